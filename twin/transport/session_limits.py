"""Limits of the sessions at a public endpoint, so that no person keeps the operator out.

zenoh limits the sessions of a hub as a whole only, and cannot close one. So the hub's links are
watched, with the names in their certificates, and what is too many is closed at its socket. Places
are reserved for people who may command: of their sessions the oldest makes room for the newest, so
that a command always comes in. Of other people's sessions the newest is refused.

Of connections that have not become a session yet, the oldest are closed where there are many.
"""

import os
import socket
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from ipaddress import ip_address
from pathlib import Path

from table_io.clock import Clock
from twin.transport.endpoint import (
    MAX_COMMAND_SESSIONS,
    MAX_HALF_OPEN,
    MAX_OBSERVER_SESSIONS,
    MAX_SESSIONS_PER_PERSON,
    split_host_port,
)

SWEEP_INTERVAL_S = 0.1
OPEN_FILES = Path("/proc/self/fd")

Address = tuple[str, int]  # IP address and port


def list_excess(sessions: Mapping[Address, str], commanding: set[Address]) -> list[Address]:
    """Return the sessions to close; `sessions` maps address to name, in order of opening.

    Those in `commanding` belong to people who may command.
    """
    per_person: Counter[str] = Counter()
    excess = []
    for address in (address for address in sessions if address not in commanding):
        name = sessions[address]
        if (
            per_person[name] == MAX_SESSIONS_PER_PERSON
            or per_person.total() == MAX_OBSERVER_SESSIONS
        ):
            excess.append(address)
        else:
            per_person[name] += 1
    by_age = [address for address in sessions if address in commanding]
    return excess + by_age[: max(0, len(by_age) - MAX_COMMAND_SESSIONS)]


@dataclass(slots=True)
class SessionLimiter:
    """Limiter of the sessions at `port` of this process; `may_command` decides by name.

    `add` and `remove` are called by zenoh's thread, `sweep` by the hub's own.
    """

    port: int
    may_command: Callable[[str], bool]
    clock: Clock
    _closed: set[str] = field(default_factory=set)  # names, not yet drained
    _sessions: dict[Address, str] = field(default_factory=dict)
    _commanding: set[Address] = field(default_factory=set)
    _half_open: dict[Address, None] = field(default_factory=dict)  # by age
    _swept_s: float = 0.0
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def add(self, locator: str, name: str) -> None:
        """Note a new session of `name`; close those that are too many then."""
        address = normalize_address(*split_host_port(locator.partition("?")[0]))
        with self._lock:
            self._sessions[address] = name
            if self.may_command(name):
                self._commanding.add(address)
            excess = list_excess(self._sessions, self._commanding)
            self._closed.update(self._sessions[address] for address in excess)
        if excess:
            close_connections(self.port, set(excess))

    def remove(self, locator: str) -> None:
        """Note the end of a session."""
        address = normalize_address(*split_host_port(locator.partition("?")[0]))
        with self._lock:
            self._sessions.pop(address, None)
            self._commanding.discard(address)

    def drain_closed(self) -> set[str]:
        """Return the names of the sessions that were closed since the last call."""
        with self._lock:
            names, self._closed = self._closed, set()
        return names

    def sweep(self) -> None:
        """Close the oldest connections without a session if there are many; call it often."""
        time_s = self.clock.now()
        if time_s - self._swept_s < SWEEP_INTERVAL_S:
            return
        self._swept_s = time_s
        connected = {address for address, _ in open_connections(self.port)}
        with self._lock:
            half_open = connected - self._sessions.keys()
        in_order = [address for address in self._half_open if address in half_open]
        self._half_open = dict.fromkeys([*in_order, *half_open])
        oldest = list(self._half_open)[:-MAX_HALF_OPEN]
        if oldest:
            close_connections(self.port, set(oldest))


def normalize_address(host: str, port: int) -> Address:
    """Return an address in its shortest form, with which equal ones compare equal."""
    address = ip_address(host.partition("%")[0])
    return str(getattr(address, "ipv4_mapped", None) or address), port


def open_connections(port: int) -> Iterator[tuple[Address, socket.socket]]:
    """Yield this process's TCP connections at its own `port`, each with the peer's address.

    The socket is closed after the iteration; the connection itself stays open.
    """
    for file in OPEN_FILES.iterdir() if OPEN_FILES.is_dir() else ():  # elsewhere than on Linux
        with suppress(OSError):  # closed meanwhile, or not connected
            if not os.readlink(file).startswith("socket:"):
                continue
            descriptor = os.dup(int(file.name))
            try:
                connection = socket.socket(fileno=descriptor)
            except OSError:
                os.close(descriptor)
                continue
            with connection:
                is_tcp = connection.family in (socket.AF_INET, socket.AF_INET6)
                if is_tcp and connection.getsockname()[1] == port:
                    host, peer_port, *_ = connection.getpeername()
                    yield normalize_address(host, peer_port), connection


def close_connections(port: int, addresses: set[Address]) -> None:
    """Shut down this process's connections at `port` with these peers; zenoh closes them then."""
    for address, connection in open_connections(port):
        if address in addresses:
            with suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
