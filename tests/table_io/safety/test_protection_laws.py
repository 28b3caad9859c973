"""Laws of the protection: every limit in both directions, on all its channels, at any rate.

The signals are those of `test_protection.py`, closed forms of a table that follows exactly; here
size, direction, place, rate and sensor are drawn.
"""

import cmath
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from table_io.block import Block, Float2D, Label
from table_io.channels import LEFT_CELLS, RIGHT_CELLS
from table_io.config.profile import Profile, ProtectionConfig, Specimen
from table_io.config.rig import RigConfig
from table_io.control.order_tracking import evaluate_transfer
from table_io.excitation.drive import Drive
from table_io.excitation.trajectory import plan_sweep
from table_io.records import FrequencyResponse
from table_io.safety import protection
from table_io.safety.protection import (
    Finding,
    Observation,
    confirmation,
    cycle_checks,
    inspect_samples,
    set_response,
    start_protection,
)
from table_io.safety.protection.confirmation import CycleCheckState, SampleSpan, check_cycle
from table_io.safety.protection.consistency import WeakFormPair, compare_motion
from table_io.safety.protection.cycle import DriveCycle, ProtectionContext, Suspicion
from table_io.safety.protection.cycle_checks import PairBaseline, SwingAverage
from table_io.safety.protection.load_cells import ForceShare, check_cell_pairs
from table_io.safety.protection.sample_checks import TABLE_GAIN, TABLE_LAG
from table_io.sensor_errors import PairErrorEstimate, PairErrors, highpass
from table_io.units import GRAVITY_M_S2
from tests.builders.rigs import RIG

NAMES = RIG.channels
DRIVE, TABLE, ACC, MASS, MASS_ACC = range(5)
RATES_HZ = (1000.0, 2000.0, 4000.0)
LAW = settings(
    max_examples=10, derandomize=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)  # fmt: skip
SIGNS = st.sampled_from([-1.0, 1.0])
RATES = st.sampled_from(RATES_HZ)
STROKE_M = 1e-3 * RIG.limits.stroke_mm
SPEED_M_S = 1e-3 * RIG.limits.velocity_mm_s
ACCELERATION_M_S2 = RIG.limits.acceleration_g * GRAVITY_M_S2
FORCE_N = 1e3 * RIG.limits.force_kn
Change = Callable[[Float2D], None]


def make_profile(rate_hz: float, frequency_hz: float = 2.0, level_g: float = 0.05) -> Profile:
    """Return a test of one frequency, held for eleven cycles."""
    return Profile.model_validate(
        {
            "title": "law",
            "specimen": {"mass_kg": 550.0, "gap_mm": 4.0},
            "acquisition": {"rate_hz": rate_hz},
            "sweep": {
                "directions": ("forward",), "start_hz": frequency_hz, "stop_hz": frequency_hz,
                "step_hz": 0.5, "cycles": 11, "measured_cycles": 8, "acceleration_g": level_g,
            },
        }
    )  # fmt: skip


def simulate_channels(drive: Drive, seed: int, noisy: tuple[int, ...] | None = None) -> Float2D:
    """Return what sound sensors measure, (channel, sample); noise on the `noisy` rows, or all."""
    count = drive.rest_start + 200
    values = np.zeros((len(NAMES), count))
    values[[DRIVE, TABLE, MASS]] = drive.command(0, count)
    values[[ACC, MASS_ACC]] = drive.acceleration(0, count)
    rms = np.array([[sensor.noise_rms * sensor.si_per_unit] for sensor in RIG.sensors])
    if noisy is not None:
        rms[[row for row in range(len(NAMES)) if row not in noisy]] = 0.0
    return values + rms * np.random.default_rng(seed).standard_normal(values.shape)


def inspect(
    profile: Profile, change: Change, seed: int = 3, noisy: tuple[int, ...] | None = None
) -> list[Finding]:
    """Return the findings of a sound run in which something was changed."""
    drive = plan_sweep(profile)
    values = simulate_channels(drive, seed, noisy)
    change(values)
    noise = {
        sensor.channel: (sensor.noise_rms * sensor.si_per_unit, 2)
        for row, sensor in enumerate(RIG.sensors)
        if noisy is None or row in noisy
    }
    state = start_protection(profile, RIG, noise)
    findings: list[Finding] = []
    for first in range(0, values.shape[1], 97):
        part = values[:, first : first + 97].copy()
        labels = drive.labels(first, part.shape[1])
        block = Block("meas", first, drive.rate_hz, NAMES, part, *labels)
        clipped = np.zeros(part.shape, dtype=np.bool_)
        state, some = inspect_samples(state, Observation.from_drive(block, clipped, drive))
        findings += some
    return findings


def find_held(profile: Profile) -> int:
    """Return a sample in the third held cycle."""
    drive = plan_sweep(profile)
    held = drive.sine_segments[-2]
    return held.start + round(2.3 * drive.rate_hz / held.f0)


def kinds(findings: list[Finding]) -> set[str]:
    return {finding.kind for finding in findings}


def first_of(findings: list[Finding], kind: str) -> Finding:
    return min((item for item in findings if item.kind == kind), key=lambda item: item.index)


@given(sign=SIGNS, rate_hz=RATES, excess=st.floats(1.01, 3.0))
@LAW
def test_stroke(sign: float, rate_hz: float, excess: float) -> None:
    profile = make_profile(rate_hz)
    at = find_held(profile)

    def hold(share: float) -> Change:
        def change(values: Float2D) -> None:
            values[TABLE, at:] = sign * share * STROKE_M

        return change

    trip = first_of(inspect(profile, hold(excess)), "stroke")
    assert trip.stop
    assert at < trip.index <= at + 2
    assert np.sign(trip.value) == sign
    assert "stroke" not in kinds(inspect(profile, hold(0.99)))


@given(sign=SIGNS, rate_hz=RATES, excess=st.floats(1.2, 4.0))
@LAW
def test_velocity(sign: float, rate_hz: float, excess: float) -> None:
    """A ramp in either direction, told within its difference quotient of 10 ms."""
    profile = make_profile(rate_hz)
    at = find_held(profile)

    def ramp(share: float) -> Change:
        def change(values: Float2D) -> None:
            time_s = np.arange(round(0.02 * rate_hz)) / rate_hz
            values[TABLE, at : at + time_s.size] = (
                values[TABLE, at] + sign * share * SPEED_M_S * time_s
            )
            values[TABLE, at + time_s.size :] = values[TABLE, at + time_s.size - 1]

        return change

    trip = first_of(inspect(profile, ramp(excess)), "velocity")
    assert trip.stop
    assert trip.index <= at + 0.012 * rate_hz + 2
    assert np.sign(trip.value) == sign
    assert "velocity" not in kinds(inspect(profile, ramp(0.9)))


