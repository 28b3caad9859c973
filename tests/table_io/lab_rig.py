"""The simulated rig of a laboratory that has more sensors than the canonical channels."""

from typing import Any

from table_io.config.base import PROFILES_DIR, parse_toml
from table_io.config.rig import RigConfig

SIMULATED = (PROFILES_DIR / "rigs" / "simulated.toml").read_text(encoding="utf-8")
SECOND_ACC, TEMPERATURE, UPWARD_ACC = "mass_acc_2_m_s2", "air_temp_degc", "mass_edge_acc_m_s2"
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
LAB_TEXT = SIMULATED.replace('name = "simulated"', 'name = "lab"', 1) + DECLARED


def lab_rig(**simulated: Any) -> RigConfig:
    """The rig, with other values in [simulated]."""
    rig = parse_toml(LAB_TEXT, RigConfig, "lab.toml")
    raw = rig.model_dump()
    raw["simulated"].update(simulated)
    return RigConfig.model_validate(raw)
