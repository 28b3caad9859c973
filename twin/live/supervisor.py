"""Supervisor: starts, monitors, restarts and finally ends the child processes of a live run."""

import contextlib
import logging
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

from table_io.clock import Clock
from table_io.config.profile import OnDeathConfig
from table_io.errors import InputError
from table_io.records import Comparison, Event, Fault, RunStop, Timing
from twin.live.process_config import ProcessConfig, process_token
from twin.recording.merge import LOCK_FILE
from twin.recording.run_paths import PARTS_FOLDER
from twin.system.files import SOCKET_PREFIX, lock_file, make_private_folder
from twin.transport.codec import RECORD_TOPICS, Item, decode_item, encode_item, topic_for
from twin.transport.endpoint import LOCAL_SOCKET_PREFIX, check_can_listen
from twin.transport.reliable_subscriber import ReliableSubscriber
from twin.transport.zenoh_link import BusLink, open_spoke

log = logging.getLogger(__name__)
READY_TIMEOUT_S = 30.0
FINISH_TIMEOUT_S = 15.0  # after the last sample, for all processes to finish
MAX_RIG_SILENCE_S = 5.0  # the rig reports every second; after this it hangs
MAX_COMPONENT_SILENCE_S = 10.0  # twice this is well within the history that the bus holds
RESTART_ALLOWANCE_S = 10.0  # in addition, after a restart: a busy computer starts slowly
SUPERVISED_COMPONENTS = ("recorder", "gate")
DRAIN_S = 0.1  # after a process died, to receive its last messages
MAX_RESTARTS = 5
WATCHED_TOPICS = tuple(RECORD_TOPICS.values())


@dataclass(slots=True)
class ChildProcess:
    """Child process of the run; its output goes to a log file in the run's folder."""

    component: str
    process: subprocess.Popen[bytes]
    log_path: Path
    restarts: int = 0

    @property
    def has_exited(self) -> bool:
        return self.process.poll() is not None

    @property
    def exit_reason(self) -> str:
        """Signal name or exit code with which the process ended."""
        code = self.process.returncode
        return signal.Signals(-code).name if code < 0 else f"exit {code}"

    @property
    def output(self) -> str:
        """What the process and its predecessors wrote to their log file."""
        return self.log_path.read_text(errors="replace").strip()

    @property
    def last_output_line(self) -> str:
        """Last line that the process wrote to its log file."""
        lines = self.output.splitlines()
        return lines[-1] if lines else "no output"

    def close_input(self) -> None:
        """Close the standard input of the process, which ends it in order."""
        stdin = self.process.stdin
        if stdin is not None and not stdin.closed:
            stdin.close()

    def kill(self) -> None:
        os.killpg(self.process.pid, signal.SIGKILL)


