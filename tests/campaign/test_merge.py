"""A run of a campaign from several recordings."""

from pathlib import Path

from table_io.config.base import PROFILES_DIR
from table_io.records import Check
from twin.campaign.state import RunPart, RunState
from twin.campaign.summary import merge_summaries
from twin.recording.reader import read_recording
from twin.results.summary import summarise
from twin.setup.run_config import read_run_config
from twin.setup.unpaced import play_unpaced


def test_checks_of_a_resumed_run_are_those_of_its_last_part(tmp_path: Path) -> None:
    text = (PROFILES_DIR / "tests" / "quickstart.toml").read_text()
    profile = tmp_path / "short.toml"
    profile.write_text(
        text.replace("start_hz = 2.4", "start_hz = 4.2").replace("cycles = 5", "cycles = 3")
    )
    config = read_run_config(profile)
    path = tmp_path / "run.mcap"
    play_unpaced(config, "run", path, lambda: None, lambda _: None)
    recording = read_recording(path)
    summary = summarise(recording, config.parameters)
    assert len(summary.checks) == len(recording.records(Check)) > 0
    parts = tuple(RunPart(folder=f"{n}", run=f"run{n}", first_step=0) for n in range(3))
    state = RunState(name="short", label="short", status="complete", parts=parts)
    for summaries in ([summary] * 3, [summary, summary, None]):  # the last part has none yet
        merged = merge_summaries(state, config.profile, summaries)
        assert merged.checks == summary.checks
