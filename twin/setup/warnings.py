"""Warnings of a test before it starts: `run` and `check` show the same ones."""

from table_io.clock import local_datetime
from table_io.config.base import parse_toml
from table_io.config.calibration import find_overdue_calibrations
from table_io.config.profile import Specimen
from table_io.safety.preflight import list_drive_warnings, list_setup_warnings
from twin.model.config import ModelConfig
from twin.setup.run_config import RunConfig


def list_test_warnings(config: RunConfig) -> list[str]:
    """List what is doubtful of a test: its drive, set-up, model, and sensors out of calibration."""
    return [
        *list_drive_warnings(config.margins, config.rig),
        *list_setup_warnings(config.profile, config.rig),
        *list_model_warnings(config.model_toml),
        *list_specimen_changes(config.model_toml, config.profile.specimen),
        *find_overdue_calibrations(config.rig, local_datetime().date()),
    ]


def list_model_warnings(model_toml: str) -> list[str]:
    """Return a warning for a model that its fit marked as provisional."""
    model = parse_toml(model_toml, ModelConfig, "model")
    return [f"the model is provisional: {model.provisional}"] if model.provisional else []


def list_specimen_changes(model_toml: str, specimen: Specimen) -> list[str]:
    """List how a specimen differs from those that a model was identified from."""
    model = parse_toml(model_toml, ModelConfig, "model")
    if model.provenance is None:
        return []
    what, gap_mm = f"the model {model.title!r}", 1e3 * sum(specimen.gaps_m)
    return [
        *model.provenance.list_mass_changes(specimen.mass_kg, what),
        *model.provenance.list_bumper_changes(gap_mm, what),
    ]
