"""Backend for a real-time target with the UDP packets of PACKETS.md.

Packets may be lost, duplicated, reordered or corrupted in both directions. The rig therefore
repeats every request until the state of the target confirms it, and requests retransmission of
missing samples.
"""

import math
from typing import NoReturn

import numpy as np

from table_io.backends import SAMPLE_TIMEOUT_S, MachineLost
from table_io.backends.command_buffer import find_newest_sample, refuse_late_command
from table_io.backends.udp.packets import (
    ANSWER_TIMEOUT_S,
    REASON_TEXTS,
    RING_SAMPLES,
    VALUES_PER_PACKET,
    Bool1D,
    PacketKind,
    Phase,
    QueueVerdict,
    Reason,
    RigPacket,
    TargetState,
    UdpLink,
    UdpWiring,
    query_target,
    rig_checksum,
    sequence_difference,
)
from table_io.block import Float1D, Float2D
from table_io.clock import Clock
from table_io.config.profile import Specimen
from table_io.config.rig import RigConfig
from table_io.errors import InputError

MAX_AHEAD_SAMPLES = 1 << 18  # samples kept ahead of the next one to return
WINDOW_PIECES = 32  # pieces in flight: what a small receive buffer holds
RESEND_S = 0.002  # after which an unconfirmed piece is sent again
CLOCK_WINDOW_S = 1.0  # over which the target's clock is compared with that of the rig


class ReceiveBuffer:
    """Reassembly buffer of received samples, from the next one to return; missing ones are NaN."""

    def __init__(self, channels: int, first: int = 0) -> None:
        self.first = first  # next sample to return
        self.complete = first  # all samples before it have arrived or are lost
        self.end = first  # after the newest sample received
        self._values = np.full((channels, 0), np.nan)
        self._resolved = np.zeros(0, dtype=np.bool_)

    def put(self, index: int, values: Float2D) -> None:
        """Insert samples, (channel, sample), from `index` on; any order, repetitions allowed."""
        end = index + values.shape[1]
        if end <= self.complete or end - self.first > MAX_AHEAD_SAMPLES:
            return
        skip = max(self.first - index, 0)
        self._grow(end)
        span = slice(index + skip - self.first, end - self.first)
        self._values[:, span] = values[:, skip:]
        self._resolved[span] = True
        self.end = max(self.end, end)
        self._advance()

    @property
    def missing(self) -> tuple[int, int] | None:
        """First gap before the newest sample, first .. last - 1; None if there is no gap."""
        if self.end <= self.complete:
            return None
        resolved = self._resolved[self.complete - self.first : self.end - self.first]
        return self.complete, self.complete + int(np.argmax(resolved))

    def give_up(self, index: int) -> None:
        """Mark missing samples before `index` as lost: they stay NaN."""
        if index > self.complete:
            self._grow(index)
            self._resolved[: index - self.first] = True
            self.end = max(self.end, index)
            self._advance()

    def take(self, samples: int) -> Float2D:
        """Remove and return the next samples, (channel, sample)."""
        out = self._values[:, :samples].copy()
        self._values, self._resolved = self._values[:, samples:], self._resolved[samples:]
        self.first += samples
        return out

    def _grow(self, end: int) -> None:
        extra = end - self.first - self._resolved.size
        if extra > 0:
            extra += 1024
            self._values = np.pad(self._values, ((0, 0), (0, extra)), constant_values=np.nan)
            self._resolved = np.pad(self._resolved, (0, extra))

    def _advance(self) -> None:
        resolved = self._resolved[self.complete - self.first :]
        self.complete += int(np.argmin(resolved)) if not resolved.all() else resolved.size


class CommandTransfer:
    """Transfer of one command in pieces, with retransmission of unconfirmed ones."""

    def __init__(self, volts: Float1D) -> None:
        self._volts = volts
        self.arrived = np.zeros(math.ceil(volts.size / VALUES_PER_PACKET), dtype=np.bool_)
        self._sent_s = np.full(self.arrived.size, -math.inf)

    def confirm(self, pieces: Bool1D) -> None:
        """Mark pieces, flags (MAX_PIECES,), as received by the target."""
        self.arrived |= pieces[: self.arrived.size]

    def pop_due(self, now_s: float) -> list[tuple[int, Float1D]]:
        """Return (piece, volts) for each piece to be sent now."""
        in_flight = ~self.arrived & (now_s - self._sent_s < RESEND_S)
        waiting = np.flatnonzero(~self.arrived & ~in_flight)
        pieces = waiting[: max(WINDOW_PIECES - int(in_flight.sum()), 0)]
        self._sent_s[pieces] = now_s
        return [
            (int(p), self._volts[VALUES_PER_PACKET * p : VALUES_PER_PACKET * (p + 1)])
            for p in pieces
        ]


