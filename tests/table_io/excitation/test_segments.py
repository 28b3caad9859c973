"""Segments of a drive against their definition: integrals, derivatives, single samples."""

import math
from dataclasses import replace

import numpy as np
import pytest

from table_io.block import Float1D, Label
from table_io.excitation.drive import (
    MAX_BLEND_CURVATURE,
    MAX_BLEND_SLOPE,
    RAMP_CYCLES,
    RAMP_S,
    Correction,
    Drive,
    HistorySegment,
    Segment,
    peak_acceleration_ratio,
)

RATE_HZ = 1000.0
X = np.linspace(0.02, 0.98, 49)
BLENDS = (
    Segment(0, 700, Label.BLEND, 0, 2.0, 3.5, 0.6, 0.4, 0.2),
    Segment(0, 900, Label.BLEND, 0, 5.0, 1.5, 0.3, 0.7, 0.9),
    Segment(0, 600, Label.BLEND, 0, 4.0, 4.0, 0.0, 0.5, 0.0),
    Segment(0, 650, Label.BLEND, 0, 3.0, 3.0, 0.5, 0.0, 0.4),
    Segment(0, 800, Label.MEASURE, 0, 2.5, 2.5, 0.5, 0.5, 0.7, 2, 1),
)
every_blend = pytest.mark.parametrize("segment", BLENDS, ids=lambda s: f"{s.f0}-{s.f1}-{s.level0}")


def quintic(x: float) -> float:
    return 6.0 * x**5 - 15.0 * x**4 + 10.0 * x**3


def frequency_at(segment: Segment, x: float) -> float:
    return segment.f0 + (segment.f1 - segment.f0) * quintic(x)


def differentiate(before: tuple[Float1D, ...], step_s: float) -> Float1D:
    """Derivative by the five-point rule from values at -2, -1, 1, 2 steps."""
    a, b, c, d = before
    derivative: Float1D = (a - 8.0 * b + 8.0 * c - d) / (12.0 * step_s)
    return derivative


@every_blend
def test_phase_is_the_integral_of_the_frequency(segment: Segment) -> None:
    nodes, weights = np.polynomial.legendre.leggauss(4)  # exact up to the seventh degree
    for x in (0.0, *X, 1.0):
        turns = sum(
            0.5 * x * weight * frequency_at(segment, 0.5 * x * (1.0 + node))
            for node, weight in zip(nodes, weights, strict=True)
        )
        expected = segment.phase0 + segment.count / RATE_HZ * turns
        assert segment.phase(np.array([x]), RATE_HZ)[0] == pytest.approx(expected, abs=1e-12)


@every_blend
def test_motion_is_the_derivative_of_the_displacement(segment: Segment) -> None:
    shift = 1e-3
    around = [X + k * shift for k in (-2, -1, 1, 2)]
    step_s = shift * segment.count / RATE_HZ
    velocity = differentiate(tuple(segment.displacement(x, RATE_HZ) for x in around), step_s)
    acceleration = differentiate(tuple(segment.motion(x, RATE_HZ)[0] for x in around), step_s)
    np.testing.assert_allclose(segment.motion(X, RATE_HZ)[0], velocity, rtol=0, atol=1e-8)
    np.testing.assert_allclose(segment.motion(X, RATE_HZ)[1], acceleration, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("shape0", "shape1"), [((), (0.1j, 0.05)), ((0.1, -0.02j, 0.03), (0.2j,)), ((0.1j,), (0.1j,))]
)
@every_blend
def test_command_is_the_corrected_level_over_the_squared_frequency_with_overtones(
    segment: Segment, shape0: tuple[complex, ...], shape1: tuple[complex, ...]
) -> None:
    segment = replace(segment, correction0=0.8, correction1=1.3, shape0=shape0, shape1=shape1)
    for x in (0.0, *X, 1.0):
        s, theta = quintic(x), 2.0 * math.pi * segment.phase(np.array([x]), RATE_HZ)[0]
        wave = math.sin(theta)
        for order in (2, 3, 4):
            ends = [dict(enumerate(shape, 2)).get(order, 0j) for shape in (shape0, shape1)]
            amplitude = (1.0 - s) * ends[0] + s * ends[1]
            wave += amplitude.real * math.sin(order * theta)
            wave += amplitude.imag * math.cos(order * theta)
        level = (1.0 - s) * 0.8 * segment.level0 + s * 1.3 * segment.level1
        expected = -level / (2.0 * math.pi * frequency_at(segment, x)) ** 2 * wave
        command = segment.displacement(np.array([x]), RATE_HZ)[0]
        assert command == pytest.approx(expected, abs=1e-12)


