"""Texts with their own hash."""

import random

import pytest

from table_io.config.provenance import require_seal, seal_text
from table_io.errors import InputError

TEXT = 'title = "A table"\nresidual = 0.02\n[parameters]\ngain_1_s = 20.0\n'
SEALED = seal_text(TEXT)


def test_sealed_text_is_accepted_with_any_line_ends() -> None:
    assert SEALED.startswith(TEXT)
    for text in (SEALED, SEALED.replace("\n", "\r\n"), SEALED + "\n\n", TEXT):
        require_seal(text, "the twin", "make it again")


def test_every_altered_character_is_noticed() -> None:
    rng = random.Random(1)
    for place, character in enumerate(SEALED):
        other = chr(rng.choice([n for n in range(33, 127) if chr(n) != character]))
        with pytest.raises(InputError, match="the twin was altered after it was written"):
            require_seal(SEALED[:place] + other + SEALED[place + 1 :], "the twin", "make it again")


def test_removed_hash_is_noticed() -> None:
    with pytest.raises(InputError):
        require_seal(SEALED[: SEALED.rindex("# sha256")], "the twin", "make it again")
