"""Any model on the ideal stepped sine: in closed form where that is all it needs, else sampled."""

import math
from collections.abc import Sequence

import numpy as np

from table_io.block import Float1D, Float2D
from twin.model.model import Model
from twin.model.solver import OUTPUTS
from twin.model.sweep import EXTREMES, SteppedSine, held, stepped_sine

SAMPLES = 1000  # a cycle, least, where it is sampled: extremes then lack at most 5e-6 of themselves


def swept(
    model: Model, frequencies_hz: Sequence[float] | Float1D, acceleration: float, cycles: int
) -> SteppedSine:
    """Whole `cycles` of A = acceleration sin(2 pi f t) at each frequency, from rest, carried on.

    As `stepped_sine`, which does it where every effect only changes parameters. Else the drive is
    linear between `SAMPLES` a cycle (a multiple, where a contact needs it) and extremes are those
    of the samples; the table's displacement is -A / w^2. Sensors are not applied: this is the
    motion.
    """
    if all(one.effect.acts in ("parameters", "sensor") for one in model.present):
        return stepped_sine(model.parameters, frequencies_hz, acceleration, cycles)
    frequencies = held(frequencies_hz, acceleration, cycles)
    extremes = np.empty((frequencies.size, cycles, len(EXTREMES)))
    ends, state = [], None
    time, touching = 0.0, (False, False)
    for place, hz in enumerate(frequencies.tolist()):
        samples = SAMPLES * max(1, math.ceil(model.least_rate_hz / (SAMPLES * hz)))
        wave = np.sin(2 * math.pi * np.arange(1, samples * cycles + 1) / samples)
        rate, out = samples * hz, np.empty((OUTPUTS, wave.size))
        solver = model.prepare(rate)
        if state is None:
            state = solver.rest()
        solver.retime(state, time * rate)
        table_disp = -acceleration / (2 * math.pi * hz) ** 2 * wave
        solver.advance(state, acceleration * wave, table_disp, out)
        time += cycles / hz
        extremes[place] = _extremes(out, cycles, touching)
        touching = bool(out[3, -1] > 0), bool(out[4, -1] < 0)
        ends.append(state.copy())
    return SteppedSine(extremes, np.array(ends))


def _extremes(out: Float2D, cycles: int, touching: tuple[bool, bool]) -> Float2D:
    """`EXTREMES` of each cycle, (cycle, 8); `touching` before the first sample."""
    rows = out.reshape(OUTPUTS, cycles, -1)
    u, a, right, left = rows[0], rows[2], rows[3], rows[4]
    onsets = []
    for force, before in ((out[3], touching[0]), (-out[4], touching[1])):
        contact = np.concatenate([[before], force > 0])
        begins = contact[1:] & ~contact[:-1]
        onsets.append(begins.reshape(cycles, -1).sum(axis=1).astype(np.float64))
    return np.stack(
        [
            u.max(axis=1), u.min(axis=1), a.max(axis=1), a.min(axis=1), right.max(axis=1),
            left.min(axis=1), *onsets,
        ],
        axis=1,
    )  # fmt: skip
