"""Discovery of NI-DAQmx devices at the local driver or a gRPC Device Server."""

import contextlib
from collections.abc import Iterable
from typing import Any, Literal

from table_io.backends.discovery import ChannelGroup, DiscoveredDevice
from table_io.errors import InputError, format_pip_line

CONNECT_TIMEOUT_S = 1.5
UNUSED_SESSION = "0"  # required by the client; no session of this name is created
CHANNEL_KINDS: tuple[tuple[Literal["AI", "AO", "DI", "DO"], str, str, str], ...] = (
    ("AI", "ai_physical_chans", "ai_voltage_rngs", "ai_max_single_chan_rate"),
    ("AO", "ao_physical_chans", "ao_voltage_rngs", "ao_max_rate"),
    ("DI", "di_lines", "", ""),
    ("DO", "do_lines", "", ""),
)


def discover_devices(server: str | None) -> tuple[DiscoveredDevice, ...]:
    """Return the devices at `server`, HOST:PORT, or the local driver; InputError if unreachable."""
    try:
        import grpc
        from nidaqmx import GrpcSessionOptions
        from nidaqmx.errors import Error
        from nidaqmx.system import System
    except ImportError as error:
        raise InputError(
            f"NI's client library is not installed ({error})", remedy=format_pip_line("ni")
        ) from None
    if server is None:
        try:
            return tuple(_device(device, "local driver") for device in System.local().devices)
        except Error as error:
            raise InputError(_first_line(error)) from None
    from table_io.backends.ni.channel import open_channel

    with contextlib.closing(open_channel(server)) as channel:
        try:
            grpc.channel_ready_future(channel).result(CONNECT_TIMEOUT_S)
            system = System.remote(GrpcSessionOptions(channel, UNUSED_SESSION))
            return tuple(_device(device, server) for device in system.devices)
        except grpc.FutureTimeoutError:
            raise InputError(
                "no gRPC Device Server answers there",
                where=server,
                remedy="start it there, and check that it listens at this address and port",
            ) from None
        except Error as error:
            raise InputError(
                f"cannot list its devices: {_first_line(error)}", where=server
            ) from None


def _device(device: Any, where: str) -> DiscoveredDevice:
    """Convert a device of the NI client."""
    ports = []
    for kind, channels, ranges, rate in CHANNEL_KINDS:
        names = tuple(str(channel.name) for channel in _read_attribute(device, channels) or ())
        if names:
            flat = [float(volts) for volts in _read_attribute(device, ranges) or ()]
            pairs = tuple(zip(flat[::2], flat[1::2], strict=True))
            ports.append(ChannelGroup(kind, names, pairs, _read_attribute(device, rate)))
    serial = _read_attribute(device, "serial_num")
    return DiscoveredDevice(
        "ni",
        str(device.name),
        where,
        str(_read_attribute(device, "product_type") or ""),
        f"{serial:X}" if serial else "",  # hexadecimal, as printed on the device
        bool(_read_attribute(device, "is_simulated")),
        tuple(ports),
    )


def _read_attribute(device: Any, name: str) -> Any:
    """Read an attribute of a device; None if the device does not have it."""
    from nidaqmx.errors import Error

    try:
        value = getattr(device, name) if name else None
        return list(value) if isinstance(value, Iterable) and not isinstance(value, str) else value
    except Error:
        return None


def _first_line(error: Exception) -> str:
    """Return the first line of the driver's message."""
    return next(iter(str(error).strip().splitlines()), type(error).__name__)
