"""Simulated tables that `shaketwin table` serves behind the protocol of a backend.

A server registers under the name of its backend in the entry-point group `shaketwin.simulators`: a
function that serves a `TableService` until `keep_running()` is False and the table is at rest.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from table_io.block import Float1D
from table_io.clock import Clock
from table_io.config.backend import REINSTALL
from table_io.config.plugins import list_entry_points, load_entry_point
from table_io.config.profile import Specimen
from table_io.config.rig import RigConfig
from table_io.errors import InputError
from table_io.sim.machine.flight_recorder import FlightRecorder
from table_io.sim.machine.table import SimulatedMachine

SIMULATOR_GROUP = "shaketwin.simulators"


@dataclass(frozen=True, eq=False)
class PlaybackPlan:
    """Drive file in m for the controller, its rate, clock error in ppm and start delay in s."""

    values_m: Float1D
    rate_hz: float
    ppm: float = 0.0
    after_s: float = 5.0  # after a client starts to acquire


@dataclass(frozen=True, eq=False, kw_only=True)
class TableService:
    """What a server simulates, and its connection to the terminal."""

    rig: RigConfig
    specimen: Specimen  # on the table, unless the protocol transmits another
    clock: Clock
    notify: Callable[[str], None]  # prints a status line
    begin: Callable[[str], None]  # call it once, with the address, when ready to serve
    keep_running: Callable[[], bool]
    log: Path | None = None  # of the flight recorder
    plan: PlaybackPlan | None = None  # of the external controller; None: it stays at rest

    def open_recorder(self) -> FlightRecorder | None:
        """Return the flight recorder, None without a log; call it when the address is taken."""
        return FlightRecorder(self.log, self.notify) if self.log is not None else None

    def make_machine(self) -> SimulatedMachine:
        """Return the machine with its kernels compiled; call it when the address is taken."""
        machine = SimulatedMachine(self.rig, self.notify, self.open_recorder())
        machine.warm_up()
        return machine


def find_simulator(rig: RigConfig) -> Callable[[TableService], None]:
    """Return the server of a rig's backend; InputError if there is none."""
    simulator: Callable[[TableService], None] | None = load_entry_point(
        SIMULATOR_GROUP, rig.backend
    )
    if simulator is None:
        names = ", ".join(list_entry_points(SIMULATOR_GROUP))
        raise InputError(
            "there is no simulated table behind this backend",
            where=f"rig {rig.name}",
            key="backend",
            value=rig.backend,
            allowed=names or "none is installed",
            remedy="give another rig file, or --listen" if names else REINSTALL,
        )
    return simulator
