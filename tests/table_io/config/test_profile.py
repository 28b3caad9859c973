"""Files that people write: every fault in one message that says where, what, allowed, and do."""

import copy
import math
from pathlib import Path
from typing import Any

import pytest

from table_io.channels import CHANNEL_BY_NAME
from table_io.config.base import PROFILES_DIR, ConfigModel, find_config, load_config, parse_toml
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.config.sensor import SensorConfig
from table_io.errors import InputError
from table_io.units import GRAVITY_M_S2, UNITS

RIG_TEXT = (PROFILES_DIR / "rigs" / "simulated.toml").read_text(encoding="utf-8")
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


def refusal(text: str, card: type[ConfigModel] = Profile) -> list[str]:
    """Lines of the refusal of a text; the first names the file, the others a fault each."""
    with pytest.raises(InputError) as caught:
        parse_toml(text, card, "some/test.toml")
    head, *faults = str(caught.value).splitlines()
    assert head.startswith("some/test.toml")
    return [fault.strip() for fault in faults]


def test_a_plain_test_is_read_and_cannot_be_changed() -> None:
    one = profile()
    assert one.sweep.acceleration_g == 0.05
    assert one.sweep.measured_cycles == 3
    assert one.acquisition.rate_hz == 2000.0
    assert one.acquisition.block_samples == 20
    assert one.specimen.gaps_m == (0.002, 0.002)
    with pytest.raises(ValueError, match="frozen"):
        one.title = "another"  # type: ignore[misc]


