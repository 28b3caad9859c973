"""`shaketwin join`: record, or run the twin for, a test that runs on another computer."""

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from table_io.clock import Clock, RealClock
from table_io.errors import InputError
from table_io.records import Event, RunStart
from twin.live.control import find_run
from twin.live.process_config import INBOX_CAPACITY, MAX_QUIET_S, ProcessConfig
from twin.live.recorder import FLUSH_INTERVAL_S, SYNC_INTERVAL_S, CompletionTracker
from twin.recording.mcap_log import LogTimeError, LogWriter
from twin.recording.merge import LOCK_FILE, merge_run_parts
from twin.recording.run_paths import PARTS_FOLDER
from twin.security.access_control import user_name
from twin.security.credentials import Credentials
from twin.setup.folders import RUNS_FOLDER, make_output_folder
from twin.system.exit_codes import EXIT_GAPS, EXIT_INTERRUPTED
from twin.system.files import lock_file
from twin.system.terminal import catch_interrupts, print_line
from twin.transport.codec import TOPIC_TYPES, WireError, decode_item, encode_item, topic_for
from twin.transport.endpoint import make_endpoint_error
from twin.transport.reliable_subscriber import ReliableSubscriber
from twin.transport.zenoh_link import BusLink, open_spoke

CONNECT_TIMEOUT_S = 5.0
MAX_SILENCE_S = 60.0  # without a message, after which a recorder closes its file


def join_as_recorder(connect: str, rig: str, out: Path | None, keys: Credentials | None) -> int:
    """Record a running test to a folder on this computer; return the exit code.

    It starts with the messages still cached by the gateway: a recorder that joins within 50 s of
    the start has the whole test.
    """
    link = open_spoke(rig, connect, CONNECT_TIMEOUT_S, keys)
    try:
        run = find_run(link, connect, rig)
        folder = make_output_folder(
            out if out is not None else RUNS_FOLDER / f"{run}-attended", run
        )
        link.declare_alive(f"observer.{user_name(keys)}.recorder")
        print_line(f"recording {run} -> {folder}; Ctrl-C ends the recording, not the test")
        with catch_interrupts("ending the recording; the test goes on") as poll_interrupt:
            inbox = link.subscribe(tuple(TOPIC_TYPES), history=True, capacity=INBOX_CAPACITY)
            is_complete = record_run(run, inbox, folder, poll_interrupt)
            interrupted = poll_interrupt() is not None
    finally:
        link.close()
    print_line(f"{merge_run_parts(folder)}; for its report: shaketwin report {folder}")
    return EXIT_INTERRUPTED if interrupted else 0 if is_complete else EXIT_GAPS


def join_as_twin(connect: str, rig: str, keys: Credentials | None) -> int:
    """Run the twin for a test that was started with --remote-twin; return the exit code."""
    from twin.live.twin_process import run_pipeline  # slow import, needed for a twin only

    link = open_spoke(rig, connect, CONNECT_TIMEOUT_S, keys)
    try:
        config, missed_from = _fetch_config(link, connect, rig)
        link.declare_alive(f"observer.{user_name(keys)}.twin")
        print_line(f"computing for {config.run}; Ctrl-C ends it, not the test")
        run_pipeline(config, missed_from, link, is_abandoned=lambda: False)
    except KeyboardInterrupt:
        print_line("the twin has ended; the test goes on")
        return EXIT_INTERRUPTED
    finally:
        link.close()
    return 0


def _fetch_config(link: BusLink, connect: str, rig_name: str) -> tuple[ProcessConfig, str]:
    """Fetch the run's configuration from the gateway; it is validated like a file when used.

    The second value is the sample up to which an earlier twin has compared, or "" if none has.
    """

    def fetch(path: str) -> str:
        answer = link.query(path, timeout_s=CONNECT_TIMEOUT_S)
        if answer is None:
            raise make_endpoint_error(
                connect,
                f"the running test does not send its configuration ({path})",
                "try again",
            )
        return answer.decode(errors="replace")

    run = find_run(link, connect, rig_name)
    status = json.loads(fetch("state/status"))
    if not status.get("remote_twin"):
        raise InputError(
            "this run computes its own twin",
            where=run,
            remedy="start it with --remote-twin to compute the twin here",
        )
    profile, rig, model = (fetch(f"config/{section}") for section in ("profile", "rig", "model"))
    name = str(json.loads(fetch("config/run"))["name"])
    compared_to = int(status.get("compared", 0))
    return ProcessConfig(run, name, "", "", profile, rig, model), str(
        compared_to
    ) if compared_to else ""


def record_run(
    run: str, inbox: ReliableSubscriber, folder: Path, poll_interrupt: Callable[[], str | None]
) -> bool:
    """Record a run to a part file in the folder; True if no message is known to be missing."""
    parts_folder = folder / PARTS_FOLDER
    parts_folder.mkdir()
    with (parts_folder / LOCK_FILE).open("a") as lock:
        lock_file(lock)
        recorder = _JoinedRecorder(run, parts_folder / "part-001.mcap", RealClock())
        recorder.record_until_complete(inbox, poll_interrupt)
        if recorder.writer is None:
            raise InputError(
                "nothing was recorded: the test's beginning never came; is it over?", where=folder
            )
        recorder.finish(inbox.missed)
    return inbox.missed == 0 and recorder.completion.end is not None


@dataclass(slots=True)
class _JoinedRecorder:
    """Recorder of a joined run; messages received before its RunStart are buffered."""

    run: str
    path: Path
    clock: Clock
    writer: LogWriter | None = None
    completion: CompletionTracker = field(default_factory=CompletionTracker)
    _early_messages: list[tuple[str, bytes]] = field(default_factory=list)

    def record_until_complete(
        self, inbox: ReliableSubscriber, poll_interrupt: Callable[[], str | None]
    ) -> None:
        flushed_s = synced_s = received_s = self.clock.now()
        while poll_interrupt() is None:
            message = inbox.get(0.05)
            time_s = self.clock.now()
            if message is not None:
                received_s = time_s
                self.write(*message)
            elif time_s - received_s > (
                MAX_QUIET_S if self.completion.end is not None else MAX_SILENCE_S
            ):
                break
            if self.completion.is_complete and time_s - received_s > 0.3:
                break
            if self.writer is not None and time_s - flushed_s > FLUSH_INTERVAL_S:
                self.writer.flush()
                flushed_s = time_s
            if self.writer is not None and time_s - synced_s > SYNC_INTERVAL_S:
                self.writer.sync()
                synced_s = time_s

    def write(self, topic_name: str, payload: bytes) -> None:
        """Write one payload; payloads of other runs are ignored."""
        try:
            run, item = decode_item(topic_name, payload)
        except WireError:
            return
        if run != self.run:
            return
        if isinstance(item, RunStart) and self.writer is None:
            self.writer = LogWriter(self.path, item.rate_hz)
            self.writer.write_run_description(item)
        if self.writer is None:
            self._early_messages.append((topic_name, payload))
            return
        try:
            self.writer.write_item(topic_name, item, run, payload)
        except LogTimeError:  # an index beyond any sample of this run
            return
        self.completion.update(item)
        early_messages, self._early_messages = self._early_messages, []
        for message in early_messages:
            self.write(*message)

    def finish(self, missed: int) -> None:
        """Close the file, with an event for messages known to be missing."""
        assert self.writer is not None
        if missed:
            end = self.completion.end or self.completion.block_end
            event = Event(end, "recorder", f"attending recorder: {missed} messages missed")
            self.writer.write(topic_for(event), encode_item(event, self.run), event.index)
        self.writer.close()
