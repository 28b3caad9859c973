"""Result of device discovery, in the same form for every vendor.

A `DeviceSearch` returns a tuple of `DiscoveredDevice`. It raises InputError if it cannot search: a
library is not installed (the message has the pip line) or a server does not answer.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, slots=True)
class ChannelGroup:
    """Channels of one kind on a device, with ranges in V and the highest sample rate in Hz."""

    kind: Literal["AI", "AO", "DI", "DO"]
    names: tuple[str, ...]  # as written in the rig file
    ranges_v: tuple[tuple[float, float], ...] = ()  # (low, high) in V; empty: unknown
    most_hz: float | None = None  # highest sample rate of one channel


@dataclass(frozen=True, slots=True)
class DiscoveredDevice:
    """One device that answered, and its channels."""

    kind: str  # name of its backend
    name: str  # as written in the rig file: Dev1, daq.nd://...
    where: str  # address of its server, or "local driver"
    product: str = ""
    serial: str = ""
    simulated: bool = False
    ports: tuple[ChannelGroup, ...] = ()


DeviceSearch = Callable[[], tuple[DiscoveredDevice, ...]]
