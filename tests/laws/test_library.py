"""Laws that hold for every row of the library, and what those that act on parameters do."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.input_errors import raises_input_error
from tests.model.cases import FORCES, RATE_HZ, drive, everything, having, noisy, typical, vanishing
from tests.model.reference import snm
from twin.laws.checks import check_effect
from twin.laws.effect import BASE_PARAMETERS, USUAL_BASE
from twin.laws.expression import parse_unit
from twin.laws.library import EFFECTS
from twin.model.force_laws import Coefficients
from twin.model.inverse_dynamics import forces_along
from twin.model.model import EffectInstance, Model
from twin.model.prepare import prepare_solver
from twin.model.solver import StateEstimate

BASES = [snm(), snm(-0.001), snm(math.inf), snm(bumper_stiffness_r=7e5, gap_l=0.0031)]
BY_ID = {effect.id: effect for effect in EFFECTS}
DYNAMIC = [effect for effect in EFFECTS if effect.acts != "sensor"]
COMPILED = [effect for effect in EFFECTS if effect.compiled]
ADDED = [effect for effect in EFFECTS if effect.is_added_law]
KICK = noisy(1.0)


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


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.id)
def test_a_row_keeps_the_contract_and_says_what_a_reader_needs(effect):
    check_effect(effect)
    assert effect.term
    assert effect.residual
    assert effect.description.count("\n") > 1
    assert 0 < len(effect.summary) < 70
    assert effect.confused_with
    assert effect.id not in effect.confused_with
    assert {*effect.confused_with, *effect.limits} <= set(BY_ID)
    assert set(effect.compiled) <= set(Coefficients._fields)
    for parameter in effect.parameters:
        assert parameter.typical != parameter.vanishing
        assert parameter.meaning


def scale_units(values, units, sizes):
    """Numbers of these names in other units: kg, m and s are `sizes` times as large."""
    return {
        name: value
        * math.prod(size**power for size, power in zip(sizes, parse_unit(units[name]), strict=True))
        for name, value in values.items()
    }


def evaluate(effect, motion, states, values=None, base=USUAL_BASE):
    """(force, rates) for numbers by name."""
    values = typical(effect) if values is None else values
    known = effect.work_out_constants(base, values) | motion | states
    rates = {name: rate.evaluate(known) for name, rate in effect.parsed_rates.items()}
    return effect.parsed_force.evaluate(known), rates


@pytest.mark.parametrize(
    "effect", [e for e in FORCES if e.force and e.place == "damper"], ids=lambda effect: effect.id
)
def test_a_law_of_the_damper_prefers_no_direction(effect):
    own, mirrored = (
        evaluate(
            effect,
            {"u": sign * 1.3e-3, "v": sign * 0.07, "a": sign * 0.9},
            dict.fromkeys(effect.states, sign * 0.3),
        )
        for sign in (1.0, -1.0)
    )
    assert mirrored == (-own[0], {name: -rate for name, rate in own[1].items()})
    assert own[0] != 0.0


@pytest.mark.parametrize("effect", [*COMPILED, *ADDED], ids=lambda effect: effect.id)
class TestExpressions:
    """Laws that hold for every force, whether the solver has a form of its own or not."""

    def test_units_of_any_size_give_the_same_law(self, effect):
        """Numbers in other units of mass, length and time: the force in these units."""
        sizes = (3.0, 0.7, 1.9)
        inputs = dict(zip(effect.variables, (1.3e-3, 0.07, 0.9, 2.0), strict=True))
        states = dict.fromkeys(effect.states, 0.3)
        units = dict(effect.variables) | {name: own.unit for name, own in effect.states.items()}
        units |= {own.name: own.unit for own in effect.parameters}
        units |= {name: unit for name, (unit, _) in BASE_PARAMETERS.items() if name not in units}
        force, rates = evaluate(effect, inputs, states)
        scaled = [
            scale_units(numbers, units, sizes)
            for numbers in (inputs, states, effect.typical_values)
        ]
        base_units = {name: unit for name, (unit, _) in BASE_PARAMETERS.items()}
        base = scale_units(USUAL_BASE, base_units, sizes)
        own_force, own_rates = evaluate(effect, scaled[0], scaled[1], scaled[2], base)
        newton = sizes[0] * sizes[1] / sizes[2] ** 2
        assert own_force == pytest.approx(newton * force, rel=1e-12)
        expected = scale_units(rates, units, sizes)
        for name, rate in own_rates.items():
            assert rate == pytest.approx(expected[name] / sizes[2], rel=1e-12)

    def test_energy_of_a_cycle_is_lost_if_the_law_dissipates_and_else_kept(self, effect):
        """Work of the law on a steady cycle, with the states carried along; dry friction apart."""
        n, amplitude, w = 4000, 2e-3, 14.0
        phases = 2 * math.pi * np.arange(4 * n) / n
        depth = amplitude if effect.is_in_bumpers else 0.0
        q, v = depth + amplitude * np.sin(phases), amplitude * w * np.cos(phases)
        states, work, size = dict.fromkeys(effect.states, 0.0), 0.0, 0.0
        step = 2 * math.pi / w / n
        for k in range(4 * n):
            inputs = {"u": q[k], "d": q[k], "v": v[k], "a": 0.0, "t": 0.0}
            force, rates = evaluate(effect, inputs, states)
            if k >= 3 * n:
                work += force * v[k] * step
                size += abs(force * v[k]) * step
            states = {name: states[name] + step * rates[name] for name in states}
        if effect.break_away:
            constants = effect.work_out_coefficients(USUAL_BASE, effect.typical_values)
            work += constants["fc"] * np.abs(v[:n]).sum() * step
        if effect.dissipates:
            assert work > 0.01 * size > 0.0
        else:
            assert abs(work) < 1e-6 * size


@pytest.mark.parametrize("effect", ADDED, ids=lambda effect: effect.id)
def test_forces_of_a_motion_balance_with_the_expression(effect):
    """M a + D + F_R + F_L = 0, D and the pushes of the expression alone."""
    p = snm()
    out = drive(having(effect), KICK)[1]
    u, v, acc, right, left = out[:5]
    d, inside = u - p.gap_r, right > 0
    inputs = {"u": u, "v": v, "d": d, "a": KICK, "t": np.arange(1, KICK.size + 1) / RATE_HZ}
    force = 0.0 * u
    if not effect.states:
        known = effect.work_out_constants(p.as_dict(), typical(effect)) | inputs
        force = effect.parsed_force.evaluate(known) + 0.0 * u
    if effect.break_away:
        force += effect.work_out_coefficients({}, typical(effect))["fc"] * np.sign(v)
    if effect.is_in_bumpers:
        push = p.bumper_stiffness_r * d + p.bumper_damping_r * v + force
        assert inside.sum() > 100
        assert right[inside] == pytest.approx(push[inside], rel=1e-9)
        force = 0.0 * u
    balance = p.mass * acc + p.damping * v + p.stiffness * u + force + right + left
    slipping = np.abs(v) > 1e-9
    if not effect.states:
        assert np.abs(balance[slipping]).max() < 1e-9 * np.abs(right).max()


@pytest.mark.parametrize("effect", COMPILED, ids=lambda effect: effect.id)
class TestCompiled:
    """The solver's own form of a law against its expression."""

    def as_written(self, effect):
        """The same row without the solver's form of it."""
        return replace(effect, id="as_written", compiled={}, is_linear=False)

    @pytest.mark.parametrize("base", BASES[:2] + BASES[3:])
    def test_expression_of_an_effect_gives_the_same_motion(self, effect, base):
        written = EffectInstance.create(self.as_written(effect), typical(effect))
        expected = drive(having(effect, base=base), KICK)[1]
        out = drive(Model(base, (written,)), KICK)[1]
        scale = np.abs(expected).max(axis=1, keepdims=True)
        assert (np.abs(out - expected) <= 2e-6 * scale).all()
        # without the law the motion is another one
        assert np.abs(drive(Model(base), KICK)[1][0] - expected[0]).max() > 1e-5 * scale[0]

    def test_expression_of_an_effect_gives_the_same_forces(self, effect):
        out = drive(having(effect), 2.0 * noisy(2.0), StateEstimate(0, 0.0, 0.0))[1]
        u, v, _, right, left = out[:5]
        time, contact = np.arange(1, u.size + 1) / RATE_HZ, np.array([right > 0, left < 0])
        written = EffectInstance.create(self.as_written(effect), typical(effect))
        expected, forces, plain = (
            forces_along(model, u, v, 0 * u, time, contact.astype(np.int8))
            for model in (having(effect), Model(snm(), (written,)), Model(snm()))
        )
        row = 1 if effect.is_in_bumpers else 0
        size = np.abs(plain - expected)[row].max()
        assert size > 0
        assert np.abs(forces - expected)[row].max() < (0.02 if effect.states else 1e-9) * size


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
        solver, base = prepare_solver(model, RATE_HZ), noisy(0.7)
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
