"""Formulas of the sample checks, each against its definition, to rounding."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from table_io.safety.protection import sample_checks
from table_io.safety.protection.sample_checks import (
    PAYLOAD_PEAK,
    REST_COUNT,
    REST_POWER,
    RUN_STAGE,
    SILENT,
    SWEEP_STAGE,
    TABLE_GAIN,
    TABLE_LAG,
    UNKNOWN_LAG,
)
from table_io.safety.protection.thresholds import (
    SampleCheckState,
    Thresholds,
    compute_thresholds,
    make_sample_state,
)
from tests.table_io.safety.guarded import RIG
from tests.table_io.safety.test_protection_laws import make_profile

CHANNEL_COUNT = len(RIG.channels)
REST_SAMPLES = 200
LAW = settings(max_examples=30, deadline=None, derandomize=True)
NOISE = {sensor.channel: (sensor.noise_rms * sensor.si_per_unit, 2) for sensor in RIG.sensors}
THRESHOLDS = compute_thresholds(make_profile(2000.0), RIG, NOISE)._replace(
    has_noise=np.ones(CHANNEL_COUNT, dtype=np.bool_)
)


def count_silent(share: float, row: int, thresholds: Thresholds = THRESHOLDS) -> int:
    """Return the findings after the noise of a channel fell to this share of that at rest.

    The noise alternates between two values, so that its power is the same at every sample.
    """
    state = make_sample_state(CHANNEL_COUNT)
    values = np.ones((CHANNEL_COUNT, 2000))
    values[:, 1::2] = -1.0
    values[row, REST_SAMPLES:] *= share
    findings, count = np.empty((64, 5)), 0
    for i in range(2, values.shape[1]):
        state.scalars[RUN_STAGE] = 0.0 if i < REST_SAMPLES else SWEEP_STAGE
        if i in (REST_SAMPLES, REST_SAMPLES + 1):
            continue  # the second differences across the change
        count = sample_checks._check_silence(values, i, i, thresholds, state, findings, count)
    assert state.channels[REST_COUNT].tolist() == [REST_SAMPLES - 2] * CHANNEL_COUNT
    np.testing.assert_allclose(state.channels[REST_POWER], 16.0 * (REST_SAMPLES - 2))
    for _, code, channel, value, limit in findings[:count]:
        assert (int(code), int(channel)) == (SILENT, row)
        assert value < limit
        assert limit == pytest.approx(math.sqrt(16.0 / 6.0) / 3.0)
    return count


@given(row=st.integers(0, CHANNEL_COUNT - 1), share=st.floats(0.01, 2.0))
@LAW
def test_a_channel_is_silent_below_a_third_of_its_noise(row: int, share: float) -> None:
    if abs(share - 1.0 / 3.0) > 0.01:
        assert (count_silent(share, row) > 0) == (share < 1.0 / 3.0)


def test_silence_needs_noise_and_enough_rest() -> None:
    none = THRESHOLDS._replace(has_noise=np.zeros(CHANNEL_COUNT, dtype=np.bool_))
    assert count_silent(0.01, 0, none) == 0
    assert count_silent(0.01, 0, THRESHOLDS._replace(min_rest_samples=REST_SAMPLES - 1.0)) == 0
    assert count_silent(0.01, 0, THRESHOLDS._replace(min_rest_samples=REST_SAMPLES - 2.0)) > 0


def make_scalars(lag_s: float, gain: float = 1.0) -> Any:
    state: SampleCheckState = make_sample_state(CHANNEL_COUNT)
    state.scalars[TABLE_LAG], state.scalars[TABLE_GAIN] = lag_s, gain
    return state.scalars


@given(
    accelerations=st.lists(
        st.floats(-9.0, 9.0) | st.just(math.nan), min_size=1, max_size=8
    ),
    lag_s=st.floats(0.0, 0.05),
)  # fmt: skip
@LAW
def test_the_payload_deflects_the_table_by_the_peak_of_its_acceleration(
    accelerations: list[float], lag_s: float
) -> None:
    scalars, peak = make_scalars(lag_s), 0.0
    for acceleration in accelerations:
        values = np.full((CHANNEL_COUNT, 3), acceleration)
        deflection = sample_checks._payload_deflection(values, 2, THRESHOLDS, scalars)
        if not math.isnan(acceleration):
            peak = max(abs(acceleration), peak * (1.0 - 1.0 / THRESHOLDS.episode_samples))
        assert scalars[PAYLOAD_PEAK] == pytest.approx(peak)
        ratio = THRESHOLDS.mass_kg / THRESHOLDS.table_kg
        assert deflection == pytest.approx(ratio * peak * (0.5 * lag_s) ** 2)


def test_without_an_accelerometer_or_a_lag_no_deflection_is_allowed_for() -> None:
    values = np.full((CHANNEL_COUNT, 3), 5.0)
    without = THRESHOLDS._replace(mass_row=-1)
    assert sample_checks._payload_deflection(values, 2, without, make_scalars(0.01)) == 0.0
    unknown = make_scalars(UNKNOWN_LAG)
    assert sample_checks._payload_deflection(values, 2, THRESHOLDS, unknown) == 0.0


@given(
    seed=st.integers(0, 99), lag_s=st.floats(0.0, 0.12), gain=st.floats(0.8, 1.2),
    displacement=st.floats(-0.01, 0.01),
)  # fmt: skip
@LAW
def test_the_following_error_is_measured_from_the_delayed_command(
    seed: int, lag_s: float, gain: float, displacement: float
) -> None:
    command = 0.01 * np.random.default_rng(seed).standard_normal(600)
    i, rate_hz = 500, THRESHOLDS.rate_hz
    delay = min(lag_s * rate_hz, THRESHOLDS.max_lag) + 1.0
    expected_m = gain * np.interp(i - delay, np.arange(command.size), command)
    error_m = sample_checks._following_error(
        displacement, command, i, THRESHOLDS, make_scalars(lag_s, gain)
    )
    assert error_m == pytest.approx(abs(displacement - expected_m), abs=1e-12)
    recent = command[i - THRESHOLDS.max_lag : i]
    beyond_m = max(recent.min() - displacement, displacement - recent.max(), 0.0)
    assert sample_checks._following_error(
        displacement, command, i, THRESHOLDS, make_scalars(UNKNOWN_LAG)
    ) == pytest.approx(beyond_m)


@given(a=st.floats(-9, 9), b=st.floats(-9, 9), c=st.floats(-9, 9), lost=st.integers(0, 5))
@LAW
def test_limits_see_the_median_of_three_samples(a: float, b: float, c: float, lost: int) -> None:
    row = np.array([9e9, a, b, c, -9e9])
    assert sample_checks._median(row, 3) == np.median([a, b, c])
    if 1 <= lost <= 3:
        row[lost] = math.nan
        assert math.isnan(sample_checks._median(row, 3))