@given(sign=SIGNS, rate_hz=RATES, excess=st.floats(1.02, 1.9))
@LAW
def test_acceleration_and_force(sign: float, rate_hz: float, excess: float) -> None:
    profile = make_profile(rate_hz)
    at = find_held(profile)

    def hold(row: int, value: float) -> Change:
        def change(values: Float2D) -> None:
            values[row, at:] = sign * value

        return change

    trip = first_of(inspect(profile, hold(ACC, excess * ACCELERATION_M_S2)), "acceleration")
    assert (trip.stop, np.sign(trip.value)) == (True, sign)
    assert trip.index <= at + 2
    assert "acceleration" not in kinds(inspect(profile, hold(ACC, 0.98 * ACCELERATION_M_S2)))
    # The force is that of table and mass, so the mass alone can exceed it.
    table_n = 2000.0 * 0.06 * GRAVITY_M_S2
    force = first_of(
        inspect(profile, hold(MASS_ACC, (excess * FORCE_N + table_n) / 550.0)), "force"
    )
    assert (force.stop, np.sign(force.value)) == (True, sign)


@given(rate_hz=RATES, frequency_hz=st.floats(2.0, 8.0), late=st.sampled_from([1, 2]))
@LAW
def test_a_converter_may_be_two_samples_late(
    rate_hz: float, frequency_hz: float, late: int
) -> None:
    """At any slope of the command: what a fast command changes in two samples is no error."""
    profile = make_profile(rate_hz, round(frequency_hz, 1), 0.1)

    def change(values: Float2D) -> None:
        values[DRIVE] = np.roll(values[DRIVE], late)

    assert "command" not in kinds(inspect(profile, change))


@given(rate_hz=RATES, sign=SIGNS, error=st.floats(0.06, 0.3))
@LAW
def test_a_gain_of_the_command_stops_in_both_directions(
    rate_hz: float, sign: float, error: float
) -> None:
    """Of a small command, so that the whole cycles show it and not the single samples."""
    profile = make_profile(rate_hz, 5.0, 0.02)
    at = find_held(profile)

    def change(values: Float2D) -> None:
        values[DRIVE, at:] *= 1.0 + sign * error

    trip = first_of(inspect(profile, change), "command")
    assert (trip.stop, trip.channel) == (True, "drive_disp_m")


@given(rate_hz=RATES, row=st.sampled_from([TABLE, ACC, MASS, MASS_ACC]), size=st.floats(0.5, 200.0))
@LAW
def test_no_jump_hides_the_loss_of_noise(rate_hz: float, row: int, size: float) -> None:
    """A cable that falls off with a jump of any size is found within 400 samples."""
    profile = make_profile(rate_hz)
    at = find_held(profile)
    drive = plan_sweep(profile)
    smooth = simulate_channels(drive, 0, ())
    sigma = RIG.sensors[row].noise_rms * RIG.sensors[row].si_per_unit

    def change(values: Float2D) -> None:
        values[row, at:] = smooth[row, at:]
        values[row, at] += 30.0 * size * sigma

    silent = [finding for finding in inspect(profile, change) if finding.kind == "silent"]
    assert silent, "the loss of noise was not found"
    assert silent[0].index <= at + 400


@pytest.mark.parametrize("rate_hz", RATES_HZ)
@pytest.mark.parametrize("noisy", [(ACC,), (TABLE,), (TABLE, ACC), (TABLE, ACC, MASS, MASS_ACC)])
def test_one_sensor_that_repeats_itself_is_no_repetition(
    noisy: tuple[int, ...], rate_hz: float
) -> None:
    """Two sensors whose noise comes again prove it; one may hang by itself."""
    profile = make_profile(rate_hz)
    at = find_held(profile)

    def change(values: Float2D) -> None:
        values[:, at : at + 40] = values[:, at - 50 : at - 10].copy()

    assert ("repeated" in kinds(inspect(profile, change, noisy=noisy))) == (len(noisy) > 1)


@given(rate_hz=RATES, row=st.sampled_from([TABLE, ACC, MASS]), seed=st.integers(0, 1000))
@LAW
def test_a_sensor_that_comes_back_is_believed_again(rate_hz: float, row: int, seed: int) -> None:
    """Losses shorter than 20 ms, far enough apart, never add up to a lost sensor."""
    profile = make_profile(rate_hz)
    at = find_held(profile)
    loss, pause = round(0.01 * rate_hz), round(0.12 * rate_hz)

    def lose(gap: int) -> Change:
        def change(values: Float2D) -> None:
            for k in range(8):
                values[row, at + k * gap : at + k * gap + loss] = np.nan

        return change

    def is_lost(findings: list[Finding]) -> bool:
        return any(finding.stop for finding in findings)

    assert not is_lost(inspect(profile, lose(pause), seed))
    assert is_lost(inspect(profile, lose(round(1.5 * loss)), seed))


@pytest.mark.parametrize("rate_hz", RATES_HZ)
def test_errors_of_the_command_do_not_count_across_a_repetition(rate_hz: float) -> None:
    """Eight in a row are an error: seven before a repetition and five after it are none."""
    profile = make_profile(rate_hz)
    at = find_held(profile)

    def change(values: Float2D) -> None:
        values[DRIVE, at : at + 40] += 5e-3
        for first in range(at + 3, at + 24, 3):
            values[:, first : first + 3] = values[:, at : at + 3]
        values[DRIVE, at + 29 :] = simulate_channels(plan_sweep(profile), 3)[DRIVE, at + 29 :]

    kinds_seen = kinds(inspect(profile, change))
    assert "repeated" in kinds_seen
    assert "command" not in kinds_seen


# Laws of the cycle checks: one cycle in closed form, each limit in both directions

CYCLE_SAMPLES = 1000  # a cycle of 2 Hz
PHASE = np.arange(CYCLE_SAMPLES) / CYCLE_SAMPLES
WAVE = np.sin(2.0 * math.pi * PHASE)
OMEGA = 4.0 * math.pi
LEVEL_M_S2 = 0.05 * GRAVITY_M_S2
AMPLITUDE_M = LEVEL_M_S2 / OMEGA**2
LSB_M = RIG.output.lsb_m
MANY = settings(max_examples=12, derandomize=True)
# Just inside and just beyond a limit.
SHARES = st.sampled_from([1.0 - 1e-6, 1.0 + 1e-6])


def rename_channel(old: str, new: str) -> RigConfig:
    """The rig with another sensor in place of a channel."""
    sensors = [
        {**sensor.model_dump(), "channel": new if sensor.channel == old else sensor.channel}
        for sensor in RIG.sensors
    ]
    return RigConfig.model_validate(RIG.model_dump() | {"sensors": sensors})


