"""The rig's loop: a generator that plays a test on a backend and yields Blocks and records.

States: idle, checking, armed, running, holding, stopping, at rest, fault. Every way to end decays
the command to rest: it is always queued to end there, so the decay also plays if this process dies.
"""

from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from table_io import conductor as conducting
from table_io import protection
from table_io.backends import Backend, MachineLost
from table_io.block import Block, Bool2D
from table_io.calibration import noise_from, tare_from, to_si
from table_io.clock import Clock, today
from table_io.due import overdue
from table_io.player import Player, Starved
from table_io.profile import Profile
from table_io.records import Gap, Record, Response, RunStart, RunStop, Trip
from table_io.rig import Rig
from table_io.telling import Telling

TARE_S = 1.0
ORDER_S = 0.1  # beyond the first sample that could change: hold and resume are not urgent
TAIL_FACTOR = 0.999  # of a sensor's range: beyond it a sample counts as clipped


@dataclass(frozen=True, slots=True)
class Setup:
    """What a session plays, and on what machine."""

    profile: Profile
    rig: Rig


@dataclass(frozen=True, slots=True)
class Order:
    """What a person, or who watches for one, asks of a session."""

    name: str  # hold, resume, stop, abort
    why: str


@dataclass(slots=True)
class Punctuality:
    """Lateness of each block in s: from its last sample's schedule to when it is handed on."""

    late_s: list[float] = field(default_factory=list)


Describe = Callable[[dict[str, float], float], RunStart]  # (tare, epoch_s) -> start record
Commands = Callable[[], Order | None]  # must not wait
Said = Generator[Block | Record, None, None]
ORDERS = ("hold", "resume", "stop", "abort")


def play(
    setup: Setup,
    backend: Backend,
    clock: Clock,
    describe: Describe,
    commands: Commands,
    punctuality: Punctuality | None = None,
) -> Said:
    """RunStart, then every Block with the records that belong to it, then RunStop.

    Closing the generator early also brings the table to rest before the machine is released.
    """
    run = _Run(setup, backend, clock)
    try:
        tare = run.begin()
        yield describe(tare, backend.scheduled(0))
        yield from run.telling.told()
        while not run.over:
            block, clipped = run.acquire(tare)
            late_s = clock.now() - backend.scheduled(block.end - 1)
            if punctuality is not None:
                punctuality.late_s.append(late_s)
            yield block
            yield from gaps(block, clipped)
            run.telling.late(late_s, block.end)
            run.protect(block, clipped)
            run.conduct(block)
            run.obey(commands())
            run.feed()
            yield from run.telling.told()
        yield from run.finish()
    except MachineLost as error:
        yield from run.lost(str(error))
    finally:
        try:
            run.player.to_rest()
        finally:
            backend.close()


