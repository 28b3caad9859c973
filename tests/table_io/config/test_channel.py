"""Channels of a laboratory: what a rig file declares next to the canonical ones."""

import pytest

from table_io.backends.opendaq.config import OpenDaqWiring
from table_io.channels import CHANNEL_BY_NAME, TIME_COLUMN, Channel
from table_io.config.base import PROFILES_DIR, parse_toml
from table_io.config.channel import CONSTANT, QUANTITIES, read_channels
from table_io.config.rig import RigConfig
from table_io.errors import InputError
from table_io.units import UNITS
from tests.builders.rigs import EXTRA, LAB_TEXT, SECOND_ACC, TEMPERATURE, make_lab_rig
from twin.recording.tabular import LABEL_UNITS, TWIN_PREFIX


def list_faults(text: str) -> tuple[InputError, ...]:
    """The faults of a rig file that is refused as a whole."""
    with pytest.raises(InputError) as caught:
        parse_toml(text, RigConfig, "lab.toml")
    return caught.value.faults


def test_declared_channel_is_one_of_the_rig() -> None:
    rig = make_lab_rig()
    assert rig.channels[-3:] == EXTRA
    assert rig.channel_by_name == {
        **CHANNEL_BY_NAME,
        **{name: rig.channel_by_name[name] for name in EXTRA},
    }
    assert rig.channel_by_name[SECOND_ACC] == Channel(
        SECOND_ACC, "m/s2", "left", "Second accelerometer on the mass.", "acceleration", "mass"
    )
    signs = [rig.channel_by_name[name].sign for name in ("mass_acc_m_s2", *EXTRA)]
    assert signs == [1.0, -1.0, None, None]
    sensor = rig.sensors[rig.channels.index(TEMPERATURE)]
    assert (sensor.range_si, sensor.volts_per_si) == (200.0, 0.05)
    assert rig.stated_offsets == {TEMPERATURE: 50.0}


def test_rig_without_declared_channels_has_the_canonical_ones() -> None:
    for path in sorted((PROFILES_DIR / "rigs").glob("*.toml")):
        rig = parse_toml(path.read_text(), RigConfig, path.name)
        assert rig.channel_by_name == CHANNEL_BY_NAME
        assert rig.stated_offsets == {}


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_every_quantity_has_a_unit_and_a_sensor_for_it(quantity: str) -> None:
    unit, directions, _ = QUANTITIES[quantity]
    suffix = unit.lower().replace("/", "_")
    positive = f'positive = "{directions[0]}"' if directions else ""
    assert UNITS[unit] == (unit, 1.0)
    text = f"""
[[channels]]
name = "lab_{suffix}"
quantity = "{quantity}"
unit = "{unit}"
body = "other"
{positive}
simulated = {{ {CONSTANT} = 0.0 }}
[[sensors]]
channel = "lab_{suffix}"
unit = "{unit}"
range = 1.0
volts_per_unit = 1.0
bits = 16
"""
    rig = parse_toml(LAB_TEXT + text, RigConfig, "lab.toml")
    assert rig.channel_by_name[rig.channels[-1]].quantity == quantity


def test_no_name_is_that_of_another_column_of_an_export() -> None:
    for name in (TIME_COLUMN, *LABEL_UNITS, f"{TWIN_PREFIX}free_mass_acc_m_s2"):
        text = LAB_TEXT.replace(f'"{SECOND_ACC}"', f'"{name}"')
        assert list_faults(text)[0].key == "channels.0.name", name


def test_opendaq_wires_declared_channels_and_no_others() -> None:
    wiring = """
[opendaq]
device = "daq.nd://127.0.0.1"
[opendaq.signals]
air_temp_degc = "AI9"
"""
    rig = parse_toml(LAB_TEXT + wiring, RigConfig, "lab.toml")
    section = rig.get_section(OpenDaqWiring)
    assert section is not None
    assert section.signals == {TEMPERATURE: "AI9"}
    (fault,) = list_faults(LAB_TEXT + wiring.replace("air_temp_degc", "oil_temp_degc"))
    assert fault.key == "opendaq"
    assert "oil_temp_degc" in fault.problem


def test_channels_of_a_foreign_rig_file_are_read_as_far_as_they_are_valid() -> None:
    assert read_channels("") == read_channels("= no toml") == CHANNEL_BY_NAME
    assert read_channels("channels = 3") == CHANNEL_BY_NAME
    text = LAB_TEXT.replace('body = "other"', 'body = "moon"')
    assert [*read_channels(text)] == [*CHANNEL_BY_NAME, EXTRA[0], EXTRA[2]]
    assert read_channels(LAB_TEXT) == make_lab_rig().channel_by_name
