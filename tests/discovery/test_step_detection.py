"""Steps found in a motion without labels, against the drives that this project plays itself."""

import numpy as np
import pytest
from scipy.signal import butter, chirp, lfilter

from table_io.block import Float1D, Label
from table_io.config.base import parse_toml
from table_io.config.profile import Profile
from table_io.excitation.trajectory import plan_sweep
from twin.compare.step_detection import DetectedSteps, find_steps

CASE = """
title = "Case"
[specimen]
mass_kg = 550.0
gap_mm = 4.0
[acquisition]
rate_hz = {rate}
[sweep]
start_hz = {start}
stop_hz = {stop}
step_hz = {step}
cycles = {cycles}
"""
FINE = {"start": 0.5, "stop": 0.8, "step": 0.03, "cycles": 5, "rate": 1000.0}
CASES = {
    "fine": FINE,
    "long": {**FINE, "stop": 0.59, "cycles": 30},
    "high": {"start": 9.0, "stop": 10.0, "step": 0.1, "cycles": 5, "rate": 2000.0},
    "wide": {"start": 0.5, "stop": 10.0, "step": 0.5, "cycles": 6, "rate": 1000.0},
    "slowly sampled": {"start": 0.5, "stop": 2.0, "step": 0.1, "cycles": 10, "rate": 200.0},
}


def case(name: str) -> Profile:
    return parse_toml(CASE.format(**CASES[name]), Profile, name)


def motion(profile: Profile, channel: str, noise: float = 0.0) -> Float1D:
    """The ideal table's motion with noise relative to the amplitude at each step, (sample,)."""
    drive = plan_sweep(profile)
    count = drive.planned_end + round(0.5 * drive.rate_hz)
    step = drive.labels(0, count)[0]
    x = drive.command(0, count) if channel == "disp" else drive.acceleration(0, count)
    scale = np.array([np.abs(x[step == number]).max() for number in range(step.max() + 1)])
    rms = noise * np.where(step < 0, scale.min(), scale[step])
    return x + rms * np.random.default_rng(1).standard_normal(count)


def late(profile: Profile, steps: DetectedSteps) -> Float1D:
    """By how many cycles each step's measured ones begin and end off the true ones."""
    drive = plan_sweep(profile)
    step, label, _ = drive.labels(0, steps.step.size)
    off = []
    for planned in profile.sweep.steps:
        true, detected = (
            np.flatnonzero((s == planned.index) & (m == Label.MEASURE))
            for s, m in ((step, label), (steps.step, steps.label))
        )
        off.append((detected[[0, -1]] - true[[0, -1]]) * planned.frequency_hz / drive.rate_hz)
    return np.abs(np.concatenate(off))


@pytest.mark.parametrize("channel", ["disp", "acc"])
@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_found_steps_are_the_driven_ones(name: str, channel: str, noise: float) -> None:
    profile = case(name)
    x = motion(profile, channel, noise)
    detected = find_steps(x, profile.acquisition.rate_hz, profile.sweep, is_acc=channel == "acc")
    assert detected.steps == profile.sweep.steps
    off = late(profile, detected)
    # Large jumps of frequency have longer blends, whose length is seen less well.
    assert off.max() < (0.5 if name == "wide" else 0.15) + 6 * noise
    assert np.median(off) < 0.05 + 2 * noise


@pytest.mark.parametrize("beat_hz", [0.0, 0.3])
def test_the_hum_of_a_sensor_at_rest_is_no_step(beat_hz: float) -> None:
    """Lines of the mains may beat, so that the quietest part of the rest is quieter than others."""
    profile = case("fine")
    x = np.concatenate([np.zeros(2000), motion(profile, "disp")])
    time = np.arange(x.size) / 1000
    beat = 1.0 + 0.5 * np.sin(2 * np.pi * beat_hz * time)
    hum = beat * np.sin(2 * np.pi * 50.0 * time)
    noise = 0.3 * np.random.default_rng(3).standard_normal(x.size)
    x += 0.01 * np.abs(x).max() * (hum + noise)
    detected = find_steps(x, 1000.0, profile.sweep)
    assert detected.steps == profile.sweep.steps
    assert np.mean(detected.label[:2000] == Label.REST) > 0.9


