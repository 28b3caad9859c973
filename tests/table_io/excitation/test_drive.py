"""Laws of the drive, over every shipped test: what the table is asked to do, sample by sample."""

import math
from fractions import Fraction
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from table_io.block import Float1D, Label
from table_io.config.base import PROFILES_DIR
from table_io.config.excitation.stepped_sine import Sweep
from table_io.config.profile import Profile, load_profile
from table_io.excitation.drive import Drive, Segment
from table_io.excitation.trajectory import plan_sweep
from table_io.units import GRAVITY_M_S2
from tests.builders.drives import sine_segment_at, sine_segments

SHIPPED = sorted(
    path.stem
    for path in (PROFILES_DIR / "tests").glob("*.toml")
    if isinstance(load_profile(path)[0].excitation, Sweep)
)
A = 0.05 * GRAVITY_M_S2
PEAK_RATIO = 1.05  # of A: the most that a drive may ask for
DECAY_PEAK = 1.06  # of A: the decay multiplies a motion that may itself be at 1.05
MARGIN_SAMPLES = 100  # samples of rest looked at before and after


@cache
def profile(name: str) -> Profile:
    return load_profile(PROFILES_DIR / "tests" / f"{name}.toml")[0]


@cache
def plan_drive(name: str) -> Drive:
    return plan_sweep(profile(name))


@cache
def command(name: str) -> Float1D:
    """The whole command in m, with some rest after it; index = sample."""
    samples = plan_drive(name).command(0, plan_drive(name).planned_end + MARGIN_SAMPLES)
    samples.setflags(write=False)
    return samples


def list_holds(drive: Drive) -> list[Segment]:
    return [segment for segment in sine_segments(drive) if segment.cycles]


def differences(samples: Float1D, order: int, rate_hz: float) -> Float1D:
    result: Float1D = np.diff(samples, order) * rate_hz**order
    return result


every_test = pytest.mark.parametrize("name", SHIPPED)


@every_test
def test_command_acceleration_is_at_most_105_percent(name: str) -> None:
    drive = plan_drive(name)
    ideal = drive.acceleration(0, drive.planned_end + MARGIN_SAMPLES)
    assert np.abs(ideal).max() <= PEAK_RATIO * A
    # The command itself, not only the formula beside it.
    commanded = differences(command(name), 2, drive.rate_hz)
    assert np.abs(commanded).max() <= PEAK_RATIO * A
    # A second difference is the mean acceleration round a sample: off by its curvature only.
    curvature = (2 * math.pi * profile(name).sweep.stop_hz / drive.rate_hz) ** 2 / 12
    assert np.abs(commanded - ideal[1:-1]).max() <= 3 * curvature * A + 1e-5


@every_test
def test_command_has_no_jump(name: str) -> None:
    drive = plan_drive(name)
    stop_hz = profile(name).sweep.stop_hz
    # A jump in the acceleration would show here as A times the rate, 2000 A a second.
    jerk = np.abs(differences(command(name), 3, drive.rate_hz)).max()
    assert jerk <= 1.1 * 2 * math.pi * stop_hz * A
    # Over one sample the velocity cannot change by more than the acceleration allows, so the
    # command leaves rest and comes back to it without a step, and starts and ends at zero.
    assert np.abs(np.diff(command(name), 2)).max() <= PEAK_RATIO * A / drive.rate_hz**2
    first = sine_segments(drive)[0].start
    assert not command(name)[: first + 1].any()
    assert command(name)[first + 1 : first + 50].any()
    assert not command(name)[drive.planned_end :].any()


@every_test
def test_step_is_held_at_its_frequency_and_amplitude(name: str) -> None:
    drive, sweep = plan_drive(name), profile(name).sweep
    steps = list_holds(drive)
    assert [segment.step for segment in steps] == [step.index for step in sweep.steps]
    for segment, step in zip(steps, sweep.steps, strict=True):
        f = step.frequency_hz
        spare = segment.count - sweep.cycles * drive.rate_hz / f
        assert -1e-6 <= spare < 1
        samples = command(name)[segment.start : segment.end]
        part = 2 * segment.count // 5
        early, amplitude = phasor(samples[:part], 0, f, drive.rate_hz)
        late, again = phasor(samples[-part:], segment.count - part, f, drive.rate_hz)
        slip = ((late - early) / (2 * math.pi) + 0.5) % 1.0 - 0.5
        measured_hz = f + slip / ((segment.count - part) / drive.rate_hz)
        assert measured_hz == pytest.approx(f, rel=1e-4)
        assert amplitude == pytest.approx(A / (2 * math.pi * f) ** 2, rel=1e-9)
        assert again == pytest.approx(amplitude, rel=1e-9)


