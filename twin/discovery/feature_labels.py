"""Names of features and of fits to them, from the entries of features.json."""

from collections.abc import Sequence
from typing import Any

Json = dict[str, Any]
REFITTED = "the refitted base"


def name_fit(names: Sequence[str]) -> str:
    """Return the name of a fit: its effects, or that of the base."""
    return " + ".join(names) or REFITTED


def label_feature(entry: Json) -> str:
    """Return a feature of features.json with its gap."""
    gap_m = entry["gap_m"]
    if entry["kind"] == "permanent_contact_gap":
        return str(entry["published"])
    gap = "G∞" if gap_m is None else f"G{1e3 * gap_m:g}"
    return f"{gap}: {entry['published']}"


def describe_fit(entry: Json, count: int) -> str:
    """Return a fit in a line: its effects, what it explains, and the price."""
    return (
        f"{name_fit(entry['effects'])}: {entry['explained']} of {count}, gains "
        f"{len(entry['gained'])}, loses {len(entry['lost'])}; misfit {entry['misfit']:.2f}"
    )
