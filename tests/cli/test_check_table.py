"""`check --table NAME`: the wiring is proven at rest, by hand where there is one; nothing moves."""

import json
import re
import socket
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from table_io.backends import MachineLost
from table_io.block import Float1D, Float2D
from table_io.clock import ManualClock
from table_io.config.base import PROFILES_DIR, parse_toml
from table_io.config.profile import Specimen
from table_io.config.rig import RigConfig
from table_io.sim.simulated_table import SimulatedBackend
from tests.builders.flight_records import read_flight_record
from tests.builders.rigs import RIG_TEXT, read_rig_text
from tests.command_line import invoke
from tests.input_errors import raises_input_error
from twin.rig.check_table import WiringCheckResult, examine_wiring

RIG = parse_toml(RIG_TEXT, RigConfig, "simulated")
RATE, SPECIMEN = 2000.0, Specimen(mass_kg=550.0, gap_mm=4.0)


class Watched(SimulatedBackend):
    """Remembers what it is told, and what the plant did."""

    def __init__(self, rig: RigConfig = RIG) -> None:
        self.clock = ManualClock()
        super().__init__(rig, SPECIMEN, RATE, self.clock)
        self.calls: list[str] = []
        self.queued: list[Float1D] = []
        self.moved_m = 0.0
        self.observer = self._see

    def _see(self, first: int, command: Float1D, signals: Float2D) -> None:
        self.moved_m = max(
            self.moved_m, *(float(np.abs(values).max()) for values in (command, signals))
        )

    def queue(self, index: int, volts: Float1D) -> None:
        self.calls.append("queue")
        self.queued.append(volts.copy())
        super().queue(index, volts)

    def start(self) -> None:
        self.calls.append("start")
        super().start()

    def close(self) -> None:
        self.calls.append("close")
        super().close()


def examine(backend: Watched, rig: RigConfig = RIG, person: object = False) -> WiringCheckResult:
    return examine_wiring(rig, backend.clock, backend, person)  # type: ignore[arg-type]


def plant_faults(*faults: str) -> RigConfig:
    return parse_toml(RIG_TEXT + "\n[[simulated.faults]]\n".join(["", *faults]), RigConfig, "card")


def failing(result: WiringCheckResult) -> list[tuple[str, str]]:
    return [(line.name, line.channel) for line in result.lines if line.verdict == "fail"]


def test_check_of_the_wiring_moves_nothing() -> None:
    backend = Watched()
    result = examine(backend)
    assert result.has_passed
    assert backend.calls == ["queue", "start", "close"]
    assert not np.concatenate(backend.queued).any()
    assert backend.moved_m == 0.0
    assert backend._next >= 4 * RATE  # so the witness has seen all of it


@pytest.mark.parametrize(("volts_off", "hz"), [(0.5, 0.0), (8.0, 1.0), (8.0, 10.0)])
def test_an_output_that_is_not_at_0_volts_is_not_started(volts_off: float, hz: float) -> None:
    class Driven(Watched):
        def tare(self, samples: int) -> Float2D:
            volts = super().tare(samples)
            volts[0] += volts_off * np.cos(2 * np.pi * hz * np.arange(samples) / RATE)
            return volts

    backend = Driven()
    result = examine(backend)
    assert backend.calls == ["close"]
    assert ("command at 0 V", "drive_disp_m") in failing(result)
    assert {channel for _, channel in failing(result)} == {"drive_disp_m"}
    untested = {line.name for line in result.lines if line.verdict == "not tested"}
    assert {"samples on time", "polarity"} <= untested


@pytest.mark.parametrize(
    ("fault", "line"),
    [
        ('kind = "stuck"\nchannel = "{}"\nat_s = 0.0', "stuck"),
        ('kind = "stuck"\nchannel = "{}"\nat_s = 2.5', "stuck"),
        ('kind = "cable_off"\nchannel = "{}"\nat_s = 0.0', "noise"),
        ('kind = "rail"\nchannel = "{}"\nat_s = 0.0', "at the rail"),
        ('kind = "rail"\nchannel = "{}"\nat_s = 1.0\nfor_s = 0.001', "at the rail"),
        ('kind = "nan"\nchannel = "{}"\nat_s = 0.0', "lost samples"),
        ('kind = "nan"\nchannel = "{}"\nat_s = 3.0\nfor_s = 0.01', "lost samples"),
        ('kind = "drift"\nchannel = "{}"\nat_s = 0.0\nsize = 0.1', "steady"),
        ('kind = "spike"\nchannel = "{}"\nat_s = 2.0\nsize = 0.3', "spikes"),
    ],
)
@pytest.mark.parametrize("channel", ["table_disp_m", "mass_acc_m_s2", "force_r2_n"])
def test_what_is_broken_is_found_by_its_line_and_no_other_channel_is_blamed(
    fault: str, line: str, channel: str
) -> None:
    rig = plant_faults(fault.format(channel))
    result = examine(Watched(rig), rig)
    assert (line, channel) in failing(result)
    assert {channel for _, channel in failing(result)} == {channel}
    assert all(line.do for line in result.lines if line.verdict == "fail")


