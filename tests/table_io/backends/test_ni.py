"""The NI backend beyond the contract: what it refuses to begin with, and how it always ends."""

import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest

from table_io.acquisition.session import SessionSetup, run_session
from table_io.backends import MachineLost, check_reachable
from table_io.backends.ni.backend import ClockSync, NiBackend
from table_io.backends.ni.config import NiFault
from table_io.block import Block, Float1D
from table_io.clock import ManualClock, RealClock
from table_io.config.base import parse_toml
from table_io.config.rig import RigConfig
from table_io.errors import InputError
from table_io.records import RunStop, SampleGap
from table_io.sim.ni.device import DriverError, ErrorCode, SimulatedDaqDevice, Task
from table_io.sim.ni.server import ServerEndpoint
from tests.builders.flight_records import read_flight_record
from tests.builders.profiles import make_profile
from tests.builders.rigs import RIG_TEXT
from tests.builders.sessions import make_start
from tests.input_errors import raises_input_error
from tests.studies.ni_error_codes import CALLS, RATE_HZ, judge_ending, meet_fault, motion
from tests.table_io.backends.ni_wire import CARD, SPECIMEN, Answer, Bed, get_wiring, note_heartbeats


@pytest.fixture(scope="module")
def bed() -> Bed:
    """One device for all that leaves it as it was."""
    return Bed()


def start_backend(bed: Bed) -> NiBackend:
    backend = bed.backend()
    backend.open()
    backend.queue(0, motion())
    backend.start()
    return backend


def session(bed: Bed) -> list[Any]:
    grid: dict[str, Any] = {
        "start_hz": 2.0,
        "stop_hz": 2.4,
        "step_hz": 0.4,
        "directions": ["forward"],
    }
    profile = make_profile(tables={"loop_check": {"enabled": False}}, **grid)
    setup = SessionSetup(profile, bed.rig)
    return list(run_session(setup, bed.backend(), bed.clock, make_start, lambda: None))


def test_session_is_played_without_a_gap() -> None:
    bed = Bed()
    items = session(bed)
    assert isinstance(items[-1], RunStop)
    assert items[-1].verdict == "complete"
    assert not [item for item in items if isinstance(item, SampleGap)]
    values = np.concatenate([item.values for item in items if isinstance(item, Block)], axis=1)
    assert values.shape[1] == items[-1].index
    assert 2e-3 < np.abs(values[1]).max() < 4e-3  # 0.05 g at 2 Hz: 3.1 mm


@pytest.mark.parametrize("call", CALLS)
@pytest.mark.parametrize("code", [-200289, -200284, -201003, -209904])
def test_every_error_is_stated_and_ends_safely(
    call: Any, code: int, bed: Bed, tmp_path: Path
) -> None:
    fault = NiFault(call=call, code=code, at_s=0.45)
    items, life = meet_fault(bed, fault, tmp_path / "box")
    assert not judge_ending(items, life, fault)


def test_input_that_fails_lets_the_command_decay_as_it_was_queued(bed: Bed, tmp_path: Path) -> None:
    _, life = meet_fault(bed, NiFault(call="read", code=-200279, at_s=0.45), tmp_path / "box")
    queued_m = motion() / bed.rig.output.volts_per_m
    step_m = bed.rig.output.lsb_m
    assert np.abs(life.row("command_m")[: queued_m.size] - queued_m).max() <= step_m
    assert not [text for _, text in life.notes if "heartbeat" in text], "the interlock has acted"


def test_frozen_output_is_landed_by_the_interlock_within_its_time(bed: Bed, tmp_path: Path) -> None:
    _, life = meet_fault(bed, NiFault(call="output", code=-200621, at_s=0.45), tmp_path / "box")
    notes = {text.split(" at sample ")[0]: (index, text) for index, text in life.notes}
    frozen = int(notes["output ended by error -200621"][1].rsplit(" ", 1)[1])
    landed = notes["stopped by the machine's interlock"][0]
    assert landed - frozen <= (0.3 + 0.1) * RATE_HZ  # silence, and what the rig needs to see it
    assert np.ptp(life.row("command_m")[frozen - 1 : landed]) == 0.0


def test_absent_rig_loses_the_machine(bed: Bed) -> None:
    backend = start_backend(bed)
    backend.read(200)
    bed.clock.wait_until(bed.clock.now() + 0.35)
    with pytest.raises(MachineLost, match=r" 0\.35 s"):
        backend.read(20)
    with pytest.raises(MachineLost, match=r" 0\.35 s"):
        backend.queue(3000, np.zeros(2))
    backend.close()
    bed.rest()


