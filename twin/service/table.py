"""`shaketwin table`: the simulated machine as a process of its own, as a laboratory has one."""

import contextlib
import select
import signal
from pathlib import Path
from typing import TextIO

from table_io.card import BadInput, find, load
from table_io.clock import RealClock
from table_io.machine.blackbox import BlackBox
from table_io.machine.endpoint import endpoint, listening
from table_io.machine.server import serve
from table_io.machine.table import Table
from table_io.rig import Rig
from twin.service.scheduling import urgent

PRIORITY = 60  # above the rig: the machine plays whatever the rig does
FASTEST = 20.0


def table(
    rig_name: str, listen: str | None, log: Path | None, time_scale: float, out: TextIO
) -> None:
    """Be the machine of a card until told to end; it ends at rest."""
    rig, _ = load(find(rig_name, "rigs"), Rig, "machine card")
    if not 1.0 <= time_scale <= FASTEST:
        raise BadInput(f"--time-scale {time_scale:g}: allowed: 1 to {FASTEST:g}")
    if listen is None and rig.machine is None:
        raise BadInput(f"rig {rig.name}: no [machine] table with an endpoint; add it or --listen")
    where = endpoint(listen or (rig.machine.endpoint if rig.machine else ""))

    def tell(text: str) -> None:
        if _free(out):
            with contextlib.suppress(OSError):
                print(f"table {rig.name}: {text}", file=out, flush=True)

    with contextlib.closing(listening(where)) as listener:
        box = BlackBox(log, tell) if log is not None else None
        machine = Table(rig, tell, box)
        machine.prepare()
        asked: list[int] = []
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda number, _: asked.append(number))
        pace = f", {time_scale:g} times as fast as the clock" if time_scale != 1.0 else ""
        scheduler = urgent(PRIORITY)
        tell(f"{rig.title}, at rest; waiting at {where.text} (scheduling: {scheduler}){pace}")
        serve(listener, machine, RealClock(time_scale), lambda: not asked)
        tell("switched off at rest")


def _free(out: TextIO) -> bool:
    """True where a line can be shown at once: a terminal that is held must not hold the machine."""
    try:
        return bool(select.select([], [out], [], 0.0)[1])
    except (OSError, ValueError):
        return True  # no file of the system's: nothing to wait for
