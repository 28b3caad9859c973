"""The processes of a live run: each a small loop round a pure step. `PROCESSES` is their table.

Started by the supervisor as `python -m twin.service.processes COMPONENT SPEC`, each in a session
of its own so that Ctrl-C reaches only the supervisor; its standard input is a pipe whose end tells
that the supervisor is gone.
"""

import contextlib
import os
import platform
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from table_io.backends import open_backend
from table_io.block import Block
from table_io.card import BadInput
from table_io.clock import Clock, RealClock
from table_io.records import Decided, Fault, RunStart, RunStop
from table_io.session import ORDERS, Order, Punctuality, play
from twin.service.bundle import warm_rig, warm_twin
from twin.service.gate import NICENESS, gate
from twin.service.recorder import recorder
from twin.service.scheduling import urgent
from twin.service.spec import CAPACITY, CONNECT_S, QUIET_S, Spec, orphaned, token
from twin.service.stopwatch import Stopwatch
from twin.stream.endpoint import INSIDE
from twin.stream.resend import Inbox
from twin.stream.wire import (
    MEAS_TOPIC,
    TOPIC_TYPES,
    Item,
    decode,
    encode,
    topic,
)
from twin.stream.zenoh_link import Link, open_hub, open_spoke

RIG_PRIORITY, TWIN_PRIORITY = 50, 40  # of real-time scheduling, where it is permitted
LINGER_S = 10.0  # that the hub stays up after the run, so that late readers can recover
TIMING_BLOCKS = 100
CONTROL = ("/run/start", "/run/stop", "/rig/decided")
RIG_TOPICS = (
    *(name for name in TOPIC_TYPES if name.startswith("/rig/")),
    "/run/start",
    "/run/stop",
    "/run/event",
    "/run/timing",
)
TWIN_TOPICS = (
    *(name for name in TOPIC_TYPES if name.startswith("/twin/")),
    "/run/fault",
    "/run/timing",
    "/run/event",
)


def rig(spec: Spec, _: str) -> None:
    """Drives the table and publishes; opens the hub inside. No other Python threads."""
    bundle = spec.bundle()
    warm_rig(bundle)
    clock = RealClock()
    scheduler = urgent(RIG_PRIORITY)
    link = open_hub(bundle.rig.name, spec.endpoint)
    link.declare(RIG_TOPICS)
    orders = link.commands()
    link.alive(token(spec, "rig"))
    stop_if_orphan = bundle.profile.on_death.supervisor == "stop"

    def ordered() -> tuple[str, str] | None:
        """(name, reason) of the next command; one that was given to another run is refused."""
        order = orders.poll()
        if order is None:
            return None
        run, _, why = order.text.partition("\n")
        known = run == spec.run and order.name in ("start", *ORDERS)
        order.reply("yes" if known else f"refused: this is run {spec.run}")
        return (order.name, why) if known else None

    def commands() -> Order | None:
        order = ordered()
        if order is not None and order[0] in ORDERS:
            return Order(order[0], order[1] or f"asked to {order[0]}")
        alone = stop_if_orphan and orphaned()
        return Order("stop", "the supervisor is gone") if alone else None

    while (order := ordered()) is None or order[0] != "start":
        if orphaned():
            return
        clock.wait_until(clock.now() + 0.01)
    seconds = bundle.profile.acquisition.block_samples / bundle.drive.rate_hz
    watch = Stopwatch("rig", clock, seconds, scheduler)
    backend = open_backend(bundle.rig, bundle.profile, clock)
    punctual = Punctuality()
    watch.begin()
    source = play(
        bundle.session, backend, clock, bundle.describe(spec.run, "table"), commands, punctual
    )
    for item in _timed(source, watch, punctual):
        link.publish(topic(item), encode(item, spec.run))
    until = clock.now() + LINGER_S
    while clock.now() < until and not orphaned():
        orders.poll()  # serves those who still ask for what this process holds
        clock.wait_until(clock.now() + 0.005)
    link.close()
    with contextlib.suppress(OSError):  # the supervisor did, unless it is dead
        Path(spec.endpoint.removeprefix(INSIDE)).parent.rmdir()


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


def twin(spec: Spec, missed_from: str, joined: Link | None = None) -> None:
    """Steps the model beside the measured blocks; publishes predictions and comparisons.

    `missed_from` is set where this is the successor of a twin that died: the sample from which its
    comparisons are missing. On another machine it has `joined` the run through the gate.
    """
    from twin.compare import pipeline

    bundle = spec.bundle()
    warm_twin()
    setup = bundle.twin()
    clock = RealClock()
    scheduler = urgent(TWIN_PRIORITY)
    link = joined or open_spoke(bundle.rig.name, spec.endpoint, CONNECT_S)
    link.declare(TWIN_TOPICS)
    control = link.subscribe(CONTROL, history=True, capacity=CAPACITY)
    blocks = link.subscribe((MEAS_TOPIC,), history=not missed_from, capacity=CAPACITY)
    if joined is None:
        link.alive(token(spec, "twin"))

    def say(items: list[Item]) -> None:
        for item in items:
            link.publish(topic(item), encode(item, spec.run))

    seconds = bundle.profile.acquisition.block_samples / bundle.drive.rate_hz
    watch = Stopwatch("twin", clock, seconds, scheduler)
    state: pipeline.State | None = None
    epoch_s, end, heard = None, None, clock.now()
    while end is None or state is None or state.tracks.index < end:
        for record in _told(control, spec.run):
            epoch_s = _epoch(record) or epoch_s
            end = record.index if isinstance(record, RunStop) else end
            if isinstance(record, Decided):
                setup = pipeline.knowing(setup, record)
        arrived = blocks.get(0.2)
        if arrived is None:
            if orphaned() and clock.now() - heard > QUIET_S:
                break
            continue
        heard = clock.now()
        run, block = decode(*arrived)
        if run != spec.run or not isinstance(block, Block):
            continue
        if state is None:
            state, begun = pipeline.start(setup, block.index)
            say(list(begun))
            watch.begin()
            if missed_from:
                lost = (int(missed_from), block.index)
                say([Fault(block.index, "twin", *lost, "the process died and was restarted")])
        state, items = pipeline.step(setup, state, block)
        say(items)
        if epoch_s is not None:
            watch.add(clock.now() - epoch_s - (block.end - 1) / block.rate_hz)
        if block.index // len(block) % TIMING_BLOCKS == TIMING_BLOCKS - 1:
            say([watch.record(block.end)])
    say([watch.record(end or 0)])
    _linger(control, clock)
    link.close()


def _linger(control: Inbox, clock: Clock) -> None:
    """Serve those who still ask for what this process holds."""
    until = clock.now() + LINGER_S
    while clock.now() < until and not orphaned():
        control.get(0.02)


def _epoch(record: Item) -> float | None:
    """When a run began by the clock of this machine; None for what is no start here."""
    if isinstance(record, RunStart) and record.host == platform.node():
        return record.epoch_s
    return None


def _told(control: Inbox, run: str) -> Iterator[Item]:
    """Records of a run that wait in an inbox, without waiting for more."""
    while (arrived := control.get(0.0)) is not None:
        of, record = decode(*arrived)
        if of == run:
            yield record


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
