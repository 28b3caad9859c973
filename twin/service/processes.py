"""The processes of a live run: each a small loop round a pure step. `PROCESSES` is their table.

Started by the supervisor as `python -m twin.service.processes COMPONENT SPEC`, each in a session
of its own so that Ctrl-C reaches only the supervisor; its standard input is a pipe whose end tells
that the supervisor is gone.
"""

import fcntl
import json
import os
import select
import signal
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from table_io.backends import open_backend
from table_io.block import Block
from table_io.card import BadInput
from table_io.clock import RealClock
from table_io.records import Decided, Event, Fault, RunStart, RunStop, Timing
from table_io.session import ORDERS, Order, Punctuality, play
from twin.service.bundle import Bundle, from_texts, warm_rig, warm_twin
from twin.service.scheduling import urgent
from twin.service.stopwatch import Stopwatch
from twin.stream.resend import Inbox
from twin.stream.wire import (
    MEASURED,
    TOPIC_TYPES,
    Item,
    decode,
    encode,
    topic,
)
from twin.stream.zenoh_link import open_hub, open_spoke

CONNECT_S = 15.0
RIG_PRIORITY, TWIN_PRIORITY = 50, 40  # of real-time scheduling, where it is permitted
LINGER_S = 10.0  # that the hub stays up after the run, so that late readers can recover
FLUSH_S = 0.25
SYNC_S = 5.0
QUIET_S = 3.0  # after which a recorder stops waiting for the twin's last word
TIMING_BLOCKS = 100
CAPACITY = 50_000
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


@dataclass(frozen=True, slots=True)
class Spec:
    """What every process of a run is told. `folder` is the run's; the texts are TOML."""

    run: str
    name: str
    folder: str
    endpoint: str
    profile_toml: str
    rig_toml: str
    model_toml: str
    serve_view: str = ""  # address of the live Rerun view, if one is wanted

    def write(self, path: Path) -> None:
        path.write_text(json.dumps(asdict(self)))

    @staticmethod
    def read(path: Path) -> "Spec":
        return Spec(**json.loads(path.read_text()))

    def bundle(self) -> Bundle:
        return from_texts(self.name, self.profile_toml, self.rig_toml, self.model_toml, self.name)


def token(spec: Spec, component: str) -> str:
    """Under which a process of this run is alive on the bus; another run's are others."""
    return f"{spec.run}.{component}"


def _orphaned() -> bool:
    """True once the supervisor's end of our standard input is closed."""
    ready, _, _ = select.select([sys.stdin], [], [], 0.0)
    return bool(ready) and not os.read(sys.stdin.fileno(), 64)


def rig(spec: Spec, _: str) -> None:
    """Drives the table and publishes; opens the hub. No other Python threads."""
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
        orphaned = stop_if_orphan and _orphaned()
        return Order("stop", "the supervisor is gone") if orphaned else None

    while (order := ordered()) is None or order[0] != "start":
        if _orphaned():
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
    while clock.now() < until and not _orphaned():
        orders.poll()  # serves those who still ask for what this process holds
        clock.wait_until(clock.now() + 0.005)
    link.close()


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


def twin(spec: Spec, missed_from: str) -> None:
    """Steps the model beside the measured blocks; publishes predictions and comparisons.

    `missed_from` is set where this is the successor of a twin that died: the sample from which its
    comparisons are missing.
    """
    from twin.compare import pipeline

    bundle = spec.bundle()
    warm_twin()
    setup = bundle.twin()
    clock = RealClock()
    scheduler = urgent(TWIN_PRIORITY)
    link = open_spoke(bundle.rig.name, spec.endpoint, CONNECT_S)
    link.declare(TWIN_TOPICS)
    control = link.subscribe(CONTROL, history=True, capacity=CAPACITY)
    blocks = link.subscribe((MEASURED,), history=not missed_from, capacity=CAPACITY)
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
            epoch_s = record.epoch_s if isinstance(record, RunStart) else epoch_s
            end = record.index if isinstance(record, RunStop) else end
            if isinstance(record, Decided):
                setup = pipeline.knowing(setup, record)
        arrived = blocks.get(0.2)
        if arrived is None:
            if _orphaned() and clock.now() - heard > QUIET_S:
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
    until = clock.now() + LINGER_S
    while clock.now() < until and not _orphaned():
        control.get(0.02)  # serves those who still ask for what this process holds
    link.close()


