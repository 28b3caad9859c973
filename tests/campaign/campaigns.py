"""Campaigns whose runs end as soon as they begin, and campaign files to play."""

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import pytest

from tests.builders.profiles import format_test
from twin.campaign import command, players, state
from twin.campaign.command import CampaignOptions
from twin.campaign.result import CampaignInfo, CampaignSummary
from twin.campaign.state import read_state
from twin.live.process_config import ProcessConfig


def write(folder: Path, **gaps: str) -> None:
    """A test profile of each name, of that gap; "4.0 0.02" also has a level."""
    for name, setting in gaps.items():
        gap, level = (*setting.split(), "0.05")[:2]
        (folder / f"{name}.toml").write_text(
            format_test(
                3.0,
                4.0,
                0.5,
                float(gap),
                title=name,
                measured_cycles=None,
                acceleration_g=float(level),
            )
        )


LISTED = """
title = "Three gaps"
[[runs]]
profile = "free.toml"
prompt = "Take the bumpers away"
[[runs]]
profile = "g4.toml"
prompt = "Set 4 mm"
notes = "look at the bolts"
[[runs]]
profile = "g4.toml"
label = "again"
"""


class Players:
    """Stands in for a WorkerPool: what is given ends at once, as `ends` says for its label."""

    ends: ClassVar[dict[str, tuple[str, int]]] = {}  # label -> verdict, measured steps
    given: ClassVar[list[ProcessConfig]] = []

    def __init__(self, _: int) -> None:
        self.playing: list[str] = []

    def __enter__(self) -> "Players":
        return self

    def __exit__(self, *_: object) -> None:
        pass

    @property
    def free(self) -> bool:
        return not self.playing

    @property
    def busy(self) -> bool:
        return bool(self.playing)

    def submit(self, run: str, spec: ProcessConfig) -> None:
        self.playing.append(run)
        self.given.append(spec)
        record(spec)

    def stop(self) -> None:
        pass

    def messages(self, _: float) -> Iterator[tuple[str, dict[str, Any]]]:
        while self.playing:
            yield self.playing.pop(0), {"reported": True}


def record(spec: ProcessConfig) -> None:
    """What a player leaves of a run: some recording, and a summary of it."""
    profile = spec.make_run_config().profile
    label = profile.set_up.label if profile.set_up else ""
    verdict, measured = Players.ends.get(label, ("complete", 6))
    log = Path(spec.folder) / "run.mcap"
    log.write_bytes(f"recorded by {spec.run}".encode())
    steps = [
        {
            "index": step.index, "direction": step.direction, "frequency_hz": step.frequency_hz,
            "measured": {"eta_d": 1.0},
        }
        for step in profile.steps[profile.first_step : measured]
    ]  # fmt: skip
    values = {
        "run": {"name": spec.run}, "verdict": verdict, "reason": f"it was {verdict}",
        "steps": steps, "gaps": 0,
        "sha256": hashlib.sha256(log.read_bytes()).hexdigest(),
    }  # fmt: skip
    (log.parent / "summary.json").write_text(json.dumps(values))


def write_bare_summary(folder: Path) -> Path:
    """Stand in for the report of a campaign: a summary without results, and no page."""
    summary = CampaignSummary(
        campaign=CampaignInfo(title="", citation="", notes=""),
        verdict="",
        reason="",
        gap_comparison=None,
    )
    summary.write(folder / "summary.json")
    return folder / "report.html"


def prepare_campaign(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder, with a campaign of three runs; nothing is simulated or drawn in it."""
    write(tmp_path, free="inf", g4="4.0")
    (tmp_path / "c.toml").write_text(LISTED)
    monkeypatch.setattr(players, "WorkerPool", Players)
    monkeypatch.setattr(Players, "ends", {})
    monkeypatch.setattr(Players, "given", [])
    for room in (command, players):
        monkeypatch.setattr(room, "write_campaign_report", write_bare_summary)
    for room in (players,):
        monkeypatch.setattr(room, "format_run_end", lambda *_: "ended")
    monkeypatch.setattr(command, "compile_kernels", lambda *_, **__: None)
    monkeypatch.setattr(state, "LOCK_TIMEOUT_S", 0.1)
    return tmp_path


def make_options(folder: Path, **changes: Any) -> CampaignOptions:
    options: dict[str, Any] = {
        "path": folder / "c.toml", "out": folder / "out", "resume": False, "unpaced": True,
        "model": None, "table": None, "unattended": False, "listen": "",
    }  # fmt: skip
    return CampaignOptions(**options | changes)


def files(folder: Path) -> dict[str, bytes]:
    """Every file under a folder, as it is."""
    return {
        str(recording.relative_to(folder)): recording.read_bytes()
        for recording in recordings(folder)
    }


def recordings(folder: Path) -> list[Path]:
    return [path for path in sorted(folder.rglob("*")) if path.is_file() and path.suffix != ".json"]


def statuses(folder: Path) -> list[str]:
    return [run.status for run in read_state(folder / "out").runs]
