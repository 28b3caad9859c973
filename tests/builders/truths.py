"""Hidden truths of the simulated table."""

import hashlib
from pathlib import Path


def seal_truth(folder: Path, text: str) -> dict[str, str]:
    """Write a truth and return the keys of [simulated] that name it."""
    path = folder / "truth.toml"
    path.write_text(text, encoding="utf-8")
    digest = hashlib.sha256(text.encode()).hexdigest()
    return {"truth": str(path), "truth_sha256": digest}
