"""Feedback that holds an unstable orbit: closed-loop multipliers and gains, from the model alone.

The law is that of `table_io.control.orbit_feedback`: after each block a sine is fitted to the
deviation e of the mass in the laboratory frame over a window, and the command answers it a horizon
later with gain e + rate_gain e', blended with the previous answer. In parts of a block this is a
discrete-time system over one period: the model's linearized motion, the table as a low pass behind
a dead time, the parts of the window and the answers on their way. Its multipliers say how fast a
deviation decays with the feedback.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from table_io.block import Float1D, Float2D
from table_io.config.excitation.waveform import smoothstep
from table_io.control.orbit_feedback import BLEND_S, WINDOW_S
from table_io.errors import InputError
from twin.dynamics.linearized_orbit import LinearizedOrbit, LinearPart
from twin.dynamics.orbits import Orbit

PARTS_PER_BLOCK = 4
TABLE_LAG_S = 0.01  # of the latency, the part that is a low pass: a servo of about 20 Hz
COMMAND_ERROR = 0.1  # relative error of the table's gain that a margin includes
MAX_GAIN, GAIN_STEP, FINE_GAIN_STEP = 1.2, 0.1, 0.025
MAX_RATE_GAIN_S, RATE_GAIN_STEP_S, FINE_RATE_GAIN_STEP_S = 0.04, 0.005, 0.00125
GAIN_STATIONS = 8  # orbits at which the gains are settled; they vary slowly along the branch
MAX_MULTIPLIER = 0.8  # of the closed loop with every error: a deviation must decay
LATENCY_RESOLUTION_S = 0.002  # of the largest allowed latency in a refusal
COARSE_CANDIDATES = 12  # of the coarse grid, that are compared with every error


@dataclass(frozen=True, slots=True)
class FeedbackTiming:
    """Timing of the feedback in s.

    latency_s: from the end of a block to the table's answer to it; jitter_s: what may be added to
    it; block_s: between answers.
    """

    latency_s: float
    jitter_s: float
    block_s: float


@dataclass(frozen=True, slots=True)
class FeedbackGains:
    """Gains, and the largest closed-loop multiplier over one period with every stated error."""

    gain: float
    rate_gain_s: float
    multiplier: float


@dataclass(frozen=True, slots=True, eq=False)
class OpenLoop:
    """Linearized motion about an orbit in parts of a block, for the feedback."""

    frequency_hz: float
    parts: Sequence[LinearPart]

    @property
    def part_s(self) -> float:
        """Duration of a part in s."""
        return 1.0 / (self.frequency_hz * len(self.parts))

    @classmethod
    def from_orbit(cls, orbit: Orbit, block_s: float) -> "OpenLoop":
        """Return the open loop with a whole number of blocks of about `block_s` per period."""
        blocks = max(1, round(1.0 / (orbit.frequency_hz * block_s)))
        linearized = LinearizedOrbit(orbit, blocks * PARTS_PER_BLOCK)
        return cls(orbit.frequency_hz, linearized.linearize_parts(2.0 / TABLE_LAG_S))


def closed_loop_multipliers(loop: OpenLoop, latency_s: float, gains: Float2D) -> Float1D:
    """Return the largest magnitude of the closed-loop multipliers for each gain pair, (k,).

    gains (k, 2): gain, and rate gain in s.

    The state is (coordinates, y, y'), the last mean deviations of the parts in the window, and
    the phasors of the last answers, newest first, each (Re, Im).
    """
    count, w = PARTS_PER_BLOCK, 2.0 * math.pi * loop.frequency_hz
    dead = max(0, round((latency_s - TABLE_LAG_S) / loop.part_s))
    window = max(count, round(WINDOW_S / loop.part_s))
    z_size = loop.parts[0].mean_row.size
    weights = [_answer_weights(index, dead, loop.part_s, w) for index in range(count)]
    answers = z_size + window
    size = answers + max(row.size for row in weights)
    demand = _demand_rows(window, loop.part_s, w)
    product: npt.NDArray[np.float64] = np.broadcast_to(
        np.eye(size), (len(gains), size, size)
    ).copy()
    for first in range(0, len(loop.parts), count):
        state = np.eye(size)
        for part, row in zip(loop.parts[first : first + count], weights, strict=True):
            command = np.zeros(size)
            command[answers : answers + row.size] = row
            mean = part.mean_row @ state[:z_size] + part.mean_from_command * command
            state[z_size + 1 : answers] = state[z_size : answers - 1].copy()
            state[z_size] = mean
            state[:z_size] = part.transition @ state[:z_size] + np.outer(part.from_command, command)
        state[answers + 2 :] = np.eye(size)[answers:-2]
        deviation = demand @ state[z_size:answers]
        block = np.broadcast_to(state, product.shape).copy()
        turned = np.array([-w * deviation[1], w * deviation[0]])
        block[:, answers : answers + 2] = (
            gains[:, :1, None] * deviation + gains[:, 1:, None] * turned
        )
        product = block @ product
    multipliers: Float1D = np.abs(np.linalg.eigvals(product)).max(axis=1)
    return multipliers


def _answer_weights(index: int, dead: int, part_s: float, w: float) -> Float1D:
    """Return the weights of the phasors (Re, Im) of the answers, newest first, in a part's command.

    index: of the part in its block; dead: parts between the end of a block and its answer.
    """
    weights, remaining, answer = [], 1.0, 0
    while remaining > 0.0:
        time_s = (index + answer * PARTS_PER_BLOCK - dead + 0.5) * part_s
        blend = float(smoothstep(np.array(time_s / BLEND_S)))
        weight = remaining * blend
        weights += [weight * math.cos(w * time_s), -weight * math.sin(w * time_s)]
        remaining -= weight
        answer += 1
    return np.array(weights)


def _demand_rows(window: int, part_s: float, w: float) -> Float2D:
    """Return the fit (Re E, Im E) of e = Re(E exp(i w t)) to the parts before t = 0, newest first.

    (2, window), of the means of the parts.
    """
    angle = -w * (np.arange(window) + 0.5) * part_s
    rows: Float2D = np.linalg.pinv(np.column_stack([np.cos(angle), -np.sin(angle)]))
    return rows


def settle_gains(loops: Sequence[OpenLoop], timing: FeedbackTiming) -> FeedbackGains:
    """Return the gains with the smallest largest multiplier over an orbit and its variants.

    loops: that of the orbit first, then those of models with errors. Each is taken with and without
    the jitter and with the table's gain off by +-COMMAND_ERROR.
    """

    def worst(gains: Float2D) -> Float1D:
        return np.max(
            [
                closed_loop_multipliers(loop, timing.latency_s + jitter_s, factor * gains)
                for loop in loops
                for jitter_s in {0.0, timing.jitter_s}
                for factor in (1.0 - COMMAND_ERROR, 1.0 + COMMAND_ERROR)
            ],
            axis=0,
        )

    coarse = _make_grid((0.0, MAX_GAIN, GAIN_STEP), (0.0, MAX_RATE_GAIN_S, RATE_GAIN_STEP_S))
    mean_latency_s = timing.latency_s + timing.jitter_s / 2
    nominal = closed_loop_multipliers(loops[0], mean_latency_s, coarse)
    coarse = coarse[np.argsort(nominal)[:COARSE_CANDIDATES]]
    gain, rate_gain = coarse[int(worst(coarse).argmin())].tolist()
    fine = _make_grid(
        (gain - GAIN_STEP / 2, gain + GAIN_STEP / 2, FINE_GAIN_STEP),
        (rate_gain - RATE_GAIN_STEP_S / 2, rate_gain + RATE_GAIN_STEP_S / 2, FINE_RATE_GAIN_STEP_S),
    )
    multipliers = worst(fine)
    best = int(multipliers.argmin())
    gain, rate_gain = fine[best].round(6).tolist()
    return FeedbackGains(gain, rate_gain, float(multipliers[best]))


def interpolate_gains(
    list_orbits: Callable[[int], list[Orbit]], positions: Sequence[float], timing: FeedbackTiming
) -> list[tuple[float, float]]:
    """Return (gain, rate gain in s) at ascending positions, settled at GAIN_STATIONS of them.

    list_orbits: by index of a position, its orbit first, then those of models with errors.
    InputError if the latency is too large at one of them.
    """
    stations = np.unique(np.linspace(0, len(positions) - 1, GAIN_STATIONS).round().astype(int))
    settled = []
    for station in stations.tolist():
        loops = [OpenLoop.from_orbit(orbit, timing.block_s) for orbit in list_orbits(station)]
        gains = settle_gains(loops, timing)
        if gains.multiplier > MAX_MULTIPLIER:
            raise _make_latency_error(loops, timing, gains)
        settled.append(gains)
    own = [positions[station] for station in stations]
    gain = np.interp(positions, own, [gains.gain for gains in settled])
    rate_gain = np.interp(positions, own, [gains.rate_gain_s for gains in settled])
    return list(zip(gain.tolist(), rate_gain.tolist(), strict=True))


def _make_latency_error(
    loops: Sequence[OpenLoop], timing: FeedbackTiming, gains: FeedbackGains
) -> InputError:
    """Return the error that no gains hold an orbit at this latency, with the largest allowed."""
    low, high = 0.0, timing.latency_s
    while high - low > LATENCY_RESOLUTION_S:
        middle = (low + high) / 2
        shorter = FeedbackTiming(middle, timing.jitter_s, timing.block_s)
        if settle_gains(loops, shorter).multiplier > MAX_MULTIPLIER:
            high = middle
        else:
            low = middle
    return InputError(
        f"no feedback holds the unstable orbit at {loops[0].frequency_hz:.4g} Hz with this "
        f"latency: a deviation grows {gains.multiplier:.2g} times in a period, allowed are "
        f"{MAX_MULTIPLIER:g}",
        key="latency",
        value=f"{1e3 * timing.latency_s:.3g} ms",
        allowed=f"up to {1e3 * low:.3g} ms, with a jitter of {1e3 * timing.jitter_s:.3g} ms",
        remedy="use shorter blocks, or a device in which the command can be replaced later",
    )


def _make_grid(*ranges: tuple[float, float, float]) -> Float2D:
    """Return the points of a grid over (low, high, step) of each coordinate, (k, coordinates)."""
    axes = [low + step * np.arange(round((high - low) / step) + 1) for low, high, step in ranges]
    grid: Float2D = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
    return grid
