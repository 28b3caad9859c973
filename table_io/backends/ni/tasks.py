"""DAQmx tasks of a rig, through the nidaqmx client: inputs, output, heartbeat.

The output has its own sample clock, divided from the same time base as that of the inputs, and
starts on their trigger: the two cannot drift apart, and the command continues if the inputs fail.
Regeneration is off; a write is placed by the index of its first sample. The device is configured to
hold as little output as it can.
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

from table_io.backends.ni.config import NiWiring
from table_io.block import Float1D, Float2D
from table_io.config.rig import RigConfig

BUFFER_S = 60.0  # of output that can be queued, and of input that is kept unread
READ_TIMEOUT_S = 1.0  # longer than the caller waits
WRITE_TIMEOUT_S = 0.2  # shorter than the watchdog limit of the heartbeat
HEARTBEAT_PERIOD_S = 0.05  # between two edges of the heartbeat line: 10 Hz
TERMINALS = {
    "differential": TerminalConfiguration.DIFF,
    "rse": TerminalConfiguration.RSE,
    "nrse": TerminalConfiguration.NRSE,
    "pseudodifferential": TerminalConfiguration.PSEUDO_DIFF,
    "default": TerminalConfiguration.DEFAULT,
}
TASK_KINDS = ("input", "output", "heartbeat")


class RigTasks:
    """The three tasks of a rig, configured and not started; DaqError if the driver refuses."""

    def __init__(self, rig: RigConfig, rate_hz: float, channel: Any) -> None:
        self._rig, self._rate_hz, self._channel = rig, rate_hz, channel
        self._open_tasks: list[Task] = []
        self._level = False
        try:
            self.input, self.output, self.heartbeat = (
                self._create_task(kind) for kind in TASK_KINDS
            )
            self._configure()
        except BaseException:
            self.clear()
            raise

    def _create_task(self, kind: str) -> Task:
        """Create a task; on a server, its session name lets the next rig find it."""
        name = session_name(self._rig, kind)
        task = Task(name, grpc_options=_options(self._channel, name, new=True))
        self._open_tasks.append(task)
        return task

    def _configure(self) -> None:
        rig, rate = self._rig, self._rate_hz
        wiring = rig.require_section("ni", NiWiring)
        inputs = {analog_input.channel: analog_input for analog_input in wiring.inputs}
        for sensor in rig.sensors:
            analog_input, full_scale_v = (
                inputs[sensor.channel],
                abs(sensor.range * sensor.volts_per_unit),
            )
            self.input.ai_channels.add_ai_voltage_chan(
                analog_input.physical,
                "",
                TERMINALS[analog_input.terminals],
                min_val=-full_scale_v,
                max_val=full_scale_v,
            )
        samples = round(BUFFER_S * rate)
        continuous = AcquisitionType.CONTINUOUS
        self.input.timing.cfg_samp_clk_timing(
            rate, "", sample_mode=continuous, samps_per_chan=samples
        )
        span_v = rig.output.span_v
        command = self.output.ao_channels.add_ao_voltage_chan(
            wiring.output, min_val=-span_v, max_val=span_v
        )
        self.output.timing.cfg_samp_clk_timing(
            rate, wiring.output_clock, sample_mode=continuous, samps_per_chan=samples
        )
        stream = self.output.out_stream
        stream.output_buf_size = samples
        stream.regen_mode = RegenerationMode.DONT_ALLOW_REGENERATION
        stream.relative_to = WriteRelativeTo.FIRST_SAMPLE
        with contextlib.suppress(DaqError):  # not every device allows a smaller onboard buffer
            stream.output_onbrd_buf_size = wiring.device_buffer_samples(rate)
        with contextlib.suppress(DaqError):
            command.ao_data_xfer_req_cond = OutputDataTransferCondition.ON_BOARD_MEMORY_EMPTY
        self.output.triggers.start_trigger.cfg_dig_edge_start_trig(wiring.trigger)
        self.heartbeat.do_channels.add_do_chan(
            wiring.heartbeat, line_grouping=LineGrouping.CHAN_PER_LINE
        )
        self.input.control(TaskMode.TASK_RESERVE)
        try:
            self.output.control(TaskMode.TASK_RESERVE)
        except DaqError:  # some devices refuse the smaller onboard buffer only here
            for owner, setting in (
                (stream, "output_onbrd_buf_size"),
                (command, "ao_data_xfer_req_cond"),
            ):
                with contextlib.suppress(DaqError):
                    delattr(owner, setting)
            self.output.control(TaskMode.TASK_RESERVE)
        self.heartbeat.control(TaskMode.TASK_RESERVE)
        self._read = AnalogMultiChannelReader(self.input.in_stream)
        self._write = AnalogSingleChannelWriter(stream, auto_start=False)
        self._beat = DigitalSingleChannelWriter(self.heartbeat.out_stream, auto_start=True)
        for accessor in (self._read, self._write, self._beat):
            accessor.verify_array_shape = False  # the check would call the driver each time

    @property
    def channel_count(self) -> int:
        """Number of input channels."""
        return len(self._rig.channels)

    @property
    def rates_hz(self) -> tuple[float, float]:
        """Actual sample rates in Hz, as set by the driver: of the inputs, of the output."""
        return self.input.timing.samp_clk_rate, self.output.timing.samp_clk_rate

    def read(self, samples: int) -> Float2D:
        """Read the next samples of the inputs in V, (channel, sample)."""
        volts = np.empty((self.channel_count, samples))
        self._read.read_many_sample(volts, samples, timeout=READ_TIMEOUT_S)
        return volts

    def write(self, index: int, volts: Float1D) -> None:
        """Write output in V, (sample,), from sample `index` on."""
        self.output.out_stream.offset = index
        self._write.write_many_sample(np.ascontiguousarray(volts), timeout=WRITE_TIMEOUT_S)

    def toggle_heartbeat(self) -> None:
        """Toggle the heartbeat line."""
        self._level = not self._level
        self._beat.write_one_sample_one_line(self._level, timeout=WRITE_TIMEOUT_S)

    def count_generated(self) -> int:
        """Return the number of output samples generated."""
        return self.output.out_stream.total_samp_per_chan_generated

    def clear(self) -> None:
        """Stop and clear the tasks; ignore errors of a driver that is gone."""
        open_tasks, self._open_tasks = self._open_tasks, []
        for task in open_tasks:
            with contextlib.suppress(Exception):
                task.close()


def session_name(rig: RigConfig, kind: str) -> str:
    """Return the session name of a task; it depends on the device, not on the name of the rig."""
    wiring = rig.require_section("ni", NiWiring)
    return f"shaketwin_{wiring.output.split('/')[0]}_{kind}"


def find_leftover_tasks(rig: RigConfig, channel: Any) -> dict[str, Task]:
    """Return the tasks that a rig that ended has left in the server, by kind."""
    tasks = {}
    for kind in TASK_KINDS:
        name = session_name(rig, kind)
        with contextlib.suppress(Exception):
            tasks[kind] = Task(name, grpc_options=_options(channel, name, new=False))
    return tasks


def _options(channel: Any, name: str, new: bool) -> GrpcSessionOptions | None:
    if channel is None:
        return None
    behavior = SessionInitializationBehavior
    return GrpcSessionOptions(
        channel,
        name,
        initialization_behavior=behavior.INITIALIZE_SERVER_SESSION
        if new
        else behavior.ATTACH_TO_SERVER_SESSION,
    )
