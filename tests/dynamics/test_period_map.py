"""Period maps, closed form and event-driven, beside independent solutions and differences."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.dynamics.maps import model_map, settle
from tests.input_errors import raises_input_error
from tests.model.cases import FORCES, everything, having
from tests.model.independent_solution import Witness
from tests.model.reference import AG, snm
from twin.dynamics.closed_form_map import ClosedFormMap
from twin.dynamics.continuation import continue_branch
from twin.dynamics.event_driven_map import EventDrivenMap, make_period_map
from twin.dynamics.orbits import find_orbit, settle_to_orbit
from twin.dynamics.period_map import GAP, change_parameter
from twin.laws.library import find_effect
from twin.model.model import Model
from twin.model.stepped_sine import simulate_stepped_sine

PERIODIC_FORCES = [effect for effect in FORCES if effect.id != "gap_drift"]
MEMORYLESS = {"bumper_damping_r": 0.0, "bumper_damping_l": 0.0}
REGIMES = [
    (snm(), 3.4, 2.6),  # impacting
    (snm(), 3.4, 5.0),  # flight
    (snm(), 0.53, 0.5),  # three impacts a side
    (snm(0.0), 5.0, 4.0),
    (snm(-0.001), 5.5, 6.5),  # leaves each bumper, starts in contact with one or two
    (snm(-0.010), 6.9, 6.0),  # never leaves
    (snm(0.004, bumper_damping_r=6e4, bumper_damping_l=2e4), 2.0, 1.5),  # slow bumpers remember
    (snm(0.004, **MEMORYLESS), 2.4, 2.0),
    (snm(0.004, bumper_damping_r=0.0, gap_l=math.inf), 2.4, 2.0),  # one bumper
    (snm(0.004, gap_r=0.003, gap_l=-0.0005), 3.4, 2.6),  # one preloaded
]


def sweep_slowly(p, start: float, stop: float) -> np.ndarray:
    """The state after slow passage from one frequency to another."""
    count = max(2, round(abs(stop - start) / 0.02) + 1)
    return simulate_stepped_sine(p, np.linspace(start, stop, count), AG, 40).states[-1]


def multipliers(orbit) -> np.ndarray:
    return np.sort_complex(orbit.multipliers)


@pytest.mark.parametrize("p, frequency, start", REGIMES)
@pytest.mark.parametrize("periods", [1, 2])
def test_derivatives_agree_with_central_differences(p, frequency, start, periods) -> None:
    period_map = ClosedFormMap(Model(p), frequency, AG)
    x = sweep_slowly(p, start, frequency).take(period_map.indices)
    result = period_map.evaluate(x, periods)
    free, directions = period_map.free_directions(x)
    contacts = period_map.to_state(x)[4:6] > 0

    def require_equal(column, evaluate, h):
        """Compare with the central difference of `evaluate(sign)`."""
        want = (evaluate(1).end - evaluate(-1).end) / (2 * h)
        assert np.abs(column - want).max() < 4e-6 * max(1, np.abs(want).max())

    def vary(name, h, shift):
        value = period_map.parameter(name)
        return lambda sign: period_map.with_parameter(name, value + sign * h).evaluate(
            x + sign * shift, periods
        )

    for column, direction in zip(free, directions.T, strict=True):
        h = 1e-7 if column == 1 else 1e-8
        require_equal(
            result.jacobian @ direction,
            lambda sign, step=h * direction: period_map.evaluate(x + sign * step, periods),
            h,
        )
    none = np.zeros(period_map.size)
    for index, name in enumerate(("frequency", "level")):
        require_equal(result.d_parameters[:, index], vary(name, 1e-7, none), 1e-7)
    for side, name in enumerate(("gap_r", "gap_l")):
        if not math.isfinite(getattr(p, name)):
            continue
        h, shift = 1e-9, none.copy()
        for column, own in period_map.faces:  # in contact the face goes with the mass
            shift[column] = (2 * side - 1) * h * (own == side and contacts[side])
        by_gap = result.d_parameters[:, 2 + side] + result.jacobian @ (shift / h)
        require_equal(by_gap, vary(name, h, shift), h)


def test_map_equals_the_stepped_driver_in_motion_contacts_and_extremes() -> None:
    """In chaos, at 0.53 Hz: states, regimes, onset counts and extremes of each period."""
    p = snm()
    state = sweep_slowly(p, 0.5, 0.53)
    period_map = ClosedFormMap(Model(p), 0.53, AG)
    sweep = simulate_stepped_sine(p, [0.53], AG, 3, state=state)
    x = state.take(period_map.indices)
    assert period_map.measure_periods(x, 3) == pytest.approx(sweep.extremes[0], abs=1e-12)
    assert period_map.record(x, 3)[-1] == pytest.approx(sweep.states[0, :4], abs=1e-12)
    events, end = period_map.find_contacts(x, 3)
    assert end == pytest.approx(sweep.states[0, :4], abs=1e-11)
    assert (np.diff(events[:, 0]) > 0).all()
    for side, name in enumerate(("onsets_r", "onsets_l")):
        onsets = events[(events[:, 1] == side) & (events[:, 2] == 1), 0]
        assert np.histogram(onsets, range(4))[0].tolist() == sweep.column(name)[0].tolist()
    for _ in range(3):
        result = period_map.evaluate(x)
        state = simulate_stepped_sine(p, [0.53], AG, 1, state=period_map.to_state(x)).states[0]
        x = result.end
        assert x == pytest.approx(state[:4], abs=1e-12)
        assert period_map.to_state(x)[4:6] == pytest.approx(state[4:6])
    total = period_map.find_extremes(x, 2)
    each = period_map.measure_periods(x, 2)
    assert total[0] == each[:, 0].max()
    assert total[3] == each[:, 3].min()
    assert total[6] == each[:, 6].sum()


def test_map_is_smooth_where_an_onset_passes_the_start() -> None:
    """A face inside the mass passes through the onset, so that Newton's method can cross it."""
    period_map = ClosedFormMap(Model(snm(0.004, bumper_damping_r=2e4)), 2.0, AG)
    x = np.array([0.002 + 1e-6, 0.1, 1e-6, 0.0])
    # with the face behind and before the mass
    ends = [period_map.evaluate(x + np.array([0, 0, lead, 0])).end for lead in (-1e-8, 1e-8)]
    rate = period_map.evaluate(x).jacobian[:, 2]
    assert (ends[1] - ends[0]) / 2e-8 == pytest.approx(rate, rel=1e-4, abs=1e-6)
    assert abs(rate[1]) > 1


