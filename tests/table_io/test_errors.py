"""Errors that a user can correct: their fields and the suggestion of a name."""

import pickle

from table_io.errors import MAX_LISTED_NAMES, InputError, suggest


def test_closest_known_name_is_suggested() -> None:
    assert "'cycles'" in suggest("cycels", ["cycles", "circles", "start_hz"])
    assert "start_hz" not in suggest("cycels", ["cycles", "start_hz"])


def test_without_a_close_name_all_are_listed() -> None:
    known = [f"channel_{k}" for k in range(MAX_LISTED_NAMES + 3)]
    text = suggest("xyz", known)
    assert all(name in text for name in known[:MAX_LISTED_NAMES])
    assert known[MAX_LISTED_NAMES] not in text
    assert text.endswith(" 3 more")


def test_message_has_its_fields_in_order() -> None:
    error = InputError("too low", where="a.toml", key="k", value=1, allowed="2", remedy="raise it")
    places = [str(error).index(part) for part in ("a.toml", "k = 1", "too low", "2", "raise it")]
    assert places == sorted(places)


def test_faults_of_a_file_keep_their_fields_and_stand_one_a_line() -> None:
    gap = InputError("missing", key="specimen.gap_mm", remedy="add it")
    mass = InputError("too small", key="specimen.mass_kg", value=-1.0, allowed="above 0")
    error = pickle.loads(pickle.dumps(InputError("", where="a.toml", faults=(gap, mass))))
    assert [(fault.key, fault.value) for fault in error.faults] == [
        ("specimen.gap_mm", None),
        ("specimen.mass_kg", -1.0),
    ]
    assert str(error).splitlines() == ["a.toml:", f"  {gap}", f"  {mass}"]


def test_each_fault_is_on_lines_of_its_own_below_its_place() -> None:
    inner = InputError("", where="a.toml", faults=[InputError("missing", key="k")])
    error = InputError("not started", where="all.toml", faults=[inner, InputError("late")])
    assert str(error).splitlines() == [
        "all.toml: not started:",
        "  a.toml:",
        "    k: missing",
        "  late",
    ]
    assert [fault.where for fault in error.faults] == ["a.toml", ""]


def test_added_place_stands_before_the_others_and_keeps_the_fields() -> None:
    error = InputError("too low", where="a.toml", key="k", value=1, allowed="2", remedy="raise it")
    placed = error.add_place("case 3")
    assert placed.where == "case 3: a.toml"
    assert str(placed) == f"case 3: {error}"
    assert (placed.key, placed.value, placed.allowed, placed.remedy) == ("k", 1, "2", "raise it")
