"""The far side of the packets with the simulated table behind it; `target.c` is its like in C.

It is told what came and what time it is, and says what to send. What a lost or a rude rig means for
the machine is decided in `table_io/machine/table.py`.
"""

import json
import math
from dataclasses import replace

import numpy as np

from table_io.backends.simulated import REPLACE_AFTER_S
from table_io.backends.udp.link import digest
from table_io.backends.udp.packets import (
    PIECES,
    RING,
    VALUES,
    Kind,
    Phase,
    Reason,
    State,
    Verdict,
    Word,
    ahead,
    decode_word,
    encode_state,
)
from table_io.block import Float1D, Float2D
from table_io.machine import wire
from table_io.machine.table import Table
from table_io.machine.wire import Message, carry, say

Address = tuple[str, int]
STATE_S = 0.02  # between states where there are no samples to send
HISTORY = 1 << 13  # samples that can be sent again
MOST_AGAIN = 16  # packets that are sent again for one word


class _Staged:
    """The newest queue, as far as it has arrived."""

    def __init__(self) -> None:
        self.number = 0
        self.verdict = Verdict.PLAYS
        self.arrived = np.zeros(PIECES, dtype=np.bool_)
        self.volts = np.zeros(0)

    def put(self, word: Word) -> bool:
        """True where this piece completes it; one that does not fit is passed over."""
        pieces = math.ceil(word.samples / VALUES)
        size = min(VALUES, word.samples - VALUES * word.piece)
        if word.samples > RING or size < 1 or word.values.size != size:
            return False
        if word.queue > self.number:
            self.number, self.verdict = word.queue, Verdict.ARRIVING
            self.arrived[:] = False
            self.volts = np.full(word.samples, np.nan)
        if word.queue < self.number or self.verdict is not Verdict.ARRIVING:
            return False
        if word.samples != self.volts.size:
            return False
        self.arrived[word.piece] = True
        first = VALUES * word.piece
        self.volts[first : first + size] = word.values
        return bool(self.arrived[:pieces].all())


