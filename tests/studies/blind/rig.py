"""Test profile and rig config of the study, as texts that do not reveal the truth.

G4 at 0.05 g, ten frequencies forward and backward, about 60 s: chaos and several impacts per cycle
below 1.6 Hz, the impacting branch up to 4.4 Hz forward, flight from 4.2 Hz backward. Loop check and
level control are off: the twin is driven by the measured table motion anyway.
"""

import hashlib
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from table_io.block import Bool2D, Float1D, Float2D, Int1D, Label
from table_io.channels import LEFT_CELLS, RIGHT_CELLS
from table_io.clock import ManualClock
from table_io.config.base import PROFILES_DIR, format_toml, parse_toml
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.excitation.trajectory import plan_sweep
from table_io.sim.simulated_table import SimulatedBackend
from tests.builders.rigs import read_rig_text

PROFILE_TOML = """\
title = "G4, ten frequencies up and back"
rig = "simulated"
model = "snm"

[specimen]
mass_kg = 550.0
gap_mm = 4.0

[sweep]
start_hz = 0.8
stop_hz = 4.4
step_hz = 0.4
cycles = 4
acceleration_g = 0.05

[acquisition]
rate_hz = 1000.0
block_samples = 50
rest_s = 1.0

[loop_check]
enabled = false

[control]
enabled = false

[protection]
sensor = "warn"
alarm = 1.0
abort_db = 12.0
"""
PROFILE = parse_toml(PROFILE_TOML, Profile, "the study's test")
MODEL_TOML = (PROFILES_DIR / "models" / "snm.toml").read_text(encoding="utf-8")
SETTLING_S = 8.0  # until the mass is at rest, to avoid spectral leakage
SIGNAL_CHANNELS = (
    "table_disp_m", "table_acc_m_s2", "mass_disp_m", "mass_acc_m_s2", *RIGHT_CELLS, *LEFT_CELLS,
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class StudySignals:
    """Signals in SI, (sample,) each; F_R >= 0, F_L <= 0.

    `step` is -1 outside of any step, `label` the `Label` of each sample.
    """

    channels: Mapping[str, Float1D]
    right: Float1D
    left: Float1D
    step: Int1D
    label: Int1D

    @property
    def moving(self) -> Bool2D:
        """Samples at which the table is not at rest, (sample,)."""
        return np.asarray(self.label != Label.REST)


def make_rig_toml(
    noise: float, seed: int = 0, truth: Path | None = None, name: str = "simulated"
) -> str:
    """Return a rig config whose plant hides a truth, sealed by the hash of its file.

    On the rig `simulated` the noise of each sensor is a share of its rms in the nominal test, so
    that it does not depend on the truth. Another rig keeps its own.
    """
    config: dict[str, Any] = tomllib.loads(read_rig_text(name))
    config["simulated"]["seed"] = seed
    if truth is not None:
        config["simulated"].pop("hidden", None)  # a rig takes either this or a truth
        digest = hashlib.sha256(truth.read_bytes()).hexdigest()
        config["simulated"] |= {"truth": str(truth.resolve()), "truth_sha256": digest}
    if name == "simulated":
        rms = compute_noise_rms(noise) if noise else {}
        sensors = parse_toml(format_toml(config), RigConfig, name).sensors
        for table, sensor in zip(config["sensors"], sensors, strict=True):
            table["noise_rms"] = rms.get(sensor.channel, 0.0) / sensor.si_per_unit
    return format_toml(config)


@cache
def compute_noise_rms(noise: float) -> dict[str, float]:
    """Return the rms of each channel's noise in SI, rounded to two digits."""
    signals = simulate_signals(make_rig_toml(0.0))
    return {
        name: float(f"{noise * values[signals.moving].std():.1e}")
        for name, values in signals.channels.items()
    }


def simulate_signals(rig_text: str, profile: Profile = PROFILE) -> StudySignals:
    """Simulate the study's test on the machine of a rig config, without session and sensors."""
    return simulate_readings(rig_text, profile)[0]


def simulate_readings(
    rig_text: str, profile: Profile = PROFILE
) -> tuple[StudySignals, dict[str, Float1D]]:
    """Simulate a test, by default the study's; return true signals and readings of their channels.

    Readings (sample,) are in SI, of the sensors of the rig config before the tare.
    """
    rig, rate = parse_toml(rig_text, RigConfig, "the study's machine"), profile.acquisition.rate_hz
    drive = plan_sweep(profile)
    count = drive.planned_end + round(SETTLING_S * rate)
    backend = SimulatedBackend(rig, profile.specimen, rate, ManualClock())
    recorded: list[Float2D] = []
    backend.observer = lambda first, command, signals: recorded.append(signals.copy())
    backend.open()
    backend.queue(0, drive.command(0, count) * rig.output.volts_per_m)
    backend.start()
    volts = backend.take(count)
    table_disp, table_acc, mass_disp, mass_acc, force_right, force_left = recorded[0]
    step, label, _ = drive.labels(0, count)
    cells = dict.fromkeys(RIGHT_CELLS, 0.5 * force_right) | dict.fromkeys(
        LEFT_CELLS, -0.5 * force_left
    )
    channels = (
        dict(zip(SIGNAL_CHANNELS, (table_disp, table_acc, mass_disp, mass_acc), strict=False))
        | cells
    )
    readings = {
        name: volts[rig.channels.index(name)] / rig.sensors[rig.channels.index(name)].volts_per_si
        for name in channels
    }
    return StudySignals(channels, force_right, force_left, step, np.asarray(label)), readings
