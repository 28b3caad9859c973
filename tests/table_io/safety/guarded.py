"""A drive played on the simulated table under protection: the smallest session there is."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from table_io.block import Block
from table_io.clock import ManualClock
from table_io.config.base import PROFILES_DIR, load_config
from table_io.config.calibration import command_to_volts, compute_tare, measure_noise, volts_to_si
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.excitation.trajectory import plan_sweep
from table_io.records import FrequencyResponse
from table_io.safety.protection import (
    Finding,
    Observation,
    inspect_samples,
    set_response,
    start_protection,
)
from table_io.sim.simulated_table import SimulatedBackend

RIG = load_config(PROFILES_DIR / "rigs" / "simulated.toml", RigConfig, "machine card")[0]
AT_RANGE_SHARE = 0.999  # of a sensor's range: at it


def machine(
    faults: tuple[dict[str, Any], ...] = (), noise: float = 1.0, **simulated: Any
) -> RigConfig:
    """The machine card with planted faults, other noise, other values in [simulated]."""
    raw = RIG.model_dump()
    raw["simulated"].update(simulated, faults=faults)
    for sensor in raw["sensors"]:
        sensor["noise_rms"] *= noise
    return RigConfig.model_validate(raw)


@dataclass
class Played:
    """What came of it: the findings, and the sample up to which was read when each was known."""

    samples: int = 0
    findings: list[tuple[int, Finding]] = field(default_factory=list)

    def since(self, sample: int) -> list[tuple[int, Finding]]:
        return [entry for entry in self.findings if entry[0] > sample]


def play(
    profile: Profile,
    rig: RigConfig,
    response: FrequencyResponse | None = None,
    until: int | None = None,
    stop_after: int | None = None,
) -> Played:
    """The uncorrected sweep, whatever is found; up to sample `until`, or to the first finding that
    is known after sample `stop_after`.
    """
    drive = plan_sweep(profile)
    rate, block = drive.rate_hz, profile.acquisition.block_samples
    backend = SimulatedBackend(rig, profile.specimen, rate, ManualClock())
    backend.open()
    volts = backend.tare(int(rate))
    tare = compute_tare(volts, rig.sensors)
    guard = start_protection(profile, rig, measure_noise(volts, rig.sensors))
    if response is not None:
        guard = set_response(guard, response)
    full = np.array([[abs(sensor.range_si * sensor.volts_per_si)] for sensor in rig.sensors])
    backend.queue(0, command_to_volts(drive.command(0, drive.rest_start + 1), rig.output))
    backend.start()
    out = Played()
    while out.samples < (until or drive.rest_start + round(0.3 * rate)):
        volts, at = backend.read(block), out.samples
        values = volts_to_si(volts, rig.sensors, tare)
        acquired = Block("meas", at, rate, rig.channels, values, *drive.labels(at, block))
        guard, findings = inspect_samples(
            guard, Observation.from_drive(acquired, np.abs(volts) >= AT_RANGE_SHARE * full, drive)
        )
        out.samples += block
        out.findings += [(out.samples, finding) for finding in findings]
        if stop_after is not None and out.since(stop_after):
            break
    return out
