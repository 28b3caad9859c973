"""Which sessions are closed where there are too many: laws over any order of arrival."""

import socket
from collections import Counter

from hypothesis import given
from hypothesis import strategies as st

from table_io.clock import ManualClock
from twin.transport import session_limits
from twin.transport.endpoint import (
    MAX_COMMAND_SESSIONS,
    MAX_OBSERVER_SESSIONS,
    MAX_SESSIONS_PER_PERSON,
)
from twin.transport.session_limits import SessionLimiter, list_excess, normalize_address

COMMANDERS = ("anna", "carl")
ARRIVALS = st.lists(st.sampled_from([*COMMANDERS, *(f"p{i}" for i in range(8))]), max_size=200)


@given(ARRIVALS)
def test_each_new_session_finds_the_places_that_its_person_has(names: list[str]) -> None:
    kept: dict[tuple[str, int], str] = {}
    for port, name in enumerate(names):
        before = dict(kept)
        kept["::1", port] = name
        commanding = {address for address, person in kept.items() if person in COMMANDERS}
        excess = list_excess(kept, commanding)
        for address in excess:
            del kept[address]
        counts = Counter(before.values())
        observing = sum(count for person, count in counts.items() if person not in COMMANDERS)
        if name in COMMANDERS:
            assert ("::1", port) in kept
            full = counts.total() - observing == MAX_COMMAND_SESSIONS
            oldest = (
                next(address for address, person in before.items() if person in COMMANDERS)
                if full
                else None
            )
            assert excess == ([oldest] if full else [])
        else:
            full = counts[name] == MAX_SESSIONS_PER_PERSON or observing == MAX_OBSERVER_SESSIONS
            assert excess == ([("::1", port)] if full else [])


def test_an_address_is_the_same_in_each_spelling() -> None:
    assert normalize_address("::ffff:10.0.0.7", 5) == normalize_address("10.0.0.7", 5)
    assert normalize_address("fe80::1%eth0", 5) == normalize_address("fe80:0::1", 5)


def test_of_connections_without_a_session_the_newest_stay(monkeypatch) -> None:
    monkeypatch.setattr(session_limits, "MAX_HALF_OPEN", 3)
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        clock = ManualClock()
        limiter = SessionLimiter(port, lambda name: name == "anna", clock)
        clients, accepted = [], []
        for number in range(6):
            clients.append(socket.create_connection(("127.0.0.1", port)))
            clients[-1].settimeout(0.05)
            accepted.append(server.accept()[0])
            if number == 0:  # it becomes a session
                limiter.add(f"tls/127.0.0.1:{clients[0].getsockname()[1]}", "bob")
            clock.time_s += 1.0
            limiter.sweep()
        assert [is_open(client) for client in clients] == [True, False, False, True, True, True]
        limiter.remove(f"tls/127.0.0.1:{clients[0].getsockname()[1]}")
        assert limiter.drain_closed() == set()
        for connection in (*clients, *accepted):
            connection.close()


def is_open(client: socket.socket) -> bool:
    """Whether the other end has not closed the connection."""
    try:
        return client.recv(1) != b""
    except TimeoutError:
        return True
