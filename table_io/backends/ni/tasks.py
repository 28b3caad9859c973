"""DAQmx tasks of a rig, and their checks at the start, through the nidaqmx client.

The output has its own sample clock, divided from the same time base as that of the inputs, and
starts on their trigger: the two cannot drift apart, and the command continues if the inputs fail.
Regeneration is off; a write is placed by the index of its first sample. The device is configured to
hold as little output as it can. Before anything moves, leftover tasks are cleared, and rest and the
replacement of queued output are verified.
"""

import contextlib
from collections.abc import Callable
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
from nidaqmx.errors import DaqError, Error
from nidaqmx.stream_readers import AnalogMultiChannelReader
from nidaqmx.stream_writers import AnalogSingleChannelWriter, DigitalSingleChannelWriter

from table_io.backends.ni.config import NiWiring
from table_io.backends.ni.driver import describe_error
from table_io.block import Float1D, Float2D
from table_io.clock import Clock
from table_io.config.calibration import volts_to_si
from table_io.config.rig import RigConfig
from table_io.errors import InputError

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
            analog_input = inputs[sensor.channel]
            full_scale_v = abs(sensor.range * sensor.volts_per_unit)
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


REST_WINDOW_S = 0.25  # of input in which rest is judged
REST_TIMEOUT_S = 30.0  # for the table to come to rest
MAX_OFFSET_SHARE = 1e-3  # of the command's span: allowed offset from 0 V
MAX_MOTION_SHARE = 4e-3  # of the sensor's range: allowed peak-to-peak motion
BASELINE_S = 0.2
WRITE_TRANSIT_S = 0.01  # from the call of a write until it takes effect
MAX_RATE_ERROR = 1e-6
NUDGE_LSB, NUDGE_S = 8, 0.02  # test pulse of the output, below MAX_MOTION_SHARE
MAX_LOOPBACK_LAG_S = 0.1  # delay of the command wired back, at most
NUDGE_TAIL_S = 1.0  # of zeros after the pulse
MIN_LOOPBACK_SHARE = 0.5  # of the pulse that must be measured
SETTLE_S = 0.5  # after the pulse
TRIES_PER_LEAD = 20  # a busy computer may miss some


def clear_leftover_tasks(rig: RigConfig, channel: Any, clock: Clock) -> None:
    """Wait until output that an earlier rig left in the server has been played; clear it."""
    tasks = find_leftover_tasks(rig, channel)
    output = tasks.get("output")
    with contextlib.suppress(DaqError):  # its buffer ran out, or it was never started
        if output is not None:
            # By then everything that a dead rig had queued has been played.
            deadline_s = clock.now() + BUFFER_S + REST_WINDOW_S
            while not output.is_task_done():
                if clock.now() > deadline_s:
                    raise InputError(
                        "another rig drives this device",
                        where=f"rig {rig.name}",
                        remedy="end it first",
                    )
                clock.wait_until(clock.now() + REST_WINDOW_S)
    for task in tasks.values():
        with contextlib.suppress(Error):
            task.close()


def require_rest(rig: RigConfig, tasks: RigTasks, rate_hz: float, clock: Clock) -> None:
    """Raise InputError unless the command is at 0 V and the table at rest within REST_TIMEOUT_S.

    The output will start at 0 V; from any other voltage that would be a step.
    """
    deadline_s = clock.now() + REST_TIMEOUT_S
    command, position = (rig.channels.index(name) for name in ("drive_disp_m", "table_disp_m"))
    while True:
        volts = read_at_rest(tasks, round(REST_WINDOW_S * rate_hz), rate_hz)
        values = volts_to_si(volts, rig.sensors, {})
        offset_m = float(values[command].mean())
        motion_m = float(np.ptp(values[position]))
        at_zero = abs(offset_m) <= MAX_OFFSET_SHARE * rig.output.span_mm * 1e-3
        if at_zero and motion_m <= MAX_MOTION_SHARE * rig.sensors[position].range_si:
            return
        if clock.now() > deadline_s:
            break
        clock.wait_until(clock.now() + REST_WINDOW_S)
    if not at_zero:
        raise InputError(
            f"the command wired back is {offset_m * 1e3:.3f} mm "
            f"({offset_m * rig.output.volts_per_m:.3f} V), not 0; starting would cause a step",
            where=f"rig {rig.name}: drive_disp_m",
            remedy="bring the table to its mean with its own controller, and check the wire from "
            "the output to this input",
        )
    raise InputError(
        f"the table still moves by {motion_m * 1e3:.2f} mm after {REST_TIMEOUT_S:g} s",
        where=f"rig {rig.name}",
        remedy="bring it to rest first",
    )


def read_at_rest(
    tasks: RigTasks, samples: int, rate_hz: float, before_chunk: Callable[[], None] = lambda: None
) -> Float2D:
    """Read volts at rest, (channel, sample); call `before_chunk` before each chunk."""
    tasks.input.start()
    try:
        return _read_chunks(tasks, samples, rate_hz, before_chunk)
    finally:
        tasks.input.stop()