class ClockOffset:
    """Estimate of `epoch_s`, the time of sample 0 in s on the rig's clock, from packet arrivals.

    A packet can only be late, so the earliest of a window is the best estimate. As two clocks drift
    apart (50 ppm are 0.18 s an hour), the estimate is renewed every CLOCK_WINDOW_S.
    """

    def __init__(self, epoch_s: float, now_s: float) -> None:
        self.epoch_s = epoch_s
        self._min_epoch_s = math.inf
        self._window_end_s = now_s + CLOCK_WINDOW_S

    def update(self, newest: int, rate_hz: float, now_s: float) -> None:
        """Update the estimate: a packet at `now_s` reports that sample `newest` was taken."""
        self._min_epoch_s = min(self._min_epoch_s, now_s - newest / rate_hz)
        self.epoch_s = min(self.epoch_s, self._min_epoch_s)
        if now_s >= self._window_end_s:
            self.epoch_s, self._min_epoch_s = self._min_epoch_s, math.inf
            self._window_end_s = now_s + CLOCK_WINDOW_S


HEARTBEAT_PERIOD_S = 0.03  # between heartbeats
RESEND_PERIOD_S = 0.002  # between repetitions of a packet or of a retransmission request
REST_TIMEOUT_S = 30.0  # for the target to come to rest after its previous rig
RELEASE_TIMEOUT_S = 0.2  # for the target to confirm the release


