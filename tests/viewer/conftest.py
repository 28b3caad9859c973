"""The example run as an .rrd file, which no test changes."""

from pathlib import Path

import pytest

from tests.viewer.example_run import blocks, recording, records
from twin.viewer.view import write_rrd


@pytest.fixture(scope="session")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("view") / "view.rrd"
    write_rrd(recording([*blocks(), *records()]), out)
    return out
