"""The Backend contract on a target that speaks our UDP packets.

Packets may be lost, doubled, reordered or spoilt, either way. So the rig says everything again
until the target's state shows that it has arrived, and asks again for samples that are missing.
"""

import math
from typing import NoReturn

import numpy as np

from table_io.backends import PATIENCE_S, MachineLost
from table_io.backends.udp.link import ANSWER_S, WORDS, Link, digest, state_of
from table_io.backends.udp.packets import (
    RING,
    Kind,
    Phase,
    Reason,
    State,
    Verdict,
    Word,
    ahead,
)
from table_io.backends.udp.transfer import Arriving, Delivery, Offset
from table_io.block import Float1D, Float2D
from table_io.card import BadInput
from table_io.clock import Clock
from table_io.profile import Specimen
from table_io.rig import Rig

BEAT_S = 0.03  # between heartbeats
AGAIN_S = 0.002  # before anything is said or asked again
RESTING_S = 30.0  # that a target may still need to come to rest after its last rig
FAREWELL_S = 0.2  # that it may take to hear of the end


class UdpBackend:
    """A rig's side of one life on the target."""

    def __init__(self, rig: Rig, specimen: Specimen, rate_hz: float, clock: Clock) -> None:
        if rig.udp is None:
            raise BadInput(f"rig {rig.name}: no [udp] table; add it, or name another backend")
        self.channels = rig.channels
        self.rate_hz = rate_hz
        self.replace_after = math.ceil(rig.udp.replace_after_ms * 1e-3 * rate_hz)
        self._rig = rig
        self._wiring = rig.udp
        self._specimen = specimen
        self._clock = clock
        self._link: Link | None = None
        self._state = State(Phase.FREE)  # what the target said last
        self._heard = False  # it has ever said something
        self._fresh = False  # since this was set to False it has said something
        self._started = False
        self._arriving = Arriving(len(self.channels))
        self._offset: Offset | None = None
        self._queues = 0
        self._lost = ""  # why the target does not answer any more

    def open(self) -> None:
        """Claim the target; waits where it still comes to rest."""
        self._rig.refuse_rate(self.rate_hz)
        state_of(self._wiring, self._clock)
        self._link = Link(self._wiring, self._clock)
        try:
            self._claim(self._link)
        except BadInput:
            self.close()
            raise

    def tare(self, samples: int) -> Float2D:
        """Volts at rest before precompression, (channel, sample): the next ones from now on."""
        self._alive()
        self._demand(not self._started, "it runs already; tare before start()")
        self._arriving = Arriving(len(self.channels), self._await(Kind.BEAT).taken)
        until = self._clock.now() + samples / self.rate_hz + PATIENCE_S
        self._gather(self._arriving.first + samples, until)
        return self._arriving.take(samples)

    def queue(self, index: int, volts: Float1D) -> None:
        """Replace the command from sample `index` on, (sample,); the last value is held."""
        self._alive()
        earliest = self._newest() + self.replace_after if self._started else 0
        if index < earliest:
            raise ValueError(
                f"the command from sample {index} on is already in the target; allowed: from "
                f"{earliest} on ({self.replace_after} after the newest sample taken)"
            )
        if not volts.size or not np.isfinite(volts).all():
            raise ValueError(f"the command from sample {index} on is empty or holds NaN or inf")
        if volts.size > RING:
            raise BadInput(
                f"a command of {volts.size} samples from {index} on; a UDP target holds {RING}: "
                "lower acquisition.rate_hz or output.lead_s"
            )
        self._queues += 1
        self._deliver(index, volts, self._queues)
        if self._state.verdict is not Verdict.PLAYS:
            raise ValueError(
                f"the target does not take the command from sample {index} on "
                f"({self._state.verdict.name}: {self._state.taken} samples were taken)"
            )

    def start(self) -> None:
        """Start output and input at sample 0, now."""
        self._alive()
        self._demand(not self._started, "it runs already; one start() a life")
        self._listen(0.0)  # what lies there is older than the start
        self._arriving = Arriving(len(self.channels))
        self._started = True
        before = self._clock.now()
        taken = self._await(Kind.START, Phase.RUNNING).taken
        now = self._clock.now()
        self._offset = Offset(max(now - (taken - 1) / self.rate_hz, before), now)

    def read(self, samples: int) -> Float2D:
        """Volts of the next samples, (channel, sample), when they have been taken."""
        last = self._arriving.first + samples
        until = self.scheduled(last - 1) + PATIENCE_S
        try:
            if not self._lost:
                self._listen(0.0)
                self._beat()
            self._gather(last, until)
        except MachineLost:
            if self._arriving.come < last:
                raise
            # What has come is handed out first; the next call says it.
        self._clock.wait_until(self.scheduled(last - 1))
        return self._arriving.take(samples)

    def scheduled(self, index: int) -> float:
        """Time on the session's clock at which sample `index` is taken, in s."""
        if self._offset is None:
            raise RuntimeError("UDP target: start() comes first")
        return self._offset.epoch_s + index / self.rate_hz

    def close(self) -> None:
        """Release the target; where it moves it plays what is queued. Safe to call twice."""
        link, self._link = self._link, None
        if link is None:
            return
        until = self._clock.now() + FAREWELL_S
        while self._clock.now() < until:
            link.say(Word(Kind.RELEASE))
            for state in link.hear(AGAIN_S):
                self._take(state, link)
            if self._state.phase in (Phase.FREE, Phase.ENDING):
                break
        link.close()

    def _claim(self, link: Link) -> None:
        """The target is ours; BadInput says why it is not."""
        gaps = (self._specimen.gap_mm, self._specimen.gap_right_mm, self._specimen.gap_left_mm)
        numbers = [self.rate_hz, len(self.channels), digest(self._rig), self._specimen.mass_kg]
        numbers += [math.nan if gap is None else gap for gap in gaps]
        word = Word(Kind.CLAIM, values=np.array(numbers))
        where = f"the UDP target at {self._wiring.target}"
        resting_until = self._clock.now() + RESTING_S
        until = self._clock.now() + ANSWER_S
        while self._state.session != link.session:
            self._fresh = False
            link.say(word)
            for state in link.hear(AGAIN_S):
                self._take(state, link)
            now = self._clock.now()
            if self._fresh and self._state.phase is Phase.ENDING and now < resting_until:
                until = now + ANSWER_S
                self._clock.wait_until(now + BEAT_S)
            elif self._fresh and self._state.reason is not Reason.NONE:
                raise BadInput(f"{where} refuses this rig: {WORDS[self._state.reason]}")
            elif now > until:
                raise BadInput(f"{where} answers no claim; restart it")
        least = self._state.least_ahead
        if least >= self.replace_after:
            raise BadInput(
                f"udp.replace_after_ms = {self._wiring.replace_after_ms:g}: the target alone needs "
                f"{1e3 * least / self.rate_hz:g} ms; give that and 10 ms for the wire"
            )

    def _deliver(self, index: int, volts: Float1D, number: int) -> None:
        """Send a command until the target has judged it."""
        delivery, until = Delivery(volts), self._clock.now() + ANSWER_S
        while self._state.queue != number or self._state.verdict is Verdict.ARRIVING:
            now = self._clock.now()
            if now > until:
                self._lose(f"it has not taken a command for {ANSWER_S:g} s")
            for piece, values in delivery.due(now):
                word = Word(
                    Kind.QUEUE, 0, 0, index, number, piece, samples=volts.size, values=values
                )
                self._alive().say(word)
            self._listen(AGAIN_S)
            if self._state.queue == number:
                delivery.heard(self._state.pieces)

    def _gather(self, last: int, until: float) -> None:
        """Hear until all samples before `last` have come, or are known to be lost for good."""
        asked_s = -math.inf
        while self._arriving.come < last:
            link, now = self._alive(), self._clock.now()
            if now > until:
                if self._arriving.seen < last:
                    self._lose(
                        f"it has not sent the samples up to {last - 1}, {PATIENCE_S:g} s after "
                        "their schedule"
                    )
                self._arriving.give_up(last)
                return
            hole = self._arriving.hole
            if hole is not None and now - asked_s > AGAIN_S:
                link.say(Word(Kind.BEAT, want_from=hole[0], want_to=hole[1]))
                asked_s = now
            self._listen(AGAIN_S if hole else BEAT_S)
            self._beat()

    def _await(self, kind: Kind, phase: Phase | None = None) -> State:
        """Say this until the target has answered, and is in this phase; what it said."""
        until = self._clock.now() + ANSWER_S
        self._listen(0.0)
        self._fresh = False
        while not self._fresh or (phase and self._state.phase is not phase):
            if self._clock.now() > until:
                self._lose(f"it has not answered {kind.name} for {ANSWER_S:g} s")
            self._alive().say(Word(kind))
            self._listen(2 * AGAIN_S)
        return self._state

    def _newest(self) -> int:
        """The newest sample that the target has taken by now, read or not."""
        since = self._clock.now() - self.scheduled(0)
        return max(self._arriving.seen - 1, math.floor(since * self.rate_hz + 1e-6))

    def _beat(self) -> None:
        link = self._alive()
        if self._clock.now() - link.spoke_s >= BEAT_S:
            link.say(Word(Kind.BEAT))

    def _listen(self, timeout_s: float) -> None:
        """Take in what comes; MachineLost where the target goes on without this rig."""
        link = self._alive()
        for state in link.hear(timeout_s):
            self._take(state, link)
        if self._state.session != link.session:
            self._lose("it has no rig any more: it was restarted, or missed this one for too long")
        if self._state.phase is Phase.ENDING:
            self._lose(WORDS[self._state.reason])

    def _take(self, state: State, link: Link) -> None:
        """What the target says: samples whenever it said so, the rest only where it is new."""
        ours = state.session == link.session
        phase = Phase.RUNNING if self._started else Phase.CLAIMED
        if ours and state.phase is phase and not state.values.size % len(self.channels):
            values = state.values.reshape(-1, len(self.channels)).T
            self._arriving.put(state.index, values)
        newer = not self._heard or ahead(state.sequence, self._state.sequence) > 0
        if not newer or not (ours or not state.session):
            return
        self._state, self._heard, self._fresh = state, True, True
        if self._offset is not None and state.phase is Phase.RUNNING:
            self._arriving.give_up(min(state.oldest, self._arriving.seen))
            self._offset.heard(state.taken - 1, self.rate_hz, self._clock.now())

    def _alive(self) -> Link:
        if self._lost:
            raise MachineLost(self._lost)
        if self._link is None:
            raise RuntimeError("UDP target: it is closed, or open() was not called")
        return self._link

    def _demand(self, condition: bool, remedy: str) -> None:
        if not condition:
            raise RuntimeError(f"UDP target: {remedy}")

    def _lose(self, why: str) -> NoReturn:
        """The target is lost, for good: MachineLost says why and what happens now."""
        self._lost = (
            f"the UDP target at {self._wiring.target} is lost: {why}. While it runs, what is "
            "queued plays to rest; if it is dead, the interlock alone stops the table. Look after "
            "the machine, then start anew"
        )
        self.close()
        raise MachineLost(self._lost)
