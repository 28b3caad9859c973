"""Following a controller that plays our drive file by itself: the session beside `session.play`.

A generator as `play` is, of the same Blocks and records, but nothing is commanded: the drive is
found in the measured command, each sample is labelled by its place in it, and what would stop the
table is said. The table cannot be stopped from here.

States: idle, checking, waiting, following, astray, at rest (or left, in motion), fault.
"""

from collections.abc import Iterator

import numpy as np

from table_io import conductor as conducting
from table_io.backends import MachineLost, Source
from table_io.backends.follow.follower import REST, Follower, advance, ended, taken
from table_io.backends.follow.words import aligned, refuse_motion
from table_io.block import Block, Bool2D, Float1D, Float2D
from table_io.calibration import tare_from, to_si
from table_io.card import BadInput
from table_io.clock import Clock, today
from table_io.drive import Drive
from table_io.due import overdue
from table_io.policies import policy_of
from table_io.profile import Profile
from table_io.records import RunStop, Trip
from table_io.rig import Rig
from table_io.session import (
    TAIL_FACTOR,
    TARE_S,
    Commands,
    Describe,
    Order,
    Punctuality,
    Said,
    Setup,
    gaps,
)
from table_io.telling import Telling
from table_io.wiring.follow import FollowWiring
from table_io.witness import ELSEWHERE, Witness, span

PARTING_S = 10.0  # after a stop was asked for, until the recording ends in any case


def planned(profile: Profile, rig: Rig) -> Drive:
    """The drive that a controller is given: open loop, the loop check included.

    BadInput for a test that decides while it runs how it goes on.
    """
    score = conducting.score(profile, rig)
    if policy_of(profile) is not None:
        raise BadInput(
            "a test with [dwell], [track] or [refine] decides while it runs where it goes; a file "
            "that another controller plays cannot. Leave that table out of the profile"
        )
    return conducting.rehearsed(score)


def follow(
    setup: Setup,
    source: Source,
    clock: Clock,
    describe: Describe,
    commands: Commands,
    punctuality: Punctuality | None = None,
) -> Said:
    """RunStart, then every Block from the start of the acquisition on, its records, then RunStop.

    A block is as late as its acquisition: until the drive is found, some are held back for labels.
    """
    run = _Following(setup, source, clock)
    try:
        yield describe(run.begin(), source.scheduled(0))
        yield from run.telling.told()
        while not run.over:
            late_s = run.acquire()
            run.telling.late(late_s, run.end)
            for block, clipped in run.labelled():
                if punctuality is not None:
                    punctuality.late_s.append(late_s)
                yield block
                yield from gaps(block, clipped)
                run.judge(block, clipped)
            run.obey(commands())
            yield from run.telling.told()
        run.finish()
    except MachineLost as error:
        run.lost(str(error))
    finally:
        source.close()
    for block, clipped in run.rest():
        if punctuality is not None:
            punctuality.late_s.append(0.0)
        yield block
        yield from gaps(block, clipped)
    yield from run.telling.told()
    yield RunStop(run.given, run.verdict, run.reason, tuple(run.telling.states))


