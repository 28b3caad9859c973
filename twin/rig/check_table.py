"""`shaketwin check --table NAME`: check of the wiring at rest, without moving the table.

The output is started only if the readback of the command is at 0 V already, and is then held at
0 V, as at the start of every run. Nothing else is queued.
"""

import contextlib
import statistics
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, TypeGuard

import numpy as np

from table_io.backends import (
    AcquisitionSource,
    Backend,
    DigitalInputs,
    MachineLost,
    find_descriptor,
    open_backend,
    open_source,
)
from table_io.block import Float2D
from table_io.clock import Clock, ManualClock, RealClock, local_datetime
from table_io.config.base import PROFILES_DIR, load_config
from table_io.config.calibration import find_overdue_calibrations
from table_io.config.folders import find_config
from table_io.config.profile import AcquisitionConfig, Profile
from table_io.config.rig import RigConfig
from table_io.config.rig_file import load_rig
from table_io.safety.wiring_check import (
    CheckLine,
    RestingInputs,
    Stimulus,
    TapResponse,
    check_digital_inputs,
    check_resting_inputs,
    check_value,
    check_zero_command,
    evaluate_tap,
    find_tap_onset,
    is_disturbed,
    list_stimuli,
    mark_untested,
)
from twin.live.process_config import request_realtime

CHECK_PRIORITY = 50  # as for a rig: the machine's watchdog acts on a silent client
TARE_S, REST_S, BLOCK_S = 1.0, 4.0, 0.02
# Phases of a stimulus by hand: see `_record_response`.
SETTLE_S, PRE_TRIGGER_S, STIMULUS_TIMEOUT_S, POST_TRIGGER_S = 1.0, 0.4, 30.0, 0.8
MAX_TRIES = 3  # if the operator acts too early
MAX_LATENESS_MS = 100.0
RELEASE_WAIT_S = 0.5  # until the release has taken effect; the inputs are then read as long


class Operator(Protocol):
    """Interface to an operator at the table."""

    def ask(self, what: str) -> None:
        """Prompt the operator for an action."""

    def declines(self) -> bool:
        """Return True if the operator skips this action; does not wait."""


@dataclass
class WiringCheckResult:
    """Result of the wiring check; `resting` holds the inputs at rest, None without samples.

    `levels` are successive readings of the digital inputs while the output was held.
    """

    rig: RigConfig
    lines: list[CheckLine] = field(default_factory=list)
    resting: RestingInputs | None = None
    levels: list[dict[str, bool]] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    @property
    def has_passed(self) -> bool:
        return all(line.verdict != "fail" for line in self.lines)


def check_table(
    table: str | Path,
    operator: Operator | None = None,
    tell: Callable[[str], None] = lambda sentence: None,
) -> WiringCheckResult:
    """Check the wiring of a table at rest; with an operator also by hand. Nothing is driven.

    `tell` gets a sentence before the machine is opened. A simulated table has no operator.
    """
    rig, _ = load_rig(find_config(str(table), "rigs", option="--table"))
    clock: Clock = ManualClock() if rig.runs_at_any_speed else RealClock()
    tell(f"{rig.title}: at rest, for {TARE_S + REST_S:g} s; keep away from the table")
    if rig.runs_at_any_speed:
        operator = None
    else:
        request_realtime(CHECK_PRIORITY)
    return examine_wiring(rig, clock, make_machine(rig, clock), operator or False)


def make_machine(rig: RigConfig, clock: Clock) -> Backend | AcquisitionSource:
    """Return the machine of a rig, at its usual sample rate; an input-only one is a source."""
    profile, _ = load_config(PROFILES_DIR / "tests" / "quickstart.toml", Profile, "test profile")
    default_rate_hz = profile.acquisition.rate_hz
    rate_hz = default_rate_hz if default_rate_hz in rig.rates_hz else max(rig.rates_hz)
    if not find_descriptor(rig).drives:
        return open_source(rig, rate_hz, clock)
    rest_profile = profile.model_copy(update={"acquisition": AcquisitionConfig(rate_hz=rate_hz)})
    return open_backend(rig, rest_profile, clock)


def _is_backend(machine: Backend | AcquisitionSource) -> TypeGuard[Backend]:
    return hasattr(machine, "queue")


def examine_wiring(
    rig: RigConfig, clock: Clock, machine: Backend | AcquisitionSource, operator: Operator | bool
) -> WiringCheckResult:
    """Run every check of the wiring; `operator` is False if no one can be prompted.

    Long computations wait until the machine is released: its watchdog acts on a silent client.
    """
    result = WiringCheckResult(
        rig, warnings=find_overdue_calibrations(rig, local_datetime().date())
    )
    open_digital_inputs = find_descriptor(rig).open_digital_inputs
    later_lines: list[CheckLine] = []
    inputs, released_levels = None, []
    try:
        machine.open()
        inputs = open_digital_inputs(rig) if open_digital_inputs else None
        read_samples = _hold_output(machine, result)
        if read_samples is not None:
            later_lines.append(_measure_rest(result, clock, machine, read_samples, inputs))
        else:
            reason = (
                "the command wired back is not at 0 V, so a start could move the table: correct it"
            )
            later_lines.append(mark_untested("samples on time", "", reason))
        for stimulus in list_stimuli(rig):
            if read_samples is None or isinstance(operator, bool):
                reason = (
                    "the output is not held" if read_samples is None else "no operator to prompt"
                )
                later_lines += evaluate_tap(stimulus, None, f"{reason}: {stimulus.prompt}")
            else:
                response = _record_response(
                    stimulus, result, machine.rate_hz, read_samples, operator
                )
                later_lines += evaluate_tap(
                    stimulus, response, f"skipped by the operator: {stimulus.prompt}"
                )
    except MachineLost as error:
        later_lines.append(check_value("machine answers", "", 0.0, (1.0, 1.0), "", str(error)))
    finally:
        machine.close()
        if inputs is not None:
            released_levels = _sample_released_levels(inputs, clock)
    later_lines += check_digital_inputs(
        result.levels, REST_S, released_levels, open_digital_inputs is not None, rig.is_simulated
    )
    result.lines = [
        *(check_resting_inputs(result.resting) if result.resting is not None else ()),
        *later_lines,
    ]
    return result


