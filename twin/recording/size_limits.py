"""Memory and work limits for reading untrusted files (decompression bombs).

The work limit is proportional to the file size, so that long recordings are accepted. The memory
limit follows from the computer; a file beyond it is refused, not reported as damaged.
"""

import os

# Work in bytes read again or decompressed: a valid recording of constant channels decompresses to
# about 60 times its size.
WORK_PER_BYTE, MIN_WORK_BYTES = 250, 256 * 2**20
WORK_PER_RECORD = 512  # minimum cost of a record
ENTRY_OVERHEAD_BYTES = 400  # memory of a message or damage entry in addition to its payload
DEFAULT_MEMORY_BYTES = 4 * 2**30


def work_limit(size: int) -> int:
    """Return the work allowed for reading a file of `size` bytes, in bytes."""
    return max(MIN_WORK_BYTES, WORK_PER_BYTE * size)


def memory_limit_bytes() -> int:
    """Return the memory allowed for the content of a file, in bytes: half of the physical memory.

    The other half is for evaluating it. Total memory counts, not free memory: the system releases
    its file cache on demand.
    """
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2
    except (AttributeError, ValueError, OSError):  # unknown on this system
        return DEFAULT_MEMORY_BYTES
