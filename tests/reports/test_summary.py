"""summary.json: the keys of contracts.md, strict JSON, and what it says of what is missing."""

import json
import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from table_io.block import Label
from table_io.records import (
    Comparison,
    CycleExtremes,
    Event,
    Fault,
    NormalizedResponse,
    PrcPoint,
    Record,
    RunStart,
    RunStop,
    SampleGap,
    Timing,
)
from tests.builders.blocks import drop_measured
from tests.builders.profiles import AT_1_KHZ, format_test
from twin.compare import COMPARED_CHANNELS
from twin.recording.mcap_log import write_items
from twin.recording.reader import Recording, read_recording
from twin.results.contract import format_json
from twin.results.contracts import ChannelError, RunSummary
from twin.results.summary import format_summary, summarise
from twin.setup.run_config import RunConfig, read_run_config
from twin.setup.unpaced import play_unpaced
from twin.transport.codec import Item

PROFILE = format_test(2.6, 4.4, 1.8, tables=AT_1_KHZ | {"recording": {"predictions": "all"}})
CELLS = ("force_r1_n", "force_r2_n", "force_l1_n", "force_l2_n")


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> RunConfig:
    path = tmp_path_factory.mktemp("summary") / "two.toml"
    path.write_text(PROFILE)
    return read_run_config(path)


