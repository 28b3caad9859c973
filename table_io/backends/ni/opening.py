"""What is looked at before anything moves: old tasks, rest, and whether output can be replaced."""

import contextlib
from collections.abc import Callable
from typing import Any

import numpy as np
from nidaqmx.errors import DaqError, Error

from table_io.backends.ni.codes import said
from table_io.backends.ni.tasks import BEAT_S, BUFFER_S, Tasks, left_over
from table_io.block import Float1D, Float2D
from table_io.calibration import to_si
from table_io.card import BadInput
from table_io.clock import Clock
from table_io.rig import Rig

LOOK_S = 0.25  # of the inputs
RESTING_S = 30.0  # until the table must be at rest
REST_SHARE = 1e-3  # of the command's span: so far from 0 V it may stand
STILL_SHARE = 4e-3  # of a sensor's range: so much the table may seem to move
REHEARSED_S = 0.2
HANDED_S = 0.01  # that a write may be on its way
RATE_SHARE = 1e-6
NUDGE_LSB, NUDGE_S = 8, 0.02  # of the output: a test of a replacement, below REST_SHARE
LAG_S = 0.1  # that it may come back later
AFTER_S = 1.0  # of zeros behind it
LEAST_SHOWN = 0.5  # of it
SETTLED_S = 0.5  # after it
TRIES = 20  # on a computer that was busy just then


def cleared(rig: Rig, channel: Any, clock: Clock) -> None:
    """Wait until what a rig that is gone has left in the server has been played; forget it."""
    tasks = left_over(rig, channel)
    output = tasks.get("output")
    with contextlib.suppress(DaqError):  # it has ended: its buffer ran out, or it was never started
        if output is not None:
            until = clock.now() + BUFFER_S + LOOK_S  # by then a rig that is gone has nothing left
            while not output.is_task_done():
                if clock.now() > until:
                    raise BadInput(
                        f"rig {rig.name}: another rig drives this device just now; end it first"
                    )
                clock.wait_until(clock.now() + LOOK_S)
    for task in tasks.values():
        with contextlib.suppress(Error):
            task.close()


def at_rest(rig: Rig, tasks: Tasks, rate_hz: float, clock: Clock) -> None:
    """BadInput where the command does not stand at 0 V, or the table moves, for too long.

    The output will begin at 0 V: from anywhere else that would be a step.
    """
    until = clock.now() + RESTING_S
    command, place = (rig.channels.index(name) for name in ("drive_disp_m", "table_disp_m"))
    while True:
        volts = look(tasks, round(LOOK_S * rate_hz), rate_hz)
        values = to_si(volts, rig.sensors, {})
        off_m = float(values[command].mean())
        moves = float(np.ptp(values[place]))
        stands = abs(off_m) <= REST_SHARE * rig.output.span_mm * 1e-3
        if stands and moves <= STILL_SHARE * rig.sensors[place].range_si:
            return
        if clock.now() > until:
            break
        clock.wait_until(clock.now() + LOOK_S)
    if not stands:
        raise BadInput(
            f"rig {rig.name}: the command stands at {off_m * 1e3:.3f} mm "
            f"({off_m * rig.output.volts_per_m:.3f} V), not at 0: starting would be a step. Bring "
            "the table to its mean with its own controller; is the command wired back?"
        )
    raise BadInput(
        f"rig {rig.name}: the table still moves by {moves * 1e3:.2f} mm after {RESTING_S:g} s; "
        "bring it to rest first"
    )


def look(
    tasks: Tasks, samples: int, rate_hz: float, between: Callable[[], None] = lambda: None
) -> Float2D:
    """Samples of the inputs while nothing moves, (channel, sample); `between` their pieces."""
    tasks.input.start()
    try:
        return _taken(tasks, samples, rate_hz, between)
    finally:
        tasks.input.stop()


