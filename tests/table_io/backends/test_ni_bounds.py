"""What the NI backend does where an answer, the heartbeat or the device is not as it should be."""

import os
import signal
import threading
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest
from nidaqmx._stubs import nidaqmx_pb2 as pb

from table_io.backends import MachineLost
from table_io.backends.ni import driver
from table_io.backends.ni.backend import NiBackend
from table_io.backends.ni.driver import REMEDIES, check_reachable
from table_io.block import Float1D
from table_io.clock import RealClock
from table_io.config.base import parse_toml
from table_io.config.rig import RigConfig
from table_io.errors import InputError
from table_io.sim.ni.device import DriverError, ErrorCode, SimulatedDaqDevice, Task
from table_io.sim.ni.server import ServerEndpoint
from tests.builders.flight_records import read_flight_record
from tests.input_errors import raises_input_error
from tests.studies.ni import serve_table
from tests.studies.ni_error_codes import RATE_HZ, motion
from tests.table_io.backends.ni_wire import CARD, SPECIMEN, Answer, Bed, get_wiring, note_heartbeats

AT_MOST_S = 60.0  # until a server that holds everybody is let go, so that a test ends


def open_backend(bed: Bed) -> NiBackend:
    backend = bed.backend()
    backend.open()
    backend.queue(0, motion())
    return backend


def reads(backend: NiBackend, blocks: int) -> None:
    for _ in range(blocks):
        backend.read(20)