@dataclass(slots=True)
class Supervisor:
    """Supervisor (watchdog) of one live run; `on_record` receives every record except blocks.

    `poll_interrupt` returns the reason once a stop is requested, None before.
    """

    config: ProcessConfig
    on_death: OnDeathConfig
    clock: Clock
    on_record: Callable[[Item], None]
    poll_interrupt: Callable[[], str | None]
    print_line: Callable[[str], None]
    children: dict[str, ChildProcess] = field(default_factory=dict)
    compared_to: int = 0
    last_message_s: dict[str, float] = field(default_factory=dict)  # of each component
    twin_missing: bool = False  # a twin died and its successor has not yet published the Fault
    run_stop: RunStop | None = None
    stop_reason: str = ""  # why the table has to stop
    _part_count: int = 0
    _hung_recorders: int = 0
    _stop_accepted: bool = False  # by the rig

    @property
    def parts_folder(self) -> Path:
        return Path(self.config.folder) / PARTS_FOLDER

    def run(self) -> bool:
        """Run the test to its end; False if it was interrupted before it began.

        InputError if it cannot begin. A run that did not begin leaves no folder behind.
        """
        self.parts_folder.mkdir(parents=True)
        socket_folder = make_private_folder(SOCKET_PREFIX)
        self.config = replace(self.config, endpoint=f"{LOCAL_SOCKET_PREFIX}{socket_folder / 'bus'}")
        self.config.write(self.parts_folder / "spec.json")
        lock = (self.parts_folder / LOCK_FILE).open("a")
        lock_file(lock)
        began = False
        try:
            link, inbox = self._start_all()
            began = True
            self._supervise(link, inbox)
            self._finish(link)
        except _InterruptedBeforeStartError:
            self.print_line("interrupted before the start: nothing moved")
        except _RigDiedError as error:
            self.print_line(f"{error}; what was recorded is kept")
        finally:
            self._reap()
            lock.close()
            shutil.rmtree(socket_folder, ignore_errors=True)
            if not began:
                self._remove_folders()
        return began

    def _start_all(self) -> tuple[BusLink, ReliableSubscriber]:
        """Start all processes, wait until they are ready, and start the rig."""
        check_can_listen(self.config.rig_name, self.config.listen, bool(self.config.keys))
        self._start("rig")
        link = self._connect(self.config.rig_name)
        self._wait_until_ready(link)
        for component in self._other_components():
            self._start(component)
        self._wait_until_ready(link)
        inbox = link.subscribe(WATCHED_TOPICS, history=True, capacity=5000)
        link.declare(("/run/event", "/run/fault"))
        if self._send_command(link, "start") != "yes":
            raise InputError("the rig does not answer; nothing moved")
        log.info("run %s has started", self.config.run)
        return link, inbox

    def _other_components(self) -> tuple[str, ...]:
        """Return the components to start in addition to the rig."""
        wanted = {"twin": not self.config.remote_twin, "viewer": bool(self.config.serve_view)}
        return tuple(
            component
            for component in ("gate", "twin", "recorder", "viewer")
            if wanted.get(component, True)
        )

    def _send_command(self, link: BusLink, name: str, reason: str = "") -> str | None:
        """Send a command to the rig and return its answer, None on timeout."""
        return link.send_command(name, f"{self.config.run}\n{reason}", timeout_s=2.0)

    def _remove_folders(self) -> None:
        """Remove the folders of a run that never began, so that it can be started again."""
        shutil.rmtree(self.parts_folder)
        with contextlib.suppress(OSError):
            self.parts_folder.parent.rmdir()

    def _start(self, component: str, argument: str = "") -> None:
        """Start or restart a process."""
        if component == "recorder":
            self._part_count += 1
            argument = str(self.parts_folder / f"part-{self._part_count:03d}.mcap")
        predecessor = self.children.get(component)
        self.children[component] = start_process(component, self.parts_folder, argument)
        log.info("%s started, process %d", component, self.children[component].process.pid)
        if predecessor is not None:
            self.children[component].restarts = predecessor.restarts + 1

    def _connect(self, rig_name: str) -> BusLink:
        deadline_s = self.clock.now() + READY_TIMEOUT_S
        while self.clock.now() < deadline_s and not self.children["rig"].has_exited:
            self._raise_if_interrupted()
            try:
                return open_spoke(rig_name, self.config.endpoint, 0.3)
            except InputError:
                continue
        raise InputError(f"the rig did not start: {self.children['rig'].last_output_line}")

    def _raise_if_interrupted(self) -> None:
        if self.poll_interrupt():
            raise _InterruptedBeforeStartError

    def _wait_until_ready(self, link: BusLink) -> None:
        """Wait until all started processes are alive; the table does not move before."""
        deadline_s = self.clock.now() + READY_TIMEOUT_S
        expected = {process_token(self.config, component) for component in self.children}
        while not expected <= link.list_components():
            self._raise_if_interrupted()
            for component, child in self.children.items():
                if child.has_exited:
                    raise InputError(f"the {component} did not start: {child.last_output_line}")
            if self.clock.now() > deadline_s:
                missing = ", ".join(sorted(expected - link.list_components()))
                raise InputError(f"not ready after {READY_TIMEOUT_S:g} s: {missing}")
            self.clock.wait_until(self.clock.now() + 0.02)

    def _supervise(self, link: BusLink, inbox: ReliableSubscriber) -> None:
        """Monitor until the rig has ended: show records, forward a stop, restart dead processes."""
        self.last_message_s = dict.fromkeys(("rig", *SUPERVISED_COMPONENTS), self.clock.now())
        while self.run_stop is None:
            self._receive(inbox, 0.1)
            if self.clock.now() - self.last_message_s["rig"] > MAX_RIG_SILENCE_S:
                text = f"the rig has been silent for {MAX_RIG_SILENCE_S:g} s: if the table still "
                raise _RigDiedError(f"{text}moves, use its own stop")
            self._kill_hung()
            for component, child in list(self.children.items()):
                if child.has_exited and self.run_stop is None:
                    self._receive(inbox, DRAIN_S)
                    if self.run_stop is None:
                        self._handle_death(component, link)
            self._request_stop(link)
        if self.twin_missing:
            self._publish_fault(link, self.run_stop.index)

    def _request_stop(self, link: BusLink) -> None:
        """Send the stop request to the rig, repeated until the rig accepts it."""
        self.stop_reason = self.stop_reason or self.poll_interrupt() or ""
        if self.stop_reason and not self._stop_accepted and self.run_stop is None:
            answer = self._send_command(link, "stop", self.stop_reason)
            log.info("stop requested (%s): %s", self.stop_reason, answer or "no answer")
            self._stop_accepted = answer == "yes"

    def _kill_hung(self) -> None:
        """Kill a recorder or gateway that hangs; a second hung recorder stops the table."""
        for component in SUPERVISED_COMPONENTS:
            silence_s = self.clock.now() - self.last_message_s[component]
            if component not in self.children or silence_s < MAX_COMPONENT_SILENCE_S:
                continue
            self.print_line(f"the {component} has been silent for {silence_s:.0f} s; ending it")
            log.warning("%s killed: silent for %.0f s", component, silence_s)
            self.children[component].kill()
            self.last_message_s[component] = self.clock.now()  # restarts the timeout
            if component == "recorder":
                self._hung_recorders += 1
        if self._hung_recorders > 1:
            self.stop_reason = self.stop_reason or "the recorder hangs"

    def _receive(self, inbox: ReliableSubscriber, seconds: float) -> None:
        deadline_s = self.clock.now() + seconds
        while (remaining_s := deadline_s - self.clock.now()) > 0:
            message = inbox.get(remaining_s)
            if message is None:
                return
            run, item = decode_item(*message)
            if run != self.config.run:
                continue
            if isinstance(item, Comparison):
                self.compared_to = max(self.compared_to, item.index + item.count)
            elif isinstance(item, Timing):
                self.last_message_s[item.component] = self.clock.now()
            elif isinstance(item, Fault) and item.component == "twin":
                self.twin_missing = False
            elif isinstance(item, RunStop):
                self.run_stop = item
            self.on_record(item)

    def _handle_death(self, component: str, link: BusLink) -> None:
        """Report a dead process, restart it, and stop the table if the profile requires it."""
        child = self.children[component]
        cause = f"{component} died ({child.exit_reason})"
        if component == "rig":
            log.warning("%s; what was recorded is kept", cause)
            raise _RigDiedError(
                f"the rig process died ({child.exit_reason}): {child.last_output_line}"
            )
        event = Event(self.compared_to, "died", cause)
        link.publish(topic_for(event), encode_item(event, self.config.run))
        given_up = child.restarts >= MAX_RESTARTS
        # Unrecorded motion is worthless: the table stops when no recorder is left.
        must_stop = getattr(self.on_death, component, "") == "stop"
        must_stop = must_stop or (given_up and component == "recorder")
        outcome = f"it stays down after {MAX_RESTARTS} restarts" if given_up else "restarting it"
        log.warning("%s; %s", cause, outcome)
        self.print_line(f"{cause}; {outcome}, the table {'stops' if must_stop else 'goes on'}")
        if child.process.returncode > 0:
            self.print_line(f"  its last output: {child.last_output_line}")
        if must_stop:
            self.stop_reason = self.stop_reason or cause
        if component == "twin":
            self.twin_missing = True
        if given_up:
            del self.children[component]
            return
        self.last_message_s[component] = self.clock.now() + RESTART_ALLOWANCE_S
        self._start(component, str(self.compared_to) if component == "twin" else "")

    def _publish_fault(self, link: BusLink, end: int) -> None:
        """Publish the Fault of a twin that was not restarted in time."""
        if self.compared_to < end:
            fault = Fault(end, "twin", self.compared_to, end, "the process died near the end")
            link.publish(topic_for(fault), encode_item(fault, self.config.run))
            self.on_record(fault)

    def _finish(self, link: BusLink) -> None:
        """Finish the processes in order: subscribers before the publishers they depend on."""
        deadline_s = self.clock.now() + FINISH_TIMEOUT_S
        for component in ("recorder", "viewer", "gate", "twin", "rig"):
            if component in self.children:
                if component in ("gate", "twin", "rig"):
                    self.children[component].close_input()
                self._await(component, link, max(deadline_s, self.clock.now() + 0.1))
        link.close()

    def _await(self, component: str, link: BusLink, deadline_s: float) -> None:
        """Wait for a process to end; a recorder that started late may still ask for a Fault."""
        child = self.children[component]
        while not child.has_exited:
            if self.clock.now() > deadline_s:
                self.print_line(f"{component} does not finish; ending it")
                return
            link.serve()
            self.clock.wait_until(self.clock.now() + 0.01)
        if child.process.returncode:
            self.print_line(f"the {component} failed: {child.last_output_line}")

    def _reap(self) -> None:
        """End all remaining processes: close their input, then kill."""
        for child in self.children.values():
            child.close_input()
        for child in self.children.values():
            try:
                child.process.wait(5.0 if child.component != "rig" else 10.0)
            except subprocess.TimeoutExpired:
                child.kill()
                with contextlib.suppress(subprocess.TimeoutExpired):
                    child.process.wait(5.0)  # a process on a failed disk may never end
            if log.isEnabledFor(logging.INFO):
                log.info("%s ended; its output:\n%s", child.component, child.output)


class _InterruptedBeforeStartError(Exception):
    """The run was interrupted before it began."""


class _RigDiedError(Exception):
    """The rig process died or hangs; the recording is kept."""


def start_process(component: str, parts_folder: Path, argument: str) -> ChildProcess:
    """Start a process in its own session, so that Ctrl-C does not reach it.

    It imports nothing from the user's working folder (-P), which may hold a folder `twin`.
    """
    log_path = parts_folder / f"{component}.log"
    command = [sys.executable, "-P", "-m", "twin.live.processes", component]
    command += [str(parts_folder / "spec.json"), argument]
    with log_path.open("ab") as out:
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=out, stderr=out, start_new_session=True
        )
    return ChildProcess(component, process, log_path)
