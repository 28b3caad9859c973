"""The machine as a process of its own: what it says, how it watches, how it comes to rest."""

import contextlib
import json
import math
import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from table_io.backends import HEARTBEAT_TIMEOUT_S
from table_io.backends.machine.protocol import (
    MachineMessage,
    MessageKind,
    ProtocolError,
    Refusal,
    text_message,
    values_message,
)
from table_io.block import Float1D
from table_io.config.base import parse_toml
from table_io.config.rig import RigConfig
from table_io.sim.machine.flight_recorder import FlightRecorder
from table_io.sim.machine.table import SimulatedMachine
from tests.builders.drives import make_bump
from tests.builders.flight_records import read_flight_record
from tests.builders.profiles import SPECIMEN
from tests.builders.rigs import read_rig_text
from tests.input_errors import raises_input_error

RATE_HZ = 2000.0
TEXT = read_rig_text("machine")
RIG = parse_toml(TEXT, RigConfig, "machine")
SCALE = RIG.output.volts_per_m
TICK_S = 0.005
LATE = """
[[simulated.faults]]
kind = "late"
at_s = 0.2
size = 0.1
"""
STALL = """
[[simulated.faults]]
kind = "stall"
at_s = 0.2
"""

OIL_LOSS = """
[[simulated.faults]]
kind = "oil_loss"
at_s = 0.5
size = 0.05
"""


def claim(rig: RigConfig = RIG, rate_hz: float = RATE_HZ, **changes: object) -> MachineMessage:
    """What a controller says first."""
    fields = {
        "rate_hz": rate_hz,
        "specimen": SPECIMEN.model_dump(),
        "output": rig.output.model_dump(),
        "sensors": [sensor.model_dump() for sensor in rig.sensors],
    }
    return text_message(MessageKind.CLAIM, json.dumps(fields | changes))


def sine(seconds: float, amplitude_m: float = 5e-3, f: float = 2.0) -> Float1D:
    """Volts of a motion that grows smoothly and goes on: its end is in motion."""
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    x = np.clip(t / 0.5, 0.0, 1.0)
    grows = x**3 * (10.0 + x * (-15.0 + 6.0 * x))
    metres: Float1D = amplitude_m * grows * np.sin(2 * np.pi * f * t)
    return metres * SCALE


def acceleration(metres: Float1D) -> float:
    """Largest acceleration of a command in m/s2, rest before it included."""
    return float(np.abs(np.diff(np.concatenate([np.zeros(2), metres]), 2)).max() * RATE_HZ**2)


@dataclass
class Desk:
    """A table and its controller in time that passes when it is told to."""

    folder: Path
    card: str = TEXT
    time_s: float = 100.0
    notices: list[str] = field(default_factory=list)
    answers: list[MachineMessage] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.box = FlightRecorder(self.folder / "box", self.notices.append)
        self.table = SimulatedMachine(
            parse_toml(self.card, RigConfig, "card"), self.notices.append, self.box
        )

    def say(self, *messages: MachineMessage) -> list[MachineMessage]:
        """The answers."""
        return [
            answer
            for message in messages
            for answer in self.table.handle_message(message, self.time_s)
        ]

    def drive(self, volts: Float1D) -> None:
        """Claim, queue, start."""
        kinds = [
            answer.kind for answer in self.say(claim(), values_message(MessageKind.QUEUE, volts))
        ]
        assert kinds == [MessageKind.GRANTED, MessageKind.QUEUED]
        assert self.say(MachineMessage(MessageKind.START))[0].values.tolist() == [self.time_s]

    def wait(self, seconds: float, beats: bool = True) -> None:
        """Time passes."""
        for _ in range(round(seconds / TICK_S)):
            self.time_s += TICK_S
            if beats:
                self.say(MachineMessage(MessageKind.BEAT))
            self.answers += self.table.tick(self.time_s)

    def rest(self) -> None:
        """Time passes without a controller until the table is free; it has ten seconds."""
        for _ in range(2000):
            if not self.table.is_claimed:
                return
            self.wait(TICK_S, beats=False)
        raise AssertionError("it did not come to rest")

    def kinds(self) -> list[MessageKind]:
        return [answer.kind for answer in self.answers]