@every_blend
def test_level_and_demanded_acceleration_follow_the_quintic(segment: Segment) -> None:
    level = [segment.level0 + (segment.level1 - segment.level0) * quintic(x) for x in X]
    np.testing.assert_allclose(segment.level(X), level, rtol=0, atol=1e-12)
    demanded = level * np.sin(2.0 * math.pi * segment.phase(X, RATE_HZ))
    np.testing.assert_allclose(segment.demanded_acceleration(X, RATE_HZ), demanded, atol=1e-12)


@pytest.mark.parametrize("corrections", [(1.0, 1.0), (0.7, 1.2), (1.6, 0.9)])
@every_blend
def test_peak_ratio_is_that_of_the_worst_phase(
    segment: Segment, corrections: tuple[float, float]
) -> None:
    command = replace(
        segment, level0=segment.level0 * corrections[0], level1=segment.level1 * corrections[1]
    )
    ratios = [
        np.abs(replace(motion, phase0=phase).motion(np.linspace(0.0, 1.0, 401), RATE_HZ)[1]).max()
        / max(motion.level0, motion.level1)
        for motion in (segment, command)
        for phase in np.linspace(0.0, 0.5, 100, endpoint=False)
    ]
    corrected = replace(segment, correction0=corrections[0], correction1=corrections[1])
    ratio = peak_acceleration_ratio(corrected, RATE_HZ)
    assert max(ratios) <= ratio <= max(ratios) * 1.0005  # of half a step of the phases: 1 - cos


@every_blend
def test_decay_lasts_two_cycles_of_its_frequency_or_half_a_second(segment: Segment) -> None:
    for x in (0.0, *X, 1.0):
        duration_s = max(2.0 / frequency_at(segment, x), 0.5)
        exact = duration_s * RATE_HZ
        assert -1e-9 <= segment.decay_samples(x, RATE_HZ) - exact < 1.0


def make_history(count: int = 60, start: int = 25) -> HistorySegment:
    values = np.random.default_rng(count).standard_normal(count)
    return HistorySegment(start, 1e-3 * values, 7)


def test_history_is_played_sample_by_sample_with_rest_around_it() -> None:
    history = make_history()
    padded = np.concatenate([np.zeros(3), history.history_m, np.zeros(3)])
    index = np.arange(-2, history.count + 2)
    x = index / history.count
    before, here, after = (padded[index + shift] for shift in (2, 3, 4))
    np.testing.assert_array_equal(history.displacement(x, RATE_HZ), here)
    velocity, acceleration = history.motion(x, RATE_HZ)
    np.testing.assert_allclose(velocity, (after - before) / 2.0 * RATE_HZ, atol=1e-12)
    np.testing.assert_allclose(acceleration, (after - 2 * here + before) * RATE_HZ**2, atol=1e-9)
    np.testing.assert_array_equal(history.demanded_acceleration(x, RATE_HZ), acceleration)
    assert not np.any([history.level(x), history.phase(x, RATE_HZ)])
    steps = np.diff(padded)
    peaks = [np.abs(values).max() for values in (padded, steps, np.diff(steps))]
    assert list(history.peaks) == pytest.approx(peaks, rel=1e-12)


@pytest.mark.parametrize("edge", [0, -1])
def test_history_that_is_largest_at_its_edge_starts_and_ends_at_rest(edge: int) -> None:
    values = np.zeros(9)
    values[edge] = -1e-3
    assert HistorySegment(0, values, 1).peaks == pytest.approx((1e-3, 1e-3, 2e-3))