def test_what_needs_a_motion_is_not_said_to_be_right() -> None:
    """A turned sensor and a wrong gain do not show at rest: their lines are not tested."""
    turned = 'kind = "polarity"\nchannel = "mass_acc_m_s2"\nat_s = 0.0'
    gain = 'kind = "gain"\nchannel = "force_r1_n"\nat_s = 0.0\nsize = 0.1'
    rig = plant_faults(turned, gain)
    result = examine(Watched(rig), rig)
    assert result.has_passed
    untested = {line.channel for line in result.lines if line.verdict == "not tested"}
    assert {"mass_acc_m_s2", "force_r1_n"} <= untested


def test_a_machine_that_falls_silent_is_a_line_and_it_is_released() -> None:
    rig = plant_faults('kind = "stall"\nat_s = 1.0')
    backend = Watched(rig)
    result = examine(backend, rig)
    assert [name for name, _ in failing(result)] == ["machine answers"]
    assert "simulated table" in result.lines[-1].do
    assert backend.calls[-1] == "close"


def test_a_machine_that_hands_over_late_is_said() -> None:
    class Slow(Watched):
        def read(self, samples: int) -> Float2D:
            volts = super().read(samples)
            self.clock.wait_until(self.scheduled_time_s(self._next - 1) + 0.15)
            return volts

    assert failing(examine(Slow())) == [("samples on time", "")]


class Struck(Watched):
    """A person taps when asked: the swing of each channel, in the sensor's unit, 0.6 s later."""

    def __init__(self, rig: RigConfig, swings: dict[str, dict[str, float]]) -> None:
        super().__init__(rig)
        self._swings, self._asked = swings, 0
        self._now: dict[str, float] = {}
        self.asked: list[str] = []
        self.tired = False

    def ask(self, what: str) -> None:
        self.asked.append(what)
        self._asked = self._next
        self._now = next((swing for key, swing in self._swings.items() if key in what), {})

    def declines(self) -> bool:
        return self.tired

    def read(self, samples: int) -> Float2D:
        volts = super().read(samples)
        t = (np.arange(self._next - samples, self._next) - self._asked) / RATE - 0.6
        swing = np.where(t >= 0, np.exp(-8.0 * t) * np.sin(60.0 * np.maximum(t, 0.0)), 0.0)
        for name, size in self._now.items():
            row = self.channels.index(name)
            volts[row] += size * swing * self._rig.sensors[row].volts_per_unit
        return volts


HANDS = {
    "tap the table": {"table_acc_m_s2": 0.3, "mass_acc_m_s2": 0.02},
    "tap the mass": {"mass_acc_m_s2": 0.3, "mass_disp_m": 0.5},
    "right bumper": {"force_r1_n": 0.4, "force_r2_n": 0.3},
    "left bumper": {"force_l1_n": 0.4, "force_l2_n": 0.3},
}


def run_tap_tests(
    rig: RigConfig = RIG, **hands: dict[str, float]
) -> tuple[Struck, WiringCheckResult]:
    backend = Struck(
        rig, HANDS | {key.replace("_", " "): response for key, response in hands.items()}
    )
    return backend, examine(backend, rig, backend)


def test_a_person_who_taps_as_asked_proves_every_polarity() -> None:
    backend, result = run_tap_tests()
    assert [asked.split(",")[0] for asked in backend.asked] == [
        "tap the table to the right", "tap the mass to the right",
        "press the load cells of the right bumper", "press the load cells of the left bumper",
    ]  # fmt: skip
    polarity = {line.channel: line.verdict for line in result.lines if line.name == "polarity"}
    assert polarity.pop("table_disp_m") == "not tested"  # the servo held it
    assert set(polarity.values()) == {"pass"}
    assert len(polarity) == 7
    assert result.has_passed
    assert not np.concatenate(backend.queued).any()
    assert backend.moved_m == 0.0