@pytest.fixture
def desk(tmp_path: Path) -> Desk:
    return Desk(tmp_path)


def test_silent_controller_is_lost_in_time_and_what_is_queued_plays_to_rest(desk: Desk) -> None:
    volts = sine(1.0)
    desk.drive(volts)
    desk.wait(0.5)
    desk.wait(HEARTBEAT_TIMEOUT_S - TICK_S, beats=False)
    assert not desk.table.latched_reason
    desk.wait(3 * TICK_S, beats=False)
    assert "no message from the controller for 0.3 s" in desk.table.latched_reason
    assert desk.answers[-1].kind is MessageKind.LOST
    desk.rest()
    assert "controller lost" in desk.notices[-1]
    assert "at rest" in desk.notices[-1]
    (life,) = read_flight_record(desk.folder / "box")
    command = life.command_m
    np.testing.assert_array_equal(command[: volts.size], volts / SCALE)
    assert life.missing == 0
    assert command[-1] == 0.0
    assert acceleration(command) <= 1.05 * acceleration(volts / SCALE)
    assert np.abs(life.row("command_m") - command).max() <= 0.501 * RIG.output.lsb_m
    assert np.abs(life.row("table_disp")[-100:]).max() < 1e-4
    assert np.abs(life.row("table_disp")).max() > 3e-3


def test_queue_that_ends_in_motion_is_brought_home_and_replaced_in_time(desk: Desk) -> None:
    volts = sine(1.0)
    desk.drive(volts[:1200])
    desk.wait(0.5)
    assert (
        desk.say(values_message(MessageKind.QUEUE, volts[1200:], 1200))[0].kind
        is MessageKind.QUEUED
    )
    desk.wait(3.0)
    desk.table.drop_controller("it is over", desk.time_s)
    desk.rest()
    (life,) = read_flight_record(desk.folder / "box")
    np.testing.assert_array_equal(life.command_m[:2000], volts / SCALE)
    assert acceleration(life.command_m) <= 1.05 * acceleration(volts / SCALE)


def test_table_that_stands_still_in_the_middle_of_its_queue_is_not_at_rest(desk: Desk) -> None:
    volts = np.concatenate([np.zeros(1500), make_bump(1.0, 1000)])
    desk.drive(volts)
    desk.wait(0.1)
    desk.table.drop_controller("gone", desk.time_s)
    desk.rest()
    (life,) = read_flight_record(desk.folder / "box")
    np.testing.assert_array_equal(life.command_m[:2500], volts / SCALE)
    assert life.notes[-1][0] >= 2500 + 0.2 * RATE_HZ


def test_table_without_oil_pressure_is_given_the_time_that_it_needs(tmp_path: Path) -> None:
    desk = Desk(tmp_path, TEXT + OIL_LOSS)
    desk.drive(sine(4.0, f=1.0))
    desk.wait(4.0)
    desk.table.drop_controller("gone", desk.time_s)
    desk.rest()
    (life,) = read_flight_record(desk.folder / "box")
    quiet = life.row("table_disp")[-400:]
    assert np.ptp(quiet) <= 1e-4
    late = np.flatnonzero(np.abs(life.row("table_disp")) > 1e-4)[-1]
    assert late > np.flatnonzero(life.command_m)[-1] + 0.2 * RATE_HZ  # or this shows nothing


def test_time_that_passed_without_a_tick_is_past(desk: Desk) -> None:
    desk.drive(sine(1.0))
    desk.wait(0.1)
    desk.time_s += 0.05
    (answer,) = desk.say(values_message(MessageKind.QUEUE, np.zeros(9), 201 + 60))
    assert (answer.kind, answer.index) == (MessageKind.REFUSED, Refusal.VALUE)