def test_flight_has_the_multipliers_growth_and_size_of_the_oscillator() -> None:
    """exp(lambda T), lambda = -a +- i wd: size exp(-C T / 2M)."""
    orbit = settle(model_map(math.inf), 2.0)
    assert orbit.x.size == 2
    assert np.abs(orbit.multipliers) == pytest.approx(math.exp(-1 / 2.0), rel=1e-12)
    w = 4 * math.pi
    assert orbit.u_max == pytest.approx(AG / abs(36e3 / 550 - w * w + 2j * w), rel=1e-12)
    growth, _ = orbit.period_map.measure_growth(orbit.x, 4000)
    assert growth.mean() == pytest.approx(-1 / 2.0, abs=2e-3)


@pytest.mark.parametrize(
    "model", [Model(snm()), Model(snm()).with_effect("maxwell_damper", k1=8e3, tau=0.05)]
)
def test_mirror_image_is_half_a_period_later_with_sides_exchanged(model) -> None:
    """Twice mirrored is one period later, faces and branch forces included."""
    period_map = make_period_map(model, 2.3, AG)
    x = period_map.iterate(period_map.start(1e-3, 0.05), 3)
    assert period_map.mirror(period_map.mirror(x)) == pytest.approx(
        period_map.iterate(x, 1), abs=1e-9
    )
    extremes = period_map.find_extremes(period_map.mirror(x), 1)
    later = period_map.find_extremes(x, 2)
    assert -extremes[1] <= later[0] + 1e-9
    assert -extremes[1] > 0.5 * later[0]


