"""Files that people write: every fault in one message that says where, what, allowed, and do."""

import copy
import math
from pathlib import Path
from typing import Any

import pytest

from table_io.channels import CHANNEL_BY_NAME
from table_io.config.base import PROFILES_DIR, ConfigModel, load_config, parse_toml
from table_io.config.folders import find_config, list_configs, resolve_config
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.config.sensor import SensorConfig
from table_io.errors import InputError
from table_io.units import GRAVITY_M_S2, UNITS
from tests.builders.rigs import RIG_TEXT

TEST: dict[str, Any] = {
    "title": "a test",
    "specimen": {"mass_kg": 550.0, "gap_mm": 4.0},
    "sweep": {"start_hz": 0.5, "stop_hz": 5.0, "step_hz": 0.1, "cycles": 10},
}


def toml(tables: dict[str, Any]) -> str:
    """TOML text of a dictionary of values and of tables of values."""

    def line(key: str, value: Any) -> str:
        shown = repr(value).lower() if isinstance(value, (bool, float)) else repr(value)
        return f"{key} = {shown}"

    top = [line(key, value) for key, value in tables.items() if not isinstance(value, dict)]
    for name, table in tables.items():
        if isinstance(table, dict):
            top += [f"[{name}]", *(line(key, value) for key, value in table.items())]
    return "\n".join(top)


def test_with(**changes: Any) -> str:
    """Text of the test with other values: `sweep__step_hz=0.3`; None leaves a key out."""
    tables = copy.deepcopy(TEST)
    for where, value in changes.items():
        *table, key = where.split("__")
        place = tables.setdefault(table[0], {}) if table else tables
        if value is None:
            del place[key]
        else:
            place[key] = value
    return toml(tables)


test_with.__test__ = False  # type: ignore[attr-defined]


def profile(**changes: Any) -> Profile:
    return parse_toml(test_with(**changes), Profile, "some/test.toml")


def list_faults(text: str, card: type[ConfigModel] = Profile) -> tuple[InputError, ...]:
    """The faults of a text that is refused as a whole."""
    with pytest.raises(InputError) as caught:
        parse_toml(text, card, "some/test.toml")
    assert caught.value.where == "some/test.toml"
    return caught.value.faults


def test_a_plain_test_is_read_and_cannot_be_changed() -> None:
    test = profile()
    assert test.sweep.acceleration_g == 0.05
    assert test.sweep.measured_cycles == 3
    assert test.acquisition.rate_hz == 2000.0
    assert test.acquisition.block_samples == 20
    assert test.specimen.gaps_m == (0.002, 0.002)
    with pytest.raises(ValueError, match="frozen"):
        test.title = "another"  # type: ignore[misc]


def test_every_fault_of_a_file_stands_in_one_message() -> None:
    faults = list_faults(
        test_with(
            nonsense=1,
            specimen__mass_kg=-5.0,
            specimen__gap_mm=math.nan,
            specimen__gap_right_mm=1.0,
            sweep__stp_hz=0.1,
            sweep__step_hz=0.31,
            sweep__cycles=2,
            sweep__acceleration_g="0.05",
            acquisition__rest_s=0.0,
            on_death__twin="explode",
        )
    )
    assert [(fault.key, fault.value) for fault in faults] == [
        ("specimen.mass_kg", -5.0),
        ("specimen.gap_mm", None),
        ("specimen.gap_left_mm", None),
        ("sweep.step_hz", None),
        ("sweep.measured_cycles", None),
        ("sweep.acceleration_g", "0.05"),
        ("sweep.stp_hz", None),
        ("acquisition.rest_s", 0.0),
        ("on_death.twin", "explode"),
        ("nonsense", None),
    ]


