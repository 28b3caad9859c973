"""A rig on the machine backend, to be killed: CARD PROFILE PACE.

Says "started EPOCH" once the table plays, then what happens, and at last "over SAMPLES VERDICT". A
line on its standard input is an order to the session, or a way to misbehave.
"""

import os
import select
import socket
import sys
from pathlib import Path

from table_io.acquisition.session import OperatorCommand, SessionSetup, run_session
from table_io.backends import open_backend
from table_io.backends.machine.client import MachineBackend
from table_io.block import Block
from table_io.clock import RealClock
from table_io.config.base import load_config
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.records import Event, RunStop
from twin.live.process_config import request_realtime


def read_command() -> str:
    """The line that waits on standard input, or nothing."""
    ready, _, _ = select.select([sys.stdin], [], [], 0.0)
    return os.read(sys.stdin.fileno(), 64).decode().strip() if ready else ""


def main() -> None:
    card, test, pace = sys.argv[1:]
    rig = load_config(Path(card), RigConfig, "machine card")[0]
    profile = load_config(Path(test), Profile, "test profile")[0]
    clock = RealClock(float(pace))
    backend = open_backend(rig, profile, clock)
    assert isinstance(backend, MachineBackend)

    def commands() -> OperatorCommand | None:
        word = read_command()
        if word == "garbage":
            backend._require_connection().sendall(b"GET / HTTP/1.1\r\nHost: table\r\n\r\n")
        elif word == "drop":
            backend._require_connection().shutdown(socket.SHUT_RDWR)
        elif word:
            return OperatorCommand(word, "asked to")
        return None

    def describe(_: dict[str, float], epoch_s: float) -> Event:
        return Event(0, "started", repr(epoch_s))

    request_realtime(50)
    acquired = 0
    for item in run_session(SessionSetup(profile, rig), backend, clock, describe, commands):  # type: ignore[arg-type]
        if isinstance(item, Block):
            acquired = item.end
        elif isinstance(item, RunStop):
            print("over", acquired, item.verdict, item.reason, flush=True)
        else:
            text = item.text if isinstance(item, Event) else repr(item)
            print(getattr(item, "kind", "record"), text, flush=True)


if __name__ == "__main__":
    main()
