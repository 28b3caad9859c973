"""What reading a file may cost, so that no bomb goes off: work by its size, memory by the machine.

Work grows with the file and has no end of its own: a recording of days is as sound as one of a
minute. Memory does not: what the machine cannot hold is refused, it is no damage.
"""

import os

# Work in bytes read again or unpacked: a sound recording of dead channels unpacks to some 60 times
# its size.
COST_PER_BYTE, LEAST_COST = 250, 256 * 2**20
COST_OF_RECORD = 512  # at least
HELD_BESIDE = 400  # bytes of memory of a message or a note, beside its payload
MEMORY_IF_UNKNOWN = 4 * 2**30


def work(size: int) -> int:
    """What reading a file of `size` bytes may cost."""
    return max(LEAST_COST, COST_PER_BYTE * size)


def memory() -> int:
    """Bytes that may be held of a file: half of the machine's, as the rest is to make sense of it.

    Of all there is, not of what is free: the system gives back what it caches of files.
    """
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2
    except (AttributeError, ValueError, OSError):  # a system that does not say
        return MEMORY_IF_UNKNOWN
