"""`shaketwin table`: the simulated machine as a process of its own, as a laboratory has one."""

import contextlib
import select
import signal
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TextIO

from table_io.card import BadInput, find, load
from table_io.clock import RealClock
from table_io.machine.blackbox import BlackBox
from table_io.machine.endpoint import endpoint, listening
from table_io.machine.table import Table
from table_io.profile import Profile
from table_io.rig import Rig
from twin.service.scheduling import urgent

PRIORITY = 60  # above the rig: the machine plays whatever the rig does
FASTEST = 20.0
SOONEST_S = 0.5  # that a controller may begin: what is taken earlier is in the plant already


@dataclass(frozen=True, slots=True)
class Vendor:
    """A controller of its own, on a table that is only followed: what it plays, and when."""

    play: Path | None = None
    ppm: float = 0.0
    after_s: float = 5.0


OFF = Vendor()


def table(
    rig_name: str,
    listen: str | None,
    log: Path | None,
    time_scale: float,
    out: TextIO,
    profile: str = "quickstart",
    vendor: Vendor = OFF,
) -> None:
    """Be the machine of a card until told to end; it ends at rest.

    Where a controller cannot say what stands on the table, it is the specimen of `profile`.
    """
    rig, _ = load(find(rig_name, "rigs"), Rig, "machine card")
    if not 1.0 <= time_scale <= FASTEST:
        raise BadInput(f"--time-scale {time_scale:g}: allowed: 1 to {FASTEST:g}")

    def tell(text: str) -> None:
        if _free(out):
            with contextlib.suppress(OSError):
                print(f"table {rig.name}: {text}", file=out, flush=True)

    if rig.backend in ("opendaq", "follow"):
        _beside(rig, profile, vendor, log, RealClock(time_scale), tell)
        return
    if vendor.play is not None:
        raise BadInput(f"--play: {rig.name!r} is driven by `run`; it belongs to a follow card")
    where, listener, serve = _far_side(rig, listen, profile)
    with contextlib.closing(listener):
        box = BlackBox(log, tell) if log is not None else None
        machine = Table(rig, tell, box)
        machine.prepare()
        asked = _switched_off()
        pace = f", {time_scale:g} times as fast as the clock" if time_scale != 1.0 else ""
        scheduler = urgent(PRIORITY)
        tell(f"{rig.title}, at rest; waiting at {where} (scheduling: {scheduler}){pace}")
        serve(listener, machine, RealClock(time_scale), lambda: not asked)
        tell("switched off at rest")


def _switched_off() -> list[int]:
    """What is no longer empty once a person has ended this process."""
    asked: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: asked.append(number))
    return asked


def _beside(
    rig: Rig,
    profile: str,
    vendor: Vendor,
    log: Path | None,
    clock: RealClock,
    tell: Callable[[str], None],
) -> None:
    """Be the table of a card that is only followed, and the controller that plays on it."""
    from table_io.backends.opendaq.device import Script, serve
    from twin.service.drive_file import read_drive

    if not vendor.after_s >= SOONEST_S:
        raise BadInput(f"--after {vendor.after_s:g}: allowed: {SOONEST_S:g} s and more")
    specimen = load(find(profile, "tests"), Profile, "test profile")[0].specimen
    file = read_drive(vendor.play) if vendor.play is not None else None
    script = Script(*file, vendor.ppm, vendor.after_s) if file is not None else None
    box = BlackBox(log, tell) if log is not None else None
    asked = _switched_off()
    urgent(PRIORITY)
    serve(rig, specimen, script, box, clock, tell, lambda: not asked)
    tell("switched off at rest")


Serve = Callable[[Any, Table, RealClock, Callable[[], bool]], None]


def _far_side(rig: Rig, listen: str | None, profile: str) -> tuple[str, Any, Serve]:
    """(where it is reached, what is heard there and closed at the end, how it is served)."""
    if listen is None and rig.backend == "udp" and rig.udp is not None:
        from table_io.backends.udp.serve import bound, serve

        return rig.udp.target, bound(rig.udp.address), serve
    if listen is None and rig.backend == "ni" and rig.ni is not None:
        from table_io.backends.ni.server import Door
        from table_io.backends.ni.server import serve as serve_ni

        specimen = load(find(profile, "tests"), Profile, "test profile")[0].specimen
        return rig.ni.endpoint, Door(rig.ni), partial(serve_ni, specimen)
    from table_io.machine.server import serve as serve_machine

    if listen is None and rig.machine is None:
        raise BadInput(f"rig {rig.name}: no [machine] table with an endpoint; add it or --listen")
    where = endpoint(listen or (rig.machine.endpoint if rig.machine else ""))
    return where.text, listening(where), serve_machine


def _free(out: TextIO) -> bool:
    """True where a line can be shown at once: a terminal that is held must not hold the machine."""
    try:
        return bool(select.select([], [out], [], 0.0)[1])
    except (OSError, ValueError):
        return True  # no file of the system's: nothing to wait for
