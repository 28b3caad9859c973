"""Parameters, the model card, the free-flight resonance."""

import math

import numpy as np
import pytest
from pydantic import ValidationError

from table_io.config.base import load_config, parse_toml
from table_io.config.folders import find_config
from table_io.config.profile import Specimen
from table_io.errors import InputError
from tests.input_errors import raises_input_error
from tests.model.reference import AG, SNM, snm
from twin.model.config import ModelConfig
from twin.model.parameters import Parameters, free_flight_resonance

CARD = """
title = "t"
[base]
stiffness_n_m = 36000.0
damping_n_s_m = 1100.0
bumper_stiffness_n_m = 510000.0
bumper_damping_n_s_m = 900.0
"""
G4 = Specimen(mass_kg=550.0, gap_mm=4.0)


def test_the_papers_card_is_the_papers_model():
    card, _ = load_config(find_config("snm", "models"), ModelConfig, "model")
    assert card.build_model(G4).parameters == snm()
    assert card.build_model(Specimen(mass_kg=550.0, gap_mm=math.inf)).parameters == snm(math.inf)


def test_measured_gaps_take_the_place_of_the_nominal_one():
    specimen = Specimen(mass_kg=550.0, gap_mm=4.0, gap_right_mm=2.2, gap_left_mm=1.7)
    built = parse_toml(CARD, ModelConfig, "x").build_model(specimen).parameters
    assert (built.gap_r, built.gap_l) == pytest.approx((2.2e-3, 1.7e-3))


def test_effects_of_a_card_apply_in_order():
    text = CARD + '[[effects]]\nid = "gap_offset"\nparameters = { offset = 2e-4 }\n'
    built = parse_toml(text, ModelConfig, "x").build_model(G4).parameters
    assert (built.gap_r, built.gap_l) == pytest.approx((2.2e-3, 1.8e-3))


@pytest.mark.parametrize(
    "entry, fields",
    [
        ('id = "bumper_asymetry"', {"remedy": "'bumper_asymmetry'"}),
        ('id = "gap_offset"\nparameters = { ofset = 1e-4 }',
         {"key": "ofset", "remedy": "'offset'"}),
        ('id = "gap_offset"\nparameters = { offset = 2.0 }',
         {"key": "offset", "value": 2.0, "allowed": "-1 to 1 m"}),
        ('id = "gap_offset"\nparameters = { offset = nan }',
         {"key": "offset", "allowed": "finite"}),
        ('id = "gap_offset"', {"key": "offset"}),
        ('id = "gap_offset"\nparameters = { offset = 0.0 }\n[[effects]]\nid = "gap_offset"\n'
         "parameters = { offset = 0.0 }", {"key": "effects", "problem": "gap_offset"}),
    ],
)  # fmt: skip
def test_a_bad_effect_is_refused_in_words(entry, fields):
    with raises_input_error(**fields):
        parse_toml(CARD + "[[effects]]\n" + entry, ModelConfig, "x")


def test_an_unknown_key_of_the_base_names_the_nearest():
    with raises_input_error(key="base.dampin_n_s_m", remedy="'damping_n_s_m'"):
        parse_toml(CARD.replace("damping_n_s_m", "dampin_n_s_m", 1), ModelConfig, "x")


def test_a_card_cannot_be_changed():
    with pytest.raises(ValidationError):
        parse_toml(CARD, ModelConfig, "x").title = "other"  # type: ignore[misc]


@pytest.mark.parametrize("name", [*SNM, "gap_r", "gap_l"])
@pytest.mark.parametrize("value", [math.nan, -math.inf, math.inf, -1.0, 0.0])
def test_parameters_refuse_what_has_no_meaning(name, value):
    fine = name.startswith("gap") and not (math.isnan(value) or value == -math.inf)
    if fine or ("damping" in name and value == 0):
        assert getattr(snm(**{name: value}), name) == value
    else:
        with raises_input_error(key=name, allowed=""):
            snm(**{name: value})


def test_dict_and_back():
    p = snm(math.inf)
    assert Parameters.from_dict(p.as_dict()) == p
    with raises_input_error(key="dampng", remedy="'damping'"):
        Parameters.from_dict({**p.as_dict(), "dampng": 1.0})
    with raises_input_error(key="mass"):
        Parameters.from_dict({k: v for k, v in p.as_dict().items() if k != "mass"})


def test_resonance_as_published():
    u, a, frequency = free_flight_resonance(snm(), AG)
    assert (u, a, frequency) == pytest.approx((30.537e-3, 2.057, 1.268), rel=3e-4)
    assert u == pytest.approx(30.5375e-3, abs=1e-7)


@pytest.mark.parametrize("damping", [10.0, 1100.0, 6000.0, 7000.0, 2e4])
def test_resonance_is_the_maximum_over_frequency(damping):
    p = snm(damping=damping)
    w = 2 * math.pi * np.linspace(1e-3, 3, 200001)
    u = AG / np.abs(p.stiffness / p.mass - w**2 + 1j * w * damping / p.mass)
    a = u * np.abs(p.stiffness + 1j * w * damping) / p.mass
    u_star, a_star, frequency = free_flight_resonance(p, AG)
    assert (u_star, a_star) == pytest.approx((u.max(), a.max()), rel=1e-5)
    assert frequency == pytest.approx(w[u.argmax()] / (2 * math.pi), abs=2e-3)


def test_an_undamped_resonance_has_no_bound():
    with pytest.raises(InputError) as error:
        free_flight_resonance(snm(damping=0.0), AG)
    assert (error.value.key, error.value.value) == ("damping", 0)
