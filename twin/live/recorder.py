"""Recorder of a live run: writes all bus traffic to a part file and handles disk errors."""

import contextlib
import logging
import os
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from table_io.block import Block
from table_io.clock import Clock, RealClock
from table_io.errors import InputError
from table_io.records import Event, RunStart, RunStop, Timing
from twin.live.process_config import (
    CONNECT_TIMEOUT_S,
    INBOX_CAPACITY,
    MAX_QUIET_S,
    LatencyHistogram,
    ProcessConfig,
    is_orphaned,
    process_token,
)
from twin.recording.mcap_log import LogTimeError, LogWriter
from twin.recording.merge import LOCK_FILE
from twin.setup.disk import RESERVE_S, DiskForecast, DiskReserve, bytes_per_s, free_bytes
from twin.system.files import lock_file
from twin.transport.codec import TOPIC_TYPES, Item, WireError, decode_item, encode_item, topic_for
from twin.transport.reliable_subscriber import ReliableSubscriber
from twin.transport.zenoh_link import BusLink, open_spoke

log = logging.getLogger(__name__)
RECORDER_NICENESS = -10  # ahead of other programs, behind the rig and the twin
FLUSH_INTERVAL_S = 0.15  # so that a crash loses at most 0.25 s, on a busy computer too
SYNC_INTERVAL_S = 5.0
REPORT_INTERVAL_S = 1.0  # between checks of free disk space, and between Timing records
RESTORE_BYTES = 32 * 2**20  # of a lost file, between two messages
MAX_CLOSE_TRIES = 20  # to close the file on a failing disk, one every CLOSE_RETRY_S
CLOSE_RETRY_S = 0.25


@dataclass(slots=True)
class CompletionTracker:
    """Completion of a run: its end, every measured block, and the twin's final Timing."""

    has_started: bool = False
    end: int | None = None
    block_end: int = 0
    twin_finished: bool = False

    def update(self, item: Item) -> None:
        if isinstance(item, RunStart):
            self.has_started = True
        elif isinstance(item, RunStop):
            self.end = item.index
        elif isinstance(item, Block) and item.stream == "meas":
            self.block_end = max(self.block_end, item.end)
        elif isinstance(item, Timing) and item.component == "twin":
            self.twin_finished = self.end is not None and item.index >= self.end

    @property
    def is_complete(self) -> bool:
        return self.end is not None and self.block_end >= self.end and self.twin_finished


def _make_completed_future() -> Future[None]:
    future: Future[None] = Future()
    future.set_result(None)
    return future


