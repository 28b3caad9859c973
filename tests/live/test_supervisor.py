"""What the supervisor does when an order is lost, or a process hangs: with a clock of its own."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import pytest

from table_io.clock import ManualClock
from table_io.config.profile import OnDeathConfig
from table_io.records import RunStop, Timing
from twin.live.supervisor import (
    MAX_COMPONENT_SILENCE_S,
    MAX_RESTARTS,
    RESTART_ALLOWANCE_S,
    Supervisor,
)
from twin.transport.codec import encode_item, topic_for

RUN = "20260101-120000-quickstart"
TURN_S = 0.05


@dataclass
class Played:
    """Stands for children, inbox and link: who speaks, what the rig answers, what was done."""

    spoken: tuple[str, ...]
    answers: list[str | None]
    seconds: float = 60.0
    clock: ManualClock = field(default_factory=ManualClock)
    orders: list[tuple[str, str]] = field(default_factory=list)
    kills: list[str] = field(default_factory=list)
    _turns: int = 0

    def get(self, _: float) -> tuple[str, bytes]:
        self._turns += 1
        self.clock.wait_until(self.clock.now() + TURN_S)
        name = self.spoken[self._turns % len(self.spoken)]
        timing = Timing(self._turns, name, 0.0, 0.0, 0.0, 0, 0, 0.0, "normal")
        over = self.clock.now() > self.seconds
        item = RunStop(self._turns, "complete", "", ()) if over else timing
        return topic_for(item), encode_item(item, RUN)

    def send_command(self, name: str, text: str, timeout_s: float) -> str | None:
        self.orders.append((name, text.partition("\n")[2]))
        return self.answers.pop(0) if self.answers else "yes"

    def publish(self, *_: object) -> None:
        pass

    def child(self, component: str, *, died: bool = False, restarts: int = 0) -> Any:
        process = SimpleNamespace(returncode=1)
        return SimpleNamespace(
            process=process, has_exited=died, restarts=restarts, exit_reason="exit 1",
            last_output_line="x",
            kill=lambda: self.kills.append(component),
        )  # fmt: skip


def run_supervisor(played: Played, asked: Callable[[], str | None], **children: Any) -> Supervisor:
    """A supervisor that has attended a run to its end, with these children beside the usual."""
    spec: Any = SimpleNamespace(run=RUN)
    bus: Any = played
    supervisor = Supervisor(
        spec, OnDeathConfig(), played.clock, lambda _: None, asked, lambda _: None
    )
    usual = {name: played.child(name) for name in ("rig", "recorder", "gate", "twin")}
    supervisor.children = usual | children
    supervisor._supervise(bus, bus)
    return supervisor


def test_stop_is_repeated_until_the_rig_accepts_it() -> None:
    played = Played(("rig", "recorder", "gate"), [None, None, "refused: no"])
    run_supervisor(played, lambda: "interrupted")
    assert played.orders == [("stop", "interrupted")] * 4
    assert played.kills == []


def test_without_a_recorder_the_table_stops_though_the_first_order_is_lost() -> None:
    played = Played(("rig", "gate"), [None])
    dead = played.child("recorder", died=True, restarts=MAX_RESTARTS)
    supervisor = run_supervisor(played, lambda: None, recorder=dead)
    assert "recorder" not in supervisor.children
    assert played.orders == [("stop", "recorder died (exit 1)")] * 2


def test_a_second_recorder_that_hangs_stops_the_table_though_the_order_is_lost() -> None:
    played = Played(("rig", "gate"), [None], 2.5 * MAX_COMPONENT_SILENCE_S)
    run_supervisor(played, lambda: None)
    assert played.kills == ["recorder"] * 2
    assert played.orders == [("stop", "the recorder hangs")] * 2


@pytest.mark.parametrize(("spoken", "kills"), [(("rig", "recorder"), 2), (("rig", "gate"), 0)])
def test_a_gate_that_hangs_is_ended_and_the_table_goes_on(
    spoken: tuple[str, ...], kills: int
) -> None:
    played = Played(spoken, [], 2.5 * MAX_COMPONENT_SILENCE_S)
    run_supervisor(played, lambda: None)
    assert played.kills.count("gate") == kills
    assert bool(played.orders) == ("recorder" not in spoken)


def test_a_recorder_that_was_restarted_has_time_to_start(monkeypatch: pytest.MonkeyPatch) -> None:
    played = Played(("rig", "gate"), [], seconds=1.0)
    supervisor = run_supervisor(played, lambda: None)
    monkeypatch.setattr(Supervisor, "_start", lambda *_: None)
    bus: Any = played
    supervisor._handle_death("recorder", bus)
    supervisor.last_message_s["gate"] = math.inf
    for after_s, kills in (
        (MAX_COMPONENT_SILENCE_S + RESTART_ALLOWANCE_S - 1.0, []),
        (2.0, ["recorder"]),
    ):
        played.clock.time_s += after_s
        supervisor._kill_hung()
        assert played.kills == kills
