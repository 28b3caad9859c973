"""The view shows the samples that were sent, at their times, however they were cut."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from table_io.block import Block
from table_io.errors import InputError
from table_io.records import PrcPoint
from tests.input_errors import raises_input_error
from tests.viewer.example_run import (
    RATE_HZ,
    SAMPLE_COUNT,
    STEPS,
    blocks,
    content,
    recording,
    records,
    samples,
    scalars,
    start,
)
from twin.viewer.plots import FrequencyCurves
from twin.viewer.view import RerunView, write_rrd

LINE_STRIDE = 4  # lines are drawn with 500 points per second


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
        drawn = np.arange(0, SAMPLE_COUNT, LINE_STRIDE)
        assert np.array_equal(np.rint(times * 1e9), np.rint(drawn * (1e9 / RATE_HZ))), entity
        assert np.array_equal(values, np.stack(columns, axis=1)[drawn]), entity


def test_every_record_is_shown(whole: Path) -> None:
    shown = content(whole)
    texts = [row[0] for row in shown["/events"]["TextLog:text"][1]]
    assert len(texts) == 7  # the warning once, though it was said twice
    assert any("20 samples of all channels late" in text for text in texts)
    assert any("0.450 s to 0.500 s: killed" in text for text in texts)
    assert "    6.0 s  complete: played" in texts
    assert scalars(whole, "/latency/a\\ b\\/c")[1].tolist() == [[1.0, 2.0, 3.0]]
    counts = scalars(whole, "/impacts")[1]
    assert counts[:, :2].tolist() == [[1, 2]] * 3
    assert np.isnan(counts[:, 2:]).all()
    assert scalars(whole, "/error")[1] == pytest.approx(np.tile([50.0, 10.0], (12, 1)))
    assert len(shown["/status"]["TextDocument:text"][1]) == len(STEPS)
    assert "-4.00 … 4.00 | - |" in shown["/cycle"]["TextDocument:text"][1][0][0]
    assert "η_d" in shown["/point"]["TextDocument:text"][1][0][0]


def test_disagreement_estimates_and_the_jump_ahead(whole: Path) -> None:
    shown = content(whole)
    assert scalars(whole, "/disagreement/F\\ right")[1].tolist() == [[1.5], [2.0]]  # worse cell
    assert np.isnan(scalars(whole, "/disagreement/a")[1]).all()
    assert "/disagreement/u" not in shown  # no band, nothing to say
    assert scalars(whole, "/disagreement/band")[1].tolist() == [[1.0], [1.0]]
    assert scalars(whole, "/disagreement/warnings")[0].tolist() == [0.2, 0.45, 3.0]
    assert (
        "| force_r1_n | 2 | 1 | 2.00 | contact left |"
        in (shown["/agreement"]["TextDocument:text"][1][1][0])
    )
    assert scalars(whole, "/drift/stiffness")[1] == pytest.approx(np.array([[1.0, 1.4, 0.6]]))
    assert scalars(whole, "/drift/damping")[1] == pytest.approx(np.array([[0.0, 2.0, -2.0]]))
    assert scalars(whole, "/gaps/gap_r")[1] == pytest.approx(np.array([[0.02, 0.04, 0.0]]))
    marks = shown["/prc/ahead"]["LineStrips2D:strips"][1]
    assert [len(row) for row in marks] == [2, 0]  # the end at 9 Hz is off the axes
    axes = FrequencyCurves(0.5, 5.0).axes
    places = [axes.origin[0] + axes.scale[0] * hz for hz in (2.3, 2.4)]
    assert [strip[0][0] for strip in marks[0]] == pytest.approx(places, rel=1e-5)
    document = shown["/ahead"]["TextDocument:text"][1]
    assert "down at 2.4 Hz" in document[1][0]
    assert "0.4 Hz ahead" in document[1][0]
    assert document[2][0].startswith("none forward")
    assert "u left its band" in shown["/warning"]["TextDocument:text"][1][-1][0]


def test_repeated_items_are_drawn_once(tmp_path: Path) -> None:
    items = recording([*blocks(), *records()]).items
    again = [item for item in items if isinstance(item, PrcPoint)]
    for name, fed in (("once", items), ("twice", [*items[:300], *items, *again])):
        view = RerunView(start(), save=tmp_path / f"{name}.rrd")
        for first in range(0, len(fed), 100):
            view.feed(fed[first : first + 100])
        view.close()
    for entity in ("/u/measured", "/a/twin", "/error", "/u/scale"):
        for whole_values, two in zip(
            scalars(tmp_path / "once.rrd", entity),
            scalars(tmp_path / "twice.rrd", entity),
            strict=True,
        ):
            assert np.array_equal(whole_values, two, equal_nan=True), entity
    curves = content(tmp_path / "twice.rrd")["/prc/data/measured"]["LineStrips2D:strips"][1]
    assert [len(strip) for strip in curves[-1]] == [2, 1]


def test_component_test_shows_the_force_on_the_motion(tmp_path: Path) -> None:
    labels = tuple(np.zeros(400, dtype=np.int64) for _ in range(3))
    t = np.arange(400) / RATE_HZ
    u, acc = 1e-3 * np.sin(20 * t), np.cos(20 * t)
    names = ("rel_disp_m", "table_disp_m", "damper_force_n")
    begin = replace(start("inf"), channels=(*names, "oil_c"))
    view = RerunView(begin, save=tmp_path / "v.rrd")
    view.feed([Block("meas", 0, RATE_HZ, names, np.stack([u, 0 * u, 40 * t]), *labels)])
    cells = (f"{track}/force_{side}1_n" for track in ("free", "window") for side in "rl")
    channels = ("free/mass_acc_m_s2", "window/mass_acc_m_s2", "window/rel_disp_m", *cells)
    zero = 0 * u
    twin = np.stack([2 * acc, acc, u, zero, zero, zero, zero])
    view.feed([Block("pred", 0, RATE_HZ, channels, twin, *labels)])
    view.close()
    assert scalars(tmp_path / "v.rrd", "/damper/measured")[1][:, 0] == pytest.approx(
        0.04 * t[::LINE_STRIDE]
    )
    forces = scalars(tmp_path / "v.rrd", "/damper/twin")[1]
    assert forces == pytest.approx(np.stack([-0.55 * 2 * acc, -0.55 * acc], axis=1)[::LINE_STRIDE])
    strip = content(tmp_path / "v.rrd")["/loop/data/measured"]["LineStrips2D:strips"][1][0][0]
    assert np.allclose(strip, np.stack([1e3 * u, 0.04 * t], axis=1)[0:101:5], atol=1e-6)
    assert len(content(tmp_path / "v.rrd")["/rig/bodies"]["Boxes3D:centers"][1][0]) == 2


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
    at = np.rint(np.array(times) * RATE_HZ / 1e9).astype(int)
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
    whole, two = content(tmp_path / "whole.rrd"), content(tmp_path / "fed.rrd")
    assert set(whole) == set(two)
    for entity in whole:
        assert repr(whole[entity]) == repr(two[entity]), entity


def test_a_short_dropout_interrupts_the_line(tmp_path: Path) -> None:
    dropped = blocks()
    values = dropped[50].values.copy()
    values[:, 5:8] = np.nan  # samples 505 to 507, none of which is drawn
    dropped[50] = replace(dropped[50], values=values)
    write_rrd(recording(dropped), tmp_path / "gap.rrd")
    times, drawn = scalars(tmp_path / "gap.rrd", "/u/measured")
    assert np.rint(times[np.isnan(drawn[:, 0])] * RATE_HZ).tolist() == [504]


def test_lost_block_interrupts_the_line(tmp_path: Path) -> None:
    write_rrd(recording(blocks(skip=[50])), tmp_path / "gap.rrd")
    times, values = scalars(tmp_path / "gap.rrd", "/u/measured")
    index = np.rint(times * RATE_HZ).astype(int)
    assert index.size == (SAMPLE_COUNT - 20) / LINE_STRIDE + 1
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
    view.feed([Block("meas", 0, RATE_HZ, names, values, *labels)])
    known = ("mass_disp_m", "table_disp_m", "force_r1_n")
    view.feed([Block("meas", 20, RATE_HZ, known, lost, *labels)])
    view.feed([Block("pred", 0, RATE_HZ, ("free/rel_disp_m",), values[:1].copy(), *labels)])
    view.close()
    assert np.isnan(scalars(tmp_path / "v.rrd", "/u/measured")[1]).all()
    assert scalars(tmp_path / "v.rrd", "/other/oil\\/temp\\ c")[1].tolist() == [[41.0]] * 5
    twin = scalars(tmp_path / "v.rrd", "/u/twin")[1]
    assert np.array_equal(twin[:, 0], 1e3 * values[0, ::LINE_STRIDE])
    assert np.isnan(twin[:, 1]).all()


def test_view_overwrites_no_file_and_serves_on_loopback_only(tmp_path: Path) -> None:
    existing = tmp_path / "there.rrd"
    existing.write_text("mine")
    with raises_input_error(where=existing):
        RerunView(start(), save=existing)
    assert existing.read_text() == "mine"
    with raises_input_error(where=tmp_path / "no" / "folder.rrd"):
        RerunView(start(), save=tmp_path / "no" / "folder.rrd")
    for address in ("0.0.0.0:9000", "127.0.0.1", "127.0.0.1:x", "127.0.0.1:0", "lab:9000"):
        with pytest.raises(InputError) as refused:
            RerunView(start(), save=tmp_path / "new.rrd", serve=address)
        assert refused.value.value == address
        assert "127.0.0.1:PORT" in refused.value.allowed
    assert not (tmp_path / "new.rrd").exists()
