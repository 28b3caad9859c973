"""Force laws as plain Python: one function of all laws of a model, and properties of each law."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from itertools import product
from types import FunctionType

import numpy as np

from table_io.errors import InputError
from twin.laws.effect import DAMPER, PLACES, Effect
from twin.laws.expression import Expression, build_function

MAX_STATES, MAX_CONSTANTS = 6, 16  # of all added laws of a model together
# Deformations in m, rates in m/s, base accelerations in m/s2 and times in s at which laws are
# evaluated for their properties and checks.
PROBED_DEFORMATIONS = {True: (1e-4, 1e-3, 3e-3), False: (-0.03, -3e-3, -1e-4, 1e-4, 3e-3, 0.03)}
PROBED_RATES = (-0.3, -0.01, 0.01, 0.3)
PROBED_DRIVES = ((0.0, 0.0), (1.0, 100.0))
MAX_GROWTH_SHARE = 1e-6  # of the largest eigenvalue of states: rounding of a lossless one
MAX_KNOWN_LAWS = 1000  # whose properties are kept: a fit changes one of several at a time
STATE_STEP = 1e-6  # of differences by a state, in its unit

ForceFunction = Callable[[float, float, float, float, tuple[float, ...]], float]
RatesFunction = Callable[[float, float, float, float, tuple[float, ...]], tuple[float, ...]]


@dataclass(frozen=True, slots=True)
class LawProperties:
    """Largest stiffness in N/m and rate in 1/s of the states of the laws at a place."""

    stiffness: float = 0.0
    relaxation_rate: float = 0.0


@cache
def build_laws(effects: tuple[Effect, ...]) -> FunctionType:
    """Return laws(place, q, w, a, t, s, c) -> (force in N, rate of each state) of all effects.

    q and w are the deformation and its rate at the place, s all states and c all constants, effect
    after effect, each bumper with states of its own.
    """
    return build_function(write_laws(effects))


@cache
def write_laws(effects: tuple[Effect, ...]) -> str:
    """Return the text of `build_laws`: one flat function compiles several times faster."""
    sums = ["force", *(f"rate_{state}" for state in range(MAX_STATES))]
    lines = ["def laws(place, q, w, a, t, s, c):", f"    {' = '.join(sums)} = 0.0"]
    constant_count = state_count = 0
    for effect in effects:
        names = {"u": "q", "d": "q", "v": "w"}
        for name in effect.constant_names:
            names[name] = f"c[{constant_count}]"
            constant_count += 1
        for place in PLACES[effect.place]:
            first = state_count
            for name in effect.states:
                names[name] = f"s[{state_count}]"
                state_count += 1
            lines += [
                f"    if place == {place}:",
                f"        force += {effect.parsed_force.write_source(names)}",
            ]
            lines += [
                f"        rate_{number} += {rate.write_source(names)}"
                for number, rate in enumerate(effect.parsed_rates.values(), first)
            ]
    return "\n".join([*lines, f"    return {', '.join(sums)}"])


def write_force(effect: Effect, arguments: Sequence[str], names: Mapping[str, str]) -> str:
    """Return the text of a function of the force, with some names replaced."""
    force: Expression = effect.parsed_force
    return f"def {effect.id}({', '.join(arguments)}):\n    return {force.write_source(names)}"


def evaluate_law(effect: Effect, c: tuple[float, ...]) -> tuple[ForceFunction, RatesFunction]:
    """Return force(q, w, a, t, s) and rates(q, w, a, t, s) of a law with constants c."""
    laws, place, count = build_laws((effect,)), PLACES[effect.place][0], len(effect.states)
    return (
        lambda q, w, a, t, s: laws(place, q, w, a, t, s, c)[0],
        lambda q, w, a, t, s: laws(place, q, w, a, t, s, c)[1 : 1 + count],
    )


def list_probes(
    effect: Effect, with_drives: bool = True
) -> Iterator[tuple[float, float, float, float]]:
    """Yield (deformation, rate, base acceleration, time), SI, for the properties of a law.

    Within the range of its fit, if it is known.
    """
    in_bumper = effect.place != "damper"
    largest = {name: max(abs(low), abs(high)) for name, low, high in effect.valid_range}
    deformations: tuple[float, ...] = PROBED_DEFORMATIONS[in_bumper]
    rates: tuple[float, ...] = PROBED_RATES
    length = largest.get("d" if in_bumper else "u")
    speed = largest.get("v")
    if length is not None:
        deformations = tuple(q * length / deformations[-1] for q in deformations)
    if speed is not None:
        rates = tuple(w * speed / PROBED_RATES[-1] for w in PROBED_RATES)
    ends = {name: high for name, _, high in effect.valid_range}
    still, (acceleration, time_s) = PROBED_DRIVES
    drives = [still, (ends.get("a", acceleration), ends.get("t", time_s))]
    for (q, w), (a, t) in product(
        product(deformations, rates), drives if with_drives else drives[:1]
    ):
        yield q, w, a, t


@lru_cache(MAX_KNOWN_LAWS)
def law_properties(effect: Effect, c: tuple[float, ...]) -> LawProperties:
    """Return the largest stiffness and rate of the states of a law over the probed motions.

    The stiffness is the instantaneous one, dF/dq + dF/ds ds'/dw: fast motion also loads the states.
    The rate is the largest eigenvalue of d rates / d states: of a relaxation or an oscillation.
    """
    try:
        return _measure_law(effect, c)
    except (ArithmeticError, ValueError, np.linalg.LinAlgError) as error:
        raise _explain_failure(effect, c, error) from None


def _explain_failure(effect: Effect, c: tuple[float, ...], error: Exception) -> InputError:
    return InputError(
        f"its law cannot be evaluated with these values: {error}",
        where=f"effect {effect.id!r}",
        value=list(c),
        remedy="change the values of its parameters",
    )


def _measure_law(effect: Effect, c: tuple[float, ...]) -> LawProperties:
    force, rates = evaluate_law(effect, c)
    stiffness = relaxation = 0.0
    count = len(effect.states)
    relaxed, steps = (0.0,) * count, STATE_STEP * np.eye(count)
    for q, w, a, t in list_probes(effect, effect.changes_with_time):
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


@cache
def is_linear_in_rate(effect: Effect, c: tuple[float, ...]) -> bool:
    """Return whether a law is elastic plus a dashpot with these constants.

    InputError where it cannot be evaluated at rest, or at 1 m/s.
    """
    force, _ = evaluate_law(effect, c)
    relaxed = (0.0,) * len(effect.states)
    for q, w, a, t in list_probes(effect):
        try:
            push, slow, fast = (force(q, rate, a, t, relaxed) for rate in (w, 0.0, 1.0))
        except (ArithmeticError, ValueError) as error:
            raise _explain_failure(effect, c, error) from None
        linear = slow + w * (fast - slow)
        if abs(push - linear) > 1e-6 * (abs(push) + abs(slow) + abs(linear)):
            return False
    return True


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