def test_moving_table_is_refused_to_others(desk: Desk) -> None:
    assert desk.table.busy_refusal() is None
    desk.drive(sine(1.0))
    busy = desk.table.busy_refusal()
    assert busy is not None
    assert (busy.index, "has a controller already" in busy.text) == (Refusal.INPUT, True)
    desk.wait(0.6)
    desk.table.drop_controller("gone", desk.time_s)
    busy = desk.table.busy_refusal()
    assert busy is not None
    assert (busy.index, "still coming to rest" in busy.text) == (Refusal.RESTING, True)
    desk.rest()
    assert desk.table.busy_refusal() is None
    desk.drive(sine(0.5, f=3.0))
    assert not desk.table.latched_reason
    desk.wait(0.2)
    lives = read_flight_record(desk.folder / "box")
    assert [life.missing for life in lives] == [0, 0]
    np.testing.assert_array_equal(lives[1].command_m[:400], sine(0.2, f=3.0) / SCALE)
    assert lives[1].notes[0] == (0, "claimed; controller lost at sample 1201: gone")


def test_claim_without_start_is_given_up(desk: Desk) -> None:
    desk.say(claim(), values_message(MessageKind.QUEUE, sine(1.0)))
    desk.wait(29.0, beats=False)
    assert desk.table.is_claimed
    desk.wait(2.0, beats=False)
    assert not desk.table.is_claimed
    desk.say(claim(), MachineMessage(MessageKind.RELEASE))
    assert not desk.table.is_claimed
    assert not desk.table.latched_reason


@pytest.mark.parametrize(
    ("message", "why"),
    [
        (claim(RIG.model_copy(update={"sensors": RIG.sensors[:3]})), "sensors.* differs"),
        (
            claim(parse_toml(TEXT.replace("bits = 18", "bits = 16"), RigConfig, "")),
            "output.* differs",
        ),
        (claim(rate_hz=1234.0), "1234"),
        (claim(rate_hz=1e300), "allowed: 1000, 2000, 4000"),
    ],
)
def test_claim_that_does_not_fit_is_refused(desk: Desk, message: MachineMessage, why: str) -> None:
    (answer,) = desk.say(message)
    assert (answer.kind, answer.index) == (MessageKind.REFUSED, Refusal.INPUT)
    assert re.search(why, answer.text)
    assert not desk.table.is_claimed


@pytest.mark.parametrize(
    "message",
    [
        MachineMessage(MessageKind.START),
        MachineMessage(MessageKind.GRANTED),
        text_message(MessageKind.CLAIM, "{}"),
        text_message(MessageKind.CLAIM, "["),
        MachineMessage(MessageKind.CLAIM, 0, b"\xff"),
        claim(rate_hz=math.nan),
        claim(specimen={"mass_kg": -1.0, "gap_mm": 4.0}),
        claim(sensors=[]),
    ],
)
def test_invalid_claim_is_refused(desk: Desk, message: MachineMessage) -> None:
    with pytest.raises(ProtocolError):
        desk.say(message)
    assert not desk.table.is_claimed