def phasor(samples: Float1D, first: int, f: float, rate_hz: float) -> tuple[float, float]:
    """(phase in rad, amplitude) of the sine at f that fits best, phase against sample 0."""
    turn = 2 * math.pi * f / rate_hz * (first + np.arange(samples.size))
    s, c = np.sin(turn), np.cos(turn)
    sc = s @ c
    a, b = np.linalg.solve([[s @ s, sc], [sc, c @ c]], [s @ samples, c @ samples])
    return math.atan2(b, a), math.hypot(a, b)


@every_test
def test_both_directions_share_one_grid(name: str) -> None:
    steps = plan_drive(name).steps
    up = [step.frequency_hz for step in steps if step.direction == "forward"]
    down = [step.frequency_hz for step in steps if step.direction == "backward"]
    if len(profile(name).sweep.directions) == 2:
        assert up == down[::-1]
    grid = up or down[::-1]
    assert grid == sorted(set(grid))
    assert all(frequency == float(f"{frequency:.3f}") for frequency in grid)


@every_test
def test_labels_measure_the_last_cycles_of_a_step(name: str) -> None:
    drive, sweep = plan_drive(name), profile(name).sweep
    step, label, cycle = drive.labels(0, drive.planned_end + MARGIN_SAMPLES)
    is_measured = np.zeros(label.size, dtype=bool)
    for segment in list_holds(drive):
        window = slice(segment.start, segment.end)
        is_measured[window] = True
        # In whole numbers, so that no rounding decides which cycle a sample lies in.
        f, rate = Fraction(str(segment.f0)), Fraction(drive.rate_hz)
        index = np.arange(segment.count)
        turn = (index * f.numerator * rate.denominator) // (f.denominator * rate.numerator)
        expected = np.minimum(turn, sweep.cycles - 1)
        assert np.array_equal(cycle[window], expected)
        measured = expected >= sweep.cycles - sweep.measured_cycles
        assert np.array_equal(label[window] == Label.MEASURE, measured)
        assert np.array_equal(label[window] == Label.SETTLE, ~measured)
        assert (step[window] == segment.step).all()
        assert np.unique(cycle[window][measured]).size == sweep.measured_cycles
    index = np.arange(label.size)
    moving = (index >= sine_segments(drive)[0].start) & (index < drive.planned_end)
    assert (label[moving & ~is_measured] == Label.BLEND).all()
    assert (label[~moving] == Label.REST).all()
    assert (step[~moving] == -1).all()
    assert (cycle[~is_measured] == -1).all()


@given(st.data())
@settings(max_examples=150)
def test_decay_from_any_sample_ends_at_rest(data: st.DataObject) -> None:
    name = data.draw(st.sampled_from(["g0", "g4_ss1", "quickstart"]))
    drive = plan_drive(name)
    at = data.draw(st.integers(0, drive.planned_end + MARGIN_SAMPLES))
    stopped = drive.decay_from(at)
    segment = sine_segment_at(drive, at)
    first, last = max(at - 20, 0), stopped.rest_start + MARGIN_SAMPLES
    samples = stopped.command(first, last - first)
    # Untouched up to the decision, smooth through it and everywhere after it.
    before = drive.command(first, at - first + 1)
    assert samples[: at - first + 1].tobytes() == before.tobytes()
    assert np.abs(differences(samples, 2, drive.rate_hz)).max() <= DECAY_PEAK * A
    # At rest max(2 cycles, 0.5 s) later, of the lower frequency of a blend at the most.
    slowest = min(segment.f0, segment.f1)
    assert stopped.rest_start - at <= math.ceil(max(2 / slowest, 0.5) * drive.rate_hz)
    assert not samples[stopped.rest_start - first :].any()
    assert not stopped.command(stopped.rest_start, 100_000).any()
    if at < sine_segments(drive)[0].start:  # nothing moves yet, so nothing ever does
        assert not samples.any()


def test_second_decay_does_not_postpone_the_first() -> None:
    drive = plan_drive("quickstart")
    stopped = drive.decay_from(20_000)
    assert stopped.decay_from(20_500) == stopped
    assert stopped.decay_from(19_000) == drive.decay_from(19_000)
