"""Acquisition from an openDAQ device by its native streaming."""

from collections.abc import Collection

from table_io.backends import AcquisitionSource, BackendDescriptor, DeviceSearch, DiscoveredDevice
from table_io.backends.opendaq.config import OpenDaqWiring
from table_io.clock import Clock
from table_io.config.rig import RigConfig


def _open_source(rig: RigConfig, rate_hz: float, clock: Clock) -> AcquisitionSource:
    from table_io.backends.opendaq.source import OpenDaqSource

    return OpenDaqSource(rig, rate_hz, clock)


def _check_reachable(rig: RigConfig) -> None:
    from table_io.backends.opendaq.source import check_reachable

    check_reachable(rig)


def _list_searches(addresses: Collection[str]) -> dict[str, DeviceSearch]:
    def search() -> tuple[DiscoveredDevice, ...]:
        from table_io.backends.opendaq.source import discover_devices

        return discover_devices(tuple(addresses))

    return {"openDAQ": search}


BACKEND = BackendDescriptor(
    config=OpenDaqWiring,
    open_source=_open_source,
    check_reachable=_check_reachable,
    list_searches=_list_searches,
)
