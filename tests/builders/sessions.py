"""Sessions on the simulated table, as fast as it computes."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import TypeVar

import numpy as np

from table_io.acquisition.session import OperatorCommand, SessionSetup, find_take_back, run_session
from table_io.backends import Backend, open_backend
from table_io.block import Block, Float1D, join_blocks
from table_io.clock import ManualClock
from table_io.config.calibration import command_to_volts, compute_tare, measure_noise, volts_to_si
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.excitation.trajectory import plan_sweep
from table_io.records import Event, FrequencyResponse, Record, RunStart, RunStop
from table_io.safety.findings import Finding
from table_io.safety.protection import Observation, inspect_samples, set_response, start_protection
from table_io.sim.simulated_table import SimulatedBackend
from tests.builders.rigs import RIG

AT_RANGE_SHARE = 0.999  # of the range of a sensor: at it
COARSE_BLOCK = 200  # samples
T = TypeVar("T")


def make_start(
    tare: dict[str, float] | None = None,
    epoch_s: float = 0.0,
    rate_hz: float = 2000.0,
    channels: tuple[str, ...] = (),
    profile: Profile | None = None,
) -> RunStart:
    """Return the first record of a run, empty where a test does not look."""
    return RunStart(
        index=0,
        run="run",
        name="short",
        source="table",
        profile_toml="",
        rig_toml="",
        model_toml="",
        rate_hz=rate_hz,
        block_samples=20,
        channels=channels,
        steps=() if profile is None else profile.steps,
        planned_samples=0,
        tare=tare or {},
        versions={},
        host="",
        started_at="",
        epoch_s=epoch_s,
    )


@dataclass(frozen=True)
class PlayedSession:
    """Everything that a session yielded, in order."""

    items: list[Block | Record]

    def select(self, kind: type[T]) -> list[T]:
        """Return the records, or the blocks, of one kind."""
        return [item for item in self.items if isinstance(item, kind)]

    def select_events(self, kind: str) -> list[Event]:
        """Return the events of one kind."""
        return [event for event in self.select(Event) if event.kind == kind]

    @cached_property
    def block(self) -> Block:
        """All samples as one block; refuses holes and overlaps."""
        return join_blocks(self.select(Block))

    @property
    def command_m(self) -> Float1D:
        """The command of every sample."""
        return self.block.channel("drive_disp_m")

    @property
    def mass_m(self) -> Float1D:
        """The displacement of the mass at every sample."""
        return self.block.channel("mass_disp_m")

    @property
    def stop(self) -> RunStop:
        """The last record."""
        stop = self.items[-1]
        assert isinstance(stop, RunStop)
        return stop


def play_session(
    profile: Profile,
    stop_s: float = math.inf,
    rig: RigConfig = RIG,
    operate: Callable[[], OperatorCommand | None] = lambda: None,
    clock: ManualClock | None = None,
    backend: Backend | None = None,
    joins_blocks: bool = False,
) -> PlayedSession:
    """Play a whole session, unpaced; it is stopped by the operator after `stop_s` of samples.

    `joins_blocks`: as in an unpaced run, where the blocks up to the next decision are one.
    """
    clock = clock or ManualClock()
    backend = backend or open_backend(rig, profile, clock)
    items: list[Block | Record] = []
    end = 0

    def describe(tare: dict[str, float], epoch_s: float) -> RunStart:
        return make_start(tare, epoch_s, backend.rate_hz, rig.channels, profile)

    def order() -> OperatorCommand | None:
        return OperatorCommand("stop", "time") if end > stop_s * backend.rate_hz else operate()

    take_back = find_take_back(backend, clock) if joins_blocks else None
    setup = SessionSetup(profile, rig)
    for item in run_session(setup, backend, clock, describe, order, take_back=take_back):
        end = item.end if isinstance(item, Block) else end
        items.append(item)
    return PlayedSession(items)


@dataclass
class GuardedDrive:
    """Findings of protection, each with the number of samples that were read when it was known."""

    samples: int = 0
    timed_findings: list[tuple[int, Finding]] = field(default_factory=list)

    @property
    def findings(self) -> list[Finding]:
        """The findings alone."""
        return [finding for _, finding in self.timed_findings]

    def findings_since(self, sample: int) -> list[tuple[int, Finding]]:
        """Return the findings that were known after a sample."""
        return [entry for entry in self.timed_findings if entry[0] > sample]


def play_guarded(
    profile: Profile,
    rig: RigConfig,
    response: FrequencyResponse | None = None,
    stop_after: int | None = None,
) -> GuardedDrive:
    """Play the uncorrected sweep on the simulated table under protection, whatever is found.

    It ends at the first finding that is known after sample `stop_after`.
    """
    drive = plan_sweep(profile)
    rate = drive.rate_hz
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
    played = GuardedDrive()
    while played.samples < drive.rest_start + round(0.3 * rate):
        # What is found does not depend on the blocks; when it is known does.
        is_timed = stop_after is not None and played.samples + COARSE_BLOCK > stop_after
        block = profile.acquisition.block_samples if is_timed else COARSE_BLOCK
        volts, first = backend.read(block), played.samples
        values = volts_to_si(volts, rig.sensors, tare)
        acquired = Block("meas", first, rate, rig.channels, values, *drive.labels(first, block))
        at_range = np.abs(volts) >= AT_RANGE_SHARE * full
        guard, findings = inspect_samples(guard, Observation.from_drive(acquired, at_range, drive))
        played.samples += block
        played.timed_findings += [(played.samples, finding) for finding in findings]
        if stop_after is not None and played.findings_since(stop_after):
            break
    return played
