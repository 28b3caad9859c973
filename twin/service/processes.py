"""The processes of a live run: each a small loop round a pure step. `PROCESSES` is their table.

Started by the supervisor as `python -m twin.service.processes COMPONENT SPEC`, each in a session
of its own so that Ctrl-C reaches only the supervisor; its standard input is a pipe whose end tells
that the supervisor is gone.
"""

import contextlib
import os
import signal
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from table_io.backends import open_backend, open_source
from table_io.block import Block
from table_io.card import BadInput
from table_io.clock import RealClock
from table_io.following import follow
from table_io.records import Event, RunStart, RunStop
from table_io.session import ORDERS, Order, Punctuality, play
from twin.service.bundle import warm_rig
from twin.service.gate import NICENESS, gate
from twin.service.recorder import recorder
from twin.service.scheduling import urgent
from twin.service.spec import CONNECT_S, LINGER_S, Spec, orphaned, token
from twin.service.stopwatch import TIMING_BLOCKS, Stopwatch
from twin.stream.endpoint import INSIDE
from twin.stream.questions import Questions
from twin.stream.wire import TOPIC_TYPES, Item, encode, topic
from twin.stream.zenoh_link import open_hub, open_spoke

RIG_PRIORITY = 50  # of real-time scheduling, where it is permitted
RIG_TOPICS = (
    *(name for name in TOPIC_TYPES if name.startswith("/rig/")),
    "/run/start",
    "/run/stop",
    "/run/event",
    "/run/timing",
)


def rig(spec: Spec, _: str) -> None:
    """Drives the table and publishes; opens the hub inside. No other Python threads."""
    bundle = spec.bundle()
    warm_rig(bundle)
    clock = RealClock()
    scheduler = urgent(RIG_PRIORITY)
    link = open_hub(bundle.rig.name, spec.endpoint)
    link.declare(RIG_TOPICS)
    orders = _Orders(link.commands(), spec.run, bundle.profile.on_death.supervisor == "stop")
    link.alive(token(spec, "rig"))
    while (order := orders.next()) is None or order[0] != "start":
        if orphaned():
            return
        clock.wait_until(clock.now() + 0.01)
    seconds = bundle.profile.acquisition.block_samples / bundle.drive.rate_hz
    watch = Stopwatch("rig", clock, seconds, scheduler)
    punctual = Punctuality()
    watch.begin()
    start = bundle.describe(spec.run, "table")
    asked = (clock, start, orders.order, punctual)
    if bundle.rig.backend == "follow":
        followed = open_source(bundle.rig, bundle.drive.rate_hz, clock)
        source = follow(bundle.session, followed, *asked)
    else:
        source = play(bundle.session, open_backend(bundle.rig, bundle.profile, clock), *asked)
    for item in _timed(source, watch, punctual):
        link.publish(topic(item), encode(item, spec.run))
    until = clock.now() + LINGER_S
    while clock.now() < until and not orphaned():
        orders.waiting.poll()  # serves those who still ask for what this process holds
        clock.wait_until(clock.now() + 0.005)
    link.close()
    with contextlib.suppress(OSError):  # the supervisor did, unless it is dead
        Path(spec.endpoint.removeprefix(INSIDE)).parent.rmdir()


@dataclass(slots=True)
class _Orders:
    """The commands to the rig of a run, each answered at once."""

    waiting: Questions
    run: str
    stop_if_orphan: bool

    def next(self) -> tuple[str, str] | None:
        """(name, reason) of the next command; one that was given to another run is refused."""
        order = self.waiting.poll()
        if order is None:
            return None
        run, _, why = order.text.partition("\n")
        known = run == self.run and order.name in ("start", *ORDERS)
        order.reply("yes" if known else f"refused: this is run {self.run}")
        return (order.name, why) if known else None

    def order(self) -> Order | None:
        """The next order to the session, which may come from nobody's being there any more."""
        order = self.next()
        if order is not None and order[0] in ORDERS:
            return Order(order[0], order[1] or f"asked to {order[0]}")
        alone = self.stop_if_orphan and orphaned()
        return Order("stop", "the supervisor is gone") if alone else None


def _timed(source: Iterator[Item], watch: Stopwatch, punctual: Punctuality) -> Iterator[Item]:
    """The items of a session with the rig's Timing every second and before the end."""
    blocks = 0
    for item in source:
        if isinstance(item, RunStop):
            yield watch.record(item.index)
        yield item
        if isinstance(item, Block):
            watch.add(punctual.late_s.pop())
            blocks += 1
            if blocks % TIMING_BLOCKS == 0:
                yield watch.record(item.end)
        elif isinstance(item, RunStart) or (isinstance(item, Event) and item.kind == "motion"):
            yield watch.record(item.index)  # a follower now hands on no block for a while


def twin(spec: Spec, missed_from: str) -> None:
    """Steps the model beside the measured blocks."""
    from twin.service.twinning import compute  # much to import, for this process alone

    compute(spec, missed_from)


def viewer(spec: Spec, _: str) -> None:
    """Feeds Rerun; a courtesy, it may be slow or die."""
    from twin.service.viewing import serve

    os.nice(NICENESS)
    link = open_spoke(spec.bundle().rig.name, spec.endpoint, CONNECT_S)
    link.alive(token(spec, "viewer"))
    serve(link, spec.serve_view, orphaned)
    link.close()


PROCESSES: dict[str, Callable[[Spec, str], None]] = {
    "rig": rig,
    "twin": twin,
    "recorder": recorder,
    "viewer": viewer,
    "gate": gate,
}


def main() -> None:
    """Entry of a child process: COMPONENT SPEC [ARGUMENT]."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    component, spec, *rest = sys.argv[1:]
    try:
        PROCESSES[component](Spec.read(Path(spec)), rest[0] if rest else "")
    except BadInput as error:
        print(error, file=sys.stderr)
        raise SystemExit(2) from None


if __name__ == "__main__":
    main()
