"""The gate of a live run: the only door to the outside. No observer reaches the rig's process.

Inside, rig, twin, recorder and supervisor talk on a bus of their own. The gate passes on every
piece of it, as it is, to a second bus at the public endpoint, and holds it there, so that whoever
joins late or reads slowly asks the gate. Into the run it lets commands, each checked, no more.
"""

import contextlib
import os
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from table_io.clock import Clock, RealClock
from table_io.records import Event
from table_io.session import ORDERS
from twin.service.offers import LONGEST_TEXT, OFFERS, TWIN_TOPICS, Offers, readable
from twin.service.spec import CAPACITY, CONNECT_S, QUIET_S, Spec, orphaned, token
from twin.service.status import PATHS, Status
from twin.service.stopwatch import TIMING_BLOCKS, Stopwatch
from twin.stream.access import open_access
from twin.stream.endpoint import PUBLIC, check, merged, safe, through
from twin.stream.keys import read_keys
from twin.stream.questions import Question, Questions
from twin.stream.resend import Inbox
from twin.stream.shelf import Piece
from twin.stream.wire import MEAS_TOPIC, TOPIC_TYPES, encode, topic
from twin.stream.zenoh_link import Link, open_hub, open_spoke

NICENESS = 5  # whoever looks waits, not whoever drives
TURN_S = 0.005
RELAYED = 32  # pieces in a turn, for which whoever asks waits
ANSWERS = 4  # of held messages, in a turn
ANSWER_S = 1.5  # of the rig to a command
LOOK_S = 0.25  # at who is there
STAY_S = 5.0  # after the run, for those who still fetch it
ASKED_WITHIN_S = 2.0  # they ask twice a second; who does not is not waited for
LOOKED_AT = 10  # every so manyth of the measured blocks
OFFERED_CAPACITY = 1000  # pieces that wait; more are asked for again
NAME = re.compile(r"[A-Za-z0-9_.-]{1,64}")
REFUSALS, REFUSAL_EVERY_S = 10, 10.0  # told at once; after these, one in so long


@dataclass(slots=True)
class Front:
    """What whoever is outside can ask, and its answers; a live run's and a replay's alike."""

    outside: Link
    status: Status
    roles: Callable[[str], str]
    order: Callable[[Question, str, str, str], None]  # (question, order, who, text)
    _questions: Questions = field(init=False)
    _present: set[str] = field(init=False)

    def __post_init__(self) -> None:
        self._questions = self.outside.questions(*PATHS, "state/role/*", "cmd/*/*")
        self._present = self.outside.presence()

    def serve(self) -> None:
        """Answer a question if there is one, and those for what is held."""
        for _ in range(ANSWERS):
            if not self.outside.serve():
                break
        question = self._questions.poll()
        if question is None:
            return
        kind, name, *who = question.path.split("/")
        if kind == "cmd":
            self.order(question, name, who[0], question.text)
        elif who:
            question.reply(self.roles(who[0]))
        else:
            question.reply(self.status.answer(question.path, frozenset(self._present)))


def fault(order: str, who: str, role: str, run: str, text: str) -> str:
    """Why a command is refused; "" where it is not. Its text is the run's id, a newline, why."""
    named, _, why = text.partition("\n")
    if not NAME.fullmatch(who):
        return f"{who[:64]!r} is no name; allowed: up to 64 letters, digits and _ . -"
    if order not in ORDERS:
        return f"no such command; known: {', '.join(ORDERS)}"
    if role != "command":
        return f"{who} has the role {role}; this takes the role command"
    if named != run:
        return f"this is run {run}"
    if not readable(why):
        return f"its reason has {len(why)} characters; allowed: {LONGEST_TEXT} printable ones"
    return ""


@dataclass(slots=True)
class Refusals:
    """Which refusals are recorded: a flood of them is one sentence now and then."""

    left: int = REFUSALS
    untold: int = 0
    _since: float = 0.0

    def told(self, sentence: str, now: float) -> str:
        """The sentence to record at the time `now`, or ""."""
        earned = int((now - self._since) / REFUSAL_EVERY_S)
        if earned > 0:
            self.left, self._since = min(REFUSALS, self.left + earned), now
        if self.left == 0:
            self.untold += 1
            return ""
        more = f" (and {self.untold} more since the last one told)" if self.untold else ""
        self.left, self.untold = self.left - 1, 0
        return sentence + more


