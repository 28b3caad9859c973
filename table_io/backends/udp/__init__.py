"""Backend for a real-time target over UDP: dSPACE, Speedgoat, LabVIEW-RT, a PLC. See PACKETS.md.

Rig side: backend.py. Packets and socket: packets.py. Target side: target.c, and the
simulated target in table_io/sim/udp.
"""

from table_io.backends import Backend, BackendDescriptor
from table_io.backends.udp.backend import UdpBackend
from table_io.backends.udp.packets import UdpWiring, check_reachable
from table_io.clock import Clock
from table_io.config.profile import Specimen
from table_io.config.rig import RigConfig


def _open(rig: RigConfig, specimen: Specimen, rate_hz: float, clock: Clock) -> Backend:
    return UdpBackend(rig, specimen, rate_hz, clock)


BACKEND = BackendDescriptor(config=UdpWiring, open=_open, check_reachable=check_reachable)
