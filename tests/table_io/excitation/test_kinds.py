"""Laws that every registered kind of excitation keeps, in the drive that is made of it."""

import math
from collections.abc import Callable
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from table_io.block import Float1D, Label
from table_io.config.base import PROFILES_DIR
from table_io.config.excitation import ENTRY_POINT_GROUP, EXCITATIONS, History, find_excitation
from table_io.config.profile import Profile, load_profile
from table_io.errors import InputError
from table_io.excitation.drive import MAX_STOP_RATIO, Drive
from table_io.excitation.trajectory import plan_excitation
from table_io.safety.preflight import compute_demands
from table_io.sequencer.procedure import make_test_plan, nominal_drive
from tests.builders.profiles import make_history_profile
from tests.builders.rigs import RIG
from tests.input_errors import raises_input_error
from tests.table_io.excitation.pulse_train import PulseTrain

pytestmark = pytest.mark.usefixtures("forget_entry_points")

ORBITS = Path(__file__).parents[1] / "acquisition" / "unstable_orbits.json"
SWEEP = {"start_hz": 2.0, "stop_hz": 3.0, "step_hz": 0.5, "cycles": 3, "measured_cycles": 1}
HELD_ORBITS = {
    "start_hz": 2.85,
    "stop_hz": 3.0,
    "file": ORBITS.name,
    "files": {ORBITS.name: ORBITS.read_text(encoding="utf-8")},
}
EXAMPLES: dict[str, dict[str, Any]] = {
    "stepped_sine": SWEEP,
    "record": load_profile(PROFILES_DIR / "tests" / "record_example.toml")[
        0
    ].excitation.model_dump(),
    "continuation": HELD_ORBITS,
    "backbone": HELD_ORBITS,
    "sine_pulse": {"frequency_hz": 2.0, "acceleration_g": 0.1, "cycles": 5, "windows": 3},
    "half_sine": {"duration_s": 0.2, "acceleration_g": 0.2, "pulses": 2, "windows": 2},
    "chirp": {"start_hz": 1.0, "stop_hz": 8.0, "duration_s": 12.0, "acceleration_g": 0.1},
    "random": {"low_hz": 0.5, "high_hz": 12.0, "rms_g": 0.03, "duration_s": 10.0},
    "multisine": {"low_hz": 0.5, "high_hz": 12.0, "duration_s": 4.0, "periods": 2},
    "swept_sine": {"start_hz": 1.5, "stop_hz": 3.0, "octaves_per_min": 6.0, "displacement_mm": 4.0},
    "cyclic": {"protocol": [[5.0, 0.5, 2], [10.0, 1.0, 3]], "windows": 4},
    "pulse_train": {"height_mm": 5.0, "width_s": 0.8, "period_s": 1.5, "windows": 3},
}
every_kind = pytest.mark.parametrize("kind", sorted(EXCITATIONS))


def profile(kind: str, **excitation: Any) -> Profile:
    return make_history_profile(**{**EXAMPLES[kind], "kind": kind, **excitation})


@cache
def drive(kind: str) -> Drive:
    """The whole drive of a test: loop check, rest, excitation."""
    return nominal_drive(make_test_plan(profile(kind), RIG))


def peaks(command: Float1D, rate_hz: float) -> list[float]:
    """Largest displacement, velocity and acceleration, SI; jumps show as huge ones."""
    return [float(np.abs(np.diff(command, n)).max()) * rate_hz**n for n in (0, 1, 2)]


def limits() -> list[float]:
    return [RIG.limits.stroke_mm * 1e-3, RIG.limits.velocity_mm_s * 1e-3, 9.80665]


def test_every_registered_kind_has_an_example() -> None:
    assert EXAMPLES.keys() == EXCITATIONS.keys()


@every_kind
def test_command_begins_and_ends_at_rest(kind: str) -> None:
    subject = drive(kind)
    command = subject.command(-50, subject.rest_start + 100)
    start = subject.segments[0].start
    assert not command[: start + 51].any()
    assert not command[subject.rest_start + 50 :].any()
    assert abs(command).max() > 1e-3
    for peak, limit in zip(peaks(command, subject.rate_hz), limits(), strict=True):
        assert peak < limit


@every_kind
@pytest.mark.parametrize(
    "samples",
    [pytest.param(1, marks=pytest.mark.slow), 7, pytest.param(64, marks=pytest.mark.slow), 500],
)
def test_division_into_blocks_changes_no_bit(kind: str, samples: int) -> None:
    subject = plan_excitation(profile(kind)).decay_from(5000)
    end = min(subject.rest_start + 100, 9000)
    quantities: list[Callable[[int, int], Any]] = [
        subject.command, subject.acceleration, subject.demanded_acceleration, subject.phase,
        subject.level, lambda first, count: np.array(subject.labels(first, count)),
    ]  # fmt: skip
    for quantity in quantities:
        whole = quantity(0, end)
        cut = [quantity(k, min(samples, end - k)) for k in range(0, end, samples)]
        assert np.concatenate(cut, axis=-1).tobytes() == whole.tobytes()


