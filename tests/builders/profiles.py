"""Profiles of tests: a stepped sine or a history, with only what a test is about stated."""

from collections.abc import Mapping
from typing import Any

from table_io.config.base import PROFILES_DIR, format_toml
from table_io.config.excitation.stepped_sine import Sweep
from table_io.config.profile import Profile, Specimen, load_profile

SPECIMEN = Specimen.model_validate({"mass_kg": 550.0, "gap_mm": 4.0})
RECORD_TOML = """title = "a record"
[specimen]
mass_kg = 550.0
gap_mm = 4.0
[excitation]
kind = "record"
file = "motion.csv"
"""
Tables = dict[str, dict[str, Any]]  # of a profile, by name
UNCHECKED: Tables = {
    "loop_check": {"enabled": False},
    "control": {"enabled": False},
}
NO_LOOP_CHECK: Tables = {"loop_check": {"enabled": False}}
AT_1_KHZ: Tables = {"acquisition": {"rate_hz": 1000.0}}
AT_1_KHZ_BY_50: Tables = {"acquisition": {"rate_hz": 1000.0, "block_samples": 50}}
GRID = {"start_hz": 2.0, "stop_hz": 3.0, "step_hz": 0.5, "cycles": 4, "measured_cycles": 2}


def make_profile(
    gap_mm: float = 4.0, tables: dict[str, dict[str, Any]] | None = None, **sweep: Any
) -> Profile:
    """Return a test of 2, 2.5 and 3 Hz up and down, with other keys of [sweep] and tables.

    `tables` replace [specimen] and add the others, e.g. {"loop_check": {"enabled": False}}.
    """
    raw: dict[str, Any] = {
        "title": "short",
        "specimen": {"mass_kg": 550.0, "gap_mm": gap_mm},
        "sweep": GRID | sweep,
    }
    return Profile.model_validate(raw | (tables or {}))


def make_history_profile(kind: str, **excitation: Any) -> Profile:
    """Return a test of another kind than a stepped sine, with its keys of [excitation]."""
    specimen = {"mass_kg": 550.0, "gap_mm": 4.0}
    raw = {"title": kind, "specimen": specimen, "excitation": {"kind": kind, **excitation}}
    return Profile.model_validate(raw)


def read_shipped_profile(name: str, **tables: dict[str, Any]) -> Profile:
    """Return a shipped test, with other values in some of its tables."""
    raw = load_profile(PROFILES_DIR / "tests" / f"{name}.toml")[0].model_dump()
    for table, values in tables.items():
        raw[table].update(values)
    return Profile.model_validate(raw)


def list_shipped_sweeps() -> list[str]:
    """Return the names of the shipped tests that are stepped sines."""
    return sorted(
        path.stem
        for path in (PROFILES_DIR / "tests").glob("*.toml")
        if isinstance(load_profile(path)[0].excitation, Sweep)
    )


def format_test(
    start_hz: float,
    stop_hz: float,
    step_hz: float,
    gap_mm: float = 4.0,
    tables: Mapping[str, Mapping[str, Any]] | None = None,
    title: str = "short",
    rig: object = None,
    model: object = None,
    **sweep: Any,
) -> str:
    """Return the text of a stepped sine, by default of 4 cycles, 2 measured, up and down.

    `sweep`: further keys of its table, None to leave one out; `tables`: further tables.
    """
    keys: dict[str, Any] = {"title": title}
    keys |= {name: str(file) for name, file in (("rig", rig), ("model", model)) if file}
    keys["specimen"] = {"mass_kg": 550.0, "gap_mm": gap_mm}
    keys["sweep"] = {"start_hz": start_hz, "stop_hz": stop_hz, "step_hz": step_hz, "cycles": 4}
    sweep = {"measured_cycles": 2} | sweep
    keys["sweep"] |= {name: value for name, value in sweep.items() if value is not None}
    return format_toml(keys | dict(tables or {}))
