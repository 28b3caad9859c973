"""A session that follows: what it records, what it says, and that it stops nothing."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import pytest

from table_io.acquisition.external_control import plan_open_loop_drive, record_external
from table_io.acquisition.session import OperatorCommand, SessionSetup
from table_io.backends import MachineLost
from table_io.block import Block, Float1D, Label, join_blocks
from table_io.clock import ManualClock
from table_io.config.base import load_config, parse_toml
from table_io.config.folders import find_config
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.errors import InputError
from table_io.excitation.drive import Drive
from table_io.records import Check, Event, FrequencyResponse, RunStart, RunStop, Trip
from tests.builders.drives import sine_segments
from tests.builders.sessions import make_start
from tests.input_errors import raises_input_error
from tests.table_io.acquisition.external_controller import Bystander, whole

DRIVE_START_SAMPLE = 4000.37
SWEEP = {
    "start_hz": 2.4,
    "stop_hz": 2.8,
    "step_hz": 0.2,
    "cycles": 3,
    "measured_cycles": 2,
    "directions": ["forward"],
}


def setup(check: bool = False, text: str = "", **changes: object) -> SessionSetup:
    profile, _ = load_config(find_config("quickstart", "tests"), Profile, "profile")
    raw = profile.model_dump() | {"excitation": SWEEP, "loop_check": {"enabled": check}, **changes}
    path = find_config("follow_simulated", "rigs")
    rig = parse_toml(text or path.read_text(), RigConfig, "card")
    return SessionSetup(Profile.model_validate(raw), rig)


@dataclass(frozen=True)
class Followed:
    """Everything that a session said, and the drive that it planned."""

    items: Sequence[object]
    drive: Drive

    def of(self, kind: type) -> list:
        return [item for item in self.items if isinstance(item, kind)]

    @property
    def block(self) -> Block:
        return join_blocks(self.of(Block))

    @property
    def stop(self) -> RunStop:
        assert isinstance(self.items[-1], RunStop)
        return self.items[-1]

    def event_texts(self, kind: str) -> list[str]:
        return [event.text for event in self.of(Event) if event.kind == kind]


def run(
    session: SessionSetup,
    file: Callable[[Drive], Float1D] = whole,
    ppm: float = 50.0,
    kind: type[Bystander] = Bystander,
    orders: Callable[[int], OperatorCommand | None] = lambda _: None,
) -> Followed:
    """A session beside a controller that plays a file; `orders` are asked by the block's number."""
    drive, clock = plan_open_loop_drive(session.profile, session.rig), ManualClock()
    played = np.ascontiguousarray(file(drive))
    source = kind(
        session.rig, session.profile.specimen, 2000.0, clock, played, DRIVE_START_SAMPLE, ppm
    )
    asked = iter(range(10**9))
    items = list(record_external(session, source, clock, make_start, lambda: orders(next(asked))))
    return Followed(items, drive)


def stop_early(drive: Drive) -> Float1D:
    """The controller's own stop in the second step: a decay of half a second."""
    values = whole(drive)
    at = next(segment.end for segment in sine_segments(drive) if segment.step == 1) - 300
    left = np.clip(1.0 - np.arange(values.size - at) / 1000.0, 0.0, 1.0)
    values[at:] *= left**3 * (10.0 + left * (-15.0 + 6.0 * left))
    return values


@pytest.fixture(scope="module")
def loop_check_recording() -> Followed:
    return run(setup(check=True))


def test_whole_is_recorded_from_the_start_of_the_acquisition_on(
    loop_check_recording: Followed,
) -> None:
    block = loop_check_recording.block  # which joins: no sample is missing
    assert isinstance(loop_check_recording.items[0], RunStart)
    assert block.index == 0
    assert np.isfinite(block.values).all()
    assert loop_check_recording.stop.verdict == "complete"
    assert loop_check_recording.stop.index == block.end
    assert loop_check_recording.stop.states == (
        "idle",
        "checking",
        "waiting",
        "following",
        "at rest",
    )