class Target:
    """A target for one rig at a time."""

    def __init__(self, table: Table) -> None:
        self._table = table
        self._channels = len(table.rig.sensors)
        self._out: list[tuple[State, Address]] = []
        self._sequence = 0
        self._ignored = 0
        self._ended = 0  # the last session; an old claim of it may still come
        self._forget()

    def _forget(self) -> None:
        """Nobody has it."""
        self._session = 0
        self._address: Address = ("", 0)
        self._phase, self._reason = Phase.FREE, Reason.NONE
        self._rate_hz = 0.0
        self._heard = self._missed = 0  # of the rig's packets
        self._staged = _Staged()
        self._answer = False  # it has said something that wants an answer
        self._said_s = -math.inf
        self._rest_from_s = 0.0
        self._restart()

    def _restart(self) -> None:
        """Samples are counted from 0 on."""
        self._history = np.full((HISTORY, self._channels), np.nan)
        self._come = self._sent = 0  # samples
        self._taken = 0

    def hear(self, data: bytes, address: Address, now: float) -> None:
        """Bytes that came from somewhere; what is no word of a rig changes nothing."""
        word = decode_word(data)
        if word is None:
            self._ignored += 1
            return
        free = self._session == 0 and word.session not in (0, self._ended)
        if free and word.kind is Kind.CLAIM:
            self._claim(word, address, now)
        elif word.session != self._session or address != self._address:
            self._ignored += word.session != 0
            held = self._phase in (Phase.CLAIMED, Phase.RUNNING)
            self._reply(address, Reason.BUSY if held else self._reason)
        else:
            self._obey(word, now)

    def _claim(self, word: Word, address: Address, now: float) -> None:
        """The rig has the machine, or is told why not."""
        rig = self._table.rig
        if word.values.size != 7:
            self._ignored += 1
            return
        rate_hz, channels, card, mass_kg, *gaps = word.values.tolist()
        wrong = Reason.NONE
        if rate_hz not in rig.rates_hz:
            wrong = Reason.RATE
        elif channels != self._channels:
            wrong = Reason.CHANNELS
        elif card not in (0, digest(rig)):
            wrong = Reason.CARD
        names = ("gap_mm", "gap_right_mm", "gap_left_mm")
        told = {
            name: None if math.isnan(gap) else gap for name, gap in zip(names, gaps, strict=True)
        }
        claim = {
            "rate_hz": rate_hz,
            "specimen": {"mass_kg": mass_kg, **told},
            "output": rig.output.model_dump(mode="json"),
            "sensors": [sensor.model_dump(mode="json") for sensor in rig.sensors],
        }
        try:
            if wrong is Reason.NONE:
                answer = self._table.hear(say(wire.Kind.CLAIM, json.dumps(claim)), now)[0]
                wrong = Reason.NONE if answer.kind is wire.Kind.GRANTED else Reason.BUSY
        except wire.Garbage:
            wrong = Reason.CARD
        if wrong is not Reason.NONE:
            self._reply(address, wrong)
            return
        self._forget()
        self._session, self._address, self._phase = word.session, address, Phase.CLAIMED
        self._rate_hz, self._rest_from_s, self._heard = rate_hz, now, word.sequence
        self._answer = True

    def _obey(self, word: Word, now: float) -> None:
        """A word of the rig that has the machine."""
        if (newer := ahead(word.sequence, self._heard)) > 0:
            self._missed = (self._missed + newer - 1) & 0xFFFFFFFF
            self._heard = word.sequence
            if self._phase is not Phase.ENDING:  # an old word come again is no sign of life
                self._tell(Message(wire.Kind.BEAT), now)
        self._answer |= word.want_to == 0
        if word.kind is Kind.QUEUE and self._phase is not Phase.ENDING:
            if self._staged.put(word):
                self._staged.verdict = self._queued(word.index, self._staged.volts, now)
        elif word.kind is Kind.START and self._phase is Phase.CLAIMED:
            self._phase = Phase.RUNNING
            self._restart()
            self._tell(Message(wire.Kind.START), now)
        elif word.kind is Kind.RELEASE and self._phase is not Phase.ENDING:
            self._phase, self._reason = Phase.ENDING, Reason.RELEASED
            self._tell(Message(wire.Kind.RELEASE), now)
        last = min(word.want_to, self._come)
        self._send(max(word.want_from, self._come - HISTORY, 0), last, MOST_AGAIN)

    def _queued(self, index: int, volts: Float1D, now: float) -> Verdict:
        """What becomes of a command that has arrived."""
        room = self._taken + RING - 4 if self._phase is Phase.RUNNING else RING  # as in target.c
        most = self._table.rig.output.span_v * (1.0 + 1e-9)
        if not (np.abs(volts) <= most).all() or not 0 <= index <= room - volts.size:
            return Verdict.NONSENSE
        answer = self._tell(carry(wire.Kind.QUEUE, volts, index), now)
        return Verdict.PLAYS if answer.kind is wire.Kind.QUEUED else Verdict.LATE

    def _tell(self, message: Message, now: float) -> Message:
        """The table's answer, if it has one."""
        answers = self._table.hear(message, now)
        return answers[0] if answers else message

    def tick(self, now: float) -> list[tuple[bytes, Address]]:
        """Play up to now; what is to be sent, and to whom."""
        for message in self._table.tick(now):
            if message.kind is wire.Kind.TAKEN:
                self._keep(message.values.reshape(-1, self._channels))
            elif message.kind is wire.Kind.LOST:
                self._end(Reason.SILENCE)
        if self._phase is Phase.CLAIMED:
            self._rest(now)
        elif self._phase is Phase.RUNNING:
            self._taken = self._table.life.taken if self._table.life else self._come
        if self._session:
            held = self._phase in (Phase.CLAIMED, Phase.RUNNING)
            self._sent += self._send(self._sent, self._come if held else 0)
            if self._answer or now - self._said_s >= STATE_S:
                self._reply(self._address, self._reason)
            self._answer = False
            if any(address == self._address for _, address in self._out):
                self._said_s = now
            if not self._table.claimed:
                self._ended = self._session
                self._forget()
        out, self._out = self._out, []
        return [(self._packet(state), address) for state, address in out]

    def switch_off(self, now: float) -> None:
        """Take the machine from its rig; it comes to rest."""
        if self._phase in (Phase.CLAIMED, Phase.RUNNING):
            self._table.lost("the table is being switched off", now)
            self._end(Reason.SWITCHED_OFF)

    def _end(self, why: Reason) -> None:
        self._phase, self._reason, self._answer = Phase.ENDING, why, True

    def _rest(self, now: float) -> None:
        """Samples at rest, as many as are due since the claim."""
        due = math.floor((now - self._rest_from_s) * self._rate_hz) + 1 - self._come
        if due > 0 and self._table.life is not None:
            self._keep(self._table.life.plant.tare(due).T)
            self._taken = self._come

    def _keep(self, rows: Float2D) -> None:
        """Samples that have come, (sample, channel)."""
        at = np.arange(self._come, self._come + len(rows)) % HISTORY
        self._history[at] = rows
        self._come += len(rows)

    def _send(self, first: int, last: int, most: int = 1 << 16) -> int:
        """Send samples first .. last - 1, in so many packets at most; how many it sent."""
        step = VALUES // self._channels
        last = min(last, first + most * step)
        for start in range(first, last, step):
            at = np.arange(start, min(start + step, last)) % HISTORY
            state = self._state(self._reason, index=start, values=self._history[at].ravel())
            self._out.append((state, self._address))
        return max(last - first, 0)

    def _reply(self, address: Address, reason: Reason) -> None:
        ours = address == self._address
        state = self._state(reason)
        self._out.append((state if ours else replace(state, session=0), address))

    def _state(self, reason: Reason, index: int = 0, values: Float1D | None = None) -> State:
        """What there is to say now, with samples from `index` on, (sample * channel,)."""
        return State(
            phase=self._phase,
            reason=reason,
            session=self._session,
            index=index,
            taken=self._taken,
            oldest=max(self._come - HISTORY, 0),
            queue=self._staged.number,
            verdict=self._staged.verdict,
            channels=self._channels,
            least_ahead=round(REPLACE_AFTER_S * (self._rate_hz or self._table.rig.rates_hz[0])),
            ignored=self._ignored & 0xFFFFFFFF,
            missed=self._missed,
            rate_hz=self._rate_hz,
            arrived=np.packbits(self._staged.arrived, bitorder="little").tobytes(),
            values=np.empty(0) if values is None else values,
        )

    def _packet(self, state: State) -> bytes:
        self._sequence = (self._sequence + 1) & 0xFFFFFFFF
        return encode_state(replace(state, sequence=self._sequence))
