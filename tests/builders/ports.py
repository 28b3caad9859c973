"""Free ports of this computer."""

import socket


def free_port() -> int:
    """Return a TCP port of the loopback interface that nobody uses now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def free_endpoint() -> str:
    """Return a loopback endpoint of the bus that nobody uses now."""
    return f"tcp/127.0.0.1:{free_port()}"