@dataclass(slots=True)
class Recorder:
    """Recorder loop; `disk_error` is the last error of the disk, "" while it works.

    `stop_reason` is why the table has to stop. It is never cleared: a disk that was full for a
    moment is not trusted again.
    """

    config: ProcessConfig
    link: BusLink
    inbox: ReliableSubscriber
    writer: LogWriter
    latency: LatencyHistogram
    disk_forecast: DiskForecast
    reserve: DiskReserve
    rate_hz: float
    clock: Clock
    sync_interval_s: float = SYNC_INTERVAL_S
    # A sync takes up to 0.2 s; in a thread it does not delay flushing.
    executor: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(1))
    pending_sync: Future[None] = field(default_factory=_make_completed_future)
    completion: CompletionTracker = field(default_factory=CompletionTracker)
    disk_error: str = ""
    stop_reason: str = ""
    stop_accepted: bool = False
    is_restoring: bool = False  # the file was deleted or moved, and is written again
    sync_failed: bool = False  # data written since the last good sync may be lost
    busy_s: float = 0.0  # since the last measured block
    impossible_count: int = 0  # payloads whose sample index is out of range

    def run(self) -> None:
        """Record until the run is complete, or silent after its end or without a supervisor."""
        flushed_s = synced_s = reported_s = received_s = self.clock.now()
        while not self.completion.is_complete or self.clock.now() - received_s < 0.3:
            message = self.inbox.get(0.05)
            time_s = self.clock.now()
            if message is not None:
                received_s = time_s
                self._write(*message)
            elif time_s - received_s > MAX_QUIET_S and (
                self.completion.end is not None or is_orphaned()
            ):
                break
            if self.is_restoring:
                self._restore()
            if time_s - flushed_s > FLUSH_INTERVAL_S:
                self._flush(sync=time_s - synced_s > self.sync_interval_s)
                synced_s = time_s if time_s - synced_s > self.sync_interval_s else synced_s
                flushed_s = time_s
            if time_s - reported_s > REPORT_INTERVAL_S:
                self._report()
                reported_s = time_s
            self.busy_s += self.clock.now() - time_s

    def _write(self, topic_name: str, payload: bytes) -> None:
        try:
            run, item = decode_item(topic_name, payload)
        except WireError:  # not sent by this run
            return
        if run != self.config.run:
            return
        if isinstance(item, RunStart):
            self.writer.write_run_description(item)
        try:
            self.writer.write_item(topic_name, item, run, payload)
        except LogTimeError:  # an index beyond any sample of this run
            self.impossible_count += 1
            return
        except OSError as error:
            self._handle_disk_error(error)
        self.completion.update(item)
        if isinstance(item, Block) and item.stream == "meas":
            self.latency.add(self.busy_s)
            self.busy_s = 0.0

    def _flush(self, sync: bool) -> None:
        """Flush to the operating system and, with `sync`, start a sync to the disk."""
        try:
            self.writer.flush()
            if sync and self.pending_sync.done():
                self._replace_sync(self.executor.submit(self.writer.sync))
        except OSError as error:
            self._handle_disk_error(error)
        else:
            if self.disk_error and not self.sync_failed and not self.is_restoring:
                self._publish_event("the disk takes the recording again; what waited is written")
                self.disk_error = ""

    def _replace_sync(self, next_sync: Future[None]) -> None:
        """Raise the OSError of the previous sync: the system reports lost data only once."""
        previous_sync, self.pending_sync = self.pending_sync, next_sync
        try:
            previous_sync.result()
        except OSError:
            self.sync_failed = True
            raise

    def _handle_disk_error(self, error: OSError) -> None:
        """Request a stop of the table; unwritten data stays in memory."""
        self.reserve.release()
        if not self.disk_error:
            self.disk_error = f"{error.strerror}: {error.filename}"
            log.error("cannot write the recording (%s)", self.disk_error)
            self.stop_reason = self.stop_reason or f"cannot write the recording ({self.disk_error})"
            self._publish_event(
                f"{self.stop_reason}: the table is stopped; what was written stays readable, and "
                "the rest is kept if there is room soon"
            )

    def _stop_after_loss(self) -> None:
        """Request a stop of the table: what deleted or moved the recording may do so again."""
        self.is_restoring = True
        self.stop_reason = f"the recording in {self.writer.path.parent.parent} was deleted or moved"
        self._publish_event(f"{self.stop_reason}: the table is stopped, the file written again")

    def _restore(self) -> None:
        """Write on at a lost file: a part at a time, so that the run is recorded meanwhile."""
        try:
            self.is_restoring = not self.writer.restore(RESTORE_BYTES)
        except OSError as error:
            self._handle_disk_error(error)
        else:
            if not self.is_restoring:
                self._publish_event(f"the recording is whole again: {self.writer.path}")

    def _report(self) -> None:
        """Publish Timing, check disk space, and repeat a stop request until it is accepted."""
        if not self.completion.has_started or self.completion.end is not None:
            return
        index = self.completion.block_end
        self._publish(self.latency.to_timing(index))
        if self.stop_reason and not self.stop_accepted:
            text = f"{self.config.run}\n{self.stop_reason}"
            self.stop_accepted = self.link.send_command("stop", text, timeout_s=0.5) == "yes"
        elif not self.stop_reason:
            try:
                if self.writer.is_lost:
                    self._stop_after_loss()
                    return
                free = free_bytes(self.writer.path.parent)
            except OSError as error:
                self._handle_disk_error(error)
                return
            warning = self.disk_forecast.check(self.writer.size, index / self.rate_hz, free)
            if warning:
                self._publish_event(warning)

    def _publish_event(self, text: str) -> None:
        self._publish(Event(self.completion.block_end, "disk", text))

    def _publish(self, item: Event | Timing) -> None:
        """Publish on the bus, from which it is recorded like every other message."""
        self.link.publish(topic_for(item), encode_item(item, self.config.run))

    def finish(self) -> None:
        """Write the final records and close the file; InputError if the disk fails."""
        end = self.completion.end or self.completion.block_end
        records: list[Event | Timing] = [self.latency.to_timing(end)]
        if self.inbox.missed or self.inbox.dropped:
            text = f"recorder: {self.inbox.missed} messages missed, {self.inbox.dropped} dropped"
            records.append(Event(end, "recorder", text))
        if self.impossible_count:
            text = f"recorder: {self.impossible_count} messages left out, of impossible samples"
            records.append(Event(end, "recorder", text))
        self.reserve.release()
        self.executor.shutdown()
        try:
            self._replace_sync(_make_completed_future())
        except OSError as error:
            self._handle_disk_error(error)
        for _ in range(MAX_CLOSE_TRIES):
            try:
                while records:
                    record = records.pop()
                    self.writer.write(
                        topic_for(record), encode_item(record, self.config.run), record.index
                    )
                self.writer.close()
                return
            except OSError as error:
                self._handle_disk_error(error)
                self.clock.wait_until(self.clock.now() + CLOSE_RETRY_S)
        raise InputError(f"the end of the recording could not be written: {self.disk_error}")


def run_recorder(config: ProcessConfig, part: str) -> None:
    """Record all bus traffic to a part file; after a restart again from the beginning."""
    with contextlib.suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, RECORDER_NICENESS)
    run_config = config.make_run_config()
    rate_hz, block_samples = run_config.drive.rate_hz, run_config.profile.acquisition.block_samples
    link = open_spoke(run_config.rig.name, config.endpoint, CONNECT_TIMEOUT_S)
    link.declare(("/run/timing", "/run/event"))
    inbox = link.subscribe(tuple(TOPIC_TYPES), history=True, capacity=INBOX_CAPACITY)
    lock = Path(part).with_name(LOCK_FILE).open("a")
    lock_file(lock)  # held until exit: the parts are not merged before
    reserve = DiskReserve(
        Path(part).with_name("reserve"), round(RESERVE_S * bytes_per_s(run_config))
    )
    writer = LogWriter(Path(part), rate_hz)
    clock = RealClock()
    latency = LatencyHistogram("recorder", clock, block_samples / rate_hz)
    disk_forecast = DiskForecast(run_config.expected_s)
    recorder = Recorder(
        config, link, inbox, writer, latency, disk_forecast, reserve, rate_hz, clock
    )
    link.declare_alive(process_token(config, "recorder"))
    latency.start()
    recorder.run()
    recorder.finish()
    link.close()
