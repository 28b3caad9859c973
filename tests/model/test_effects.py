"""Laws that hold for every effect, and what those that act on parameters do."""

import math

import numpy as np
import pytest

from tests.input_errors import raises_input_error
from tests.model.cases import FORCES, RATE_HZ, drive, everything, having, noisy, typical, vanishing
from tests.model.reference import snm
from twin.laws.library import EFFECTS
from twin.model.model import Model

TABLE = {
    "cubic_stiffness": {"k3": "N/m3"}, "quadratic_damping": {"c2": "N s2/m2"},
    "coulomb_friction": {"fc": "N"}, "bouc_wen": {"force": "N", "yield_displacement": "m"},
    "maxwell_damper": {"k1": "N/m", "tau": "s"}, "bumper_hardening": {"k2": "N/m2"},
    "hunt_crossley": {"ch": "N s/m2"}, "bumper_maxwell": {"kb": "N/m", "tau": "s"},
    "bumper_asymmetry": {"ratio": ""}, "gap_offset": {"offset": "m"}, "gap_drift": {"rate": "m/s"},
    "stribeck_friction": {"fc": "N", "ratio": "", "speed": "m/s"},
    "position_damping": {"cu": "N s/m3"}, "dead_band": {"width": "m"},
    "appendage": {"mass": "kg", "frequency": "Hz", "damping_ratio": ""},
    "bumper_cubic": {"kc": "N/m3"}, "adhesion": {"force": "N"},
    "table_tilt": {"tilt": "rad/m"}, "mass_error": {"ratio": ""}, "sensor_gain": {"gain": ""},
    "sensor_lag": {"lag": "s"}, "sensor_offset": {"offset": "unit of the channel"},
}  # fmt: skip
BASES = [snm(), snm(-0.001), snm(math.inf), snm(bumper_stiffness_r=7e5, gap_l=0.0031)]
BY_ID = {effect.id: effect for effect in EFFECTS}
DYNAMIC = [effect for effect in EFFECTS if effect.acts != "sensor"]
KICK = noisy(1.0)


def test_the_table_of_effects_is_whole():
    units = {e.id: {p.name: p.unit for p in e.parameters} for e in EFFECTS}
    assert units == TABLE


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.id)
class TestLaws:
    @pytest.mark.parametrize("base", BASES)
    def test_absent_at_the_vanishing_value_to_the_bit(self, effect, base):
        """Alone, beside another, and in the solver: the model without it."""
        without = Model(base)
        model = having(effect, base=base, values=vanishing)
        assert not model.present_effects
        assert not model.sensors
        assert drive(model, KICK)[1].tobytes() == drive(without, KICK)[1].tobytes()
        other = BY_ID["bouc_wen" if effect.id != "bouc_wen" else "cubic_stiffness"]
        both = having(other, base=base).with_effect(
            effect.id, "mass_acc_m_s2" if effect.acts == "sensor" else "", **vanishing(effect)
        )
        alone = drive(having(other, base=base), KICK[:200])[1]
        assert drive(both, KICK[:200])[1].tobytes() == alone.tobytes()

    def test_refuses_values_beyond_bounds_and_names_them(self, effect):
        for parameter in effect.parameters:
            for value in (parameter.high + 1, parameter.low - 1, math.nan):
                values = {**typical(effect), parameter.name: value}
                with raises_input_error(
                    key=parameter.name, allowed=f"{parameter.low:g} to {parameter.high:g}"
                ):
                    effect.validate(values)

    def test_refuses_unknown_and_missing_parameters(self, effect):
        first = effect.parameters[0].name
        with raises_input_error(where=f"effect {effect.id!r}", key=first + "x", remedy=repr(first)):
            effect.validate({**typical(effect), first + "x": 1.0})
        with raises_input_error(where=f"effect {effect.id!r}", key=first):
            effect.validate({})

    def test_tells_what_a_person_needs(self, effect):
        assert effect.term
        assert effect.residual
        assert effect.confused_with
        assert effect.id not in effect.confused_with
        assert set(effect.confused_with) <= set(BY_ID)
        assert any(parameter.vanishing is not None for parameter in effect.parameters)
        for parameter in effect.parameters:
            assert parameter.low <= parameter.typical <= parameter.high
            if parameter.vanishing is not None:
                assert parameter.low <= parameter.vanishing <= parameter.high
                assert parameter.typical != parameter.vanishing
            assert parameter.meaning


def extreme(parameter, end):
    """A value far from the typical one, for a rig of 550 kg: bounds are for specimens of any size.

    A spring that softens 10 times as much as is typical lets the mass of this rig escape.
    """
    if parameter.vanishing is None:
        value = parameter.typical * (0.01 if end == "low" else 30.0)
    else:
        size = abs(parameter.typical - parameter.vanishing)
        value = parameter.vanishing + (-3.0 if end == "low" else 30.0) * size
    return min(max(value, parameter.low), parameter.high)


