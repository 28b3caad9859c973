"""A drive played on the simulated table under protection: the smallest session there is."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from table_io.backends import MachineLost
from table_io.backends.simulated import SimulatedBackend
from table_io.block import Block
from table_io.calibration import command_to_volts, noise_from, tare_from, to_si
from table_io.card import PROFILES, load
from table_io.clock import ManualClock
from table_io.drive import Drive
from table_io.profile import Profile
from table_io.protection import Finding, Guard, Seen, begin, identified, inspect
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
    """What came of it: findings, the sample at which each was known, and how it ended."""

    drive: Drive
    findings: list[Finding] = field(default_factory=list)
    known_at: list[int] = field(default_factory=list)
    lost_at: int | None = None
    guard: Guard | None = None
    table_m: list[float] = field(default_factory=list)

    @property
    def stop(self) -> Finding | None:
        return next((one for one in self.findings if one.stop), None)


def play(
    profile: Profile,
    rig: Rig,
    drive: Drive,
    block: int = 20,
    response: Response | None = None,
    until: int | None = None,
) -> Played:
    """Plays a drive; the first finding that must stop decays it to rest."""
    rate, clock = drive.rate_hz, ManualClock()
    backend = SimulatedBackend(rig, profile.specimen, rate, clock)
    backend.open()
    volts = backend.tare(int(rate))
    tare = tare_from(volts, rig.sensors)
    guard = begin(profile, rig, noise_from(volts, rig.sensors))
    if response is not None:
        guard = identified(guard, response)
    full = np.array([[abs(one.range_si * one.volts_per_si)] for one in rig.sensors])
    metres = drive.command(0, drive.rest_from + 1)
    backend.queue(0, command_to_volts(metres, rig.output))
    backend.start()
    out, at, rest = Played(drive), 0, round(0.3 * rate)
    while at < min(out.drive.rest_from + rest, until or 2**62):
        try:
            volts = backend.read(block)
        except MachineLost:
            out.lost_at = at
            break
        labels = out.drive.labels(at, block)
        values = to_si(volts, rig.sensors, tare)
        seen = Block("meas", at, rate, rig.channels, values, *labels)
        guard, found = inspect(guard, Seen.of(seen, np.abs(volts) >= RANGE * full, out.drive))
        at += block
        for one in found:
            if one.stop and out.stop is None:
                taken = round((clock.now() - backend.scheduled(0)) * rate)
                first = max(at, taken) + backend.replace_after + round(0.005 * rate)
                out.drive = out.drive.decayed(first)
                metres = out.drive.command(first, max(out.drive.rest_from + 1 - first, 1))
                backend.queue(first, command_to_volts(metres, rig.output))
            out.findings.append(one)
            out.known_at.append(at)
    out.guard = guard
    return out