@dataclass(slots=True)
class Gate:
    """A gate at work, between `inside` and `outside`."""

    spec: Spec
    inside: Link
    outside: Link
    inbox: Inbox
    clock: Clock
    roles: Callable[[str], str]
    refusals: Refusals = field(default_factory=Refusals)
    mirrored: set[str] = field(default_factory=set)
    status: Status = field(init=False)
    watch: Stopwatch = field(init=False)
    blocks: int = 0
    offers: Offers | None = None  # of a twin outside

    def __post_init__(self) -> None:
        self.status = Status(self.spec)
        self.watch = Stopwatch("gate", self.clock, float("inf"))  # it has no deadline to miss
        self.watch.begin()

    def run(self) -> None:
        """Until the run is over, or nobody is there any more, and who listens has it all."""
        front = Front(self.outside, self.status, self.roles, self.obey)
        present = self.inside.presence()
        looked = heard = self.clock.now()
        while not (orphaned() and self.clock.now() - heard > self._patience()):
            if self._relay():
                heard = self.clock.now()
            if self.offers is not None:
                self._admit(self.offers)
            front.serve()
            if self.clock.now() - looked > LOOK_S:
                self._mirror(set(present))
                looked = self.clock.now()
        until = self.clock.now() + STAY_S
        while self.clock.now() < until and self.outside.behind(ASKED_WITHIN_S) > 0:
            front.serve()
            self.clock.wait_until(self.clock.now() + TURN_S)

    def _patience(self) -> float:
        """For how long nothing may come before the run counts as over, once nobody supervises."""
        return 0.3 if self.status.stop is not None else QUIET_S

    def _relay(self) -> bool:
        """Pass on what waits, before anybody is answered; True where there was something."""
        timeout_s = TURN_S
        for count in range(RELAYED):
            piece = self.inbox.piece(timeout_s)
            if piece is None:
                return count > 0
            if self.offers is not None:
                self.offers.inside.add(piece.source)
            self._pass(piece)
            timeout_s = 0.0
        return True

    def _pass(self, piece: Piece) -> None:
        self.outside.relay(piece)
        whole = self.inbox.whole(piece)
        if whole is not None:
            self.status.see(piece.topic, whole)
            if piece.topic == MEAS_TOPIC:
                self._time()

    def _admit(self, offers: Offers) -> None:
        """Let in what a twin outside has computed; it waits until we know how far the rig is."""
        end = 0 if self.inbox.behind else self.status.end
        for _ in range(OFFERS if end else 0):
            taken = offers.take(end)
            if taken is None:
                return
            for piece in taken:
                self.inbox.without.add(piece.source)
                self.inside.relay(piece)
                self._pass(piece)

    def _time(self) -> None:
        """Look at every tenth block how late it goes out; say so once a second."""
        self.blocks += 1
        start, block = self.status.start, self.blocks % LOOKED_AT == 0 and self.status.block
        if not start or not block:
            return
        late = self.clock.now() - start.epoch_s - (block.end - 1) / block.rate_hz
        self.watch.add(late)
        if self.blocks % TIMING_BLOCKS == 0:
            record = self.watch.record(block.end)
            self.inside.publish(topic(record), encode(record, self.spec.run))

    def _mirror(self, present: set[str]) -> None:
        """Outside, be alive in the place of whoever is alive inside."""
        for name in present - self.mirrored:
            self.outside.alive(name)
        for name in self.mirrored - present:
            self.outside.gone(name)
        self.mirrored = present

    def obey(self, question: Question, order: str, who: str, text: str) -> None:
        """Pass a command on to the rig, or refuse it; either is recorded with who gave it."""
        why = fault(order, who, self.roles(who), self.spec.run, text)
        if why:
            question.reply(f"refused: {why}")
            sentence = f"{safe(order)[:16]} by {safe(who)[:64]}: {why}"
            self._say("refused", self.refusals.told(sentence, self.clock.now()))
            return
        reason = text.partition("\n")[2] or f"asked to {order}"
        signed = f"{reason} by {who}"
        self.inside.pass_on(order, f"{self.spec.run}\n{signed}", question, ANSWER_S)
        self._say("order", f"{order}: {signed}")

    def _say(self, kind: str, text: str) -> None:
        if text:
            event = Event(self.status.end, kind, text)
            self.inside.publish(topic(event), encode(event, self.spec.run))


def gate(spec: Spec, _: str) -> None:
    """Stands between a run and whoever watches it."""
    with contextlib.suppress(OSError):
        os.nice(NICENESS)
    rig = spec.rig
    inside = open_spoke(rig, spec.endpoint, CONNECT_S)
    keys = read_keys(Path(spec.keys)) if spec.keys else None
    if keys is not None and not spec.remote_twin:
        keys = keys.without_twins()
    open_to = {} if keys is not None else open_access(rig, remote_twin=spec.remote_twin)
    also = merged(PUBLIC, open_to)
    if spec.router:
        check(rig, spec.router, keys is not None)
        also = merged(also, through(spec.router))
    outside = open_hub(rig, spec.listen, also, keys)
    inside.declare(tuple(TOPIC_TYPES))
    outside.declare(tuple(TOPIC_TYPES))
    inbox = inside.subscribe(tuple(TOPIC_TYPES), history=True, capacity=CAPACITY)
    offers = _offers(spec, outside) if spec.remote_twin else None
    inside.alive(token(spec, "gate"))
    # Without keys everybody on this machine may command, as whoever they say they are.
    roles = keys.role if keys is not None else lambda _: "command"
    Gate(spec, inside, outside, inbox, RealClock(), roles, offers=offers).run()
    outside.close()
    inside.close()


def _offers(spec: Spec, outside: Link) -> Offers:
    from twin.compare.watch import KINDS  # much to import, which a gate without offers never needs

    inbox = outside.subscribe(TWIN_TOPICS, history=True, capacity=OFFERED_CAPACITY, offered=True)
    return Offers(inbox, spec.run, frozenset(KINDS))