REL_RIG = rename_channel("mass_disp_m", "rel_disp_m")
BARE_RIG = RigConfig.model_validate(
    RIG.model_dump() | {"sensors": [sensor.model_dump() for sensor in RIG.sensors[:3]]}
)


def make_cycle(
    channels: dict[str, Any],
    rig: RigConfig = RIG,
    sigma: dict[str, float] | None = None,
    specimen: dict[str, float] | None = None,
    protection: dict[str, float] | None = None,
    command: Any = -AMPLITUDE_M * WAVE,
    level: float = LEVEL_M_S2,
    label: Label = Label.MEASURE,
) -> DriveCycle:
    """A cycle of 2 Hz at 2000 Hz with these channels, (sample,), the others zero."""
    values = np.zeros((len(rig.channels), CYCLE_SAMPLES))
    for name, row in channels.items():
        values[rig.channels.index(name)] = row
    profile = make_profile(2000.0).model_copy(
        update={
            "specimen": Specimen(**({"mass_kg": 550.0, "gap_mm": 4.0} | (specimen or {}))),
            "protection": ProtectionConfig(**(protection or {})),
        }
    )
    noise = np.array([(sigma or {}).get(name, 0.0) for name in rig.channels])
    context = ProtectionContext(profile, rig, noise, np.full(noise.size, math.inf))
    return DriveCycle(context, values, command, PHASE, level, int(label))


@pytest.mark.parametrize("label", [Label.SETTLE, Label.MEASURE])
@given(
    share=SHARES, sign=SIGNS, alarm=st.floats(0.02, 0.5), abort_db=st.floats(1.0, 12.0),
    level=st.floats(0.1, 5.0),
)  # fmt: skip
@MANY
def test_the_level_has_an_alarm_while_measured_and_a_stop_at_any_time(
    label: Label, share: float, sign: float, alarm: float, abort_db: float, level: float
) -> None:
    def suspect(ratio: float, severity: str, demanded: float = level) -> list[Suspicion]:
        cycle = make_cycle(
            {"table_acc_m_s2": ratio * level * WAVE},
            protection={"alarm": alarm, "abort_db": abort_db}, level=demanded, label=label,
        )  # fmt: skip
        return [item for item in cycle_checks.check_level(cycle) if item.severity == severity]

    ratio = 1.0 + share * sign * alarm
    alarms = suspect(ratio, "alarm")
    assert len(alarms) == (share > 1.0 and label == Label.MEASURE)
    for item in alarms:
        assert (item.kind, item.channel, item.required_checks) == ("level", "table_acc_m_s2", 1)
        assert (item.value, item.limit) == pytest.approx(
            (ratio * level, (1 + sign * alarm) * level)
        )
    ratio = 10.0 ** (share * sign * abort_db / 20.0)
    stops = suspect(ratio, "stop")
    assert len(stops) == (share > 1.0)
    for item in stops:
        bound = 10.0 ** (sign * abort_db / 20.0) * level
        assert (item.kind, item.channel, item.required_checks) == ("level", "table_acc_m_s2", 3)
        assert (item.value, item.limit) == pytest.approx((ratio * level, bound))
    assert suspect(0.0, "stop")
    assert not suspect(9.0, "stop", 0.0)  # at rest no level is demanded
    assert not suspect(math.nan, "stop")


@given(share=SHARES, sign=SIGNS, command_m=st.floats(1e-5, 0.05))
@MANY
def test_the_gain_of_the_command_is_one_within_two_percent_and_a_step_of_the_dac(
    share: float, sign: float, command_m: float
) -> None:
    limit = 0.02 + LSB_M / command_m
    gain = 1.0 + share * sign * limit
    cycle = make_cycle({"drive_disp_m": gain * command_m * WAVE}, command=command_m * WAVE)
    suspicions = list(cycle_checks.check_command_gain(cycle))
    assert len(suspicions) == (share > 1.0)
    for item in suspicions:
        assert (item.kind, item.channel) == ("command", "drive_disp_m")
        assert (item.value, item.limit) == pytest.approx((gain, 1.0 + sign * limit))
    for other in (
        make_cycle({"drive_disp_m": WAVE}, command=0.0 * WAVE),
        make_cycle({"drive_disp_m": math.nan}),
    ):
        assert not list(cycle_checks.check_command_gain(other))


@given(share=SHARES, sign=SIGNS, amplitude_m=st.floats(0.0, 0.05), sigma=st.floats(0.0, 1e-4))
@MANY
def test_the_table_moves_about_its_place_at_rest(
    share: float, sign: float, amplitude_m: float, sigma: float
) -> None:
    limit = 0.075e-3 + 0.02 * amplitude_m + sigma
    mean = share * sign * limit
    cycle = make_cycle({"table_disp_m": amplitude_m * WAVE + mean}, sigma={"table_disp_m": sigma})
    suspicions = list(cycle_checks.check_table_mean(cycle))
    assert len(suspicions) == (share > 1.0)
    for item in suspicions:
        assert (item.kind, item.channel) == ("drift", "table_disp_m")
        assert (item.value, item.limit) == pytest.approx((mean, limit))
    assert not list(cycle_checks.check_table_mean(make_cycle({"table_disp_m": math.nan})))


@pytest.mark.parametrize("rig", [RIG, REL_RIG])
@pytest.mark.parametrize(
    ("gaps", "asymmetry_m"),
    [
        ({}, 0.0),
        ({"gap_mm": math.inf}, 0.0),
        ({"gap_right_mm": 2.0, "gap_left_mm": 8.0}, 3e-3),
        ({"gap_right_mm": 8.0, "gap_left_mm": 2.0}, 3e-3),
    ],
)
@given(share=SHARES, sign=SIGNS, half_m=st.floats(0.0, 0.05))
@MANY
def test_the_mass_swings_about_the_middle_within_a_third_of_its_swing(
    rig: RigConfig, gaps: dict[str, float], asymmetry_m: float,
    share: float, sign: float, half_m: float,
) -> None:  # fmt: skip
    limit = 0.1e-3 + 0.35 * half_m + asymmetry_m
    swing = SwingAverage(share * sign * limit, half_m, 20)
    cycle = make_cycle({}, rig, specimen=gaps)
    suspicions = list(cycle_checks.check_mass_mean(cycle, swing))
    assert len(suspicions) == (share > 1.0)
    for item in suspicions:
        assert (item.kind, item.channel) == ("drift", rig.channels[3])
        assert (item.value, item.limit) == pytest.approx((swing.mean, limit))
    early = replace(swing, check_count=19)
    assert not list(cycle_checks.check_mass_mean(cycle, early))
    assert not list(cycle_checks.check_mass_mean(make_cycle({}, BARE_RIG), swing))


