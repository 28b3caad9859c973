"""An openDAQ device: acquisition by its native streaming, and a simulated table served as one."""

import socket

from table_io.backends.opendaq.source import OpenDaqSource, needed
from table_io.card import BadInput
from table_io.rig import Rig

__all__ = ["OpenDaqSource", "answers"]

ANSWER_S = 2.0


def answers(rig: Rig) -> None:
    """BadInput where nothing streams at the card's address, or the library is not installed."""
    wiring = needed(rig)
    try:
        socket.create_connection(wiring.address, ANSWER_S).close()
    except (OSError, UnicodeError) as error:
        why = getattr(error, "strerror", None) or error
        hint = f"for a simulated one: shaketwin table --rig {rig.name}" if rig.simulated else ""
        raise BadInput(
            f"no openDAQ device answers at {wiring.device} ({why}); switch it on, "
            f"or mend opendaq.device in the card{'; ' if hint else ''}{hint}"
        ) from None
