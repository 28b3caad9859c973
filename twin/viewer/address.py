"""Address of a live view, on loopback only. Does not import rerun, which is slow."""

import socket

from table_io.errors import InputError

VIEW_ADDRESS = "127.0.0.1:9876"
MAX_PORTS = 100


def parse_address(address: str) -> tuple[str, int]:
    """Return (host, port) of "127.0.0.1:PORT"; raise InputError if not loopback or port in use."""
    host, _, port = address.rpartition(":")
    if host != "127.0.0.1" or not port.isdigit() or not 0 < int(port) < 65536:
        raise InputError(
            "not a valid loopback address",
            key="view address",
            value=address,
            allowed="127.0.0.1:PORT (this computer only)",
        )
    if not _is_free(host, int(port)):
        raise InputError(
            "the port is in use", key="view address", value=address, remedy="choose another port"
        )
    return host, int(port)


def find_free_address(address: str) -> str:
    """Return the address with its port, or with the next free port if that one is in use."""
    host, _, first = address.rpartition(":")
    last = min(int(first) + MAX_PORTS, 65536)
    for port in range(int(first), last):
        if _is_free(host, port):
            return f"{host}:{port}"
    raise InputError(
        f"ports {first} to {last - 1} are all in use",
        where="live view",
        remedy="stop programs that use them",
    )


def viewer_url(address: str) -> str:
    """Return the URL that a viewer opens."""
    return f"rerun+http://{address}/proxy"


def format_live_view(address: str) -> str:
    """Format the message that announces a live view and how to open it."""
    note = (
        "" if address == VIEW_ADDRESS else f" ({VIEW_ADDRESS} is in use, perhaps by another view)"
    )
    return f"live view: rerun {viewer_url(address)}{note}"


def is_listening(address: str) -> bool:
    """Return whether a server accepts connections at "HOST:PORT" of this computer."""
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), 1.0).close()
    except OSError:
        return False
    return True


def _is_free(host: str, port: int) -> bool:
    try:
        socket.create_server((host, port)).close()
    except OSError:
        return False
    return True
