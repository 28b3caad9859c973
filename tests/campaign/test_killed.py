"""A campaign on the simulated table, whole, and killed at a random point and resumed."""

import json
import math
import os
import random
import re
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from tests.builders.profiles import AT_1_KHZ, format_test
from tests.campaign.campaigns import Players
from twin.campaign import report, state
from twin.campaign.command import CampaignOptions, run_campaign
from twin.campaign.figures import prc_families
from twin.campaign.summary import read_campaign
from twin.drawing.prc_families import draw_all_gaps
from twin.inspection.curves import print_curves
from twin.inspection.folder_report import write_folder_report
from twin.live.process_config import ProcessConfig
from twin.recording.reader import read_recording
from twin.setup.unpaced import play_unpaced

pytestmark = pytest.mark.slow  # 30 s
SHAKETWIN = str(Path(sys.executable).parent / "shaketwin")
LISTED = """
title = "Free flight and G4 <i>"
[[runs]]
profile = "free.toml"
prompt = "Take the bumpers away"
[[runs]]
profile = "g4.toml"
prompt = "Set 4 mm"
"""
TABLES = AT_1_KHZ | {"loop_check": {"cycles": 3}}
TESTS = {
    "free": format_test(
        1.0, 1.6, 0.3, math.inf, title="free", cycles=3, directions=["forward"], tables=TABLES
    ),
    "g4": format_test(2.6, 4.4, 0.6, title="g4", cycles=6, tables=TABLES),
}
RELATIVE_TOLERANCE = (
    0.025  # of a curve: the level is only held within 2 %, and noise goes on elsewhere
)


class Here(Players):
    """Plays what it is given at once, in this process, and draws nothing."""

    def submit(self, run: str, spec: ProcessConfig) -> None:
        self.playing.append(run)
        log = Path(spec.folder) / "run.mcap"
        play_unpaced(spec.make_run_config(), spec.run, log, lambda: None, lambda _: None)
        state.write_summary_and_report(log.parent)


