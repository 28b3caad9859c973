"""Start-up checks before anything moves: leftover tasks, rest, replacement of queued output."""

import contextlib
from collections.abc import Callable
from typing import Any

import numpy as np
from nidaqmx.errors import DaqError, Error

from table_io.backends.ni.config import NiWiring
from table_io.backends.ni.errors import describe_error
from table_io.backends.ni.tasks import BUFFER_S, HEARTBEAT_PERIOD_S, RigTasks, find_leftover_tasks
from table_io.block import Float1D, Float2D
from table_io.clock import Clock
from table_io.config.calibration import volts_to_si
from table_io.config.rig import RigConfig
from table_io.errors import InputError

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
