"""Wiring check: evaluation of inputs at rest, digital inputs, tap tests and shunts, without motion.

    check_resting_inputs(resting) -> check lines of the inputs at rest
    check_zero_command(resting) -> check line of the command at 0 V output
    check_digital_inputs(...) -> check lines of heartbeat and switches
    list_stimuli(rig) -> stimuli (tap, press, shunt) that the operator is asked to apply
    is_disturbed(stimulus, response) -> True if the stimulus came too early
    find_tap_onset(stimulus, response) -> sample at which it came
    evaluate_tap(stimulus, response, reason) -> its check lines

Functions take samples that are already acquired.
"""

from table_io.safety.wiring_check.check_line import CheckLine, check_value, mark_untested
from table_io.safety.wiring_check.digital_inputs import check_digital_inputs
from table_io.safety.wiring_check.static_checks import (
    RestingInputs,
    check_resting_inputs,
    check_zero_command,
)
from table_io.safety.wiring_check.tap_test import (
    Stimulus,
    TapResponse,
    evaluate_tap,
    find_tap_onset,
    is_disturbed,
    list_stimuli,
)

__all__ = [
    "CheckLine",
    "RestingInputs",
    "Stimulus",
    "TapResponse",
    "check_digital_inputs",
    "check_resting_inputs",
    "check_value",
    "check_zero_command",
    "evaluate_tap",
    "find_tap_onset",
    "is_disturbed",
    "list_stimuli",
    "mark_untested",
]  # fmt: skip
