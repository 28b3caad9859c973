"""A test that was interrupted goes on at a step: from rest, checked again, its steps as before."""

from typing import Any

import numpy as np
import pytest

from table_io.block import Label
from table_io.config.base import parse_toml
from table_io.config.profile import Profile
from table_io.errors import InputError
from table_io.excitation.trajectory import plan_sweep
from table_io.safety.preflight import compute_demands
from table_io.sequencer.procedure import make_test_plan, nominal_drive
from tests.builders.drives import sine_segment_at, sine_segments
from tests.builders.profiles import format_test
from tests.builders.rigs import RIG

TEXT = format_test(2.0, 4.0, 1.0)


def profile(first: int | None = None, **more: Any) -> Profile:
    text = TEXT if first is None else f'{TEXT}[resume]\nfirst_step = {first}\nof = "before"\n'
    return parse_toml(text, Profile, "test").model_copy(update=more)


@pytest.mark.parametrize("control", [True, False])
def test_resumed_test_starts_at_its_step_after_a_loop_check(control: bool) -> None:
    test = profile(3)
    test = test.model_copy(update={"control": test.control.model_copy(update={"enabled": control})})
    drive = nominal_drive(make_test_plan(test, RIG))
    step, label, _ = drive.labels(0, drive.planned_end)
    assert list(dict.fromkeys(step[step >= 0].tolist())) == [3, 4, 5]
    assert (label == Label.CHECK).any()
    begins = int(np.flatnonzero(step == 3)[0])
    assert np.flatnonzero(label == Label.CHECK)[-1] < begins
    assert not drive.command(begins - 2000, 2000).any()  # rest, then a soft start
    first = sine_segment_at(drive, begins)
    assert (first.level0, first.f1) == (0.0, 4.0)


def test_resumed_test_without_loop_check() -> None:
    none = profile().loop_check.model_copy(update={"enabled": False})
    drive = nominal_drive(make_test_plan(profile(4, loop_check=none), RIG))
    assert {segment.step for segment in sine_segments(drive)} == {4, 5}


def test_demands_of_a_resumed_test() -> None:
    resumed = profile(4)
    assert {segment.step for segment in sine_segments(plan_sweep(resumed))} == {4, 5}
    rows, whole = (
        {
            row.step: row
            for row in compute_demands(nominal_drive(make_test_plan(test, RIG)), test, RIG)
        }
        for test in (resumed, profile())
    )
    assert rows[5].displacement_m == pytest.approx(whole[5].displacement_m, rel=0.02)
    assert rows[4].displacement_m > 0


def test_resume_at_step_0_is_the_whole_test() -> None:
    assert profile().first_step == 0
    assert nominal_drive(make_test_plan(profile(0), RIG)) == nominal_drive(
        make_test_plan(profile(), RIG)
    )


@pytest.mark.parametrize(
    ("first", "key", "value", "allowed"),
    [(6, "resume", None, "0 to 5"), (-1, "resume.first_step", -1, "")],
)
def test_step_that_is_not_there_is_refused(
    first: int, key: str, value: int | None, allowed: str
) -> None:
    with pytest.raises(InputError) as error:
        profile(first)
    (fault,) = error.value.faults
    assert (fault.key, fault.value, fault.allowed) == (key, value, allowed)