def _told(control: Inbox, run: str) -> Iterator[Item]:
    """Records of a run that wait in an inbox, without waiting for more."""
    while (arrived := control.get(0.0)) is not None:
        of, record = decode(*arrived)
        if of == run:
            yield record


def recorder(spec: Spec, part: str) -> None:
    """Writes everything on the bus to a part file, from the beginning if it is a successor."""
    from twin.stream.mcap_log import LogWriter

    bundle = spec.bundle()
    clock = RealClock()
    link = open_spoke(bundle.rig.name, spec.endpoint, CONNECT_S)
    link.declare(("/run/timing", "/run/event"))
    inbox = link.subscribe(tuple(TOPIC_TYPES), history=True, capacity=CAPACITY)
    lock = Path(part).with_name("lock").open("a")
    fcntl.flock(lock, fcntl.LOCK_SH)  # until this process ends: nobody takes the parts away
    writer = LogWriter(Path(part), bundle.drive.rate_hz)
    link.alive(token(spec, "recorder"))
    watch = Stopwatch("recorder", clock, 1.0)
    watch.begin()
    flushed = synced = heard = clock.now()
    waiting = _Awaited()
    while not waiting.over or clock.now() - heard < 0.3:
        arrived = inbox.get(0.05)
        now = clock.now()
        if arrived is not None:
            heard = now
            name, payload = arrived
            run, item = decode(name, payload)
            if run != spec.run:
                continue
            if isinstance(item, RunStart):
                writer.describe(item)
            writer.write(name, payload, item.index)
            waiting.heard(item)
        elif (waiting.end is not None and now - heard > QUIET_S) or (
            now - heard > QUIET_S and _orphaned()
        ):
            break
        if now - flushed > FLUSH_S:
            writer.flush()
            flushed = now
        if now - synced > SYNC_S:
            os.fsync(writer.fileno())
            synced = now
    last = watch.record(waiting.end or 0)
    writer.write("/run/timing", encode(last, spec.run), last.index)
    if inbox.missed or inbox.dropped:
        text = f"recorder: {inbox.missed} messages missed, {inbox.dropped} dropped"
        event = Event(waiting.end or 0, "recorder", text)
        writer.write("/run/event", encode(event, spec.run), event.index)
    writer.close()
    link.close()


@dataclass(slots=True)
class _Awaited:
    """What a recorder waits for: the end, every measured block, and the twin's last word."""

    end: int | None = None
    block_end: int = 0
    twin_done: bool = False

    def heard(self, item: Item) -> None:
        if isinstance(item, RunStop):
            self.end = item.index
        elif isinstance(item, Block) and item.stream == "meas":
            self.block_end = max(self.block_end, item.end)
        elif isinstance(item, Timing) and item.component == "twin":
            self.twin_done = self.end is not None and item.index >= self.end

    @property
    def over(self) -> bool:
        return self.end is not None and self.block_end >= self.end and self.twin_done


def viewer(spec: Spec, _: str) -> None:
    """Feeds Rerun; a courtesy, it may be slow or die."""
    from twin.service.viewing import serve

    link = open_spoke(spec.bundle().rig.name, spec.endpoint, CONNECT_S)
    link.alive(token(spec, "viewer"))
    serve(link, spec.serve_view, _orphaned)
    link.close()


PROCESSES: dict[str, Callable[[Spec, str], None]] = {
    "rig": rig,
    "twin": twin,
    "recorder": recorder,
    "viewer": viewer,
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