class UdpBackend:
    """Rig's side of one connection to the target."""

    def __init__(self, rig: RigConfig, specimen: Specimen, rate_hz: float, clock: Clock) -> None:
        wiring = rig.require_section("udp", UdpWiring)
        self.channels = rig.channels
        self.rate_hz = rate_hz
        self.replace_after = math.ceil(wiring.replace_after_ms * 1e-3 * rate_hz)
        self._rig = rig
        self._wiring = wiring
        self._specimen = specimen
        self._clock = clock
        self._link: UdpLink | None = None
        self._state = TargetState(Phase.FREE)  # newest state of the target
        self._has_state = False  # any state has arrived
        self._has_news = False  # a state has arrived since this was set to False
        self._started = False
        self._buffer = ReceiveBuffer(len(self.channels))
        self._clock_offset: ClockOffset | None = None
        self._queue_count = 0
        self._loss_reason = ""  # why the target is lost; empty: it is not

    def open(self) -> None:
        """Claim the target, after waiting for it to come to rest."""
        self._rig.check_rate(self.rate_hz)
        query_target(self._wiring, self._clock)
        self._link = UdpLink(self._wiring, self._clock)
        try:
            self._claim(self._link)
        except InputError:
            self.close()
            raise

    def tare(self, samples: int) -> Float2D:
        """Return volts at rest, (channel, sample), from now on."""
        self._require_link()
        self._require(not self._started, "start() was called already; tare before start()")
        self._buffer = ReceiveBuffer(len(self.channels), self._request(PacketKind.BEAT).taken)
        deadline_s = self._clock.now() + samples / self.rate_hz + SAMPLE_TIMEOUT_S
        self._receive_until(self._buffer.first + samples, deadline_s)
        return self._buffer.take(samples)

    def queue(self, index: int, volts: Float1D) -> None:
        """Replace the command from sample `index` on, volts (sample,); the last value is held."""
        self._require_link()
        earliest = self._newest_sample() + self.replace_after if self._started else 0
        refuse_late_command(index, earliest, self.replace_after, "target")
        if not volts.size or not np.isfinite(volts).all():
            raise ValueError(f"the command from sample {index} on is empty or contains NaN or inf")
        if volts.size > RING_SAMPLES:
            raise InputError(
                f"the command from sample {index} on has {volts.size} samples",
                allowed=f"{RING_SAMPLES}, the ring of a UDP target",
                remedy="lower acquisition.rate_hz or output.lead_s",
            )
        self._queue_count += 1
        self._send_command(index, volts, self._queue_count)
        if self._state.verdict is not QueueVerdict.PLAYS:
            raise ValueError(
                f"the target refuses the command from sample {index} on "
                f"({self._state.verdict.name}, {self._state.taken} samples taken)"
            )

    def start(self) -> None:
        """Start output and inputs at sample 0, at once."""
        self._require_link()
        self._require(not self._started, "start() was called already; one start() a connection")
        self._receive(0.0)  # packets from before the start
        self._buffer = ReceiveBuffer(len(self.channels))
        self._started = True
        before = self._clock.now()
        taken = self._request(PacketKind.START, Phase.RUNNING).taken
        now_s = self._clock.now()
        self._clock_offset = ClockOffset(max(now_s - (taken - 1) / self.rate_hz, before), now_s)

    def read(self, samples: int) -> Float2D:
        """Wait for the next samples and return their volts, (channel, sample)."""
        last = self._buffer.first + samples
        deadline_s = self.scheduled_time_s(last - 1) + SAMPLE_TIMEOUT_S
        try:
            if not self._loss_reason:
                self._receive(0.0)
                self._send_heartbeat()
            self._receive_until(last, deadline_s)
        except MachineLost:
            if self._buffer.complete < last:
                raise
            # Return the samples that have arrived; the next call raises the loss.
        self._clock.wait_until(self.scheduled_time_s(last - 1))
        return self._buffer.take(samples)

    def scheduled_time_s(self, index: int) -> float:
        """Return the time in s, on the session's clock, at which sample `index` is taken."""
        if self._clock_offset is None:
            raise RuntimeError("UDP target: call start() first")
        return self._clock_offset.epoch_s + index / self.rate_hz

    def close(self) -> None:
        """Release the target; if it moves, it plays what is queued. Safe to call twice."""
        link, self._link = self._link, None
        if link is None:
            return
        deadline_s = self._clock.now() + RELEASE_TIMEOUT_S
        while self._clock.now() < deadline_s:
            link.send(RigPacket(PacketKind.RELEASE))
            for state in link.receive(RESEND_PERIOD_S):
                self._handle_state(state, link)
            if self._state.phase in (Phase.FREE, Phase.ENDING):
                break
        link.close()

    def _claim(self, link: UdpLink) -> None:
        """Claim the target; InputError with its reason if it refuses."""
        gaps = (self._specimen.gap_mm, self._specimen.gap_right_mm, self._specimen.gap_left_mm)
        numbers = [
            self.rate_hz,
            len(self.channels),
            rig_checksum(self._rig),
            self._specimen.mass_kg,
        ]
        numbers += [math.nan if gap is None else gap for gap in gaps]
        packet = RigPacket(PacketKind.CLAIM, values=np.array(numbers))
        target = f"the UDP target at {self._wiring.target}"
        resting_until = self._clock.now() + REST_TIMEOUT_S
        deadline_s = self._clock.now() + ANSWER_TIMEOUT_S
        while self._state.session != link.session:
            self._has_news = False
            link.send(packet)
            for state in link.receive(RESEND_PERIOD_S):
                self._handle_state(state, link)
            now_s = self._clock.now()
            if self._has_news and self._state.phase is Phase.ENDING and now_s < resting_until:
                deadline_s = now_s + ANSWER_TIMEOUT_S
                self._clock.wait_until(now_s + HEARTBEAT_PERIOD_S)
            elif self._has_news and self._state.reason is not Reason.NONE:
                raise InputError(
                    f"refuses the claim: {REASON_TEXTS[self._state.reason]}", where=target
                )
            elif now_s > deadline_s:
                raise InputError("does not answer the claim", where=target, remedy="restart it")
        min_lead = self._state.least_ahead
        if min_lead >= self.replace_after:
            raise InputError(
                f"too short: the target alone needs {1e3 * min_lead / self.rate_hz:g} ms",
                key="udp.replace_after_ms",
                value=self._wiring.replace_after_ms,
                remedy="set the time that the target needs plus 10 ms for the network",
            )

    def _send_command(self, index: int, volts: Float1D, number: int) -> None:
        """Send a command, with repetitions, until the target accepts or refuses it."""
        transfer, deadline_s = CommandTransfer(volts), self._clock.now() + ANSWER_TIMEOUT_S
        while self._state.queue != number or self._state.verdict is QueueVerdict.ARRIVING:
            now_s = self._clock.now()
            if now_s > deadline_s:
                self._raise_lost(f"it has not received a command within {ANSWER_TIMEOUT_S:g} s")
            for piece, values in transfer.pop_due(now_s):
                packet = RigPacket(
                    PacketKind.QUEUE, 0, 0, index, number, piece, samples=volts.size, values=values
                )
                self._require_link().send(packet)
            self._receive(RESEND_PERIOD_S)
            if self._state.queue == number:
                transfer.confirm(self._state.pieces)

    def _receive_until(self, last: int, deadline_s: float) -> None:
        """Receive until all samples before `last` have arrived or are known to be lost."""
        requested_s = -math.inf
        while self._buffer.complete < last:
            link, now_s = self._require_link(), self._clock.now()
            if now_s > deadline_s:
                if self._buffer.end < last:
                    self._raise_lost(
                        f"the samples up to {last - 1} have not arrived {SAMPLE_TIMEOUT_S:g} s "
                        "after their scheduled time"
                    )
                self._buffer.give_up(last)
                return
            missing = self._buffer.missing
            if missing is not None and now_s - requested_s > RESEND_PERIOD_S:
                link.send(RigPacket(PacketKind.BEAT, want_from=missing[0], want_to=missing[1]))
                requested_s = now_s
            self._receive(RESEND_PERIOD_S if missing else HEARTBEAT_PERIOD_S)
            self._send_heartbeat()

    def _request(self, kind: PacketKind, phase: Phase | None = None) -> TargetState:
        """Repeat a request until the target answers and is in `phase`; return its state."""
        deadline_s = self._clock.now() + ANSWER_TIMEOUT_S
        self._receive(0.0)
        self._has_news = False
        while not self._has_news or (phase and self._state.phase is not phase):
            if self._clock.now() > deadline_s:
                self._raise_lost(f"no answer to {kind.name} within {ANSWER_TIMEOUT_S:g} s")
            self._require_link().send(RigPacket(kind))
            self._receive(2 * RESEND_PERIOD_S)
        return self._state

    def _newest_sample(self) -> int:
        """Return the index of the newest sample taken by now, read or not."""
        elapsed_s = self._clock.now() - self.scheduled_time_s(0)
        return find_newest_sample(self._buffer.end, elapsed_s, self.rate_hz)

    def _send_heartbeat(self) -> None:
        link = self._require_link()
        if self._clock.now() - link.last_sent_s >= HEARTBEAT_PERIOD_S:
            link.send(RigPacket(PacketKind.BEAT))

    def _receive(self, timeout_s: float) -> None:
        """Process arriving packets; MachineLost if the target has dropped this rig."""
        link = self._require_link()
        for state in link.receive(timeout_s):
            self._handle_state(state, link)
        if self._state.session != link.session:
            self._raise_lost("it was restarted, or received no packet from this rig for too long")
        if self._state.phase is Phase.ENDING:
            self._raise_lost(REASON_TEXTS[self._state.reason])

    def _handle_state(self, state: TargetState, link: UdpLink) -> None:
        """Process a state: its samples in any order, the rest only if it is the newest."""
        ours = state.session == link.session
        phase = Phase.RUNNING if self._started else Phase.CLAIMED
        if ours and state.phase is phase and not state.values.size % len(self.channels):
            values = state.values.reshape(-1, len(self.channels)).T
            self._buffer.put(state.index, values)
        newer = not self._has_state or sequence_difference(state.sequence, self._state.sequence) > 0
        if not newer or not (ours or not state.session):
            return
        self._state, self._has_state, self._has_news = state, True, True
        if self._clock_offset is not None and state.phase is Phase.RUNNING:
            self._buffer.give_up(min(state.oldest, self._buffer.end))
            self._clock_offset.update(state.taken - 1, self.rate_hz, self._clock.now())

    def _require_link(self) -> UdpLink:
        if self._loss_reason:
            raise MachineLost(self._loss_reason)
        if self._link is None:
            raise RuntimeError("UDP target: closed, or open() was not called")
        return self._link

    def _require(self, condition: bool, remedy: str) -> None:
        if not condition:
            raise RuntimeError(f"UDP target: {remedy}")

    def _raise_lost(self, reason: str) -> NoReturn:
        """Raise MachineLost with cause, consequence and remedy, now and in every later call."""
        self._loss_reason = (
            f"the UDP target at {self._wiring.target} is lost: {reason}. If it still runs, the "
            "queued command plays to rest; if not, only the interlock stops the table. Check the "
            "machine, then start again"
        )
        self.close()
        raise MachineLost(self._loss_reason)
