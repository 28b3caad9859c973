"""Recordings of the laboratory as logs: imported as a user would, with the profile of the test."""

from collections.abc import Mapping
from pathlib import Path

from tests.builders.profiles import format_test
from tests.studies.evidence.laboratory import Float1D, Specimen, StepTest, write_table
from twin.exchange.import_table import ImportOptions, import_table


def format_profile(specimen: Specimen, test: StepTest) -> str:
    """Return the profile of a test."""
    return format_test(
        test.start_hz,
        test.stop_hz,
        test.step_hz,
        specimen.gap_mm,
        {"acquisition": {"rate_hz": test.rate_hz}},
        "laboratory",
        cycles=test.cycles,
        measured_cycles=4,
        acceleration_g=0.05,
    )


def import_columns(
    columns: Mapping[str, Float1D],
    folder: Path,
    profile: str = "",
    settings: Mapping[str, float] | None = None,
) -> Path:
    """Write the columns of a recording to a folder, import them, and return the log."""
    table, log = write_table(columns, folder / "log.csv"), folder / "log.mcap"
    path = folder / "lab.toml" if profile else None
    if path is not None:
        path.write_text(profile)
    import_table(table, log, ImportOptions(profile=path, accept=True, settings=settings or {}))
    return log
