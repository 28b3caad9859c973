"""A target that speaks our UDP packets: dSPACE, Speedgoat, LabVIEW-RT, a PLC. See PACKETS.md.

rig: backend.py, link.py, transfer.py  <-- packets.py, over UDP -->  target.py, serve.py; target.c
"""

from table_io.backends.udp.backend import UdpBackend
from table_io.backends.udp.link import answers

__all__ = ["UdpBackend", "answers"]
