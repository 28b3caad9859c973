"""The recorder of a live run: everything on the bus into a part file, whatever the disk does."""

import contextlib
import fcntl
import os
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from table_io.block import Block
from table_io.card import BadInput
from table_io.clock import Clock, RealClock
from table_io.records import Event, RunStart, RunStop, Timing
from twin.service.disk import RESERVE_S, Reserve, Room, bytes_per_s, free_bytes
from twin.service.parts import LOCK
from twin.service.spec import CAPACITY, CONNECT_S, QUIET_S, Spec, orphaned, token
from twin.service.stopwatch import Stopwatch
from twin.stream.mcap_log import ImpossibleTimeError, LogWriter
from twin.stream.resend import Inbox
from twin.stream.wire import TOPIC_TYPES, Item, WireError, decode, encode, topic
from twin.stream.zenoh_link import Link, open_spoke

PRIORITY = -10  # before whatever else a busy machine does, after the rig and the twin
FLUSH_S = 0.15  # so that on a busy machine, too, no more than 0.25 s are at stake
SYNC_S = 5.0
LOOK_S = 1.0  # at the disk; and so often it says how punctual it is
LAST_TRIES = 20  # to end a file on a disk that fails, one every LAST_TRY_S
LAST_TRY_S = 0.25


@dataclass(slots=True)
class Awaited:
    """What a recorder waits for: the end, every measured block, and the twin's last word."""

    begun: bool = False
    end: int | None = None
    block_end: int = 0
    twin_done: bool = False

    def heard(self, item: Item) -> None:
        if isinstance(item, RunStart):
            self.begun = True
        elif isinstance(item, RunStop):
            self.end = item.index
        elif isinstance(item, Block) and item.stream == "meas":
            self.block_end = max(self.block_end, item.end)
        elif isinstance(item, Timing) and item.component == "twin":
            self.twin_done = self.end is not None and item.index >= self.end

    @property
    def over(self) -> bool:
        return self.end is not None and self.block_end >= self.end and self.twin_done


def _done() -> Future[None]:
    nothing: Future[None] = Future()
    nothing.set_result(None)
    return nothing


