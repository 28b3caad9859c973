"""Errors that a user can correct: their fields and the suggestion of a name."""

from table_io.errors import MAX_LISTED_NAMES, InputError, suggest


def test_the_closest_known_name_is_suggested() -> None:
    assert "'cycles'" in suggest("cycels", ["cycles", "circles", "start_hz"])
    assert "start_hz" not in suggest("cycels", ["cycles", "start_hz"])


def test_without_a_close_name_all_are_listed() -> None:
    known = [f"channel_{k}" for k in range(MAX_LISTED_NAMES + 3)]
    text = suggest("xyz", known)
    assert all(name in text for name in known[:MAX_LISTED_NAMES])
    assert known[MAX_LISTED_NAMES] not in text
    assert text.endswith(" 3 more")


def test_a_message_has_its_fields_in_order() -> None:
    error = InputError("too low", where="a.toml", key="k", value=1, allowed="2", remedy="raise it")
    places = [str(error).index(part) for part in ("a.toml", "k = 1", "too low", "2", "raise it")]
    assert places == sorted(places)
