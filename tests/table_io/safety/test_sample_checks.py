"""Formulas of the sample checks, each against its definition, to rounding."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from table_io.block import Block, Label
from table_io.config.profile import ProtectionConfig
from table_io.safety import protection, sample_checks
from table_io.safety.findings import to_finding
from table_io.safety.sample_checks import (
    ACCELERATION,
    BLIND,
    COMMAND,
    COMMAND_PEAK,
    CYCLE_FRACTION,
    DROPPED,
    FOLLOWING,
    FORCE,
    HALF_CYCLE,
    LOST,
    MOTION_KEY,
    NEW_MOTION,
    PAYLOAD_PEAK,
    RAIL,
    REPEATED,
    REST_COUNT,
    REST_POWER,
    RUN_STAGE,
    SILENT,
    SPIKE,
    STROKE,
    STUCK,
    SWEEP_STAGE,
    TABLE_GAIN,
    TABLE_LAG,
    UNKNOWN_LAG,
    VELOCITY,
    CheckRun,
    SampleCheckState,
    Thresholds,
    compute_thresholds,
    make_sample_state,
)
from table_io.units import GRAVITY_M_S2
from tests.builders.profiles import make_profile
from tests.builders.rigs import NOISE_SI, RIG

CHANNEL_COUNT = len(RIG.channels)
REST_SAMPLES = 200
PROFILE = make_profile()
LAW = settings(max_examples=30, derandomize=True)
THRESHOLDS = compute_thresholds(PROFILE, RIG, NOISE_SI)._replace(
    has_noise=np.ones(CHANNEL_COUNT, dtype=np.bool_)
)


def start_run(thresholds: Thresholds = THRESHOLDS, room: int = 64) -> CheckRun:
    """Return a run of the checks without findings, of which there is room for this many."""
    state = make_sample_state(CHANNEL_COUNT)
    return CheckRun(thresholds, state, np.full((room, 5), math.nan), np.zeros(1, np.int64))


def count_silent(share: float, row: int, thresholds: Thresholds = THRESHOLDS) -> int:
    """Return the findings after the noise of a channel fell to this share of that at rest.

    The noise alternates between two values, so that its power is the same at every sample.
    """
    run = start_run(thresholds)
    state = run.state
    values = np.ones((CHANNEL_COUNT, 2000))
    values[:, 1::2] = -1.0
    values[row, REST_SAMPLES:] *= share
    for i in range(2, values.shape[1]):
        state.scalars[RUN_STAGE] = 0.0 if i < REST_SAMPLES else SWEEP_STAGE
        if i in (REST_SAMPLES, REST_SAMPLES + 1):
            continue  # the second differences across the change
        sample_checks._check_silence(values, i, i, run)
    assert state.channels[REST_COUNT].tolist() == [REST_SAMPLES - 2] * CHANNEL_COUNT
    np.testing.assert_allclose(state.channels[REST_POWER], 16.0 * (REST_SAMPLES - 2))
    reports = list_reports(run)
    for _, code, channel, value, limit in reports:
        assert (code, channel) == (SILENT, row)
        assert value < limit
        assert limit == pytest.approx(math.sqrt(16.0 / 6.0) / 3.0)
    return len(reports)


@given(row=st.integers(0, CHANNEL_COUNT - 1), share=st.floats(0.01, 2.0))
@LAW
def test_check_silence_below_a_third_of_the_noise(row: int, share: float) -> None:
    if abs(share - 1.0 / 3.0) > 0.01:
        assert (count_silent(share, row) > 0) == (share < 1.0 / 3.0)


def test_check_silence_without_noise_or_rest() -> None:
    none = THRESHOLDS._replace(has_noise=np.zeros(CHANNEL_COUNT, dtype=np.bool_))
    assert count_silent(0.01, 0, none) == 0
    assert count_silent(0.01, 0, THRESHOLDS._replace(min_rest_samples=REST_SAMPLES - 1.0)) == 0
    assert count_silent(0.01, 0, THRESHOLDS._replace(min_rest_samples=REST_SAMPLES - 2.0)) > 0


def make_scalars(lag_s: float, gain: float = 1.0) -> Any:
    state: SampleCheckState = make_sample_state(CHANNEL_COUNT)
    state.scalars[TABLE_LAG], state.scalars[TABLE_GAIN] = lag_s, gain
    return state.scalars


@given(
    accelerations=st.lists(st.floats(-9.0, 9.0) | st.just(math.nan), min_size=1, max_size=8),
    lag_s=st.floats(0.0, 0.05),
)
@LAW
def test_payload_deflection_follows_the_peak_acceleration(
    accelerations: list[float], lag_s: float
) -> None:
    scalars, peak = make_scalars(lag_s), 0.0
    for acceleration in accelerations:
        values = np.full((CHANNEL_COUNT, 3), acceleration)
        deflection = sample_checks._payload_deflection(values, 2, THRESHOLDS, scalars)
        if not math.isnan(acceleration):
            peak = max(abs(acceleration), peak * (1.0 - 1.0 / THRESHOLDS.episode_samples))
        assert scalars[PAYLOAD_PEAK] == pytest.approx(peak)
        without = THRESHOLDS._replace(mass_row=-1)
        unknown = make_scalars(UNKNOWN_LAG)
        assert sample_checks._payload_deflection(values, 2, without, make_scalars(0.01)) == 0.0
        assert sample_checks._payload_deflection(values, 2, THRESHOLDS, unknown) == 0.0
        ratio = THRESHOLDS.mass_kg / THRESHOLDS.table_kg
        assert deflection == pytest.approx(ratio * peak * (0.5 * lag_s) ** 2)


@given(
    seed=st.integers(0, 99),
    lag_s=st.floats(0.0, 0.12),
    gain=st.floats(0.8, 1.2),
    displacement=st.floats(-0.01, 0.01),
)
@LAW
def test_following_error_from_the_delayed_command(
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


DRIVE, TABLE, ACC, MASS, MASS_ACC = range(5)
SIGNS = st.sampled_from([-1.0, 1.0])
# Just inside and just beyond a limit.
SHARES = st.sampled_from([1.0 - 1e-6, 1.0 + 1e-6])
Report = tuple[int, int, int, float, float]  # sample, code, channel, value, limit


def list_reports(run: CheckRun) -> list[Report]:
    rows = run.findings[: run.finding_count[0]].tolist()
    return [(int(a), int(b), int(c), d, e) for a, b, c, d, e in rows]


@given(gap=st.integers(0, 4000), code=st.integers(0, 12), row=st.integers(0, CHANNEL_COUNT - 1))
@LAW
def test_report_repeats_after_a_second(gap: int, code: int, row: int) -> None:
    run = start_run(room=4)
    first = (0, code, row, 7.0, 5.0)
    again = [(gap, code, row, 7.0, 5.0)] if gap > 2000 else []
    other = (gap, code + 1, row, 7.0, 5.0)  # another finding has its own time
    for index, reported in ((0, code), (gap, code), (gap, code + 1)):
        sample_checks._report(run, index, reported, row, 7.0, 5.0)
    assert list_reports(run) == [first, *again, other]
    full = run._replace(findings=run.findings[: run.finding_count[0]])
    sample_checks._report(full, gap + 3000, code, row, 7.0, 5.0)  # no room is left
    sample_checks._report(run, gap + 4000, code, row, 7.0, 5.0)  # nor was it absent
    assert list_reports(run) == [first, *again, other]


@given(
    seed=st.integers(0, 99),
    sign=SIGNS,
    share=SHARES,
    code=st.sampled_from([STROKE, VELOCITY, ACCELERATION, FORCE]),
    is_lost=st.booleans(),
)
@LAW
def test_check_limits_at_each_limit(
    seed: int, sign: float, share: float, code: int, is_lost: bool
) -> None:
    """Stroke, difference quotient over 10 ms, acceleration, and force of table and mass."""
    values = np.zeros((CHANNEL_COUNT, 40))
    noise = 1e-9 * np.random.default_rng(seed).standard_normal((CHANNEL_COUNT, 3))
    i, span = 35, 20
    size = {STROKE: 0.06, VELOCITY: 0.5, ACCELERATION: GRAVITY_M_S2, FORCE: 30e3}[code]
    value = sign * share * size
    if code == STROKE:
        values[TABLE] = value
    elif code == VELOCITY:
        values[TABLE, : i - span + 1] = -value * 0.002
        values[TABLE, i - 2 :] = value * 0.008
    elif code == ACCELERATION:
        values[ACC] = value
        values[MASS_ACC] = -value
    elif is_lost:
        values[ACC], values[MASS_ACC] = value / 2000.0, math.nan
    else:
        values[ACC] = 0.5 * value / 2000.0
        values[MASS_ACC] = 0.5 * value / 550.0
    values[:, i - 2 : i + 1] += noise - np.median(noise, axis=1, keepdims=True)
    run = start_run()
    sample_checks._check_limits(values, i, 77, run)
    reports = list_reports(run)
    if code == FORCE and is_lost:
        reports = [report for report in reports if report[1] == FORCE]
    expected = [(77, code, TABLE if code in (STROKE, VELOCITY) else ACC)]
    assert [report[:3] for report in reports] == (expected if share > 1.0 else [])
    for report in reports:
        assert report[3:] == pytest.approx((value, size))


@given(
    sign=SIGNS,
    share=SHARES,
    slope=st.floats(-1e-4, 1e-4),
    peak=st.floats(0.0, 0.05),
    stage=st.sampled_from([0.0, 0.5, SWEEP_STAGE]),
    lag_s=st.just(UNKNOWN_LAG) | st.floats(0, 0.09),
    gain=st.floats(0.8, 1.2),
    a=st.floats(-9.0, 9.0),
)
@LAW
def test_check_following_after_eight_samples(
    sign: float,
    share: float,
    slope: float,
    peak: float,
    stage: float,
    lag_s: float,
    gain: float,
    a: float,
) -> None:
    in_check, is_unknown = stage < 1.0, lag_s == UNKNOWN_LAG
    gain = 1.0 if is_unknown else gain
    command = slope * np.arange(600.0)
    tolerance_m = 5e-4 * 0.06 + 3 * (0.12 / 2**24 + RIG.output.lsb_m)
    command_limit_m = tolerance_m + (2.5 if in_check else 0.01) * peak + 2.0 * abs(slope)
    command_limit_m += 0.02 * 0.06 if in_check else 0.0
    limit_m = 1e-3 * 0.06 + 10 * 5e-6 + (0.25 if is_unknown else 0.15) * peak
    limit_m += 0.0 if is_unknown else 550.0 / 2000.0 * abs(a) * (0.5 * lag_s) ** 2
    if in_check:
        limit_m = 1e-3 * 0.06 + 10 * 5e-6 + 2.5 * peak + 0.02 * 0.06
    for code, row, size in ((COMMAND, DRIVE, command_limit_m), (FOLLOWING, TABLE, limit_m)):
        run = start_run()
        scalars = run.state.scalars
        scalars[COMMAND_PEAK], scalars[RUN_STAGE] = peak, stage
        scalars[TABLE_GAIN], scalars[TABLE_LAG] = gain, lag_s
        values = np.zeros((CHANNEL_COUNT, 600))
        values[DRIVE], values[MASS_ACC] = command, a
        # Beyond the median of three, one sample late; while unknown, beyond any position allowed.
        delay = 0.0 if is_unknown else lag_s * 2000.0
        if is_unknown:
            delay = 199.0 if sign * slope < 0 else 0.0
        values[TABLE] = gain * (command - delay * slope)
        values[row] += sign * share * size
        for i in range(500, 510):
            sample_checks._check_following(values, command, i, i, run)
        expected = sign * share * size
        reports = list_reports(run)
        assert [report[:3] for report in reports] == ([(507, code, row)] if share > 1.0 else [])
        for report in reports:
            value = expected if code == COMMAND else abs(expected)
            assert report[3:] == pytest.approx((value, size))
            # A sample within the tolerance starts the count again.
            values[row, 510:] -= expected
            for i in range(510, 530):
                sample_checks._check_following(values, command, i, i, run)
            assert scalars[sample_checks.COMMAND_ERROR_COUNT] == 0.0
            assert scalars[sample_checks.FOLLOWING_ERROR_COUNT] == 0.0


@given(per_half=st.sampled_from([4, 8, 16, 32]), sign=SIGNS, seed=st.integers(0, 99))
@LAW
def test_find_mark_at_half_cycles_and_new_motions(per_half: int, sign: float, seed: int) -> None:
    """The phase may restart at any cycle; its steps, here exact in binary, add up."""
    chance = np.random.default_rng(seed)
    keys = np.repeat(chance.choice([0.0, -1.0, 1.0, 2.0, 3.0, 0.5], 6), 3 * per_half + 1)
    step = 0.5 / per_half
    phase = (step * np.arange(keys.size) + chance.integers(0, 64) / 64.0) % 1.0
    command = sign * chance.uniform(0.0, 1.0, keys.size) * np.exp(-np.arange(keys.size) / 9.0)
    scalars = make_sample_state(CHANNEL_COUNT).scalars
    key, stage, peak, since = 0.0, 0.0, 0.0, 0
    for i in range(1, keys.size):
        mark = sample_checks._find_mark(command, phase, i, keys[i], scalars, THRESHOLDS)
        peak = max(abs(command[i]), peak * math.exp(-step))
        since += 1
        if keys[i] != key:
            key, since = keys[i], 0
            stage = max(stage, 1.0 if key > 0 else 0.5 if key < 0 else 0.0)
            assert mark == NEW_MOTION
        else:
            assert mark == (HALF_CYCLE if since % per_half == 0 else 0)
        assert scalars[COMMAND_PEAK] == pytest.approx(peak)
        assert scalars[CYCLE_FRACTION] == step * (since % per_half)
        assert (scalars[MOTION_KEY], scalars[RUN_STAGE]) == (key, stage)


def test_command_peak_of_a_standing_command_decays() -> None:
    scalars = make_sample_state(CHANNEL_COUNT).scalars
    scalars[COMMAND_PEAK] = 1.0
    for i in range(1, 2001):
        sample_checks._find_mark(np.zeros(2001), np.full(2001, 0.3), i, 0.0, scalars, THRESHOLDS)
    assert scalars[COMMAND_PEAK] == pytest.approx(math.exp(-1.0))


@given(
    row=st.integers(0, CHANNEL_COUNT - 1), is_noisy=st.booleans(), percent=st.integers(-100, 100)
)
@LAW
def test_check_stuck_after_its_run(row: int, is_noisy: bool, percent: int) -> None:
    noise = NOISE_SI if is_noisy else dict.fromkeys(RIG.channels, (0.0, 2000))
    thresholds = compute_thresholds(PROFILE, RIG, noise)
    values = np.random.default_rng(1).standard_normal((CHANNEL_COUNT, 200))
    values[row, 20:] = 0.3
    # The command moves by twenty steps of the coarser converter in `needed` samples.
    lsb = [0.12 / 2**24, 0.15 / 2**24, 4.0 * GRAVITY_M_S2 / 2**24]
    steps = [RIG.output.lsb_m, RIG.output.lsb_m, lsb[2]]
    step = percent * 1e-8
    command = step * np.arange(200.0)
    demanded = 2.0 * command
    check_run = start_run(thresholds)
    for i in range(2, 200):
        sample_checks._check_stuck(values, i, i, command[i], demanded[i], check_run)
    reports = list_reports(check_run)
    channel = RIG.channels[row]
    run: float = math.inf
    if is_noisy and NOISE_SI[channel][0] > 0:
        run = 20.0  # 10 ms, ten times the run of two
    elif row in (DRIVE, TABLE, ACC) and step:
        speed = abs(step) * (2.0 if row == ACC else 1.0)
        needed = math.ceil(20.0 * steps[row] / speed * (1 - 1e-12)) + 1
        run = max(20.0, needed)
    expected = [(20 + int(run) - 1, STUCK, row)] if run <= 180 else []
    assert [report[:3] for report in reports] == expected
    for report in reports:
        assert report[3:] == (run, run)


@given(row=st.integers(0, CHANNEL_COUNT - 1), sign=SIGNS, share=SHARES, other=st.booleans())
@LAW
def test_check_spikes_in_one_channel(row: int, sign: float, share: float, other: bool) -> None:
    values = np.zeros((CHANNEL_COUNT, 9))
    limit = THRESHOLDS.spike_limit[row]
    values[row, 7] = sign * share * limit
    if other:
        neighbor = (row + 1) % CHANNEL_COUNT
        values[neighbor, 7] = 2.0 * THRESHOLDS.spike_limit[neighbor]
    run = start_run()
    sample_checks._check_spikes(values, 8, 50, run)
    reports = list_reports(run)
    if other and share < 1.0:  # then the neighbor is the only one
        assert [report[:3] for report in reports] == [(49, SPIKE, (row + 1) % CHANNEL_COUNT)]
    elif other or share < 1.0:
        assert reports == []
    else:
        assert reports == [(49, SPIKE, row, pytest.approx(share * limit), limit)]


@given(first=st.integers(30, 490), then=st.integers(30, 490), before=st.integers(0, 8))
@LAW
def test_is_repeated_after_five_samples(first: int, then: int, before: int) -> None:
    """Samples at another distance before do not count; the first new one ends it."""
    values = np.random.default_rng(2).standard_normal((CHANNEL_COUNT, 560))
    before = 0 if then == first else before
    begin = 520 + before
    for i in range(520, 540):
        values[:, i] = values[:, i - (first if i < begin else then)]
    scalars = make_sample_state(CHANNEL_COUNT).scalars
    repeated = [
        i for i in range(510, 560) if sample_checks._is_repeated(values, i, THRESHOLDS, scalars)
    ]
    # A shorter distance than before is looked for again after one sample without repetition.
    counted = begin + 1 if before and then < first else begin
    assert repeated == [*range(524, begin), *range(counted + 4, 540)]


@pytest.mark.parametrize("row", [0, 3, CHANNEL_COUNT - 1])
@pytest.mark.parametrize("is_repeated", [False, True])
def test_check_delivery_balance_of_lost_samples(row: int, is_repeated: bool) -> None:
    values = np.ones((CHANNEL_COUNT, 2000))
    lost = np.zeros(2000, dtype=np.bool_)
    lost[100:141] = lost[150] = True
    lost[600:640] = True
    if not is_repeated:
        values[row, lost] = math.nan
    run = start_run()
    clipped = np.zeros(CHANNEL_COUNT, dtype=np.bool_)
    balance, level = [], 0.0
    for i in range(2000):
        repeated = bool(is_repeated and lost[i])
        sample_checks._check_delivery(values, clipped, i, i, repeated, run)
        level = max(level + (1.0 if lost[i] else -0.1), 0.0)
        balance.append(run.state.channels[sample_checks.LOST_COUNT, row] - level)
    assert np.abs(balance).max() < 1e-9
    reports = [report for report in list_reports(run) if report[1] == BLIND]
    blind = range(CHANNEL_COUNT) if is_repeated else [row]
    assert [report[:3] for report in reports] == [(140, BLIND, c) for c in blind]
    for report in reports:
        assert report[3:] == pytest.approx((41 / 2000.0, 0.02))
    singles = [report for report in list_reports(run) if report[1] == LOST]
    assert [report[:3] for report in singles] == ([] if is_repeated else [(100, LOST, row)])


def test_check_delivery_of_dropped_and_clipped_samples() -> None:
    values = np.ones((CHANNEL_COUNT, 20))
    values[:, 5] = math.nan
    values[:-1, 9] = math.nan
    clipped = np.zeros((CHANNEL_COUNT, 20), dtype=np.bool_)
    clipped[3, [10, 11, 13, 14, 15]] = clipped[4, [10, 11]] = True
    run = start_run()
    for i in range(20):
        sample_checks._check_delivery(values, clipped[:, i].copy(), i, i, False, run)
    reports = [report[:3] for report in list_reports(run)]
    lost = [(9, LOST, c) for c in range(CHANNEL_COUNT - 1)]
    assert reports == [(5, DROPPED, DRIVE), *lost, (15, RAIL, 3)]
    assert list_reports(run)[-1][3:] == (1.0, RIG.sensors[3].range_si)


# Thresholds in closed form


@pytest.mark.parametrize("rate_hz", [1000.0, 2000.0, 4000.0])
@given(run=st.integers(1, 500), scale=st.floats(0.0, 30.0))
@LAW
def test_compute_thresholds_in_closed_form(rate_hz: float, run: int, scale: float) -> None:
    sigma = np.array([scale * sensor.noise_rms * sensor.si_per_unit for sensor in RIG.sensors])
    noise = {name: (rms, run) for name, rms in zip(RIG.channels, sigma, strict=True)}
    thresholds = compute_thresholds(
        make_profile(tables={"acquisition": {"rate_hz": rate_hz}}), RIG, noise
    )
    ranges = np.array([sensor.range * sensor.si_per_unit for sensor in RIG.sensors])
    dac_m = 0.12 / 2**18
    lsb = 2.0 * ranges / 2**24
    assert thresholds.full_scale == pytest.approx(ranges)
    spikes = np.maximum(10.0 * sigma, 1e-3 * ranges)
    spikes[ACC] += dac_m / 1e-6  # a stiff table follows each step of its output
    assert thresholds.spike_limit == pytest.approx(spikes)
    is_informative = (sigma > 0) & (run < 0.1 * rate_hz)
    runs = np.where(is_informative, max(0.01 * rate_hz, 10.0 * run), math.inf)
    assert thresholds.stuck_run == pytest.approx(runs)
    assert thresholds.has_noise.tolist() == (is_informative & (run <= 5)).tolist()
    visible = np.full(CHANNEL_COUNT, math.inf)
    steps = np.maximum(lsb, math.sqrt(12.0) * sigma)
    steps[[DRIVE, TABLE]] = np.maximum(steps[[DRIVE, TABLE]], dac_m)
    visible[:3] = np.where(is_informative[:3], math.inf, 20.0 * steps[:3])
    assert thresholds.visible_motion == pytest.approx(visible)
    assert thresholds.command_tolerance_m == pytest.approx(
        5e-4 * 0.06 + 3.0 * (lsb[DRIVE] + dac_m) + 10.0 * sigma[DRIVE]
    )
    assert thresholds.following_tolerance_m == pytest.approx(1e-3 * 0.06 + 10.0 * sigma[TABLE])
    assert thresholds.loop_check_tolerance_m == pytest.approx(0.02 * 0.06)
    unknown = compute_thresholds(PROFILE, RIG, {})
    assert not unknown.has_noise.any()
    assert np.isinf(unknown.stuck_run).all()
    assert np.isfinite(unknown.visible_motion).tolist() == [True] * 3 + [False] * 6
    in_samples = {
        "history": 0.25,
        "episode_samples": 1.0,
        "velocity_span": 0.01,
        "visible_run": 0.01,
        "max_lost": 0.02,
        "max_lag": 0.1,
    }
    for name, seconds in in_samples.items():
        assert getattr(thresholds, name) == pytest.approx(seconds * rate_hz), name
    in_si = {
        "stroke_m": 0.06,
        "velocity_m_s": 0.5,
        "acceleration_m_s2": GRAVITY_M_S2,
        "force_n": 30e3,
        "table_kg": 2000.0,
        "mass_kg": 550.0,
        "drive_row": DRIVE,
        "table_row": TABLE,
        "acceleration_row": ACC,
        "mass_row": MASS_ACC,
        "following_ratio": 0.15,
        "initial_following_ratio": 0.25,
        "rate_hz": rate_hz,
    }
    for name, value in in_si.items():
        assert getattr(thresholds, name) == pytest.approx(value), name


def test_initial_following_ratio_is_at_least_that_of_the_rig() -> None:
    for ratio, initial in ((0.1, 0.25), (0.4, 0.4)):
        response = RIG.table_response.model_copy(update={"following_ratio": ratio})
        rig = RIG.model_copy(update={"table_response": response})
        thresholds = compute_thresholds(PROFILE, rig, NOISE_SI)
        assert (thresholds.following_ratio, thresholds.initial_following_ratio) == (ratio, initial)


# Findings and keys


def test_to_finding_reaction() -> None:
    stops = {STROKE, VELOCITY, ACCELERATION, FORCE, COMMAND, FOLLOWING}
    alarms = {LOST, DROPPED, SPIKE, REPEATED}
    for reaction in ("stop", "warn"):
        profile = PROFILE.model_copy(update={"protection": ProtectionConfig(sensor=reaction)})
        for code in range(sample_checks.CODE_COUNT):
            for name in RIG.channels:
                channel = RIG.channel_by_name[name]
                finding = to_finding(code, 12, channel, 3.0, 2.0, profile)
                is_needed = name in ("drive_disp_m", "table_disp_m", "table_acc_m_s2")
                by_sensor = code not in alarms and (is_needed or reaction == "stop")
                assert finding.stop == (code in stops or by_sensor), (code, name)
                assert (finding.index, finding.channel) == (12, name)
                assert (finding.value, finding.limit) == (3.0, 2.0)


def test_to_finding_unit() -> None:
    """The first number of a message that is neither sample nor name is the value, in its unit."""
    scales = {
        STROKE: 1e3,
        VELOCITY: 1e3,
        ACCELERATION: 1 / GRAVITY_M_S2,
        FORCE: 1e-3,
        BLIND: 1e3,
        REPEATED: 1e3,
        COMMAND: 1e3,
        FOLLOWING: 1e3,
        STUCK: 1.0,
    }
    channel = RIG.channel_by_name["table_acc_m_s2"]
    for code, scale in scales.items():
        text = to_finding(code, 12, channel, 3.217, 2.0, PROFILE).text
        assert f"{3.217 * scale:.4g}" in text.replace(",", " ").split(), code


def test_motion_keys() -> None:
    held = (Label.SETTLE, Label.MEASURE, Label.CHECK)
    for step in (-1, 0, 3):
        labels = np.array([int(label) for label in Label])
        steps, cycles = np.full(labels.size, step), np.full(labels.size, -1)
        values = np.zeros((CHANNEL_COUNT, labels.size))
        block = Block("meas", 0, 2000.0, RIG.channels, values, steps, labels, cycles)
        keys = protection._motion_keys(block, is_swept=False).tolist()
        for label, key, is_history in zip(Label, keys, block.is_history, strict=True):
            if label == Label.REST:
                assert key == 0
            elif step < 0:
                assert key == -1
            elif is_history:
                assert key == 0.5
            else:
                assert key == (2 + step if label in held else 1)
