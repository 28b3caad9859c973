"""Hidden truths of the simulated table."""

import hashlib
from pathlib import Path
from typing import Any


def seal_truth(folder: Path, text: str) -> dict[str, Any]:
    """Write a truth and return the keys of [simulated] that name it."""
    path = folder / "truth.toml"
    path.write_text(text, encoding="utf-8")
    digest = hashlib.sha256(text.encode()).hexdigest()
    return {"truth": str(path), "truth_sha256": digest}


def hide_truth(rig_toml: str, folder: Path, text: str) -> str:
    """Return the text of a simulated rig that hides a truth, sound without one.

    [simulated] is its last table, as in the shipped rigs.
    """
    if not text:
        return rig_toml
    keys = seal_truth(folder, text)
    return rig_toml + "".join(f'{key} = "{value}"\n' for key, value in keys.items())
