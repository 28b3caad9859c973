"""Dwell policy: hold the last step of the sweep on its branch and measure it repeatedly."""

import math

from table_io.adaptive.result import Decision, PolicyGenerator, StepResult
from table_io.config.adaptive import DwellConfig
from table_io.config.profile import Profile


def describe_policy(config: DwellConfig, profile: Profile) -> str:
    """Describe the planned dwell in one sentence."""
    last = profile.sweep.steps[-1]
    return (
        f"hold the last step, {last.frequency_hz:g} Hz {last.direction}, for "
        f"{_dwell_cycles(config, last.frequency_hz)} more held cycles, with a result every "
        f"{profile.sweep.cycles}"
    )


def run_policy(config: DwellConfig, profile: Profile) -> PolicyGenerator:
    """Request the last step of the sweep until it was held long enough; return a summary."""
    sweep, steps = profile.sweep, profile.sweep.steps[profile.first_step :]
    for _ in steps:
        first = yield None
    step, held_cycles, last = steps[-1], 0, first
    target_cycles = _dwell_cycles(config, step.frequency_hz)
    while held_cycles < target_cycles:
        reason = f"dwell, {held_cycles} of {target_cycles} cycles held so far"
        last = yield Decision(step.frequency_hz, step.direction, reason)
        held_cycles += sweep.cycles
    return (
        f"dwell at {step.frequency_hz:g} Hz {step.direction}: {held_cycles} cycles held in "
        f"{held_cycles // sweep.cycles} visits; swing of u from "
        f"{_format_swing(first)} to {_format_swing(last)}"
    )


def _dwell_cycles(config: DwellConfig, frequency_hz: float) -> int:
    if config.cycles is not None:
        return config.cycles
    return math.ceil((config.seconds or 0.0) * frequency_hz - 1e-9)


def _format_swing(result: StepResult) -> str:
    return f"+-{1e3 * result.swing_m:.4g} mm at {result.level_g:.4f} g"