@pytest.mark.parametrize("rig", [RIG, REL_RIG])
def test_the_swing_is_the_mean_of_all_checks_then_of_the_last_twenty_or_so(rig: RigConfig) -> None:
    chance = np.random.default_rng(3)
    average, expected, sums = SwingAverage(), np.zeros(2), np.zeros(2)
    table = 0.01 * WAVE if rig is RIG else 0.0 * WAVE
    for count in range(1, 46):
        mean, half = chance.standard_normal(), abs(chance.standard_normal())
        swing = mean + half * WAVE
        channels = {rig.channels[3]: swing + table, "table_disp_m": table}
        average = cycle_checks.update_swing(make_cycle(channels, rig), average)
        sums += mean, half
        expected += (np.array([mean, half]) - expected) / 20.0
        expected = sums / count if count <= 20 else expected
        assert [average.mean, average.half] == pytest.approx(expected.tolist())
        assert average.check_count == count
    lost = make_cycle({rig.channels[3]: math.nan}, rig)
    assert cycle_checks.update_swing(lost, average) == average


@given(
    lag_s=st.floats(0.0, 0.05), gain=st.floats(0.5, 1.5), a=st.floats(0.0, 9.0),
    low_cut=st.floats(0.0, 3.0),
)  # fmt: skip
@MANY
def test_the_response_and_the_payload_of_a_table_in_closed_form(
    lag_s: float, gain: float, a: float, low_cut: float
) -> None:
    transfer = gain * cmath.exp(-1j * OMEGA * lag_s)
    # Acceleration of the table behind the low cut of its sensor, s / (s + w_c).
    behind = -(OMEGA**2) * 1j * OMEGA / (1j * OMEGA + low_cut)
    tone = -AMPLITUDE_M * np.exp(2j * math.pi * PHASE)
    channels = {
        "table_disp_m": (transfer * tone).imag,
        "table_acc_m_s2": (behind * transfer * tone).imag,
        "mass_acc_m_s2": a * WAVE + 3.0 * np.sin(4 * math.pi * PHASE),
    }
    cycle = make_cycle(channels)
    assert cycle.omega == pytest.approx(OMEGA)
    both = cycle_checks.measure_transfer(cycle, low_cut)
    assert both == pytest.approx((transfer, transfer))
    assert cycle_checks.phase_lag_s(both[0], OMEGA) == pytest.approx(lag_s, abs=1e-9)
    deflection = 550.0 / 2000.0 * a * (0.5 * lag_s) ** 2 / (gain * AMPLITUDE_M)
    assert cycle_checks.payload_deflection(cycle, lag_s) == pytest.approx(deflection, abs=1e-12)
    for name in ("table_disp_m", "table_acc_m_s2", "mass_acc_m_s2"):
        lost = make_cycle({**channels, name: math.nan})
        known = [not cmath.isnan(item) for item in cycle_checks.measure_transfer(lost, low_cut)]
        assert known == [name != "table_disp_m", name != "table_acc_m_s2"]
        if name != "table_acc_m_s2":
            assert cycle_checks.payload_deflection(lost, lag_s) == 0.0
    still = cycle_checks.measure_transfer(make_cycle(channels, command=0.0 * WAVE), low_cut)
    assert all(cmath.isnan(item) for item in still)


@pytest.mark.parametrize("more", [0, 1])  # the sensor that shows the larger change
@pytest.mark.parametrize("a", [0.0, 2.0])
@given(
    share=SHARES, sign=SIGNS, other=SIGNS, larger=st.floats(1.001, 1.2), lag_s=st.floats(0.0, 0.02)
)
@MANY
def test_the_response_has_changed_where_both_sensors_show_it(
    more: int, a: float, share: float, sign: float, other: float, larger: float, lag_s: float
) -> None:
    cycle = make_cycle({"table_disp_m": AMPLITUDE_M * WAVE, "mass_acc_m_s2": a * WAVE})
    reference = 0.9 * cmath.exp(-1j * OMEGA * lag_s)
    deflection = 550.0 / 2000.0 * a * (0.5 * lag_s) ** 2 / AMPLITUDE_M

    def suspect(ratios: list[complex]) -> list[Suspicion]:
        first, second = reversed(ratios) if more == 0 else ratios
        pair = (first * reference, second * reference)
        return list(cycle_checks.check_response(cycle, pair, reference))

    limit = 0.2 + deflection
    gains = suspect([1.0 + sign * share * limit, 1.0 + other * larger * limit])
    assert len(gains) == (share > 1.0)
    for item in gains:
        assert (item.kind, item.channel) == ("response", "table_acc_m_s2")
        assert item.value == pytest.approx(1.0 + sign * share * limit)
        assert item.limit == pytest.approx(1.0 + sign * limit)
    limit_s = max(0.5 * lag_s, 0.003) + deflection / OMEGA
    extra_s = sign * share * limit_s, other * larger * limit_s
    lags = suspect([cmath.exp(-1j * OMEGA * each) for each in extra_s])
    assert len(lags) == (share > 1.0)
    for item in lags:
        assert (item.kind, item.channel) == ("response", "table_disp_m")
        assert item.value == pytest.approx(lag_s + extra_s[0])
        assert item.limit == pytest.approx(lag_s + sign * limit_s)
    assert suspect([complex("nan"), 2.0]) == suspect([2.0, complex("nan")]) == []
    assert suspect([0j, 2.0]) == suspect([2.0, 0j]) == []


# Laws of the comparison of a displacement with an acceleration

PAIRS = [
    (RIG, cycle_checks.SENSOR_PAIRS[0], 2.0),
    (RIG, cycle_checks.SENSOR_PAIRS[1], 5.0),
    (REL_RIG, cycle_checks.SENSOR_PAIRS[2], 5.0),
]


def make_pair(
    displacement: list[float],
    acceleration: list[float],
    constant: tuple[float, float, float] = (1.0, 0.0, 0.0),
    sigma: float = 0.0,
) -> WeakFormPair:
    """Return a pair of these amplitudes without low cut and delay; noise in the average only."""
    zeros = np.zeros(3, dtype=np.complex128)
    amplitudes = np.array([displacement, acceleration, constant], dtype=np.complex128)
    noise = np.array([sigma, 1e-12, 1e-12])
    return WeakFormPair(amplitudes[0], amplitudes[1], amplitudes[2], noise, zeros, zeros)


def make_baseline(checks: int, gain: float = 1.0, last: WeakFormPair | None = None) -> PairBaseline:
    return PairBaseline(last, PairErrorEstimate(PairErrors(gain), check_count=checks))


