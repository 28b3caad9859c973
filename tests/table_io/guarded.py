"""A drive played on the simulated table under protection: the smallest session there is."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from table_io.backends.simulated import SimulatedBackend
from table_io.block import Block
from table_io.calibration import command_to_volts, noise_from, tare_from, to_si
from table_io.card import PROFILES, load
from table_io.clock import ManualClock
from table_io.course import plan
from table_io.profile import Profile
from table_io.protection import Finding, Seen, begin, identified, inspect
from table_io.records import Response
from table_io.rig import Rig

RIG = load(PROFILES / "rigs" / "simulated.toml", Rig, "machine card")[0]
RANGE = 0.999  # of a sensor's range: at it


def machine(faults: tuple[dict[str, Any], ...] = (), noise: float = 1.0, **simulated: Any) -> Rig:
    """The machine card with planted faults, other noise, other values in [simulated]."""
    raw = RIG.model_dump()
    raw["simulated"].update(simulated, faults=faults)
    for sensor in raw["sensors"]:
        sensor["noise_rms"] *= noise
    return Rig.model_validate(raw)


@dataclass
class Played:
    """What came of it: the findings, and the sample up to which was read when each was known."""

    samples: int = 0
    findings: list[tuple[int, Finding]] = field(default_factory=list)

    def since(self, sample: int) -> list[tuple[int, Finding]]:
        return [one for one in self.findings if one[0] > sample]


def play(
    profile: Profile,
    rig: Rig,
    response: Response | None = None,
    until: int | None = None,
    stop_after: int | None = None,
) -> Played:
    """The uncorrected sweep, whatever is found; up to sample `until`, or to the first finding that
    is known after sample `stop_after`.
    """
    drive = plan(profile)
    rate, block = drive.rate_hz, profile.acquisition.block_samples
    backend = SimulatedBackend(rig, profile.specimen, rate, ManualClock())
    backend.open()
    volts = backend.tare(int(rate))
    tare = tare_from(volts, rig.sensors)
    guard = begin(profile, rig, noise_from(volts, rig.sensors))
    if response is not None:
        guard = identified(guard, response)
    full = np.array([[abs(one.range_si * one.volts_per_si)] for one in rig.sensors])
    backend.queue(0, command_to_volts(drive.command(0, drive.rest_from + 1), rig.output))
    backend.start()
    out = Played()
    while out.samples < (until or drive.rest_from + round(0.3 * rate)):
        volts, at = backend.read(block), out.samples
        values = to_si(volts, rig.sensors, tare)
        seen = Block("meas", at, rate, rig.channels, values, *drive.labels(at, block))
        guard, found = inspect(guard, Seen.of(seen, np.abs(volts) >= RANGE * full, drive))
        out.samples += block
        out.findings += [(out.samples, one) for one in found]
        if stop_after is not None and out.since(stop_after):
            break
    return out