def test_parameters_are_those_of_the_drive_and_of_the_model() -> None:
    model = Model(snm(0.004, gap_r=0.003, gap_l=0.001)).with_effect("gap_offset", offset=1e-4)
    wider = change_parameter(model, GAP, 0.006)
    assert (wider.base.gap_r, wider.base.gap_l) == (pytest.approx(0.004), pytest.approx(0.002))
    assert change_parameter(model, "mass", 600.0).base.mass == 600.0
    moved = change_parameter(model, "gap_offset.offset", 2e-4)
    assert moved.parameters.gap_r == pytest.approx(0.0032)
    with raises_input_error(key="stifness", remedy="stiffness"):
        change_parameter(model, "stifness", 1.0)
    with raises_input_error(key="gap", allowed="gap_r or gap_l"):
        change_parameter(Model(snm(0.004, gap_l=math.inf)), GAP, 0.006)
    rubbed = make_period_map(Model(snm()).with_effect("coulomb_friction", fc=50.0), 2.0, AG)
    changed = rubbed.with_parameter("coulomb_friction.fc", 60.0).with_parameter(GAP, 0.01)
    changed = changed.with_parameter("frequency", 3.0).with_parameter("level", 0.3)
    names = ("coulomb_friction.fc", "gap_r", "frequency", "level")
    assert [changed.parameter(name) for name in names] == pytest.approx([60.0, 0.005, 3.0, 0.3])
    assert rubbed.parameter("coulomb_friction.fc") == 50.0
    with raises_input_error(where="effect 'gap_drift'", remedy="remove"):
        make_period_map(having(find_effect("gap_drift")), 2.0, AG)


BASES = {
    "snm": snm(),
    "unequal gaps": snm(gap_r=0.001, gap_l=0.004),
    "negative gaps": snm(-0.001),
    "one side": snm(gap_l=math.inf),
    "no memory": snm(**MEMORYLESS),
    "one memory": snm(bumper_damping_l=0.0, bumper_stiffness_l=2e5),
    "no gap": snm(0.0),
}


@pytest.mark.parametrize("base", BASES.values(), ids=BASES.keys())
@pytest.mark.parametrize("frequency_hz", [1.9, 3.4, 5.5])
def test_event_driven_map_equals_the_closed_form(base, frequency_hz) -> None:
    sampled, closed = (
        kind(Model(base), frequency_hz, AG) for kind in (EventDrivenMap, ClosedFormMap)
    )
    assert list(sampled.indices) == list(closed.indices)
    x = closed.start(5e-4, 0.05)
    assert sampled.start(5e-4, 0.05).tolist() == x.tolist()
    for periods in (1, 2):
        want, result = closed.evaluate(x, periods), sampled.evaluate(x, periods)
        assert np.abs((result.end - want.end) / closed.scales).max() < 1e-9  # m, of motions of 5 mm
        assert np.abs((sampled.iterate(x, periods) - result.end) / closed.scales).max() < 1e-12
        scale = np.abs(want.jacobian).max()
        assert np.abs(result.jacobian - want.jacobian).max() < 1e-5 * scale
        for j in range(2):
            scale = np.abs(want.d_parameters[:, j]).max()
            assert np.abs(result.d_parameters - want.d_parameters[:, :2])[:, j].max() < 1e-5 * scale
        assert result.contacts == want.contacts


