"""Laws that effects bring themselves (`Effect.force`): evaluation, properties, checks."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from inspect import signature
from itertools import product
from typing import Any

import numpy as np

from table_io.errors import InputError
from twin.model.effects.effect import Effect
from twin.model.parameters import Parameters

DAMPER = -1  # a bumper has the number of its side: 0 right, 1 left
PLACES = {"damper": (DAMPER,), "bumpers": (0, 1), "right_bumper": (0,), "left_bumper": (1,)}
LAW_ARGUMENTS = ("q", "w", "a", "t", "s", "c")  # see `Effect`
# Deformations in m, rates in m/s, base accelerations in m/s2 and times in s at which laws are
# evaluated for their properties and checks.
PROBED_DEFORMATIONS = {True: (1e-4, 1e-3, 3e-3), False: (-0.03, -3e-3, -1e-4, 1e-4, 3e-3, 0.03)}
PROBED_RATES = (-0.3, -0.01, 0.01, 0.3)
PROBED_DRIVES = ((0.0, 0.0), (1.0, 100.0))
# Base parameters for the checks of a law that depends on them.
PROBED_BASE = Parameters(1e3, 1e5, 1e3, 1e6, 1e3, 1e6, 1e3, 1e-3, 1e-3)
MAX_GROWTH_SHARE = 1e-6  # of the largest eigenvalue of states: rounding of a lossless one
STATE_STEP = 1e-6  # of differences by a state, in its unit


@dataclass(frozen=True, slots=True)
class LawProperties:
    """Largest stiffness in N/m and rate in 1/s of the states of the laws at a place."""

    stiffness: float = 0.0
    relaxation_rate: float = 0.0


@cache
def list_arguments(function: Callable[..., Any]) -> tuple[str, ...]:
    """Return the names of the arguments of `force` or `rates`."""
    return tuple(signature(function).parameters)


def changes_with_time(effect: Effect) -> bool:
    """Return whether an effect depends on the time since the start of the run."""
    functions = [function for function in (effect.force, effect.rates) if function is not None]
    return effect.is_drift or any("t" in list_arguments(function) for function in functions)


def list_constants(
    effect: Effect, parameters: Parameters, values: Mapping[str, float]
) -> tuple[float, ...]:
    """Return the constants c of a law: of the effect, or the values of its parameters."""
    if effect.constants is not None:
        return effect.constants(parameters, values)
    return tuple(values[parameter.name] for parameter in effect.parameters)


@cache
def count_constants(effect: Effect) -> int:
    """Return the number of constants of a law."""
    return len(list_constants(effect, PROBED_BASE, typical_values(effect)))


def typical_values(effect: Effect) -> dict[str, float]:
    """Return the typical value of each parameter of an effect."""
    return {parameter.name: parameter.typical for parameter in effect.parameters}


def list_probed_motions(effect: Effect) -> list[tuple[float, float]]:
    """Return deformations in m and rates in m/s at which a law is evaluated for its properties.

    Within the range of its fit, if it is known.
    """
    in_bumper = effect.place != "damper"
    largest = {name: max(abs(low), abs(high)) for name, low, high in effect.valid_range}
    deformations: tuple[float, ...] = PROBED_DEFORMATIONS[in_bumper]
    rates: tuple[float, ...] = PROBED_RATES
    length, speed = (largest.get(name) for name in ("d" if in_bumper else "u", "v"))
    if length is not None:
        deformations = tuple(q * length / deformations[-1] for q in deformations)
    if speed is not None:
        rates = tuple(w * speed / PROBED_RATES[-1] for w in PROBED_RATES)
    return [*product(deformations, rates)]


def list_probed_drives(effect: Effect) -> tuple[tuple[float, float], ...]:
    """Return base accelerations in m/s2 and times in s at which a law is evaluated."""
    ends = {name: high for name, _, high in effect.valid_range}
    still, (acceleration, time_s) = PROBED_DRIVES
    return still, (ends.get("a", acceleration), ends.get("t", time_s))


def law_properties(effect: Effect, c: tuple[float, ...]) -> LawProperties:
    """Return the largest stiffness and rate of the states of a law over the probed motions.

    The stiffness is the instantaneous one, dF/dq + dF/ds ds'/dw: fast motion also loads the states.
    The rate is the largest eigenvalue of d rates / d states: of a relaxation or an oscillation.
    """
    try:
        return _measure_law(effect, c)
    except (ArithmeticError, ValueError, np.linalg.LinAlgError) as error:
        raise InputError(
            f"its law cannot be evaluated with these values: {error}",
            where=f"effect {effect.id!r}",
            value=list(c),
            remedy="change the values of its parameters",
        ) from None


def _measure_law(effect: Effect, c: tuple[float, ...]) -> LawProperties:
    force, rates = evaluate_law(effect, c)
    stiffness = relaxation = 0.0
    count = len(effect.states)
    relaxed, steps = (0.0,) * count, STATE_STEP * np.eye(count)
    drives = list_probed_drives(effect)
    probes = product(
        list_probed_motions(effect), drives if changes_with_time(effect) else drives[:1]
    )
    for (q, w), (a, t) in probes:
        h = 1e-6 * abs(q)
        k = (force(q + h, w, a, t, relaxed) - force(q - h, w, a, t, relaxed)) / (2 * h)
        slopes = np.zeros((count, count))
        for i, step in enumerate(steps.tolist()):
            up, down = tuple(step), tuple(-value for value in step)
            f_s = (force(q, w, a, t, up) - force(q, w, a, t, down)) / (2 * STATE_STEP)
            r_w = rates(q, w * (1 + 1e-6), a, t, relaxed)[i]
            r_w -= rates(q, w * (1 - 1e-6), a, t, relaxed)[i]
            k += f_s * r_w / (2e-6 * w)
            change = np.subtract(rates(q, w, a, t, up), rates(q, w, a, t, down))
            slopes[:, i] = change / (2 * STATE_STEP)
        stiffness = max(stiffness, abs(k))
        if count:
            eigenvalues = np.linalg.eigvals(slopes)
            relaxation = max(relaxation, float(np.abs(eigenvalues).max()))
            if eigenvalues.real.max() > MAX_GROWTH_SHARE * relaxation:
                raise ValueError("its states grow without bound")
    return LawProperties(stiffness, relaxation)


def evaluate_law(
    effect: Effect, c: tuple[float, ...]
) -> tuple[Callable[..., float], Callable[..., tuple[float, ...]]]:
    """Return force(q, w, a, t, s) and rates(q, w, a, t, s) of a law in plain Python."""
    assert effect.force is not None
    force, rates = effect.force, effect.rates
    force_names = list_arguments(force)
    rates_names = () if rates is None else list_arguments(rates)

    def choose(names: Sequence[str], *values: Any) -> list[Any]:
        arguments = dict(zip(LAW_ARGUMENTS, (*values, c), strict=True))
        return [arguments[name] for name in names]

    return (
        lambda *values: force(*choose(force_names, *values)),
        lambda *values: () if rates is None else rates(*choose(rates_names, *values)),
    )


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
    try:
        return _find_argument_problem(effect) or _find_value_problem(effect)
    except Exception as error:  # the law is foreign code and may raise anything
        return f"its law cannot be evaluated: {type(error).__name__}: {error}"


@cache
def is_linear_in_rate(effect: Effect, c: tuple[float, ...]) -> bool:
    """Return whether a law is elastic plus a dashpot with these constants."""
    force, _ = evaluate_law(effect, c)
    relaxed = (0.0,) * len(effect.states)
    for (q, w), (a, t) in product(list_probed_motions(effect), list_probed_drives(effect)):
        push, slow = force(q, w, a, t, relaxed), force(q, 0.0, a, t, relaxed)
        linear = slow + w * (force(q, 1.0, a, t, relaxed) - slow)
        if abs(push - linear) > 1e-6 * (abs(push) + abs(slow) + abs(linear)):
            return False
    return True


def _find_argument_problem(effect: Effect) -> str:
    """Return which argument of a law is unknown, "" if none."""
    for function in (effect.force, effect.rates):
        for name in () if function is None else list_arguments(function):
            if name not in LAW_ARGUMENTS:
                return f"its law has the argument {name!r}; allowed: {', '.join(LAW_ARGUMENTS)}"
    return ""


def _find_value_problem(effect: Effect) -> str:
    """Return what is wrong with the values of a law, "" if nothing."""
    constants = list_constants(effect, PROBED_BASE, typical_values(effect))
    force, rates = evaluate_law(effect, constants)
    relaxed = (0.0,) * len(effect.states)
    in_bumper = effect.place != "damper"
    drives = list_probed_drives(effect)
    for (q, w), (a, t) in product(list_probed_motions(effect), drives):
        push, slow = force(q, w, a, t, relaxed), force(q, 0.0, a, t, relaxed)
        own = rates(q, w, a, t, relaxed)
        if not all(math.isfinite(value) for value in (push, *own)):
            return f"its law is not finite at deformation {q:g} m, rate {w:g} m/s"
        if len(own) != len(effect.states):
            return f"`rates` returns {len(own)} values for {len(effect.states)} states"
        if in_bumper and not is_linear_in_rate(effect, constants) and (push - slow) * w < 0.0:
            return (
                "in a bumper a force that is not linear in the rate must oppose it: its zero in "
                "flight gives the recovery of the face"
            )
    if in_bumper and any(force(0.0, 0.0, a, t, relaxed) != 0.0 for a, t in drives):
        return "in a bumper the force must be zero at deformation 0, rate 0, states relaxed"
    return ""


def sum_law_properties(
    laws: Sequence[tuple[Effect, tuple[float, ...]]],
) -> dict[int, LawProperties]:
    """Return the summed stiffness and the fastest rate of the states of laws, by place."""
    sums = {place: LawProperties() for place in (DAMPER, 0, 1)}
    for effect, constants in laws:
        own = law_properties(effect, constants)
        for place in PLACES[effect.place]:
            sums[place] = LawProperties(
                sums[place].stiffness + own.stiffness,
                max(sums[place].relaxation_rate, own.relaxation_rate),
            )
    return sums
