"""Candidates of a selection: every effect of the library, sensor effects once per channel.

Forces depend (nearly) linearly on the amplitude of a candidate, but not on its shape parameters.
Each candidate therefore has a ladder of trial shapes; the fit interpolates between them.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from table_io.channels import LEFT_CELLS, RIGHT_CELLS
from twin.identification.generic_terms import list_term_parameters, list_terms
from twin.identification.parameters import (
    GENERIC_PREFIX,
    SLIP_SPEED,
    FreeParameter,
    ParameterKey,
    ParameterSet,
    list_effect_parameters,
)
from twin.identification.residuals import LogResiduals
from twin.model.effects import EFFECTS, load_plugins
from twin.model.effects.effect import Effect

LADDER_LENGTH = 9
SLIP_SPEEDS_M_S = (1e-5, 3e-4, 1e-3, 3e-3)  # trial values; friction near zero velocity varies


@dataclass(frozen=True, slots=True)
class Candidate:
    """Candidate effect with a ladder of trial shapes.

    `effect` is None for a generic term, which represents effects outside the library.
    """

    name: str
    free: tuple[FreeParameter, ...]
    amplitude: FreeParameter  # the one of `free` that makes the effect vanish
    vanishing: float
    shapes: tuple[tuple[float, ...], ...]  # trial values of the other parameters, in their order
    effect: Effect | None = None
    channel: str = ""

    @classmethod
    def from_effect(
        cls, effect: Effect, channel: str, shapes: tuple[tuple[float, ...], ...]
    ) -> "Candidate":
        """Return the candidate of a library effect; `channel` is that of a sensor effect."""
        free = list_effect_parameters(effect, channel)
        index = next(
            i for i, parameter in enumerate(effect.parameters) if parameter.vanishing is not None
        )
        vanishing = float(effect.parameters[index].vanishing or 0.0)
        name = f"{effect.id}.{channel}" if channel else effect.id
        amplitude = free[index]
        if effect.id == "coulomb_friction":
            slip = FreeParameter(
                SLIP_SPEED,
                SLIP_SPEEDS_M_S[0],
                3.0 * SLIP_SPEEDS_M_S[-1],
                SLIP_SPEEDS_M_S[0],
                "m/s",
                logarithmic=True,
            )
            free, shapes = (*free, slip), tuple((speed,) for speed in SLIP_SPEEDS_M_S)
        return cls(name, free, amplitude, vanishing, shapes, effect, channel)

    def add_to(
        self, parameters: ParameterSet, shape: Sequence[float], amplitude: float | None = None
    ) -> ParameterSet:
        """Add the candidate, free, to a parameter set; by default its amplitude vanishes."""
        shape_keys = [free.key for free in self.free if free is not self.amplitude]
        values: dict[ParameterKey, float] = dict(zip(shape_keys, shape, strict=True))
        values[self.amplitude.key] = self.vanishing if amplitude is None else amplitude
        return parameters.with_values(values).with_free((*parameters.free, *self.free))


def list_generic_candidates(has_contact: bool) -> tuple[Candidate, ...]:
    """Return the generic terms as candidates."""
    candidates = []
    for name, ladder in list_terms(has_contact):
        free = list_term_parameters(name, ladder)
        shapes = tuple((width,) for width in ladder) or ((),)
        candidates.append(Candidate(f"{GENERIC_PREFIX}.{name}", free, free[0], 0.0, shapes))
    return tuple(candidates)


def list_candidates(
    log_residuals: Sequence[LogResiduals], fitted: ParameterSet, without: Sequence[str] = ()
) -> tuple[tuple[Candidate, ...], dict[str, str]]:
    """Return (candidates not yet in the parameter set, reason for each excluded effect)."""
    has_contact = any((residuals.contact_state != 0).any() for residuals in log_residuals)
    channels = set.intersection(*(set(residuals.signals.channels) for residuals in log_residuals))
    candidates, excluded = [], {}
    for effect in (*EFFECTS, *load_plugins()):
        reason = _exclusion_reason(effect, has_contact, channels)
        if effect.id in without:
            reason = "left out of the library"
        if reason:
            excluded[effect.id] = reason
            continue
        for channel in sorted(_checkable_channels(channels)) if effect.acts == "sensor" else ("",):
            candidate = Candidate.from_effect(effect, channel, _shape_ladder(effect, log_residuals))
            already_free = {free.key for free in candidate.free} & fitted.values.keys()
            if (
                not already_free
                and not _is_unobservable(candidate, channels)
                and not _is_unloaded(candidate, log_residuals)
            ):
                candidates.append(candidate)
    return tuple(candidates), excluded


def _exclusion_reason(effect: Effect, has_contact: bool, channels: set[str]) -> str:
    if effect.is_in_bumpers and not has_contact:
        return "there was no contact with a bumper"
    missing = [name for name in effect.required_channels if name not in channels]
    if missing:
        return f"needs {', '.join(missing)}"
    if effect.id == "mass_error":
        cells = channels & {*RIGHT_CELLS, *LEFT_CELLS}
        if "damper_force_n" in channels or not (cells and has_contact):
            return "needs measured bumper forces in addition to the acceleration of the mass"
    return ""


def _checkable_channels(channels: set[str]) -> set[str]:
    """Return the channels whose sensor can be checked: all except the displacement reference."""
    has_both = {"mass_disp_m", "table_disp_m"} <= channels
    return channels - ({"rel_disp_m"} if has_both else {"mass_disp_m", "table_disp_m"})


def _is_unobservable(candidate: Candidate, channels: set[str]) -> bool:
    """Return True for a sensor gain that no other measurement can contradict."""
    gain = candidate.name.startswith("sensor_gain.")
    if "damper_force_n" in channels and candidate.channel == "damper_force_n":
        return gain
    no_mass_acc = "mass_acc_m_s2" not in channels
    return no_mass_acc and gain and candidate.channel in ("table_acc_m_s2", "rel_disp_m")


def _is_unloaded(candidate: Candidate, log_residuals: Sequence[LogResiduals]) -> bool:
    """Return True for gain or lag of a load cell without contact: it would only scale noise."""
    sensor_sides = [
        side for side, cells in enumerate((RIGHT_CELLS, LEFT_CELLS)) if candidate.channel in cells
    ]
    is_offset = candidate.name.startswith("sensor_offset.")
    return not is_offset and any(
        not any((residuals.contact_state[side] > 0).any() for residuals in log_residuals)
        for side in sensor_sides
    )


def _shape_ladder(
    effect: Effect, log_residuals: Sequence[LogResiduals]
) -> tuple[tuple[float, ...], ...]:
    """Return trial shapes: a ladder for a single parameter by its unit, typical values for more."""
    amplitude = next(
        parameter for parameter in effect.parameters if parameter.vanishing is not None
    )
    shapes = [parameter for parameter in effect.parameters if parameter is not amplitude]
    if len(shapes) != 1:
        return (tuple(parameter.typical for parameter in shapes),)
    (shape,) = shapes
    if shape.unit == "m":
        largest = max(
            float(np.abs(residuals.motion().u[residuals.row_mask[0]]).max())
            for residuals in log_residuals
        )
        low, high = 0.01 * largest, 2.0 * largest
    elif shape.unit == "s":
        duration = max(float(np.ptp(residuals.motion().time_s)) for residuals in log_residuals)
        low, high = 0.5 / log_residuals[0].motion().rate_hz, min(0.1 * duration, 3.0)
    else:
        low, high = 0.1 * shape.typical, 10.0 * shape.typical
    low, high = max(low, shape.low), min(high, shape.high)
    ladder = np.exp(np.linspace(math.log(low), math.log(high), LADDER_LENGTH))
    return tuple((min(max(float(rung), shape.low), shape.high),) for rung in ladder)
