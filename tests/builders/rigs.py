"""Rigs: those shipped, with other sensors, tables, faults or channels."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from table_io.block import Float1D, Float2D
from table_io.config.base import PROFILES_DIR, parse_toml
from table_io.config.rig import OutputConfig, RigConfig
from table_io.config.sensor import SensorConfig
from table_io.sim.config import HydraulicTableConfig


def read_rig_text(name: str) -> str:
    """Return the text of a shipped rig file."""
    return (PROFILES_DIR / "rigs" / f"{name}.toml").read_text(encoding="utf-8")


def read_rig(name: str) -> RigConfig:
    """Return a shipped rig."""
    return parse_toml(read_rig_text(name), RigConfig, f"{name}.toml")


def read_model_text(name: str) -> str:
    """Return the text of a shipped model file."""
    return (PROFILES_DIR / "models" / f"{name}.toml").read_text(encoding="utf-8")


RIG_TEXT = read_rig_text("simulated")
RIG = read_rig("simulated")
CHANNEL_ROWS = {name: row for row, name in enumerate(RIG.channels)}
# (rms in SI, longest run of one value) of each channel at rest, as the tare measures them.
NOISE_SI = {sensor.channel: (sensor.noise_rms * sensor.si_per_unit, 2) for sensor in RIG.sensors}


def change_rig(
    rig: RigConfig = RIG,
    sensors: Mapping[str, Mapping[str, Any]] | None = None,
    every_sensor: Mapping[str, Any] | None = None,
    **tables: Mapping[str, Any],
) -> RigConfig:
    """Return a rig with other fields of some sensors, of all of them, and of tables."""
    raw = rig.model_dump()
    for sensor in raw["sensors"]:
        sensor.update({**(every_sensor or {}), **(sensors or {}).get(sensor["channel"], {})})
    for table, values in tables.items():
        raw[table].update(values)
    return RigConfig.model_validate(raw)


def make_faulty_rig(
    faults: Sequence[Mapping[str, Any]] = (), noise: float = 1.0, **simulated: Any
) -> RigConfig:
    """Return the simulated rig with planted faults, other noise and other values."""
    levels = {sensor.channel: {"noise_rms": noise * sensor.noise_rms} for sensor in RIG.sensors}
    return change_rig(sensors=levels, simulated={**simulated, "faults": tuple(faults)})


SECOND_ACC = "mass_acc_2_m_s2"
TEMPERATURE = "air_temp_degc"
UPWARD_ACC = "mass_edge_acc_m_s2"
EXTRA = (SECOND_ACC, TEMPERATURE, UPWARD_ACC)
# The second accelerometer is mounted the other way round; the third one senses rocking.
DECLARED = """
[[channels]]
name = "mass_acc_2_m_s2"
quantity = "acceleration"
unit = "m/s2"
body = "mass"
positive = "left"
meaning = "Second accelerometer on the mass."
simulated = { mass_acc_m_s2 = -1.0 }

[[channels]]
name = "air_temp_degc"
quantity = "temperature"
unit = "degC"
body = "other"
meaning = "Air at the specimen."
simulated = { constant = 21.5 }

[[channels]]
name = "mass_edge_acc_m_s2"
quantity = "acceleration"
unit = "m/s2"
body = "mass"
positive = "up"
simulated = { mass_acc_m_s2 = 0.5, table_acc_m_s2 = -0.25, constant = 0.1 }

[[sensors]]
channel = "mass_acc_2_m_s2"
unit = "g"
range = 5.0
volts_per_unit = 2.0
bits = 24
noise_rms = 0.0005
offset = 0.002
serial = "A-17"

[[sensors]]
channel = "air_temp_degc"
unit = "degC"
range = 200.0
volts_per_unit = 0.05
bits = 16
noise_rms = 0.02
offset = 50.0

[[sensors]]
channel = "mass_edge_acc_m_s2"
unit = "g"
range = 5.0
volts_per_unit = 2.0
bits = 24
noise_rms = 0.0005
"""
LAB_TEXT = RIG_TEXT.replace('name = "simulated"', 'name = "lab"', 1) + DECLARED


def make_lab_rig(**simulated: Any) -> RigConfig:
    """Return the rig of a laboratory that has more sensors than the canonical channels."""
    return change_rig(parse_toml(LAB_TEXT, RigConfig, "lab.toml"), simulated=simulated)


def si_to_volts(
    values: Float2D, sensors: tuple[SensorConfig, ...], tare: dict[str, float]
) -> Float2D:
    """Convert SI values, (channel, sample), to volts; the inverse of `volts_to_si`."""
    slope = np.array([sensor.volts_per_si for sensor in sensors])
    offset = np.array([tare.get(sensor.channel, 0.0) for sensor in sensors])
    return (values + offset[:, None]) * slope[:, None]


def command_to_si(volts: Float1D, output: OutputConfig) -> Float1D:
    """Convert volts of the command channel, (sample,), to displacement in m."""
    return volts / output.volts_per_m


def compute_oil_column_hz(hydraulic: HydraulicTableConfig, mass_kg: float) -> float:
    """Return the natural frequency of a moving mass in kg on the oil column, Hz."""
    area_m2, volume_m3 = hydraulic.piston_area_cm2 * 1e-4, hydraulic.oil_volume_cm3 * 1e-6
    stiffness_n_m = 4.0 * hydraulic.bulk_modulus_mpa * 1e6 * area_m2**2 / volume_m3
    return math.sqrt(stiffness_n_m / mass_kg) / math.tau
