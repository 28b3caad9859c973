"""Limits of the system on open files, memory and threads of the matrix library."""

import os

from table_io.errors import InputError

try:
    import resource
except ImportError:  # Windows
    HAS_LIMITS = False
else:
    HAS_LIMITS = True

MIN_MEMORY_BYTES = 1_000_000_000  # of address space, for numpy, numba and the kernels
MIN_RUN_MEMORY_BYTES = 2_000_000_000  # of each process of a live run, most of it never used
MIN_OPEN_FILES = 128  # of each process of a live run on a machine of many cores, with observers
WANTED_OPEN_FILES = 1024


def limit_matrix_threads() -> None:
    """Let numpy's matrix library use one thread, unless the user asks for more.

    The matrices are small: threads cost more than they gain and delay the processes of a run. To be
    called before numpy is imported; child processes inherit it.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def require_memory(min_bytes: int) -> None:
    """Raise InputError if the processes of this user may use less memory than this.

    Libraries end the process or raise anything while they are imported without enough of it.
    """
    if not HAS_LIMITS:
        return
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit != resource.RLIM_INFINITY and limit < min_bytes:
        raise InputError(
            "the limit on the memory of a process is too low",
            where="this shell",
            key="ulimit -v",
            value=limit // 1024,
            allowed=f"at least {min_bytes // 1024} kB",
            remedy="raise it with `ulimit -v unlimited`, or in the service or batch job",
        )


def require_open_files() -> None:
    """Raise the limit on open files to `WANTED_OPEN_FILES`; InputError if it stays below this.

    Child processes inherit it.
    """
    if not HAS_LIMITS:
        return
    limit, highest = resource.getrlimit(resource.RLIMIT_NOFILE)
    if limit == resource.RLIM_INFINITY or limit >= WANTED_OPEN_FILES:
        return
    if highest == resource.RLIM_INFINITY or highest > limit:
        is_limited = highest != resource.RLIM_INFINITY
        limit = min(WANTED_OPEN_FILES, highest) if is_limited else WANTED_OPEN_FILES
        resource.setrlimit(resource.RLIMIT_NOFILE, (limit, highest))
    if limit < MIN_OPEN_FILES:
        raise InputError(
            "the limit on open files is too low",
            where="this shell",
            key="ulimit -n",
            value=limit,
            allowed=f"at least {MIN_OPEN_FILES}",
            remedy=f"raise it with `ulimit -n {WANTED_OPEN_FILES}`, or in the service or batch job",
        )