def _taken(
    tasks: Tasks, samples: int, rate_hz: float, between: Callable[[], None] = lambda: None
) -> Float2D:
    """The next samples, in pieces each of which comes long before a read loses patience."""
    piece = max(round(BEAT_S / 2 * rate_hz), 1)
    come = [np.empty((tasks.width, 0))]
    for at in range(0, samples, piece):
        between()
        come.append(tasks.read(min(piece, samples - at)))
    return np.concatenate(come, axis=1)


def rehearsed(rig: Rig, tasks: Tasks, rate_hz: float) -> None:
    """Play zeros, and replace them by NUDGE_LSB steps of the output for NUDGE_S.

    BadInput where the device holds more than it should, or what is wired back does not show them.
    Afterwards the tasks are used up.
    """
    assert rig.ni is not None
    margin = replaceable(rig, rate_hz)
    count = round((REHEARSED_S + BUFFER_S / 4) * rate_hz)
    tasks.write(0, np.zeros(count))
    tasks.output.start()
    tasks.input.start()
    before = _taken(tasks, max(round(REHEARSED_S * rate_hz), 1), rate_hz)
    ahead, refused, tries = margin, "", 0
    nudge = np.zeros(round((NUDGE_S + AFTER_S) * rate_hz))
    nudge[: round(NUDGE_S * rate_hz)] = NUDGE_LSB * rig.output.lsb_m * rig.output.volts_per_m
    while (at := tasks.generated() + ahead) + nudge.size <= count:
        try:
            tasks.write(at, nudge)
            break
        except DaqError as error:
            refused, tries = refused or said(error), tries + 1
            if tries % TRIES == 0:
                ahead *= 2
    else:
        raise BadInput(
            f"rig {rig.name}: driver and device do not let queued output be replaced ({refused}), "
            "so a stop would come too late; use another output device"
        )
    if ahead > margin:
        raise BadInput(
            f"rig {rig.name}: the device holds about {ahead / rate_hz * 1e3:.0f} ms of output, the "
            f"card says ni.held_by_device_ms = {rig.ni.held_by_device_ms:g}; a stop comes later by "
            "what it holds: use a device that holds less, or say so in the card"
        )
    until = at + round((NUDGE_S + LAG_S) * rate_hz)
    seen = np.concatenate([before, _taken(tasks, until - before.shape[1], rate_hz)], axis=1)
    _shown(rig, seen, at, before.shape[1], nudge[: round(NUDGE_S * rate_hz)])


def _shown(rig: Rig, volts: Float2D, at: int, still: int, nudge: Float1D) -> None:
    """BadInput where the command wired back does not show `nudge` from sample `at` on, or later.

    Later: by what converters delay. How much that is, the loop check finds.
    """
    row = rig.channels.index("drive_disp_m")
    command = to_si(volts, rig.sensors, {})[row] * rig.output.volts_per_m
    off = np.nan_to_num(command - np.nanmean(command[:still]))  # a lost sample shows nothing
    means = np.convolve(off, np.full(nudge.size, 1.0 / nudge.size), "valid")[at - 1 :]
    share = float(means.max()) / nudge[0]
    if not LEAST_SHOWN <= share <= 1.0 / LEAST_SHOWN:
        raise BadInput(
            f"rig {rig.name}: queued output was replaced by {nudge[0] * 1e3:.2f} mV, and of that "
            f"{share:.0%} came back in drive_disp_m: the driver takes what replaces and plays what "
            "was there, or the command is not wired back; use another output device, or mend it"
        )


def replaceable(rig: Rig, rate_hz: float) -> int:
    """Samples from the newest one taken to the first that can be replaced for certain."""
    assert rig.ni is not None
    return rig.ni.held(rate_hz) + round(HANDED_S * rate_hz)


def sampled(tasks: Tasks, rate_hz: float) -> None:
    """BadInput where the device cannot sample at this very rate."""
    for real_hz in tasks.rates_hz:
        if abs(real_hz / rate_hz - 1.0) > RATE_SHARE:
            raise BadInput(
                f"acquisition.rate_hz = {rate_hz:g}: the device would sample at {real_hz:.9g} Hz; "
                "give a rate that it can divide from its time base"
            )
