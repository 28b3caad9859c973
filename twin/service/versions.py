"""What can make a difference in the last bit: libraries, machine type, and the twin's own code."""

import hashlib
import platform
from functools import cache
from importlib.metadata import version
from pathlib import Path

import twin

LIBRARIES = ("shaketwin", "numpy", "scipy", "numba", "protobuf", "eclipse-zenoh", "mcap")
PURE = ("model", "compare")  # rooms whose code makes what a replay is compared in


@cache
def installed() -> dict[str, str]:
    """Versions by name, as they go into the start record: each changes where a result may.

    `machine` is the processor that kernels are compiled for, `kernels` a hash of the code of model
    and comparison.
    """
    from llvmlite.binding import get_host_cpu_name

    return {name: version(name) for name in LIBRARIES} | {
        "python": platform.python_version(),
        "machine": f"{platform.machine()} {get_host_cpu_name()}",
        "kernels": _code(),
    }


def differing(recorded: dict[str, str]) -> dict[str, tuple[str, str]]:
    """(recorded, installed) version of all that was recorded and is another one now."""
    here = installed()
    return {
        name: (then, here.get(name, "none"))
        for name, then in recorded.items()
        if here.get(name, "none") != then
    }


def _code() -> str:
    digest = hashlib.sha256()
    home = Path(twin.__file__).parent
    for room in PURE:
        for path in sorted((home / room).rglob("*.py")):
            digest.update(f"{path.relative_to(home)}\n".encode() + path.read_bytes())
    return digest.hexdigest()[:12]
