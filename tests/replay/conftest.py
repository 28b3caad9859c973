"""What a replay has to say, without its page."""

from typing import Any

import pytest

from twin.replay.task import describe_replay
from twin.results.contracts import ReplayResult


@pytest.fixture
def report(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What the command has to say of a replay; no report is drawn."""
    kept: dict[str, Any] = {}

    def describe(*given: Any) -> ReplayResult:
        result = describe_replay(*given)
        kept.update(result.to_plain())
        return result

    monkeypatch.setattr("twin.replay.task.describe_replay", describe)
    monkeypatch.setattr("twin.report.finalize.write_report", lambda *_: None)
    return kept
