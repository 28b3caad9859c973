"""Where a live view is served: on this machine and nowhere else. No rerun here, so it is quick."""

import socket

from table_io.card import BadInput

VIEW_ADDRESS = "127.0.0.1:9876"
PORTS_TRIED = 100


def checked(address: str) -> tuple[str, int]:
    """(host, port) of "127.0.0.1:PORT"; BadInput where that is not this machine or is taken."""
    host, _, port = address.rpartition(":")
    if host != "127.0.0.1" or not port.isdigit() or not 0 < int(port) < 65536:
        raise BadInput(f"view address {address!r}; allowed: 127.0.0.1:PORT, this machine only")
    if not _free(host, int(port)):
        raise BadInput(f"view address {address}: the port is taken; choose another")
    return host, int(port)


def next_free(address: str) -> str:
    """The address itself, or with the next port that nobody listens at."""
    host, _, first = address.rpartition(":")
    last = min(int(first) + PORTS_TRIED, 65536)
    for port in range(int(first), last):
        if _free(host, port):
            return f"{host}:{port}"
    raise BadInput(f"live view: ports {first} to {last - 1} are all taken; end what holds them")


def url(address: str) -> str:
    """What a viewer opens."""
    return f"rerun+http://{address}/proxy"


def live_view(address: str) -> str:
    """What to tell a person about a view served there."""
    taken = "" if address == VIEW_ADDRESS else f" ({VIEW_ADDRESS} is taken, as by another view)"
    return f"live view: rerun {url(address)}{taken}"


def _free(host: str, port: int) -> bool:
    try:
        socket.create_server((host, port)).close()
    except OSError:
        return False
    return True