@pytest.mark.parametrize(
    ("changes", "key", "fields"),
    [
        ({"titel": "x"}, "titel", {"remedy": "did you mean 'title'?"}),
        ({"title": None}, "title", {"remedy": "add it"}),
        ({"sweep__start_hz": None}, "sweep.start_hz", {"remedy": "add it"}),
        ({"specimen__gap": 4.0}, "specimen.gap", {"remedy": "did you mean 'gap_mm'?"}),
        (
            {"acquisition__qqq": 4.0},
            "acquisition.qqq",
            {"remedy": "known: rate_hz, block_samples, rest_s"},
        ),
        ({"sweep__start_hz": 0.0}, "sweep.start_hz", {"value": 0.0}),
        ({"sweep__stop_hz": math.inf}, "sweep.stop_hz", {"value": math.inf}),
        ({"sweep__stop_hz": 0.4}, "sweep.stop_hz", {}),
        ({"sweep__step_hz": 0.4}, "sweep.step_hz", {"remedy": "nearest: 0.409091"}),
        ({"sweep__step_hz": 1e-4}, "sweep.step_hz", {"allowed": "at least 0.0009"}),
        ({"sweep__step_hz": 1e-310}, "sweep.step_hz", {"allowed": "at least 0.0009"}),
        ({"sweep__cycles": 1}, "sweep.cycles", {"value": 1}),
        ({"sweep__cycles": 10.5}, "sweep.cycles", {"value": 10.5}),
        ({"sweep__cycles": True}, "sweep.cycles", {"value": True}),
        ({"sweep__measured_cycles": 11}, "sweep.measured_cycles", {}),
        (
            {"sweep__directions": []},
            "sweep.directions",
            {"allowed": "'forward', 'backward', in any order"},
        ),
        ({"sweep__directions": ["up"]}, "sweep.directions.0", {"value": "up"}),
        ({"sweep__blend_cycles": 1.0}, "sweep.blend_cycles", {"value": 1.0}),
        ({"sweep__acceleration_g": True}, "sweep.acceleration_g", {"value": True}),
        ({"specimen__mass_kg": math.inf}, "specimen.mass_kg", {"value": math.inf}),
        (
            {"specimen__gap_mm": -math.inf},
            "specimen.gap_mm",
            {"allowed": "a number in mm, or inf for no bumpers"},
        ),
        ({"specimen__gap_right_mm": 2.0}, "specimen.gap_left_mm", {}),
        ({"specimen__gap_left_mm": 2.0}, "specimen.gap_left_mm", {}),
        ({"acquisition__rate_hz": 499.0}, "acquisition", {"allowed": "at least 500"}),
        ({"sweep": 3}, "sweep", {"value": 3}),
    ],
)
def test_a_fault_names_key_value_and_what_is_allowed(
    changes: dict[str, Any], key: str, fields: dict[str, object]
) -> None:
    (fault,) = list_faults(test_with(**changes))
    assert fault.key == key
    assert {name: getattr(fault, name) for name in fields} == fields


def test_a_frequency_that_is_no_number_is_refused() -> None:
    (fault,) = list_faults(test_with(sweep__start_hz=math.nan))
    assert fault.key == "sweep.start_hz"
    assert math.isnan(float(str(fault.value)))


def test_the_default_rate_too_is_checked_against_the_sweep() -> None:
    (fault,) = list_faults(test_with(sweep__stop_hz=20.5, sweep__step_hz=1.0))
    assert (fault.key, fault.allowed) == ("acquisition", "at least 2050")


@pytest.mark.parametrize("gap_mm", [math.inf, 30.0, 0.0, -1.0, -10.0])
def test_gaps_may_be_infinite_or_negative(gap_mm: float) -> None:
    assert profile(specimen__gap_mm=gap_mm).specimen.gaps_m == (gap_mm / 2e3, gap_mm / 2e3)


def test_measured_gaps_win_over_the_nominal_one() -> None:
    test = profile(specimen__gap_right_mm=2.3, specimen__gap_left_mm=-1.9)
    assert test.specimen.gaps_m == (0.0023, -0.0019)
    assert test.specimen.gap_mm == 4.0


