"""Laws that the solver does not know by coefficients, compiled for it.

The solver knows some laws of the library by their coefficients. All others become one compiled
function of (place, deformation, rate, base acceleration, time, states, constants), so that the
solver itself is compiled and cached only once, whatever effects a model has.
"""

from collections.abc import Sequence
from functools import cache

from table_io.compilation import jit_kernel
from table_io.errors import InputError
from twin.laws.effect import PLACES, Effect
from twin.laws.expression import build_function
from twin.laws.properties import MAX_CONSTANTS, MAX_STATES, write_laws
from twin.model.force_laws import ADDED_LAWS_SIGNATURE, AddedLaws


def pack_constants(
    laws: Sequence[tuple[Effect, tuple[float, ...]]],
) -> tuple[float, ...] | None:
    """Return the constants of all laws, padded to `MAX_CONSTANTS`; None without, error if many."""
    if not laws:
        return None
    values = [value for _, constants in laws for value in constants]
    state_count = sum(len(PLACES[effect.place]) * len(effect.states) for effect, _ in laws)
    for count, limit, what in (
        (len(values), MAX_CONSTANTS, "constants"),
        (state_count, MAX_STATES, "states, those of each bumper counted"),
    ):
        if count > limit:
            raise InputError(
                f"the laws of {', '.join(effect.id for effect, _ in laws)} have {count} {what}",
                allowed=f"at most {limit} in total",
                remedy="remove an effect",
            )
    return (*values, *[0.0] * (MAX_CONSTANTS - len(values)))


def compile_laws(effects: Sequence[Effect]) -> AddedLaws | None:
    """Compile the laws of these effects into one function, None for none."""
    return _compile_text(write_laws(tuple(effects))) if effects else None


@cache
def _compile_text(text: str) -> AddedLaws:
    """Compile the text of laws; effects that differ in names, bounds or ranges alone share it."""
    return jit_kernel(ADDED_LAWS_SIGNATURE)(build_function(text))
