"""Periodic orbits of the simulated plant with payload reaction, by shooting on the plant itself.

Unknown are (x, x', y, y') at a section without contact, the amplitude of the command and the
frequency; the motion returns, the fundamental of the table's acceleration is the level, and that of
u is given, which passes both folds of the primary resonance. Nothing of the twin is used.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from table_io.sim.plant import Plant

SAMPLES_PER_PERIOD = 400  # of a period
UNKNOWN_SCALES = np.array([1e-3, 2e-2, 1e-3, 2e-2, 1e-3, 1.0])
DIFFERENCE_STEP, MAX_STEP, MAX_STEPS = 1e-5, 0.2, 25
STEP_TOLERANCE = 1e-6  # in UNKNOWN_SCALES
SETTLING_PERIODS = 300
AMPLITUDE_STEP_M = 2e-5


@dataclass(frozen=True)
class PlantOrbit:
    """Orbit at a level: fundamental of u in m, Hz, largest Floquet multiplier, shooting unknowns.

    The section lies at `phase` of the command, in cycles.
    """

    fundamental_m: float
    frequency_hz: float
    multiplier: complex
    unknowns: np.ndarray
    phase: float


def trace_orbits(
    plant: Plant, level_m_s2: float, low_m: float, high_m: float, start_hz: float = 3.5
) -> list[PlantOrbit]:
    """Return the orbits of `low_m` to `high_m`, from that without impacts at `start_hz`.

    Fewer where Newton's method ends beyond the upper fold.
    """
    unknowns, phase = _settle(plant, level_m_s2, start_hz)
    orbits: list[PlantOrbit] = []
    amplitude = _measure(_play(plant, unknowns, phase)[1], start_hz)[1]
    while amplitude < high_m:
        solved = _solve(plant, unknowns, phase, amplitude, level_m_s2)
        if solved is None:
            break
        multiplier = _find_multiplier(plant, solved, phase)
        if amplitude >= low_m:
            orbits.append(PlantOrbit(amplitude, float(solved[5]), multiplier, solved, phase))
        unknowns, phase = _move_section(plant, solved, phase)
        amplitude += AMPLITUDE_STEP_M
    return orbits


def _play(plant: Plant, unknowns: np.ndarray, phase: float, samples: int = SAMPLES_PER_PERIOD):
    """(state, SIGNALS) after samples of a period that starts at a phase of the command."""
    x, v, y, w, amplitude, frequency_hz = unknowns
    own = replace(plant, rate_hz=SAMPLES_PER_PERIOD * frequency_hz, servo_delay_s=0.0)
    index = np.arange(-own.history_samples, samples)
    state = np.array([x, v, y, w, 0.0, 0.0, 0.0, 0.0])
    out = np.empty((7, samples))
    own.advance(state, amplitude * np.sin(math.tau * (phase + index / SAMPLES_PER_PERIOD)), out)
    return state, out


def _measure(out: np.ndarray, frequency_hz: float) -> tuple[float, float]:
    """Fundamentals of the table's acceleration in m/s2, from its motion, and of u in m.

    The acceleration itself jumps at an impact, so its samples give no smooth function.
    """
    turn = (
        2
        / SAMPLES_PER_PERIOD
        * np.exp(-2j * math.pi * np.arange(out.shape[1]) / SAMPLES_PER_PERIOD)
    )
    table_m, u_m = (float(abs(values @ turn)) for values in (out[0], out[2] - out[0]))
    return (math.tau * frequency_hz) ** 2 * table_m, u_m


def _residual(plant, unknowns, phase, amplitude_m, level) -> np.ndarray:
    state, out = _play(plant, unknowns, phase)
    acceleration, u_m = _measure(out, unknowns[5])
    return np.append(
        (state[:4] - unknowns[:4]) / UNKNOWN_SCALES[:4],
        [acceleration / level - 1, u_m / amplitude_m - 1],
    )


def _solve(plant, unknowns, phase, amplitude_m, level) -> np.ndarray | None:
    for _ in range(MAX_STEPS):
        columns = [
            _residual(plant, unknowns + step, phase, amplitude_m, level)
            - _residual(plant, unknowns - step, phase, amplitude_m, level)
            for step in DIFFERENCE_STEP * np.diag(UNKNOWN_SCALES)
        ]
        jacobian = np.column_stack(columns) / (2 * DIFFERENCE_STEP)
        residual = _residual(plant, unknowns, phase, amplitude_m, level)
        step = np.linalg.solve(jacobian, -residual)
        step *= min(1.0, MAX_STEP / np.abs(step).max())
        unknowns = unknowns + step * UNKNOWN_SCALES
        if np.abs(step).max() < STEP_TOLERANCE:
            return unknowns
    return None


def _find_multiplier(plant, unknowns, phase) -> complex:
    columns = [
        (_play(plant, unknowns + step, phase)[0] - _play(plant, unknowns - step, phase)[0])[:4]
        for step in DIFFERENCE_STEP * np.diag(UNKNOWN_SCALES)[:4]
    ]
    jacobian = np.column_stack(columns) / (2 * DIFFERENCE_STEP)
    multipliers = np.linalg.eigvals(jacobian / UNKNOWN_SCALES[:4, None])
    return complex(multipliers[np.abs(multipliers).argmax()])


def _move_section(plant, unknowns, phase) -> tuple[np.ndarray, float]:
    """Move the section to where u passes 0 upwards, away from the bumpers."""
    out = _play(plant, unknowns, phase)[1]
    u = out[2] - out[0]
    upcrossings = np.flatnonzero((u[:-1] <= 0) & (u[1:] > 0))
    if not upcrossings.size:
        return unknowns, phase
    count = int(upcrossings[0]) + 1
    state = _play(plant, unknowns, phase, count)[0]
    return np.append(state[:4], unknowns[4:]), (phase + count / SAMPLES_PER_PERIOD) % 1.0


def _settle(plant: Plant, level: float, frequency_hz: float) -> tuple[np.ndarray, float]:
    """Play a command of about the level from rest, until the motion repeats."""
    command_m = level / (math.tau * frequency_hz) ** 2
    unknowns = np.array([0.0, 0.0, 0.0, 0.0, command_m, frequency_hz])
    for _ in range(SETTLING_PERIODS):
        state, out = _play(plant, unknowns, 0.0)
        unknowns[:4] = state[:4]
    unknowns[:5] *= level / _measure(out, frequency_hz)[0]
    return _move_section(plant, unknowns, 0.0)
