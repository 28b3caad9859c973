"""The twin of a live run, here or on another machine: steps the model beside measured blocks."""

import platform
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from table_io.block import Block
from table_io.clock import Clock, RealClock
from table_io.records import Decided, Fault, RunStart, RunStop
from twin.compare import pipeline
from twin.service.bundle import warm_twin
from twin.service.offers import TWIN_TOPICS
from twin.service.scheduling import urgent
from twin.service.spec import CAPACITY, CONNECT_S, LINGER_S, QUIET_S, Spec, orphaned, token
from twin.service.stopwatch import TIMING_BLOCKS, Stopwatch
from twin.stream.resend import Inbox
from twin.stream.wire import MEAS_TOPIC, Item, decode, encode, topic
from twin.stream.zenoh_link import Link, open_spoke

PRIORITY = 40  # of real-time scheduling, where it is permitted
CONTROL = ("/run/start", "/run/stop", "/rig/decided")


def compute(
    spec: Spec,
    missed_from: str,
    joined: Link | None = None,
    alone: Callable[[], bool] = orphaned,
) -> None:
    """Publishes predictions and comparisons until the run is over, or it is left `alone`.

    `missed_from` is set where this is the successor of a twin that died: the sample from which its
    comparisons are missing. On another machine it has `joined` the run through the gate.
    """
    bundle = spec.bundle()
    warm_twin()
    clock = RealClock()
    scheduler = urgent(PRIORITY)
    link = joined or open_spoke(bundle.rig.name, spec.endpoint, CONNECT_S)
    link.declare(TWIN_TOPICS, offered=joined is not None)
    control = link.subscribe(CONTROL, history=True, capacity=CAPACITY)
    blocks = link.subscribe((MEAS_TOPIC,), history=not missed_from, capacity=CAPACITY)
    if joined is None:
        link.alive(token(spec, "twin"))
    seconds = bundle.profile.acquisition.block_samples / bundle.drive.rate_hz
    watch = Stopwatch("twin", clock, seconds, scheduler)
    twin = _Twin(spec.run, link, bundle.twin(), watch, clock, missed_from)
    twin.follows = bundle.rig.backend == "follow"
    twin.run(control, blocks, alone)
    until = clock.now() + LINGER_S
    while clock.now() < until and not alone():
        control.get(0.02)  # serves those who still ask for what this process holds
    link.close()


@dataclass(slots=True)
class _Twin:
    """A twin at work, beside the run."""

    name: str  # of the run
    link: Link
    setup: pipeline.Setup
    watch: Stopwatch
    clock: Clock
    missed_from: str
    state: pipeline.State | None = None
    epoch_s: float | None = None
    end: int | None = None
    follows: bool = False  # a device whose clock is not ours, by labels that came later: no latency

    def run(self, control: Inbox, blocks: Inbox, alone: Callable[[], bool]) -> None:
        """Until the end of the run is compared, or nobody is there any more."""
        heard = self.clock.now()
        while self.end is None or self.state is None or self.state.tracks.index < self.end:
            for record in _told(control, self.name):
                self.hear(record)
            arrived = blocks.get(0.2)
            if arrived is None:
                if alone() and self.clock.now() - heard > QUIET_S:
                    break
                continue
            heard = self.clock.now()
            run, block = decode(*arrived)
            if run == self.name and isinstance(block, Block):
                self.step(block)
        self.say([self.watch.record(self.end or 0)])

    def hear(self, record: Item) -> None:
        """Take in what was planned, or decided, or that the run is over."""
        if isinstance(record, RunStart) and record.host == platform.node() and not self.follows:
            self.epoch_s = record.epoch_s  # by the clock of this machine
        elif isinstance(record, RunStop):
            self.end = record.index
        elif isinstance(record, Decided):
            self.setup = pipeline.knowing(self.setup, record)

    def step(self, block: Block) -> None:
        """Compare a measured block."""
        state = self.state if self.state is not None else self.begin(block.index)
        self.state, items = pipeline.step(self.setup, state, block)
        self.say(items)
        if self.epoch_s is not None:
            self.watch.add(self.clock.now() - self.epoch_s - (block.end - 1) / block.rate_hz)
        if block.index // len(block) % TIMING_BLOCKS == TIMING_BLOCKS - 1:
            self.say([self.watch.record(block.end)])

    def begin(self, index: int) -> pipeline.State:
        """Start at this sample, and say what is missing before it."""
        state, begun = pipeline.start(self.setup, index)
        self.say(list(begun))
        self.watch.begin()
        if self.missed_from or index > 0:
            why = "the process died and was restarted" if self.missed_from else "it joined late"
            self.say([Fault(index, "twin", int(self.missed_from or 0), index, why)])
        return state

    def say(self, items: list[Item]) -> None:
        for item in items:
            self.link.publish(topic(item), encode(item, self.name))


def _told(control: Inbox, run: str) -> Iterator[Item]:
    """Records of a run that wait in an inbox, without waiting for more."""
    while (arrived := control.get(0.0)) is not None:
        of, record = decode(*arrived)
        if of == run:
            yield record
