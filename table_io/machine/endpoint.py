"""Where a machine is reached: "tcp/127.0.0.1:PORT" or "unix/PATH", on this computer only."""

import contextlib
import os
import socket
from dataclasses import dataclass

from table_io.card import BadInput

LOOPBACK = ("127.0.0.1", "localhost", "::1")
ALLOWED = "allowed: tcp/127.0.0.1:PORT, or unix/PATH"


@dataclass(frozen=True, slots=True)
class Endpoint:
    """A socket's family and address; `text` as a person wrote it."""

    text: str
    family: socket.AddressFamily
    address: tuple[str, int] | str


def endpoint(text: str) -> Endpoint:
    """What a person wrote; BadInput where it is no endpoint, or reaches beyond this computer."""
    kind, _, rest = text.partition("/")
    if kind == "unix" and rest:
        return Endpoint(text, socket.AF_UNIX, rest)
    host, _, port = rest.rpartition(":")
    if kind != "tcp" or not port.isdecimal() or not 0 <= int(port) <= 65535:
        raise BadInput(f"endpoint {text!r}: {ALLOWED}")
    if host not in LOOPBACK:
        raise BadInput(
            f"endpoint {text!r}: {host or 'no host'} is reached from other computers, and the "
            f"machine has no lock on its door; {ALLOWED}"
        )
    family = socket.AF_INET6 if host == "::1" else socket.AF_INET
    return Endpoint(text, family, (host, int(port)))


def connected(where: Endpoint, timeout_s: float) -> socket.socket:
    """A connection; OSError where nobody answers."""
    one = socket.socket(where.family, socket.SOCK_STREAM)
    try:
        one.settimeout(timeout_s)
        one.connect(where.address)
        if where.family != socket.AF_UNIX:
            one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    except BaseException:
        one.close()
        raise
    return one


def listening(where: Endpoint) -> socket.socket:
    """A listener; BadInput where somebody listens there already, or nobody can."""
    one = socket.socket(where.family, socket.SOCK_STREAM)
    try:
        if isinstance(where.address, str):
            _sweep(where, where.address)
        else:
            one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        one.bind(where.address)
        one.listen()
        one.setblocking(False)
    except OSError as error:
        one.close()
        raise BadInput(
            f"--listen {where.text}: {error.strerror or error}; is another table there? End it, or "
            "give another endpoint"
        ) from None
    except BadInput:
        one.close()
        raise
    return one


def _sweep(where: Endpoint, path: str) -> None:
    """Take away the socket file of a machine that died; BadInput where one is alive."""
    with contextlib.suppress(FileNotFoundError, ConnectionRefusedError):
        connected(where, 1.0).close()
        raise BadInput(f"--listen {where.text}: another table listens there; end it first")
    with contextlib.suppress(FileNotFoundError):
        os.unlink(path)
