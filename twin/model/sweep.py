"""The SNM on the ideal stepped sine, in closed form: what `simulate` and ideal PRCs stand on."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from table_io.block import Float1D, Float2D
from table_io.card import BadInput
from twin.model.exact import parameter_constants, rest, substeps
from twin.model.parameters import Parameters
from twin.model.phase import BASE, STATE_SIZE
from twin.model.sinusoid import Float3D, stepped

EXTREMES = ("u_max", "u_min", "a_max", "a_min", "f_r_max", "f_l_min", "onsets_r", "onsets_l")
LEAST_STEPS = 8  # a cycle: fewer, and a contact could begin and end unseen


@dataclass(frozen=True, slots=True, eq=False)
class SteppedSine:
    """extremes (step, cycle, 8), `EXTREMES`, SI; states (step, STATE_SIZE) at the end of each step.

    Extremes are true ones, from roots of the slope and from both sides of a jump, not samples.
    F_R >= 0, F_L <= 0; onsets are counted in the cycle in which they happen.
    """

    extremes: Float3D
    states: Float2D

    def column(self, name: str) -> Float2D:
        """One of `EXTREMES`, (step, cycle)."""
        return self.extremes[:, :, EXTREMES.index(name)]


def held(frequencies_hz: Sequence[float] | Float1D, acceleration: float, cycles: int) -> Float1D:
    """The frequencies in Hz that a sweep holds, (n,); BadInput where it cannot be driven."""
    frequencies = np.asarray(frequencies_hz, dtype=np.float64)
    fine = np.isfinite(frequencies) & (frequencies > 0)
    if not fine.all():
        first = int(np.argmin(fine))
        raise BadInput(
            f"frequencies_hz[{first}] = {frequencies[first]:g}: allowed: above 0 Hz, finite"
        )
    if not math.isfinite(acceleration):
        raise BadInput(f"acceleration = {acceleration}: allowed: a finite number of m/s2")
    if cycles < 1:
        raise BadInput(f"cycles = {cycles}: allowed: 1 or more")
    return frequencies


def stepped_sine(
    parameters: Parameters,
    frequencies_hz: Sequence[float] | Float1D,
    acceleration: float,
    cycles: int,
    steps_per_cycle: int = 16,
    state: Float1D | None = None,
) -> SteppedSine:
    """Whole `cycles` of A = acceleration sin(2 pi f t) at each frequency, in m/s2, carried through.

    Starts from `state` (left as it is) or from rest. A is continuous at a change of frequency; the
    velocity of the table is not, so this is the ideal sweep, which no table can drive.
    `steps_per_cycle` is raised where a contact turns more than `exact.TURN` in a step; the result
    does not depend on it where the motion is not chaotic. BadInput names what cannot be driven.
    """
    frequencies = held(frequencies_hz, acceleration, cycles)
    if steps_per_cycle < LEAST_STEPS:
        raise BadInput(f"steps_per_cycle {steps_per_cycle}: allowed: {LEAST_STEPS} or more")
    con = parameter_constants(parameters)
    steps = np.array(
        [steps_per_cycle * substeps(con, 1 / (f * steps_per_cycle)) for f in frequencies],
        dtype=np.int64,
    )
    moving = rest(parameters) if state is None else state.copy()
    moving[BASE] = 0.0
    extremes = np.empty((frequencies.size, cycles, len(EXTREMES)))
    ends = np.empty((frequencies.size, STATE_SIZE))
    peaks = np.full(frequencies.size, acceleration)
    room = np.empty((2, int(steps.max(initial=0)) + 1)), np.empty((4, 3))
    stepped(moving, con, 2 * math.pi * frequencies, peaks, cycles, steps, *room, extremes, ends)
    return SteppedSine(extremes, ends)