class _Following:
    """The moving part: what was acquired, the follower, the guard, the state."""

    def __init__(self, setup: Setup, source: Source, clock: Clock) -> None:
        profile, rig = setup.profile, setup.rig
        self.setup, self.source, self.clock = setup, source, clock
        self.rate_hz = profile.acquisition.rate_hz
        self.drive = planned(profile, rig)
        self.wiring = rig.follow or FollowWiring()
        self.verdict, self.reason = "complete", "the whole drive was played"
        self.given = 0  # samples that were handed on
        self.over = False
        self._rest = round(profile.acquisition.rest_s * self.rate_hz)
        self._longest = self.drive.rest_from + self._rest
        self._lost = 0  # samples of the command
        self._full = np.array([abs(s.range_si * s.volts_per_si) for s in rig.sensors])
        self._row = rig.channels.index(self.wiring.command)
        self._held = np.empty((len(rig.channels), 0))  # volts that were not handed on
        self._tare: dict[str, float] = {}
        self._follower = Follower(self.drive, self.rate_hz, 0.0, 0.0)
        self._places, self._last = np.empty(0, dtype=np.int64), REST
        self._stop_by: int | None = None
        self.telling = Telling(lambda: self.given)
        self._swept = False

    def begin(self) -> dict[str, float]:
        """Open, tare, start to acquire; the tare in SI."""
        self.telling.to("checking")
        for sentence in overdue(self.setup.rig, today().date()):
            self.telling.say("calibration", sentence)
        self.source.open()
        volts = self.source.tare(int(TARE_S * self.rate_hz))
        self._witness = Witness(self.setup, volts)
        self._tare = tare_from(volts, self.setup.rig.sensors)
        sensor = self.setup.rig.sensors[self._row]
        refuse_motion(self._command(volts), sensor, self.drive, self.rate_hz)
        lsb, noise = 2 * sensor.range_si / 2**sensor.bits, self._witness.noise.get(sensor.channel)
        self._follower = Follower(self.drive, self.rate_hz, noise or 0.0, lsb)
        self.source.start()
        self.telling.to("waiting")
        self.telling.say("clock", f"{self.source.clock_says}; the controller's own runs beside it")
        if not self._witness.guards:
            self.telling.say("follow", "no command is wired: protection and loop check are off")
        if self.wiring.command == "table_disp_m":
            self.telling.say(
                "follow", "the drive is looked for in table_disp_m, which lags behind it"
            )
        text = f"play the drive file on the controller NOW; waiting for {self.wiring.wait_s:g} s"
        self.telling.say("follow", text)
        return self._tare

    @property
    def end(self) -> int:
        """Samples that have been acquired."""
        return self.given + self._held.shape[1]

    def acquire(self) -> float:
        """Take the next block and follow it; how late it came, s."""
        volts = self.source.read(self.setup.profile.acquisition.block_samples)
        self._held = np.concatenate([self._held, volts], axis=1)
        end = self.end
        late_s = self.clock.now() - self.source.scheduled(end - 1)
        before = self._follower
        command = self._command(volts)
        self._lost += int(np.isnan(command).sum())
        self._follower = now = advance(before, command)
        if now.onset is not None and before.onset is None:
            self.telling.say("motion", "something moves: looking for the drive in it")
        if now.state != before.state:
            self._turned(now)
        self._end_if_due(end)
        return late_s

    def _command(self, volts: Float2D) -> Float1D:
        """The measured command in m, (sample,)."""
        row = slice(self._row, self._row + 1)
        return to_si(volts[row], self.setup.rig.sensors[row], self._tare)[0]

    def _turned(self, now: Follower) -> None:
        """The follower has found the drive, or lost it."""
        if now.state == "playing":
            self.telling.to("following")
            self.telling.say("aligned", aligned(self._follower))
            return
        self.telling.to("astray")
        if self._stop_by is None:  # else it is what was asked for
            self.verdict = "aborted"
            self.reason = f"the controller does not play the drive: {now.why}"
            text, where = f"{self.reason}; the recording goes on until rest", self.wiring.command
            self.telling.said.append(
                Trip(now.left_at, now.done, "plan", where, *now.beside_m, text)
            )
        if now.places.size and now.fit is not None:
            self.drive = self.drive.decayed(int(now.places[0]))

    def _end_if_due(self, end: int) -> None:
        """See whether there is anything left to wait for."""
        now, state = self._follower, self._follower.state
        if state == "waiting" and now.onset is None and end > self.wiring.wait_s * self.rate_hz:
            self.verdict = "aborted"
            self.reason = f"nothing was played within {self.wiring.wait_s:g} s"
            if self._lost > end / 2:
                self.reason = "the command was lost, so it is not known whether it was played"
            self.over = True
        elif state in ("left", "other"):
            self.over = now.quiet and end - now.left_at > 2 * self.rate_hz
            if not now.quiet and end > (now.onset or now.left_at) + self._longest:
                self.over = True
                text = f"{self.wiring.command} still moves, or cannot be told from its noise"
                self.telling.say("stop", f"{text}: the recording ends; {ELSEWHERE}")
        if self._stop_by is not None:
            self.over = self.over or end >= self._stop_by or now.still
            if end >= self._stop_by and not now.still:
                self.telling.say(
                    "stop", f"the recording ends while the table still moves; {ELSEWHERE}"
                )

    def labelled(self) -> Iterator[tuple[Block, Bool2D]]:
        """(block in SI, True where a sample lies at its sensor's range) as far as places are told.

        It ends after the rest behind the drive.
        """
        count = self.setup.profile.acquisition.block_samples
        while min(self._follower.told - self.given, self._held.shape[1]) >= count:
            yield self._next(count)
            if (
                self._follower.state == "playing"
                and self._last >= self.drive.rest_from + self._rest
            ):
                self.over = True

    def rest(self) -> Iterator[tuple[Block, Bool2D]]:
        """The blocks that were held back when the end came."""
        if self._held.size:
            self._follower = ended(self._follower)
        most = self.setup.profile.acquisition.block_samples
        while count := min(self._held.shape[1], most):
            yield self._next(count)

    def _next(self, count: int) -> tuple[Block, Bool2D]:
        volts, self._held = self._held[:, :count], self._held[:, count:]
        self._follower, places = taken(self._follower, count)
        self._places, self._last = places, int(places[-1])
        rig = self.setup.rig
        first, samples, at = span(places)
        labels = (row[at] for row in self.drive.labels(first, samples))
        values = to_si(volts, rig.sensors, self._tare)
        block = Block("meas", self.given, self.rate_hz, rig.channels, values, *labels)
        self.given = block.end
        return block, np.abs(volts) >= TAIL_FACTOR * self._full[:, None]

    def judge(self, block: Block, clipped: Bool2D) -> None:
        """Hold a block against the drive, and say where the sweep begins."""
        seen = block, clipped, self._places, self.drive
        self.telling.said.extend(self._witness.protect(*seen))
        if self._follower.state != "playing":
            return
        self.telling.said.extend(self._witness.check(block, self._places, self.drive))
        if not self._swept and block.step[-1] >= 0:
            self._swept = True
            self.telling.say("aligned", aligned(self._follower))

    def obey(self, order: Order | None) -> None:
        """Say that nothing can be done from here; after a stop the recording ends."""
        if order is None or self._stop_by is not None:
            return
        if order.name in ("hold", "resume"):
            self.telling.say(
                "refused", f"{order.name}: the controller plays by itself, do it there"
            )
            return
        self.verdict = "stopped" if order.name == "stop" else "aborted"
        self.reason = order.why
        self.telling.say(
            "stop", f"{order.why}: STOP THE TABLE AT ITS CONTROLLER, it cannot be done here"
        )
        self._stop_by = self.end + round(PARTING_S * self.rate_hz)

    def finish(self) -> None:
        """The last words of a recording that came to its end."""
        if self._follower.fit is not None:
            self.telling.say("aligned", aligned(self._follower))
        if self._witness.tripped and self.verdict == "complete":
            self.reason += "; protection would have stopped it, see the trip"
        self.telling.to("at rest" if self._follower.quiet else "left")

    def lost(self, why: str) -> None:
        """The last words of a recording whose device no longer answers."""
        self.telling.to("fault")
        end = self.end
        self.telling.said.append(Trip(end, end, "machine", "", 0.0, 0.0, why))
        self.verdict, self.reason = "halted", why
