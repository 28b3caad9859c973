"""Starts the processes of a live run, watches them, restarts what died, ends them in order."""

import contextlib
import fcntl
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

from table_io.card import BadInput
from table_io.clock import Clock
from table_io.profile import OnDeath
from table_io.records import Comparison, Event, Fault, RunStop, Timing
from twin.service.child import Child, begin
from twin.service.parts import LOCK
from twin.service.spec import Spec, private_folder, token
from twin.stream.endpoint import INSIDE, refuse_taken
from twin.stream.folder import PARTS
from twin.stream.resend import Inbox
from twin.stream.wire import RECORD_TOPICS, Item, decode, encode, topic
from twin.stream.zenoh_link import Link, open_spoke

READY_S = 30.0
END_S = 15.0  # after the last sample, for everybody to finish
SILENT_S = 5.0  # the rig reports every second; after this it hangs
DEAF_S = 10.0  # so do the others; twice this is well before the bus forgets
DEADLINED = ("recorder", "gate")
DRAIN_S = 0.1  # after a death, for what the dead one had still sent
RESTARTS = 5
WATCHED = tuple(RECORD_TOPICS.values())


@dataclass(slots=True)
class Supervisor:
    """One live run. `watch` sees every small record; `asked` says why once someone wants a stop."""

    spec: Spec
    on_death: OnDeath
    clock: Clock
    watch: Callable[[Item], None]
    asked: Callable[[], str | None]
    say: Callable[[str], None]
    children: dict[str, Child] = field(default_factory=dict)
    compared_to: int = 0
    heard: dict[str, float] = field(default_factory=dict)  # when a component last spoke
    twin_missing: bool = False  # a twin died and its successor has not said so yet
    stop: RunStop | None = None
    stop_why: str = ""  # the table is to stop
    _parts: int = 0
    _deaf: int = 0  # recorders that hung
    _stopping: bool = False  # the rig has said that it stops

    @property
    def parts(self) -> Path:
        return Path(self.spec.folder) / PARTS

    def run(self) -> bool:
        """Play the run to its end; False where a person stopped it before it began.

        BadInput where it cannot begin. A run that did not begin leaves nothing behind.
        """
        self.parts.mkdir(parents=True)
        room = private_folder()
        self.spec = replace(self.spec, endpoint=f"{INSIDE}{room / 'bus'}")
        self.spec.write(self.parts / "spec.json")
        lock = (self.parts / LOCK).open("a")
        fcntl.flock(lock, fcntl.LOCK_SH)
        moved = False
        try:
            link, inbox = self._begin()
            moved = True
            self._attend(link, inbox)
            self._finish(link)
        except _NeverBeganError:
            self.say("interrupted before the start: nothing moved")
        except _RigDiedError as error:
            self.say(f"{error}; what was recorded is kept")
        finally:
            self._reap()
            lock.close()
            shutil.rmtree(room, ignore_errors=True)
            if not moved:
                self._clear()
        return moved

    def _begin(self) -> tuple[Link, Inbox]:
        """Start everybody, wait until all are there, and set the rig going."""
        refuse_taken(self.spec.rig, self.spec.listen, bool(self.spec.keys))
        self._start("rig")
        link = self._connect(self.spec.rig)
        self._ready(link)
        for component in self._beside():
            self._start(component)
        self._ready(link)
        inbox = link.subscribe(WATCHED, history=True, capacity=5000)
        link.declare(("/run/event", "/run/fault"))
        if self._order(link, "start") != "yes":
            raise BadInput("the rig does not answer; nothing moved")
        return link, inbox

    def _beside(self) -> tuple[str, ...]:
        """Who is started beside the rig."""
        wanted = {"twin": not self.spec.remote_twin, "viewer": bool(self.spec.serve_view)}
        return tuple(one for one in ("gate", "twin", "recorder", "viewer") if wanted.get(one, True))

    def _order(self, link: Link, name: str, why: str = "") -> str | None:
        """The rig's answer to a command of this run."""
        return link.request(name, f"{self.spec.run}\n{why}", timeout_s=2.0)

    def _clear(self) -> None:
        """Take away what a run that never began has left, so that it can be started again."""
        shutil.rmtree(self.parts)
        with contextlib.suppress(OSError):
            self.parts.parent.rmdir()

    def _start(self, component: str, argument: str = "") -> None:
        """Start or restart a process."""
        if component == "recorder":
            self._parts += 1
            argument = str(self.parts / f"part-{self._parts:03d}.mcap")
        before = self.children.get(component)
        self.children[component] = begin(component, self.parts, argument)
        if before is not None:
            self.children[component].restarts = before.restarts + 1

    def _connect(self, rig: str) -> Link:
        until = self.clock.now() + READY_S
        while self.clock.now() < until and not self.children["rig"].died:
            self._unless_asked()
            try:
                return open_spoke(rig, self.spec.endpoint, 0.3)
            except BadInput:
                continue
        raise BadInput(f"the rig did not start: {self.children['rig'].words}")

    def _unless_asked(self) -> None:
        if self.asked():
            raise _NeverBeganError

    def _ready(self, link: Link) -> None:
        """Wait until everybody started is there; nothing moves before."""
        until = self.clock.now() + READY_S
        wanted = {token(self.spec, component) for component in self.children}
        while not wanted <= link.components():
            self._unless_asked()
            for component, child in self.children.items():
                if child.died:
                    raise BadInput(f"the {component} did not start: {child.words}")
            if self.clock.now() > until:
                missing = ", ".join(sorted(wanted - link.components()))
                raise BadInput(f"not ready after {READY_S:g} s: {missing}")
            self.clock.wait_until(self.clock.now() + 0.02)

    def _attend(self, link: Link, inbox: Inbox) -> None:
        """Until the rig has ended: show what happens, pass a stop on, restart what died."""
        self.heard = dict.fromkeys(("rig", *DEADLINED), self.clock.now())
        while self.stop is None:
            self._listen(inbox, 0.1)
            if self.clock.now() - self.heard["rig"] > SILENT_S:
                text = f"the rig has been silent for {SILENT_S:g} s: if the table still moves, "
                raise _RigDiedError(f"{text}use its own stop")
            self._end_hung()
            for component, child in list(self.children.items()):
                if child.died and self.stop is None:
                    self._listen(inbox, DRAIN_S)
                    if self.stop is None:
                        self._bury(component, link)
            self._stop_if_due(link)
        if self.twin_missing:
            self._fault(link, self.stop.index)

    def _stop_if_due(self, link: Link) -> None:
        """Pass on why the table is to stop, again until the rig says that it does."""
        self.stop_why = self.stop_why or self.asked() or ""
        if self.stop_why and not self._stopping and self.stop is None:
            self._stopping = self._order(link, "stop", self.stop_why) == "yes"

    def _end_hung(self) -> None:
        """End a recorder or a gate that hangs; a second such recorder stops the table."""
        for component in DEADLINED:
            silent = self.clock.now() - self.heard[component]
            if component not in self.children or silent < DEAF_S:
                continue
            self.say(f"the {component} has been silent for {silent:.0f} s; ending it")
            self.children[component].kill()
            self.heard[component] = self.clock.now()  # its successor has as long
            if component == "recorder":
                self._deaf += 1
        if self._deaf > 1:
            self.stop_why = self.stop_why or "the recorder hangs"

    def _listen(self, inbox: Inbox, seconds: float) -> None:
        until = self.clock.now() + seconds
        while (left := until - self.clock.now()) > 0:
            arrived = inbox.get(left)
            if arrived is None:
                return
            run, item = decode(*arrived)
            if run != self.spec.run:
                continue
            if isinstance(item, Comparison):
                self.compared_to = max(self.compared_to, item.index + item.count)
            elif isinstance(item, Timing):
                self.heard[item.component] = self.clock.now()
            elif isinstance(item, Fault) and item.component == "twin":
                self.twin_missing = False
            elif isinstance(item, RunStop):
                self.stop = item
            self.watch(item)

    def _bury(self, component: str, link: Link) -> None:
        """Say what died and why, start a successor, stop the table where it must not go on."""
        child = self.children[component]
        how = f"{component} died ({child.how})"
        if component == "rig":
            raise _RigDiedError(f"the rig process died ({child.how}): {child.words}")
        event = Event(self.compared_to, "died", how)
        link.publish(topic(event), encode(event, self.spec.run))
        given_up = child.restarts >= RESTARTS
        # unrecorded motion is worthless: without a recorder the table does not go on
        stop = getattr(self.on_death, component, "") == "stop"
        stop = stop or (given_up and component == "recorder")
        fate = f"it stays down after {RESTARTS} restarts" if given_up else "restarting it"
        self.say(f"{how}; {fate}, the table {'stops' if stop else 'goes on'}")
        if child.process.returncode > 0:
            self.say(f"  its last words: {child.words}")
        if stop:
            self.stop_why = self.stop_why or how
        if component == "twin":
            self.twin_missing = True
        if given_up:
            del self.children[component]
            return
        self.heard[component] = self.clock.now()
        self._start(component, str(self.compared_to) if component == "twin" else "")

    def _fault(self, link: Link, end: int) -> None:
        """Record what a twin that did not come back has missed."""
        if self.compared_to < end:
            fault = Fault(end, "twin", self.compared_to, end, "the process died near the end")
            link.publish(topic(fault), encode(fault, self.spec.run))
            self.watch(fault)

    def _finish(self, link: Link) -> None:
        """Let everybody finish in order: those who listen, then those whom they still ask."""
        until = self.clock.now() + END_S
        for component in ("recorder", "viewer", "gate", "twin", "rig"):
            if component in self.children:
                if component in ("gate", "twin", "rig"):
                    self.children[component].dismiss()
                self._await(component, max(until - self.clock.now(), 0.1))
        link.close()

    def _await(self, component: str, seconds: float) -> None:
        try:
            if self.children[component].process.wait(seconds):
                self.say(f"the {component} failed: {self.children[component].words}")
        except subprocess.TimeoutExpired:
            self.say(f"{component} does not finish; ending it")

    def _reap(self) -> None:
        """End whatever still runs: first its input, then a signal."""
        for child in self.children.values():
            child.dismiss()
        for child in self.children.values():
            try:
                child.process.wait(5.0 if child.component != "rig" else 10.0)
            except subprocess.TimeoutExpired:
                child.kill()
                with contextlib.suppress(subprocess.TimeoutExpired):
                    child.process.wait(5.0)  # more, and it waits for a dead disk


class _NeverBeganError(Exception):
    """A person stopped the run before it began."""


class _RigDiedError(Exception):
    """The rig is gone; what was recorded is kept."""
