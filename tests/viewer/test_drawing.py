"""What is drawn: trails, boxes, axes; plain arrays, no viewer."""

import numpy as np
import pytest

from table_io.block import Block, join_contiguous
from tests.viewer.example_run import RATE_HZ, SAMPLE_COUNT, blocks
from twin.viewer.motion import Trail, extract_motion
from twin.viewer.plots import AxisRange, PlotAxes
from twin.viewer.scaled_plots import WindowPeaks, next_power_of_ten
from twin.viewer.scene import Scene


def test_trail_is_the_same_for_any_cut_and_knows_the_slope() -> None:
    trails = []
    for size in (20, 7, 500):
        trail = Trail(100, 5, 10)
        whole = [block for block in blocks(size) if block.stream == "meas"]
        trails.append(
            [strip for block in whole for strip in trail.add(extract_motion(block), RATE_HZ)]
        )
    assert len(trails[0]) == SAMPLE_COUNT // 100 - 2
    for other in trails[1:]:
        for (end, strip), (same_end, same) in zip(trails[0], other, strict=True):
            assert end == same_end
            assert np.array_equal(strip, same)
    index = np.arange(100, 201, 5)
    v = 16e-3 * np.pi * np.cos(4 * np.pi * index / RATE_HZ + 1)
    assert trails[0][0][1][:, 1] == pytest.approx(1e3 * v, rel=1e-3, abs=0.1)
    assert np.array_equal(trails[0][0][1][-1], trails[0][1][1][0])


def test_scene_keeps_contact_true_in_the_picture() -> None:
    scene = Scene((2e-3, 1e-3), 10.0, 5.0, 20.0)
    values = np.array([[0, 0, 0], [-3e-3, 0, 5e-3], [0, 0, 100.0], [50.0, 0, 0]])
    labels = tuple(np.zeros(3, dtype=np.int64) for _ in range(3))
    names = ("table_disp_m", "mass_disp_m", "force_r1_n", "force_l1_n")
    boxes = scene.body_boxes(extract_motion(Block("meas", 0, RATE_HZ, names, values, *labels)))
    mass, right, left = (boxes.centres[:, box, 0] for box in (1, 2, 3))
    half = boxes.half_sizes[:, :, 0]
    room_right = right - half[:, 2] - (mass + half[:, 1])
    room_left = mass - half[:, 1] - (left + half[:, 3])
    assert room_right == pytest.approx([20 * 5e-3, 20 * 2e-3, 0])
    assert room_left == pytest.approx([0, 20 * 1e-3, 20 * 6e-3])


def test_axes_and_axis_range() -> None:
    axes = PlotAxes((-2.0, 2.0), (0.0, 0.4), "x", "y", 2.2)
    assert axes.ticks(0.0, 0.4) == pytest.approx([0, 0.1, 0.2, 0.3, 0.4])
    (places, texts), (sx, sy), (ox, oy) = axes.labels(), axes.scale, axes.origin
    assert texts[:5] == ["-2", "-1", "0", "1", "2"]
    assert (ox + sx * -2.0, oy + sy * 0.4) == pytest.approx((0.0, 0.0))
    assert (ox + sx * 2.0, oy) == pytest.approx((axes.width, axes.HEIGHT))
    assert len(places) == len(texts)
    assert len(axes.vertical_lines([0.0, 3.0, float("inf")])) == 1
    reach = AxisRange(1.0, 3)
    assert [reach.update(peak) for peak in (0.5, 4.0, 4.0, 0.5, 0.5, 0.5)] == [False, True] + [
        False
    ] * 3 + [True]
    assert reach.value == 1.0


def test_pieces_end_where_samples_are_missing() -> None:
    kept = [block for block in blocks(skip=[3]) if block.stream == "meas"]
    assert [(block.index, block.end) for block in join_contiguous(kept)] == [
        (0, 60),
        (80, SAMPLE_COUNT),
    ]


def test_peaks_are_the_same_for_any_cut_and_stretch_an_axis_without_numbers() -> None:
    values = np.array([[1.0, -5.0, 2.0, np.nan, 3.0, 1.0, 7.0], [0.0] * 7])
    extremes = []
    for cut in (1, 2, 7):
        peaks = WindowPeaks(2)
        parts = [slice(first, first + cut) for first in range(0, 7, cut)]
        index = np.arange(4, 11)
        extremes.append([add for part in parts for add in peaks.add(index[part], values[:, part])])
        assert [(end, high.tolist()) for end, high in extremes[-1]] == [
            (6, [5.0, 0.0]), (8, [2.0, 0.0]), (10, [3.0, 0.0]),
        ]  # fmt: skip
    assert [next_power_of_ten(peak) for peak in (0.9, 6.0, 10.0)] == [1.0, 10.0, 10.0]
    assert all(np.isnan(next_power_of_ten(peak)) for peak in (0.0, 0.5, 4.0))


def test_a_rig_with_one_bumper_has_one() -> None:
    scene = Scene((2e-3, float("inf")), 10.0, 5.0, 20.0)
    labels = tuple(np.zeros(1, dtype=np.int64) for _ in range(3))
    values = np.array([[0.0], [3e-3]])
    moves = extract_motion(
        Block("meas", 0, RATE_HZ, ("table_disp_m", "mass_disp_m"), values, *labels)
    )
    assert scene.body_boxes(moves).centres.shape == (1, 3, 3)
    assert scene.caption_texts(550.0) == ["mass 550 kg", "table", "right bumper"]
    assert np.isfinite(scene.caption_positions(moves)).all()
