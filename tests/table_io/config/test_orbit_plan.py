"""Orbit plan: JSON text, harmonics as a vector, faults by key."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from table_io.config.excitation.continuation import (
    OrbitPlan,
    PlannedOrbit,
    pack_harmonics,
    parse_orbit_plan,
    unpack_harmonics,
)
from table_io.errors import InputError
from tests.input_errors import raises_input_error


def make_plan() -> OrbitPlan:
    orbit = PlannedOrbit(
        frequency_hz=3.4,
        acceleration_m_s2=0.49,
        stable=False,
        multiplier=3.115,
        u_m=((0.0, 0.0), (1e-3, -3e-3)),
        jacobian=((0.1, 0.0, 0.0), (0.0, 1 / 3, 2.0), (0.0, -2.0, 1.0)),
        gain=0.6,
        rate_gain_s=0.0,
    )
    return OrbitPlan(harmonics=1, latency_s=0.046, jitter_s=0.005, points=(orbit, orbit))


def test_plan_survives_its_json_text() -> None:
    plan = make_plan()
    read = parse_orbit_plan(plan.to_json(), "plan.json")
    assert_allclose(read.points[1].jacobian_matrix, plan.points[1].jacobian_matrix, rtol=1e-6)
    assert read.points[0].u_m == plan.points[0].u_m
    assert (read.latency_s, read.jitter_s, read.harmonics) == (0.046, 0.005, 1)
    assert parse_orbit_plan(read.to_json(), "") == read


def test_multiplier_may_be_complex() -> None:
    point = make_plan().points[0].model_copy(update={"multiplier": (0.6, -0.8)})
    assert point.multiplier_size == pytest.approx(1.0)
    assert make_plan().points[0].multiplier_size == 3.115


def test_harmonics_are_packed_in_the_stated_order() -> None:
    coefficients = np.array([0.5, 1 + 2j, 3 + 4j])
    vector = pack_harmonics(coefficients)
    assert_array_equal(vector, [0.5, 1, 2, 3, 4])
    assert_array_equal(unpack_harmonics(vector), coefficients)
    assert_array_equal(make_plan().points[0].harmonics_m, [0.0, 1e-3, -3e-3])


@pytest.mark.parametrize(
    "change, key",
    [
        ({"version": 2}, "version"),
        ({"harmonics": 2}, "points"),
        ({"latency_s": -1.0}, "latency_s"),
        ({"points": []}, "points"),
    ],
)
def test_fault_of_a_plan_names_its_key(change: dict, key: str) -> None:
    text = json.dumps(json.loads(make_plan().to_json()) | change)
    with raises_input_error(where="plan.json", key=key):
        parse_orbit_plan(text, "plan.json")


def test_jacobian_must_fit_the_harmonics() -> None:
    table = json.loads(make_plan().to_json())
    table["points"][1]["jacobian"] = [[1.0]]
    with raises_input_error(key="points.1.jacobian"):
        parse_orbit_plan(json.dumps(table), "plan.json")


def test_text_that_is_no_plan_is_refused() -> None:
    with pytest.raises(InputError):
        parse_orbit_plan("no plan", "plan.json")
