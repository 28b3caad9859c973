"""The three tasks of a rig on the driver, through the nidaqmx client: inputs, output, heartbeat.

The output has a clock of its own, divided from the time base that clocks the inputs too, and starts
with their trigger: so the two cannot drift apart, and the command goes on where the inputs fail. It
never regenerates; a write is placed by the index of its first sample. The device is told to hold as
little as it can.
"""

import contextlib
from typing import Any

import numpy as np
from nidaqmx import GrpcSessionOptions, SessionInitializationBehavior, Task
from nidaqmx.constants import (
    AcquisitionType,
    LineGrouping,
    OutputDataTransferCondition,
    RegenerationMode,
    TaskMode,
    TerminalConfiguration,
    WriteRelativeTo,
)
from nidaqmx.errors import DaqError
from nidaqmx.stream_readers import AnalogMultiChannelReader
from nidaqmx.stream_writers import AnalogSingleChannelWriter, DigitalSingleChannelWriter

from table_io.block import Float1D, Float2D
from table_io.rig import Rig

BUFFER_S = 60.0  # of output that can be queued, and of input that may wait
READ_S = 1.0  # that a read waits; who asks for it loses patience before
WRITE_S = 0.2  # that a write waits: less than the heartbeat may be silent
BEAT_S = 0.05  # between two changes of the heartbeat line: 10 Hz
TERMINALS = {
    "differential": TerminalConfiguration.DIFF,
    "rse": TerminalConfiguration.RSE,
    "nrse": TerminalConfiguration.NRSE,
    "pseudodifferential": TerminalConfiguration.PSEUDO_DIFF,
    "default": TerminalConfiguration.DEFAULT,
}
KINDS = ("input", "output", "heartbeat")


class Tasks:
    """What drives one rig, configured and not started; DaqError where the driver does not agree."""

    def __init__(self, rig: Rig, rate_hz: float, channel: Any) -> None:
        self._rig, self._rate_hz, self._channel = rig, rate_hz, channel
        self._made: list[Task] = []
        self._level = False
        try:
            self.input, self.output, self.line = (self._make(kind) for kind in KINDS)
            self._configure()
        except BaseException:
            self.clear()
            raise

    def _make(self, kind: str) -> Task:
        """A new task; on a server its session has a name, by which the next rig finds it."""
        name = session(self._rig, kind)
        task = Task(name, grpc_options=_options(self._channel, name, new=True))
        self._made.append(task)
        return task

    def _configure(self) -> None:
        rig, rate = self._rig, self._rate_hz
        assert rig.ni is not None
        wired = {one.channel: one for one in rig.ni.inputs}
        for sensor in rig.sensors:
            one, full = wired[sensor.channel], abs(sensor.range * sensor.volts_per_unit)
            self.input.ai_channels.add_ai_voltage_chan(
                one.physical, "", TERMINALS[one.terminals], min_val=-full, max_val=full
            )
        samples = round(BUFFER_S * rate)
        continuous = AcquisitionType.CONTINUOUS
        self.input.timing.cfg_samp_clk_timing(
            rate, "", sample_mode=continuous, samps_per_chan=samples
        )
        span = rig.output.span_v
        command = self.output.ao_channels.add_ao_voltage_chan(
            rig.ni.output, min_val=-span, max_val=span
        )
        self.output.timing.cfg_samp_clk_timing(
            rate, rig.ni.output_clock, sample_mode=continuous, samps_per_chan=samples
        )
        stream = self.output.out_stream
        stream.output_buf_size = samples
        stream.regen_mode = RegenerationMode.DONT_ALLOW_REGENERATION
        stream.relative_to = WriteRelativeTo.FIRST_SAMPLE
        with contextlib.suppress(DaqError):  # not every device lets its own memory be cut
            stream.output_onbrd_buf_size = rig.ni.held(rate)
        with contextlib.suppress(DaqError):
            command.ao_data_xfer_req_cond = OutputDataTransferCondition.ON_BOARD_MEMORY_EMPTY
        self.output.triggers.start_trigger.cfg_dig_edge_start_trig(rig.ni.trigger)
        self.line.do_channels.add_do_chan(
            rig.ni.heartbeat, line_grouping=LineGrouping.CHAN_PER_LINE
        )
        self.input.control(TaskMode.TASK_RESERVE)
        try:
            self.output.control(TaskMode.TASK_RESERVE)
        except DaqError:  # some say only now that their own memory cannot be cut
            for owner, wish in (
                (stream, "output_onbrd_buf_size"),
                (command, "ao_data_xfer_req_cond"),
            ):
                with contextlib.suppress(DaqError):
                    delattr(owner, wish)
            self.output.control(TaskMode.TASK_RESERVE)
        self.line.control(TaskMode.TASK_RESERVE)
        self._read = AnalogMultiChannelReader(self.input.in_stream)
        self._write = AnalogSingleChannelWriter(stream, auto_start=False)
        self._beat = DigitalSingleChannelWriter(self.line.out_stream, auto_start=True)
        for one in (self._read, self._write, self._beat):
            one.verify_array_shape = False  # it would ask the driver each time

    @property
    def width(self) -> int:
        """Channels of the inputs."""
        return len(self._rig.channels)

    @property
    def rates_hz(self) -> tuple[float, float]:
        """What the driver made of the rate: of the inputs, of the output."""
        return self.input.timing.samp_clk_rate, self.output.timing.samp_clk_rate

    def read(self, samples: int) -> Float2D:
        """The next samples of the inputs in V, (channel, sample)."""
        volts = np.empty((self.width, samples))
        self._read.read_many_sample(volts, samples, timeout=READ_S)
        return volts

    def write(self, index: int, volts: Float1D) -> None:
        """Place output in V, (sample,), from sample `index` on."""
        self.output.out_stream.offset = index
        self._write.write_many_sample(np.ascontiguousarray(volts), timeout=WRITE_S)

    def beat(self) -> None:
        """Change the heartbeat line."""
        self._level = not self._level
        self._beat.write_one_sample_one_line(self._level, timeout=WRITE_S)

    def generated(self) -> int:
        """Samples of output that have left."""
        return self.output.out_stream.total_samp_per_chan_generated

    def clear(self) -> None:
        """Stop the tasks and forget them; where the driver is gone there is nothing to forget."""
        made, self._made = self._made, []
        for task in made:
            with contextlib.suppress(Exception):
                task.close()


def session(rig: Rig, kind: str) -> str:
    """Name of a task on this rig's device, whatever its card is called."""
    assert rig.ni is not None
    return f"shaketwin_{rig.ni.output.split('/')[0]}_{kind}"


def left_over(rig: Rig, channel: Any) -> dict[str, Task]:
    """Tasks that a rig which is gone has left in the server, by kind."""
    found = {}
    for kind in KINDS:
        name = session(rig, kind)
        with contextlib.suppress(Exception):
            found[kind] = Task(name, grpc_options=_options(channel, name, new=False))
    return found


def _options(channel: Any, name: str, new: bool) -> GrpcSessionOptions | None:
    if channel is None:
        return None
    how = SessionInitializationBehavior
    return GrpcSessionOptions(
        channel,
        name,
        initialization_behavior=how.INITIALIZE_SERVER_SESSION
        if new
        else how.ATTACH_TO_SERVER_SESSION,
    )
