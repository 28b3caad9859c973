"""A test that finds its way, recorded, summed up, replayed: visits are no points of a curve."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from table_io.config.base import PROFILES_DIR
from table_io.records import Comparison, Event, Fault, PrcPoint, StepAdded
from tests.builders.profiles import AT_1_KHZ, NO_LOOP_CHECK, format_test
from tests.builders.recordings import store_items
from twin.recording.reader import Recording, read_recording
from twin.replay.pipeline_replay import RecordedRun, replay_recording
from twin.report.report import format_headline
from twin.results.report_data import build_report_data, extract_prc
from twin.results.summary import format_summary, summarise
from twin.setup.run_config import RunConfig, from_texts
from twin.setup.unpaced import play_unpaced
from twin.transport.codec import encode_item

PROFILE = format_test(
    3.8,
    4.0,
    0.2,
    cycles=3,
    directions=["forward"],
    tables=NO_LOOP_CHECK | AT_1_KHZ | {"dwell": {"cycles": 6}},
)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[RunConfig, Recording, Any]:
    texts = [
        (PROFILES_DIR / name).read_text() for name in ("rigs/simulated.toml", "models/snm.toml")
    ]
    bundle = from_texts("short", PROFILE, texts[0], texts[1], "short")
    log = tmp_path_factory.mktemp("visits") / "run.mcap"
    play_unpaced(bundle, "short", log, lambda: None, lambda item: None)
    recording = read_recording(log)
    return bundle, recording, summarise(recording, bundle.parameters)


def test_visits_stand_beside_the_steps_with_their_reasons(run: tuple) -> None:
    bundle, recording, summary = run
    assert [step.index for step in summary.steps] == [0, 1]
    assert [visit.index for visit in summary.visits] == [2, 3]
    for visit, decided in zip(summary.visits, recording.records(StepAdded), strict=True):
        assert (visit.frequency_hz, visit.direction) == (4.0, "forward")
        assert visit.reason == decided.reason
        assert visit.measured.eta_d == pytest.approx(visit.twin.eta_d, rel=0.03)
    (detected,) = [event.text for event in recording.records(Event) if event.kind == "found"]
    assert summary.findings == [detected]
    assert "6 cycles held in 2 visits" in format_summary(summary, 2)
    shown = build_report_data(recording, summary)
    assert extract_prc(shown.steps, "measured", "forward", "eta_d")[0].tolist() == [3.8, 4.0]
    assert format_headline(shown).startswith("2 of 2 steps")
    assert detected in format_headline(shown)
    assert len(bundle.steps) == 2


def test_replay_of_visits_is_identical(run: tuple, tmp_path: Path) -> None:
    bundle, recording, summary = run
    made = tmp_path / "run.mcap"
    identity = replay_recording(
        RecordedRun.open(recording.path), bundle, made, "again", lambda item: None
    )
    assert identity.is_identical
    again = read_recording(tmp_path / "run.mcap")
    for kind in (Comparison, PrcPoint, StepAdded, Event):
        replayed = [
            record for record in again.records(kind) if getattr(record, "kind", "") != "replay"
        ]
        assert [encode_item(record, "") for record in replayed] == [
            encode_item(record, "") for record in recording.records(kind)
        ]
    assert len(again.records(PrcPoint)) == 4
    assert summarise(again, bundle.parameters).visits == summary.visits


def test_visits_that_a_dead_twin_missed_are_measured_all_the_same(run: tuple) -> None:
    bundle, recording, summary = run
    end = recording.stop.index
    fault = Fault(end, "twin", 0, end, "it died")
    kept = tuple(item for item in recording.items if not isinstance(item, PrcPoint))
    rebuilt = summarise(replace(recording, items=store_items([*kept, fault])), bundle.parameters)
    assert [visit.measured for visit in rebuilt.visits] == [
        visit.measured for visit in summary.visits
    ]
    assert {visit.twin for visit in rebuilt.visits} == {None}
