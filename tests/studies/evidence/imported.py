"""Recordings of the laboratory as logs: imported as a user would, with the profile of the test."""

from collections.abc import Mapping
from pathlib import Path

from tests.studies.evidence.laboratory import Float1D, Specimen, StepTest, write_table
from twin.exchange.import_table import ImportOptions, import_table

PROFILE = """title = "laboratory"
rig = "simulated"
model = "snm"
[specimen]
mass_kg = 550.0
gap_mm = {gap}
[sweep]
start_hz = {start}
stop_hz = {stop}
step_hz = {step}
cycles = {cycles}
measured_cycles = 4
acceleration_g = 0.05
[acquisition]
rate_hz = {rate}
"""


def format_profile(specimen: Specimen, test: StepTest) -> str:
    """Return the profile of a test."""
    return PROFILE.format(
        gap=specimen.gap_mm, start=test.start_hz, stop=test.stop_hz, step=test.step_hz,
        cycles=test.cycles, rate=test.rate_hz,
    )  # fmt: skip


def import_columns(columns: Mapping[str, Float1D], folder: Path, profile: str = "") -> Path:
    """Write the columns of a recording to a folder, import them, and return the log."""
    table, log = write_table(columns, folder / "log.csv"), folder / "log.mcap"
    path = folder / "lab.toml" if profile else None
    if path is not None:
        path.write_text(profile)
    import_table(table, log, ImportOptions(profile=path, accept=True))
    return log