@pytest.mark.parametrize(
    ("frequency_hz", "u"), [(3.4, 5e-3), (3.4, 0.0), (2.0, 3e-3), (4.5, 1e-3), (0.9, 1e-3)]
)
def test_orbits_of_both_maps_agree_to_1e_6_and_multipliers_to_1e_4(frequency_hz, u) -> None:
    sampled, closed = (
        kind(Model(snm()), frequency_hz, AG) for kind in (EventDrivenMap, ClosedFormMap)
    )
    want = find_orbit(closed, closed.iterate(closed.start(u, 0.0), 150))
    assert want is not None
    orbit = find_orbit(sampled, want.x * (1 + 1e-4))
    assert orbit is not None
    own, exact = orbit.extremes, want.extremes
    assert np.abs(own[:2] / exact[:2] - 1).max() < 1e-6
    assert own[6:].tolist() == exact[6:].tolist()
    assert np.abs(own[2:6] - exact[2:6]).max() < 1e-3 * np.abs(exact[2:6]).max()
    assert np.abs(multipliers(orbit) - multipliers(want)).max() < 1e-4


def test_unstable_orbit_of_g4_is_found_by_differences() -> None:
    period_map = ClosedFormMap(Model(snm()), 3.4, AG)
    high = settle_to_orbit(period_map, period_map.start(5e-3, 0.0))
    assert high is not None
    (unstable,) = [
        orbit for orbit in continue_branch(high, "frequency", (2.5, 4.5)).orbits_at(3.4)
        if not orbit.stable
    ]  # fmt: skip
    orbit = find_orbit(EventDrivenMap(Model(snm()), 3.4, AG), unstable.x * (1 + 1e-5))
    assert orbit is not None
    assert orbit.u_max == pytest.approx(3.297e-3, abs=1e-6)
    assert multipliers(orbit)[-2:].real == pytest.approx([0.138, 3.115], abs=1e-3)


@pytest.mark.parametrize("effect", PERIODIC_FORCES, ids=lambda effect: effect.id)
@pytest.mark.parametrize("frequency_hz", [1.8, 3.4])
def test_orbit_of_every_effect_has_the_multipliers_of_perturbed_motion(
    effect, frequency_hz
) -> None:
    """From motions that start next to the orbit, at steps that Newton did not use."""
    period_map = make_period_map(having(effect), frequency_hz, AG)
    orbit = find_orbit(period_map, period_map.iterate(period_map.start(5e-4, 0.05), 120))
    assert orbit is not None
    assert orbit.stable
    jacobian = np.zeros_like(orbit.jacobian)
    steps = 1e-8 * np.maximum(period_map.scales, 1e-3)
    for j in np.flatnonzero(np.abs(orbit.jacobian).max(axis=0) > 0):
        y = orbit.x.copy()
        y[j] -= math.copysign(steps[j], y[j])  # towards rest: a face at rest cannot stretch
        jacobian[:, j] = (period_map.iterate(y, 1) - orbit.x) / (y[j] - orbit.x[j])
    if not orbit.contacts[0]:
        own = np.sort_complex(np.linalg.eigvals(jacobian))
        assert np.abs(own - multipliers(orbit)).max() < 1e-3


@pytest.mark.parametrize("effect", PERIODIC_FORCES, ids=lambda effect: effect.id)
def test_motion_of_every_effect_agrees_with_an_independent_integrator(effect) -> None:
    model, frequency_hz = having(effect), 2.6
    period_map = make_period_map(model, frequency_hz, AG)
    x = period_map.start(5e-4, 0.05)
    witness = Witness(model, lambda t: AG * math.sin(2 * math.pi * frequency_hz * t))
    times = np.linspace(0, 2 / frequency_hz, 401)
    want = witness.run([5e-4, 0.05, 0, 0, 0, 0, 0, 0], times)
    motion, end = period_map.sample_motion(x, 2, 400), period_map.iterate(x, 2)
    amplitude, speed = np.abs(want[0]).max(), np.abs(want[1]).max()
    assert np.abs(motion[0] - want[0, 1:]).max() < 2e-6 * amplitude
    assert abs(end[0] - want[0, -1]) < 1e-6 * amplitude
    assert abs(end[1] - want[1, -1]) < 1e-5 * speed
    extremes = period_map.find_extremes(x, 2)
    assert extremes[:2] == pytest.approx([want[0].max(), want[0].min()], abs=3e-4 * amplitude)


