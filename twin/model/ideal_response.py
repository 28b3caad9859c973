"""Response of any model to the ideal stepped sine: in closed form if possible, else sampled."""

import math
from collections.abc import Sequence

import numpy as np

from table_io.block import Float1D, Float2D
from twin.model.model import Model
from twin.model.prepare import prepare_solver
from twin.model.solver import OUTPUT_COUNT
from twin.model.stepped_sine import (
    EXTREME_NAMES,
    SteppedSineResponse,
    simulate_stepped_sine,
    validate_frequencies,
)
from twin.model.valid_range import find_range_exits

MIN_SAMPLES_PER_CYCLE = 1000  # underestimates extremes by at most 5e-6 of their value


def simulate_sweep(
    model: Model,
    frequencies_hz: Sequence[float] | Float1D,
    acceleration: float | Float1D,
    cycles: int,
    measured_cycles: int | None = None,
) -> SteppedSineResponse:
    """Simulate whole `cycles` of A = acceleration sin(2 pi f t) at each frequency, from rest.

    `acceleration` in m/s2 is one, or one at each frequency, (frequency,). The state carries over
    between frequencies. Extremes are returned of the last `measured_cycles` at each frequency, by
    default of all. `stepped_sine` computes it if effects only change parameters. Otherwise the
    drive is linear between `MIN_SAMPLES_PER_CYCLE` samples (a multiple, where a contact needs it)
    and extremes are those of the samples; the table displacement is -A / w^2. Sensor effects are
    not applied: this is the true motion. Exits of ranges of laws are those of all cycles.
    """
    if model.changes_only_parameters:
        return simulate_stepped_sine(
            model.parameters, frequencies_hz, acceleration, cycles, measured_cycles=measured_cycles
        )
    frequencies = validate_frequencies(frequencies_hz, acceleration, cycles)
    levels = np.broadcast_to(np.float64(acceleration), frequencies.shape).tolist()
    extremes = np.empty((frequencies.size, cycles, len(EXTREME_NAMES)))
    end_states, range_exits, state = [], [], None
    time, in_contact = 0.0, (False, False)
    for index, (frequency_hz, level) in enumerate(zip(frequencies.tolist(), levels, strict=True)):
        samples = MIN_SAMPLES_PER_CYCLE * max(
            1, math.ceil(model.min_rate_hz / (MIN_SAMPLES_PER_CYCLE * frequency_hz))
        )
        wave = np.sin(2 * math.pi * np.arange(1, samples * cycles + 1) / samples)
        rate_hz, out = samples * frequency_hz, np.empty((OUTPUT_COUNT, wave.size))
        solver = prepare_solver(model, rate_hz)
        if state is None:
            state = solver.rest_state()
        solver.set_clock(state, time * rate_hz)
        table_disp = -level / (2 * math.pi * frequency_hz) ** 2 * wave
        solver.advance(state, level * wave, table_disp, out)
        sample_times = time + np.arange(1, wave.size + 1) / rate_hz
        motion = {"u": out[0], "v": out[1], "a": level * wave, "t": sample_times, "y": table_disp}
        range_exits.append(tuple(find_range_exits(model, motion)))
        time += cycles / frequency_hz
        extremes[index] = sampled_extremes(out, cycles, in_contact)
        in_contact = bool(out[3, -1] > 0), bool(out[4, -1] < 0)
        end_states.append(state.copy())
    measured = cycles if measured_cycles is None else measured_cycles
    return SteppedSineResponse(extremes[:, -measured:], np.array(end_states), tuple(range_exits))


def sampled_extremes(out: Float2D, cycles: int, in_contact: tuple[bool, bool]) -> Float2D:
    """Return `EXTREME_NAMES` of each cycle, (cycle, 8); `in_contact` before the first sample."""
    rows = out.reshape(OUTPUT_COUNT, cycles, -1)
    u, a, right, left = rows[0], rows[2], rows[3], rows[4]
    onsets = []
    for force, before in ((out[3], in_contact[0]), (-out[4], in_contact[1])):
        contact = np.concatenate([[before], force > 0])
        onset_flags = contact[1:] & ~contact[:-1]
        onsets.append(onset_flags.reshape(cycles, -1).sum(axis=1).astype(np.float64))
    return np.stack(
        [
            u.max(axis=1), u.min(axis=1), a.max(axis=1), a.min(axis=1), right.max(axis=1),
            left.min(axis=1), *onsets,
        ],
        axis=1,
    )  # fmt: skip
