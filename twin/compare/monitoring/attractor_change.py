"""Attractor change: a steady motion becomes another one while the drive stays the same."""

from dataclasses import dataclass

import numpy as np

from table_io.channels import relative_displacement
from table_io.records import Event, Record
from twin.compare.monitoring.cycle import CycleData

MAX_STEADY_RANGE = 0.05  # range of the amplitude over `STEADY_CYCLES`, relative to its mean
MIN_AMPLITUDE_CHANGE = 0.25  # of the steady amplitude: another motion
STEADY_CYCLES, CONFIRMING_CYCLES = 4, 2  # for a steady motion; to confirm another one


@dataclass(frozen=True, slots=True)
class AttractorState:
    """Amplitudes of u in m of the last cycles, and the steady one, if any.

    Kept per direction and frequency, not per step: a dwell repeats steps at one frequency.
    """

    drive_key: tuple[str, float] = ("", 0.0)
    recent: tuple[float, ...] = ()
    steady_amplitude: float | None = None


def detect_attractor_change(
    state: AttractorState, cycle: CycleData
) -> tuple[AttractorState, list[Record]]:
    """Update with one cycle; return an Event if the motion has changed to another one."""
    u = relative_displacement(cycle.corrected)
    amplitude = 0.5 * float(np.ptp(u))
    drive_key = cycle.step.direction, cycle.step.frequency_hz
    if state.drive_key != drive_key or not np.isfinite(amplitude):
        state = AttractorState(drive_key)
        if not np.isfinite(amplitude):
            return state, []
    recent = (*state.recent, amplitude)[-STEADY_CYCLES:]
    steady = state.steady_amplitude
    others = [
        steady is not None and abs(value - steady) > MIN_AMPLITUDE_CHANGE * steady
        for value in recent[-CONFIRMING_CYCLES:]
    ]
    if steady is None or not all(others):
        mean = float(np.mean(recent))
        is_steady = len(recent) == STEADY_CYCLES and np.ptp(recent) <= MAX_STEADY_RANGE * mean
        settles = is_steady and not others[-1]
        return AttractorState(drive_key, recent, mean if settles else steady), []
    text = (
        f"the motion has changed to another one at {cycle.step.frequency_hz:g} Hz "
        f"{cycle.step.direction}, cycle {cycle.number}: amplitude of u "
        f"{1e3 * steady:.3g} -> {1e3 * amplitude:.3g} mm"
    )
    return AttractorState(drive_key, (), None), [Event(cycle.end, "attractor", text)]