def test_the_grid_is_the_decimal_one_both_ways() -> None:
    sweep = profile().sweep
    assert sweep.frequencies_hz == tuple(round(0.1 * k, 1) for k in range(5, 51))
    up = [step.frequency_hz for step in sweep.steps if step.direction == "forward"]
    down = [step.frequency_hz for step in sweep.steps if step.direction == "backward"]
    assert up == list(sweep.frequencies_hz)
    assert down == up[::-1]
    assert [step.index for step in sweep.steps] == list(range(len(up) + len(down)))
    assert {step.acceleration_m_s2 for step in sweep.steps} == {0.05 * GRAVITY_M_S2}


def test_what_is_no_toml_says_the_line() -> None:
    with pytest.raises(InputError, match="line 2") as error:
        parse_toml('title = "x"\nsweep = \n', Profile, "some/test.toml")
    assert error.value.where == "some/test.toml"


def test_a_missing_file_names_its_neighbours(tmp_path: Path) -> None:
    with pytest.raises(InputError) as error:
        load_config(tmp_path / "nowhere" / "g4.toml", Profile, "test")
    assert error.value.where == str(tmp_path / "nowhere" / "g4.toml")
    (tmp_path / "g5.toml").write_text(test_with())
    with pytest.raises(InputError) as error:
        load_config(tmp_path / "g4.toml", Profile, "test")
    assert (error.value.where, error.value.remedy) == (str(tmp_path / "g4.toml"), "there: g5.toml")


def test_what_cannot_be_read_says_so(tmp_path: Path) -> None:
    (tmp_path / "folder.toml").mkdir()
    (tmp_path / "bytes.toml").write_bytes(b"title = '\xff\xfe'")
    for name in ("folder.toml", "bytes.toml"):
        with pytest.raises(InputError) as error:
            load_config(tmp_path / name, Profile, "test")
        assert error.value.where == str(tmp_path / name)


def test_load_hands_out_the_text_that_it_read(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(test_with() + "\n# a note\n", encoding="utf-8")
    assert load_config(path, Profile, "test") == (profile(), test_with() + "\n# a note\n")


def test_find_knows_names_paths_and_neighbours(tmp_path: Path) -> None:
    assert find_config("g4_ss1", "tests") == PROFILES_DIR / "tests" / "g4_ss1.toml"
    assert find_config("any/where.toml", "tests") == Path("any/where.toml")
    beside = tmp_path / "tests" / "mine.toml"
    for folder in ("tests", "rigs"):
        (tmp_path / folder).mkdir()
    beside.write_text(test_with())
    (tmp_path / "rigs" / "simulated.toml").write_text(RIG_TEXT)
    (tmp_path / "rigs" / "big_table.toml").write_text(RIG_TEXT)
    assert find_config("simulated", "rigs", beside) == tmp_path / "rigs" / "simulated.toml"
    with pytest.raises(InputError) as raised:
        find_config("g4_s1", "tests")
    assert raised.value.remedy.startswith("did you mean 'g4_ss1'?")
    assert str(PROFILES_DIR / "tests") in raised.value.remedy
    with pytest.raises(InputError) as raised:
        find_config("bigtable", "rigs", beside)
    assert raised.value.remedy.startswith("did you mean 'big_table'?")
    with pytest.raises(InputError) as raised:
        find_config("xyz", "tests")
    assert raised.value.key == "xyz"
    assert "quickstart" in raised.value.remedy


def test_the_folders_of_the_user_come_before_the_shipped_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    working, listed, own = (tmp_path / name for name in ("working", "listed", "own"))
    for root, names in (
        (working / "profiles", ("a",)),
        (listed, ("a", "b")),
        (own / "shaketwin", ("a", "b", "simulated")),
    ):
        (root / "rigs").mkdir(parents=True)
        for name in names:
            (root / "rigs" / f"{name}.toml").write_text(RIG_TEXT)
    (working / "quickstart").mkdir()  # a folder of results, not the test of that name
    monkeypatch.chdir(working)
    monkeypatch.setenv("SHAKETWIN_PROFILES", str(listed))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(own))
    places = [find_config(name, "rigs").parent.parent for name in ("a", "b", "simulated")]
    assert places == [working / "profiles", listed, own / "shaketwin"]
    assert list_configs("rigs").keys() >= {"a", "b", "simulated", "machine"}
    shipped = PROFILES_DIR / "tests" / "quickstart.toml"
    assert find_config("simulated", "rigs", shipped).parent.parent == own / "shaketwin"
    assert resolve_config(Path("quickstart"), "tests") == shipped


