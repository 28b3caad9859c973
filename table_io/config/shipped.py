"""Folder of the shipped tests, rigs, models and campaigns; importing it costs nothing."""

from pathlib import Path

# In a wheel the profiles lie inside this package, in a source tree next to it.
PROFILES_DIR = next(
    folder / "profiles"
    for folder in Path(__file__).resolve().parents[1:3]
    if (folder / "profiles").is_dir()
)


def list_shipped_names(kind: str) -> list[str]:
    """List the bare names of the shipped configs of a kind, such as "rigs"."""
    return sorted(path.stem for path in (PROFILES_DIR / kind).glob("*.toml"))
