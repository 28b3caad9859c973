"""Laws that effects bring themselves (`Effect.force`): evaluation, properties, checks."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache

from twin.model.effects.effect import Effect

DAMPER = -1  # a bumper has the number of its side: 0 right, 1 left
PLACES = {"damper": (DAMPER,), "bumpers": (0, 1), "right_bumper": (0,), "left_bumper": (1,)}
# Deformations in m and rates in m/s at which stiffness and relaxation rate of a law are taken.
PROBED_DEFORMATIONS = {True: (1e-4, 1e-3, 3e-3), False: (-0.03, -3e-3, -1e-4, 1e-4, 3e-3, 0.03)}
PROBED_RATES = (-0.3, -0.01, 0.01, 0.3)


@dataclass(frozen=True, slots=True)
class LawProperties:
    """Largest stiffness in N/m and relaxation rate in 1/s of the laws at a place."""

    stiffness: float = 0.0
    relaxation_rate: float = 0.0


def law_properties(effect: Effect, values: Mapping[str, float]) -> LawProperties:
    """Return the largest stiffness and relaxation rate of a law over the probed motions.

    The stiffness is the instantaneous one, dF/dq + dF/ds ds'/dw: fast motion also loads the states.
    """
    force, rates = evaluate_law(effect, values)
    stiffness = relaxation = 0.0
    relaxed = (0.0,) * len(effect.states)
    for q in PROBED_DEFORMATIONS[effect.place != "damper"]:
        for w in PROBED_RATES:
            h = 1e-6 * abs(q)
            k = (force(q + h, w, relaxed) - force(q - h, w, relaxed)) / (2 * h)
            for i in range(len(relaxed)):
                up, down = ((*relaxed[:i], sign * 1e-6, *relaxed[i + 1 :]) for sign in (1, -1))
                f_s = (force(q, w, up) - force(q, w, down)) / 2e-6
                r_w = rates(q, w * (1 + 1e-6), relaxed)[i] - rates(q, w * (1 - 1e-6), relaxed)[i]
                k += f_s * r_w / (2e-6 * w)
                r_s = (rates(q, w, up)[i] - rates(q, w, down)[i]) / 2e-6
                relaxation = max(relaxation, abs(r_s))
            stiffness = max(stiffness, abs(k))
    return LawProperties(stiffness, relaxation)


def evaluate_law(
    effect: Effect, values: Mapping[str, float]
) -> tuple[Callable[..., float], Callable[..., tuple[float, ...]]]:
    """Return force(q, w, s) and rates(q, w, s) of a law in plain Python."""
    c, law, law_rates = tuple(values[p.name] for p in effect.parameters), effect.force, effect.rates
    assert law is not None
    if law_rates is None:
        return lambda q, w, s: law(q, w, c), lambda q, w, s: ()
    return lambda q, w, s: law(q, w, s, c), lambda q, w, s: law_rates(q, w, s, c)


@cache
def find_law_problem(effect: Effect) -> str:
    """Return what is wrong with the law of an effect, "" if nothing; calls it in plain Python.

    Cached: a fit looks its effects up for every set of parameters.
    """
    if effect.force is None:
        return "acts as a force but has no `force` function"
    if effect.place not in PLACES:
        return f"acts as a force at {effect.place!r}; allowed: {', '.join(PLACES)}"
    if bool(effect.states) != (effect.rates is not None):
        return "`states` and `rates` belong together: give both or neither"
    force, rates = evaluate_law(effect, {p.name: p.typical for p in effect.parameters})
    relaxed = (0.0,) * len(effect.states)
    in_bumper = effect.place != "damper"
    try:
        for q in PROBED_DEFORMATIONS[in_bumper]:
            for w in PROBED_RATES:
                push, slow = force(q, w, relaxed), force(q, 0.0, relaxed)
                own = rates(q, w, relaxed)
                if not all(math.isfinite(value) for value in (push, *own)):
                    return f"its law is not finite at deformation {q:g} m, rate {w:g} m/s"
                if len(own) != len(effect.states):
                    return f"`rates` returns {len(own)} values for {len(effect.states)} states"
                if in_bumper:
                    linear = slow + w * (force(q, 1.0, relaxed) - slow)
                    if abs(push - linear) > 1e-6 * (abs(push) + abs(slow) + abs(linear)):
                        return (
                            "in a bumper the force must be elastic plus a dashpot: linear in the "
                            "rate, whose zero in flight gives the recovery of the face"
                        )
        if in_bumper and force(0.0, 0.0, relaxed) != 0.0:
            return "in a bumper the force must be zero at deformation 0, rate 0, states relaxed"
    except Exception as error:  # the law is foreign code and may raise anything
        return f"its law cannot be evaluated: {type(error).__name__}: {error}"
    return ""


def sum_law_properties(
    laws: Sequence[tuple[Effect, Mapping[str, float]]],
) -> dict[int, LawProperties]:
    """Return the summed stiffness and the fastest relaxation rate of laws, by place."""
    sums = {place: LawProperties() for place in (DAMPER, 0, 1)}
    for effect, values in laws:
        own = law_properties(effect, values)
        for place in PLACES[effect.place]:
            sums[place] = LawProperties(
                sums[place].stiffness + own.stiffness,
                max(sums[place].relaxation_rate, own.relaxation_rate),
            )
    return sums
