"""The Python door: what it hands out is what stands in the log, sample by sample."""

import ast
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import twin.log
from table_io.block import Block, Label
from table_io.channels import relative_displacement
from table_io.records import CycleExtremes, Event, PrcPoint, StepAdded
from tests.input_errors import raises_input_error
from twin.log import ChannelMap, Log, open_log
from twin.recording.mcap_log import write_items
from twin.recording.reader import Recording, read_recording
from twin.setup.run_config import RunConfig


@pytest.fixture(scope="module")
def folder(log_file: Path) -> Path:
    return log_file.parent


@pytest.fixture(scope="module")
def log(folder: Path) -> Log:
    return open_log(folder)


def test_channels_are_those_of_the_log_to_the_bit(log: Log, recording: Recording) -> None:
    (meas,), (pred,) = recording.contiguous_blocks("meas"), recording.contiguous_blocks("pred")
    assert log.channels == (*meas.channels, "rel_disp_m")
    u_m = meas.channel("mass_disp_m") - meas.channel("table_disp_m")
    assert log["rel_disp_m"].tobytes() == u_m.tobytes()
    for name in meas.channels:
        assert log[name].tobytes() == meas.channel(name).tobytes()
    for track, values in (("free", log.twin), ("window", log.window)):
        for name in values:
            assert values[name].tobytes() == pred.channel(f"{track}/{name}").tobytes()
    assert log.time_s.tobytes() == meas.time_s.tobytes()
    for mine, theirs in (
        (log.step_index, meas.step), (log.label, meas.label), (log.cycle, meas.cycle),
    ):  # fmt: skip
        assert np.array_equal(mine, theirs)
    with pytest.raises(ValueError, match="read-only"):
        log["mass_disp_m"][0] = 0.0


def test_a_step_is_its_samples(log: Log, recording: Recording) -> None:
    (meas,) = recording.contiguous_blocks("meas")
    inside = meas.step == 3
    step = log.step(3)
    assert step.step == recording.start.steps[3]
    assert np.array_equal(step["mass_acc_m_s2"], meas.channel("mass_acc_m_s2")[inside])
    assert np.array_equal(step.time_s, meas.time_s[inside])
    assert len(step.twin["rel_disp_m"]) == len(step) == inside.sum()
    held = inside & (meas.label == Label.MEASURE)
    assert np.array_equal(step.held["mass_disp_m"], meas.channel("mass_disp_m")[held])
    assert set(step.held.cycle.tolist()) == {2, 3}
    assert step.point == recording.records(PrcPoint)[3]
    assert step.cycles == tuple(c for c in recording.records(CycleExtremes) if c.step == 3)
    with pytest.raises(KeyError, match=r"step 6;.* 0 to 5"):
        log.step(6)


def test_a_log_and_a_step_are_walked_as_a_dict_of_channels(log: Log) -> None:
    step = log.step(1)
    for view in (log, step, step.held, log.measured, step.measured, step.twin):
        assert "mass_disp_m" in view
        assert "no_such_channel" not in view
        assert 0 not in view
        assert list(view) == list(view.keys())
    assert list(log) == list(log.keys()) == list(step) == list(log.channels)
    assert dict(log).keys() == set(log.channels)
    assert {name: len(values) for name, values in dict(step).items()} == dict.fromkeys(
        log.channels, len(step)
    )


def test_a_track_of_a_step_is_that_of_the_log(log: Log) -> None:
    """Whatever source it is of: `measured` means the same for both."""
    step = log.step(3)
    for name in ("measured", "twin", "window"):
        whole, part = getattr(log, name), getattr(step, name)
        assert type(part) is type(whole) is ChannelMap
        values = whole["mass_disp_m"][step.samples]
        assert np.array_equal(part["mass_disp_m"], values, equal_nan=True)


def test_the_held_cycles_give_the_recorded_point(log: Log) -> None:
    """eta_d from the arrays alone: half the swing of u, without its noise, over u*."""
    ratios = []
    for step in (log.step(1), log.step(4)):
        part, point = step.held, step.held.point
        assert point is not None
        assert point.measured is not None
        u = part["mass_disp_m"] - part["table_disp_m"]
        angle = 2 * np.pi * point.frequency_hz / log.rate_hz * np.arange(u.size)
        waves = np.exp(1j * np.outer(np.arange(13), angle))
        columns = np.concatenate([waves.real, waves.imag[1:]]).T
        smooth = columns @ np.linalg.lstsq(columns, u, rcond=None)[0]
        ratios.append(0.5 * np.ptp(smooth) / point.measured.eta_d)
    assert ratios[1] == pytest.approx(ratios[0], rel=2e-3)


def test_curves_events_and_what_the_run_was_made_with(
    log: Log, recording: Recording, bundle: RunConfig
) -> None:
    points = recording.records(PrcPoint)
    assert log.points == points
    assert log.prc["direction"].tolist() == ["forward"] * 3 + ["backward"] * 3
    assert log.prc["frequency_hz"].tolist() == [point.frequency_hz for point in points]
    for name, source in (("eta_d", "measured"), ("twin_r_l", "twin")):
        key = name.removeprefix("twin_")
        assert log.prc[name].tolist() == [getattr(getattr(p, source), key) for p in points]
    assert log.events == recording.records(Event)
    assert log.stop == recording.stop
    assert log.whole
    assert log.profile == bundle.profile
    assert log.rig == bundle.rig
    assert log.model.flatten() == bundle.model.flatten()
    assert [step.index for step in log.steps] == list(range(6))
    assert log.units["force_r1_n"] == "N"
    assert log.units["rel_vel_m_s"] == "m/s"
    text = repr(log)
    assert all(part in text for part in ("Across the down-jump", "1000 Hz", "6 steps", "mass_disp"))
    assert "2.4 Hz forward" in repr(log.step(0))


