"""Laws that effects bring themselves (`Effect.force`), compiled for the solver.

The solver knows the laws of this package by their coefficients. All others become one compiled
function of (place, deformation, rate, base acceleration, time, states, coefficients), so that the
solver itself is compiled and cached only once, whatever effects a model has.
"""

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

from numba.core.errors import NumbaError

from table_io.compilation import jit_kernel
from table_io.errors import InputError
from twin.model.effects.effect import Effect
from twin.model.effects.law import PLACES, list_arguments, take_all_arguments
from twin.model.force_laws import (
    ADDED_LAWS_SIGNATURE,
    LAW_PARAMETERS,
    LAW_STATES,
    AddedLaws,
)


def pack_coefficients(laws: Sequence[tuple[Effect, Mapping[str, float]]]) -> tuple[float, ...]:
    """Return the parameters of all laws, padded to `LAW_PARAMETERS`; InputError if too many."""
    values = [values[p.name] for effect, values in laws for p in effect.parameters]
    state_count = sum(len(PLACES[effect.place]) * len(effect.states) for effect, _ in laws)
    for count, limit, what in (
        (len(values), LAW_PARAMETERS, "parameters"),
        (state_count, LAW_STATES, "states, those of each bumper counted"),
    ):
        if count > limit:
            raise InputError(
                f"the laws of {', '.join(effect.id for effect, _ in laws)} have {count} {what}",
                allowed=f"at most {limit} in total",
                remedy="remove an effect",
            )
    return (*values, *[0.0] * (LAW_PARAMETERS - len(values)))


@cache
def compile_laws(effects: tuple[Effect, ...]) -> AddedLaws | None:
    """Compile the laws of these effects into one function, None for none.

    Compiled once in every process: numba's cache on disk does not notice that a plug-in changed.
    InputError if numba cannot compile a law.
    """
    laws: Any = _no_laws
    first_parameter = first_state = 0
    for effect in effects:
        try:
            force, rates = _compile_law(effect)
            for place in PLACES[effect.place]:
                laws = _add_law(laws, force, rates, place, first_parameter, first_state)
                first_state += len(effect.states)
            laws.compile(ADDED_LAWS_SIGNATURE)
        except NumbaError as error:
            raise InputError(
                f"its law cannot be compiled: {str(error).strip().splitlines()[0]}",
                where=f"effect {effect.id!r}",
                remedy="use only arithmetic, `math`, comparisons and float tuples in it",
            ) from error
        first_parameter += len(effect.parameters)
    return jit_kernel(ADDED_LAWS_SIGNATURE)(laws.py_func) if effects else None


def _compile_law(effect: Effect) -> tuple[Any, Any]:
    """Return force and rates of a law, both compiled functions of `LAW_ARGUMENTS`."""

    def compile_function(function: Any) -> Any:
        names = list_arguments(function)
        return jit_kernel()(take_all_arguments(jit_kernel()(function), names))

    rates = _no_rates if effect.rates is None else compile_function(effect.rates)
    return compile_function(effect.force), rates


@jit_kernel()
def _no_laws(
    place: int, q: float, w: float, a: float, t: float, s: tuple[float, ...], c: tuple[float, ...]
) -> tuple[float, ...]:
    return (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@jit_kernel()
def _no_rates(
    q: float, w: float, a: float, t: float, s: tuple[float, ...], c: tuple[float, ...]
) -> tuple[float, ...]:
    return (0.0,)


@jit_kernel()
def _rate_of(rates: tuple[float, ...], index: int) -> float:
    """Return the rate of one state, 0 for a state of another law."""
    return rates[index] if 0 <= index < len(rates) else 0.0


def _add_law(
    before: Any, force: Any, rates: Any, own_place: int, first_parameter: int, first_state: int
) -> Any:
    """Return the laws `before` and one more, whose parameters and states begin at these numbers."""
    p, n = first_parameter, first_state
    P, S = LAW_PARAMETERS, LAW_STATES

    def laws(place, q, w, a, t, s, c):  # type: ignore[no-untyped-def]
        total = before(place, q, w, a, t, s, c)
        if place != own_place:
            return total
        # Numba unpacks no tuples: all states and parameters in turn, from the law's own on.
        own_s = (
            s[n % S], s[(n + 1) % S], s[(n + 2) % S], s[(n + 3) % S], s[(n + 4) % S],
            s[(n + 5) % S],
        )  # fmt: skip
        own_c = (
            c[p % P], c[(p + 1) % P], c[(p + 2) % P], c[(p + 3) % P], c[(p + 4) % P],
            c[(p + 5) % P], c[(p + 6) % P], c[(p + 7) % P],
        )  # fmt: skip
        own = rates(q, w, a, t, own_s, own_c)
        return (
            total[0] + force(q, w, a, t, own_s, own_c),
            total[1] + _rate_of(own, -n), total[2] + _rate_of(own, 1 - n),
            total[3] + _rate_of(own, 2 - n), total[4] + _rate_of(own, 3 - n),
            total[5] + _rate_of(own, 4 - n), total[6] + _rate_of(own, 5 - n),
        )  # fmt: skip

    return jit_kernel()(laws)