def test_a_planted_polarity_is_found_by_the_tap() -> None:
    rig = plant_faults('kind = "polarity"\nchannel = "mass_acc_m_s2"\nat_s = 0.0')
    assert rig.is_simulated
    hands = {"mass_acc_m_s2": -0.3, "mass_disp_m": 0.5}  # the fault turns what the sensor gives
    _, result = run_tap_tests(rig, tap_the_mass=hands)
    assert failing(result) == [("polarity", "mass_acc_m_s2")]


def test_who_does_nothing_or_declines_leaves_lines_that_are_not_tested() -> None:
    backend, result = run_tap_tests(RIG, right_bumper={})
    untested = {line.channel for line in result.lines if line.name == "polarity"} - {
        line.channel for line in result.lines if line.name == "polarity" and line.verdict == "pass"
    }
    assert untested == {"table_disp_m", "force_r1_n", "force_r2_n"}
    assert result.has_passed
    backend = Struck(RIG, {})
    backend.tired = True
    result = examine(backend, RIG, backend)
    assert {line.verdict for line in result.lines if line.name == "polarity"} == {"not tested"}
    assert backend.clock.now() < 20.0  # nobody waits for who has said no


class Hasty(Struck):
    """Presses the right cells as soon as it is asked, so often, and a second later lets go."""

    def __init__(self, rig: RigConfig, times: int) -> None:
        super().__init__(rig, HANDS)
        self.times = times

    def read(self, samples: int) -> Float2D:
        volts = super().read(samples)
        t = (np.arange(self._next - samples, self._next) - self._asked) / RATE
        asked = [asked for asked in self.asked if "right bumper" in asked]
        if asked and asked[-1] == self.asked[-1] and len(asked) <= self.times:
            volts[self.channels.index("force_r1_n")] += 1.0 * ((t > 0.2) & (t < 0.9))
        return volts


@pytest.mark.parametrize(("times", "verdict"), [(1, "pass"), (9, "not tested")])
def test_who_presses_too_early_is_asked_again(times: int, verdict: str) -> None:
    backend = Hasty(RIG, times)
    result = examine(backend, RIG, backend)
    assert failing(result) == []
    right = [asked for asked in backend.asked if "right bumper" in asked]
    assert len(right) == min(times + 1, 3)
    assert "once more" in right[1]
    lines = [
        line for line in result.lines if line.channel == "force_r1_n" and line.name == "polarity"
    ]
    assert [line.verdict for line in lines] == [verdict]


class Holding(Struck):
    """Presses a right cell hard, and lets go only when the left ones have been asked for once."""

    def read(self, samples: int) -> Float2D:
        volts = super().read(samples)
        t = (np.arange(self._next - samples, self._next) - self._asked) / RATE
        right, left = (
            [asked for asked in self.asked if f"{side} bumper" in asked]
            for side in ("right", "left")
        )
        if right and not left:
            volts[self.channels.index("force_r1_n")] += 1.0 * (t > 0.6)
        if len(left) == 1:
            volts[self.channels.index("force_r1_n")] += 1.0 * (t < 0.45)
        return volts


def test_a_press_that_is_held_until_the_next_is_asked_for_swaps_nothing() -> None:
    backend = Holding(RIG, HANDS)
    result = examine(backend, RIG, backend)
    assert failing(result) == []
    assert len([asked for asked in backend.asked if "left bumper" in asked]) == 2
    lines = [
        line for line in result.lines if line.channel == "force_l1_n" and line.name == "polarity"
    ]
    assert [line.verdict for line in lines] == ["pass"]


def run_shunt_check(size: float) -> WiringCheckResult:
    head = 'channel = "force_r1_n"\nunit = "kN"\n'
    assert RIG_TEXT.count(head) == 1
    text = RIG_TEXT.replace(head, head + "shunt = 2.0\nshunt_tolerance = 0.05\n")
    rig = parse_toml(text, RigConfig, "card")

    class Switched(Struck):
        def read(self, samples: int) -> Float2D:
            volts = super().read(samples)
            if "shunt" in (self.asked or [""])[-1]:
                late = (np.arange(self._next - samples, self._next) - self._asked) / RATE > 1.0
                volts[self.channels.index("force_r1_n")] += size * late
            return volts

    backend = Switched(rig, HANDS)
    return examine(backend, rig, backend)


def test_a_shunt_proves_the_gain() -> None:
    assert failing(run_shunt_check(2.02)) == []
    assert [line.verdict for line in run_shunt_check(2.02).lines if line.name == "shunt"] == [
        "pass"
    ]
    assert failing(run_shunt_check(2.2)) == [("shunt", "force_r1_n")]
    assert failing(run_shunt_check(-2.0)) == [("shunt", "force_r1_n")]


@pytest.fixture
def check(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[int, str]]:
    monkeypatch.chdir(tmp_path)
    return partial(invoke, "check")