def test_cycles_are_numbered_and_the_last_are_measured() -> None:
    profile = case("fine")
    detected = find_steps(motion(profile, "disp"), 1000.0, profile.sweep)
    for step in profile.sweep.steps:
        own = detected.step == step.index
        assert set(detected.cycle[own]) - {-1} == set(range(5))
        assert set(detected.cycle[own & (detected.label == Label.MEASURE)]) == {2, 3, 4}
    assert set(detected.label[detected.step < 0]) == {Label.REST, Label.BLEND}
    assert (detected.label[:400] == Label.REST).all()


def test_lost_samples_cost_no_step() -> None:
    profile = case("fine")
    x = motion(profile, "disp", 0.01)
    for first in range(3000, x.size, 9000):
        x[first : first + 150] = np.nan
    detected = find_steps(x, 1000.0, profile.sweep)
    assert detected.steps == profile.sweep.steps
    assert late(profile, detected).max() < 0.5


def test_without_a_grid_frequencies_and_levels_are_measured() -> None:
    profile = case("fine")
    detected = find_steps(motion(profile, "disp", 0.01), 1000.0, profile.sweep, on_grid=False)
    pairs = list(zip(detected.steps, profile.sweep.steps, strict=True))
    assert [step.direction for step, _ in pairs] == [true.direction for _, true in pairs]
    for step, true in pairs:
        assert step.frequency_hz == pytest.approx(true.frequency_hz, rel=1e-3)
        assert step.acceleration_m_s2 == pytest.approx(true.acceleration_m_s2, rel=0.01)
    assert any(step.frequency_hz != true.frequency_hz for step, true in pairs)


def test_a_burst_of_low_level_before_the_sweep_is_no_step() -> None:
    profile = case("fine")
    x = motion(profile, "disp")
    time = np.arange(9000) / 1000
    check = 2e-3 * np.sin(2 * np.pi * time) * np.clip(np.minimum(time, 9 - time) / 2, 0, 1)
    detected = find_steps(
        np.concatenate([np.zeros(1000), check, np.zeros(2000), x]), 1000.0, profile.sweep
    )
    assert detected.steps == profile.sweep.steps
    assert "loop check" in detected.messages[0]
    assert set(detected.label[1000:10000]) <= {Label.REST, Label.BLEND}


def shaken(kind: str) -> Float1D:
    time = np.arange(30000) / 500
    noise = np.random.default_rng(2).standard_normal(time.size)
    if kind == "noise":
        return noise
    if kind == "narrow noise":
        return lfilter(*butter(2, [0.9, 1.1], "band", fs=500), noise)
    if kind == "earthquake":
        return lfilter(*butter(2, [0.5, 5], "band", fs=500), noise) * np.exp(
            -(((time - 20) / 8) ** 2)
        )
    low = 0.5 if kind == "chirp" else 4.0
    return chirp(time, low, 60, 5)


@pytest.mark.parametrize("kind", ["noise", "narrow noise", "earthquake", "chirp", "slow chirp"])
@pytest.mark.parametrize("on_grid", [True, False])
def test_what_is_no_stepped_sine_has_no_steps(kind: str, on_grid: bool) -> None:
    detected = find_steps(shaken(kind), 500.0, case("fine").sweep, on_grid=on_grid)
    assert detected.steps == ()
    assert set(detected.step) == set(detected.cycle) == {-1}
    assert Label.SETTLE in detected.label
    assert set(detected.label) <= {Label.REST, Label.SETTLE}
    assert "no stepped sine" in detected.messages[-1]


@pytest.mark.parametrize("value", [0.0, np.nan])
def test_a_table_that_never_moved_is_at_rest(value: float) -> None:
    detected = find_steps(np.full(5000, value), 500.0, case("fine").sweep)
    assert detected.steps == ()
    assert set(detected.label) == {Label.REST}
