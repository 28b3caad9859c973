"""`shaketwin table` behind our UDP packets: the socket round `target.py`."""

import contextlib
import select
import socket
from collections.abc import Callable

from table_io.backends.udp.packets import WORD_BYTES
from table_io.backends.udp.target import Address, Target
from table_io.card import BadInput
from table_io.clock import Clock
from table_io.machine.table import Table

TICK_S = 0.004  # of real time, between two looks at the plant
IDLE_S = 0.1  # the same where nobody has the machine
MOST_PACKETS = 256  # heard between two looks
BUFFER_BYTES = 1 << 20


def bound(address: Address) -> socket.socket:
    """A socket that hears at this address, and nowhere else; BadInput where it cannot."""
    one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
        one.setblocking(False)
        one.bind(address)
    except OSError as error:
        one.close()
        raise BadInput(
            f"udp.target: cannot hear at {address[0]}:{address[1]}: {error.strerror or error}; is "
            "another target there? End it, or give an address of this computer and a free port"
        ) from None
    return one


def serve(one: socket.socket, table: Table, clock: Clock, going: Callable[[], bool]) -> None:
    """Be the target while `going()`, and until the table is at rest."""
    target = Target(table)
    while (wanted := going()) or table.moving:
        if not wanted:
            target.switch_off(clock.now())
        select.select([one], [], [], TICK_S if table.claimed else IDLE_S)
        with contextlib.suppress(BlockingIOError):
            for _ in range(MOST_PACKETS):
                data, address = one.recvfrom(WORD_BYTES + 1)
                target.hear(data, address, clock.now())
        for data, address in target.tick(clock.now()):
            with contextlib.suppress(OSError):  # lost like any other
                one.sendto(data, address)
