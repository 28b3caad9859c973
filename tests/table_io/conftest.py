"""Closes what the tests of the simulated machines leave open."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest


@pytest.fixture(autouse=True)
def closed_flight_recorders(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Close the flight recorders of a test at its end, as a server does at its own."""
    from table_io.sim.machine.flight_recorder import FlightRecorder

    recorders: list[FlightRecorder] = []
    open_recorder = FlightRecorder.__init__

    def open_and_note(self: FlightRecorder, path: Path, notify: Any) -> None:
        open_recorder(self, path, notify)
        recorders.append(self)

    monkeypatch.setattr(FlightRecorder, "__init__", open_and_note)
    yield
    for recorder in recorders:
        recorder.close()
