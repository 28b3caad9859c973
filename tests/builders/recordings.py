"""Fixtures: a short run with a jump, recorded once a session of tests.

Imports what computes only where a fixture is used.
"""

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from twin.recording.reader import Recording
    from twin.setup.run_config import RunConfig

PROFILE = """
title = "Across the down-jump and back"
[specimen]
mass_kg = 550.0
gap_mm = 4.0
[sweep]
start_hz = 2.4
stop_hz = 4.4
step_hz = 1.0
cycles = 4
measured_cycles = 2
[loop_check]
enabled = false
[acquisition]
rate_hz = 1000.0
[recording]
predictions = "all"
"""


@pytest.fixture(scope="session")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> "RunConfig":
    """Six steps across the down-jump and back."""
    from twin.setup.run_config import read_run_config

    path = tmp_path_factory.mktemp("across") / "across.toml"
    path.write_text(PROFILE)
    return read_run_config(path)


@pytest.fixture(scope="session")
def log_file(bundle: "RunConfig", tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recording of a run of it, alone in its folder."""
    from twin.setup.unpaced import play_unpaced

    path = tmp_path_factory.mktemp("across") / "first" / "run.mcap"
    path.parent.mkdir()
    play_unpaced(bundle, "first", path, lambda: None, lambda _: None)
    return path


@pytest.fixture(scope="session")
def recording(log_file: Path) -> "Recording":
    from twin.recording.reader import read_recording

    return read_recording(log_file)