@dataclass(slots=True)
class _Recorder:
    """A recorder at work; `trouble` is what the disk last said, empty while all is well.

    `stop` is why the table has to, once: a disk that was full for a moment is not trusted again.
    """

    spec: Spec
    link: Link
    inbox: Inbox
    writer: LogWriter
    watch: Stopwatch
    room: Room
    reserve: Reserve
    rate_hz: float
    clock: Clock
    # A disk takes up to 0.2 s for it; meanwhile what comes is flushed all the same.
    thread: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(1))
    syncing: Future[None] = field(default_factory=_done)
    waiting: Awaited = field(default_factory=Awaited)
    trouble: str = ""
    stop: str = ""
    stopping: bool = False
    lost: bool = False  # a sync failed: what the disk took since the one before is in doubt
    busy_s: float = 0.0  # since the last measured block
    impossible: int = 0  # payloads of a sample that no log can hold

    def run(self) -> None:
        """Until the run is over, or nobody is there any more."""
        flushed = synced = looked = heard = self.clock.now()
        while not self.waiting.over or self.clock.now() - heard < 0.3:
            arrived = self.inbox.get(0.05)
            now = self.clock.now()
            if arrived is not None:
                heard = now
                self._take(*arrived)
            elif now - heard > QUIET_S and (self.waiting.end is not None or orphaned()):
                break
            if now - flushed > FLUSH_S:
                self._on_disk(sync=now - synced > SYNC_S)
                synced = now if now - synced > SYNC_S else synced
                flushed = now
            if now - looked > LOOK_S:
                self._look()
                looked = now
            self.busy_s += self.clock.now() - now

    def _take(self, name: str, payload: bytes) -> None:
        try:
            run, item = decode(name, payload)
        except WireError:  # whoever sent it is not of this run
            return
        if run != self.spec.run:
            return
        if isinstance(item, RunStart):
            self.writer.describe(item)
        try:
            self.writer.write(name, payload, item.index)
        except ImpossibleTimeError:  # so far away is no sample of this run, whatever it says
            self.impossible += 1
            return
        except OSError as error:
            self._troubled(error)
        self.waiting.heard(item)
        if isinstance(item, Block) and item.stream == "meas":
            self.watch.add(self.busy_s)
            self.busy_s = 0.0

    def _on_disk(self, sync: bool) -> None:
        """Flush what was taken, and now and then see to it that it is on the disk itself."""
        try:
            self.writer.flush()
            if sync and self.syncing.done():
                self._synced(self.thread.submit(self.writer.sync))
        except OSError as error:
            self._troubled(error)
        else:
            if self.trouble and not self.lost:
                self._say("the disk takes the recording again; what waited is written")
                self.trouble = ""

    def _synced(self, following: Future[None]) -> None:
        """OSError of the last sync: a disk says once what it lost, and then seems well again."""
        before, self.syncing = self.syncing, following
        try:
            before.result()
        except OSError:
            self.lost = True
            raise

    def _troubled(self, error: OSError) -> None:
        """Stop the table; what cannot be written waits in memory."""
        self.reserve.release()
        if not self.trouble:
            self.trouble = f"{error.strerror}: {error.filename}"
            self.stop = self.stop or f"cannot write the recording ({self.trouble})"
            self._say(
                f"{self.stop}: the table is stopped; what was written stays readable, and the rest "
                "is kept if there is room soon"
            )

    def _look(self) -> None:
        """Once a second: how punctual, how much room; ask for the stop until it is heard."""
        if not self.waiting.begun or self.waiting.end is not None:
            return
        at = self.waiting.block_end
        self._publish(self.watch.record(at))
        if self.stop and not self.stopping:
            why = f"{self.spec.run}\n{self.stop}"
            self.stopping = self.link.request("stop", why, timeout_s=0.5) == "yes"
        elif not self.stop:
            try:
                free = free_bytes(self.writer.path.parent)
            except OSError as error:
                self._troubled(error)
                return
            said = self.room.look(self.writer.size, at / self.rate_hz, free)
            if said:
                self._say(said)

    def _say(self, text: str) -> None:
        self._publish(Event(self.waiting.block_end, "disk", text))

    def _publish(self, item: Event | Timing) -> None:
        """Say it on the bus, from where it comes into the recording like all else."""
        self.link.publish(topic(item), encode(item, self.spec.run))

    def end(self) -> None:
        """Write the last words and finish the file; BadInput where the disk does not take it."""
        end = self.waiting.end or self.waiting.block_end
        words: list[Event | Timing] = [self.watch.record(end)]
        if self.inbox.missed or self.inbox.dropped:
            text = f"recorder: {self.inbox.missed} messages missed, {self.inbox.dropped} dropped"
            words.append(Event(end, "recorder", text))
        if self.impossible:
            text = f"recorder: {self.impossible} messages left out, of impossible samples"
            words.append(Event(end, "recorder", text))
        self.reserve.release()
        self.thread.shutdown()
        try:
            self._synced(_done())
        except OSError as error:
            self._troubled(error)
        for _ in range(LAST_TRIES):
            try:
                while words:
                    word = words.pop()
                    self.writer.write(topic(word), encode(word, self.spec.run), word.index)
                self.writer.close()
                return
            except OSError as error:
                self._troubled(error)
                self.clock.wait_until(self.clock.now() + LAST_TRY_S)
        raise BadInput(f"the end of the recording could not be written: {self.trouble}")


def recorder(spec: Spec, part: str) -> None:
    """Writes everything on the bus to a part file, from the beginning if it is a successor."""
    with contextlib.suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, PRIORITY)
    bundle = spec.bundle()
    rate_hz, block = bundle.drive.rate_hz, bundle.profile.acquisition.block_samples
    link = open_spoke(bundle.rig.name, spec.endpoint, CONNECT_S)
    link.declare(("/run/timing", "/run/event"))
    inbox = link.subscribe(tuple(TOPIC_TYPES), history=True, capacity=CAPACITY)
    lock = Path(part).with_name(LOCK).open("a")
    fcntl.flock(lock, fcntl.LOCK_SH)  # until this process ends: nobody takes the parts away
    reserve = Reserve(Path(part).with_name("reserve"), round(RESERVE_S * bytes_per_s(bundle)))
    writer = LogWriter(Path(part), rate_hz)
    clock = RealClock()
    watch = Stopwatch("recorder", clock, block / rate_hz)
    room = Room(bundle.drive.planned_end / rate_hz)
    at_work = _Recorder(spec, link, inbox, writer, watch, room, reserve, rate_hz, clock)
    link.alive(token(spec, "recorder"))
    watch.begin()
    at_work.run()
    at_work.end()
    link.close()