def suspect_pair(
    rig: RigConfig, names: tuple[tuple[str, ...], str], pair: WeakFormPair, baseline: PairBaseline
) -> list[Suspicion]:
    return list(cycle_checks.check_sensor_pair(make_cycle({}, rig), *names, pair, baseline))


@pytest.mark.parametrize(("rig", "names", "range_g"), PAIRS)
@given(
    share=SHARES, sign=SIGNS, gain=st.floats(0.97, 1.03), size=st.floats(0.5, 20.0),
    order=st.sampled_from([1, 2]), checks=st.sampled_from([0, 5, 6, 20]),
)  # fmt: skip
@MANY
def test_two_sensors_fit_within_an_eighth_and_within_a_twentieth_of_what_they_did(
    rig: RigConfig, names: tuple[tuple[str, ...], str], range_g: float,
    share: float, sign: float, gain: float, size: float, order: int, checks: int,
) -> None:  # fmt: skip
    displacements, _ = names

    def suspect(limit: float, expected: float, at: int, baseline: PairBaseline) -> list[Suspicion]:
        motion = [0.0, size, size]
        moved = [0.0, expected * size, expected * size]
        moved[at] *= 1.0 - share * limit if sign < 0 else 1.0 / (1.0 - share * limit)
        return suspect_pair(rig, names, make_pair(motion, moved), baseline)

    def check(suspicions: list[Suspicion], limit: float, expected: bool) -> None:
        assert len(suspicions) == expected
        for item in suspicions:
            assert (item.kind, item.channel) == ("consistency", displacements[0])
            assert item.group == displacements[0]
            assert (item.value, item.limit) == pytest.approx((share * limit, limit))

    # Of either order of the motion, whatever is known of the pair.
    if order == 2 or checks < 6:
        check(suspect(0.12, 1.0, order, make_baseline(checks)), 0.12, share > 1.0)
    # Of the fundamental, from the gain that the pair had, once that is known.
    check(suspect(0.05, gain, 1, make_baseline(checks, gain)), 0.05, share > 1.0 and checks >= 6)


@pytest.mark.parametrize(("rig", "names", "range_g"), PAIRS)
@given(
    share=SHARES, sign=SIGNS, average=st.floats(1.0, 5.0), sigma=st.floats(0.0, 0.05),
    checks=st.sampled_from([0, 6]), wave=st.floats(3.0, 9.0),
)  # fmt: skip
@MANY
def test_an_offset_is_a_drift_of_the_accelerometer(
    rig: RigConfig, names: tuple[tuple[str, ...], str], range_g: float,
    share: float, sign: float, average: float, sigma: float, checks: int, wave: float,
) -> None:  # fmt: skip
    _, acceleration = names

    def suspect(pair: WeakFormPair) -> Suspicion | None:
        suspicions = suspect_pair(rig, names, pair, make_baseline(checks))
        assert len(suspicions) <= 1
        return suspicions[0] if suspicions else None

    def is_drift(item: Suspicion | None, value: float, limit: float) -> bool:
        if item is None or item.kind != "drift":
            return False
        assert item.channel == acceleration
        assert (item.value, item.limit) == pytest.approx((value, limit))
        return True

    # Below an error of gain of the average, and where it spoils nothing else.
    max_offset = 1e-3 * range_g * GRAVITY_M_S2 + 6.0 * sigma
    limit = max_offset + 0.12 * average
    offset = sign * share * limit
    motion = [-sign * average, wave, wave]
    item = suspect(make_pair(motion, [motion[0] + offset, wave, wave], sigma=sigma))
    assert (item is not None) == is_drift(item, offset, limit) == (share > 1.0)
    # Where it spoils the motion, it explains the difference, or most of it.
    offset, spoiled = sign * share * max_offset, 0.5 * wave
    constant = (1.0, spoiled / offset, 0.0)
    limit = 1e-3 * range_g * GRAVITY_M_S2
    weight = 1.0 + constant[1] ** 2
    limit += 6.0 * math.hypot(sigma, constant[1] * 1e-12) / weight
    offset = sign * share * limit
    constant = (1.0, spoiled / offset, 0.0)
    item = suspect(make_pair([0.0, wave, wave], [offset, wave + spoiled, wave], constant))
    assert item is not None
    assert is_drift(item, offset, 1e-3 * range_g * GRAVITY_M_S2) == (
        abs(offset) > 1e-3 * range_g * GRAVITY_M_S2
    )
    offset = 10.0 * sign * max_offset
    constant = (1.0, spoiled / offset, 0.0)
    rest = 0.3 * share * spoiled
    item = suspect(make_pair([0.0, wave, wave], [offset, wave + spoiled, wave + rest], constant))
    assert item is not None
    assert (item.kind == "drift") == (share < 1.0)


@pytest.mark.parametrize(("rig", "names", "range_g"), PAIRS)
@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("change", [0.5, 1.0, 1.5])
def test_the_sensor_that_changed_more_is_suspected(
    rig: RigConfig, names: tuple[tuple[str, ...], str], range_g: float, sign: float, change: float
) -> None:
    displacements, acceleration = names
    pair = make_pair([0.0, 11.0, 9.0], [0.0, 14.0, 9.0])
    last = make_pair([5.0, 11.0 - sign, 2.0], [3.0, 14.0 - sign * change, 7.0])
    (item,) = suspect_pair(rig, names, pair, PairBaseline(last))
    assert item.channel == (acceleration if change > 1.0 else displacements[0])


def test_a_pair_is_known_after_six_clear_comparisons() -> None:
    clear, unclear = make_pair([0.0, 9.0, 9.0], [0.0, 9.0, 9.0]), make_pair([0.0] * 3, [0.0] * 3)
    baseline = PairBaseline()
    for count in range(1, 9):
        baseline = baseline.update(unclear, OMEGA)
        assert (baseline.last, baseline.estimate.check_count) == (unclear, count - 1)
        baseline = baseline.update(clear, OMEGA)
        assert (baseline.last, baseline.estimate.check_count) == (clear, count)
        assert baseline.is_known == (count >= 6)


@pytest.mark.parametrize(("rig", "names", "range_g"), PAIRS)
def test_the_displacements_of_a_pair_add_up_and_so_does_their_noise(
    rig: RigConfig, names: tuple[tuple[str, ...], str], range_g: float
) -> None:
    displacements, acceleration = names
    chance = np.random.default_rng(4)
    sizes = {name: chance.uniform(1e-3, 5e-3) for name in displacements}
    sigma = {name: chance.uniform(1e-6, 1e-5) for name in (*displacements, acceleration)}
    a = chance.standard_normal(CYCLE_SAMPLES)
    channels = {name: size * WAVE for name, size in sizes.items()} | {acceleration: a}
    cycle = make_cycle(channels, rig, sigma)
    filtered = chance.standard_normal(CYCLE_SAMPLES)
    x, noise = sum(sizes.values()) * WAVE, math.hypot(*(sigma[name] for name in displacements))
    expected = compare_motion(cycle.window, x, a, (noise, sigma[acceleration]), (filtered, 0.7))
    pair = cycle_checks.compare_sensor_pair(cycle, displacements, acceleration, filtered, 0.7)
    for name in ("displacement", "acceleration", "sigma", "low_cut_term", "delay_term"):
        np.testing.assert_allclose(getattr(pair, name), getattr(expected, name), rtol=1e-9)