def test_windows_of_a_history_are_equal_parts() -> None:
    history = make_history()
    x = np.arange(60) / 60.0
    window, label, cycle = history.labels(x, RATE_HZ)
    assert window.tolist() == [sample * 7 // 60 for sample in range(60)]
    assert set(label.tolist()) == {Label.MEASURE}
    assert set(cycle.tolist()) == {-1}


@pytest.mark.parametrize("frequency_hz", [0.5, 1.0, 3.0, 12.0])
def test_decay_of_a_history_is_the_shortest_that_bounds_its_acceleration(
    frequency_hz: float,
) -> None:
    time_s = np.arange(8000) / RATE_HZ
    history = HistorySegment(0, 0.01 * np.sin(2.0 * math.pi * frequency_hz * time_s) ** 3, 1)
    d, v, a = history.peaks

    def peak_acceleration(n: int) -> float:
        return a + 2.0 * v * MAX_BLEND_SLOPE / n + d * MAX_BLEND_CURVATURE / n**2

    length = history.decay_samples(0.3, RATE_HZ)
    assert peak_acceleration(length) <= 1.25 * a
    assert length == 500 or peak_acceleration(length - 1) > 1.25 * a


def make_drive() -> Drive:
    """A blend from rest, a hold that outlasts the blends that cut it, a gap, and a history."""
    segments = (
        Segment(100, 50, Label.BLEND, 0, 40.0, 40.0, 0.0, 5.0, 0.0),
        Segment(150, 350, Label.MEASURE, 0, 40.0, 40.0, 5.0, 5.0, 0.2, 14, 3),
        Segment(300, 60, Label.BLEND, 1, 40.0, 25.0, 5.0, 4.0, 0.7),
        Segment(360, 80, Label.BLEND, 1, 25.0, 25.0, 4.0, 0.0, 0.1),
        make_history(start=470),
    )
    return Drive(RATE_HZ, segments, (), correction=Correction(200, np.full(90, 1e-4)))


@pytest.mark.parametrize("decay_start", [None, 99, 100, 130, 320, 445, 480, 900])
def test_every_sample_is_that_of_the_segment_that_began_last(
    decay_start: int | None,
) -> None:
    drive = replace(make_drive(), decay_start=decay_start)
    first, last = 40, 1200
    expected = {
        name: np.zeros(last - first)
        for name in ("command", "acceleration", "phase", "level", "demanded_acceleration")
    }
    labels = np.array([[-1], [Label.REST], [-1]]) * np.ones(last - first, dtype=np.int64)
    for place, index in enumerate(range(first, last)):
        factor = 1.0
        if decay_start is not None:
            share = (index - decay_start) / drive.decay_samples
            factor = 1.0 - quintic(min(max(share, 0.0), 1.0))
        begun = [segment for segment in drive.segments if segment.start <= index]
        containing = [segment for segment in begun[-1:] if index < segment.end]
        added = 1e-4 if 200 <= index < 290 else 0.0
        expected["command"][place] = added * factor
        if containing:
            segment = containing[-1]
            x = np.array([(index - segment.start) / segment.count])
            assert drive.segment_at(index) is segment
            expected["command"][place] = (segment.displacement(x, RATE_HZ)[0] + added) * factor
            expected["acceleration"][place] = segment.motion(x, RATE_HZ)[1][0]
            expected["phase"][place] = segment.phase(x, RATE_HZ)[0]
            expected["level"][place] = segment.level(x)[0] * factor
            expected["demanded_acceleration"][place] = (
                segment.demanded_acceleration(x, RATE_HZ)[0] * factor
            )
            labels[:, place] = [row[0] for row in segment.labels(x, RATE_HZ)]
            is_sine = isinstance(segment, Segment)
            hz = frequency_at(segment, float(x[0])) if isinstance(segment, Segment) else 0.0
            assert drive.frequency_hz(index) == pytest.approx(hz, abs=1e-12)
            assert (segment in drive.sine_segments) == is_sine
        else:
            assert drive.frequency_hz(index) == 0.0
        if decay_start is not None and index >= decay_start:
            labels[2, place] = -1
            at_rest = index >= drive.rest_start
            labels[1, place] = Label.REST if at_rest else Label.STOP
            labels[0, place] = -1 if at_rest else labels[0, place]
    for name, values in expected.items():
        for count in (last - first, 37):
            parts = [
                getattr(drive, name)(at, min(count, last - at)) for at in range(first, last, count)
            ]
            np.testing.assert_allclose(np.concatenate(parts), values, rtol=1e-12, atol=1e-15)
    np.testing.assert_array_equal(drive.labels(first, last - first), labels)


def test_decay_lasts_as_its_first_segment_says_and_ends_with_the_drive() -> None:
    drive = make_drive()
    assert (drive.planned_end, drive.rest_start, drive.decay_samples) == (530, 530, 0)
    for at in range(90, 560):
        stopped = drive.decay_from(at)
        length = 1
        if at >= 100:
            segment = drive.segment_at(at)
            length = segment.decay_samples(min((at - segment.start) / segment.count, 1.0), RATE_HZ)
        assert stopped.decay_samples == length
        assert stopped.rest_start == min(at + length, max(530, at))


def test_outside_a_drive_its_first_or_last_segment_applies() -> None:
    drive = make_drive()
    assert drive.segment_at(0) is drive.segments[0]
    assert drive.segment_at(10_000) is drive.segments[-1]


def test_drive_without_segments_is_at_rest() -> None:
    drive = Drive(RATE_HZ, (), ())
    assert (drive.planned_end, drive.rest_start) == (0, 0)
    stopped = drive.decay_from(5)
    assert (stopped.decay_samples, stopped.rest_start) == (1, 5)
    assert not stopped.command(0, 20).any()


def test_cycles_settle_first_and_a_cycle_begins_on_its_sample() -> None:
    """At 40 Hz and 1000 Hz a cycle is 25 samples; the last one takes what is left."""
    segment = Segment(0, 130, Label.MEASURE, 4, 40.0, 40.0, 1.0, 1.0, 0.0, 5, 2)
    step, label, cycle = segment.labels(np.arange(130) / 130.0, RATE_HZ)
    expected = [min(sample // 25, 4) for sample in range(130)]
    assert cycle.tolist() == expected
    assert label.tolist() == [Label.MEASURE if k >= 2 else Label.SETTLE for k in expected]
    assert set(step.tolist()) == {4}
    unnumbered = replace(segment, cycles=0, settle=0, label=Label.CHECK)
    _, label, cycle = unnumbered.labels(np.arange(130) / 130.0, RATE_HZ)
    assert (set(label.tolist()), set(cycle.tolist())) == ({Label.CHECK}, {-1})


def test_constants_of_the_blend_are_its_extremes() -> None:
    x = np.linspace(0.0, 1.0, 10_001)
    assert np.abs(30.0 * x**2 * (1.0 - x) ** 2).max() == pytest.approx(MAX_BLEND_SLOPE, rel=1e-4)
    curvature = np.abs(60.0 * x * (1.0 - x) * (1.0 - 2.0 * x)).max()
    assert curvature == pytest.approx(MAX_BLEND_CURVATURE, rel=1e-4)
    assert (RAMP_CYCLES, RAMP_S) == (2.0, 0.5)


@pytest.mark.parametrize("count", [0, 1, 6])
@pytest.mark.parametrize("keep_from", [0, 5, 11, 14, 40])
@pytest.mark.parametrize("first", [3, 9, 10, 13, 16, 20])
def test_correction_is_replaced_sample_by_sample(first: int, keep_from: int, count: int) -> None:
    old = {10 + k: 1.0 + k for k in range(6)}
    new = {first + k: -1.0 - k for k in range(count)}
    before = {index: value for index, value in old.items() if keep_from <= index < first}
    correction = Correction(10, np.array(list(old.values())))
    replaced = correction.replace_from(first, np.array(list(new.values())), keep_from)
    for at, length in ((0, 60), (12, 1), (11, 4), (2, 8), (16, 9), (30, 5)):
        for subject, values in ((correction, old), (replaced, before | new)):
            expected = [values.get(index, 0.0) for index in range(at, at + length)]
            np.testing.assert_array_equal(subject.displacement(at, length), expected)
    assert replaced.end == first + count
    assert replaced.start == min(max(10, keep_from), first)
