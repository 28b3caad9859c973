"""Backend `simulated`: the simulated table in the process of the rig."""

from table_io.backends import Backend, BackendDescriptor
from table_io.clock import Clock
from table_io.config.profile import Specimen
from table_io.config.rig import RigConfig
from table_io.sim.config import SimulatedTableConfig


def _open(rig: RigConfig, specimen: Specimen, rate_hz: float, clock: Clock) -> Backend:
    from table_io.sim.simulated_table import SimulatedBackend

    return SimulatedBackend(rig, specimen, rate_hz, clock)


BACKEND = BackendDescriptor(
    config=SimulatedTableConfig, open=_open, any_speed=True, is_simulated=True
)
