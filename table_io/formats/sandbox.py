"""Sandbox for parsers of untrusted files: a child process with limits on memory and CPU time.

If a library crashes, hangs or exhausts memory on a damaged file, only the child process ends.
"""

import faulthandler
import os
import signal
import sys
from collections.abc import Callable
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TypeVar

from table_io.errors import InputError

# Address space beyond that of the parent.
BASE_MEMORY_BYTES = 2**30
MEMORY_PER_FILE_BYTE = 600
MAX_MEMORY_BYTES = 2**34
MAX_CPU_S = 60
T = TypeVar("T")


def run_isolated(path: Path, work: Callable[[], T], max_cpu_s: int = MAX_CPU_S) -> T:
    """Run `work` on the file at `path` in a child process; raise InputError on any failure.

    The child is killed after `max_cpu_s` of CPU time. Only Linux has the sandbox; elsewhere the
    file is read in this process.
    """
    if sys.platform != "linux":
        return _raise_input_error(_capture_result(path, work))
    receiver, sender = Pipe(duplex=False)
    child = os.fork()
    if not child:
        try:
            _run_in_child(path, work, sender, max_cpu_s)
        finally:
            os._exit(0)
    sender.close()
    try:
        result: T | InputError = receiver.recv()
    except EOFError:
        result = InputError(
            "its reader crashed, hung or used too much memory",
            where=path,
            remedy="the file is damaged or too large: export it again, or import its parts one by "
            "one",
        )
    finally:
        receiver.close()
        os.kill(child, signal.SIGKILL)  # it has sent its result, or this process was interrupted
        os.waitpid(child, 0)
    return _raise_input_error(result)


def _raise_input_error(result: T | InputError) -> T:
    """Return a result; raise it if it is an error."""
    if isinstance(result, InputError):
        raise result
    return result


def _run_in_child(path: Path, work: Callable[[], T], sender: Connection, max_cpu_s: int) -> None:
    """Send the result of `work`, or an InputError, from the child process."""
    import resource

    faulthandler.disable()  # the parent reports a crash in one message
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    used_bytes = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    for resource_kind, limit in (
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_CPU, max_cpu_s),
        (
            resource.RLIMIT_AS,
            used_bytes
            + min(BASE_MEMORY_BYTES + MEMORY_PER_FILE_BYTE * path.stat().st_size, MAX_MEMORY_BYTES),
        ),
    ):
        hard_limit = resource.getrlimit(resource_kind)[1]
        resource.setrlimit(
            resource_kind, (limit if hard_limit < 0 else min(limit, hard_limit), hard_limit)
        )
    sender.send(_capture_result(path, work))


def _capture_result(path: Path, work: Callable[[], T]) -> T | InputError:
    """Return the result of `work`, or the InputError that explains why there is none."""
    try:
        return work()
    except InputError as error:
        return error
    except MemoryError:
        return InputError(
            "too large for this memory", where=path, remedy="import its parts one by one"
        )
    except OSError as error:
        return InputError(f"cannot read this: {error.strerror or _first_line(error)}", where=path)
    except Exception as error:  # parsers raise any exception on unexpected bytes
        return InputError(
            f"damaged, or not of the format of its suffix: {_first_line(error)}",
            where=path,
            remedy="export it again",
        )


def _first_line(error: Exception) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0][:200]
