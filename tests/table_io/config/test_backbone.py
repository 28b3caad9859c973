"""Backbone: its keys, their defaults within 100 periods a point, and refusals."""

from typing import Any

import pytest

from table_io.config.base import parse_toml
from table_io.config.excitation.continuation import (
    MAX_POINT_PERIODS,
    Backbone,
    OrbitPlan,
    parse_orbit_plan,
)
from tests.input_errors import raises_input_error
from tests.table_io.config.test_orbit_plan import make_plan


def make_backbone(**keys: Any) -> Backbone:
    table = {"start_hz": 1.3, "stop_hz": 4.5} | keys
    text = "\n".join(f"{name} = {value}" for name, value in table.items())
    return parse_toml(f'kind = "backbone"\n{text}\n', Backbone, "profile")


def test_point_takes_at_most_100_periods_by_default() -> None:
    config = make_backbone()
    evaluation = config.settle_cycles + config.measured_cycles
    assert config.blend_cycles + evaluation + config.updates * (2 + evaluation) <= 100
    assert config.multiplier_periods == 0


@pytest.mark.parametrize(
    "keys",
    [{"updates": 5}, {"settle_cycles": 20}, {"multiplier_periods": 24}, {"measured_cycles": 12}],
)
def test_more_periods_a_point_are_refused(keys: dict[str, int]) -> None:
    with raises_input_error(allowed=f"up to {MAX_POINT_PERIODS}"):
        make_backbone(**keys)


def test_periods_may_be_spent_on_the_multiplier_instead() -> None:
    assert make_backbone(updates=2, multiplier_periods=24).multiplier_periods == 24


def test_levels_in_the_wrong_order_are_refused() -> None:
    with raises_input_error(allowed="up to acceleration_g"):
        make_backbone(acceleration_g=0.01, min_acceleration_g=0.02)


def test_leads_and_condition_survive_the_json_text_of_a_plan() -> None:
    plan = make_plan()
    backbone = plan.model_copy(update={"condition": "phase", "leads": plan.points[:1]})
    read = parse_orbit_plan(backbone.to_json(), "plan.json")
    assert (read.condition, len(read.leads)) == ("phase", 1)
    assert parse_orbit_plan(read.to_json(), "") == read


def test_lead_of_another_number_of_harmonics_is_refused() -> None:
    plan = make_plan()
    point = plan.points[0]
    lead = point.model_copy(update={"u_m": point.u_m[:1], "jacobian": (point.jacobian[0][:1],)})
    text = OrbitPlan.to_json(plan.model_copy(update={"leads": (lead,)}))
    with raises_input_error(where="plan.json", allowed="1, as harmonics states"):
        parse_orbit_plan(text, "plan.json")