def test_every_sample_is_labelled_by_its_place_in_the_drive(loop_check_recording: Followed) -> None:
    """To the nearest sample, but where two labels meet within the noise of the alignment."""
    block = loop_check_recording.block
    true = (np.arange(len(block)) - DRIVE_START_SAMPLE) * (1 + 50e-6)
    place = np.rint(true).astype(int)
    labels = loop_check_recording.drive.labels(int(place[0]), int(place[-1] - place[0]) + 1)
    for acquired, drive in zip((block.step, block.label, block.cycle), labels, strict=True):
        wrong = np.flatnonzero(acquired != drive[place - place[0]])
        # what was given on before motion was seen, at less than what can be seen of it
        unseen = wrong[(block.label[wrong] == Label.REST) & (wrong < DRIVE_START_SAMPLE + 1100)]
        assert len(wrong) - len(unseen) <= len(np.flatnonzero(np.diff(drive)))


def test_loop_check_and_alignment_are_recorded(loop_check_recording: Followed) -> None:
    checks = loop_check_recording.of(Check)
    assert len(checks) > 30
    assert all(check.passed for check in checks)
    assert len(loop_check_recording.of(FrequencyResponse)) == 1
    alignments = loop_check_recording.event_texts("aligned")
    assert len(alignments) == 3
    assert "sample 0 of the drive is sample 4000.3" in alignments[-1]
    assert float(alignments[-1].split(" ppm")[0].split()[-1]) == pytest.approx(50.0, abs=1.0)
    (clock,) = loop_check_recording.event_texts("clock")
    assert clock.startswith("the simulated table's clock; ")
    assert not loop_check_recording.of(Trip)


def test_failed_loop_check_is_an_event_and_stops_nothing() -> None:
    text = find_config("follow_simulated", "rigs").read_text()
    text += '\n[[simulated.faults]]\nkind = "polarity"\nat_s = 0.0\nchannel = "table_acc_m_s2"\n'
    recording = run(setup(check=True, text=text))
    assert any(
        "failed" in line and "its controller" in line for line in recording.event_texts("check")
    )
    assert recording.stop.verdict == "complete"
    assert "protection would have stopped it" in recording.stop.reason or not recording.of(Trip)


def test_trip_is_recorded_while_the_table_goes_on() -> None:
    text = find_config("follow_simulated", "rigs").read_text()
    text += '\n[[simulated.faults]]\nkind = "cable_off"\nat_s = 5.0\nchannel = "table_disp_m"\n'
    recording = run(setup(text=text))
    trips = recording.of(Trip)
    assert len(trips) == 1
    assert "stop it at its controller" in trips[0].text
    assert recording.stop.verdict == "complete"
    assert "see the trip" in recording.stop.reason


def test_controller_that_stops_early_is_recorded_to_rest() -> None:
    recording = run(setup(), stop_early)
    left = (
        next(s.end for s in sine_segments(recording.drive) if s.step == 1)
        - 300
        + DRIVE_START_SAMPLE
    )
    (trip,) = [trip for trip in recording.of(Trip) if trip.kind == "plan"]
    assert left - 500 <= trip.index <= trip.decided <= left + 2000
    assert "off the drive" in trip.text
    assert recording.stop.verdict == "aborted"
    assert "does not play the drive" in recording.stop.reason
    assert recording.stop.states[-2:] == ("astray", "at rest")
    block = recording.block
    assert np.abs(block.channel("drive_disp_m")[-400:]).max() < 1e-6
    measured = np.flatnonzero(block.label == Label.MEASURE)
    assert measured.max() <= left + 2000


def test_another_drive_is_not_taken_for_ours() -> None:
    other = plan_open_loop_drive(
        setup(excitation=SWEEP | {"start_hz": 2.6, "stop_hz": 3.4}).profile, setup().rig
    )
    recording = run(setup(), lambda _: whole(other))
    assert recording.stop.verdict == "aborted"
    assert "not this drive" in recording.stop.reason
    assert (recording.block.step == -1).all()


def test_recording_ends_if_nothing_is_played() -> None:
    text = (
        find_config("follow_simulated", "rigs")
        .read_text()
        .replace("wait_s = 300.0", "wait_s = 6.0")
    )
    recording = run(setup(text=text), lambda _: np.zeros(10))
    assert recording.stop.verdict == "aborted"
    assert "nothing was played within 6 s" in recording.stop.reason
    assert recording.block.end == pytest.approx(12000, abs=40)


def order(name: str, at: int, asked: int) -> OperatorCommand | None:
    return OperatorCommand(name, f"asked to {name}") if asked == at else None


