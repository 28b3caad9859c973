"""What a machine has been given to play: a lead of checked command, and behind it a decay to rest.

Whatever dies, what is queued ends at rest. What can still be changed is told by the machine's own
clock, not by what has been read.
"""

import math

from table_io.backends import Backend
from table_io.calibration import command_to_volts
from table_io.clock import Clock
from table_io.drive import Drive
from table_io.rig import Output

# Between now and the start of a decay, beyond what the machine needs: time to compute and to hand
# over. At most 50 ms may pass from the decision to the first changed sample.
DECISION_S = 0.005


TRIES = 5


class Starved(Exception):
    """The lead ran out: this process was away, and the machine plays the decay behind it."""


class Player:
    """The drive on its way into a backend; `acquired` samples have come back."""

    def __init__(
        self, backend: Backend, clock: Clock, output: Output, drive: Drive, block: int
    ) -> None:
        self.backend = backend
        self.clock = clock
        self.drive = drive
        self.acquired = 0
        self._output = output
        self._block = block
        self._started = False
        self._queued = 0  # samples of the true drive that are queued; a decay follows them
        self._at_rest = 0  # index at which what is queued has come to rest

    @property
    def decaying(self) -> bool:
        """True once the drive is on its way to rest for good."""
        return self.drive.decay_at is not None

    @property
    def moving(self) -> bool:
        """True from the start of the machine until the drive has come to rest."""
        return self._started and self.acquired < self.drive.rest_from

    def start(self) -> None:
        """Queue the first of the drive and start the machine."""
        self.feed()
        self.backend.start()
        self._started = True

    def change(self, drive: Drive, first: int) -> None:
        """Another drive from sample `first` on; it is queued when its time comes."""
        whole = self._queued >= self.drive.rest_from  # beyond its end it stays at rest
        self.drive = drive
        self._queued = first if whole else min(self._queued, first)

    def feed(self) -> None:
        """Keep `lead_s` of the drive queued that can still be changed, beyond the next block, then
        a decay to rest.

        Starved where that comes too late; the drive is then what the machine plays instead.
        """
        rest_from = self.drive.rest_from
        if self._queued >= rest_from:
            return
        reached = self.reached()
        if self._started and self._queued < reached + self.backend.replace_after:
            raise self._starved()
        lead = round(self._output.lead_s * self.drive.rate_hz)
        lead += self.backend.replace_after + self._block
        if self._queued - reached >= lead:
            return
        last = min(reached + 2 * lead, rest_from)
        try:
            self._queue(self._queued, self.drive.decayed(last) if last < rest_from else self.drive)
        except ValueError:
            if not self._started:
                raise
            # the machine's clock ran on while this was on its way
            raise self._starved() from None
        self._queued = last

    def _starved(self) -> Starved:
        """What to raise once the machine plays the decay behind the lead."""
        behind = (self.reached() - self.acquired) / self.drive.rate_hz
        self._decaying(self._queued)
        return Starved(
            f"the rig was {behind:.2f} s behind: its queue ended at sample "
            f"{self.drive.decay_at}, and the table decayed to rest by itself"
        )

    def decay(self) -> None:
        """Replace what is queued by a decay from the first sample that can still be changed.

        Where the machine's clock runs on while that is on its way, once more from then on; where it
        always does, the decay that is queued behind the lead has to do.
        """
        for _ in range(TRIES):
            at = self.changeable()
            if at >= self.drive.rest_from:
                self._decaying(self.drive.rest_from)
                return
            try:
                self._queue(at, self.drive.decayed(at))
            except ValueError:
                continue
            self._decaying(at)
            return
        self._decaying(min(self._queued, self.drive.rest_from))

    def _decaying(self, at: int) -> None:
        self.drive = self.drive.decayed(at)
        self._queued = self.drive.rest_from

    def changeable(self) -> int:
        """The first sample that a decision of now can change."""
        room = self.backend.replace_after + math.ceil(DECISION_S * self.drive.rate_hz)
        return self.reached() + room

    def reached(self) -> int:
        """Samples that the machine has taken by now; at least those that were read."""
        if not self._started:
            return 0
        since = self.clock.now() - self.backend.scheduled(0)
        return max(self.acquired, math.floor(since * self.drive.rate_hz + 1e-6) + 1)

    def _queue(self, first: int, drive: Drive) -> None:
        """Queue a drive from sample `first` to its rest."""
        metres = drive.command(first, max(drive.rest_from + 1 - first, 1))
        self.backend.queue(first, command_to_volts(metres, self._output))
        self._at_rest = drive.rest_from

    def to_rest(self) -> None:
        """Decay and wait for rest where the table still moves."""
        if not self.moving:
            return
        try:
            if not self.decaying:
                self.decay()
            while self.acquired < self.drive.rest_from:
                count = min(200, self.drive.rest_from - self.acquired)
                self.backend.read(count)
                self.acquired += count
        except BaseException:
            self.wait_out()
            raise

    def wait_out(self) -> None:
        """Let a machine that no longer answers play what is queued: it ends at rest."""
        if self._started:
            self.clock.wait_until(self.backend.scheduled(self._at_rest))
        self._started = False
