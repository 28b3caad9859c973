"""`shaketwin attend`: a recorder or a twin on another machine, for a test that runs elsewhere."""

import fcntl
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from table_io.card import BadInput
from table_io.clock import Clock, RealClock
from table_io.records import Event, RunStart
from twin.service.folders import RUNS, new_folder
from twin.service.outcome import EXIT_GAPS, EXIT_INTERRUPTED
from twin.service.parts import LOCK, gather
from twin.service.recorder import FLUSH_S, SYNC_S, Awaited
from twin.service.spec import CAPACITY, QUIET_S, Spec
from twin.service.tell import person, run_of
from twin.service.terminal import interruptible, say
from twin.stream.folder import PARTS
from twin.stream.keys import Keys
from twin.stream.mcap_log import ImpossibleTimeError, LogWriter
from twin.stream.resend import Inbox
from twin.stream.wire import TOPIC_TYPES, WireError, decode, encode, topic
from twin.stream.zenoh_link import Link, open_spoke

CONNECT_S = 5.0
SILENT_S = 60.0  # without a word, cut off or not, after which a recorder ends what it has


def attend_as_recorder(connect: str, rig: str, out: Path | None, keys: Keys | None) -> int:
    """Records a running test in a folder of this machine; the exit code.

    It takes what the gate still holds, so that one that comes within 50 s has the whole.
    """
    link = open_spoke(rig, connect, CONNECT_S, keys)
    try:
        run = run_of(link, connect, rig)
        folder = new_folder(out if out is not None else RUNS / f"{run}-attended", run)
        link.alive(f"observer.{person(keys)}.recorder")
        say(f"recording {run} -> {folder}; Ctrl-C ends the recording, not the test")
        with interruptible("ending the recording; the test goes on") as asked:
            inbox = link.subscribe(tuple(TOPIC_TYPES), history=True, capacity=CAPACITY)
            whole = _record(run, inbox, folder, asked)
            interrupted = asked() is not None
    finally:
        link.close()
    say(f"{gather(folder)}; shaketwin report {folder} makes its report")
    return EXIT_INTERRUPTED if interrupted else 0 if whole else EXIT_GAPS


def attend_as_twin(connect: str, rig: str, keys: Keys | None) -> int:
    """Computes for a running test that was started with --remote-twin; the exit code."""
    from twin.service.twinning import compute  # much to import, for a twin alone

    link = open_spoke(rig, connect, CONNECT_S, keys)
    try:
        spec, missed_from = _spec(link, connect, rig)
        link.alive(f"observer.{person(keys)}.twin")
        say(f"computing for {spec.run}; Ctrl-C ends it, not the test")
        compute(spec, missed_from, link, alone=lambda: False)
    except KeyboardInterrupt:
        say("the twin has ended; the test goes on")
        return EXIT_INTERRUPTED
    finally:
        link.close()
    return 0


def _spec(link: Link, connect: str, rig_name: str) -> tuple[Spec, str]:
    """What the gate says of its run; looked at like any file when it is used.

    With it, where a twin has been there before, the sample up to which that one had come.
    """

    def asked(path: str) -> str:
        answer = link.inquire(path, timeout_s=CONNECT_S)
        if answer is None:
            raise BadInput(f"endpoint {connect}: does not say what runs there ({path})")
        return answer.decode(errors="replace")

    run = run_of(link, connect, rig_name)
    status = json.loads(asked("state/status"))
    if not status.get("remote_twin"):
        raise BadInput(f"{run} has a twin of its own; start it with --remote-twin for one here")
    profile, rig, model = (asked(f"config/{one}") for one in ("profile", "rig", "model"))
    name = str(json.loads(asked("config/run"))["name"])
    compared = int(status.get("compared", 0))
    return Spec(run, name, "", "", profile, rig, model), str(compared) if compared else ""


def _record(run: str, inbox: Inbox, folder: Path, asked: Callable[[], str | None]) -> bool:
    """Everything of a run into a part in the folder; True where nothing is known to be missing."""
    parts = folder / PARTS
    parts.mkdir()
    with (parts / LOCK).open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_SH)
        taking = _Taking(run, parts / "part-001.mcap", RealClock())
        taking.run_until_over(inbox, asked)
        if taking.writer is None:
            raise BadInput(
                f"{folder}: nothing was recorded: the test's beginning never came; is it over?"
            )
        taking.end(inbox.missed)
    return inbox.missed == 0 and taking.waiting.end is not None


@dataclass(slots=True)
class _Taking:
    """What has been taken of a run; what came before its start waits, and is written after it."""

    run: str
    part: Path
    clock: Clock
    writer: LogWriter | None = None
    waiting: Awaited = field(default_factory=Awaited)
    _early: list[tuple[str, bytes]] = field(default_factory=list)

    def run_until_over(self, inbox: Inbox, asked: Callable[[], str | None]) -> None:
        flushed = synced = heard = self.clock.now()
        while asked() is None:
            arrived = inbox.get(0.05)
            now = self.clock.now()
            if arrived is not None:
                heard = now
                self.take(*arrived)
            elif now - heard > (QUIET_S if self.waiting.end is not None else SILENT_S):
                break
            if self.waiting.over and now - heard > 0.3:
                break
            if self.writer is not None and now - flushed > FLUSH_S:
                self.writer.flush()
                flushed = now
            if self.writer is not None and now - synced > SYNC_S:
                self.writer.sync()
                synced = now

    def take(self, name: str, payload: bytes) -> None:
        """Write one payload of this run; others are not ours."""
        try:
            run, item = decode(name, payload)
        except WireError:
            return
        if run != self.run:
            return
        if isinstance(item, RunStart) and self.writer is None:
            self.writer = LogWriter(self.part, item.rate_hz)
            self.writer.describe(item)
        if self.writer is None:
            self._early.append((name, payload))
            return
        try:
            self.writer.write(name, payload, item.index)
        except ImpossibleTimeError:  # so far away is no sample of this run, whatever it says
            return
        self.waiting.heard(item)
        early, self._early = self._early, []
        for one in early:
            self.take(*one)

    def end(self, missed: int) -> None:
        """Finish the file; what is known to be missing is said in it."""
        assert self.writer is not None
        if missed:
            end = self.waiting.end or self.waiting.block_end
            event = Event(end, "recorder", f"attending recorder: {missed} messages missed")
            self.writer.write(topic(event), encode(event, self.run), event.index)
        self.writer.close()
