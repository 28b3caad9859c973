"""Profiles and rigs as they are read: defaults, grids, units, and files that cannot be read."""

import math
from pathlib import Path
from typing import Any

import pytest

from table_io.channels import CHANNEL_BY_NAME
from table_io.config.base import ConfigModel, format_toml, load_config, parse_toml
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.config.sensor import SensorConfig
from table_io.errors import InputError
from table_io.units import GRAVITY_M_S2, UNITS
from tests.builders.rigs import RIG_TEXT
from tests.input_errors import raises_input_error
from tests.table_io.config.test_refusals import format_sweep


def profile(**changes: Any) -> Profile:
    return parse_toml(format_sweep(changes), Profile, "some/test.toml")


def list_faults(text: str, card: type[ConfigModel] = Profile) -> tuple[InputError, ...]:
    """The faults of a text that is refused as a whole."""
    with raises_input_error(where="some/test.toml") as caught:
        parse_toml(text, card, "some/test.toml")
    return caught.value.faults


def test_plain_profile_is_read_with_defaults() -> None:
    test = profile()
    assert test.sweep.acceleration_g == 0.05
    assert test.sweep.measured_cycles == 3
    assert test.acquisition.rate_hz == 2000.0
    assert test.acquisition.block_samples == 20
    assert test.specimen.gaps_m == (0.002, 0.002)
    with pytest.raises(ValueError, match="frozen"):
        test.title = "another"  # type: ignore[misc]


def test_measured_gaps_win_over_the_nominal_one() -> None:
    for gap_mm in (math.inf, 30.0, 0.0, -10.0):
        assert profile(specimen__gap_mm=gap_mm).specimen.gaps_m == (gap_mm / 2e3, gap_mm / 2e3)
    test = profile(specimen__gap_right_mm=2.3, specimen__gap_left_mm=-1.9)
    assert test.specimen.gaps_m == (0.0023, -0.0019)
    assert test.specimen.gap_mm == 4.0


def test_grid_is_decimal_in_both_directions() -> None:
    sweep = profile().sweep
    assert sweep.frequencies_hz == tuple(round(0.1 * k, 1) for k in range(5, 51))
    up = [step.frequency_hz for step in sweep.steps if step.direction == "forward"]
    down = [step.frequency_hz for step in sweep.steps if step.direction == "backward"]
    assert up == list(sweep.frequencies_hz)
    assert down == up[::-1]
    assert [step.index for step in sweep.steps] == list(range(len(up) + len(down)))
    assert {step.acceleration_m_s2 for step in sweep.steps} == {0.05 * GRAVITY_M_S2}


def test_invalid_toml_names_the_line() -> None:
    with pytest.raises(InputError, match="line 2") as error:
        parse_toml('title = "x"\nsweep = \n', Profile, "some/test.toml")
    assert error.value.where == "some/test.toml"


def test_missing_file_names_its_neighbours(tmp_path: Path) -> None:
    with raises_input_error(where=str(tmp_path / "nowhere" / "g4.toml")):
        load_config(tmp_path / "nowhere" / "g4.toml", Profile, "test")
    (tmp_path / "g5.toml").write_text(format_sweep({}))
    with raises_input_error(where=str(tmp_path / "g4.toml"), remedy="there: g5.toml"):
        load_config(tmp_path / "g4.toml", Profile, "test")


def test_unreadable_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "folder.toml").mkdir()
    (tmp_path / "bytes.toml").write_bytes(b"title = '\xff\xfe'")
    for name in ("folder.toml", "bytes.toml"):
        with raises_input_error(where=str(tmp_path / name)):
            load_config(tmp_path / name, Profile, "test")


@pytest.mark.parametrize("channel", sorted(CHANNEL_BY_NAME))
def test_sensor_takes_the_units_of_its_quantity(channel: str) -> None:
    for unit, (si, scale) in UNITS.items():
        text = format_toml(
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


def test_rig_needs_the_sensors_of_the_controller() -> None:
    text = without_sensor(without_sensor(RIG_TEXT, "table_acc_m_s2"), "drive_disp_m")
    (fault,) = list_faults(text, RigConfig)
    assert fault.key == "sensors"
    assert "drive_disp_m, table_acc_m_s2" in fault.problem
    (fault,) = list_faults(RIG_TEXT.split("[simulated]")[0], RigConfig)
    assert fault.key == "simulated"
