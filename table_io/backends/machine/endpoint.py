"""Endpoint of a machine on this computer: "tcp/127.0.0.1:PORT" or "unix/PATH"."""

import contextlib
import os
import socket
from dataclasses import dataclass

from table_io.errors import InputError

LOOPBACK_HOSTS = ("127.0.0.1", "localhost", "::1")
ALLOWED_ENDPOINTS = "tcp/127.0.0.1:PORT, or unix/PATH"


@dataclass(frozen=True, slots=True)
class Endpoint:
    """Socket family and address; `text` as the user wrote it."""

    text: str
    family: socket.AddressFamily
    address: tuple[str, int] | str


def parse_endpoint(text: str) -> Endpoint:
    """Parse an endpoint; InputError if it is invalid or reachable from other computers."""
    kind, _, location = text.partition("/")
    if kind == "unix" and location:
        return Endpoint(text, socket.AF_UNIX, location)
    host, _, port = location.rpartition(":")
    if kind != "tcp" or not port.isdecimal() or not 0 <= int(port) <= 65535:
        raise InputError("invalid endpoint", key="endpoint", value=text, allowed=ALLOWED_ENDPOINTS)
    if host not in LOOPBACK_HOSTS:
        raise InputError(
            f"{host or 'an empty host'} can be reached from other computers, and the table has no "
            "access control",
            key="endpoint",
            value=text,
            allowed=ALLOWED_ENDPOINTS,
        )
    family = socket.AF_INET6 if host == "::1" else socket.AF_INET
    return Endpoint(text, family, (host, int(port)))


def connect(endpoint: Endpoint, timeout_s: float) -> socket.socket:
    """Return a connection; OSError if nothing answers."""
    connection = socket.socket(endpoint.family, socket.SOCK_STREAM)
    try:
        connection.settimeout(timeout_s)
        connection.connect(endpoint.address)
        if endpoint.family != socket.AF_UNIX:
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    except BaseException:
        connection.close()
        raise
    return connection


def open_listener(endpoint: Endpoint) -> socket.socket:
    """Return a listening socket; InputError if the endpoint is in use or cannot be used."""
    listener = socket.socket(endpoint.family, socket.SOCK_STREAM)
    try:
        if isinstance(endpoint.address, str):
            _remove_stale_socket(endpoint, endpoint.address)
        else:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(endpoint.address)
        listener.listen()
        listener.setblocking(False)
    except OSError as error:
        listener.close()
        raise InputError(
            f"cannot listen there: {error.strerror or error}",
            where=f"--listen {endpoint.text}",
            remedy="end another table that listens there, or give another endpoint",
        ) from None
    except InputError:
        listener.close()
        raise
    return listener


def _remove_stale_socket(endpoint: Endpoint, path: str) -> None:
    """Remove the socket file of a machine that died; InputError if one is running."""
    with contextlib.suppress(FileNotFoundError, ConnectionRefusedError):
        connect(endpoint, 1.0).close()
        raise InputError(
            "another table listens there", where=f"--listen {endpoint.text}", remedy="end it first"
        )
    with contextlib.suppress(FileNotFoundError):
        os.unlink(path)
