"""The view shows the samples that were sent, at their times, however they were cut."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rerun.chunk import RrdReader

from table_io.block import Block, Label
from table_io.card import PROFILES, BadInput
from table_io.channels import BY_NAME
from table_io.records import (
    Comparison,
    Cycle,
    Event,
    Extremes,
    Fault,
    Gap,
    Params,
    Point,
    Quantities,
    Record,
    RunStart,
    RunStop,
    Step,
    Timing,
)
from twin.compare import PREDICTED
from twin.stream import rerun_view
from twin.stream.recording import Recording
from twin.stream.rerun_layout import Axes, Reach, Scene, Trail, motion, pieces
from twin.stream.rerun_view import RerunView, open_viewer, screenshot, write_rrd

RATE = 2000.0
SAMPLES = 12000
STEPS = (
    Step(0, "forward", 2.0, 0.49),
    Step(1, "forward", 2.5, 0.49),
    Step(2, "backward", 2.0, 0.49),
)
MEASURED = tuple(BY_NAME)[:9]


def start(gap_mm: str = "4.0") -> RunStart:
    profile = (
        (PROFILES / "tests/g4_ss3.toml").read_text().replace("gap_mm = 4.0", f"gap_mm = {gap_mm}")
    )
    return RunStart(
        index=0, run="r1", name="synthetic", source="table", profile_toml=profile, rig_toml="",
        model_toml="", rate_hz=RATE, block_samples=20, channels=MEASURED, steps=STEPS,
        planned_samples=SAMPLES, tare={}, versions={}, host="here", started_at="", epoch_s=0.0,
    )  # fmt: skip


def samples() -> tuple[Any, Any]:
    """(measured, predicted) values (channel, sample): sines, and a force beyond the gap."""
    t = np.arange(SAMPLES) / RATE
    table, u = 2e-3 * np.sin(4 * np.pi * t), 4e-3 * np.sin(4 * np.pi * t + 1)
    right, left = 5e5 * np.clip(u - 2e-3, 0, None), 5e5 * np.clip(-u - 2e-3, 0, None)
    acc, v = -2.0 * np.sin(4 * np.pi * t + 1), np.gradient(u) * RATE
    cells = [right / 2, right / 2, left / 2, left / 2]
    measured = np.stack([table, table, 0.49 * np.sin(4 * np.pi * t), table + u, acc, *cells])
    track = np.stack([u, v, table + u, acc, *cells])
    return measured, np.concatenate([1.1 * track, track])


def blocks(size: int = 20, skip: Sequence[int] = ()) -> list[Block]:
    """Both streams, block by block; `skip` are the numbers of lost measured blocks."""
    measured, predicted = samples()
    step = np.minimum(np.arange(SAMPLES) * len(STEPS) // SAMPLES, len(STEPS) - 1)
    label = np.full(SAMPLES, Label.MEASURE, dtype=np.int64)
    found = []
    for number, first in enumerate(range(0, SAMPLES, size)):
        part = slice(first, first + size)
        labels = (step[part].copy(), label[part].copy(), np.zeros_like(step[part]))
        for name, names, values in (("meas", MEASURED, measured), ("pred", PREDICTED, predicted)):
            if name == "pred" or number not in skip:
                found.append(Block(name, first, RATE, names, values[:, part].copy(), *labels))
    return found


def records() -> list[Record]:
    nan = float("nan")
    extremes = Extremes(4e-3, -4e-3, 2.0, -2.0, 1000.0, 1000.0, (100,), (600, 700))
    found: list[Record] = [
        Event(10, "step", "2 Hz"),
        Gap(400, 20, "", "late"),
        Params(5, {}, "start"),
    ]
    for step in STEPS:
        end = (step.index + 1) * SAMPLES // len(STEPS)
        eta = 0.2 + 0.1 * step.index
        quantities = Quantities(eta, eta, eta, eta, eta, nan, (1, 1), (), 0.0, 0.0)
        twin = None if step.index == 1 else quantities
        point = (step.index, step.direction, step.frequency_hz, quantities, twin, 0.49, 0.49, 0.01)
        found += [Point(end, *point), Cycle(end, step.index, 0, 3, 1000, extremes, None)]
    found += [
        Comparison(k, 20, ("rel_disp_m",), (4.0,), (1.0,), (0.04,)) for k in range(0, SAMPLES, 20)
    ]
    found += [
        Fault(900, "twin", 900, 1000, "killed"),
        Timing(0, "a b/c", 1, 2, 3, 0, 9, 0.1, "other"),
    ]
    return [*found, RunStop(SAMPLES, "complete", "played")]


def recording(items: Sequence[Block | Record], begin: RunStart | None = None) -> Recording:
    begin = begin or start()
    ordered = sorted(items, key=lambda item: item.index)
    return Recording(Path("run.mcap"), "r1", begin, (begin, *ordered), True)


def content(path: Path) -> dict[str, dict[str, tuple[Any, Any]]]:
    """{entity: {component: (times in ns, rows as lists)}} of what changes over time."""
    found: dict[str, dict[str, list[tuple[int, Any]]]] = {}
    for chunk in RrdReader(path).stream():
        if chunk.is_static:
            continue
        batch = chunk.to_record_batch()
        times = batch.column("time").cast("int64").to_pylist()
        for name in batch.schema.names:
            if ":" in name:
                rows = found.setdefault(chunk.entity_path, {}).setdefault(name, [])
                rows.extend(zip(times, batch.column(name).to_pylist(), strict=True))
    return {
        entity: {name: tuple(zip(*rows, strict=True)) for name, rows in columns.items()}
        for entity, columns in found.items()
    }


def scalars(path: Path, entity: str) -> tuple[Any, Any]:
    """(times in s (row,), values (row, series)) of an entity."""
    times, rows = content(path)[entity]["Scalars:scalars"]
    return np.array(times) / 1e9, np.array(rows, dtype=np.float64)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("view") / "view.rrd"
    write_rrd(recording([*blocks(), *records()]), out)
    return out


def test_values_and_times_are_those_of_the_blocks(whole: Path) -> None:
    measured, predicted = samples()
    table, mass, force = measured[1], measured[3], measured[5] + measured[6]
    for entity, columns in {
        "/u/measured": [1e3 * (mass - table)],
        "/a/measured": [measured[4], measured[2]],
        "/force/measured": [1e-3 * force, -1e-3 * (measured[7] + measured[8])],
        "/u/twin": [1e3 * predicted[0], 1e3 * predicted[8]],
        "/a/twin": [predicted[3], predicted[11]],
        "/force/twin": [
            1e-3 * (predicted[12] + predicted[13]),
            -1e-3 * (predicted[14] + predicted[15]),
        ],
    }.items():
        times, values = scalars(whole, entity)
        assert np.array_equal(np.rint(times * RATE), np.arange(SAMPLES)), entity
        assert np.array_equal(np.rint(times * 1e9), np.rint(np.arange(SAMPLES) * (1e9 / RATE)))
        assert np.array_equal(values, np.stack(columns, axis=1)), entity


def test_every_record_is_shown(whole: Path) -> None:
    found = content(whole)
    texts = [row[0] for row in found["/events"]["TextLog:text"][1]]
    assert len(texts) == 5
    assert any("20 samples of all channels late" in text for text in texts)
    assert any("0.450 s to 0.500 s: killed" in text for text in texts)
    assert "complete: played" in texts
    assert scalars(whole, "/latency/a\\ b\\/c")[1].tolist() == [[1.0, 2.0, 3.0]]
    counts = scalars(whole, "/impacts")[1]
    assert counts[:, :2].tolist() == [[1, 2]] * 3
    assert np.isnan(counts[:, 2:]).all()
    assert scalars(whole, "/error")[1] == pytest.approx(np.tile([50.0, 10.0], (12, 1)))
    assert len(found["/status"]["TextDocument:text"][1]) == len(STEPS)
    assert "-4.00 … 4.00 | - |" in found["/cycle"]["TextDocument:text"][1][0][0]
    assert "η_d" in found["/point"]["TextDocument:text"][1][0][0]


def test_prc_grows_point_by_point(whole: Path) -> None:
    curves = content(whole)["/prc/data/measured"]["LineStrips2D:strips"][1]
    assert [[len(strip) for strip in row] for row in curves] == [[1], [2], [2, 1]]
    assert np.allclose(curves[-1][0], [[2.0, 0.2], [2.5, 0.3]])
    twin = content(whole)["/prc/data/twin"]["LineStrips2D:strips"][1]
    assert [[len(strip) for strip in row] for row in twin] == [[1], [1], [1, 1]]


def test_bumper_lights_up_in_contact_and_only_then(whole: Path) -> None:
    bodies = content(whole)["/rig/bodies"]
    times, colours = bodies["Boxes3D:colors"]
    lit = np.array([row[2] != row[3] for row in colours])
    at = np.rint(np.array(times) * RATE / 1e9).astype(int)
    measured = samples()[0]
    force = np.maximum(measured[5] + measured[6], measured[7] + measured[8])[at]
    assert np.array_equal(lit, force > 10.0)
    assert 0 < lit.sum() < lit.size


def test_batches_and_blocks_do_not_matter(tmp_path: Path) -> None:
    items = recording([*blocks(), *records()]).items
    write_rrd(recording(items[1:]), tmp_path / "whole.rrd")
    other = recording([*blocks(7), *records()]).items
    view = RerunView(start(), save=tmp_path / "fed.rrd")
    for first in range(0, len(other), 23):
        view.feed(other[first : first + 23])
    view.close()
    one, two = content(tmp_path / "whole.rrd"), content(tmp_path / "fed.rrd")
    assert set(one) == set(two)
    for entity in one:
        assert repr(one[entity]) == repr(two[entity]), entity


def test_a_lost_block_lifts_the_pen(tmp_path: Path) -> None:
    write_rrd(recording(blocks(skip=[50])), tmp_path / "gap.rrd")
    times, values = scalars(tmp_path / "gap.rrd", "/u/measured")
    index = np.rint(times * RATE).astype(int)
    assert index.size == SAMPLES - 19
    assert np.isnan(values[:, 0]).sum() == 1
    assert index[np.isnan(values[:, 0])] == 1000


@pytest.mark.parametrize("gap_mm", ["4.0", "inf", "-2.0"])
def test_missing_and_unknown_channels(tmp_path: Path, gap_mm: str) -> None:
    labels = tuple(np.full(20, -1, dtype=np.int64) for _ in range(3))
    names = ("table_disp_m", "oil/temp c")
    values = np.stack([np.linspace(0, 1e-3, 20), np.full(20, 41.0)])
    lost = np.full((3, 20), np.nan)
    view = RerunView(start(gap_mm), save=tmp_path / "v.rrd")
    view.feed([])
    view.feed([Block("meas", 0, RATE, names, values, *labels)])
    known = ("mass_disp_m", "table_disp_m", "force_r1_n")
    view.feed([Block("meas", 20, RATE, known, lost, *labels)])
    view.feed([Block("pred", 0, RATE, ("free/rel_disp_m",), values[:1].copy(), *labels)])
    view.close()
    assert np.isnan(scalars(tmp_path / "v.rrd", "/u/measured")[1]).all()
    assert scalars(tmp_path / "v.rrd", "/other/oil\\/temp\\ c")[1].tolist() == [[41.0]] * 20
    twin = scalars(tmp_path / "v.rrd", "/u/twin")[1]
    assert np.array_equal(twin[:, 0], 1e3 * values[0])
    assert np.isnan(twin[:, 1]).all()


def test_nothing_is_overwritten_and_nothing_leaves_this_machine(tmp_path: Path) -> None:
    there = tmp_path / "there.rrd"
    there.write_text("mine")
    with pytest.raises(BadInput, match="exists already"):
        RerunView(start(), save=there)
    assert there.read_text() == "mine"
    with pytest.raises(BadInput, match="cannot write"):
        RerunView(start(), save=tmp_path / "no" / "folder.rrd")
    for address in ("0.0.0.0:9000", "127.0.0.1", "127.0.0.1:x", "127.0.0.1:0", "lab:9000"):
        with pytest.raises(BadInput, match="this machine only"):
            RerunView(start(), save=tmp_path / "new.rrd", serve=address)
    assert not (tmp_path / "new.rrd").exists()


def free_port() -> int:
    with rerun_view.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def test_file_and_server_at_once(tmp_path: Path) -> None:
    port = free_port()
    view = RerunView(start(), save=tmp_path / "v.rrd", serve=f"127.0.0.1:{port}")
    with pytest.raises(BadInput, match="taken"):
        RerunView(start(), serve=f"127.0.0.1:{port}")
    view.feed(blocks()[:20])
    view.close()
    assert scalars(tmp_path / "v.rrd", "/u/measured")[0].size == 200


def test_without_a_display_it_says_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rerun_view.sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert "--bind 127.0.0.1" in open_viewer("rerun+http://127.0.0.1:9876/proxy")
    with pytest.raises(BadInput, match="no such file"):
        open_viewer(tmp_path / "none.rrd")
    monkeypatch.setattr(rerun_view, "find_spec", lambda _: None)
    with pytest.raises(BadInput, match="pip install rerun-sdk"):
        open_viewer("rerun+http://127.0.0.1:9876/proxy")


def test_the_picture(whole: Path, tmp_path: Path) -> None:
    image = pytest.importorskip("PIL.Image")
    try:
        complaints = screenshot(whole, tmp_path / "view.png", 4.0)
    except BadInput as error:
        pytest.skip(str(error))
    assert complaints == []
    picture = np.asarray(image.open(tmp_path / "view.png").convert("RGB")).astype(int)
    height, width = picture.shape[:2]
    red = (picture[..., 0] > 200) & (picture[..., 1] < 140) & (picture[..., 2] < 140)
    for rows in np.array_split(np.arange(int(0.8 * height)), 3):
        assert red[rows][:, width // 2 :].sum() > 100  # u, acceleration, force
    assert red[height // 3 :, : width // 3].sum() > 100  # PRC and phase plane
    assert np.unique(picture[: height // 3, : width // 3].reshape(-1, 3), axis=0).shape[0] > 50


def test_trail_is_the_same_for_any_cut_and_knows_the_slope() -> None:
    trails = []
    for size in (20, 7, 500):
        trail = Trail(100, 5, 10)
        whole = [one for one in blocks(size) if one.stream == "meas"]
        trails.append([strip for one in whole for strip in trail.add(motion(one), RATE)])
    assert len(trails[0]) == SAMPLES // 100 - 2
    for other in trails[1:]:
        for (end, strip), (same_end, same) in zip(trails[0], other, strict=True):
            assert end == same_end
            assert np.array_equal(strip, same)
    index = np.arange(100, 201, 5)
    v = 16e-3 * np.pi * np.cos(4 * np.pi * index / RATE + 1)
    assert trails[0][0][1][:, 1] == pytest.approx(1e3 * v, rel=1e-3, abs=0.1)
    assert np.array_equal(trails[0][0][1][-1], trails[0][1][1][0])


def test_scene_keeps_contact_true_in_the_picture() -> None:
    scene = Scene((2e-3, 1e-3), 10.0, 5.0, 20.0)
    values = np.array([[0, 0, 0], [-3e-3, 0, 5e-3], [0, 0, 100.0], [50.0, 0, 0]])
    labels = tuple(np.zeros(3, dtype=np.int64) for _ in range(3))
    names = ("table_disp_m", "mass_disp_m", "force_r1_n", "force_l1_n")
    boxes = scene.bodies(motion(Block("meas", 0, RATE, names, values, *labels)))
    mass, right, left = (boxes.centres[:, box, 0] for box in (1, 2, 3))
    half = boxes.halves[:, :, 0]
    room_right = right - half[:, 2] - (mass + half[:, 1])
    room_left = mass - half[:, 1] - (left + half[:, 3])
    assert room_right == pytest.approx([20 * 5e-3, 20 * 2e-3, 0])
    assert room_left == pytest.approx([0, 20 * 1e-3, 20 * 6e-3])


def test_axes_and_reach() -> None:
    axes = Axes((-2.0, 2.0), (0.0, 0.4), "x", "y")
    assert axes.ticks(0.0, 0.4) == pytest.approx([0, 0.1, 0.2, 0.3, 0.4])
    (places, texts), (sx, sy), (ox, oy) = axes.labels(), axes.scale, axes.origin
    assert texts[:5] == ["-2", "-1", "0", "1", "2"]
    assert (ox + sx * -2.0, oy + sy * 0.4) == pytest.approx((0.0, 0.0))
    assert (ox + sx * 2.0, oy) == pytest.approx((axes.WIDTH, axes.HEIGHT))
    assert len(places) == len(texts)
    assert len(axes.uprights([0.0, 3.0, float("inf")])) == 1
    reach = Reach(1.0, 3)
    assert [reach.see(peak) for peak in (0.5, 4.0, 4.0, 0.5, 0.5, 0.5)] == [False, True] + [
        False
    ] * 3 + [True]
    assert reach.value == 1.0


def test_pieces_end_where_samples_are_missing() -> None:
    kept = [one for one in blocks(skip=[3]) if one.stream == "meas"]
    assert [(one.index, one.end) for one in pieces(kept)] == [(0, 60), (80, SAMPLES)]
