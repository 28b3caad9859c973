"""Laws of the protection: every limit in both directions, on all its channels, at any rate.

The signals are those of `test_protection.py`, closed forms of a table that follows exactly; here
size, direction, place, rate and sensor are drawn.
"""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from table_io.block import Block, Float2D
from table_io.config.profile import Profile
from table_io.excitation.drive import Drive
from table_io.excitation.trajectory import plan_sweep
from table_io.safety.protection import Finding, Observation, inspect_samples, start_protection
from table_io.units import GRAVITY_M_S2
from tests.table_io.safety.guarded import RIG

NAMES = RIG.channels
DRIVE, TABLE, ACC, MASS, MASS_ACC = range(5)
RATES_HZ = (1000.0, 2000.0, 4000.0)
LAW = settings(
    max_examples=10, deadline=None, derandomize=True,
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
