"""Expect an error that a user can correct, by its fields."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from table_io.errors import InputError

EQUAL = ("where", "key", "value")
CONTAINED = ("problem", "allowed", "remedy")


@contextmanager
def raises_input_error(**fields: object) -> Iterator[pytest.ExceptionInfo[InputError]]:
    """Require an InputError: `where`, `key`, `value` equal these, other fields contain them.

    What is contained is a name or a number, not a sentence, which may be worded anew. The fields
    may be those of any of several faults, except `where` of the whole.
    """
    with pytest.raises(InputError) as error:
        yield error
    assert fields.keys() <= {*EQUAL, *CONTAINED}
    faults = error.value.faults or (error.value,)
    candidates = [error.value, *faults, *(inner for fault in faults for inner in fault.faults)]
    assert any(_fits(candidate, fields) for candidate in candidates), (
        fields,
        [vars(candidate) for candidate in candidates],
    )


def _fits(error: InputError, fields: dict[str, object]) -> bool:
    return all(
        str(expected) in getattr(error, name)
        if name in CONTAINED
        else getattr(error, name) == (str(expected) if name == "where" else expected)
        for name, expected in fields.items()
    )
