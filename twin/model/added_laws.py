"""Laws that effects bring themselves (`Effect.force`), compiled for the solver.

The solver knows the laws of this package by their coefficients. All others become one compiled
function of (place, deformation, rate, base acceleration, time, states, coefficients), so that the
solver itself is compiled and cached only once, whatever effects a model has.
"""

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

from numba.core.errors import NumbaError

from table_io.compilation import jit_helper, jit_kernel
from table_io.errors import InputError
from twin.model.effects.effect import Effect
from twin.model.effects.law import LAW_ARGUMENTS, PLACES, count_constants, list_arguments
from twin.model.force_laws import (
    ADDED_LAWS_SIGNATURE,
    LAW_CONSTANTS,
    LAW_STATES,
    AddedLaws,
)


def pack_constants(
    laws: Sequence[tuple[Effect, tuple[float, ...]]],
) -> tuple[float, ...] | None:
    """Return the constants of all laws, padded to `LAW_CONSTANTS`; None without, error if many."""
    if not laws:
        return None
    values = [value for _, constants in laws for value in constants]
    state_count = sum(len(PLACES[effect.place]) * len(effect.states) for effect, _ in laws)
    for count, limit, what in (
        (len(values), LAW_CONSTANTS, "constants"),
        (state_count, LAW_STATES, "states, those of each bumper counted"),
    ):
        if count > limit:
            raise InputError(
                f"the laws of {', '.join(effect.id for effect, _ in laws)} have {count} {what}",
                allowed=f"at most {limit} in total",
                remedy="remove an effect",
            )
    return (*values, *[0.0] * (LAW_CONSTANTS - len(values)))


@cache
def compile_laws(effects: tuple[Effect, ...]) -> AddedLaws | None:
    """Compile the laws of these effects into one function, None for none.

    Compiled once in every process: numba's cache on disk does not notice that a plug-in changed.
    InputError if numba cannot compile a law.
    """
    if not effects:
        return None
    functions: list[tuple[str, Callable[..., Any]]] = []
    for number, effect in enumerate(effects):
        assert effect.force is not None
        functions.append((f"force_{number}", effect.force))
        if effect.rates is not None:
            functions.append((f"rates_{number}", effect.rates))
    try:
        return _compile_text(_write_laws(effects), tuple(functions))
    except NumbaError as error:
        for effect in effects if len(effects) > 1 else ():
            compile_laws((effect,))  # names the one that fails
        raise InputError(
            f"its law cannot be compiled: {str(error).strip().splitlines()[0]}",
            where=f"effect {effects[0].id!r}",
            remedy="use only arithmetic, `math`, comparisons and float tuples in it",
        ) from error


@cache
def _compile_text(text: str, functions: tuple[tuple[str, Callable[..., Any]], ...]) -> AddedLaws:
    """Compile the text of `laws` with the functions that it calls by name.

    Effects that differ in names, bounds or ranges alone share it.
    """
    namespace: dict[str, Any] = {name: _register_function(call) for name, call in functions}
    exec(text, namespace)
    return jit_kernel(ADDED_LAWS_SIGNATURE)(namespace["laws"])


@cache
def _register_function(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a law's function as a helper of kernels, registered once."""
    return jit_helper()(function)


def _write_laws(effects: Sequence[Effect]) -> str:
    """Return the text of `laws`, which adds up the laws of all effects at a place.

    Text, because numba compiles no call whose arguments are chosen by name, and because one flat
    function compiles several times faster than nested ones.
    """
    sums = ["force", *(f"rate_{state}" for state in range(LAW_STATES))]
    lines = [f"def laws(place, {', '.join(LAW_ARGUMENTS)}):", f"    {' = '.join(sums)} = 0.0"]
    constant = state = 0
    for number, effect in enumerate(effects):
        constants = range(constant, constant := constant + count_constants(effect))
        for place in PLACES[effect.place]:
            states = range(state, state := state + len(effect.states))
            values = {
                **{name: name for name in LAW_ARGUMENTS},
                "s": f"({' '.join(f's[{i}],' for i in states)})",
                "c": f"({' '.join(f'c[{i}],' for i in constants)})",
            }
            lines.append(f"    if place == {place}:")
            for function, kind in ((effect.force, "force"), (effect.rates, "rates")):
                if function is None:
                    continue
                arguments = ", ".join(values[name] for name in list_arguments(function))
                target = "force +" if kind == "force" else "rates "
                lines.append(f"        {target}= {kind}_{number}({arguments})")
            lines += [f"        rate_{i} += rates[{n}]" for n, i in enumerate(states)]
    return "\n".join([*lines, f"    return {', '.join(sums)}"])
