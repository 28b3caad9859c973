"""Backend for NI-DAQmx devices, on the local driver or through NI's gRPC Device Server."""

from collections.abc import Collection
from functools import partial

from table_io.backends import (
    Backend,
    BackendDescriptor,
    DeviceSearch,
    DigitalInputs,
    DiscoveredDevice,
)
from table_io.backends.ni.config import NiWiring
from table_io.clock import Clock
from table_io.config.profile import Specimen
from table_io.config.rig import RigConfig
from table_io.errors import InputError, format_pip_line


def _require_library() -> None:
    """Raise InputError if NI's client library is not installed."""
    try:
        import grpc  # noqa: F401
        import nidaqmx  # noqa: F401
    except ImportError as error:
        raise InputError(
            f"NI's client library is not installed ({error})",
            key="backend",
            value="ni",
            remedy=format_pip_line("ni"),
        ) from None


def _open(rig: RigConfig, specimen: Specimen, rate_hz: float, clock: Clock) -> Backend:
    _require_library()
    from table_io.backends.ni.backend import NiBackend

    return NiBackend(rig, specimen, rate_hz, clock)


def _check_reachable(rig: RigConfig) -> None:
    _require_library()
    from table_io.backends.ni.driver import check_reachable

    check_reachable(rig)


def _open_digital_inputs(rig: RigConfig) -> DigitalInputs | None:
    """Open the lines of the rig file, None if it has none; InputError if unreadable."""
    wiring = rig.get_section(NiWiring)
    if wiring is None or not wiring.digital_inputs:
        return None
    _require_library()
    from table_io.backends.ni.driver import NiDigitalInputs

    return NiDigitalInputs(wiring)


def _discover(server: str | None) -> tuple[DiscoveredDevice, ...]:
    _require_library()
    from table_io.backends.ni.driver import discover_devices

    return discover_devices(server)


def _list_searches(servers: Collection[str]) -> dict[str, DeviceSearch]:
    return {
        "NI, local driver": partial(_discover, None),
        **{f"NI, server {server}": partial(_discover, server) for server in servers},
    }


BACKEND = BackendDescriptor(
    config=NiWiring,
    open=_open,
    check_reachable=_check_reachable,
    open_digital_inputs=_open_digital_inputs,
    list_searches=_list_searches,
)
