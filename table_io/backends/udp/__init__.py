"""Backend for a real-time target over UDP: dSPACE, Speedgoat, LabVIEW-RT, a PLC. See PACKETS.md.

Rig side: backend.py, link.py, transfer.py. Packets: packets.py. Target side: target.c, and the
simulated target in table_io/sim/udp.
"""

from table_io.backends.udp.backend import UdpBackend
from table_io.backends.udp.link import check_reachable

__all__ = ["UdpBackend", "check_reachable"]
