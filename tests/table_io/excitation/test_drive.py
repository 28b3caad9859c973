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
from table_io.excitation.drive import Drive, Segment, segment_motion
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
def test_the_table_is_never_asked_for_more_than_105_percent(name: str) -> None:
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
def test_command_velocity_and_acceleration_never_jump(name: str) -> None:
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
def test_it_rests_first_and_starts_and_stops_softly(name: str) -> None:
    drive = plan_drive(name)
    assert sine_segments(drive)[0].start == round(profile(name).acquisition.rest_s * drive.rate_hz)
    for ramp in (sine_segments(drive)[0], sine_segments(drive)[-1]):
        assert min(ramp.level0, ramp.level1) == 0.0
        assert ramp.f0 == ramp.f1
        assert ramp.count >= max(2 / ramp.f0, 0.5) * drive.rate_hz


@every_test
def test_blends_last_at_least_one_and_a_half_cycles(name: str) -> None:
    drive = plan_drive(name)
    previous = sine_segments(drive)[0]
    assert sine_segments(drive)[0].label == Label.BLEND
    for segment in sine_segments(drive)[1:]:
        assert segment.start == previous.end
        if not segment.cycles:
            turns = float(segment.phase(np.ones(1), drive.rate_hz)[0]) - segment.phase0
            assert turns >= 1.5
            assert segment.label == Label.BLEND
        # Between two held steps there is a blend, unless the sweep turns and repeats a frequency.
        assert not (previous.cycles and segment.cycles) or previous.f0 == segment.f0
        previous = segment


@pytest.mark.parametrize("step_hz", [9.5, 4.75, 1.9])
@pytest.mark.parametrize("directions", [("forward", "backward"), ("backward", "forward")])
def test_coarse_grids_get_longer_blends_instead_of_harder_ones(
    step_hz: float, directions: tuple[str, ...]
) -> None:
    sweep: dict[str, object] = {"start_hz": 0.5, "stop_hz": 10.0, "step_hz": step_hz, "cycles": 2}
    sweep |= {"measured_cycles": 1, "directions": directions}
    raw = {"title": "coarse", "specimen": {"mass_kg": 550.0, "gap_mm": 4.0}, "sweep": sweep}
    drive = plan_sweep(Profile.model_validate(raw))
    samples = drive.command(0, drive.planned_end + MARGIN_SAMPLES)
    assert np.abs(differences(samples, 2, drive.rate_hz)).max() <= PEAK_RATIO * A
    assert np.abs(drive.acceleration(0, samples.size)).max() <= PEAK_RATIO * A


@every_test
def test_every_step_is_held_for_its_cycles_at_its_frequency_and_amplitude(name: str) -> None:
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
def test_both_directions_are_driven_on_the_identical_grid(name: str) -> None:
    steps = plan_drive(name).steps
    up = [step.frequency_hz for step in steps if step.direction == "forward"]
    down = [step.frequency_hz for step in steps if step.direction == "backward"]
    if len(profile(name).sweep.directions) == 2:
        assert up == down[::-1]
    grid = up or down[::-1]
    assert grid == sorted(set(grid))
    assert all(frequency == float(f"{frequency:.3f}") for frequency in grid)


@every_test
def test_measured_samples_are_the_last_cycles_of_a_step_and_never_in_a_blend(name: str) -> None:
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


@every_test
def test_the_command_is_the_same_to_the_bit_every_time(name: str) -> None:
    again = plan_sweep(load_profile(PROFILES_DIR / "tests" / f"{name}.toml")[0])
    assert again.command(0, command(name).size).tobytes() == command(name).tobytes()


@pytest.mark.parametrize("samples", [1, 7, 64, 500, 4093])
def test_no_cut_into_blocks_changes_a_bit(samples: int) -> None:
    drive = plan_drive("quickstart")
    # Single samples are slow to make: there, the neighbourhood of a soft start and two blends.
    last = sine_segments(drive)[4].start + 50 if samples == 1 else command("quickstart").size
    first = sine_segments(drive)[1].end - 500 if samples == 1 else 0
    for subject in (drive, drive.decay_from(sine_segments(drive)[2].start + 100)):
        whole = subject.command(first, last - first)
        labels = subject.labels(first, last - first)
        cuts = [(at, min(samples, last - at)) for at in range(first, last, samples)]
        assert np.concatenate([subject.command(*cut) for cut in cuts]).tobytes() == whole.tobytes()
        for place, expected in enumerate(labels):
            parts = [subject.labels(*cut)[place] for cut in cuts]
            assert np.array_equal(np.concatenate(parts), expected)


@given(st.data())
@settings(max_examples=150)
def test_a_decay_from_any_sample_is_smooth_and_ends_at_rest(data: st.DataObject) -> None:
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


def test_a_decay_takes_its_full_time_where_the_drive_goes_on_longer() -> None:
    drive = plan_drive("quickstart")
    for segment in list_holds(drive)[:-2]:
        stopped = drive.decay_from(segment.start + 10)
        assert stopped.rest_start - (segment.start + 10) == math.ceil(
            max(2 / segment.f0, 0.5) * drive.rate_hz
        )
        assert stopped.command(stopped.rest_start - drive.decay_samples - 400, 300).any()


def test_a_second_stop_does_not_postpone_the_first() -> None:
    drive = plan_drive("quickstart")
    stopped = drive.decay_from(20_000)
    assert stopped.decay_from(20_500) == stopped
    assert stopped.decay_from(19_000) == drive.decay_from(19_000)


def test_the_labels_of_a_decay_say_stop_and_measure_nothing() -> None:
    drive = plan_drive("quickstart")
    at = list_holds(drive)[3].end - 50  # in a measured cycle
    stopped = drive.decay_from(at)
    step, label, cycle = stopped.labels(0, drive.planned_end)
    before = [row[:at] for row in drive.labels(0, drive.planned_end)]
    assert all(np.array_equal(a[:at], b) for a, b in zip((step, label, cycle), before, strict=True))
    assert (label[at : stopped.rest_start] == Label.STOP).all()
    assert (label[stopped.rest_start :] == Label.REST).all()
    assert (cycle[at:] == -1).all()
    assert (step[stopped.rest_start :] == -1).all()


@pytest.mark.parametrize(
    ("cycles", "peak"), [(0.5, 1.26), (1.0, 1.07), (1.5, 1.03), (2.0, 1.02)], ids=str
)
def test_short_blends_peak_as_computed_for_the_project(cycles: float, peak: float) -> None:
    """Quintic blend 0.5 -> 0.6 Hz at its worst phase, the numbers of physics.md."""
    rate = 2000.0
    count = round(cycles / 0.55 * rate)
    x = np.linspace(0.0, 1.0, 2001)
    worst = max(
        float(np.abs(segment_motion(blend, x, rate)[1]).max())
        for blend in (
            Segment(0, count, Label.BLEND, 0, 0.5, 0.6, 1.0, 1.0, phase)
            for phase in np.linspace(0.0, 0.5, 50, endpoint=False)
        )
    )
    assert worst == pytest.approx(peak, abs=0.01)
