"""Entry point of the program: a stop order does not wait for the imports of the command line."""

import io
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from table_io.errors import InputError

ORDERS = ("hold", "resume", "stop", "abort")
DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"


def main() -> None:
    """Run the program; an input error is one message on standard error and exit code 2."""
    prepare_streams()
    try:
        was_order = send_order(sys.argv[1:])
    except InputError as error:
        print(f"shaketwin: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    if not was_order:
        from twin.cli.main import main as run_command_line

        run_command_line()


def prepare_streams() -> None:
    """Make output never fail: what an encoding lacks becomes ?, a closed stream takes all."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            sink = Path(os.devnull).open("w", encoding="utf-8")  # noqa: SIM115  open to the end
            setattr(sys, name, sink)
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def send_order(words: Sequence[str]) -> bool:
    """Send `control ORDER [--why TEXT] [--connect ENDPOINT] [--rig NAME]`.

    Return False for everything else, which the command line parses: help, keys, mistakes. Parsing
    it there too takes 0.2 s, most of it imports.
    """
    options = {"--why": "", "--connect": DEFAULT_ENDPOINT, "--rig": "simulated"}
    names, values = words[2::2], words[3::2]
    if words[:1] != ["control"] or not set(words[1:2]) & set(ORDERS):
        return False
    if len(names) != len(values) or not set(names) <= options.keys():
        return False
    from twin.live.control import send_command

    options |= dict(zip(names, values, strict=True))
    print(send_command(words[1], options["--why"], options["--connect"], options["--rig"]))
    return True
