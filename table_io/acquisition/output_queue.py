"""Output queue: keeps the machine supplied with a lead of checked command and a decay to rest.

Whichever process dies, the queued command ends at rest. The clock of the machine, not the samples
read so far, determines which samples can still be changed.
"""

import math

from table_io.backends import Backend
from table_io.clock import Clock
from table_io.config.calibration import command_to_volts
from table_io.config.rig import OutputConfig
from table_io.excitation.drive import Drive

# Time to compute and transfer a change, on top of the machine's `replace_after`. At most 50 ms may
# pass from the decision to the first changed sample.
DECISION_S = 0.005
MAX_DECAY_TRIES = 5


class BufferUnderrun(Exception):
    """Buffer underrun: the lead ran out, and the machine plays the decay queued behind it."""


class OutputQueue:
    """Queue of the drive into a backend, of which `acquired` samples were read back."""

    def __init__(
        self, backend: Backend, clock: Clock, output: OutputConfig, drive: Drive, block: int
    ) -> None:
        self.backend = backend
        self.clock = clock
        self.drive = drive
        self.acquired = 0
        self._output = output
        self._block = block
        self._started = False
        self._queued_end = 0  # end of the queued samples of the drive; a decay follows
        self._rest_index = 0  # index at which the queued command is at rest

    @property
    def is_decaying(self) -> bool:
        """True once the final decay to rest has begun."""
        return self.drive.decay_start is not None

    @property
    def is_moving(self) -> bool:
        """True from the start of the machine until the drive has come to rest."""
        return self._started and self.acquired < self.drive.rest_start

    def start(self) -> None:
        """Queue the start of the drive and start the machine."""
        self.feed()
        self.backend.start()
        self._started = True

    def change_drive(self, drive: Drive, first: int) -> None:
        """Replace the drive from sample `first` on; `feed` queues it in time."""
        fully_queued = self._queued_end >= self.drive.rest_start  # it stays at rest beyond its end
        self.drive = drive
        self._queued_end = first if fully_queued else min(self._queued_end, first)

    def replace_drive(self, drive: Drive, first: int) -> bool:
        """Queue another drive from sample `first` on at once; False if the machine played past it.

        For changes that are due within milliseconds: nothing has changed if it is too late.
        """
        previous, queued_end = self.drive, self._queued_end
        if first >= previous.rest_start and drive.rest_start == previous.rest_start:
            return True  # at rest already
        if self.has_run_out:
            return False
        self.change_drive(drive, first)
        try:
            self._queue_lead(self.played_samples())
        except ValueError:
            if not self._started:
                raise
            self.drive, self._queued_end = previous, queued_end
            return False
        return True

    def feed(self) -> None:
        """Keep `lead_s` of replaceable drive queued beyond the next block, then a decay to rest.

        BufferUnderrun if this comes too late; `drive` is then the decay that the machine plays.
        """
        rest_start = self.drive.rest_start
        if self._queued_end >= rest_start:
            return
        played = self.played_samples()
        if self.has_run_out:
            raise self._start_underrun_decay()
        if self._queued_end - played >= self._lead_samples:
            return
        try:
            self._queue_lead(played)
        except ValueError:
            if not self._started:
                raise
            # the machine played on while this was transferred
            raise self._start_underrun_decay() from None

    @property
    def is_late(self) -> bool:
        """True if the machine has played more samples than were read."""
        return self.played_samples() > self.acquired

    def samples_until_feed(self) -> float:
        """Return after how many more samples `feed` queues again; inf if all is queued."""
        if self._queued_end >= self.drive.rest_start:
            return math.inf
        return self._queued_end - self.played_samples() - self._lead_samples + 1

    @property
    def has_run_out(self) -> bool:
        """True if the machine can no longer be kept from the decay behind the lead."""
        earliest = self.played_samples() + self.backend.replace_after
        return self._started and self._queued_end < min(earliest, self.drive.rest_start)

    @property
    def _lead_samples(self) -> int:
        """Samples of drive that are queued ahead at least."""
        lead = self._output.lead_samples(self.drive.rate_hz, self.backend.replace_after)
        return lead + self._block

    def _queue_lead(self, played: int) -> None:
        """Queue the drive to twice the lead, then a decay to rest; ValueError if too late."""
        rest_start = self.drive.rest_start
        lead_end = min(played + 2 * self._lead_samples, rest_start)
        self._queue_drive(
            self._queued_end,
            self.drive.decay_from(lead_end) if lead_end < rest_start else self.drive,
        )
        self._queued_end = lead_end

    def _start_underrun_decay(self) -> BufferUnderrun:
        """Switch to the decay behind the lead and return the BufferUnderrun to raise."""
        lag_s = (self.played_samples() - self.acquired) / self.drive.rate_hz
        self._set_decay(self._queued_end)
        return BufferUnderrun(
            f"buffer underrun: the rig was {lag_s:.2f} s behind, its queue ended at sample "
            f"{self.drive.decay_start}, and the table decayed to rest by itself"
        )

    def decay(self) -> None:
        """Replace the queued command by a decay from the first sample that can still be changed.

        If the machine plays past that sample during the transfer, try again from a later one; if
        every try fails, the decay queued behind the lead applies.
        """
        for _ in range(MAX_DECAY_TRIES):
            first = self.first_changeable()
            if first >= self.drive.rest_start:
                self._set_decay(self.drive.rest_start)
                return
            try:
                self._queue_drive(first, self.drive.decay_from(first))
            except ValueError:
                continue
            self._set_decay(first)
            return
        self._set_decay(min(self._queued_end, self.drive.rest_start))

    def _set_decay(self, at: int) -> None:
        self.drive = self.drive.decay_from(at)
        self._queued_end = self.drive.rest_start

    def first_changeable(self) -> int:
        """Return the first sample that a decision made now can change."""
        margin = self.backend.replace_after + math.ceil(DECISION_S * self.drive.rate_hz)
        return self.played_samples() + margin

    def played_samples(self) -> int:
        """Return the number of samples played by the machine so far, at least those read."""
        if not self._started:
            return 0
        elapsed_s = self.clock.now() - self.backend.scheduled_time_s(0)
        return max(self.acquired, math.floor(elapsed_s * self.drive.rate_hz + 1e-6) + 1)

    def _queue_drive(self, first: int, drive: Drive) -> None:
        """Queue a drive from sample `first` until it is at rest."""
        displacement_m = drive.command(first, max(drive.rest_start + 1 - first, 1))
        self.backend.queue(first, command_to_volts(displacement_m, self._output))
        self._rest_index = drive.rest_start

    def bring_to_rest(self) -> None:
        """Decay to rest and wait for it if the table still moves."""
        if not self.is_moving:
            return
        try:
            if not self.is_decaying:
                self.decay()
            while self.acquired < self.drive.rest_start:
                count = min(200, self.drive.rest_start - self.acquired)
                self.backend.read(count)
                self.acquired += count
        except BaseException:
            self.wait_for_rest()
            raise

    def wait_for_rest(self) -> None:
        """Wait until a machine that no longer answers has played its queue, which ends at rest."""
        if self._started:
            self.clock.wait_until(self.backend.scheduled_time_s(self._rest_index))
        self._started = False