def test_opening_reads_the_start_only(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And the first look at a stream reads that stream alone, once."""
    asked: list[tuple[str, ...]] = []

    def count_reads(path: Path, topics: tuple[str, ...]) -> Recording:
        asked.append(tuple(topics))
        return read_recording(path, topics)

    monkeypatch.setattr(twin.log, "read_recording", count_reads)
    log = open_log(folder)
    assert "mass_disp_m" in repr(log)
    assert asked == []
    assert log["mass_disp_m"] is not None
    assert log["force_r1_n"] is not None
    assert log.label.size
    assert asked == [("/rig/meas",)]
    assert log.twin["rel_disp_m"] is not None
    assert log.window["rel_disp_m"] is not None
    assert asked == [("/rig/meas",), ("/twin/pred",)]


def test_a_gap_is_nan_on_the_one_axis(recording: Recording, tmp_path: Path) -> None:
    """Neither sample nor label is invented, and the axis stays even."""
    lost = {"meas": (2000, 2100), "pred": (1500, 2500)}
    kept = [
        item for item in recording.items
        if not isinstance(item, Block) or item.end <= lost[item.stream][0]
        or item.index >= lost[item.stream][1]
    ]  # fmt: skip
    write_items(tmp_path / "run.mcap", kept, recording.start)
    log = open_log(tmp_path)
    (meas,), (pred,) = recording.contiguous_blocks("meas"), recording.contiguous_blocks("pred")
    gap = slice(2000, 2100)
    expected = meas.channel("mass_disp_m").copy()
    expected[gap] = np.nan
    assert np.array_equal(log["mass_disp_m"], expected, equal_nan=True)
    expected = pred.channel("free/rel_disp_m").copy()
    expected[1500:2500] = np.nan
    assert np.array_equal(log.twin["rel_disp_m"], expected, equal_nan=True)
    for labels in (log.step_index, log.label, log.cycle):
        assert (labels[gap] == -1).all()
    assert np.allclose(np.diff(log.time_s), 1e-3, rtol=0, atol=1e-12)
    assert log.time_s.size == len(meas)


def test_added_step_is_a_step(recording: Recording, tmp_path: Path) -> None:
    """The last step as a visit: not in the plan, told by a record."""
    start = replace(recording.start, steps=recording.start.steps[:-1])
    last = recording.start.steps[-1]
    added_step = StepAdded(100, last.index, last.direction, last.frequency_hz, 0.49, "tracked")
    items = [start if item is recording.start else item for item in recording.items]
    write_items(tmp_path / "run.mcap", [*items, added_step], start)
    log = open_log(tmp_path / "run.mcap")
    assert [step.index for step in log.steps] == list(range(6))
    assert log.step(5).step.frequency_hz == last.frequency_hz


def test_missing_log_is_refused(tmp_path: Path) -> None:
    for place in (tmp_path, tmp_path / "none.mcap"):
        with raises_input_error(where=place, remedy="run.mcap"):
            open_log(place)
    (tmp_path / "run.mcap").write_text("time_s,mass_disp_m\n")
    with raises_input_error(where=tmp_path / "run.mcap", remedy="run.mcap"):
        open_log(tmp_path)


def test_a_log_that_was_cut_off_opens(folder: Path, recording: Recording, tmp_path: Path) -> None:
    whole = (folder / "run.mcap").read_bytes()
    (tmp_path / "run.mcap").write_bytes(whole[: len(whole) // 2])
    log = open_log(tmp_path)
    assert not log.whole
    count = log["mass_disp_m"].size
    (meas,) = recording.contiguous_blocks("meas")
    assert 1000 < count < len(meas)
    assert np.array_equal(log["mass_disp_m"], meas.channel("mass_disp_m")[:count])


# xarray


def test_the_dataset_has_every_channel_with_its_unit(log: Log, recording: Recording) -> None:
    pytest.importorskip("xarray")
    data = log.to_xarray()
    (meas,), (pred,) = recording.contiguous_blocks("meas"), recording.contiguous_blocks("pred")
    assert set(data.data_vars) == {
        *log.channels, *(f"twin_{name.replace('/', '_')}" for name in pred.channels)
    }  # fmt: skip
    assert data.mass_acc_m_s2.values.tobytes() == meas.channel("mass_acc_m_s2").tobytes()
    name = "window/force_l2_n"
    assert data.twin_window_force_l2_n.values.tobytes() == pred.channel(name).tobytes()
    assert data.twin_window_force_l2_n.attrs["units"] == "N"
    assert data.table_acc_m_s2.attrs["positive"] == "right"
    assert data.attrs["title"] == "Across the down-jump and back"
    chosen = data.where(data.step == 2, drop=True)
    assert np.array_equal(chosen.mass_disp_m.values, log.step(2)["mass_disp_m"])
    part = log.step(2).to_xarray()
    assert np.array_equal(part.time.values, log.step(2).time_s)
    u = (data.mass_disp_m - data.table_disp_m).values
    assert np.array_equal(u, relative_displacement(meas))


def test_to_xarray_without_xarray_names_the_extra(
    log: Log, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "xarray", None)
    with raises_input_error(remedy='"shaketwin[notebook]"'):
        log.to_xarray()


def test_every_line_of_the_docstring_works(log: Log) -> None:
    """Each expression of its table, on a real log."""
    lines = [line for line in (twin.log.__doc__ or "").splitlines() if line.startswith("| `")]
    assert len(lines) > 8
    for line in lines:
        for text in line.split("|")[1].split(","):
            source = text.strip().strip("`").replace("step(12)", "step(2)")
            ast.parse(source)
            assert eval(source, {"log": log}) is not None