@dataclass(frozen=True)
class Both:
    """Folders of the same campaign: played in one go, and killed and resumed."""

    whole: Path
    killed: Path
    share: float  # of the second recording, when it was killed
    left: dict[str, bytes]  # what the killed one had recorded by then
    output: str  # by the resumed one


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> Both:
    folder = tmp_path_factory.mktemp("campaigns")
    for name, text in TESTS.items():
        (folder / f"{name}.toml").write_text(text)
    (folder / "c.toml").write_text(LISTED)
    whole, killed = folder / "whole", folder / "killed"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("twin.campaign.players.WorkerPool", Here)
        patch.setattr(state, "write_report", lambda *_: None)
        patch.setattr(report, "draw_campaign_figures", lambda *_: [])
        assert (
            run_campaign(
                CampaignOptions(folder / "c.toml", whole, False, True, None, None, False, "")
            )
            == 0
        )
    share = random.uniform(0.2, 0.95)
    size = (whole / "02-g4" / "run.mcap").stat().st_size
    command = [SHAKETWIN, "campaign", str(folder / "c.toml"), "--speed", "max"]
    command += ["--out", str(killed)]
    _kill(command, killed / "02-g4" / "run.mcap", share * size)
    left = {log.parent.name: log.read_bytes() for log in killed.rglob("run.mcap")}
    done = subprocess.run([*command, "--resume"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return Both(whole, killed, share, left, done.stdout)


def _kill(command: list[str], log: Path, size: float) -> None:
    """Start a campaign, and kill it and all that it started once the log is so large."""
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    while process.poll() is None and not (log.exists() and log.stat().st_size >= size):
        time.sleep(0.01)
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    for pid in (process.pid, *map(int, children)):
        os.kill(pid, signal.SIGKILL)
    process.wait()


def summary(folder: Path) -> dict[str, Any]:
    return dict(json.loads((folder / "summary.json").read_text()))


def test_a_campaign_measures_u_and_a_in_free_flight_and_divides_by_them(both: Both) -> None:
    whole = summary(both.whole)
    free = whole["free_flight"]
    # physics.md: 29.95 mm at 1.3 Hz on the grid of 0.1 Hz; three cycles do not quite reach it
    assert free["u_star_m"] == pytest.approx(29.95e-3, rel=0.03)
    assert free["model_u_star_m"] == pytest.approx(30.537e-3, rel=1e-3)
    assert free["model_a_star_m_s2"] == pytest.approx(2.057, rel=1e-3)
    peaks = whole["runs"][0]["peak"]
    assert (peaks["eta_d"]["value"], peaks["eta_d"]["frequency_hz"]) == (pytest.approx(1.0), 1.3)
    assert peaks["eta_a"]["value"] == pytest.approx(1.0)
    assert "free measured in free flight" in whole["campaign"]["normalisation"]
    alone = summary(both.whole / "02-g4")
    for step, was in zip(whole["runs"][1]["steps"], alone["steps"], strict=True):
        by = free["model_u_star_m"] / free["u_star_m"]
        assert step["measured"]["eta_d"] == pytest.approx(by * was["measured"]["eta_d"])


def test_a_campaign_finds_what_its_runs_found(both: Both) -> None:
    whole = summary(both.whole)
    assert (whole["verdict"], whole["reason"]) == ("complete", "2 of 2 runs complete")
    free, g4 = whole["runs"]
    assert (free["jumps"], free["gap_mm"], g4["gap_mm"]) == ([], None, 4.0)
    assert g4["hysteresis"] == [{"kind": "right", "from_hz": 3.2, "to_hz": 3.8}]
    assert all(check["passed"] for check in g4["checks"])
    assert len(g4["checks"]) > 30
    assert g4["trips"] == []
    assert abs(g4["level_error"]) < 0.02


def test_a_campaign_that_was_killed_and_resumed_has_the_same_result(both: Both) -> None:
    whole, other = summary(both.whole), summary(both.killed)
    assert other["verdict"] == "complete"
    assert other["u_star_m"] == pytest.approx(whole["u_star_m"], rel=RELATIVE_TOLERANCE)
    for a, b in zip(whole["runs"], other["runs"], strict=True):
        assert b["jumps"] == a["jumps"], both.share
        assert b["hysteresis"] == a["hysteresis"], both.share
        assert [step["index"] for step in b["steps"]] == [step["index"] for step in a["steps"]]
        for x, y in zip(a["steps"], b["steps"], strict=True):
            for name in ("eta_d", "eta_a", "r_r"):
                want = pytest.approx(x["measured"][name], rel=RELATIVE_TOLERANCE, abs=2e-3)
                assert y["measured"][name] == want, (both.share, x["index"], name)
            assert y["measured"]["impacts_right"] == x["measured"]["impacts_right"]


def test_what_was_interrupted_is_kept_as_it_was(both: Both) -> None:
    for name, content in both.left.items():
        assert (both.killed / name / "run.mcap").read_bytes() == content, name
    assert "02-g4" in both.left
    assert "2 of 2 runs complete" in both.output


def test_what_goes_on_says_of_what_and_from_where(both: Both) -> None:
    (run,) = [run for run in summary(both.killed)["runs"] if run["run"]["label"] == "g4"]
    used = {piece["part"] for branch in run["branches"] for piece in branch["pieces"]}
    assert len(run["parts"]) == 2
    assert run["parts"][1]["folder"] == "02-g4-2"
    assert run["parts"][1]["first_step"] in {0, 4}  # from the beginning of a direction
    assert {branch["history"] for branch in run["branches"]} <= {"whole", "restarted from rest"}
    if run["parts"][1]["first_step"]:
        assert used == {"02-g4", "02-g4-2"}
        start = read_recording(both.killed / "02-g4-2" / "run.mcap").start
        assert f'of = "{run["parts"][0]["run"]}"' in start.profile_toml
        assert len(start.steps) == 8
        page = (both.killed / "02-g4-2" / "report.html").read_text()
        assert f"run {run['parts'][0]['run']} from step 5" in page
    else:
        assert used == {"02-g4-2"}


def test_the_report_of_a_campaign_has_every_run(both: Both) -> None:
    page = (both.killed / "report.html").read_text()
    reports = sorted(both.killed.glob("*/report.html"))
    assert {"02-g4", "02-g4-2"} <= {path.parent.name for path in reports}
    for path in reports:
        assert f'href="{path.parent.name}/report.html"' in page
        assert "Set-up: " in path.read_text()
    assert {*re.findall(r'href="([^"]*)/report.html"', page)} == {p.parent.name for p in reports}
    assert "every eta, measured and model&#39;s, is divided by the u* and a*" in page
    assert "right 3.2–3.8" in page
    assert "Free flight and G4 &lt;i&gt;" in page
    assert page.count("data:image/png;base64,") == 2
    assert "http://" not in page
    assert "https://" not in page


def test_lines_and_points_of_the_pictures_are_divided_by_the_same(both: Both) -> None:
    cases, rig = prc_families(read_campaign(both.killed))
    merged = summary(both.killed)
    assert list(cases) == ["G∞", "G4"]
    by = merged["free_flight"]["model_u_star_m"] / merged["u_star_m"]
    for name, run in zip(cases, merged["runs"], strict=True):
        (test,) = cases[name].tests
        bare = replace(test, scale_override=None)
        for line, own in zip(test.points, bare.points, strict=True):
            assert line.twin is not None
            assert own.twin is not None
            assert line.twin.eta_d == pytest.approx(by * own.twin.eta_d)
            assert line.twin.r_r == own.twin.r_r
        eta = [point.measured.eta_d for point in rig.points[name] if point.measured]
        assert eta == [step["measured"]["eta_d"] for step in run["steps"]]


def test_a_gap_without_a_measured_step_is_not_drawn(both: Both) -> None:
    campaign = read_campaign(both.killed)
    free, *others = campaign.runs
    unmeasured = replace(free, summary=free.summary.model_copy(update={"steps": []}))
    cases, measured = prc_families(replace(campaign, runs=(unmeasured, *others)))
    assert list(cases) == list(measured.points) == ["G4"]
    caption = draw_all_gaps(cases, measured).caption
    assert "G−1" not in caption
    assert "free flight" not in caption


def test_the_report_is_written_anew_from_the_folder_alone(
    both: Both, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = summary(both.killed)
    (both.killed / "summary.json").unlink()
    monkeypatch.setattr(report, "draw_campaign_figures", lambda *_: [])
    write_folder_report(both.killed)
    assert summary(both.killed) == before


def test_the_curves_of_a_campaign_are_those_of_its_joined_runs(
    both: Both, capsys: pytest.CaptureFixture[str]
) -> None:
    print_curves(both.killed, True)
    runs = json.loads(capsys.readouterr().out)["runs"]
    merged = summary(both.killed)["runs"]
    assert [run["hysteresis"] for run in runs] == [run["hysteresis"] for run in merged]
    assert [run["steps"] for run in runs] == [run["steps"] for run in merged]
