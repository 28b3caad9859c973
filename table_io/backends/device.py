"""What a search for hardware finds: small plain values, whoever made the device.

`found(...)` in table_io/backends/{ni,opendaq}/found.py returns a tuple of these. BadInput says what
keeps it from looking: a library that is missing (with the pip line), a server that does not answer.
"""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, slots=True)
class Ports:
    """Channels of one kind on a device, and what they can do."""

    kind: Literal["AI", "AO", "DI", "DO"]
    names: tuple[str, ...]  # as the machine card would name them
    ranges_v: tuple[tuple[float, float], ...] = ()  # (low, high) in V; empty: not stated
    most_hz: float | None = None  # highest sample rate of one channel


@dataclass(frozen=True, slots=True)
class Device:
    """One device that answers."""

    kind: Literal["ni", "opendaq", "udp"]
    name: str  # as the machine card would name it: Dev1, daq.nd://...
    where: str  # the address of the server that has it, or "local driver"
    product: str = ""
    serial: str = ""
    simulated: bool = False
    ports: tuple[Ports, ...] = ()