# Laws of the load cells

SIDES = pytest.mark.parametrize(("side", "direction"), [(RIGHT_CELLS, 1.0), (LEFT_CELLS, -1.0)])


@SIDES
@given(share=SHARES, sign=SIGNS, sigma=st.floats(0.0, 50.0), other=st.sampled_from([0.0, 2.0]))
@MANY
def test_cells_bear_nothing_while_the_mass_is_on_the_other_side(
    side: tuple[str, str], direction: float, share: float, sign: float, sigma: float, other: float
) -> None:
    u = direction * 0.01 * WAVE
    count = int((direction * u < 0).sum())
    limit = 5.0 + 6.0 * sigma / math.sqrt(count)
    offset = sign * share * limit
    for first, second in (side, side[::-1]):
        channels = {"mass_disp_m": u, first: offset, second: other * offset}
        suspicions, shares = check_cell_pairs(make_cycle(channels, sigma={first: sigma}), {})
        expected = {first} if share > 1.0 else set()
        expected |= {second} if other else set()
        if len(expected) == 2:  # then the displacement is
            expected = {"mass_disp_m"}
        assert {item.channel for item in suspicions} == expected
        assert {item.kind for item in suspicions} <= {"drift"}
        if expected == {first}:
            assert (suspicions[0].value, suspicions[0].limit) == pytest.approx((offset, limit))
        assert shares == {}
        for gap_mm in (0.0, -3.0):
            closed = make_cycle(channels, sigma={first: 1.0}, specimen={"gap_mm": gap_mm})
            assert check_cell_pairs(closed, {}) == ([], {})
        unmeasured = make_cycle(channels | {"mass_disp_m": math.nan}, sigma={first: 1.0})
        assert check_cell_pairs(unmeasured, {}) == ([], {})
    alone = make_cycle({"mass_disp_m": u, side[0]: 2.0 * offset, side[1]: math.nan})
    assert [item.channel for item in check_cell_pairs(alone, {})[0]] == [side[0]]


@SIDES
@pytest.mark.parametrize("count", [4, 5])
def test_five_samples_without_contact_show_the_force_of_a_cell(
    side: tuple[str, str], direction: float, count: int
) -> None:
    u = np.where(np.arange(CYCLE_SAMPLES) < count, -1e-3, np.where(PHASE < 0.5, 0.0, 1e-3))
    cycle = make_cycle({"mass_disp_m": direction * u, side[0]: 20.0})
    assert len(check_cell_pairs(cycle, {})[0]) == (count >= 5)
    # Contact on the own side bears nothing on the other one.
    pushed = make_cycle({"mass_disp_m": direction * u, side[0]: np.where(u >= 0, 1e3, 0.0)})
    assert check_cell_pairs(pushed, {side[0]: ForceShare(0.0, (500.0, 0.0))})[0] == []


def share_force(
    side: tuple[str, str], angle: float, force_n: float, means: tuple[float, float] = (0.0, 0.0),
    sigma: float = 0.0,
) -> DriveCycle:  # fmt: skip
    """A cycle with a swinging force at this angle between both cells, precompressed."""
    first, second = math.cos(angle), math.sin(angle)
    channels = {
        side[0]: force_n * first * WAVE + means[0],
        side[1]: force_n * second * WAVE + means[1],
    }
    noise = {side[0]: sigma, side[1]: 0.5 * sigma}
    return make_cycle(channels, sigma=noise, specimen={"gap_mm": -1.0})


@SIDES
@given(
    share=SHARES, sign=SIGNS, angle=st.floats(0.4, 1.1), sigma=st.sampled_from([0.0, 0.1, 2.0]),
    less=st.sampled_from([0, 1]), force_n=st.floats(200.0, 2e3),
)  # fmt: skip
@MANY
def test_two_cells_share_a_force_as_before_and_at_first_not_too_unevenly(
    side: tuple[str, str], direction: float,
    share: float, sign: float, angle: float, sigma: float, less: int, force_n: float,
) -> None:  # fmt: skip
    sigma_angle = sigma / math.sqrt(CYCLE_SAMPLES) / (force_n / math.sqrt(2.0))
    means = (300.0, 400.0) if less == 0 else (400.0, 300.0)
    for expected, max_change, before in (
        (math.pi / 4, math.radians(25.0), {}),
        (angle, math.radians(3.0), {side[0]: ForceShare(angle, means, 7)}),
    ):
        measured = expected + sign * share * (max_change + 6.0 * sigma_angle)
        cycle = share_force(side, measured, force_n, means, sigma)
        suspicions, shares = check_cell_pairs(cycle, before)
        assert len(suspicions) == (share > 1.0)
        for item in suspicions:
            assert (item.kind, item.channel, item.group) == ("share", side[less], side[0])
            assert (item.value, item.limit) == pytest.approx(
                (measured, expected + sign * max_change)
            )
            assert shares == before
        if not suspicions:
            weight = 1.0 / 8.0 if before else 1.0
            start = expected if before else 0.0
            assert shares[side[0]].angle == pytest.approx(start + weight * (measured - start))
            assert shares[side[0]].check_count == (8 if before else 1)
            assert shares[side[0]].means == pytest.approx(means)
    # A force within its noise says nothing; the force is the root mean square of both.
    force_n = 20.0 * sigma * math.sqrt(2.0) * share
    assert (
        side[0] in check_cell_pairs(share_force(side, angle, force_n, means, sigma), {})[1]
    ) == (share > 1.0 and sigma > 0.0)