def test_every_fault_of_a_file_stands_in_one_message() -> None:
    faults = refusal(
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
    wanted = {
        "nonsense": "unknown key",
        "specimen.mass_kg": "-5.0: input should be greater than 0",
        "specimen.gap_mm": "nan",
        "specimen.gap_left_mm": "both or neither",
        "sweep.stp_hz": "unknown key; did you mean",
        "sweep.step_hz": "does not divide",
        "sweep.measured_cycles": "measured_cycles 3 is more than cycles 2",
        "sweep.acceleration_g": "'0.05'",
        "acquisition.rest_s": "greater than or equal to 0.2",
        "on_death.twin": "'continue' or 'stop'",
    }
    for key, part in wanted.items():
        (fault,) = (line for line in faults if line.split(" ")[0].rstrip(":") == key)
        assert part in fault, key
    assert len(faults) == len(wanted)


@pytest.mark.parametrize(
    ("changes", "key", "part"),
    [
        ({"titel": "x"}, "titel", "did you mean 'title'?"),
        ({"title": None}, "title", "missing; add it"),
        ({"sweep__start_hz": None}, "sweep.start_hz", "missing; add it"),
        ({"specimen__gap": 4.0}, "specimen.gap", "did you mean 'gap_mm'?"),
        ({"acquisition__qqq": 4.0}, "acquisition.qqq", "known: rate_hz, block_samples, rest_s"),
        (
            {"sweep__start_hz": 0.0},
            "sweep.start_hz",
            "= 0.0: input should be greater than or equal to 0.01",
        ),
        ({"sweep__start_hz": math.nan}, "sweep.start_hz", "nan"),
        ({"sweep__stop_hz": math.inf}, "sweep.stop_hz", "finite"),
        ({"sweep__stop_hz": 0.4}, "sweep.stop_hz", "0.4 lies below start_hz 0.5"),
        ({"sweep__step_hz": 0.4}, "sweep.step_hz", "0.4 does not divide 0.5 to 5.0 Hz"),
        ({"sweep__step_hz": 1e-4}, "sweep.step_hz", "more than 5001 steps"),
        ({"sweep__step_hz": 1e-310}, "sweep.step_hz", "more than 5001 steps"),
        ({"sweep__cycles": 1}, "sweep.cycles", "greater than or equal to 2"),
        ({"sweep__cycles": 10.5}, "sweep.cycles", "integer"),
        ({"sweep__cycles": True}, "sweep.cycles", "integer"),
        ({"sweep__measured_cycles": 11}, "sweep.measured_cycles", "more than cycles 10"),
        ({"sweep__directions": []}, "sweep.directions", "allowed: 'forward', 'backward'"),
        ({"sweep__directions": ["up"]}, "sweep.directions.0", "'forward' or 'backward'"),
        ({"sweep__blend_cycles": 1.0}, "sweep.blend_cycles", "greater than or equal to 1.5"),
        ({"sweep__acceleration_g": True}, "sweep.acceleration_g", "number"),
        ({"specimen__mass_kg": math.inf}, "specimen.mass_kg", "finite"),
        ({"specimen__gap_mm": -math.inf}, "specimen.gap_mm", "-inf; allowed"),
        ({"specimen__gap_right_mm": 2.0}, "specimen.gap_left_mm", "give both or neither"),
        ({"specimen__gap_left_mm": 2.0}, "specimen.gap_left_mm", "give both or neither"),
        ({"acquisition__rate_hz": 499.0}, "acquisition", "allowed: at least 500"),
        ({"sweep": 3}, "sweep", "= 3"),
    ],
)
def test_a_fault_names_key_value_and_what_is_allowed(
    changes: dict[str, Any], key: str, part: str
) -> None:
    (fault,) = refusal(test_with(**changes))
    assert fault.split(" ")[0].rstrip(":") == key
    assert part in fault


def test_the_default_rate_too_is_checked_against_the_sweep() -> None:
    (fault,) = refusal(test_with(sweep__stop_hz=20.5, sweep__step_hz=1.0))
    assert "rate_hz 2000" in fault
    assert "at least 2050" in fault


@pytest.mark.parametrize("gap_mm", [math.inf, 30.0, 0.0, -1.0, -10.0])
def test_gaps_may_be_infinite_or_negative(gap_mm: float) -> None:
    assert profile(specimen__gap_mm=gap_mm).specimen.gaps_m == (gap_mm / 2e3, gap_mm / 2e3)


def test_measured_gaps_win_over_the_nominal_one() -> None:
    one = profile(specimen__gap_right_mm=2.3, specimen__gap_left_mm=-1.9)
    assert one.specimen.gaps_m == (0.0023, -0.0019)
    assert one.specimen.gap_mm == 4.0


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
    with pytest.raises(InputError, match=r"some/test.toml: not valid TOML: .*line 2"):
        parse_toml('title = "x"\nsweep = \n', Profile, "some/test.toml")


def test_a_missing_file_names_its_neighbours(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"g4.toml: no such test; give the path"):
        load_config(tmp_path / "nowhere" / "g4.toml", Profile, "test")
    (tmp_path / "g5.toml").write_text(test_with())
    with pytest.raises(InputError, match=r"g4.toml: no such test; there: g5.toml"):
        load_config(tmp_path / "g4.toml", Profile, "test")


def test_what_cannot_be_read_says_so(tmp_path: Path) -> None:
    (tmp_path / "folder.toml").mkdir()
    (tmp_path / "bytes.toml").write_bytes(b"title = '\xff\xfe'")
    for name in ("folder.toml", "bytes.toml"):
        with pytest.raises(InputError, match=rf"{name}: cannot read this test"):
            load_config(tmp_path / name, Profile, "test")


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
    with pytest.raises(InputError, match=r"did you mean 'g4_ss1'\?"):
        find_config("g4_s1", "tests")
    with pytest.raises(InputError, match=r"did you mean 'big_table'\?"):
        find_config("bigtable", "rigs", beside)
    with pytest.raises(InputError) as raised:
        find_config("xyz", "tests")
    assert raised.value.key == "xyz"
    assert "quickstart" in raised.value.remedy


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
            (fault,) = refusal(text, SensorConfig)
            assert fault.startswith(f"unit: unit '{unit}' does not measure {channel}")
            assert f"allowed: {CHANNEL_BY_NAME[channel].unit}" in fault


def without_sensor(text: str, channel: str, times: int = 1) -> str:
    """The machine card without the first `times` sensors of a channel."""
    head, *sensors = text.split("[[sensors]]")
    for _ in range(times):
        sensors.remove(next(one for one in sensors if f'"{channel}"' in one))
    return "[[sensors]]".join([head, *sensors])


@pytest.mark.parametrize(
    ("old", "new", "key", "part"),
    [
        ('"mass_acc_m_s2"', '"mass_acc_m_s"', "sensors.4.channel", "mean 'mass_acc_m_s2'?"),
        ('"force_l2_n"', '"force_l1_n"', "sensors", "name force_l1_n more than once"),
        ('"table_acc_m_s2"', '"rel_disp_m"', "sensors.2.unit", "does not measure rel_disp_m"),
        ("volts_per_unit = 5.0", "volts_per_unit = 0.0", "sensors.2.volts_per_unit", "not 0"),
        ("noise_rms = 0.0005", "noise = 0.0005", "sensors.2.noise", "mean 'noise_rms'?"),
        ("stroke_mm = 60.0", "stroke_mm = inf", "limits.stroke_mm", "finite"),
        ("bits = 18", "bits = 40", "output.bits", "less than or equal to 32"),
        ("seed = 1", "sead = 1", "simulated.sead", "did you mean 'seed'?"),
        ("rates_hz = [1000.0, 2000.0, 4000.0]", "rates_hz = []", "rates_hz", "at least 1"),
    ],
)
def test_a_machine_card_is_read_as_strictly(old: str, new: str, key: str, part: str) -> None:
    faults = refusal(RIG_TEXT.replace(old, new, 1), RigConfig)
    assert faults[0].split(" ")[0].rstrip(":") == key
    assert part in faults[0]
    assert len(faults) == 1


def test_a_machine_card_needs_the_sensors_of_the_controller() -> None:
    text = without_sensor(without_sensor(RIG_TEXT, "table_acc_m_s2"), "drive_disp_m")
    (fault,) = refusal(text, RigConfig)
    assert fault.startswith("sensors: sensors lack drive_disp_m, table_acc_m_s2")
    (fault,) = refusal(RIG_TEXT.split("[simulated]")[0], RigConfig)
    assert "needs a [simulated] table" in fault