@every_kind
def test_stop_at_any_time_comes_to_rest(kind: str) -> None:
    subject = plan_excitation(profile(kind))
    own = peaks(subject.command(0, subject.planned_end), subject.rate_hz)
    for at in np.linspace(subject.segments[0].start, subject.planned_end, 60).astype(int).tolist():
        stopped = subject.decay_from(at)
        command = stopped.command(0, stopped.rest_start + 200)
        assert np.array_equal(command[:at], subject.command(0, at))
        assert not command[stopped.rest_start :].any()
        assert stopped.rest_start - at < 8 * subject.rate_hz
        displacement, velocity, acceleration = peaks(command, subject.rate_hz)
        assert displacement <= own[0]
        assert velocity <= own[1] * 1.1
        assert acceleration <= own[2] * MAX_STOP_RATIO
        assert set(stopped.labels(at, stopped.rest_start - at)[1].tolist()) <= {Label.STOP}


@every_kind
def test_labels_are_steps_or_windows(kind: str) -> None:
    test = profile(kind)
    plan = test.plan
    subject = plan_excitation(test)
    step, label, cycle = subject.labels(0, subject.planned_end + 10)
    counted = step[step >= 0]
    assert counted.tolist() == sorted(counted.tolist())
    assert set(counted.tolist()) == set(range(len(plan.steps) or plan.windows))
    assert np.array_equal(label == Label.REST, step < 0)
    if kind == "swept_sine":  # a phase, no numbered cycles, parts of equal widths in octaves
        assert (cycle == -1).all()
        assert subject.phase(0, subject.planned_end).any()
    elif not plan.steps:  # no phase, no cycles, equal windows
        assert (cycle == -1).all()
        assert not subject.phase(0, subject.planned_end).any()
        assert np.ptp(np.bincount(counted)) <= 1
    else:
        held = {"continuation": 20, "backbone": 16}.get(kind, SWEEP["cycles"])
        assert cycle.max() == held - 1


@every_kind
def test_level_and_band_are_those_of_the_drive(kind: str) -> None:
    test = profile(kind)
    subject, plan = plan_excitation(test), test.plan
    acceleration = subject.acceleration(0, subject.planned_end)
    assert plan.level_m_s2 == pytest.approx(np.abs(acceleration).max(), rel=0.06)
    power = np.abs(np.fft.rfft(acceleration)) ** 2
    f = np.fft.rfftfreq(acceleration.size, 1 / subject.rate_hz)
    inside = power[(f >= 0.9 * plan.low_hz) & (f <= 1.1 * plan.high_hz)].sum()
    assert inside > 0.85 * power.sum()


@every_kind
def test_demands_cover_command_and_stop(kind: str) -> None:
    subject = plan_excitation(profile(kind))
    rows = compute_demands(subject, profile(kind), RIG)
    own = peaks(subject.command(0, subject.planned_end), subject.rate_hz)
    demands = [(row.displacement_m, row.velocity_m_s, row.acceleration_m_s2) for row in rows]
    played = [row for row, demand in zip(demands, rows, strict=True) if demand.name != "a stop"]
    continuation = profile(kind).continuation
    feedback = np.ones(3)
    if continuation is not None:  # |q'|^2 <= 2 |q| |q''|
        d, a = 1.0 + continuation.max_feedback, 1.125
        feedback = np.array([d, math.sqrt(2.0 * d * a), a])
    assert np.max(played, axis=0) == pytest.approx(feedback * own, rel=0.06)
    if rows[-1].direction == "a stop":
        stops = [
            peaks(stopped.command(at, stopped.rest_start - at + 9), subject.rate_hz)
            for at in range(subject.segments[0].start, subject.planned_end, 1009)
            if (stopped := subject.decay_from(at))
        ]
        assert (np.max(stops, axis=0) <= np.multiply(demands[-1], 1.01)).all()


def test_sweep_equals_kind_stepped_sine() -> None:
    raw = profile("stepped_sine").model_dump()
    older = {**raw, "sweep": SWEEP}
    del older["excitation"]
    subject = Profile.model_validate(older)
    assert subject == profile("stepped_sine")
    assert nominal_drive(make_test_plan(subject, RIG)) == drive("stepped_sine")


class Jump(History):
    """A history that does not begin at rest."""

    def displacement(self, rate_hz: float) -> Float1D:
        return 0.01 * np.cos(np.arange(2000) / rate_hz)


class Still(History):
    """A history without motion."""

    def displacement(self, rate_hz: float) -> Float1D:
        return np.zeros(round(rate_hz))


@pytest.mark.parametrize("kind", [Jump, Still])
def test_history_in_motion_at_its_ends_is_refused(kind: type[History]) -> None:
    with raises_input_error(where="excitation 'mine'"):
        kind(kind="mine").plan(2000.0)


def test_copy_of_a_kind_plays_its_values() -> None:
    test = profile("pulse_train")
    assert isinstance(test.excitation, PulseTrain)
    higher = test.excitation.model_copy(update={"height_mm": 10.0})
    level = test.plan.level_m_s2
    assert test.model_copy(update={"excitation": higher}).plan.level_m_s2 == pytest.approx(
        2 * level
    )


@pytest.mark.parametrize(
    ("value", "usable"),
    [
        ("tests.table_io.excitation.pulse_train:PulseTrain", True),
        ("tests.table_io.excitation.pulse_train:np", False),
        ("tests.table_io.excitation.missing:Kind", False),
    ],
)
def test_find_excitation_of_a_plug_in(
    value: str, usable: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    entry = metadata.EntryPoint("mine", value, ENTRY_POINT_GROUP)
    monkeypatch.setattr(metadata, "entry_points", lambda group: (entry,))
    if usable:
        assert find_excitation("mine") is PulseTrain
    else:
        with pytest.raises(InputError) as refusal:
            find_excitation("mine")
        assert value in refusal.value.where
    with raises_input_error(remedy="did you mean 'mine'?"):
        find_excitation("mime")
