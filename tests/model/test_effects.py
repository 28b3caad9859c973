"""Laws that hold for every effect, and what each does."""

import math

import pytest

from table_io.profile import BadInput
from twin.model.effects import EFFECTS

from .reference import snm

BASES = [snm(), snm(-0.001), snm(math.inf), snm(bumper_stiffness_r=7e5, gap_l=0.0031)]
BY_ID = {effect.id: effect for effect in EFFECTS}


def vanishing(effect):
    return {parameter.name: parameter.vanishing for parameter in effect.parameters}


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.id)
class TestLaws:
    @pytest.mark.parametrize("base", BASES)
    def test_absent_at_the_vanishing_value_to_the_bit(self, effect, base):
        assert effect.apply(base, vanishing(effect)) is base
        # Not only by the short cut: the change itself vanishes there.
        changed = effect.change(base, vanishing(effect)).as_dict()
        assert changed == pytest.approx(base.as_dict(), rel=1e-15)

    def test_present_elsewhere_and_continuous(self, effect):
        for parameter in effect.parameters:
            small = 1e-9 * (parameter.high - parameter.low)
            values = {**vanishing(effect), parameter.name: parameter.vanishing + small}
            found = effect.apply(snm(), values)
            assert found != snm()
            assert found.as_dict() == pytest.approx(snm().as_dict(), rel=1e-6)

    @pytest.mark.parametrize("end", ["low", "high"])
    def test_valid_at_its_bounds(self, effect, end):
        values = {parameter.name: getattr(parameter, end) for parameter in effect.parameters}
        for base in BASES:
            effect.apply(base, values)

    def test_refuses_values_beyond_bounds_and_names_them(self, effect):
        for parameter in effect.parameters:
            for value in (parameter.high + 1, parameter.low - 1, math.nan):
                values = {**vanishing(effect), parameter.name: value}
                with pytest.raises(BadInput, match=f"{parameter.low:g} to {parameter.high:g}"):
                    effect.apply(snm(), values)

    def test_refuses_unknown_and_missing_parameters(self, effect):
        first = effect.parameters[0].name
        with pytest.raises(BadInput, match=f"did you mean '{first}'"):
            effect.check({**vanishing(effect), first + "x": 1.0})
        with pytest.raises(BadInput, match=f"lacks '{first}'"):
            effect.check({})

    def test_tells_what_a_person_needs(self, effect):
        assert effect.term
        assert effect.residual
        assert effect.confused_with
        assert effect.id not in effect.confused_with
        for parameter in effect.parameters:
            assert parameter.low <= parameter.vanishing <= parameter.high
            assert parameter.meaning


def test_ids_are_unique():
    assert len(BY_ID) == len(EFFECTS)


def test_asymmetry_keeps_the_mean_stiffness():
    found = BY_ID["bumper_asymmetry"].apply(snm(), {"ratio": 1.5})
    assert found.bumper_stiffness_r / found.bumper_stiffness_l == pytest.approx(1.5)
    assert found.bumper_stiffness_r + found.bumper_stiffness_l == pytest.approx(1.02e6)


def test_offset_keeps_the_total_gap():
    found = BY_ID["gap_offset"].apply(snm(), {"offset": 3e-4})
    assert (found.gap_r, found.gap_l) == pytest.approx((2.3e-3, 1.7e-3))