class _Run:
    """The moving part of a session: its player, its conductor, its guard, its state."""

    def __init__(self, setup: Setup, backend: Backend, clock: Clock) -> None:
        profile = setup.profile
        self.setup = setup
        self.rate_hz = profile.acquisition.rate_hz
        score = conducting.score(profile, setup.rig, backend.replace_after)
        self._now = conducting.start(score)
        block = profile.acquisition.block_samples
        self.player = Player(backend, clock, setup.rig.output, self._now.drive, block)
        self.verdict, self.reason = "complete", "the whole drive was played"
        self._rest = round(profile.acquisition.rest_s * self.rate_hz)
        self._full = np.array([abs(s.range_si * s.volts_per_si) for s in setup.rig.sensors])
        self.telling = Telling(lambda: self.player.acquired)

    @property
    def end(self) -> int | None:
        """Sample at which the recording ends, the servo at rest too; None while it is not known."""
        known = self._now.over or self._now.stage.kind == "open" or self.player.decaying
        return self.player.drive.rest_from + self._rest if known else None

    @property
    def over(self) -> bool:
        return self.end is not None and self.player.acquired >= self.end

    def begin(self) -> dict[str, float]:
        """Open, tare, start the machine; the tare in SI."""
        self.telling.to("checking")
        for sentence in overdue(self.setup.rig, today().date()):
            self.telling.say("calibration", sentence)
        backend, sensors = self.player.backend, self.setup.rig.sensors
        backend.open()
        volts = backend.tare(int(TARE_S * self.rate_hz))
        noise = noise_from(volts, sensors)
        self._guard = protection.begin(self.setup.profile, self.setup.rig, noise)
        self._now = replace(self._now, noise={name: rms for name, (rms, _) in noise.items()})
        if self._now.stage.kind != "check":
            self.telling.to("armed")
        self.player.start()
        return tare_from(volts, sensors)

    def acquire(self, tare: dict[str, float]) -> tuple[Block, Bool2D]:
        """(the next block in SI, True where a sample lies at its sensor's range)."""
        rig, first = self.setup.rig, self.player.acquired
        count = self.setup.profile.acquisition.block_samples
        if self.end is not None:
            count = min(count, self.end - first)
        volts = self.player.backend.read(count)
        labels = self.player.drive.labels(first, count)
        values = to_si(volts, rig.sensors, tare)
        self.player.acquired += count
        block = Block("meas", first, self.rate_hz, rig.channels, values, *labels)
        return block, np.abs(volts) >= TAIL_FACTOR * self._full[:, None]

    def protect(self, block: Block, clipped: Bool2D) -> None:
        """Look at a block; the first finding that must stop the table is latched."""
        seen = protection.Seen.of(block, clipped, self.player.drive)
        self._guard, findings = protection.inspect(self._guard, seen)
        for one in findings:
            if not one.stop:
                self.telling.said.append(one.event())
            elif not self.player.decaying:
                self.telling.said.append(one.trip(block.end))
                self.stop("aborted", one.text)

    def conduct(self, block: Block) -> None:
        """Let the conductor look; what it changes in the drive is queued in its time."""
        if self.player.decaying:
            return
        before = self._now
        self._now, said = conducting.advance(before, block)
        self.telling.said.extend(said)
        for record in said:
            if isinstance(record, Response):
                self._guard = protection.identified(self._guard, record)
        if self._now.drive is not before.drive:
            self.player.change(self._now.drive, self._now.changed)
        if self._now.refused:
            self.verdict, self.reason = "aborted", self._now.refused
        elif before.stage.kind == "check" != self._now.stage.kind:
            self.telling.to("armed")
        if self.telling.states[-1] == "armed" and block.step[-1] >= 0:
            self.telling.to("running")

    def obey(self, order: Order | None) -> None:
        """Do what was asked, where the state allows it."""
        if order is None or self.player.decaying:
            return
        if order.name in ("stop", "abort"):
            self.stop("stopped" if order.name == "stop" else "aborted", order.why)
            return
        before, at = self._now, self.player.changeable() + round(ORDER_S * self.rate_hz)
        change = {"hold": conducting.hold, "resume": conducting.resume}[order.name]
        self._now = change(before, at)
        if self._now is before:
            self.telling.say(
                "refused", f"{order.name} does not apply now ({self.telling.states[-1]})"
            )
            return
        self.player.change(self._now.drive, self._now.changed)
        self.telling.to("holding" if order.name == "hold" else "running")

    def stop(self, verdict: str, reason: str) -> None:
        """Bring the table to rest, for good."""
        self.verdict, self.reason = verdict, reason
        self.telling.to("stopping")
        self.telling.say("stop", f"{reason}; decaying to rest")
        self.player.decay()

    def feed(self) -> None:
        """Keep the machine fed; where that came too late, say so: the table stops by itself."""
        try:
            self.player.feed()
        except Starved as error:
            at = self.player.drive.decay_at or 0
            self.telling.said.append(
                Trip(at, self.player.acquired, "late", "", 0.0, 0.0, f"{error}")
            )
            self.verdict, self.reason = "aborted", str(error)
            self.telling.to("stopping")

    def finish(self) -> Iterator[Record]:
        """The last records of a session that came to rest."""
        if self._now.stage.kind == "open" and not self.player.decaying:
            self.verdict, self.reason = "stopped", "held for an hour without a word"
        self.telling.to("at rest")
        yield from self.telling.told()
        yield RunStop(self.player.acquired, self.verdict, self.reason, tuple(self.telling.states))

    def lost(self, why: str) -> Iterator[Record]:
        """The last records of a session whose machine no longer answers."""
        self.telling.to("fault")
        at = self.player.acquired
        self.telling.said.append(Trip(at, at, "machine", "", 0.0, 0.0, why))
        yield from self.telling.told()
        self.player.wait_out()
        yield RunStop(at, "halted", why, tuple(self.telling.states))


def gaps(block: Block, clipped: Bool2D) -> Iterator[Gap]:
    """A Gap for every stretch of lost or of clipped samples of every channel of the block."""
    if not (clipped.any() or np.isnan(block.values).any()):
        return
    for name, values, at_range in zip(block.channels, block.values, clipped, strict=True):
        for bad, reason in ((np.isnan(values), "lost"), (at_range, "clipped")):
            edges = np.flatnonzero(np.diff(bad, prepend=False, append=False))
            for first, last in edges.reshape(-1, 2).tolist():
                yield Gap(block.index + first, last - first, name, reason)