def _read_chunks(
    tasks: RigTasks, samples: int, rate_hz: float, before_chunk: Callable[[], None] = lambda: None
) -> Float2D:
    """Read volts, (channel, sample), in chunks far shorter than the time-out of a read."""
    chunk = max(round(HEARTBEAT_PERIOD_S / 2 * rate_hz), 1)
    chunks = [np.empty((tasks.channel_count, 0))]
    for at in range(0, samples, chunk):
        before_chunk()
        chunks.append(tasks.read(min(chunk, samples - at)))
    return np.concatenate(chunks, axis=1)


def verify_output_replacement(rig: RigConfig, tasks: RigTasks, rate_hz: float) -> None:
    """Verify that queued output can be replaced: a pulse of NUDGE_LSB for NUDGE_S replaces zeros.

    Raises InputError if the device holds more output than the rig file states, or if the command
    wired back does not show the pulse. The tasks cannot be used again afterwards.
    """
    wiring = rig.require_section("ni", NiWiring)
    required_lead = replace_after_samples(rig, rate_hz)
    count = round((BASELINE_S + BUFFER_S / 4) * rate_hz)
    tasks.write(0, np.zeros(count))
    tasks.output.start()
    tasks.input.start()
    baseline = _read_chunks(tasks, max(round(BASELINE_S * rate_hz), 1), rate_hz)
    lead, first_error, tries = required_lead, "", 0
    nudge = np.zeros(round((NUDGE_S + NUDGE_TAIL_S) * rate_hz))
    nudge[: round(NUDGE_S * rate_hz)] = NUDGE_LSB * rig.output.lsb_m * rig.output.volts_per_m
    while (at := tasks.count_generated() + lead) + nudge.size <= count:
        try:
            tasks.write(at, nudge)
            break
        except DaqError as error:
            first_error, tries = first_error or describe_error(error), tries + 1
            if tries % TRIES_PER_LEAD == 0:
                lead *= 2
    else:
        raise InputError(
            f"driver and device do not let queued output be replaced ({first_error}), so a stop "
            "would take effect too late",
            where=f"rig {rig.name}",
            remedy="use another output device",
        )
    if lead > required_lead:
        raise InputError(
            f"the device holds about {lead / rate_hz * 1e3:.0f} ms of output, which delays a stop",
            where=f"rig {rig.name}",
            key="ni.held_by_device_ms",
            value=wiring.held_by_device_ms,
            remedy="use a device that holds less, or enter the larger value in the rig file",
        )
    last = at + round((NUDGE_S + MAX_LOOPBACK_LAG_S) * rate_hz)
    volts = np.concatenate(
        [baseline, _read_chunks(tasks, last - baseline.shape[1], rate_hz)], axis=1
    )
    _verify_nudge(rig, volts, at, baseline.shape[1], nudge[: round(NUDGE_S * rate_hz)])


def _verify_nudge(
    rig: RigConfig, volts: Float2D, at: int, baseline_samples: int, nudge: Float1D
) -> None:
    """Raise InputError unless the command wired back shows `nudge`, V, at sample `at` or later.

    The converters delay it, by up to MAX_LOOPBACK_LAG_S; the loop check measures by how much.
    """
    row = rig.channels.index("drive_disp_m")
    command = volts_to_si(volts, rig.sensors, {})[row] * rig.output.volts_per_m
    # Lost samples count as no deviation.
    deviation_v = np.nan_to_num(command - np.nanmean(command[:baseline_samples]))
    means = np.convolve(deviation_v, np.full(nudge.size, 1.0 / nudge.size), "valid")[at - 1 :]
    share = float(means.max()) / nudge[0]
    if not MIN_LOOPBACK_SHARE <= share <= 1.0 / MIN_LOOPBACK_SHARE:
        raise InputError(
            f"a test pulse of {nudge[0] * 1e3:.2f} mV replaced queued output, but {share:.0%} of "
            "it was measured: the driver ignores the replacement, or the command is not wired back",
            where=f"rig {rig.name}: drive_disp_m",
            remedy="check the wire from the output to this input, or use another output device",
        )


def replace_after_samples(rig: RigConfig, rate_hz: float) -> int:
    """Return the number of samples after the newest taken one that cannot be replaced safely."""
    wiring = rig.require_section("ni", NiWiring)
    return wiring.device_buffer_samples(rate_hz) + round(WRITE_TRANSIT_S * rate_hz)


def verify_sample_rate(tasks: RigTasks, rate_hz: float) -> None:
    """Raise InputError if the device cannot sample at exactly `rate_hz`."""
    for actual_hz in tasks.rates_hz:
        if abs(actual_hz / rate_hz - 1.0) > MAX_RATE_ERROR:
            raise InputError(
                f"the device would sample at {actual_hz:.9g} Hz",
                key="acquisition.rate_hz",
                value=rate_hz,
                allowed="rates that the device can divide from its time base",
            )
