"""Closed-form response of the SNM to the ideal stepped sine, for `simulate` and ideal PRCs."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from table_io.block import Float1D, Float2D
from table_io.errors import InputError
from twin.model.closed_form import continuous_params, rest_state, substep_count
from twin.model.contact_regime import BASE, STATE_SIZE
from twin.model.parameters import Parameters
from twin.model.stepped_sine_kernel import Float3D, run_stepped_sine

if TYPE_CHECKING:
    from twin.model.valid_range import RangeExit

EXTREME_NAMES = ("u_max", "u_min", "a_max", "a_min", "f_r_max", "f_l_min", "onsets_r", "onsets_l")
MIN_STEPS_PER_CYCLE = 8  # with fewer, a contact could begin and end undetected


@dataclass(frozen=True, slots=True, eq=False)
class SteppedSineResponse:
    """Extremes of each cycle and final state of each step of a stepped sine, SI.

    extremes (step, measured cycle, 8), `EXTREME_NAMES`; states (step, STATE_SIZE). Extremes are
    true ones, from roots of the slope and from both sides of a jump, not samples. F_R >= 0,
    F_L <= 0; onsets are counted in the cycle in which they happen. `range_exits`: of each step, the
    first exit of each range of a law; empty for models without such laws.
    """

    extremes: Float3D
    states: Float2D
    range_exits: "tuple[tuple[RangeExit, ...], ...]" = ()

    def column(self, name: str) -> Float2D:
        """Return one of `EXTREME_NAMES`, (step, cycle)."""
        return self.extremes[:, :, EXTREME_NAMES.index(name)]


def validate_frequencies(
    frequencies_hz: Sequence[float] | Float1D, acceleration: float | Float1D, cycles: int
) -> Float1D:
    """Return the frequencies of a sweep in Hz, (n,); InputError if it cannot be driven."""
    frequencies = np.asarray(frequencies_hz, dtype=np.float64)
    valid = np.isfinite(frequencies) & (frequencies > 0)
    if not valid.all():
        first = int(np.argmin(valid))
        raise InputError(
            "not a drive frequency",
            key=f"frequencies_hz[{first}]",
            value=float(frequencies[first]),
            allowed="above 0 Hz, finite",
        )
    if not np.isfinite(acceleration).all():
        raise InputError(
            "not an acceleration", key="acceleration", value=acceleration, allowed="m/s2, finite"
        )
    if cycles < 1:
        raise InputError("too few cycles", key="cycles", value=cycles, allowed="1 or more")
    return frequencies


def simulate_stepped_sine(
    parameters: Parameters,
    frequencies_hz: Sequence[float] | Float1D,
    acceleration: float | Float1D,
    cycles: int,
    steps_per_cycle: int = 16,
    state: Float1D | None = None,
    measured_cycles: int | None = None,
) -> SteppedSineResponse:
    """Simulate whole `cycles` of A = acceleration sin(2 pi f t) in m/s2 at each frequency in turn.

    `acceleration` is one, or one at each frequency, (frequency,).
    Starts from `state` (not modified) or from rest. A is continuous at a change of frequency; the
    velocity of the table is not, so this is the ideal sweep, which no table can drive.
    `steps_per_cycle` is raised where a mode turns more than `closed_form.MAX_PHASE_STEP_RAD` in a
    step; the result does not depend on it unless the motion is chaotic. Extremes are computed of
    the last `measured_cycles` of each step, by default of all. InputError names inputs that cannot
    be driven.
    """
    frequencies = validate_frequencies(frequencies_hz, acceleration, cycles)
    if steps_per_cycle < MIN_STEPS_PER_CYCLE:
        raise InputError(
            "a contact could begin and end undetected",
            key="steps_per_cycle",
            value=steps_per_cycle,
            allowed=f"{MIN_STEPS_PER_CYCLE} or more",
        )
    params = continuous_params(parameters)
    steps = np.array(
        [steps_per_cycle * substep_count(params, 1 / (f * steps_per_cycle)) for f in frequencies],
        dtype=np.int64,
    )
    current = rest_state(parameters) if state is None else state.copy()
    current[BASE] = 0.0
    measured = cycles if measured_cycles is None else min(measured_cycles, cycles)
    extremes = np.empty((frequencies.size, measured, len(EXTREME_NAMES)))
    end_states = np.empty((frequencies.size, STATE_SIZE))
    peaks = np.broadcast_to(np.float64(acceleration), frequencies.shape).copy()
    work_arrays = np.empty((2, int(steps.max(initial=0)) + 1)), np.empty((4, 3))
    run_stepped_sine(
        current,
        params,
        2 * math.pi * frequencies,
        peaks,
        cycles,
        steps,
        *work_arrays,
        extremes,
        end_states,
    )
    return SteppedSineResponse(extremes, end_states)