def test_table_tilt_is_a_level_that_falls_with_frequency() -> None:
    """g tilt x on the mass is the same as another level: an independent closed form."""
    tilt, frequency_hz = 0.8, 1.7
    period_map = make_period_map(
        Model(snm()).with_effect("table_tilt", tilt=tilt), frequency_hz, AG
    )
    factor = 1 - 9.80665 * tilt / (2 * math.pi * frequency_hz) ** 2
    closed = ClosedFormMap(Model(snm()), frequency_hz, AG * factor)
    x = np.zeros(4)
    want, result = closed.evaluate(x, 3), period_map.evaluate(x, 3)
    assert np.abs((result.end - want.end) / closed.scales).max() < 1e-9
    d_level = want.d_parameters[:, 1] * factor
    d_frequency = want.d_parameters[:, 0] + want.d_parameters[:, 1] * (
        2 * AG * (1 - factor) / frequency_hz
    )
    assert np.abs(result.d_parameters[:, 1] - d_level).max() < 1e-5 * np.abs(d_level).max()
    assert np.abs(result.d_parameters[:, 0] - d_frequency).max() < 1e-5 * np.abs(d_frequency).max()
    motion, exact = (each.sample_motion(x, 1, 64) for each in (period_map, closed))
    phase = 2 * math.pi * np.arange(1, 65) / 64
    total = exact[2] + AG * (1 - factor) * np.sin(phase)
    assert np.abs(motion[2] - total).max() < 1e-5 * np.abs(total).max()


def test_friction_that_holds_the_mass_at_the_section_forgets_its_speed() -> None:
    """It sticks over phase 0: u' there is zero whatever it was before."""
    base = replace(snm(), damping=0.0)
    period_map = make_period_map(Model(base).with_effect("coulomb_friction", fc=250.0), 1.05, AG)
    orbit = find_orbit(period_map, period_map.iterate(period_map.start(5e-4, 0.05), 60))
    assert orbit is not None
    assert orbit.x[1] == 0.0
    assert orbit.jacobian[1].tolist() == [0.0] * 4
    assert np.abs(orbit.jacobian[:, 1]).max() < 1e-3
    moved = orbit.x + np.array([1e-6, 0.0, 0.0, 0.0])
    slope = (period_map.iterate(moved, 1)[0] - orbit.x[0]) / 1e-6
    assert orbit.jacobian[0, 0] == pytest.approx(slope, abs=1e-4)


def test_mass_that_never_slips_stays() -> None:
    period_map = make_period_map(Model(snm()).with_effect("coulomb_friction", fc=400.0), 2.0, AG)
    x = np.array([1e-4, 0.0, 0.0, 0.0])
    result = period_map.evaluate(x)
    assert result.end.tolist() == x.tolist()
    assert result.jacobian[0, 0] == pytest.approx(1.0)
    assert np.abs(result.d_parameters).max() == 0.0


def test_model_with_every_effect_has_all_coordinates_and_a_stable_orbit() -> None:
    model = everything().with_effect("gap_drift", rate=0.0)
    period_map = make_period_map(model, 3.0, AG)
    assert period_map.size == 10  # u, v, two faces, f, two b_j, z, two of the appendage
    orbit = find_orbit(period_map, period_map.iterate(period_map.start(5e-4, 0.05), 100))
    assert orbit is not None
    assert orbit.stable


def test_rest_is_the_static_equilibrium() -> None:
    model = Model(snm(-0.002, bumper_stiffness_r=2e5)).with_effect("bumper_hardening", k2=1e8)
    period_map = make_period_map(model, 2.0, 0.0)
    x = period_map.rest()
    assert x[0] > 0
    assert np.abs(period_map.iterate(x, 5) - x).max() < 1e-12
