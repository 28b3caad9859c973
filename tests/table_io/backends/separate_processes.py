"""A network of this thread's own, for servers that listen on every interface."""

import contextlib
import ctypes
import os
import shutil
import subprocess
from collections.abc import Iterator

import pytest

NEW_NETWORK = 0x40000000  # CLONE_NEWNET
# A loopback, and a pair of interfaces that the library's discovery can send on.
LINKS = (
    "link set lo up",
    "link add here type veth peer name there",
    "addr add 10.99.0.1/24 dev here",
    "link set here up",
    "link set there up",
)


@contextlib.contextmanager
def own_network() -> Iterator[None]:
    """This thread, and what it starts, in a network namespace of its own; skips where forbidden."""
    if shutil.which("ip") is None:
        pytest.skip("needs the program ip, for a network namespace of its own")
    libc = ctypes.CDLL(None, use_errno=True)
    here = os.open("/proc/thread-self/ns/net", os.O_RDONLY)
    try:
        if libc.unshare(NEW_NETWORK) != 0:
            why = os.strerror(ctypes.get_errno())
            pytest.skip(f"needs a network namespace of its own, here that is: {why}")
        try:
            for words in LINKS:
                made = subprocess.run(["ip", *words.split()], capture_output=True, check=False)
                if made.returncode:
                    pytest.skip(f"ip {words}: {made.stderr.decode().strip()}")
            yield
        finally:
            libc.setns(here, 0)
    finally:
        os.close(here)
