"""Feedback that holds an orbit: its answer, its smoothness, its limits, its end without blocks."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from table_io.block import Float1D, Label
from table_io.control.orbit_feedback import (
    FeedbackState,
    ReferenceSegment,
    advance_feedback,
    evaluate_harmonics,
)
from table_io.excitation.drive import Drive
from table_io.excitation.trajectory import SineTarget, Trajectory

RATE_HZ, F, LEVEL, BLOCK, HORIZON = 2000.0, 3.4, 0.49, 20, 60
GAIN, RATE_GAIN_S = 0.7, 0.005
REFERENCE = np.array([0.0, 1e-3, -3e-3, 0.0, 2e-4])


def make_drive() -> Drive:
    trajectory = Trajectory(RATE_HZ, 100, SineTarget(F, 0.0))
    trajectory = trajectory.append_blend(SineTarget(F, LEVEL), 0, 2.0, Label.BLEND)
    return trajectory.append_hold(20_000, 0, Label.SETTLE).to_drive(())


def make_state(**changes: Any) -> FeedbackState:
    """Return a feedback whose acceleration is not limited, but by the changes."""
    segment = ReferenceSegment(
        0, 1, REFERENCE, REFERENCE, 1.0, 1.0, GAIN, RATE_GAIN_S, 5e-4, 9.0 * LEVEL
    )
    return FeedbackState(HORIZON).append(replace(segment, **changes))


def find_peak_m_s2(drive: Drive, first: int, count: int) -> float:
    return float(np.abs(np.diff(drive.command(first, count), 2)).max() * RATE_HZ**2)


def run_feedback(
    state: FeedbackState, deviation: Float1D, first: int = 4000, earliest: int = 0
) -> tuple[FeedbackState, Drive]:
    """Feed samples of reference plus deviation from sample `first` on, block by block."""
    drive = make_drive()
    for end in range(BLOCK, deviation.size + 1, BLOCK):
        state, drive = run_feedback_block(state, drive, deviation, end, first, earliest)
    return state, drive


def run_feedback_block(
    state: FeedbackState,
    drive: Drive,
    deviation: Float1D,
    end: int,
    first: int = 4000,
    earliest: int = 0,
) -> tuple[FeedbackState, Drive]:
    """Feed the block of a deviation that ends before its sample `end`."""
    index = first + end - BLOCK
    x = evaluate_harmonics(REFERENCE, drive.phase(index, BLOCK)) + deviation[end - BLOCK : end]
    state, correction, _ = advance_feedback(state, drive, index, x, earliest, 0)
    return state, replace(drive, correction=correction)


def sine(amplitude_m: float, count: int = 2000) -> Float1D:
    return amplitude_m * np.cos(2 * math.pi * F * np.arange(count) / RATE_HZ)


def test_sine_deviation_is_answered_at_its_phase_one_horizon_later() -> None:
    _, drive = run_feedback(make_state(), sine(1e-4))
    index = np.arange(1500, 1900)
    t = (index - HORIZON) / RATE_HZ
    w = 2 * math.pi * F
    expected = GAIN * np.cos(w * t) - RATE_GAIN_S * w * np.sin(w * t)
    answer = drive.correction.displacement(4000 + 1500, 400) / 1e-4
    np.testing.assert_allclose(answer, expected, atol=2e-3)


def test_orbit_without_deviation_gets_no_correction() -> None:
    _, drive = run_feedback(make_state(), np.zeros(2000))
    assert np.abs(drive.correction.values_m).max() < 1e-15


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_correction_stays_within_its_amplitude_and_the_acceleration_of_the_command(
    sign: float,
) -> None:
    state, drive = run_feedback(make_state(max_acceleration_m_s2=1.12 * LEVEL), sine(sign * 5e-3))
    assert 1e-4 < np.abs(drive.correction.values_m).max() <= 1.001 * 5e-4
    assert LEVEL * 0.99 < find_peak_m_s2(drive, 4000, 2050) <= 1.12 * LEVEL * (1 + 1e-9)
    assert state.saturated_samples > 1500


def test_correction_that_lowers_the_command_is_not_limited_by_its_acceleration() -> None:
    lower, phase = make_state(max_acceleration_m_s2=LEVEL), make_drive().phase(4000, 2000)
    command_m = -LEVEL / (math.tau * F) ** 2 * np.sin(math.tau * phase)
    answers = [run_feedback(lower, sign * 0.3 * np.roll(command_m, HORIZON))[1] for sign in (1, -1)]
    raising, lowering = (
        np.abs(drive.correction.displacement(5000, 900)).max() for drive in answers
    )
    assert lowering > 0.2 * np.abs(command_m).max() > 2.0 * raising


@pytest.mark.parametrize("ramp_s", [0.0, 0.03, 0.05, 0.1])
@pytest.mark.parametrize("seed", range(3))
def test_acceleration_of_the_written_correction_is_limited_in_any_ramp_of_the_share(
    seed: int, ramp_s: float
) -> None:
    """The share begins and ends at once or within a ramp, again and again, under a deviation."""
    rng = np.random.default_rng(seed)
    state, count = make_state(max_acceleration_m_s2=1.02 * LEVEL), round(ramp_s * RATE_HZ)
    for k, start in enumerate(range(4200, 6000, 300)):
        before, after = float((k + 1) % 2), float(k % 2)
        state = state.append(
            replace(state.segments[0], start=start, count=count, share0=before, share1=after)
        )
    deviation = sine(3e-4) + 5e-6 * rng.standard_normal(2000)
    drives: list[Drive] = []
    for end in range(BLOCK, 2000, BLOCK):
        state, drive = run_feedback_block(
            state, drives[-1] if drives else make_drive(), deviation, end
        )
        drives.append(drive)
    peaks = [find_peak_m_s2(drive, 4000 + end + HORIZON - 2, BLOCK + 2)
             for end, drive in zip(range(BLOCK, 2000, BLOCK), drives, strict=True)]  # fmt: skip
    assert 1.01 * LEVEL < max(peaks) <= 1.02 * LEVEL * (1 + 1e-9)


def test_correction_follows_a_share_that_ends_although_its_acceleration_is_limited() -> None:
    state = make_state(max_acceleration_m_s2=1.02 * LEVEL)
    state = state.append(replace(state.segments[0], start=5000, count=60, share1=0.0))
    _, drive = run_feedback(state, sine(1e-4))
    before, after = (drive.correction.displacement(first, 300) for first in (4600, 5400))
    assert np.abs(after).max() < 0.03 * np.abs(before).max()


def test_saturation_ends_with_the_deviation() -> None:
    state, _ = run_feedback(make_state(), np.concatenate([sine(5e-3, 1000), np.zeros(200)]))
    assert state.saturated_samples == 0


def test_correction_fades_smoothly_if_no_block_follows() -> None:
    _, drive = run_feedback(make_state(), sine(1e-4))
    end = 4000 + 2000
    assert drive.correction.end < end + 0.4 * RATE_HZ
    tail = drive.correction.displacement(end, round(0.5 * RATE_HZ))
    assert np.abs(np.diff(tail)).max() * RATE_HZ < 4 * np.abs(tail).max() * 2 * math.pi * F
    assert not tail[-200:].any()


def test_lost_samples_leave_the_queued_correction_as_it_is() -> None:
    state, drive = run_feedback(make_state(), sine(1e-4))
    lost = np.full(BLOCK, math.nan)
    _, correction, _ = advance_feedback(state, drive, 6000, lost, 0, 0)
    assert correction is drive.correction


def test_late_block_changes_only_what_can_still_be_changed() -> None:
    state, drive = run_feedback(make_state(max_acceleration_m_s2=3.0 * LEVEL), sine(1e-4))
    x = evaluate_harmonics(REFERENCE, drive.phase(6000, BLOCK)) + 3e-4
    _, correction, first = advance_feedback(state, drive, 6000, x, 6200, 0)
    assert first == 6200
    before = slice(0, 6200 - drive.correction.start)
    np.testing.assert_array_equal(correction.values_m[before], drive.correction.values_m[before])
    assert np.abs(np.diff(correction.values_m, 2)).max() * RATE_HZ**2 < 4 * LEVEL


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_share_scales_the_correction(share: float) -> None:
    state = make_state(max_acceleration_m_s2=100.0 * LEVEL)
    _, full = run_feedback(state, sine(1e-4))
    _, part = run_feedback(
        make_state(share0=share, share1=share, max_acceleration_m_s2=100.0 * LEVEL), sine(1e-4)
    )
    np.testing.assert_allclose(
        part.correction.values_m, share * full.correction.values_m, atol=1e-12
    )


def test_reference_blends_from_one_orbit_to_the_next() -> None:
    state = make_state()
    after = 2.0 * REFERENCE
    state = state.append(
        replace(state.segments[0], start=5000, count=400, before=REFERENCE, after=after)
    )
    phase = make_drive().phase(4900, 800)
    reference = state.reference(4900, phase)
    np.testing.assert_allclose(reference[:100], evaluate_harmonics(REFERENCE, phase[:100]))
    np.testing.assert_allclose(reference[500:], evaluate_harmonics(after, phase[500:]))
    assert np.abs(np.diff(reference)).max() < 4e-3 * 2 * 2 * math.pi * F * 2 / RATE_HZ