SampleReader = Callable[[int], Float2D]


def _hold_output(
    machine: Backend | AcquisitionSource, result: WiringCheckResult
) -> SampleReader | None:
    """Hold the output at 0 V and return the sample reader; None if it must not be started.

    An input-only source has no output to hold.
    """
    rate_hz = machine.rate_hz
    if not _is_backend(machine):
        machine.start()
        return machine.read
    tare = RestingInputs(result.rig, rate_hz, machine.tare(round(TARE_S * rate_hz)))
    (line,) = check_zero_command(tare)
    if line.verdict != "pass":
        result.resting = tare
        return None
    machine.queue(0, np.zeros(2))
    machine.start()
    return machine.read


def _sample_released_levels(inputs: DigitalInputs, clock: Clock) -> list[dict[str, bool]]:
    """Return successive readings of the digital inputs after the machine was released."""
    levels = []
    clock.wait_until(clock.now() + RELEASE_WAIT_S)
    with contextlib.closing(inputs), contextlib.suppress(MachineLost):  # reported already
        for _ in range(round(RELEASE_WAIT_S / BLOCK_S)):
            levels.append(inputs.read_levels())
            clock.wait_until(clock.now() + BLOCK_S)
    return levels


def _measure_rest(
    result: WiringCheckResult,
    clock: Clock,
    machine: Backend | AcquisitionSource,
    read_samples: SampleReader,
    inputs: DigitalInputs | None,
) -> CheckLine:
    """Record the inputs at rest; return the check of their median lateness."""
    blocks, late_s = [], []
    block_samples = round(BLOCK_S * machine.rate_hz)
    for k in range(round(REST_S / BLOCK_S)):
        blocks.append(read_samples(block_samples))
        late_s.append(clock.now() - machine.scheduled_time_s((k + 1) * block_samples - 1))
        if inputs is not None:
            result.levels.append(inputs.read_levels())
    result.resting = RestingInputs(result.rig, machine.rate_hz, np.concatenate(blocks, axis=1))
    median_late_ms = 1e3 * statistics.median(late_s)
    advice = "this computer is too busy, or the device hands over in pieces that are too long"
    return check_value(
        "samples on time", "", median_late_ms, (-MAX_LATENESS_MS, MAX_LATENESS_MS), "ms", advice
    )


def _record_response(
    stimulus: Stimulus,
    result: WiringCheckResult,
    rate_hz: float,
    read_samples: SampleReader,
    operator: Operator,
) -> TapResponse | None:
    """Record the response to a stimulus by hand; None if it was skipped or timed out.

    Vibration of the previous stimulus decays for SETTLE_S. Then the operator is prompted; motion
    counts from PRE_TRIGGER_S later on, and is recorded for POST_TRIGGER_S after its onset. If the
    sensor moves earlier, the operator is prompted again, at most MAX_TRIES times.
    """
    volts_per_unit = np.array([[sensor.volts_per_unit] for sensor in result.rig.sensors])
    block_samples = round(BLOCK_S * rate_hz)
    pre_trigger_samples = round(PRE_TRIGGER_S * rate_hz)
    history_samples = round(rate_hz)

    def make_response(volts: Float2D) -> TapResponse:
        resting = result.resting
        noise = resting.noise_rms if resting is not None else np.zeros(len(volts_per_unit))
        rest_means = resting.means if resting is not None else None
        return TapResponse(
            result.rig, rate_hz, volts / volts_per_unit, noise, pre_trigger_samples, rest_means
        )

    def read_for(seconds: float) -> Float2D:
        return np.concatenate(
            [read_samples(block_samples) for _ in range(round(seconds / BLOCK_S))], axis=1
        )

    for attempt in range(MAX_TRIES):
        read_for(SETTLE_S)
        operator.ask(f"let go; once more: {stimulus.prompt}" if attempt else stimulus.prompt)
        volts = read_for(PRE_TRIGGER_S)
        if not is_disturbed(stimulus, make_response(volts)):
            break
    else:
        return make_response(volts)
    for _ in range(round(STIMULUS_TIMEOUT_S / BLOCK_S)):
        volts = np.concatenate([volts, read_samples(block_samples)], axis=1)
        if find_tap_onset(stimulus, make_response(volts)) is not None:
            return make_response(np.concatenate([volts, read_for(POST_TRIGGER_S)], axis=1))
        if operator.declines():
            break
        first_kept = max(pre_trigger_samples, volts.shape[1] - history_samples)
        volts = np.concatenate([volts[:, :pre_trigger_samples], volts[:, first_kept:]], axis=1)
    return None
