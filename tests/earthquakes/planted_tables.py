"""Random hydraulic tables with or without a planted effect, and their rehearsals.

A rehearsal is recorded from the simulated table of `profiles/rigs/hydraulic.toml`, with all errors
of its instruments, by the profile `rehearsal.toml`.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from table_io.clock import ManualClock
from table_io.config.base import PROFILES_DIR
from table_io.config.calibration import compute_tare, volts_to_si
from table_io.config.profile import load_profile
from table_io.config.rig import RigConfig
from table_io.sim.simulated_table import SimulatedBackend
from tests.earthquakes.hydraulic_rig import RIG
from twin.earthquakes.table_identification import TableRehearsal

PROFILE = load_profile(PROFILES_DIR / "tests" / "rehearsal.toml")[0]
RATE_HZ = PROFILE.acquisition.rate_hz
REST_S = 0.5
# Effect of the twin's library: keys of [simulated.hydraulic], each with the ends of its size.
SIZES: dict[str, dict[str, tuple[float, float]]] = {
    "dead_band": {"valve_overlap_percent": (0.1, 0.8)},
    "valve_hysteresis": {"valve_hysteresis_percent": (0.15, 0.8)},
    "flow_asymmetry": {"flow_asymmetry": (0.08, 0.3)},
    "friction_drift": {"friction_drift_1_s": (0.003, 0.015)},
    "friction_asymmetry": {"friction_asymmetry": (0.1, 0.4)},
    "friction_slope": {"friction_slope_1_m": (20.0, 80.0)},
    "backlash": {"coupling_play_mm": (0.02, 0.15)},
    "transducer_gain": {"transducer_gain_error": (0.02, 0.1)},
    "transducer_lag": {"transducer_lag_ms": (4.0, 20.0)},
    "second_frame_mode": {
        "attached_mass_kg": (2000.0, 8000.0),
        "attached_frequency_hz": (20.0, 32.0),
    },
}


@dataclass(frozen=True)
class PlantedTable:
    """A simulated table: keys of [simulated.hydraulic] that differ from the rig file, and more."""

    hydraulic: Mapping[str, float]
    delay_ms: float = 2.0
    seed: int = 1
    effect: str = ""

    def build_rig(self) -> RigConfig:
        """Return the rig file of this table; InputError if a key does not fit."""
        values: dict[str, Any] = RIG.model_dump()
        simulated = dict(values["simulated"])
        simulated["hydraulic"] = {**simulated["hydraulic"], **self.hydraulic}
        simulated |= {"servo_delay_ms": self.delay_ms, "seed": self.seed}
        return RigConfig.model_validate({**values, "simulated": simulated})


def draw_table(rng: np.random.Generator, effect: str = "") -> PlantedTable:
    """Draw a table with friction of 300 to 1500 N and an oil column of 20 to 35 Hz."""
    friction_n, oil_hz = rng.uniform(300.0, 1500.0), rng.uniform(20.0, 35.0)
    # 27 Hz at 1000 MPa
    bulk_mpa = 1000.0 * (oil_hz / 26.902) ** 2
    hydraulic = {
        "friction_n": friction_n,
        "static_friction_n": friction_n * rng.uniform(1.1, 1.5),
        "stribeck_speed_m_s": rng.uniform(0.007, 0.014),
        "stick_stiffness_n_m": friction_n / rng.uniform(1.5e-5, 3e-5),
        "viscous_friction_n_s_m": rng.uniform(300.0, 1500.0),
        "bulk_modulus_mpa": bulk_mpa,
        "leakage_l_min_mpa": rng.uniform(0.04, 0.12),
        "gain_1_s": rng.uniform(14.0, 28.0),
        "velocity_feedforward": rng.uniform(0.0, 0.4),
        "pressure_feedback": rng.uniform(0.05, 0.11),
        "valve_frequency_hz": rng.uniform(65.0, 100.0),
        "valve_damping": rng.uniform(0.6, 1.0),
        "frame_frequency_hz": rng.uniform(11.0, 17.0),
        "frame_mass_kg": rng.uniform(25e3, 60e3),
        "frame_damping": rng.uniform(0.05, 0.12),
    }
    for key, (low, high) in SIZES.get(effect, {}).items():
        size = math.exp(rng.uniform(math.log(low), math.log(high)))
        signed = effect in ("flow_asymmetry", "friction_drift", "friction_asymmetry",
                            "friction_slope", "transducer_gain")  # fmt: skip
        hydraulic[key] = size * (rng.choice([-1.0, 1.0]) if signed else 1.0)
    return PlantedTable(hydraulic, rng.uniform(1.0, 4.0), int(rng.integers(1, 1_000_000)), effect)


def record_rehearsal(table: PlantedTable, excitation_seed: int = 0) -> TableRehearsal:
    """Return the rehearsal of a table as the rig would record it."""
    rig = table.build_rig()
    excitation = PROFILE.excitation.model_copy(update={"seed": excitation_seed})
    rest = np.zeros(round(REST_S * RATE_HZ))
    command = np.concatenate([rest, excitation.plan(RATE_HZ).history_m, rest])
    backend = SimulatedBackend(rig, PROFILE.specimen, RATE_HZ, ManualClock())
    backend.open()
    tare = compute_tare(backend.tare(round(RATE_HZ)), rig.sensors)
    backend.queue(0, command * rig.output.volts_per_m)
    values = volts_to_si(backend.take(command.size), rig.sensors, tare)
    signals = dict(zip(rig.channels, values, strict=True))
    return TableRehearsal(
        RATE_HZ,
        signals["drive_disp_m"],
        signals["table_disp_m"],
        signals["table_acc_m_s2"],
        -PROFILE.specimen.mass_kg * signals["mass_acc_m_s2"],
    )