@pytest.mark.parametrize("channel", sorted(CHANNEL_BY_NAME))
def test_a_channel_takes_the_units_of_its_quantity_and_no_other(channel: str) -> None:
    for unit, (si, scale) in UNITS.items():
        text = toml(
            {"channel": channel, "unit": unit, "range": 2.0, "volts_per_unit": 4.0, "bits": 16}
        )
        if si == CHANNEL_BY_NAME[channel].unit:
            sensor = parse_toml(text, SensorConfig, "s.toml")
            assert sensor.range_si == 2.0 * scale
            assert sensor.volts_per_si == pytest.approx(4.0 / scale)
        else:
            (fault,) = list_faults(text, SensorConfig)
            assert fault.key == "unit"
            assert fault.allowed.split(", ")[0] == CHANNEL_BY_NAME[channel].unit


def without_sensor(text: str, channel: str, times: int = 1) -> str:
    """The machine card without the first `times` sensors of a channel."""
    head, *sensors = text.split("[[sensors]]")
    for _ in range(times):
        sensors.remove(next(sensor for sensor in sensors if f'"{channel}"' in sensor))
    return "[[sensors]]".join([head, *sensors])


@pytest.mark.parametrize(
    ("old", "new", "key", "fields"),
    [
        (
            '"mass_acc_m_s2"',
            '"mass_acc_m_s"',
            "sensors.4.channel",
            {"remedy": "did you mean 'mass_acc_m_s2'? or declare it in a [[channels]] table"},
        ),
        ('"force_l2_n"', '"force_l1_n"', "sensors", {"remedy": "one sensor per channel"}),
        (
            '"table_acc_m_s2"',
            '"rel_disp_m"',
            "sensors.2.unit",
            {"allowed": "m, mm, um, cm, in, ft"},
        ),
        (
            "volts_per_unit = 5.0",
            "volts_per_unit = 0.0",
            "sensors.2.volts_per_unit",
            {"allowed": "not 0"},
        ),
        (
            "noise_rms = 0.0005",
            "noise = 0.0005",
            "sensors.2.noise",
            {"remedy": "did you mean 'noise_rms'?"},
        ),
        ("stroke_mm = 60.0", "stroke_mm = inf", "limits.stroke_mm", {"value": math.inf}),
        ("bits = 18", "bits = 40", "output.bits", {"value": 40}),
        ("seed = 1", "sead = 1", "simulated.sead", {"remedy": "did you mean 'seed'?"}),
        ("rates_hz = [1000.0, 2000.0, 4000.0]", "rates_hz = []", "rates_hz", {"value": []}),
    ],
)
def test_a_machine_card_is_read_as_strictly(
    old: str, new: str, key: str, fields: dict[str, object]
) -> None:
    (fault,) = list_faults(RIG_TEXT.replace(old, new, 1), RigConfig)
    assert fault.key == key
    assert {name: getattr(fault, name) for name in fields} == fields


def test_a_machine_card_needs_the_sensors_of_the_controller() -> None:
    text = without_sensor(without_sensor(RIG_TEXT, "table_acc_m_s2"), "drive_disp_m")
    (fault,) = list_faults(text, RigConfig)
    assert fault.key == "sensors"
    assert "drive_disp_m, table_acc_m_s2" in fault.problem
    (fault,) = list_faults(RIG_TEXT.split("[simulated]")[0], RigConfig)
    assert fault.key == "simulated"
