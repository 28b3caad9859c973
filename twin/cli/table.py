"""`shaketwin table`: serve a simulated machine as a separate process, as in a laboratory."""

import contextlib
import select
import signal
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TextIO

from table_io.backends.machine.endpoint import open_listener, parse_endpoint
from table_io.clock import RealClock
from table_io.config.base import find_config, load_config
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.errors import InputError
from table_io.sim.machine.flight_recorder import FlightRecorder
from table_io.sim.machine.table import SimulatedMachine
from twin.live.scheduling import request_realtime

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
    rig, _ = load_config(find_config(rig_name, "rigs"), RigConfig, "machine card")
    if not 1.0 <= time_scale <= MAX_TIME_SCALE:
        raise InputError(f"--time-scale {time_scale:g}: allowed: 1 to {MAX_TIME_SCALE:g}")

    def print_status(text: str) -> None:
        if _can_write(out):
            with contextlib.suppress(OSError):
                print(f"table {rig.name}: {text}", file=out, flush=True)

    if rig.backend in ("opendaq", "follow"):
        _serve_external(rig, profile, controller, log, RealClock(time_scale), print_status)
        return
    if controller.play is not None:
        raise InputError(f"--play: {rig.name!r} is driven by `run`; it belongs to a follow card")
    address, listener, serve = _open_listener(rig, listen, profile)
    with contextlib.closing(listener):
        box = FlightRecorder(log, print_status) if log is not None else None
        machine = SimulatedMachine(rig, print_status, box)
        machine.warm_up()
        signals = _collect_signals()
        pace = f", {time_scale:g} times as fast as the clock" if time_scale != 1.0 else ""
        scheduler = request_realtime(TABLE_PRIORITY)
        print_status(f"{rig.title}, at rest; waiting at {address} (scheduling: {scheduler}){pace}")
        serve(listener, machine, RealClock(time_scale), lambda: not signals)
        print_status("switched off at rest")


def _collect_signals() -> list[int]:
    """Return a list that collects SIGINT and SIGTERM, empty until the first."""
    signals: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: signals.append(number))
    return signals


def _serve_external(
    rig: RigConfig,
    profile: str,
    controller: ExternalController,
    log: Path | None,
    clock: RealClock,
    print_status: Callable[[str], None],
) -> None:
    """Serve the table of a followed rig, with the external controller that drives it."""
    from table_io.sim.opendaq import PlaybackPlan, serve_opendaq
    from twin.exchange.drive_file import read_drive

    if not controller.after_s >= MIN_START_DELAY_S:
        raise InputError(
            f"--after {controller.after_s:g}: allowed: {MIN_START_DELAY_S:g} s and more"
        )
    specimen = load_config(find_config(profile, "tests"), Profile, "test profile")[0].specimen
    drive = read_drive(controller.play) if controller.play is not None else None
    script = PlaybackPlan(*drive, controller.ppm, controller.after_s) if drive is not None else None
    box = FlightRecorder(log, print_status) if log is not None else None
    signals = _collect_signals()
    request_realtime(TABLE_PRIORITY)
    serve_opendaq(rig, specimen, script, box, clock, print_status, lambda: not signals)
    print_status("switched off at rest")


ServeFunction = Callable[[Any, SimulatedMachine, RealClock, Callable[[], bool]], None]


def _open_listener(
    rig: RigConfig, listen: str | None, profile: str
) -> tuple[str, Any, ServeFunction]:
    """Open the listener of a machine; return (address, listener, serve function)."""
    if listen is None and rig.backend == "udp" and rig.udp is not None:
        from table_io.sim.udp.server import bind_socket, serve_udp_target

        return rig.udp.target, bind_socket(rig.udp.address), serve_udp_target
    if listen is None and rig.backend == "ni" and rig.ni is not None:
        from table_io.sim.ni.server import ServerEndpoint, serve_ni_device

        specimen = load_config(find_config(profile, "tests"), Profile, "test profile")[0].specimen
        return rig.ni.endpoint, ServerEndpoint(rig.ni), partial(serve_ni_device, specimen)
    from table_io.sim.machine.server import serve_machine

    if listen is None and rig.machine is None:
        raise InputError(f"rig {rig.name}: no [machine] table with an endpoint; add it or --listen")
    address = parse_endpoint(listen or (rig.machine.endpoint if rig.machine else ""))
    return address.text, open_listener(address), serve_machine


def _can_write(out: TextIO) -> bool:
    """Return True if output would not block: a paused terminal must not stop the machine."""
    try:
        return bool(select.select([], [out], [], 0.0)[1])
    except (OSError, ValueError):
        return True  # not a system file: writing cannot block