@SIDES
@given(
    share=SHARES, sign=SIGNS, angle=st.floats(0.4, 1.1), sigma=st.sampled_from([0.0, 0.1, 2.0]),
    along_n=st.floats(-300.0, 300.0), count=st.sampled_from([1, 4, 20]),
)  # fmt: skip
@MANY
def test_a_cell_drifts_where_the_mean_forces_leave_their_axis(
    side: tuple[str, str], direction: float,
    share: float, sign: float, angle: float, sigma: float, along_n: float, count: int,
) -> None:  # fmt: skip
    """A force along the axis is a load; across it, half the contact force on both cells."""
    force_n, before = 1e3, ForceShare(angle, (50.0, 70.0), count)
    sigma_mean = sigma / math.sqrt(CYCLE_SAMPLES)
    sigma_angle = sigma_mean / (force_n / math.sqrt(2.0)) / math.sqrt(count)
    across_n = 5.0 * math.sqrt(2.0)
    for _ in range(50):  # the uncertainty grows with the force itself
        uncertainty = sigma_angle * math.hypot(along_n, across_n)
        across_n = 5.0 * math.sqrt(2.0) + 6.0 * math.hypot(uncertainty, 2.0 * sigma_mean)
    limit, across_n = across_n, share * sign * across_n
    means = (
        50.0 + along_n * math.cos(angle) - across_n * math.sin(angle),
        70.0 + along_n * math.sin(angle) + across_n * math.cos(angle),
    )
    cycle = share_force(side, angle, force_n, means, sigma)
    suspicions, shares = check_cell_pairs(cycle, {side[0]: before})
    assert len(suspicions) == (share > 1.0)
    for item in suspicions:
        assert (item.kind, item.channel) == ("drift", side[0] if sign < 0 else side[1])
        assert item.value == pytest.approx(abs(across_n))
        assert item.limit == pytest.approx(limit, rel=1e-5)
    if not suspicions and count < 20:
        expected = [
            old + (new - old) / (count + 1) for old, new in zip((50, 70), means, strict=True)
        ]
        assert shares[side[0]].means == pytest.approx(expected)
    if count == 20:
        assert shares[side[0]] == before  # fixed from then on


# Laws of the schedule: which samples are checked together, and when a suspicion is confirmed


def make_span(
    first: int, count: int, key: int = 1, channels: dict[str, Any] | None = None,
    rig: RigConfig = RIG, is_half_cycle: bool = True,
) -> SampleSpan:  # fmt: skip
    """Samples of a table that follows exactly at 2 Hz; the phase starts again at every cycle."""
    phase = (np.arange(first, first + count) / CYCLE_SAMPLES + 0.3) % 1.0
    wave = np.sin(2 * math.pi * phase)
    values = np.zeros((len(rig.channels), count))
    values[[DRIVE, TABLE]] = -AMPLITUDE_M * wave
    values[ACC] = LEVEL_M_S2 * wave
    if rig is not BARE_RIG:
        values[MASS] = -AMPLITUDE_M * wave if rig is RIG else 0.0
        values[MASS_ACC] = LEVEL_M_S2 * wave
    for name, factor in (channels or {}).items():
        values[rig.channels.index(name)] *= factor
    label = int(Label.MEASURE if key > 1 else Label.BLEND)
    return SampleSpan(values, -AMPLITUDE_M * wave, phase, LEVEL_M_S2, label, key, is_half_cycle)


@pytest.mark.parametrize("rig", [RIG, REL_RIG, BARE_RIG])
@given(counts=st.lists(st.integers(2, 1100), min_size=1, max_size=12))
@settings(max_examples=5, derandomize=True)
def test_a_check_takes_the_fewest_spans_that_make_a_whole_cycle(
    rig: RigConfig, counts: list[int]
) -> None:
    context = make_cycle({}, rig).context
    state, first, spans = CycleCheckState(), 0, []
    low_cuts = {"table_disp_m": 1.3, "mass_disp_m": 0.4, "rel_disp_m": 2.2}
    baselines = {
        name: PairBaseline(None, PairErrorEstimate(PairErrors(1.0, low_cut)))
        for name, low_cut in low_cuts.items()
    }
    state = replace(state, pair_baselines=baselines)
    for count in counts:
        span = make_span(first, count, rig=rig)
        first += count
        spans.append(span)
        state = replace(check_cycle(context, state, span)[0], pair_baselines=baselines)
        sizes = [item.phase.size for item in spans]
        fewest = next(
            (k for k in range(1, len(sizes) + 1) if sum(sizes[-k:]) > 0.999 * CYCLE_SAMPLES),
            len(sizes),
        )
        assert [item.phase.size for item in state.spans] == sizes[-fewest:]
        assert confirmation._count_cycles(spans) == pytest.approx(first / CYCLE_SAMPLES)
        cycle = confirmation._join_spans(context, list(state.spans))
        begin = first - sum(sizes[-fewest:])
        expected = np.arange(begin, first) / CYCLE_SAMPLES + 0.3
        assert cycle.phase == pytest.approx(expected - math.floor(expected[0]))
        assert cycle.command == pytest.approx(-AMPLITUDE_M * np.sin(2 * math.pi * expected))
        assert (cycle.level, cycle.label) == (LEVEL_M_S2, int(Label.BLEND))
        assert cycle.values[TABLE] == pytest.approx(cycle.command)
        # The high-pass runs on from span to span as over all samples in one.
        joined = np.concatenate([item.values for item in spans], axis=1)
        for names, acceleration in cycle_checks.SENSOR_PAIRS:
            if not {*names, acceleration} <= {*rig.channels}:
                assert names[0] not in state.spans[-1].filtered
                continue
            x = sum(joined[rig.channels.index(name)] for name in names)
            whole = highpass(np.asarray(x), low_cuts[names[0]], 2000.0)
            filtered = np.concatenate([item.filtered[names[0]] for item in state.spans])
            assert filtered == pytest.approx(whole[-filtered.size :], abs=1e-12)


@pytest.mark.parametrize(
    ("name", "factor", "kind"),
    [
        ("mass_acc_m_s2", 3.0, "consistency"),
        ("mass_disp_m", 3.0, "consistency"),
        ("table_acc_m_s2", 5.0, "level"),
        ("drive_disp_m", 1.3, "command"),
    ],
)
@pytest.mark.parametrize("pause", [None, 3, 5])
def test_a_suspicion_is_confirmed_by_the_third_check_in_a_row(
    name: str, factor: float, kind: str, pause: int | None
) -> None:
    """Checks begin with the second half cycle; a sound one, or a rest, starts the count again."""
    context, state, numbers = make_cycle({}).context, CycleCheckState(), []
    for number in range(1, 11):
        channels = {} if number in (pause, pause and pause + 1) else {name: factor}
        span = make_span(500 * (number - 1), 500, 2, channels)
        state, suspicions = check_cycle(context, state, span)
        numbers += [
            number for item in suspicions if item.kind == kind and item.required_checks == 3
        ]
    # Two sound half cycles make a sound check.
    assert numbers == {None: [4], 3: [7], 5: [4, 9]}[pause]
    rested, suspicions = check_cycle(context, state, make_span(5000, 500, 0))
    assert (rested.spans, dict(rested.streaks), suspicions) == ((), {}, ())