@pytest.mark.parametrize("effect", DYNAMIC, ids=lambda effect: effect.id)
class TestMotion:
    @pytest.mark.parametrize("end", ["low", "high"])
    def test_solvable_far_from_what_is_typical_of_the_rig(self, effect, end):
        values = {p.name: extreme(p, end) for p in effect.parameters}
        model = having(effect, values=lambda _: values)
        assert np.isfinite(drive(model, KICK[:200], rate=RATE_HZ)[1]).all()

    def test_small_effects_are_small_and_linear(self, effect):
        """A thousandth of the effect changes the motion by a thousandth, before chaos."""
        base = noisy(0.4)
        plain = drive(Model(snm()), base)[1]
        changes = []
        for part in (1e-4, 2e-4):
            values = {
                p.name: p.typical
                if p.vanishing is None
                else p.vanishing + part * (p.typical - p.vanishing)
                for p in effect.parameters
            }
            model = having(effect, values=lambda _, values=values: values)
            changes.append(np.abs(drive(model, base)[1][0] - plain[0]).max())
        assert changes[0] > 0
        if not effect.id.endswith("_friction"):  # sticks a little longer: not linear in Fc at rest
            power = 2 if effect.id == "adhesion" else 1  # its impulse is force times delay
            assert changes[1] == pytest.approx(2**power * changes[0], rel=0.05)

    @pytest.mark.parametrize("size", [1, 7, 64, 500])
    def test_blocks_of_any_size_give_the_same_bits(self, effect, size):
        self.cut(having(effect), size)

    def cut(self, model, size):
        solver, base = model.prepare(RATE_HZ), noisy(0.7)
        whole, out = drive(model, base)
        state, cut = solver.rest_state(), np.empty_like(out)
        for first in range(0, base.size, size):
            part = base[first : first + size]
            part.setflags(write=False)
            solver.advance(state, part, 0.01 * part, cut[:, first : first + size])
        assert cut.tobytes() == out.tobytes()
        assert state.tobytes() == whole.tobytes()

    def test_left_and_right_are_mirror_images(self, effect):
        """u -> -u and the drive with it, the sides swapped."""
        base = noisy(0.7)
        p = snm(bumper_stiffness_l=7e5, gap_r=1e-3, gap_l=1.4e-3)
        q = snm(bumper_stiffness_r=7e5, gap_l=1e-3, gap_r=1.4e-3)
        values = dict(typical(effect))
        other = dict(values)
        if effect.id == "bumper_asymmetry":
            other["ratio"] = 1 / values["ratio"]
        if effect.id == "gap_offset":
            other["offset"] = -values["offset"]
        _, right = drive(having(effect, base=p, values=lambda _: values), base)
        _, two = drive(having(effect, base=q, values=lambda _: other), -base)
        scale = np.abs(right).max(axis=1, keepdims=True)
        assert (np.abs(right + two[[0, 1, 2, 4, 3, 6, 5]]) <= 1e-8 * scale).all()

    def test_rest_is_an_equilibrium(self, effect):
        for gap in (0.004, 0.0, -0.002):
            if effect.id == "gap_drift" and gap <= 0:
                continue
            model = having(effect, base=snm(gap, gap_r=gap / 2 + 1e-4))
            _, out = drive(model, np.zeros(400))
            assert np.abs(out[1]).max() < 1e-11


@pytest.mark.parametrize("size", [1, 64])
def test_all_effects_together_are_cut_invariant(size):
    TestMotion().cut(everything(), size)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
@pytest.mark.parametrize("effect", FORCES, ids=lambda effect: effect.id)
def test_a_lost_sample_makes_everything_after_it_nan(effect, bad):
    base = noisy(0.5)
    base[500] = bad
    state, out = drive(having(effect), base)
    assert np.isfinite(out[:, :500]).all()
    assert np.isnan(out[:, 500:]).all()
    assert np.isnan(state[:-1]).all()
    assert state[-1] == base.size


def test_asymmetry_keeps_the_mean_stiffness():
    applied = Model(snm()).with_effect("bumper_asymmetry", ratio=1.5).parameters
    assert applied.bumper_stiffness_r / applied.bumper_stiffness_l == pytest.approx(1.5)
    assert applied.bumper_stiffness_r + applied.bumper_stiffness_l == pytest.approx(1.02e6)


def test_offset_keeps_the_total_gap():
    applied = Model(snm()).with_effect("gap_offset", offset=3e-4).parameters
    assert (applied.gap_r, applied.gap_l) == pytest.approx((2.3e-3, 1.7e-3))


def test_mass_error_multiplies_every_force_over_mass():
    out = drive(having(BY_ID["mass_error"]), KICK)[1]
    p = snm()
    force = p.damping * out[1] + p.stiffness * out[0] + out[3] + out[4]
    assert np.abs(550.0 * out[2] + 1.05 * force).max() < 1e-9 * np.abs(force).max()


def test_tilt_pushes_with_the_tables_displacement():
    out = drive(having(BY_ID["table_tilt"]), KICK)[1]
    p = snm()
    force = p.damping * out[1] + p.stiffness * out[0] + out[3] + out[4]
    want = -force / p.mass - 9.80665 * 0.1 * 0.01 * KICK
    assert np.abs(out[2] - want).max() < 1e-12
