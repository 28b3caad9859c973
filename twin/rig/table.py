"""`shaketwin table`: serve a simulated machine as a separate process, as in a laboratory."""

import contextlib
import select
import signal
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TextIO

from table_io.backends import find_descriptor
from table_io.clock import RealClock
from table_io.config.folders import find_config
from table_io.config.profile import load_profile
from table_io.config.rig_file import load_rig
from table_io.errors import InputError
from table_io.sim.machine.server import serve_machine_table
from table_io.sim.machine.table import PlaybackPlan, TableService, find_simulator, read_drive
from twin.live.process_config import request_realtime

TABLE_PRIORITY = 60  # above the rig: a real machine does not depend on its load
MAX_TIME_SCALE = 20.0
# The plant has been computed up to here before a controller can begin.
MIN_START_DELAY_S = 0.5


@dataclass(frozen=True, slots=True)
class ExternalController:
    """External controller of a followed table: drive file, clock error in ppm, start delay in s."""

    play: Path | None = None
    ppm: float = 0.0
    after_s: float = 5.0


NO_CONTROLLER = ExternalController()


def serve_table(
    rig_name: str,
    listen: str | None,
    log: Path | None,
    time_scale: float,
    out: TextIO,
    profile: str = "quickstart",
    controller: ExternalController = NO_CONTROLLER,
) -> None:
    """Serve the simulated machine of a rig until SIGINT or SIGTERM; it ends at rest.

    The specimen is that of `profile` if the machine's protocol does not transmit it.
    """
    rig, _ = load_rig(find_config(rig_name, "rigs", option="--table"))
    if not 1.0 <= time_scale <= MAX_TIME_SCALE:
        raise InputError(
            "out of range",
            where=f"--time-scale {time_scale:g}",
            allowed=f"1 to {MAX_TIME_SCALE:g}",
        )
    drives = find_descriptor(rig).drives
    if drives and controller.play is not None:
        raise InputError(
            f"the table {rig.name!r} is driven by `run`, not by an external controller",
            where=f"--play {controller.play}",
            remedy="omit it, or give a rig file with backend = 'follow'",
        )
    if listen is not None and drives:
        serve: Callable[[TableService], None] = partial(serve_machine_table, listen=listen)
    else:
        serve = find_simulator(rig)
    signals: list[int] = []

    def print_status(text: str) -> None:
        if _can_write(out):
            with contextlib.suppress(OSError):
                print(f"table {rig.name}: {text}", file=out, flush=True)

    def begin(address: str) -> None:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda number, _: signals.append(number))
        pace = f", {time_scale:g} times as fast as the clock" if time_scale != 1.0 else ""
        scheduler = request_realtime(TABLE_PRIORITY)
        print_status(f"{rig.title}, at rest; waiting at {address} (scheduling: {scheduler}){pace}")

    service = TableService(
        rig=rig,
        specimen=load_profile(find_config(profile, "tests"))[0].specimen,
        clock=RealClock(time_scale),
        notify=print_status,
        begin=begin,
        keep_running=lambda: not signals,
        log=log,
        plan=None if drives else _plan_playback(controller),
    )
    serve(service)
    print_status("switched off at rest")


def _plan_playback(controller: ExternalController) -> PlaybackPlan | None:
    """Return what an external controller plays; None if it stays at rest."""
    if not controller.after_s >= MIN_START_DELAY_S:
        raise InputError(
            "too early",
            where=f"--after {controller.after_s:g}",
            allowed=f"{MIN_START_DELAY_S:g} s and more",
        )
    if controller.play is None:
        return None
    return PlaybackPlan(*read_drive(controller.play), controller.ppm, controller.after_s)


def _can_write(out: TextIO) -> bool:
    """Return True if output would not block: a paused terminal must not stop the machine."""
    try:
        return bool(select.select([], [out], [], 0.0)[1])
    except (OSError, ValueError):
        return True  # not a system file: writing cannot block
