"""Loop check: verification of wiring, sensors and servo at low level before every run.

    plan_targets(profile, rig) -> steady motions, in the order in which they are driven
    count_hold_cycles(target, profile) -> cycles to hold, the first SETTLE_CYCLES not evaluated
    evaluate(block, drive, profile, rig, tare_noise=None) -> (checks, response or None)
    evaluate_transfer(response, frequency_hz) -> acceleration over command, complex

No check judges the specimen: it may resonate and touch its bumpers.
"""

import math

import numpy as np

from table_io.block import Block
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.control.order_tracking import evaluate_gain, evaluate_transfer
from table_io.excitation.drive import Drive
from table_io.excitation.trajectory import SineTarget
from table_io.records import Check, FrequencyResponse
from table_io.safety.loop_check.checks import (
    check_alive,
    check_derivative_consistency,
    check_lost_samples,
    check_mass_polarity,
    check_noise,
    check_read_back,
    check_rest,
    check_table_response,
    unwrap_phase,
)
from table_io.safety.loop_check.data import LoopCheckData
from table_io.safety.loop_check.load_cells import check_load_cells
from table_io.units import GRAVITY_M_S2

__all__ = [
    "count_hold_cycles",
    "evaluate",
    "evaluate_gain",
    "evaluate_transfer",
    "find_remedy",
    "plan_targets",
]

SETTLE_CYCLES = 1
MIN_HOLD_S = 2.0  # noise then changes a gain by 0.2 % at 10 Hz; over five cycles by 0.5 %
MAX_LEVEL_RATIO = 0.1  # of the test level
MIN_CHECK_HZ = 1.0
MIN_FREQUENCY_RATIO = 1.1  # closer frequencies are merged
MAX_CANCELLED_ORDER = 5  # highest harmonic of the table that may be canceled
CHECK_FUNCTIONS = (
    check_lost_samples,
    check_alive,
    check_read_back,
    check_table_response,
    check_mass_polarity,
    check_derivative_consistency,
    check_noise,
    check_rest,
    check_load_cells,
)
REMEDIES = {
    "lost samples": "check the cable and the acquisition device",
    "alive": "check the cable, supply and range of the sensor",
    "command read back": "connect the command output to its input, and check span_mm and span_v of "
    "the output",
    "polarity": "turn the sensor around, or change the sign of volts_per_unit in the rig file",
    "gain off": "check for a loose sensor or a resonance of the table",
    "gain at": "lower the frequencies of the excitation or tune the servo",
    "gain": "check unit and volts_per_unit in the rig file against the sensor, then the servo",
    "delay": "check filters and the clocks of output and input",
    "second derivative": "check gain, unit, sign, filter and input of both sensors; they may be "
    "swapped",
    "noise": "check for ground loops and the range, or raise the level of the excitation",
    "offset": "tare again with the table at rest and the bumpers unloaded",
    "motion left": "let the servo come to rest, or raise loop_check.rest_s",
    "cross-talk": "check that the gap is as large as stated; if so, the cell responds to the "
    "motion of the table",
    "force ratio": "check that both load cells of this side are connected and loaded",
}


def plan_targets(profile: Profile, rig: RigConfig) -> tuple[SineTarget, ...]:
    """Plan the steady motions of the check as sine targets, lowest frequency first.

    Three frequencies in equal ratios between the ends of the excitation's band (from 1 Hz if it
    starts below and ends above it); two more, up to the fifth harmonic of the highest frequency, if
    harmonics are canceled. Where an amplitude has fewer DAC steps than `output.least_lsb`, the
    level is raised to at most a tenth of the test level; beyond that the frequency is lowered, and
    the response above it is extrapolated. A rig with friction may ask for a larger level.
    """
    plan, settings = profile.plan, profile.loop_check
    test_level = plan.level_m_s2
    least = min(rig.table_response.least_level_g * GRAVITY_M_S2, test_level)
    lowest = max(settings.level * test_level, least)
    min_amplitude_m = rig.output.least_lsb * rig.output.lsb_m

    def limit_frequency(f: float) -> float:
        resolvable_hz = math.sqrt(MAX_LEVEL_RATIO * test_level / min_amplitude_m) / (2 * math.pi)
        return min(f, resolvable_hz, rig.limits.frequency_hz)

    requested_hz = list(settings.frequencies_hz)
    if not requested_hz:
        high_hz = limit_frequency(plan.high_hz)
        low_hz = min(
            max(plan.low_hz, MIN_CHECK_HZ) if high_hz > MIN_CHECK_HZ else plan.low_hz, high_hz
        )
        requested_hz = [low_hz, math.sqrt(low_hz * high_hz), high_hz]
        if plan.steps and profile.control.harmonics:
            top_hz = limit_frequency(MAX_CANCELLED_ORDER * plan.high_hz)
            requested_hz += [math.sqrt(high_hz * top_hz), top_hz]
    targets: list[SineTarget] = []
    for f in sorted(map(limit_frequency, requested_hz)):
        if not targets or f > MIN_FREQUENCY_RATIO * targets[-1].frequency_hz:
            targets.append(SineTarget(f, max(lowest, min_amplitude_m * (2 * math.pi * f) ** 2)))
    return tuple(targets)


def count_hold_cycles(target: SineTarget, profile: Profile) -> int:
    """Count the cycles to hold at a target, settling included; they last MIN_HOLD_S or longer."""
    return SETTLE_CYCLES + max(
        profile.loop_check.cycles, math.ceil(MIN_HOLD_S * target.frequency_hz - 1e-9)
    )


def evaluate(
    block: Block,
    drive: Drive,
    profile: Profile,
    rig: RigConfig,
    tare_noise: dict[str, float] | None = None,
) -> tuple[tuple[Check, ...], FrequencyResponse | None]:
    """Evaluate the loop check: return (checks, frequency response of the table).

    `block` holds the rest before, the motions and the rest after them, SI. Checks whose channels
    are missing are omitted. The response is None if the table's accelerometer is lost.
    """
    data = LoopCheckData(block, drive, profile, rig, tare_noise or {})
    if not data.holds:
        return (), None
    checks = tuple(check for check_function in CHECK_FUNCTIONS for check in check_function(data))
    return checks, _compute_response(data)


def find_remedy(check: Check) -> str:
    """Return the remedy for a failed check; empty if there is none."""
    return next((text for name, text in REMEDIES.items() if check.name.startswith(name)), "")


def _compute_response(data: LoopCheckData) -> FrequencyResponse | None:
    tones = data.tones("table_acc_m_s2")
    if not (np.isfinite(tones).all() and np.abs(tones).all()):
        return None
    frequencies_hz = data.frequencies_hz
    phase = unwrap_phase(tones, frequencies_hz)
    gain = np.abs(tones)
    return FrequencyResponse(
        data.block.end, tuple(frequencies_hz.tolist()), tuple(gain.tolist()), tuple(phase.tolist())
    )
