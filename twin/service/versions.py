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


Pairs = dict[str, dict[str, str | None]]


def beside_installed(recorded: dict[str, str]) -> Pairs:
    """What can change a result, by name: recorded and installed, None where there is none."""
    here = installed()
    return {
        name: {"recorded": recorded.get(name), "installed": here.get(name)}
        for name in sorted({*recorded, *here})
    }


def differing(recorded: dict[str, str]) -> Pairs:
    """All that was recorded and is another one now."""
    return {
        name: pair
        for name, pair in beside_installed(recorded).items()
        if pair["recorded"] not in (None, pair["installed"])
    }


def changes(differing: Pairs) -> str:
    """What differs in a few words; "" for nothing."""
    return ", ".join(
        f"{name} {pair['recorded']} -> {pair['installed'] or 'none'}"
        for name, pair in differing.items()
    )


def _code() -> str:
    digest = hashlib.sha256()
    home = Path(twin.__file__).parent
    for room in PURE:
        for path in sorted((home / room).rglob("*.py")):
            digest.update(f"{path.relative_to(home)}\n".encode() + path.read_bytes())
    return digest.hexdigest()[:12]
