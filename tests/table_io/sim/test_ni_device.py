"""The model of a DAQmx device behaves as the driver's documentation says, to its error codes."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from table_io.block import Float1D, Float2D
from table_io.sim.ni.device import (
    FIRST_SAMPLE,
    WHEN_EMPTY,
    WHEN_NOT_FULL,
    DriverError,
    ErrorCode,
    SimulatedDaqDevice,
    Task,
)

RATE_HZ = 2000.0
HELD_SAMPLES = 40  # samples in the device, where it is told to hold few
START_S = 10.0


class Plotter:
    """What stands behind the device: it writes down which voltage was played, and reads it back."""

    def __init__(self) -> None:
        self.volts = np.zeros(1)
        self.since = np.nan
        self.given = 0
        self.why = ""
        self.beats: list[float] = []

    @property
    def moving(self) -> bool:
        return bool(np.isfinite(self.since))

    def arm(self, rate_hz: float) -> None:
        self.volts, self.why = np.zeros(1), ""

    def feed(self, index: int, volts: Float1D) -> None:
        held = np.full(max(index - self.volts.size, 0), self.volts[-1])
        self.volts = np.concatenate([self.volts[:index], held, volts])

    def start(self, now_s: float) -> None:
        self.since, self.given = now_s, 0

    def freeze(self, why: str) -> None:
        self.why = why

    def receive_heartbeat(self, now_s: float) -> None:
        self.beats.append(now_s)

    def take_played(self, count: int) -> Float1D:
        return np.pad(self.volts, (0, max(count - self.volts.size, 0)), "edge")[:count]

    def play(self, now_s: float) -> list[Float2D]:
        if not self.moving:
            return []
        due = int((now_s - self.since) * RATE_HZ + 1e-6) + 1
        first, self.given = self.given, due
        return [self.take_played(due)[None, first:]]

    def read_at_rest(self, rate_hz: float, samples: int) -> Float2D:
        return np.zeros((1, samples))


class Bank:
    """A device with its three tasks, configured as a rig does it."""

    def __init__(self, **output: Any) -> None:
        self.table = Plotter()
        self.device = SimulatedDaqDevice(self.table, (RATE_HZ,), START_S)
        self.input = self._task("ai", "Dev1/ai0", 4000)
        self.output = self._task("ao", "Dev1/ao0", 10000)
        self.line = self.device.create_task("line", 0)[0]
        self.device.add_channel(self.line, "do", "Dev1/port0/line0")
        self.output.trigger = "/Dev1/ai/StartTrigger"
        self.output.regenerates, self.output.relative_to = False, FIRST_SAMPLE
        self.output.transfer_condition = WHEN_EMPTY
        for name, value in output.items():
            setattr(self.output, name, value)

    def _task(self, kind: str, physical: str, buffer: int) -> Task:
        task, new = self.device.create_task(kind, 0)
        assert new
        self.device.add_channel(task, kind, physical)
        self.device.configure_timing(task, RATE_HZ, "", buffer)
        return task

    def write(self, first: int, volts: Float1D, now_s: float = START_S) -> None:
        self.output.offset = first
        self.device.write(self.output, volts, now_s)

    def go(self, volts: Float1D) -> None:
        self.write(0, volts)
        self.device.start(self.output, START_S)
        self.device.start(self.input, START_S)


def code_of(call: Callable[[], object]) -> int:
    with pytest.raises(DriverError) as raised:
        call()
    return raised.value.code


RAMP = np.arange(1000) / 1000.0


def test_output_waits_for_the_trigger_of_the_input_and_shares_its_sample_0() -> None:
    bank = Bank()
    bank.write(0, RAMP)
    bank.device.start(bank.output, START_S)
    bank.device.advance(START_S + 1.0)
    assert not bank.table.moving
    bank.device.start(bank.input, START_S + 1.0)
    assert bank.device.samples_ready(bank.input, 200, START_S + 1.1)
    assert (bank.device.read(bank.input, 200)[0] == RAMP[:200]).all()


def test_only_samples_in_the_buffer_are_replaced() -> None:
    bank = Bank()
    bank.go(RAMP)
    now_s = START_S + 0.1  # 201 samples have left, the next 40 lie in the device
    bank.device.advance(now_s)
    last = bank.output.generated_samples(now_s) + HELD_SAMPLES - 1
    assert code_of(lambda: bank.write(last, np.ones(500), now_s)) == ErrorCode.NO_LONGER_WRITEABLE
    bank.write(last + 1, np.ones(500), now_s)
    bank.device.advance(START_S + 0.3)
    assert (bank.table.take_played(last + 1) == RAMP[: last + 1]).all()
    assert bank.table.take_played(last + 2)[-1] == 1.0


def test_by_default_the_device_swallows_all_that_its_memory_holds() -> None:
    bank = Bank(transfer_condition=WHEN_NOT_FULL)
    bank.go(np.zeros(9000))
    bank.device.advance(START_S + 0.1)
    assert (
        code_of(lambda: bank.write(8000, np.ones(2), START_S + 0.1))
        == ErrorCode.NO_LONGER_WRITEABLE
    )
    bank.write(8450, np.ones(2), START_S + 0.1)


def test_without_regeneration_an_output_that_is_not_fed_stops_and_freezes() -> None:
    bank = Bank()
    bank.go(RAMP)
    bank.device.advance(START_S + 1.0)
    assert bank.table.why == "output ran out at sample 1000"
    assert bank.table.take_played(2000)[-1] == RAMP[-1]
    assert code_of(lambda: bank.device.is_done(bank.output, START_S + 1.0)) == -200290
    assert code_of(lambda: bank.write(1000, RAMP, START_S + 1.0)) == -200290


def test_output_with_regeneration_is_repeated() -> None:
    bank = Bank(regenerates=True)
    bank.go(RAMP)
    bank.device.advance(START_S + 1.2)
    assert (bank.table.take_played(2400) == np.tile(RAMP, 3)[:2400]).all()
    assert not bank.device.is_done(bank.output, START_S + 1.2)


def test_samples_behind_the_last_write_are_dropped() -> None:
    bank = Bank()
    bank.go(RAMP)
    bank.write(300, np.ones(10), START_S + 0.05)
    bank.device.advance(START_S + 0.5)
    assert bank.table.why == "output ran out at sample 310"


def test_buffer_has_an_end_and_no_hole() -> None:
    bank = Bank()
    assert code_of(lambda: bank.write(0, np.zeros(10001))) == ErrorCode.NO_MORE_SPACE
    bank.go(RAMP)
    assert code_of(lambda: bank.write(1000, np.zeros(9100), START_S)) == ErrorCode.NOT_YET_WRITEABLE
    assert code_of(lambda: bank.write(1001, np.zeros(10), START_S)) == ErrorCode.NOT_YET_WRITEABLE
    assert code_of(lambda: bank.write(-1, np.zeros(10), START_S)) == ErrorCode.NEGATIVE_WRITE


def test_output_needs_samples_before_it_starts() -> None:
    bank = Bank()
    bank.write(0, np.zeros(HELD_SAMPLES - 1))
    assert code_of(lambda: bank.device.start(bank.output, START_S)) == ErrorCode.NOT_ENOUGH_WRITTEN


def test_input_that_nobody_reads_ends_and_the_output_goes_on() -> None:
    bank = Bank()
    bank.go(np.tile(RAMP, 9))
    late = START_S + 4001 / RATE_HZ
    assert (
        code_of(lambda: bank.device.samples_ready(bank.input, 1, late))
        == ErrorCode.NO_LONGER_AVAILABLE
    )
    assert not bank.table.why
    assert not bank.device.is_done(bank.output, late)


def test_output_on_the_clock_of_the_inputs_freezes_with_them() -> None:
    bank = Bank(clock="/Dev1/ai/SampleClock")
    bank.go(np.tile(RAMP, 9))
    bank.device.stop(bank.input, START_S + 0.25)
    assert bank.table.why == "output without a clock at sample 501"
    assert bank.table.take_played(3000)[-1] == RAMP[500]


def test_output_that_is_stopped_freezes_where_it_is() -> None:
    bank = Bank()
    bank.go(RAMP)
    bank.device.clear(bank.output, START_S + 0.25)
    assert bank.table.take_played(3000)[-1] == RAMP[500]
    assert code_of(lambda: bank.device.find_task(bank.output.number)) == ErrorCode.INVALID_TASK


def test_samples_are_waited_for_and_read_once() -> None:
    bank = Bank()
    bank.go(RAMP)
    assert not bank.device.samples_ready(bank.input, 100, START_S + 98 / RATE_HZ)
    assert bank.device.samples_ready(bank.input, 100, START_S + 99 / RATE_HZ)
    whole = np.concatenate([bank.device.read(bank.input, count) for count in (60, 60)], axis=1)
    assert (whole[0] == RAMP[:100]).all()


def test_device_that_is_in_use_is_reserved_and_a_session_is_found_by_its_name() -> None:
    bank = Bank()
    bank.go(RAMP)
    other = bank.device.create_task("other", 1)[0]
    bank.device.add_channel(other, "ai", "Dev1/ai0")
    bank.device.configure_timing(other, RATE_HZ, "", 100)
    assert code_of(lambda: bank.device.start(other, START_S)) == ErrorCode.RESERVED
    assert bank.device.create_task("ao", 2) == (bank.output, False)
    with pytest.raises(KeyError):
        bank.device.create_task("ao", 1)
    with pytest.raises(KeyError):
        bank.device.create_task("nobody", 2)


def test_rate_that_the_device_has_not_and_a_task_without_channels_are_refused() -> None:
    bank = Bank()
    assert (
        code_of(lambda: bank.device.configure_timing(bank.input, 1234.5, "", 10))
        == ErrorCode.INVALID_VALUE
    )
    empty = bank.device.create_task("", 0)[0]
    assert (
        code_of(lambda: bank.device.configure_timing(empty, RATE_HZ, "", 10))
        == ErrorCode.NO_CHANNELS
    )
    assert (
        code_of(lambda: bank.device.add_channel(bank.input, "ao", "Dev1/ao0"))
        == ErrorCode.NOT_SUPPORTED
    )