@pytest.mark.parametrize("name", ["hold", "resume"])
def test_hold_and_resume_are_refused(name: str) -> None:
    recording = run(setup(), orders=partial(order, name, 300))
    (text,) = recording.event_texts("refused")
    assert name in text
    assert "controller" in text
    assert recording.stop.verdict == "complete"


@pytest.mark.parametrize(("name", "verdict"), [("stop", "stopped"), ("abort", "aborted")])
def test_stop_ends_the_recording_of_a_moving_table(name: str, verdict: str) -> None:
    """The controller plays on: ten seconds later the recording ends, and says that it moves."""
    long = setup(excitation=SWEEP | {"cycles": 20})
    recording = run(long, orders=partial(order, name, 500))
    assert recording.stop.verdict == verdict
    assert any("STOP THE TABLE AT ITS CONTROLLER" in line for line in recording.event_texts("stop"))
    assert any("while the table still moves" in line for line in recording.event_texts("stop"))
    assert recording.block.end == pytest.approx(501 * 20 + 20000, abs=40)
    assert recording.stop.states[-1] == "left"


def test_stop_that_is_followed_at_the_controller_is_recorded_to_rest() -> None:
    recording = run(setup(), stop_early, orders=partial(order, "stop", 500))
    left = (
        next(s.end for s in sine_segments(recording.drive) if s.step == 1)
        - 300
        + DRIVE_START_SAMPLE
    )
    assert left - 4000 < 500 * 20 < left
    assert recording.stop.verdict == "stopped"
    assert recording.stop.reason == "asked to stop"
    assert not [trip for trip in recording.of(Trip) if trip.kind == "plan"]
    assert recording.stop.states[-1] == "at rest"
    assert recording.block.end > left + 1400
    assert np.abs(recording.block.channel("drive_disp_m")[-300:]).max() < 1e-6


def test_stop_while_waiting_ends_at_once() -> None:
    recording = run(setup(), orders=partial(order, "stop", 20))
    assert recording.stop.verdict == "stopped"
    assert recording.block.end <= 30 * 20


def test_test_that_decides_while_it_runs_cannot_be_given_away() -> None:
    profile = load_config(find_config("track", "tests"), Profile, "profile")[0]
    with raises_input_error(key="[track]"):
        plan_open_loop_drive(profile, setup().rig)


class Breaking(Bystander):
    """The device is lost in mid-test."""

    def take(self, samples: int) -> np.ndarray:
        if self._next > 12000:
            raise MachineLost("nobody answers; stop it at its controller")
        return super().take(samples)


def test_lost_device_keeps_all_acquired_samples() -> None:
    recording = run(setup(), kind=Breaking)
    assert recording.stop.verdict == "halted"
    assert recording.block.end == recording.stop.index == 12020
    assert recording.of(Trip)[-1].kind == "machine"


def no_command() -> str:
    """The card without a wire for the command."""
    text = find_config("follow_simulated", "rigs").read_text()
    command = text.index('[[sensors]]\nchannel = "drive_disp_m"')
    after = text.index("[[sensors]]", command + 1)
    text = (text[:command] + text[after:]).replace(
        'command = "drive_disp_m"', 'command = "table_disp_m"'
    )
    return text.replace('drive_disp_m = "command"\n', "")


def test_where_no_command_is_wired_the_table_stands_for_it() -> None:
    """Its labels lag as the table does; protection is off, and both are said."""
    recording = run(setup(text=no_command()))
    assert recording.stop.verdict == "complete"
    assert any(
        "protection and loop check are off" in line for line in recording.event_texts("follow")
    )
    assert any("lags behind" in line for line in recording.event_texts("follow"))
    block = recording.block
    true = np.rint((np.arange(len(block)) - DRIVE_START_SAMPLE) * (1 + 50e-6)).astype(int)
    step, _, _ = recording.drive.labels(int(true[0]), true.size + 10)
    for index in (1, 2):
        first, expected = (int(np.flatnonzero(row == index)[0]) for row in (block.step, step))
        assert 10 <= first - expected - (-true[0] - round(DRIVE_START_SAMPLE)) <= 60


def test_card_wants_its_source() -> None:
    text = find_config("follow_simulated", "rigs").read_text()
    bare = text[: text.index("\n[opendaq]")] + text[text.index("\n[limits]") :]
    with pytest.raises(InputError) as error:
        parse_toml(bare, RigConfig, "card")
    (fault,) = error.value.faults
    assert fault.key == "follow"
    assert "[opendaq]" in fault.problem
