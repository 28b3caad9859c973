"""The test of the study and the machine it stands on, as texts that reveal nothing.

G4 at 0.05 g through ten frequencies, up and back, about 60 s: chaos and several impacts a cycle
below 1.6 Hz, the impacting branch up to 4.4 Hz on the way up, flight from 4.2 Hz on the way back.
No loop check and no level control: the twin is driven by the measured table in any case.
"""

import json
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from table_io.backends.simulated import SimulatedBackend
from table_io.block import Bool2D, Float1D, Float2D, Int1D, Label
from table_io.card import PROFILES, parse
from table_io.channels import LEFT_CELLS, RIGHT_CELLS
from table_io.clock import ManualClock
from table_io.course import plan
from table_io.profile import Profile
from table_io.rig import Rig

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
PROFILE = parse(PROFILE_TOML, Profile, "the study's test")
MODEL_TOML = (PROFILES / "models" / "snm.toml").read_text(encoding="utf-8")
NOMINAL_RIG: dict[str, Any] = tomllib.loads(
    (PROFILES / "rigs" / "simulated.toml").read_text(encoding="utf-8")
)
RING_S = 8.0  # in which the mass comes to rest, so that a spectrum has no edge
CHANNELS = (
    "table_disp_m", "table_acc_m_s2", "mass_disp_m", "mass_acc_m_s2", *RIGHT_CELLS, *LEFT_CELLS,
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Signals:
    """What truly happened: SI, (sample,) each; F_R >= 0, F_L <= 0; `step` -1 outside of any."""

    true: Mapping[str, Float1D]
    right: Float1D
    left: Float1D
    step: Int1D
    moving: Bool2D


def rig_toml(noise: float, seed: int = 0, truth: str = "", sha256: str = "") -> str:
    """The machine card's text: every sensor's noise is this share of its rms over the nominal test.

    The rms of the nominal test, so the noise tells nothing of the truth.
    """
    card = NOMINAL_RIG | {"simulated": NOMINAL_RIG["simulated"] | {"seed": seed}}
    if truth:
        card["simulated"] |= {"truth": truth, "truth_sha256": sha256}
    rms = noise_rms(noise) if noise else {}
    card["sensors"] = [
        one | {"noise_rms": rms.get(one["channel"], 0.0) / _si_per_unit(one["channel"])}
        for one in NOMINAL_RIG["sensors"]
    ]
    return toml(card)


@cache
def noise_rms(noise: float) -> dict[str, float]:
    """rms of each channel's noise in SI, rounded to two digits."""
    signals = played(rig_toml(0.0))
    return {
        name: float(f"{noise * values[signals.moving].std():.1e}")
        for name, values in signals.true.items()
    }


def played(rig_text: str) -> Signals:
    """The study's test on the machine of a card, without session and without sensors."""
    rig, rate = parse(rig_text, Rig, "the study's machine"), PROFILE.acquisition.rate_hz
    drive = plan(PROFILE)
    count = drive.planned_end + round(RING_S * rate)
    backend = SimulatedBackend(rig, PROFILE.specimen, rate, ManualClock())
    seen: list[Float2D] = []
    backend.witness = lambda first, command, signals: seen.append(signals.copy())
    backend.open()
    backend.queue(0, drive.command(0, count) * rig.output.volts_per_m)
    backend.start()
    backend.take(count)
    y, y_acc, x, x_acc, right, left = seen[0]
    step, label, _ = drive.labels(0, count)
    cells = dict.fromkeys(RIGHT_CELLS, 0.5 * right) | dict.fromkeys(LEFT_CELLS, -0.5 * left)
    true = dict(zip(CHANNELS, (y, y_acc, x, x_acc), strict=False)) | cells
    return Signals(true, right, left, step, np.asarray(label) != Label.REST)


def _si_per_unit(channel: str) -> float:
    rig = parse(toml(NOMINAL_RIG), Rig, "simulated.toml")
    return next(one.si_per_unit for one in rig.sensors if one.channel == channel)


def toml(table: Mapping[str, Any], path: str = "") -> str:
    """The text of a table: numbers, words, lists of them, tables and lists of tables in it."""
    plain, nested = [], []
    for key, value in table.items():
        where = f"{path}.{key}" if path else key
        if isinstance(value, Mapping):
            nested.append(f"\n[{where}]\n{toml(value, where)}")
        elif isinstance(value, list | tuple) and value and isinstance(value[0], Mapping):
            nested += [f"\n[[{where}]]\n{toml(one, where)}" for one in value]
        else:
            plain.append(f"{key} = {json.dumps(value, ensure_ascii=False)}\n")
    return "".join(plain + nested)
