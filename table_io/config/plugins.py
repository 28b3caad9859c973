"""Entry points of installed packages: backends, their simulators, excitations, effects."""

from collections.abc import Mapping, Sequence
from functools import cache
from importlib import metadata
from typing import Any

from table_io.errors import InputError


@cache
def list_entry_points(group: str) -> Mapping[str, Sequence[metadata.EntryPoint]]:
    """Return the entry points of a group by name, sorted; several if packages use one name.

    Scanning the installed packages takes milliseconds, so a process does it once.
    """
    entries: dict[str, list[metadata.EntryPoint]] = {}
    for entry in sorted(metadata.entry_points(group=group), key=lambda entry: entry.name):
        entries.setdefault(entry.name, []).append(entry)
    return entries


def load_entry(entry: metadata.EntryPoint, group: str) -> Any:
    """Import the object of an entry point; InputError if that fails."""
    try:
        return entry.load()
    except Exception as error:  # a plug-in module may raise anything
        raise make_plugin_error(
            entry, group, f"cannot load: {error} ({type(error).__name__})"
        ) from error


def make_plugin_error(entry: metadata.EntryPoint, group: str, problem: str) -> InputError:
    """Return the error of an entry point whose object cannot be used."""
    return InputError(
        problem, where=f"plug-in {entry.value} of {group}", remedy="fix or remove the package"
    )


def load_entry_point(group: str, name: str) -> Any:
    """Import the object registered under `name`, None if there is none; InputError if it fails."""
    entries = list_entry_points(group).get(name)
    if entries is None:
        return None
    entry, *others = entries
    if others:
        raise InputError(
            f"provided by {entry.value} and by {', '.join(other.value for other in others)}",
            where=group,
            key=name,
            remedy="remove all but one of these packages",
        )
    return load_entry(entry, group)
