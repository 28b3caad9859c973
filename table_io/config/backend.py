"""Backends as a rig file sees them: their sections, and the registry of those installed.

A backend registers under its name in the entry-point group `shaketwin.backends`. Its module is
imported when a rig file names it, not before.
"""

from functools import cache
from typing import TYPE_CHECKING, Protocol, runtime_checkable

from table_io.config.base import ConfigModel
from table_io.config.plugins import list_entry_points, load_entry_point
from table_io.errors import InputError

if TYPE_CHECKING:
    from table_io.config.rig import RigConfig

BACKEND_GROUP = "shaketwin.backends"
REINSTALL = "install shaketwin again (pip install -e . in a source tree)"


class BackendConfig(ConfigModel):
    """Base class of the section `[name]` in which a rig file configures the backend `name`."""

    def list_faults(self, rig: "RigConfig") -> list[str]:
        """List contradictions between this section and the rest of the rig file."""
        return []

    def find_address(self, rig: "RigConfig") -> str:
        """Return the address of the machine as written in the rig file; "" if it has none."""
        return ""

    @property
    def warnings(self) -> list[str]:
        """Warnings of the pre-flight check about allowed but less safe settings."""
        return []

    @property
    def max_start_wait_s(self) -> float:
        """Longest recorded wait for the table to be started, in s."""
        return 0.0


@runtime_checkable
class InstalledBackend(Protocol):
    """What a rig file needs of `table_io.backends.BackendDescriptor`."""

    @property
    def config(self) -> type[BackendConfig]: ...
    @property
    def drives(self) -> bool: ...
    @property
    def any_speed(self) -> bool: ...
    @property
    def is_simulated(self) -> bool: ...
    @property
    def external_control(self) -> bool: ...


@cache
def load_backend(name: str) -> InstalledBackend | None:
    """Import the backend `name`, None if it is not installed; InputError if it is unusable."""
    backend = load_entry_point(BACKEND_GROUP, name)
    if backend is not None and not isinstance(backend, InstalledBackend):
        raise InputError(
            f"is a {type(backend).__name__}",
            where=BACKEND_GROUP,
            key=name,
            allowed="a BackendDescriptor",
            remedy="fix or remove the package",
        )
    return backend


def require_backend(name: str, where: object, key: str = "backend") -> InstalledBackend:
    """Return the backend `name`; InputError if it is not installed."""
    backend = load_backend(name)
    if backend is None:
        names = ", ".join(list_entry_points(BACKEND_GROUP))
        raise InputError(
            "no installed package provides this backend",
            where=where,
            key=key,
            value=name,
            allowed=names or "none is installed",
            remedy="correct the name, or install the package that provides it"
            if names
            else REINSTALL,
        )
    return backend
