"""Acquisition from an openDAQ device by its native streaming."""

import socket

from table_io.backends.opendaq.source import OpenDaqSource, require_opendaq_wiring
from table_io.config.rig import RigConfig
from table_io.errors import InputError

__all__ = ["OpenDaqSource", "check_reachable"]

CONNECT_TIMEOUT_S = 2.0


def check_reachable(rig: RigConfig) -> None:
    """Raise InputError if the device does not answer or the library is not installed."""
    wiring = require_opendaq_wiring(rig)
    try:
        socket.create_connection(wiring.address, CONNECT_TIMEOUT_S).close()
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or error
        hint = f"for a simulated one: shaketwin table --rig {rig.name}" if rig.simulated else ""
        raise InputError(
            f"no openDAQ device answers at {wiring.device} ({reason})",
            remedy="switch it on, or correct opendaq.device in the rig file"
            f"{'; ' if hint else ''}{hint}",
        ) from None