def test_samples_that_do_not_come_are_a_loss_after_patience_and_the_command_decays(
    tmp_path: Path,
) -> None:
    stall = '[[simulated.faults]]\nkind = "stall"\nat_s = 0.5\n'
    clock = RealClock(4.0)  # which jumps over no heartbeat
    bed = Bed(CARD + stall, tmp_path / "box", clock)
    backend = start_backend(bed)
    backend.read(980)
    with pytest.raises(MachineLost, match=r"samples|200284"):
        backend.read(200)
    backend.close()
    bed.rest()
    queued_m = motion() / bed.rig.output.volts_per_m
    life = read_flight_record(tmp_path / "box")[-1]
    assert np.abs(life.row("command_m")[: queued_m.size] - queued_m).max() <= bed.rig.output.lsb_m


def test_close_waits_for_rest_before_it_stops_the_output(tmp_path: Path) -> None:
    bed = Bed(CARD, tmp_path / "box")
    backend = start_backend(bed)
    backend.read(500)
    assert bed.clock.now() < backend.scheduled_time_s(510)
    backend.close()
    assert bed.clock.now() >= backend.scheduled_time_s(motion().size)
    bed.rest()
    queued_m = motion() / bed.rig.output.volts_per_m
    life = read_flight_record(tmp_path / "box")[-1]
    assert np.abs(life.row("command_m")[: queued_m.size] - queued_m).max() <= bed.rig.output.lsb_m


def test_heartbeat_is_10_hz_while_the_rig_reads_and_not_after_it() -> None:
    bed = Bed()
    beats = note_heartbeats(bed)
    backend = start_backend(bed)
    for _ in range(100):
        backend.read(20)
    between = np.diff(beats)
    assert 0.04 < between.min() <= between.max() < 0.08
    backend.close()
    assert beats[-1] <= bed.clock.now()
    count = len(beats)
    bed.rest()
    assert len(beats) == count


def test_rig_that_is_gone_leaves_tasks_that_play_to_rest_and_the_next_one_clears(
    tmp_path: Path,
) -> None:
    bed = Bed(CARD, tmp_path / "box")
    gone = start_backend(bed)
    gone.read(700)
    names = {task.name for task in bed.device.tasks}
    assert names == {f"shaketwin_Dev1_{kind}" for kind in ("input", "output", "heartbeat")}
    following = bed.backend()
    following.open()  # waits until it has been played
    lives = read_flight_record(tmp_path / "box")
    queued_m = motion() / bed.rig.output.volts_per_m
    left = next(life for life in lives if life.samples.shape[1] > queued_m.size)
    assert np.abs(left.row("command_m")[: queued_m.size] - queued_m).max() <= bed.rig.output.lsb_m
    assert any("no heartbeat for 0.3 s" in text for _, text in left.notes)
    following.queue(0, motion())
    following.start()
    assert following.read(500).shape == (9, 500)
    following.close()


def test_rig_that_drives_keeps_its_device(bed: Bed) -> None:
    first = start_backend(bed)
    first.read(100)
    alive = iter(range(10**6))

    def waits(when: float) -> None:  # while the second one waits, the first one reads
        next(alive)
        first.read(max(int((when - bed.clock.now()) * RATE_HZ), 1))

    second = bed.backend(clock=Paced(bed.clock, waits))
    with raises_input_error(where=f"rig {bed.rig.name}", remedy="end it first"):
        second.open()
    first.read(20)
    first.close()
    bed.rest()


class Paced:
    """A clock whose waits do something."""

    def __init__(self, clock: Any, waits: Any) -> None:
        self._clock, self.wait_until = clock, waits

    def now(self) -> float:
        return self._clock.now()


def test_device_with_more_memory_than_stated_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Task, "onboard_samples", property(lambda task: 8191))
    with pytest.raises(InputError, match="7680 ms") as error:
        Bed().backend().open()
    assert (error.value.key, error.value.value) == ("ni.held_by_device_ms", 20.0)


def test_driver_that_lets_nothing_be_replaced_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    write = SimulatedDaqDevice.write

    def only_behind(device: SimulatedDaqDevice, task: Task, volts: Float1D, now_s: float) -> None:
        if task.running and task.offset < task.written:
            raise DriverError(ErrorCode.NO_LONGER_WRITEABLE)
        write(device, task, volts, now_s)

    monkeypatch.setattr(SimulatedDaqDevice, "write", only_behind)
    with pytest.raises(InputError, match="-200289"):
        Bed().backend().open()


