"""A typed parameter set: keys, the model that it holds, the vector of a fit."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.discovery.played import SNM
from twin.discovery.motion import RecordScale
from twin.discovery.parameters import (
    BUMPER_STIFFNESS,
    DAMPING,
    INPUT_GAIN,
    SLIP_SPEED,
    STIFFNESS,
    BaseKey,
    EffectKey,
    FreeParameter,
    GapKey,
    ParameterKey,
    ParameterSet,
    TareKey,
    get_log,
    list_base_parameters,
    list_effect_parameters,
    size_of_unit,
)
from twin.laws.library import find_effect
from twin.model.model import SensorModel

SCALE = RecordScale(
    0.02, 0.2, 3.0, 1e-3, 1650.0, 5e-3, 2e-3, 25.0, {"table_acc_m_s2": 0.5}
)  # a rig of 550 kg
SIDES = (BaseKey("bumper_stiffness_r"), BaseKey("bumper_stiffness_l"))
FIT_ONLY: dict[ParameterKey, float] = {
    SLIP_SPEED: 1e-3, TareKey(1, "u"): 1e-5,
    INPUT_GAIN: 1.02, EffectKey("sensor_offset", "offset", "force_r1_n"): 4.0,
}  # fmt: skip


@pytest.mark.parametrize(
    ("key", "name"),
    [
        (STIFFNESS, "stiffness"),
        (EffectKey("bouc_wen", "force"), "bouc_wen.force"),
        (INPUT_GAIN, "sensor_gain.table_acc_m_s2.gain"),
        (SLIP_SPEED, "slip"),
        (GapKey(12), "gap12"),
        (TareKey(0, "right"), "zero0.right"),
    ],
)
def test_a_key_has_the_name_of_the_files(key: ParameterKey, name: str) -> None:
    assert str(key) == name


def test_a_key_says_to_which_log_it_belongs_whatever_its_name() -> None:
    assert get_log(GapKey(12)) == 12
    assert get_log(TareKey(3, "u")) == 3
    assert get_log(BaseKey("gap_r")) is None
    assert get_log(EffectKey("gap7", "offset")) is None


def test_the_model_is_the_same_after_a_round_trip_and_holds_no_corrections() -> None:
    model = replace(SNM, base=replace(SNM.base, gap_l=2.5e-3)).with_effect(
        "maxwell_damper", k1=8e3, tau=0.05
    )
    parameters = ParameterSet.from_model(model, 2).with_values(FIT_ONLY)
    assert parameters.to_model() == model
    assert parameters.values[GapKey(1)] == 0.0


def test_sensor_errors_are_assumed_per_channel() -> None:
    parameters = ParameterSet.from_model(SNM, 1).with_values(FIT_ONLY)
    assert parameters.assumed_sensors() == (
        SensorModel("table_acc_m_s2", gain=1.02), SensorModel("force_r1_n", offset=4.0),
    )  # fmt: skip
    assert parameters.with_values({INPUT_GAIN: 1.0}).assumed_sensors() == (
        SensorModel("force_r1_n", offset=4.0),
    )


def test_a_vector_sets_the_free_parameters_alone_tied_ones_together() -> None:
    speed = FreeParameter(SLIP_SPEED, 1e-5, 1e-2, 1e-5, "m/s", logarithmic=True)
    bumpers = FreeParameter(BUMPER_STIFFNESS, 1.0, math.inf, 1e5, "N/m", tied=SIDES)
    start = ParameterSet.from_model(SNM, 1).with_values({SLIP_SPEED: 1e-3})
    free = start.with_free((speed, bumpers))
    x = free.to_vector()
    assert x.tolist() == [math.log(1e-3), SNM.base.bumper_stiffness_r]
    moved = free.with_vector(np.array([math.log(1.0), 9e5]))
    changed = {key for key, value in moved.values.items() if value != start.values[key]}
    assert changed == {SLIP_SPEED, *SIDES}
    assert moved.values[SLIP_SPEED] == 1e-2  # its bound
    assert [moved.values[key] for key in SIDES] == [9e5, 9e5]
    assert [*moved.values] == [*start.values]
    assert moved.to_vector().tolist() == [math.log(1e-2), 9e5]


def test_a_removed_effect_leaves_neither_values_nor_free_parameters() -> None:
    friction = list_effect_parameters(find_effect("coulomb_friction"), SCALE)
    base = list_base_parameters([False], None, {}, SCALE)
    start = ParameterSet.from_model(SNM, 1).with_free(base)
    added = start.with_values({friction[0].key: 30.0}).with_free((*base, *friction))
    removed = added.without(friction)
    assert removed.values == start.values
    assert removed.free == base


def test_bumpers_gaps_and_tares_are_free_where_the_logs_determine_them() -> None:
    free = list_base_parameters([False, True], 1.0, {TareKey(0, "acc"): 1e-3}, SCALE)
    by_key = {parameter.key: parameter for parameter in free}
    assert {STIFFNESS, DAMPING, BUMPER_STIFFNESS, GapKey(1), INPUT_GAIN} <= by_key.keys()
    assert GapKey(0) not in by_key
    assert by_key[BUMPER_STIFFNESS].keys == SIDES
    tare = by_key[TareKey(0, "acc")]
    assert (tare.low, tare.high, tare.unit) == (-4e-3, 4e-3, "m/s2")


@pytest.mark.parametrize(
    ("unit", "size"),
    [
        ("N s2/m2", 300.0 * 0.1**2 / 0.02**2), ("kg", 300.0 * 0.1**2 / 0.02), ("rad/m", 1 / 0.02),
        ("m", 0.02), ("", None), ("s", None), ("1", None), ("1/s", None), ("Hz", None),
        ("unit of the channel", None), ("N/m/s", None),
    ],
)  # fmt: skip
def test_a_unit_has_the_size_of_its_parts(unit: str, size: float | None) -> None:
    expected = size if size is None else pytest.approx(size, rel=1e-12)
    assert size_of_unit(unit, force=300.0, length=0.02, time=0.1) == expected
