"""Entry point of the program: a stop order does not wait for the imports of the command line."""

import gc
import io
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from table_io.errors import InputError
from twin.system.exit_codes import EXIT_FAILED
from twin.system.resource_limits import MIN_MEMORY_BYTES, require_memory
from twin.transport.endpoint import DEFAULT_ENDPOINT

# Allocations between two collections of garbage: searching what imports made is a fifth of a start.
IMPORTED_OBJECTS = 50_000
FORMER_TABLE_OPTION = "--rig"
ORDERS = ("hold", "resume", "stop", "abort")
NO_MEMORY_MESSAGE = "not enough memory: close other programs, or raise the limit `ulimit -v`"


def main() -> None:
    """Run the program; an input error is one message on standard error and exit code 2."""
    gc.set_threshold(IMPORTED_OBJECTS, 20, 20)
    streams = prepare_streams()
    code: str | int | None = 0
    try:
        run_words(sys.argv[1:])
    except SystemExit as end:
        code = end.code
    except MemoryError:
        print(f"shaketwin: {NO_MEMORY_MESSAGE}", file=sys.stderr)
        code = EXIT_FAILED
    failures = [stream.failure for stream in streams if stream.failure]
    if failures and not code:
        print(f"shaketwin: cannot write the output: {failures[0]}", file=sys.stderr)
        code = EXIT_FAILED
    raise SystemExit(code)


def run_words(words: Sequence[str]) -> None:
    """Run a command line."""
    try:
        was_order = send_order(words)
        if not was_order:
            require_memory(MIN_MEMORY_BYTES)
    except InputError as error:
        print(f"shaketwin: {error}", file=sys.stderr)
        raise SystemExit(EXIT_FAILED) from None
    if not was_order:
        from twin.cli.table import main as run_command_line

        run_command_line()


class SteadyOutput(io.TextIOWrapper):
    """Output that never ends a command: a test goes on without readers, or on a full disk.

    What the encoding lacks becomes ?. `failure` is the first error; a reader who leaves is none.
    """

    failure = ""

    def write(self, text: str) -> int:
        try:
            return super().write(text)
        except OSError as error:
            self._discard_from_now(error)
            return len(text)

    def flush(self) -> None:
        try:
            super().flush()
        except OSError as error:
            self._discard_from_now(error)

    def _discard_from_now(self, error: OSError) -> None:
        if not isinstance(error, BrokenPipeError):
            self.failure = self.failure or str(error.strerror)
        devnull = os.open(os.devnull, os.O_WRONLY)
        os.dup2(devnull, self.fileno())
        os.close(devnull)


def prepare_streams() -> list[SteadyOutput]:
    """Make standard output and error steady; a closed one takes all and shows nothing."""
    streams = []
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            sink = Path(os.devnull).open("w", encoding="utf-8")  # noqa: SIM115  open to the end
            setattr(sys, name, sink)
        elif isinstance(stream, io.TextIOWrapper):
            is_direct, encoding = stream.line_buffering, stream.encoding
            steady = SteadyOutput(
                stream.detach(), encoding, errors="replace", line_buffering=is_direct
            )
            setattr(sys, name, steady)
            streams.append(steady)
    return streams


def send_order(words: Sequence[str]) -> bool:
    """Send `control ORDER [--why TEXT] [--connect ENDPOINT] [--table NAME]`.

    Return False for everything else, which the command line parses: help, keys, mistakes. Parsing
    it there too takes 0.2 s, most of it imports.
    """
    options = {"--why": "", "--connect": DEFAULT_ENDPOINT, "--table": "simulated"}
    names = ["--table" if name == FORMER_TABLE_OPTION else name for name in words[2::2]]
    values = words[3::2]
    if words[:1] != ["control"] or not set(words[1:2]) & set(ORDERS):
        return False
    if len(names) != len(values) or not set(names) <= options.keys():
        return False
    from twin.live.control import send_command

    options |= dict(zip(names, values, strict=True))
    print(send_command(words[1], options["--why"], options["--connect"], options["--table"]))
    return True