@pytest.mark.slow  # 20 s
def test_stopped_server_blocks_neither_read_nor_close(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A dozen calls meet their deadline here, one after another.
    monkeypatch.setattr(driver, "CALL_TIMEOUT_S", 1.0)
    with serve_table(tmp_path) as (_, rig, process):
        backend = NiBackend(rig, SPECIMEN, RATE_HZ, RealClock())
        backend.open()
        backend.queue(0, motion())
        backend.start()
        backend.read(200)
        let_go = threading.Event()

        def go_on() -> None:
            let_go.set()
            os.kill(process.pid, signal.SIGCONT)

        guard = threading.Timer(AT_MOST_S, go_on)
        os.kill(process.pid, signal.SIGSTOP)
        guard.start()
        try:
            with pytest.raises(MachineLost, match="DEADLINE"):
                reads(backend, 1000)
            backend.close()
            assert not let_go.is_set(), "it waited until the server went on"
            with pytest.raises(InputError):
                answers_and_opens(rig)
            assert not let_go.is_set(), "open waited until the server went on"
        finally:
            guard.cancel()
            os.kill(process.pid, signal.SIGCONT)


def answers_and_opens(rig: RigConfig) -> None:
    check_reachable(rig)
    NiBackend(rig, SPECIMEN, RATE_HZ, RealClock()).open()


def test_heart_beats_before_the_start_so_that_a_latch_can_be_reset() -> None:
    bed = Bed()
    times = note_heartbeats(bed)
    backend = bed.backend()
    backend.open()
    assert times == [bed.clock.now()]
    backend.tare(2000)
    backend.queue(0, motion())
    backend.start()
    backend.read(200)
    between = np.diff(times)
    assert len(times) > 12
    assert 0.04 < between.min() <= between.max() < 0.1
    backend.close()


WELL = CARD.replace("inputs = [", 'well = { interlock = "Dev1/port0/line1" }\ninputs = [', 1)


def test_open_interlock_is_not_started_against(monkeypatch: pytest.MonkeyPatch) -> None:
    bed = Bed(WELL)
    monkeypatch.setattr(
        bed.service,
        "ReadDigitalLines",
        lambda request, context: pb.ReadDigitalLinesResponse(
            read_array=b"\0", samps_per_chan_read=1, num_bytes_per_samp=1
        ),
    )
    backend = open_backend(bed)
    with pytest.raises(MachineLost, match="interlock"):
        backend.start()
    backend.close()
    bed.rest()
    assert bed.notices.count("the output drives the table") == 1  # when it was opened
    resetting = bed.backend()  # what commands nothing may start, so that somebody can reset it
    resetting.open()
    resetting.queue(0, np.zeros(2))
    resetting.start()
    resetting.close()


def test_start_whose_answer_is_lost_is_played_to_rest(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    bed = Bed(CARD, tmp_path / "box")
    backend = open_backend(bed)
    start = bed.service.StartTask
    count = iter(range(9))

    def lose_answer(request: Any, context: Any) -> Any:
        answer = start(request, context)
        if next(count) == 1:  # the input, and with it the output
            bed.clock.wait_until(bed.clock.now() + 0.6)
            raise Answer(grpc.StatusCode.UNAVAILABLE, "Socket closed", ())
        return answer

    monkeypatch.setattr(bed.service, "StartTask", lose_answer)
    with pytest.raises(MachineLost, match="UNAVAILABLE"):
        backend.start()
    backend.close()
    bed.rest()
    queued_m = motion() / bed.rig.output.volts_per_m
    command = read_flight_record(tmp_path / "box")[-1].row("command_m")
    assert np.abs(command[: queued_m.size] - queued_m).max() <= bed.rig.output.lsb_m


@pytest.mark.parametrize("call", ["IsTaskDone", "WriteDigitalLines"])
def test_stall_inside_a_heartbeat_is_a_lost_machine(
    call: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    bed = Bed()
    backend = open_backend(bed)
    backend.start()
    backend.read(200)
    before = getattr(bed.service, call)

    def slow(request: Any, context: Any) -> Any:
        bed.clock.wait_until(bed.clock.now() + 0.28)
        return before(request, context)

    monkeypatch.setattr(bed.service, call, slow)
    with pytest.raises(MachineLost, match=r" 0\.3"):
        reads(backend, 10)
    backend.close()
    bed.rest()


@pytest.mark.parametrize("rate_hz", [250.0, 500.0, 1000.0])
def test_tare_is_read_in_pieces_that_come_in_time(rate_hz: float) -> None:
    bed = Bed(CARD.replace("rates_hz = [", "rates_hz = [250.0, 500.0, "))
    backend = bed.backend(rate_hz)
    backend.open()
    assert backend.tare(int(2.0 * rate_hz)).shape == (9, int(2.0 * rate_hz))
    backend.close()


def test_error_before_the_start_is_a_lost_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    bed = Bed()
    backend = bed.backend()
    backend.open()

    def raise_driver_error(*_: Any) -> bool:
        raise DriverError(-200284)

    monkeypatch.setattr(bed.device, "samples_ready", raise_driver_error)
    with pytest.raises(MachineLost, match="-200284"):
        backend.tare(100)
    backend.close()


def test_driver_that_ignores_a_replacement_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    write = SimulatedDaqDevice.write

    def ignore_replacement(
        device: SimulatedDaqDevice, task: Task, volts: Float1D, now_s: float
    ) -> None:
        if task.kind == "ao" and task.running and task.offset < task.written:
            return
        write(device, task, volts, now_s)

    monkeypatch.setattr(SimulatedDaqDevice, "write", ignore_replacement)
    with pytest.raises(InputError) as error:
        Bed().backend().open()
    assert error.value.where.endswith("drive_disp_m")


def test_test_of_a_replacement_is_eight_steps_of_the_output(tmp_path: Path) -> None:
    bed = Bed(CARD, tmp_path / "box")
    bed.backend().open()
    bed.rest()
    most = max(np.abs(life.row("command_m")).max() for life in read_flight_record(tmp_path / "box"))
    assert most == pytest.approx(8 * bed.rig.output.lsb_m, rel=0.01)
    assert most < 1e-3 * bed.rig.output.span_mm * 1e-3  # what is at rest


def test_tasks_of_a_dead_rig_are_cleared_by_another_rig() -> None:
    bed = Bed()
    gone = open_backend(bed)
    gone.start()
    gone.read(700)
    other = parse_toml(CARD.replace('name = "ni_simulated"', 'name = "renamed"'), RigConfig, "card")
    backend = NiBackend(other, SPECIMEN, RATE_HZ, bed.clock, bed.wire)
    backend.open()
    backend.close()


def test_device_in_use_is_refused_with_a_remedy() -> None:
    bed = Bed()
    theirs, _ = bed.device.create_task("theirs", 1)
    bed.device.add_channel(theirs, "ai", "Dev1/ai0")
    bed.device.reserve(theirs)
    with pytest.raises(InputError, match="-50103") as error:
        bed.backend().open()
    assert error.value.remedy == REMEDIES[-50103]


def test_moving_write_position_is_no_other_rig(monkeypatch: pytest.MonkeyPatch) -> None:
    bed = Bed()
    gone = open_backend(bed)
    gone.start()
    gone.read(700)

    def position(request: Any, context: Any) -> Any:
        now_s = bed.clock.now()
        task = bed.device.find_task(request.task.id)
        bed.device.advance(now_s)
        return pb.GetWriteAttributeUInt64Response(value=task.generated_samples(now_s))

    monkeypatch.setattr(bed.service, "GetWriteAttributeUInt64", position)
    bed.backend().open()


def test_device_with_fixed_memory_is_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    bed = Bed(CARD.replace("held_by_device_ms = 20.0", "held_by_device_ms = 4200.0"))
    reserve = bed.device.reserve

    def unless_cut(task: Task) -> None:
        if task.kind == "ao" and task.fifo_samples != 8191:
            raise DriverError(ErrorCode.INVALID_VALUE)
        reserve(task)

    monkeypatch.setattr(bed.device, "reserve", unless_cut)
    backend = bed.backend()
    backend.open()
    backend.close()


def test_channel_that_is_not_there_is_named() -> None:
    bed = Bed()
    wrong = parse_toml(CARD.replace('"Dev1/ai8"', '"Dev1/ai9"'), RigConfig, "card")
    with pytest.raises(InputError, match=r"-200170 .*Dev1/ai9"):
        NiBackend(wrong, SPECIMEN, RATE_HZ, bed.clock, bed.wire).open()


def test_only_a_simulated_table_is_advised_to_start_one() -> None:
    text = CARD.replace("127.0.0.1:7470", "127.0.0.1:9")
    real = text[: text.index("# True parameters of the simulated table")]
    with pytest.raises(InputError) as refusal:
        check_reachable(parse_toml(real, RigConfig, "card"))
    assert "shaketwin table" not in refusal.value.remedy


def test_run_ends_before_the_driver_cannot_count_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("table_io.backends.ni.backend.MAX_WRITE_INDEX", 9000)
    bed = Bed()
    backend = open_backend(bed)
    backend.start()
    backend.read(1000)
    with pytest.raises(MachineLost, match="sample 9000"):
        backend.queue(4000, np.zeros(2000))
    backend.close()
    bed.rest()


def test_served_card_needs_an_address() -> None:
    local = parse_toml(CARD.replace('endpoint = "127.0.0.1:7470"\n', ""), RigConfig, "card")
    with raises_input_error(key="ni.endpoint"):
        ServerEndpoint(get_wiring(local))
