"""Sandbox for parsers of untrusted files: a child process with limits on memory and CPU time.

If a library crashes, hangs or exhausts memory on a damaged file, only the child process ends. If a
file makes it run code, that code can read but neither write, remove nor execute a file, open a
connection nor signal another process, where the kernel has Landlock; and what it answers can
construct nothing but tables, arrays and errors.
"""

import ctypes
import faulthandler
import io
import os
import pickle
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
ANSWER_NAMES = {  # all that an answer may construct
    *(("numpy", name) for name in ("ndarray", "dtype")),
    *(("numpy._core.multiarray", name) for name in ("_reconstruct", "scalar")),
    ("numpy._core.numeric", "_frombuffer"),
    (type(Path()).__module__, type(Path()).__name__),
    ("table_io.errors", "InputError"),
    *(("table_io.formats.table", name) for name in ("ForeignTable", "ForeignColumn")),
}
# Of Linux, on every architecture.
LANDLOCK_CREATE_RULESET, LANDLOCK_RESTRICT_SELF, PR_SET_NO_NEW_PRIVS = 444, 446, 38
# By the first version of Landlock that has them: rights on files, without those to read a file (4)
# and a folder (8); to bind and connect TCP; to reach other processes by sockets and signals.
FILE_RIGHTS = {1: 0x1FFF & ~0xC, 2: 0x2000, 3: 0x4000, 5: 0x8000}
NETWORK_RIGHTS, PROCESS_RIGHTS = {4: 0x3}, {6: 0x3}
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
        result: T | InputError = _AnswerReader(io.BytesIO(receiver.recv_bytes())).load()
    except Exception:  # no answer, or one that is no table
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


class _AnswerReader(pickle.Unpickler):
    """Reader of the answer of a child process, which its file may control."""

    def find_class(self, module: str, name: str) -> object:
        if (module, name) not in ANSWER_NAMES:
            raise pickle.UnpicklingError(f"{module}.{name} is no part of a table")
        return super().find_class(module, name)


def _drop_rights() -> None:
    """Give up all rights of this process but to read files; as far as the kernel has Landlock."""
    libc = ctypes.CDLL(None)
    version = libc.syscall(LANDLOCK_CREATE_RULESET, None, 0, 1)
    if version < 1:
        return
    rights = [
        sum(mask for since, mask in masks.items() if since <= version)
        for masks in (FILE_RIGHTS, NETWORK_RIGHTS, PROCESS_RIGHTS)
    ]
    known = 1 + (version >= min(NETWORK_RIGHTS)) + (version >= min(PROCESS_RIGHTS))
    attributes = (ctypes.c_uint64 * 3)(*rights)
    ruleset = libc.syscall(LANDLOCK_CREATE_RULESET, attributes, ctypes.c_size_t(8 * known), 0)
    libc.prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0)
    libc.syscall(LANDLOCK_RESTRICT_SELF, ruleset, 0)


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
    _drop_rights()
    answer = io.BytesIO()
    pickler = pickle.Pickler(answer)
    pickler.dispatch_table = {}  # none of the ways that libraries register for errors of all kinds
    pickler.dump(_capture_result(path, work))
    sender.send_bytes(answer.getvalue())


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