def test_rate_that_the_device_only_comes_near_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    timing = SimulatedDaqDevice.configure_timing

    def near(
        device: SimulatedDaqDevice, task: Task, rate_hz: float, clock: str, samples: int
    ) -> None:
        timing(device, task, rate_hz, clock, samples)
        task.rate_hz = 2048.0

    monkeypatch.setattr(SimulatedDaqDevice, "configure_timing", near)
    with pytest.raises(InputError, match="2048 Hz") as error:
        Bed().backend().open()
    assert (error.value.key, error.value.value) == ("acquisition.rate_hz", RATE_HZ)


def test_command_that_does_not_stand_at_zero_is_not_started_from(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bed = Bed()
    resting = bed.table.read_at_rest

    def off(rate_hz: float, samples: int) -> Any:
        volts = resting(rate_hz, samples)
        volts[0] += 0.5
        return volts

    monkeypatch.setattr(bed.table, "read_at_rest", off)
    with pytest.raises(InputError, match=r"3\.000 mm \(0\.500 V\)") as error:
        bed.backend().open()
    assert error.value.where == f"rig {bed.rig.name}: drive_disp_m"


def test_table_that_moves_is_waited_for_and_then_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    bed = Bed()
    resting = bed.table.read_at_rest

    def moves(rate_hz: float, samples: int) -> Any:
        volts = resting(rate_hz, samples)
        volts[1] += np.linspace(0.0, 0.1, samples)
        return volts

    monkeypatch.setattr(bed.table, "read_at_rest", moves)
    before = bed.clock.now()
    with pytest.raises(InputError, match=r"\d mm after 30 s") as error:
        bed.backend().open()
    assert error.value.where == f"rig {bed.rig.name}"
    assert bed.clock.now() - before > 30.0


def test_wired_channels_must_be_those_of_the_sensors() -> None:
    cut = CARD.replace('    { channel = "mass_disp_m", physical = "Dev1/ai3" },\n', "")
    with pytest.raises(InputError, match="mass_disp_m") as error:
        NiBackend(parse_toml(cut, RigConfig, "card"), SPECIMEN, RATE_HZ, ManualClock())
    assert error.value.key == "ni.inputs"


def test_trigger_is_that_of_the_inputs_chassis() -> None:
    rig = parse_toml(CARD.replace("Dev1/ai", "cDAQ1Mod3/ai"), RigConfig, "card")
    assert get_wiring(rig).trigger == "/cDAQ1/ai/StartTrigger"
    assert get_wiring(parse_toml(CARD, RigConfig, "card")).trigger == "/Dev1/ai/StartTrigger"


def test_absent_server_is_refused_with_a_remedy() -> None:
    rig = parse_toml(CARD.replace("127.0.0.1:7470", "127.0.0.1:9"), RigConfig, "card")
    with raises_input_error(remedy="shaketwin table --table ni_simulated"):
        check_reachable(rig)
    local = parse_toml(CARD.replace('endpoint = "127.0.0.1:7470"\n', ""), RigConfig, "card")
    with raises_input_error(remedy="ni.endpoint"):
        check_reachable(local)


def test_local_driver_is_warned_of() -> None:
    local = parse_toml(CARD.replace('endpoint = "127.0.0.1:7470"\n', ""), RigConfig, "card")
    assert "freezes in motion" in get_wiring(local).warnings[0]
    assert not get_wiring(parse_toml(CARD, RigConfig, "card")).warnings


@pytest.mark.parametrize("ppm", [-150.0, 0.0, 150.0])
def test_schedule_follows_the_clock_of_the_device(ppm: float) -> None:
    """An hour of blocks that come 2 ms late and later, from a device that is ahead or behind."""
    rate, start = 2000.0 * (1 + ppm * 1e-6), 50.0
    pace, chance = ClockSync(2000.0, start - 0.001), np.random.default_rng(1)
    off = []
    for last in range(19, 7_200_000, 20):
        taken = start + last / rate
        now_s = taken + 0.002 + float(chance.exponential(0.003))
        pace.update(last, now_s)
        off.append(pace.epoch_s + last / 2000.0 - taken)
    assert max(off) < 0.002 + 1e-9  # no sample is scheduled after it has come
    assert min(off) > -0.004  # nor long before it is taken
    assert abs(off[-1] - off[0]) < 0.003


def test_no_sample_is_scheduled_after_it_has_come() -> None:
    pace = ClockSync(2000.0, 50.0)
    pace.update(20, 50.009)
    assert pace.epoch_s + 20 / 2000.0 == pytest.approx(50.009)


def test_shipped_card_is_the_simulated_table() -> None:
    ours = parse_toml(CARD, RigConfig, "card").model_dump()
    theirs = parse_toml(RIG_TEXT, RigConfig, "card").model_dump()
    assert ours.pop("ni")
    for key in ("name", "title", "backend"):
        ours.pop(key), theirs.pop(key)
    assert ours == theirs


def test_samples_behind_a_shorter_command_never_play(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Also on a driver that keeps it, and after the rig has died."""
    write = SimulatedDaqDevice.write

    def keep_old_samples(
        device: SimulatedDaqDevice, task: Task, volts: Float1D, now_s: float
    ) -> None:
        end = task.offset + volts.size
        behind = task.volts.values(end, max(task.written, end))
        write(device, task, np.append(volts, behind), now_s)

    monkeypatch.setattr(SimulatedDaqDevice, "write", keep_old_samples)
    bed = Bed(CARD, tmp_path / "box")
    backend = bed.backend()
    backend.open()
    backend.queue(0, np.tile(motion(), 4))
    backend.start()
    backend.read(100)
    backend.queue(4000, np.zeros(2))
    bed.rest()
    life = read_flight_record(tmp_path / "box")[-1]
    assert life.samples.shape[1] > 16000, "it has played on to the end of the buffer"
    assert np.abs(life.row("command_m")[4000:]).max() == 0.0


class Slow:
    """A clock that runs slow against another one by so many ppm."""

    def __init__(self, clock: ManualClock, ppm: float) -> None:
        self._clock, self._share = clock, 1.0 - ppm * 1e-6

    def now(self) -> float:
        return self._clock.now() * self._share

    def wait_until(self, when: float) -> None:
        self._clock.wait_until(when / self._share)


def test_device_whose_clock_runs_slow_is_not_late() -> None:
    ppm, clock = 190.0, ManualClock(100.0)
    bed = Bed(clock=clock, device_clock=Slow(clock, ppm))
    backend = bed.backend()
    backend.open()
    backend.queue(0, motion())
    backend.start()
    start = backend.scheduled_time_s(0)
    for _ in range(1250):
        backend.read(40)
    taken = start + 49_999 / (
        RATE_HZ * (1.0 - ppm * 1e-6)
    )  # 25 s: 4.75 ms later than told at first
    assert abs(backend.scheduled_time_s(49_999) - taken) < 2e-3
    backend.close()


def test_command_far_beyond_what_is_queued_finds_the_last_value_held(tmp_path: Path) -> None:
    bed = Bed(CARD, tmp_path / "box")
    backend = bed.backend()
    backend.open()
    up = motion()[:500]
    backend.queue(0, up)
    backend.start()
    backend.read(20)
    backend.queue(9000, np.zeros(2))
    for _ in range(475):
        backend.read(20)
    backend.close()
    bed.rest()
    command = read_flight_record(tmp_path / "box")[-1].row("command_m") * bed.rig.output.volts_per_m
    assert np.abs(command[500:9000] - up[-1]).max() < 1e-4
    assert np.abs(command[9000:9500]).max() == 0.0


def test_server_that_is_gone_is_a_lost_connection(monkeypatch: pytest.MonkeyPatch) -> None:
    bed = Bed()
    backend = start_backend(bed)
    backend.read(200)

    def gone(request: Any, context: Any) -> None:
        raise Answer(grpc.StatusCode.UNAVAILABLE, "", ())

    for call in ("ReadAnalogF64", "WriteAnalogF64", "WriteDigitalLines", "IsTaskDone", "ClearTask"):
        monkeypatch.setattr(bed.service, call, gone)
    with pytest.raises(MachineLost, match="UNAVAILABLE"):
        backend.read(200)
    backend.close()
    backend.close()


def test_missing_library_is_named() -> None:
    code = (
        "import sys; sys.modules['nidaqmx'] = None\n"
        "from table_io.backends import check_reachable\n"
        "from table_io.config.folders import find_config\n"
        "from table_io.errors import InputError\n"
        "from table_io.config.rig_file import load_rig\n"
        "rig, _ = load_rig(find_config('ni_simulated', 'rigs'))\n"
        "try: check_reachable(rig)\n"
        "except InputError as error: print(error)\n"
    )
    completed = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert '"shaketwin[ni]"' in completed.stdout


def test_address_in_use_is_refused() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        rig = parse_toml(CARD.replace("127.0.0.1:7470", address), RigConfig, "card")
        with raises_input_error(key="ni.endpoint", value=address):
            ServerEndpoint(get_wiring(rig))