@pytest.mark.parametrize(
    ("message", "refusal"),
    [
        (MachineMessage(MessageKind.QUEUE, 5000, b"1234567"), None),
        (MachineMessage(MessageKind.TAKEN, 0), None),
        (MachineMessage(MessageKind.PLAYED, 0), None),
        (claim(), None),
        (MachineMessage(MessageKind.QUEUE, 5000), Refusal.VALUE),
        (values_message(MessageKind.QUEUE, np.array([np.nan]), 5000), Refusal.VALUE),
        (values_message(MessageKind.QUEUE, np.array([0.0]), -(2**62)), Refusal.VALUE),
        (values_message(MessageKind.QUEUE, np.array([0.0]), 10), Refusal.VALUE),
        (MachineMessage(MessageKind.TARE, -1), Refusal.VALUE),
        (MachineMessage(MessageKind.TARE, 2**40), Refusal.VALUE),
        (MachineMessage(MessageKind.START), Refusal.ORDER),
    ],
)
def test_invalid_message_changes_nothing(
    desk: Desk, message: MachineMessage, refusal: Refusal | None
) -> None:
    volts = sine(1.0)
    desk.drive(volts)
    desk.wait(0.2)
    if refusal is None:
        with pytest.raises(ProtocolError):
            desk.say(message)
    else:
        (answer,) = desk.say(message)
        assert (answer.kind, answer.index) == (MessageKind.REFUSED, refusal)
    desk.wait(0.2)
    desk.table.drop_controller("enough", desk.time_s)
    desk.rest()
    (life,) = read_flight_record(desk.folder / "box")
    np.testing.assert_array_equal(life.command_m[: volts.size], volts / SCALE)


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.sampled_from([*MessageKind]),
    st.integers(-(2**63), 2**63 - 1),
    st.one_of(st.binary(max_size=64), st.floats().map(lambda x: np.array([x]).tobytes())),
)
def test_any_message_is_answered_or_refused(
    tmp_path_factory: pytest.TempPathFactory, kind: MessageKind, index: int, payload: bytes
) -> None:
    desk = Desk(tmp_path_factory.mktemp("desk"))
    for drives in (False, True):
        if drives:
            desk.drive(sine(0.1))
        with contextlib.suppress(ProtocolError):
            desk.say(MachineMessage(kind, index, payload))
        if desk.table.is_claimed:
            desk.wait(0.02)


def test_command_far_ahead_does_not_fill_the_memory(desk: Desk) -> None:
    desk.drive(sine(1.0))
    (answer,) = desk.say(values_message(MessageKind.QUEUE, np.zeros(2), 2**62))
    assert (answer.kind, answer.index) == (MessageKind.REFUSED, Refusal.VALUE)
    assert "at most" in answer.text


def test_late_samples_are_handed_over_late_and_in_order(tmp_path: Path) -> None:
    desk = Desk(tmp_path, TEXT + LATE)
    desk.drive(sine(1.0))
    came: list[tuple[int, float]] = []
    for _ in range(100):
        desk.answers.clear()
        desk.wait(TICK_S)
        came += [(answer.index, desk.time_s) for answer in desk.answers]
    indices = [index for index, _ in came]
    assert indices == sorted(indices)
    at = next(time_s for index, time_s in came if index + 10 > 400)
    assert at - 100.2 == pytest.approx(0.1, abs=2 * TICK_S)
    after = next(time_s for index, time_s in came if index > 800)
    assert after - 100.0 - 801 / RATE_HZ < 2 * TICK_S


def test_machine_that_stalls_still_plays_and_remembers(tmp_path: Path) -> None:
    desk = Desk(tmp_path, TEXT + STALL)
    desk.drive(sine(1.0))
    desk.wait(0.6)
    assert sum(answer.values.size for answer in desk.answers) // len(RIG.sensors) <= 400
    desk.table.drop_controller("it heard nothing", desk.time_s)
    desk.rest()
    (life,) = read_flight_record(desk.folder / "box")
    assert life.missing == 0
    assert life.samples.shape[1] > 2000
    assert life.command_m[-1] == 0.0


def test_black_box_that_is_cut_off_is_readable(desk: Desk) -> None:
    desk.drive(sine(1.0))
    desk.wait(0.5)
    path = desk.folder / "box"
    whole = read_flight_record(path)[0].samples
    path.write_bytes(path.read_bytes()[:-100])
    (life,) = read_flight_record(path)
    assert life.missing == 0
    count = life.samples.shape[1]
    assert whole.shape[1] - 20 <= count < whole.shape[1]
    np.testing.assert_array_equal(life.samples, whole[:, :count])


def test_black_box_overwrites_nothing_and_names_what_is_none(tmp_path: Path) -> None:
    path = tmp_path / "box"
    path.write_text("something else, long enough for a header")
    before = path.read_bytes()
    with raises_input_error(where=f"--log {path}"):
        FlightRecorder(path, print)
    assert path.read_bytes() == before
    with raises_input_error(where=str(path)):
        read_flight_record(path)
    with raises_input_error(where=f"--log {tmp_path / 'none' / 'box'}"):
        FlightRecorder(tmp_path / "none" / "box", print)
