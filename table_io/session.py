"""The rig's loop: a generator that plays a drive on a backend and yields Blocks and records.

States: idle, checking, armed, running, stopping, at rest, fault. Every way to end decays the
command to rest: it is always queued to end there, so the decay also plays if this process dies.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from table_io.backends import Backend
from table_io.block import Block, Bool2D
from table_io.calibration import command_to_volts, tare_from, to_si
from table_io.clock import Clock
from table_io.drive import Drive
from table_io.limits import tripped
from table_io.profile import Profile
from table_io.records import Event, Gap, Record, RunStart, RunStop
from table_io.rig import Rig

TARE_S = 1.0
# From the newest sample to the start of a decay. At most 50 ms may pass from the decision to the
# first changed sample, and the first samples of a C2 decay hardly differ from the drive.
DECISION_S = 0.04
TAIL_FACTOR = 0.999  # of a sensor's range: beyond it a sample counts as clipped


@dataclass(frozen=True, slots=True)
class Setup:
    """What a session plays, and on what machine."""

    profile: Profile
    rig: Rig
    drive: Drive


@dataclass(slots=True)
class Punctuality:
    """Lateness of each block in s: from its last sample's schedule to when it is handed on."""

    late_s: list[float] = field(default_factory=list)


Describe = Callable[[dict[str, float], float], RunStart]  # (tare, epoch_s) -> start record
Commands = Callable[[], str | None]  # why to stop, or None; must not wait


def play(
    setup: Setup,
    backend: Backend,
    clock: Clock,
    describe: Describe,
    commands: Commands,
    punctuality: Punctuality | None = None,
) -> Iterator[Block | Record]:
    """RunStart, then every Block with the records that belong to it, then RunStop.

    Closing the generator early also brings the table to rest before the machine is released.
    """
    states = ["idle", "checking"]
    run = _Run(setup, backend)
    try:
        backend.open()
        tare = tare_from(backend.tare(int(TARE_S * setup.drive.rate_hz)), setup.rig.sensors)
        states.append("armed")
        run.feed()
        run.start()
        states.append("running")
        yield describe(tare, backend.scheduled(0))
        verdict, reason = "complete", "the whole drive was played"
        while run.acquired < run.end:
            block, clipped = run.acquire(tare)
            if punctuality is not None:
                punctuality.late_s.append(clock.now() - backend.scheduled(block.end - 1))
            yield block
            yield from _gaps(block, clipped)
            if states[-1] == "running":
                trip = tripped(block, setup.rig)
                asked = commands()
                if trip or asked:
                    verdict = "aborted" if trip else "stopped"
                    reason = trip or asked or ""
                    states.append("stopping")
                    run.stop()
                    yield Event(block.end, "stop", f"{reason}; decaying to rest")
            run.feed()
        states.append("at rest")
        yield RunStop(run.acquired, verdict, reason, tuple(states))
    finally:
        try:
            run.to_rest(clock)
        finally:
            backend.close()


class _Run:
    """The moving part of a session: what has been queued, what has been acquired."""

    def __init__(self, setup: Setup, backend: Backend) -> None:
        self.setup = setup
        self.backend = backend
        self.drive = setup.drive
        self.acquired = 0
        self._playing = False
        self._queued = 0  # samples of the true drive that are queued; a decay follows them
        self._at_rest = 0  # index at which what is queued has come to rest
        self._rest = round(setup.profile.acquisition.rest_s * self.drive.rate_hz)

    @property
    def end(self) -> int:
        """Index at which the recording ends: the drive at rest, the servo too."""
        return self.drive.rest_from + self._rest

    def start(self) -> None:
        """Start the machine; from here on the table has to be brought to rest."""
        self.backend.start()
        self._playing = True

    def _queue(self, first: int, drive: Drive) -> None:
        """Queue a drive from sample `first` to its rest."""
        metres = drive.command(first, drive.rest_from + 1 - first)
        self.backend.queue(first, command_to_volts(metres, self.setup.rig.output))
        self._at_rest = drive.rest_from

    def feed(self) -> None:
        """Keep `lead_s` of checked command queued beyond the next block, then a decay to rest."""
        lead = max(
            round(self.setup.rig.output.lead_s * self.drive.rate_hz), self.backend.replace_after
        )
        lead += self.setup.profile.acquisition.block_samples
        if self._queued - self.acquired >= lead or self._queued >= self.drive.rest_from:
            return
        first, last = self._queued, self.acquired + 2 * lead
        self._queue(first, self.drive.decayed(last))
        self._queued = last

    def stop(self) -> None:
        """Replace what is queued by a decay from the first sample that can still be changed."""
        room = max(round(DECISION_S * self.drive.rate_hz), self.backend.replace_after)
        at = self.acquired + room
        if at >= self.drive.rest_from:
            return
        self.drive = self.drive.decayed(at)
        self._queue(at, self.drive)
        self._queued = self.drive.rest_from

    def acquire(self, tare: dict[str, float]) -> tuple[Block, Bool2D]:
        """(the next block in SI, True where a sample lies at its sensor's range)."""
        rig = self.setup.rig
        count = min(self.setup.profile.acquisition.block_samples, self.end - self.acquired)
        volts = self.backend.read(count)
        full = np.array([abs(one.range_si * one.volts_per_si) for one in rig.sensors])
        step, label, cycle = self.drive.labels(self.acquired, count)
        block = Block(
            "meas",
            self.acquired,
            self.drive.rate_hz,
            rig.channels,
            to_si(volts, rig.sensors, tare),
            step,
            label,
            cycle,
        )
        self.acquired += count
        return block, np.abs(volts) >= TAIL_FACTOR * full[:, None]

    def to_rest(self, clock: Clock) -> None:
        """Decay and wait for rest where the session ends before the table is at rest."""
        if not self._playing or self.acquired >= self.drive.rest_from:
            return
        try:
            self.stop()
            while self.acquired < self.drive.rest_from:
                count = min(200, self.drive.rest_from - self.acquired)
                self.backend.read(count)
                self.acquired += count
        except BaseException:
            # The machine no longer answers. What is queued ends at rest: let it play to there.
            clock.wait_until(self.backend.scheduled(self._at_rest))
            raise


def _gaps(block: Block, clipped: Bool2D) -> Iterator[Gap]:
    """A Gap for every stretch of lost or of clipped samples of every channel of the block."""
    if not (clipped.any() or np.isnan(block.values).any()):
        return
    for name, values, at_range in zip(block.channels, block.values, clipped, strict=True):
        for bad, reason in ((np.isnan(values), "lost"), (at_range, "clipped")):
            edges = np.flatnonzero(np.diff(bad, prepend=False, append=False))
            for first, last in edges.reshape(-1, 2).tolist():
                yield Gap(block.index + first, last - first, name, reason)
