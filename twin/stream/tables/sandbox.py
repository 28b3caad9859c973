"""Foreign bytes are parsed in a process of its own: where a library crashes, hangs or swells on a
damaged file, that process ends, not ours.
"""

import faulthandler
import os
import resource
import signal
from collections.abc import Callable
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TypeVar

from table_io.card import BadInput

MEMORY, PER_BYTE, MOST_MEMORY = 2**30, 600, 2**34  # bytes of addresses beyond ours
MOST_CPU_S = 60
T = TypeVar("T")


def apart(path: Path, work: Callable[[], T]) -> T:
    """What `work` makes of the file at `path`; BadInput where it fails in whatever way."""
    receiver, sender = Pipe(duplex=False)
    child = os.fork()
    if not child:
        try:
            _work(path, work, sender)
        finally:
            os._exit(0)
    sender.close()
    try:
        found: T | BadInput = receiver.recv()
    except EOFError:
        found = BadInput(
            f"{path}: its reader crashed, hung or took too much memory; it is damaged, or too "
            "large: export it again, or import its parts one by one"
        )
    finally:
        receiver.close()
        os.kill(child, signal.SIGKILL)  # it has said all, or we were interrupted
        os.waitpid(child, 0)
    if isinstance(found, BadInput):
        raise found
    return found


def _work(path: Path, work: Callable[[], T], sender: Connection) -> None:
    """In the child: the result or what is wrong, as the only thing that is sent."""
    faulthandler.disable()  # what dies here is told in one sentence
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    for what, most in (
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_CPU, MOST_CPU_S),
        (resource.RLIMIT_AS, used + min(MEMORY + PER_BYTE * path.stat().st_size, MOST_MEMORY)),
    ):
        hard = resource.getrlimit(what)[1]
        resource.setrlimit(what, (most if hard < 0 else min(most, hard), hard))
    try:
        sender.send(work())
    except BadInput as error:
        sender.send(error)
    except MemoryError:
        sender.send(BadInput(f"{path}: too large for this memory; import its parts one by one"))
    except OSError as error:
        sender.send(BadInput(f"{path}: cannot read this: {error.strerror or _first_line(error)}"))
    except Exception as error:  # whatever a parser says of bytes that it did not expect
        sender.send(
            BadInput(
                f"{path}: damaged, or not what its name says: {_first_line(error)}; export it again"
            )
        )


def _first_line(error: Exception) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0][:200]
