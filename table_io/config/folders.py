"""Folders in which tests, rigs, models, features ... are found by their bare names."""

import os
from pathlib import Path

from platformdirs import user_config_path

from table_io.config.base import PROFILES_DIR
from table_io.errors import InputError, suggest

FOLDERS_VARIABLE = "SHAKETWIN_PROFILES"  # further folders, each with tests, rigs, models, campaigns


def list_config_folders(kind: str, profile_path: Path | None = None) -> list[Path]:
    """List the folders that are searched for configs of a kind, such as "rigs", in their order.

    Next to the profile; profiles/ in the working folder; the folders of SHAKETWIN_PROFILES; the
    user's config folder; the shipped ones.
    """
    roots = [Path("profiles"), user_config_path("shaketwin"), PROFILES_DIR]
    roots[1:1] = map(Path, filter(None, os.environ.get(FOLDERS_VARIABLE, "").split(os.pathsep)))
    if profile_path is not None and not profile_path.resolve().is_relative_to(PROFILES_DIR):
        roots.insert(0, profile_path.resolve().parent.parent)
    return list(dict.fromkeys(root.resolve() / kind for root in roots))


def list_configs(kind: str, profile_path: Path | None = None) -> dict[str, Path]:
    """Return the paths of the configs of a kind by their bare names, sorted."""
    folders = list_config_folders(kind, profile_path)
    paths = [path for folder in reversed(folders) for path in folder.glob("*.toml")]
    paths = [path for path in paths if path.is_file()]
    by_name = {path.stem: path for path in paths}  # the last one, of the first folder, stays
    return {name: by_name[name] for name in sorted(by_name)}


def find_config(name: str, folder: str, profile_path: Path | None = None, option: str = "") -> Path:
    """Return the path of config `name`: a path, or a bare name found by `list_configs`.

    InputError names the option that gave the name, without one the profile.
    """
    direct = Path(name)
    if direct.suffix == ".toml":
        by_profile = profile_path.parent / direct if profile_path is not None else direct
        return by_profile if by_profile.is_file() else direct
    configs = list_configs(folder, profile_path)
    if name in configs:
        return configs[name]
    searched = ", ".join(map(str, list_config_folders(folder, profile_path)))
    raise InputError(
        "not found",
        where=f"{option} {name}" if option else profile_path or "",
        key="" if option else name or folder.removesuffix("s"),
        allowed=f"a name in {folder} or the path of a .toml file",
        remedy=f"{suggest(name, configs)} (searched: {searched})",
    )


def resolve_config(path: Path, folder: str) -> Path:
    """Return the path of a config file given as a path, or as the bare name of one.

    A name comes before a file of that name without the suffix .toml in the working folder.
    """
    if path.suffix.lower() == ".toml" or len(path.parts) > 1:
        return path
    return (
        path
        if path.is_file() and str(path) not in list_configs(folder)
        else find_config(str(path), folder)
    )
