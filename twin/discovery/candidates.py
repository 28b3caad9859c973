"""Candidates of a selection: every effect of the library, sensor effects once per channel.

Forces depend (nearly) linearly on the amplitude of a candidate, but not on its shape parameters.
Each candidate therefore has a ladder of trial shapes; the fit interpolates between them.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np

from twin.discovery.motion import RecordScale
from twin.discovery.parameters import (
    SLIP_SPEED,
    FreeParameter,
    ParameterKey,
    ParameterSet,
    list_effect_parameters,
    measure_size,
)
from twin.discovery.residuals import LogResiduals
from twin.laws.effect import Effect, EffectParameter
from twin.laws.library import EFFECTS, load_plugins

LADDER_LENGTH = 9
# of the largest velocity: trial values; friction near zero velocity varies
SLIP_SHARES = (5e-5, 1.5e-3, 5e-3, 1.5e-2)
THRESHOLD_SHARES = (0.003, 0.01, 0.03, 0.1, 0.3)  # of its size: trial values of a threshold
LADDER_SHARES = (0.01, 2.0)  # ends of the ladder of a length or speed, of the largest in the test
MAX_LADDER_PERIODS = 6.0  # of the main motion: end of the ladder of a relaxation time or frequency
RESONANCE_RATIO = 1.12  # between trial frequencies: about the width of a resonance of 5 % damping
MAX_RESONANCE_SHARE = 0.1  # of the sampling rate: highest trial frequency


INSTRUMENT_REASON = "an error of an instrument: sensors judge sensors, no force law does"


@dataclass(frozen=True, slots=True)
class Candidate:
    """Candidate effect with a ladder of trial shapes."""

    name: str
    free: tuple[FreeParameter, ...]
    amplitude: FreeParameter  # the one of `free` that makes the effect vanish
    vanishing: float
    shapes: tuple[tuple[float, ...], ...]  # trial values of the other parameters, in their order
    effect: Effect
    channel: str = ""
    constants: Mapping[ParameterKey, float] = field(default_factory=dict)  # fixed values
    # Deviations of the amplitude over which its slope is taken; 0: where it vanishes.
    probes: tuple[float, ...] = (0.0,)

    @classmethod
    def from_effect(cls, effect: Effect, channel: str, scale: RecordScale) -> "Candidate":
        """Return the candidate of a library effect; `channel` is that of a sensor effect."""
        free = list_effect_parameters(effect, scale, channel)
        shapes = _list_shapes(effect, free, scale)
        index = next(
            i for i, parameter in enumerate(effect.parameters) if parameter.vanishing is not None
        )
        vanishing = float(effect.parameters[index].vanishing or 0.0)
        name = f"{effect.id}.{channel}" if channel else effect.id
        amplitude = free[index]
        if effect.is_dry_friction:
            speeds = [share * scale.v for share in SLIP_SHARES]
            slip = FreeParameter(
                SLIP_SPEED, speeds[0], 3.0 * speeds[-1], speeds[0], "m/s", logarithmic=True
            )
            # a law with shapes of its own is found with any slip speed
            trials = speeds if shapes == ((),) else speeds[1:2]
            shapes = tuple((*shape, speed) for shape in shapes for speed in trials)
            free = (*free, slip)
        shares = THRESHOLD_SHARES if effect.is_threshold else (0.0,)
        probes = tuple(share * amplitude.scale for share in shares)
        return cls(name, free, amplitude, vanishing, shapes, effect, channel, probes=probes)

    def add_to(
        self, parameters: ParameterSet, shape: Sequence[float], amplitude: float | None = None
    ) -> ParameterSet:
        """Add the candidate, free, to a parameter set; by default its amplitude vanishes."""
        shape_keys = [free.key for free in self.free if free is not self.amplitude]
        values = {**self.constants, **dict(zip(shape_keys, shape, strict=True))}
        values[self.amplitude.key] = self.vanishing if amplitude is None else amplitude
        parameters = parameters.with_effect(self.effect)
        return parameters.with_values(values).with_free((*parameters.free, *self.free))

    def start_in(
        self, parameters: ParameterSet, shape: Sequence[float], change: float
    ) -> ParameterSet:
        """Add the candidate with so much more than its vanishing amplitude, within its bounds."""
        start, free = self.vanishing + change, self.amplitude
        return self.add_to(parameters, shape, min(max(start, free.low), free.high))

    @property
    def used_keys(self) -> frozenset[object]:
        """Parameters, and coefficients by which the solver knows the candidate."""
        return frozenset((*(free.key for free in self.free), *self.effect.compiled))

    def remove_from(self, parameters: ParameterSet) -> ParameterSet:
        """Return a parameter set without the parameters of the candidate."""
        reduced = parameters.without(self.free)
        values = {key: v for key, v in reduced.values.items() if key not in self.constants}
        return replace(reduced, values=values)


def list_candidates(
    log_residuals: Sequence[LogResiduals], fitted: ParameterSet, without: Sequence[str] = ()
) -> tuple[tuple[Candidate, ...], dict[str, str]]:
    """Return (candidates not yet in the parameter set, reason for each excluded effect)."""
    hidden = [residuals.explain_hidden_bumpers() for residuals in log_residuals]
    reason_in_bumpers = "; ".join(dict.fromkeys(hidden)) if all(hidden) else ""
    channels = set.intersection(*(set(residuals.signals.channels) for residuals in log_residuals))
    candidates, excluded = [], {}
    for effect in (*EFFECTS, *load_plugins()):
        reason = _exclusion_reason(effect, reason_in_bumpers, channels)
        untared = channels - set().union(*(r.signals.rest_values for r in log_residuals))
        is_offset = effect.id == "sensor_offset" and "damper_force_n" in untared
        if (effect.acts == "sensor" and not is_offset) or effect.id == "mass_error":
            reason = INSTRUMENT_REASON
        if effect.id in without:
            reason = "left out of the library"
        if reason:
            excluded[effect.id] = reason
            continue
        # a force sensor that was not tared may read anything, and is held against no other one
        for channel in ("damper_force_n",) if effect.acts == "sensor" else ("",):
            candidate = Candidate.from_effect(effect, channel, log_residuals[0].scale)
            already_free = {free.key for free in candidate.free} & fitted.values.keys()
            if not already_free:
                candidates.append(candidate)
    return tuple(candidates), excluded


def _exclusion_reason(effect: Effect, in_bumpers: str, channels: set[str]) -> str:
    if effect.is_in_bumpers and in_bumpers:
        return in_bumpers
    missing = [name for name in effect.required_channels if name not in channels]
    if missing:
        return f"needs {', '.join(missing)}"
    return ""


def _list_shapes(
    effect: Effect, free: Sequence[FreeParameter], scale: RecordScale
) -> tuple[tuple[float, ...], ...]:
    """Return trial shapes: a ladder for a single parameter, every other rung of each for more.

    A resonance is found by its frequency alone: the others have the middle of their ladder.
    """
    shapes = [
        (parameter.unit, _shape_ladder(parameter, own, effect, scale))
        for parameter, own in zip(effect.parameters, free, strict=True)
        if own.logarithmic
    ]
    if len(shapes) > 1:
        middle = LADDER_LENGTH // 2
        rest = slice(middle, middle + 1) if effect.has_resonance else slice(None, None, 2)
        shapes = [(unit, rungs if unit == "Hz" else rungs[rest]) for unit, rungs in shapes]
    return tuple(product(*(rungs for _, rungs in shapes)))


def _shape_ladder(
    parameter: EffectParameter, free: FreeParameter, effect: Effect, scale: RecordScale
) -> list[float]:
    """Return the trial values of a shape parameter, within its bounds, SI."""
    if parameter.unit == "Hz":
        main_hz = 1.0 / (2 * np.pi * scale.time_s)
        low, high = main_hz / MAX_LADDER_PERIODS, MAX_RESONANCE_SHARE / scale.sample_s
        count = 1 + math.ceil(math.log(max(high / low, 1.0)) / math.log(RESONANCE_RATIO))
        return [float(rung) for rung in np.geomspace(low, high, count)]
    if parameter.unit in ("m", "m/s"):
        largest = scale.u if parameter.unit == "m" else scale.v
        low, high = (share * largest for share in LADDER_SHARES)
    elif parameter.unit == "s":
        longest = MAX_LADDER_PERIODS * 2 * np.pi * scale.time_s
        low, high = 0.5 * scale.sample_s, min(0.1 * scale.duration_s, longest)
    else:
        size = measure_size(parameter, effect, "", scale) or parameter.typical
        low, high = 0.1 * size, 10.0 * size
    low, high = max(low, free.low), min(high, free.high)
    rungs = np.geomspace(low, max(high, low), LADDER_LENGTH)
    return [min(max(float(rung), free.low), free.high) for rung in rungs]
