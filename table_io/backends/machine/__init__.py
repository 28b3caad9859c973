"""Backend for a simulated machine in a separate process (`shaketwin table`)."""

from table_io.backends import Backend, BackendDescriptor
from table_io.backends.machine.client import MachineBackend, check_reachable
from table_io.backends.machine.protocol import MachineConfig
from table_io.clock import Clock
from table_io.config.profile import Specimen
from table_io.config.rig import RigConfig


def _open(rig: RigConfig, specimen: Specimen, rate_hz: float, clock: Clock) -> Backend:
    return MachineBackend(rig, specimen, rate_hz, clock)


def _check_reachable(rig: RigConfig) -> None:
    check_reachable(rig)


BACKEND = BackendDescriptor(config=MachineConfig, open=_open, check_reachable=_check_reachable)