def test_a_motion_is_steady_over_two_half_cycles_of_one_step() -> None:
    """Only then are level and command checked: not in blends, nor across steps or parts of them."""
    context, wrong = make_cycle({}).context, {"drive_disp_m": 1.3}
    for keys, is_half, steady in (
        ((2, 2), (True, True), True),
        ((5, 5), (True, True), True),
        ((1, 1), (True, True), False),
        ((1, 2), (True, True), False),
        ((2, 3), (True, True), False),
        ((2, 2), (False, True), False),
        ((2, 2), (True, False), False),
    ):
        state = CycleCheckState()
        for k in range(2):
            span = make_span(500 * k, 500, keys[k], wrong, is_half_cycle=is_half[k])
            state, _ = check_cycle(context, state, span)
        assert (("command", "drive_disp_m", "sensor") in state.streaks) == steady, keys
    whole = check_cycle(context, CycleCheckState(), make_span(0, 1000, 2, wrong))[0]
    assert ("command", "drive_disp_m", "sensor") not in whole.streaks


@given(gain=st.floats(0.6, 1.4), lag_s=st.floats(0.0, 0.09), share=SHARES, sign=SIGNS)
@MANY
def test_gain_and_lag_of_the_table_are_adopted_if_plausible(
    gain: float, lag_s: float, share: float, sign: float
) -> None:
    def update(state: CycleCheckState, gain: float, lag_s: float) -> CycleCheckState:
        table = gain * cmath.exp(-2j * math.pi * 1.5 * lag_s)
        return state.update_table_response(table, 1.5)

    unknown = CycleCheckState()
    state = update(unknown, gain, lag_s)
    assert (state.gain, state.lag_s) == pytest.approx((gain, lag_s), abs=1e-9)
    assert (update(unknown, 1.5 / share, lag_s) is not unknown) == (share > 1.0)
    assert (update(unknown, 0.5 * share, lag_s) is not unknown) == (share > 1.0)
    assert (update(unknown, gain, 0.1 / share) is not unknown) == (share > 1.0)
    assert update(unknown, gain, -1e-6 - lag_s) is unknown
    for bound in (0.5, 1.5):  # themselves excluded, a lag of zero is not
        assert unknown.update_table_response(complex(bound), 1.5) is unknown
        inside = complex(float(np.nextafter(bound, 1.0)))
        assert unknown.update_table_response(inside, 1.5).lag_s == 0.0
    known = replace(unknown, gain=1.0, lag_s=0.0 if sign < 0 else 0.02)
    assert (update(known, 1.0 + 0.1 * sign * share, lag_s) is known) == (share > 1.0)


def test_a_frequency_keeps_the_response_of_its_first_sound_check() -> None:
    context, state = make_cycle({}).context, CycleCheckState()
    table = {"table_disp_m": 1.1, "table_acc_m_s2": 1.1, "mass_disp_m": 1.1, "mass_acc_m_s2": 1.1}
    for number, channels in enumerate(({"drive_disp_m": 1.3}, {}, table)):
        for k in (2 * number, 2 * number + 1):
            span = make_span(500 * k, 500, 2 + number, channels)
            state, _ = check_cycle(context, state, span)
        if number == 0:
            assert state.visited_responses == {}  # a suspicion is no reference
        else:
            assert list(state.visited_responses) == [2.0]
            assert state.visited_responses[2.0] == pytest.approx(1.0)


@pytest.mark.parametrize("rate_hz", [1000.0, 4000.0])
def test_every_sample_goes_to_the_cycle_checks_once(
    monkeypatch: pytest.MonkeyPatch, rate_hz: float
) -> None:
    """In spans that end at half a cycle or with the motion, whatever the blocks were."""
    spans: list[SampleSpan] = []

    def record(_: ProtectionContext, state: CycleCheckState, span: SampleSpan) -> Any:
        spans.append(span)
        return state, ()

    monkeypatch.setattr(protection, "check_cycle", record)
    profile = make_profile(rate_hz)
    drive = plan_sweep(profile)
    inspect(profile, lambda _: None)
    measured = simulate_channels(drive, 3)
    labels, level = drive.labels(0, drive.rest_start + 200), drive.level(0, drive.rest_start + 200)
    first = 0
    for span in spans:
        last = first + span.phase.size
        np.testing.assert_array_equal(span.values, measured[:, first:last])
        np.testing.assert_array_equal(span.command, drive.command(first, last - first))
        np.testing.assert_array_equal(span.phase, drive.phase(first, last - first))
        assert (span.level, span.label) == (level[last - 1], labels[1][last - 1])
        is_held = span.label in (Label.SETTLE, Label.MEASURE)
        assert span.key == (2 if is_held else span.label != Label.REST)
        half = 0.5 * rate_hz / 2.0
        if is_held:  # eleven cycles are 22 halves, of which the last ends with the motion
            assert span.phase.size == pytest.approx(half, abs=1)
        first = last
    assert first >= drive.rest_start
    halves = [span.is_half_cycle for span in spans if span.key == 2]
    assert halves[:21] == [True] * 21
    blends = [span for span in spans if span.key == 1]
    assert not blends[-1].is_half_cycle


@pytest.mark.parametrize("is_history", [False, True])
def test_the_response_of_the_loop_check_is_that_at_the_first_step(is_history: bool) -> None:
    """Of a history, which has no step, that in the middle of its band on a logarithmic scale."""
    profile = make_profile(2000.0, 3.0)
    if is_history:
        raw = {"title": "band", "specimen": {"mass_kg": 550.0, "gap_mm": 4.0}}
        chirp = {"kind": "chirp", "start_hz": 1.0, "stop_hz": 9.0, "duration_s": 20.0}
        profile = Profile.model_validate(raw | {"excitation": chirp | {"acceleration_g": 0.02}})
    lags_s, frequencies_hz = (0.012, 0.015, 0.02), (1.0, 3.0, 9.0)
    phases = tuple(-2 * math.pi * f * lag for f, lag in zip(frequencies_hz, lags_s, strict=True))
    response = FrequencyResponse(0, frequencies_hz, (1.0, 0.9, 0.7), phases)
    state = set_response(start_protection(profile, RIG, {}), response)
    plan = profile.plan
    frequency_hz = math.sqrt(plan.low_hz * plan.high_hz)
    assert frequency_hz == pytest.approx(3.0, rel=0.05)
    table = evaluate_transfer(response, frequency_hz)
    assert state.cycle_state.response is response
    lag_s = -cmath.phase(table) / (2 * math.pi * frequency_hz)
    assert (state.cycle_state.gain, state.cycle_state.lag_s) == pytest.approx((abs(table), lag_s))
    scalars = state.sample_state.scalars
    assert (scalars[TABLE_GAIN], scalars[TABLE_LAG]) == pytest.approx((abs(table), lag_s))
