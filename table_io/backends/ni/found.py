"""NI-DAQmx devices of the local driver, or of a gRPC Device Server, and what they have."""

import contextlib
from collections.abc import Iterable
from typing import Any, Literal

from table_io.backends.device import Device, Ports
from table_io.card import BadInput

REACHED_S = 2.0  # in which a server must let itself be reached
NOTHING = "0"  # a name of a session that is never made
KINDS: tuple[tuple[Literal["AI", "AO", "DI", "DO"], str, str, str], ...] = (
    ("AI", "ai_physical_chans", "ai_voltage_rngs", "ai_max_single_chan_rate"),
    ("AO", "ao_physical_chans", "ao_voltage_rngs", "ao_max_rate"),
    ("DI", "di_lines", "", ""),
    ("DO", "do_lines", "", ""),
)


def found(server: str | None) -> tuple[Device, ...]:
    """Every device of `server`, HOST:PORT, or of the local driver; BadInput says why none."""
    try:
        import grpc
        from nidaqmx import GrpcSessionOptions
        from nidaqmx.errors import Error
        from nidaqmx.system import System
    except ImportError as error:
        raise BadInput(
            f"NI's library is not installed ({error}); pip install shaketwin[ni]"
        ) from None
    if server is None:
        try:
            return tuple(_device(one, "local driver") for one in System.local().devices)
        except Error as error:
            raise BadInput(_first(error)) from None
    from table_io.backends.ni.channel import channel_to

    with contextlib.closing(channel_to(server)) as channel:
        try:
            grpc.channel_ready_future(channel).result(REACHED_S)
            system = System.remote(GrpcSessionOptions(channel, NOTHING))
            return tuple(_device(one, server) for one in system.devices)
        except grpc.FutureTimeoutError:
            raise BadInput(
                f"no gRPC Device Server answers at {server}; start it there, and see that its "
                "address and port are these"
            ) from None
        except Error as error:
            raise BadInput(f"{server} does not tell its devices: {_first(error)}") from None


def _device(device: Any, where: str) -> Device:
    """A device of the driver's own kind, as a plain value."""
    ports = []
    for kind, channels, ranges, rate in KINDS:
        names = tuple(str(one.name) for one in _told(device, channels) or ())
        if names:
            flat = [float(volts) for volts in _told(device, ranges) or ()]
            pairs = tuple(zip(flat[::2], flat[1::2], strict=True))
            ports.append(Ports(kind, names, pairs, _told(device, rate)))
    serial = _told(device, "serial_num")
    return Device(
        "ni",
        str(device.name),
        where,
        str(_told(device, "product_type") or ""),
        f"{serial:X}" if serial else "",  # as it is printed on the device
        bool(_told(device, "is_simulated")),
        tuple(ports),
    )


def _told(device: Any, name: str) -> Any:
    """What a device says of itself; None where it has no such thing."""
    from nidaqmx.errors import Error

    try:
        value = getattr(device, name) if name else None
        return list(value) if isinstance(value, Iterable) and not isinstance(value, str) else value
    except Error:
        return None


def _first(error: Exception) -> str:
    """The driver's words in one line."""
    return next(iter(str(error).strip().splitlines()), type(error).__name__)