@pytest.fixture(scope="module")
def recording(bundle: RunConfig, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    path = tmp_path_factory.mktemp("summary") / "run.mcap"
    play_unpaced(bundle, "two", path, lambda: None, lambda item: None)
    return read_recording(path)


def summary_of(items: list[Item], recording: Recording, bundle: RunConfig, folder: Path) -> Any:
    """What a user reads of a recording with these items: parsed from the text, strictly."""
    write_items(folder / "made.mcap", items, recording.start)
    summarise(read_recording(folder / "made.mcap"), bundle.parameters).write(
        folder / "summary.json"
    )
    return strict((folder / "summary.json").read_text())


def strict(text: str) -> Any:
    def refuse(name: str) -> None:
        raise AssertionError(f"{name} is not JSON")

    return json.loads(text, parse_constant=refuse)


def without(recording: Recording, *kinds: type) -> list[Item]:
    return [item for item in recording.items if not isinstance(item, kinds)]


def point(
    step: int, direction: str, hz: float, measured: float | None, twin: float | None
) -> PrcPoint:
    def values(eta_d: float | None) -> NormalizedResponse | None:
        if eta_d is None:
            return None
        return NormalizedResponse(eta_d, eta_d, 0.0, 0.0, 0.0, 0.0, (1, 1), (1, 2), 0.0, 0.001)

    return PrcPoint(
        1000 * step, step, direction, hz, values(measured), values(twin), 0.5, 0.49, 0.01
    )


def as_points(forward: list[float], backward: list[float]) -> list[PrcPoint]:
    """Points on 2.0, 2.1 ... Hz; `backward` is given upwards too. The twin is 10 % larger."""
    rows = [("forward", k, eta) for k, eta in enumerate(forward)]
    rows += [("backward", k, eta) for k, eta in list(enumerate(backward))[::-1]]
    return [
        point(step, direction, round(2.0 + 0.1 * k, 9), eta, 1.1 * eta)
        for step, (direction, k, eta) in enumerate(rows)
    ]


# Keys


def test_alarms_of_limits_are_stated(
    recording: Recording, bundle: RunConfig, tmp_path: Path
) -> None:
    """Those that stopped nothing, apart from the warnings of the monitoring."""
    event = Event(1500, "alarm", "limit mass_acc_m_s2: 1.3 g, warned at 1.2 g")
    items = sorted([*recording.items, event], key=lambda item: item.index)
    summary = summary_of(items, recording, bundle, tmp_path)
    assert [(each["at_s"], each["text"]) for each in summary["alarms"]] == [(1.5, event.text)]
    assert event.text not in [each["text"] for each in summary["warnings"]]
    assert event.text in format_summary(RunSummary.model_validate(summary), 4)


def test_a_sweep_that_measured_nothing_says_so(recording: Recording, bundle: RunConfig) -> None:
    summary = summarise(recording, bundle.parameters)
    summary.windows = []
    assert "complete: nothing measured" in format_summary(summary, 4)


def test_the_keys_of_the_contract(recording: Recording, bundle: RunConfig, tmp_path: Path) -> None:
    timing = Timing(900, "twin", 1.5, 4.0, 9.0, 2, 100, 0.1, "normal")
    summary = summary_of([*recording.items, timing], recording, bundle, tmp_path)
    assert summary["verdict"] == "complete"
    assert summary["reason"] == "the whole drive was played"
    assert summary["gaps"] == 0
    assert isinstance(summary["gaps"], int)
    assert summary["u_star_m"] == pytest.approx(30.537e-3, abs=1e-6)
    assert summary["a_star_m_s2"] == pytest.approx(2.057, abs=1e-3)
    assert summary["run"]["id"] == "two"
    assert recording.stop is not None
    assert summary["run"]["samples"] == recording.stop.index
    assert summary["run"]["duration_s"] == recording.stop.index / 1000
    assert "continuous in frequency" in summary["run"]["normalisation"]
    assert summary["timing"]["latency_ms"] == {"p50": 1.5, "p99": 4.0, "max": 9.0}
    assert summary["timing"]["missed_deadlines"] == 2
    assert set(summary["comparison"]) == set(COMPARED_CHANNELS)
    assert [step["index"] for step in summary["steps"]] == [0, 1, 2, 3]
    for step, planned in zip(summary["steps"], bundle.steps, strict=True):
        assert step["direction"] == planned.direction
        assert step["frequency_hz"] == planned.frequency_hz
        for name in ("table_acc_peak_m_s2", "thd"):
            assert isinstance(step[name], float)
        for source in ("measured", "twin"):
            ratios = ("eta_d", "eta_a", "eta_r", "eta_l", "r_r", "r_l")
            assert all(isinstance(step[source][name], float) for name in ratios)
            for side in ("impacts_right", "impacts_left"):
                assert len(step[source][side]) == 2
                assert all(isinstance(count, int) for count in step[source][side])


def test_steps_are_the_recorded_points(
    recording: Recording, bundle: RunConfig, tmp_path: Path
) -> None:
    summary = summary_of(list(recording.items), recording, bundle, tmp_path)
    for step, point_record in zip(summary["steps"], recording.records(PrcPoint), strict=True):
        assert point_record.measured is not None
        assert point_record.twin is not None
        assert step["measured"] == json.loads(json.dumps(asdict(point_record.measured)))
        assert step["twin"] == json.loads(json.dumps(asdict(point_record.twin)))


def test_without_processes_there_is_no_latency(
    recording: Recording, bundle: RunConfig, tmp_path: Path
) -> None:
    timing = summary_of(list(recording.items), recording, bundle, tmp_path)["timing"]
    assert timing["latency_ms"] == {"p50": None, "p99": None, "max": None}
    assert timing["missed_deadlines"] is None


def test_the_last_timing_of_each_component_counts(
    recording: Recording, bundle: RunConfig, tmp_path: Path
) -> None:
    timings = [
        Timing(index, component, 1.0, 2.0, float(index), missed, 100, 0.1, "normal")
        for index, component, missed in ((100, "twin", 1), (200, "twin", 3), (200, "rig", 4))
    ]
    timing = summary_of([*recording.items, *timings], recording, bundle, tmp_path)["timing"]
    assert timing["latency_ms"]["max"] == 200.0
    assert timing["missed_deadlines"] == 7


# Comparison


def test_nrmse_is_that_of_the_samples(recording: Recording, bundle: RunConfig) -> None:
    """Directly from the recorded samples, over those that both have."""
    comparison = summarise(recording, bundle.parameters).comparison
    measured = recording.contiguous_blocks("meas")[0]
    predicted = recording.contiguous_blocks("pred")[0]
    u = measured.channel("mass_disp_m") - measured.channel("table_disp_m")
    # comparisons know whole cells of 20 samples; the first restart is at 250
    cells = slice(260, 20 * (len(measured) // 20))
    for name in COMPARED_CHANNELS:
        x = (u if name == "rel_disp_m" else measured.channel(name))[cells]
        for track, key in (("window", "nrmse"), ("free", "free_nrmse")):
            error = x - predicted.channel(f"{track}/{name}")[cells]
            # the motion of the table is measured: only that relative to it is a prediction
            size = u[cells] if name == "mass_disp_m" else x
            want = math.sqrt((error**2).sum() / (size**2).sum())
            assert getattr(comparison[name], key) == pytest.approx(want, rel=1e-9)
        # white noise of the card would leave this of a perfect model
        at_rest = np.cumsum(measured.label != Label.REST) == 0
        lasers = np.array([measured.channel(n)[at_rest] for n in ("mass_disp_m", "table_disp_m")])
        noise = measured.channel(name)[at_rest].std() if "acc" in name or "force" in name else (
            math.hypot(*lasers.std(axis=1))
        )  # fmt: skip
        floor = noise * math.sqrt(x.size / (size**2).sum())
        assert comparison[name].noise_floor == pytest.approx(floor, rel=0.2)


def test_a_lost_channel_is_null_and_the_others_stay(
    recording: Recording, bundle: RunConfig, tmp_path: Path
) -> None:
    place = COMPARED_CHANNELS.index("force_r1_n")
    items: list[Item] = []
    for item in recording.items:
        if isinstance(item, Comparison):
            sums = list(item.measured_ss)
            sums[place] = math.nan
            items.append(replace(item, measured_ss=tuple(sums)))
        else:
            items.append(item)
    comparison = summary_of(items, recording, bundle, tmp_path)["comparison"]
    whole = summarise(recording, bundle.parameters).comparison
    assert comparison["force_r1_n"] == dict.fromkeys(("nrmse", "free_nrmse", "noise_floor"))
    assert comparison["force_r2_n"] == whole["force_r2_n"].to_plain()


def test_load_cells_without_bumpers_have_nothing_to_compare(
    recording: Recording, bundle: RunConfig
) -> None:
    parameters = replace(bundle.parameters, gap_r=math.inf)
    comparison = summarise(recording, parameters).comparison
    for name in CELLS[:2]:
        assert comparison[name] == ChannelError(nrmse=None, free_nrmse=None, noise_floor=None)
    for name in (*CELLS[2:], "rel_disp_m"):
        assert (comparison[name].nrmse or 0.0) > 0


# Jumps and hysteresis


def test_summary_has_jumps_and_hysteresis_of_table_and_twin(
    recording: Recording, bundle: RunConfig, tmp_path: Path
) -> None:
    points = as_points([0.1, 0.2, 0.3, 0.4, 0.05], [0.1, 0.06, 0.06, 0.05, 0.05])
    summary = summary_of([*without(recording, PrcPoint), *points], recording, bundle, tmp_path)
    assert summary["hysteresis"] == [{"kind": "right", "from_hz": 2.1, "to_hz": 2.3}]
    assert summary["jumps"] == [
        {"direction": "forward", "from_hz": 2.3, "to_hz": 2.4, "kind": "down"},
        {"direction": "backward", "from_hz": 2.1, "to_hz": 2.0, "kind": "up"},
    ]
    assert summary["twin_hysteresis"] == summary["hysteresis"]
    assert summary["steps"][0]["measured"]["impacts_left"] == [1, 2]


def test_no_hysteresis_is_an_empty_list(
    recording: Recording, bundle: RunConfig, tmp_path: Path
) -> None:
    points = as_points([0.1, 0.2, 0.3], [0.1, 0.2, 0.3])
    summary = summary_of([*without(recording, PrcPoint), *points], recording, bundle, tmp_path)
    assert summary["hysteresis"] == summary["jumps"] == []


# What is missing


def test_a_dead_twin_leaves_what_was_measured(
    recording: Recording, bundle: RunConfig, tmp_path: Path
) -> None:
    """Dead over the second step: its measured part is made from the samples, its twin is null."""
    cycles = {cycle.step: cycle for cycle in recording.records(CycleExtremes)}
    dead = (cycles[0].index + 250, cycles[1].index + 100)
    fault = Fault(dead[1], "twin", *dead, "the process died and was restarted")
    kept = [
        item
        for item in recording.items
        if not (isinstance(item, (PrcPoint, CycleExtremes)) and item.step == 1)
        and not (isinstance(item, Comparison) and dead[0] <= item.index < dead[1])
    ]
    summary = summary_of([*kept, fault], recording, bundle, tmp_path)
    assert [step["index"] for step in summary["steps"]] == [0, 1, 2, 3]
    whole = summarise(recording, bundle.parameters).to_plain()["steps"]
    assert summary["steps"][1]["twin"] is None
    assert summary["steps"][1]["measured"] == json.loads(json.dumps(whole[1]["measured"]))
    assert summary["steps"][1]["thd"] == whole[1]["thd"]
    assert summary["steps"][0]["twin"] is not None
    assert summary["faults"][0]["from_index"] == dead[0]


def test_a_stopped_run_without_a_point(bundle: RunConfig, tmp_path: Path) -> None:
    play_unpaced(bundle, "two", tmp_path / "run.mcap", lambda: "asked to stop", lambda item: None)
    recording = read_recording(tmp_path / "run.mcap")
    assert not recording.records(PrcPoint)
    summary = summary_of(list(recording.items), recording, bundle, tmp_path)
    assert summary["verdict"] == "stopped"
    assert summary["reason"] == "asked to stop"
    assert summary["steps"] == summary["jumps"] == summary["hysteresis"] == []
    assert recording.stop is not None
    assert summary["run"]["samples"] == recording.stop.index


def test_a_recording_without_an_end_says_so(
    recording: Recording, bundle: RunConfig, tmp_path: Path
) -> None:
    begun = drop_measured(without(recording, RunStop), 3000, 2**62)
    kept = [item for item in begun if item.index < 3000]
    summary = summary_of(kept, recording, bundle, tmp_path)
    assert summary["verdict"] == "halted"
    assert summary["reason"] == "the recording ends without a stop record"
    assert summary["run"]["samples"] == 3000
    assert summary["run"]["duration_s"] == 3.0
    assert summary["lost_samples"] == 0


def test_a_recording_of_its_start_alone(
    recording: Recording, bundle: RunConfig, tmp_path: Path
) -> None:
    summary = summary_of([recording.start], recording, bundle, tmp_path)
    assert summary["run"]["samples"] == 0
    assert summary["steps"] == []
    assert summary["comparison"] == {}


def test_gaps_and_lost_samples_are_counted(
    recording: Recording, bundle: RunConfig, tmp_path: Path
) -> None:
    gaps: list[Record] = [
        SampleGap(1500, 5, "mass_disp_m", "lost"),
        SampleGap(2000, 2, "", "clipped"),
    ]
    assert summary_of([*recording.items, *gaps], recording, bundle, tmp_path)["gaps"] == 2
    kept = list(drop_measured(recording.items, 1500, 1600))
    (tmp_path / "holed").mkdir()
    summary = summary_of(kept, recording, bundle, tmp_path / "holed")
    assert summary["gaps"] == 1
    assert summary["lost_samples"] == 100


def test_what_is_no_number_is_null() -> None:
    text = format_json(
        {"a": math.nan, "b": [math.inf, {"c": (-math.inf, 1.0)}], "d": np.float64("nan")}
    )
    assert strict(text) == {"a": None, "b": [None, {"c": [None, 1.0]}], "d": None}


def test_points_of_a_lost_sensor_are_null_not_zero(
    recording: Recording, bundle: RunConfig, tmp_path: Path
) -> None:
    values = NormalizedResponse(0.1, math.nan, 0.02, 0.0, math.nan, 0.0, (), (), 0.0, 0.0)
    lone_point = replace(point(0, "forward", 3.4, 0.1, None), measured=values, thd=math.nan)
    items = [*without(recording, PrcPoint, Event), lone_point]
    (step,) = summary_of(items, recording, bundle, tmp_path)["steps"]
    assert step["measured"]["eta_a"] is None
    assert step["measured"]["r_r"] is None
    assert step["measured"]["impacts_right"] == []
    assert step["thd"] is None
    assert step["twin"] is None


def test_a_lost_start_record_is_taken_from_its_copy(recording: Recording, tmp_path: Path) -> None:
    write_items(tmp_path / "run.mcap", without(recording, RunStart), recording.start)
    again = read_recording(tmp_path / "run.mcap")
    assert again.start == recording.start
    (damage,) = again.damage
    assert "/run/start: lost" in damage.reason


def test_a_summary_that_is_read_again_is_written_as_it_was(
    recording: Recording, bundle: RunConfig, tmp_path: Path
) -> None:
    path, again = tmp_path / "summary.json", tmp_path / "again.json"
    summarise(recording, bundle.parameters).write(path)
    RunSummary.read(path, "").write(again)
    assert again.read_text() == path.read_text()


def test_a_key_that_the_contract_does_not_know_is_not_written(
    recording: Recording, bundle: RunConfig
) -> None:
    plain = summarise(recording, bundle.parameters).to_plain()
    step = {**plain["steps"][0], "mood": "good"}
    for wrong in ({**plain, "steps": [step]}, {**plain, "mood": "good"}):
        with pytest.raises(ValidationError):
            RunSummary.model_validate(wrong)