def test_the_command_says_it_in_a_table_and_ends_with_2_where_a_line_fails(
    check: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    code, text = check("--table", "simulated")
    assert code == 0
    assert "no line fails" in text
    assert text.rstrip().endswith("nothing was moved")
    fault = '\n[[simulated.faults]]\nkind = "cable_off"\nchannel = "mass_disp_m"\nat_s = 0.0\n'
    due = RIG_TEXT.replace('channel = "force_l2_n"', 'channel = "force_l2_n"\ndue = 2020-01-01')
    (tmp_path / "card.toml").write_text(due + fault)
    code, text = check("--table", "card.toml")
    assert code == 2
    assert "FAIL noise, mass_disp_m: " in text
    assert "warning: force_l2_n: its calibration was due on 2020-01-01" in text
    assert "no line fails" not in text


def test_as_json_every_line_stands_there(check: Callable[..., tuple[int, str]]) -> None:
    code, text = check("--table", "simulated", "--json")
    report = json.loads(text)
    assert (code, report["passed"], report["backend"]) == (0, True, "simulated")
    assert {line["channel"] for line in report["lines"]} == {*RIG.channels, ""}
    assert {line["verdict"] for line in report["lines"]} == {"pass", "not tested"}
    (acc,) = (sensor for sensor in report["inputs"] if sensor["channel"] == "table_acc_m_s2")
    assert acc["noise_rms"] == pytest.approx(0.0005, rel=0.1)
    assert acc["mean"] == pytest.approx(0.001, abs=1e-4)


def test_check_with_options_that_do_not_fit_is_refused(
    check: Callable[..., tuple[int, str]],
) -> None:
    quick = str(PROFILES_DIR / "tests" / "quickstart.toml")
    for words in ((), ("--json",), (quick, "--json"), (quick, "--unattended")):
        with raises_input_error(where="check", allowed="PROFILE"):
            check(*words)
    with raises_input_error(where="--table simulatd", remedy="'simulated'"):
        check("--table", "simulatd")
    assert "ready: nothing exceeds" in check(quick)[1]  # the pre-flight is what it was


def test_machine_lost_in_the_check_is_a_failed_line() -> None:
    class Lost(Watched):
        def tare(self, samples: int) -> Float2D:
            raise MachineLost("the cable is out; put it in")

    result = examine(Lost())
    assert failing(result) == [("machine answers", "")]
    assert result.lines[0].do == "the cable is out; put it in"


def free_port(kind: int) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["machine", "ni_simulated", "udp_simulated"])
def test_on_a_table_of_its_own_every_line_passes_and_its_black_box_saw_no_motion(
    name: str, tmp_path: Path
) -> None:
    text = read_rig_text(name)
    port = free_port(socket.SOCK_DGRAM if name == "udp_simulated" else socket.SOCK_STREAM)
    card, box = tmp_path / "card.toml", tmp_path / "box"
    lines = '\nheartbeat_back = "Dev1/port0/line1"\nwell = { limit = "Dev1/port0/line2" }\n'
    text = text.replace("[ni]\n", f"[ni]{lines}")
    card.write_text(re.sub(r"127\.0\.0\.1:\d+", f"127.0.0.1:{port}", text))
    shaketwin = Path(sys.executable).parent / "shaketwin"
    command: list[str | Path] = [shaketwin, "table", "--rig", card, "--log", box]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as table:
        assert table.stdout is not None
        assert "waiting at" in table.stdout.readline()
        words: list[str | Path] = [shaketwin, "check", "--table", card, "--json"]
        result = subprocess.run(words, capture_output=True, text=True, check=False)
        table.terminate()
    assert result.returncode == 0, result.stdout + result.stderr
    passed = {
        line["name"] for line in json.loads(result.stdout)["lines"] if line["verdict"] == "pass"
    }
    assert {"noise", "command at 0 V", "samples on time"} <= passed
    assert ({"heartbeat comes back", "heartbeat stops", "all is well"} <= passed) == (
        name == "ni_simulated"
    )
    sessions = read_flight_record(box)
    assert sessions[-1].samples.shape[1] >= 4 * RATE
    assert not sessions[-1].samples.any()
    pulse_lsb = 8 if name == "ni_simulated" else 0  # its own check that output can be replaced
    pulse_m = pulse_lsb * parse_toml(text, RigConfig, name).output.lsb_m
    for motion in ("command_m", "table_disp"):
        peaks_m = [np.abs(session.row(motion)).max(initial=0.0) for session in sessions]
        assert max(peaks_m) == pytest.approx(pulse_m, rel=0.1)
