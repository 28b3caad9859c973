"""The sampled driver: closed forms, an independent integrator, physics, its state."""

import math

import numpy as np
import pytest

from tests.model.motion import F_L, F_R, U_L, U_R, A, U, V, kick, run, sine
from tests.model.reference import AG, linear_between, reference, snm
from twin.model import closed_form

STEEL = {"bumper_damping_r": 6e4, "bumper_damping_l": 2e4}
CRITICAL = 2 * math.sqrt(550.0 * 36e3)
CRITICAL_IN_CONTACT = 2 * math.sqrt(550.0 * 546e3) - 1100.0
EVENT_S = 1e-12


@pytest.mark.parametrize("ratio", [0.1, 0.999, 1.0, 1.001, 3.0])
def test_flight_is_the_textbook_oscillator(ratio):
    """Free decay from u0 at rest, under-, over- and critically damped, no bumpers."""
    p = snm(math.inf, damping=ratio * CRITICAL)
    state = closed_form.rest_state(p)
    state[U] = 0.01
    _, out, _ = run(p, 500.0, np.zeros(1000), state)
    t, w0 = np.arange(1, 1001) / 500, math.sqrt(36e3 / 550)
    root = np.sqrt(complex(ratio**2 - 1)) * w0
    if ratio == 1:
        want = 0.01 * np.exp(-w0 * t) * (1 + w0 * t)
    else:
        s1, s2 = -ratio * w0 + root, -ratio * w0 - root
        want = (0.01 * (s1 * np.exp(s2 * t) - s2 * np.exp(s1 * t)) / (s1 - s2)).real
    assert np.abs(out[U] - want).max() < 1e-14


CASES = [
    (snm(), 2.0, 0.1),
    (snm(), 3.4, 0.1),
    (snm(-0.002), 5.8, 0.3),
    (snm(-0.010), 7.0, 0.1),
    (snm(0.004, **STEEL), 2.0, 0.1),
    (snm(0.004, damping=1.2 * CRITICAL, bumper_damping_r=3e4), 1.0, -0.2),
    (snm(0.004, bumper_damping_r=2e4 * 3, bumper_stiffness_r=2e4), 1.3, 0.2),
    (snm(0.004, bumper_stiffness_l=9e5, gap_r=0.003, gap_l=-0.0005), 2.4, 0.1),
    (snm(0.004, gap_l=math.inf), 1.5, 0.1),
    (snm(0.004, damping=CRITICAL), 1.0, -0.2),
    (snm(0.004, bumper_damping_r=CRITICAL_IN_CONTACT), 2.0, 0.2),
]


@pytest.mark.parametrize("p, frequency, speed", CASES)
def test_agrees_with_dop853(p, frequency, speed):
    """Ten cycles of a drive that is linear between samples, so that both solve the same problem."""
    rate = 20 * frequency
    base, start = sine(frequency, rate, 10 / frequency), kick(p, speed)
    times = np.arange(base.size + 1) / rate
    drive = linear_between(times, np.concatenate([[0.0], base]))
    contact = (bool(start[4]), bool(start[5]))
    want, events = reference(p, start[:4], contact, drive, times)
    _, out, impacts = run(p, rate, base, start)
    error = np.abs(out[[U, V, U_R, U_L]] - want[:, 1:]).max(axis=1)
    assert (error < [1e-13, 1e-12, 1e-13, 1e-13]).all()
    assert len(impacts) == len(events) > 0 or p.gap_r + p.gap_l < -0.005
    assert impacts[:, 1:3].tolist() == (events[:, 1:] * [-2, 1] + [1, 0]).tolist()
    assert np.abs(impacts[:, 0] - events[:, 0]).max(initial=0.0) < EVENT_S


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("gap", [0.003, 0.0, -0.001])
@pytest.mark.parametrize("rate, peak", [(4.0, 0.4), (10.0, 1.0), (40.0, 300.0), (100.0, 60.0)])
def test_refining_a_drive_that_is_linear_between_samples_changes_nothing(gap, rate, peak, seed):
    """First-order hold is closed_form, and all events are found, many in one step or none.

    The drive is violent, so that a mass may leave a bumper and come back within one substep.
    """
    parts, p = round(32000 / rate), snm(gap)
    coarse = peak * np.random.default_rng(seed).uniform(-1, 1, 61)
    coarse[0] = 0.0
    fine = np.interp(np.arange(1, 60 * parts + 1) / parts, np.arange(61), coarse)
    _, few, events = run(p, rate, coarse[1:], kick(p, 0.1))
    _, many, events_fine = run(p, rate * parts, fine, kick(p, 0.1))
    assert len(events) == len(events_fine) > 5
    assert events[:, 1:3].tolist() == events_fine[:, 1:3].tolist()
    scale = np.abs(few[U]).max()
    assert np.abs(few - many[:, parts - 1 :: parts])[[U, U_R, U_L]].max() < 1e-8 * scale


def test_impacting_and_flight_solutions_coexist_at_g4():
    """The paper's 3.4 Hz: 5.123 mm impacting, 1.247 mm flight."""
    base = sine(3.4, 2000.0, 60)
    flying, _, _ = run(snm(math.inf), 2000.0, sine(3.4, 2000.0, 60))
    for state, want in ((kick(snm(), 0.1), 5.123e-3), (flying, 1.247e-3)):
        _, out, _ = run(snm(), 2000.0, base, state)
        assert np.abs(out[U, -4000:]).max() == pytest.approx(want, abs=1e-6)


def test_converges_to_the_sinusoid_with_order_two():
    from twin.model.stepped_sine import simulate_stepped_sine

    p, errors = snm(), []
    want = simulate_stepped_sine(p, [2.0], AG, 10, state=kick(p, 0.1)).states[0]
    for rate in (500.0, 1000.0, 2000.0, 4000.0):
        state, _, _ = run(p, rate, sine(2.0, rate, 5), kick(p, 0.1))
        errors.append(np.abs(state[:2] - want[:2]).max())
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.all(np.abs(orders - 2) < 0.1)
    assert errors[-1] < 1e-9


@pytest.mark.parametrize("gap", [0.004, 0.0, -0.002])
def test_contact_never_creates_energy(gap):
    """Without drive, kinetic and all elastic energy (bumpers too) only falls, events included."""
    p = snm(gap, damping=0.0)
    _, out, events = run(p, 2000.0, np.zeros(8000), kick(p, 0.3))
    energy = 0.5 * (
        p.mass * out[V] ** 2 + p.stiffness * out[U] ** 2
        + p.bumper_stiffness_r * out[U_R] ** 2 + p.bumper_stiffness_l * out[U_L] ** 2
    )  # fmt: skip
    assert len(events) >= 4
    assert np.diff(energy).max() <= 1e-13 * energy[0]
    assert energy[-1] < 0.9 * energy[0]


def test_outputs_fit_the_equation_of_motion_and_the_signs():
    p = snm(-0.001)
    base = sine(5.2, 2000.0, 4)
    _, out, _ = run(p, 2000.0, base)
    force = p.damping * out[V] + p.stiffness * out[U] + out[F_R] + out[F_L]
    assert np.abs(p.mass * out[A] + force).max() < 1e-9 * np.abs(force).max()
    assert (out[F_R] >= 0).all()
    assert (out[F_L] <= 0).all()
    assert (out[U_R] >= 0).all()
    assert (out[U_L] <= 0).all()
    assert out[F_R].max() > 100 < -out[F_L].min()
    assert (out[U_R] - out[U] + p.gap_r > -1e-13).all()
    assert (out[U] - out[U_L] + p.gap_l > -1e-13).all()


def test_events_tell_side_time_speed_and_impulse():
    """Impulses add up to the momentum balance; onset force is C times the closing speed."""
    p, rate = snm(), 2000.0
    base = sine(3.4, rate, 10)
    start = kick(p, 0.1)
    end, out, events = run(p, rate, base, start)
    times, side, onset, speed, impulse = events.T
    assert (np.diff(times) > 0).all()
    assert (speed[onset == 1] > 0).all()
    assert (side * impulse)[onset == 0].min() > 0
    assert (onset[side > 0] == (np.arange((side > 0).sum()) + 1) % 2).all()
    area = np.trapezoid(np.concatenate([[0.0], out[U]]), dx=1 / rate)
    drive = np.trapezoid(np.concatenate([[0.0], base]), dx=1 / rate)
    want = -p.mass * (end[V] - start[V] + drive) - p.damping * end[U] - p.stiffness * area
    assert impulse.sum() + end[7] + end[8] == pytest.approx(want, rel=1e-3)
    fine = run(p, 200000.0, sine(3.4, 200000.0, 0.1), start)
    first = fine[2][0]
    after = math.ceil(first[0] * 200000.0)
    assert fine[1][F_R, after] == pytest.approx(p.bumper_damping_r * first[3], rel=0.02)


def test_more_events_than_rows_are_counted():
    p, base = snm(), sine(3.4, 2000.0, 5)
    state, events = kick(p, 0.1), np.zeros((3, 5))
    out = np.empty((7, base.size))
    count = closed_form.advance_state(
        state, closed_form.discretized_params(p, 2000.0), base, out, events
    )
    assert count > 3
    assert (events[:, 0] > 0).all()


GAPS = [(-1e-3, -1e-3), (-2e-3, -1e-3), (-1e-3, 2e-3), (0.0, 0.0), (3e-3, -1e-3),
        (math.inf, -1e-3), (-1e-3, 1e-4), (np.float64(math.inf), np.float64(-1e-3))]  # fmt: skip


@pytest.mark.parametrize("gap_r, gap_l", GAPS)
def test_rest_is_an_equilibrium(gap_r, gap_l):
    p = snm(gap_r=gap_r, gap_l=gap_l, bumper_stiffness_l=7e5)
    with np.errstate(all="raise"):
        state = closed_form.rest_state(p)
    if gap_r < 0 and gap_l == -1e-3:
        k = p.stiffness + p.bumper_stiffness_r + p.bumper_stiffness_l
        want = (p.bumper_stiffness_l * 1e-3 + p.bumper_stiffness_r * gap_r) / k
        assert state[U] == pytest.approx(want)
    _, out, events = run(p, 2000.0, np.zeros(2000))
    assert np.abs(out[V]).max() < 1e-13
    assert np.abs(out[U] - state[U]).max() < 1e-15
    assert len(events) == 0


def test_left_and_right_are_mirror_images():
    """Swapping the sides and the sign of A mirrors the response, to the bit."""
    p = snm(bumper_stiffness_l=7e5, bumper_damping_l=2e3, gap_r=1e-3, gap_l=-5e-4)
    q = snm(bumper_stiffness_r=7e5, bumper_damping_r=2e3, gap_l=1e-3, gap_r=-5e-4)
    base = sine(2.7, 2000.0, 8)
    _, coarse_out, events = run(p, 2000.0, base)
    _, two, _ = run(q, 2000.0, -base)
    assert len(events) > 10
    assert np.array_equal(
        coarse_out[[U, V, A, F_R, F_L, U_R, U_L]], -two[[U, V, A, F_L, F_R, U_L, U_R]]
    )


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("depth", [1e-15, 1e-13, 1e-11, 1e-9, 1e-7, -1e-9])
def test_a_graze_inside_a_step_is_found_and_left_again(depth, side):
    """Half a cosine whose top lies between two samples and `depth` beyond the bumper."""
    top = 2e-3
    gaps = (top - depth, 1.0)[::side]
    p = snm(gap_r=gaps[0], gap_l=gaps[1], damping=0.0)
    w0, rate = math.sqrt(36e3 / 550), 1000.0
    state = closed_form.rest_state(p)
    start = (20.4 / rate) * w0
    state[U], state[V] = side * top * math.cos(start), side * top * w0 * math.sin(start)
    _, out, events = run(p, rate, np.zeros(60), state)
    want = side * top * np.cos(w0 * np.arange(1, 61) / rate - start)
    assert np.abs(out[U] - want).max() < 30 * math.sqrt(abs(depth)) * abs(depth) ** 0.5 + 1e-15
    assert len(events) == (2 if depth > 1e-13 else 0 if depth < 0 else len(events))
    if depth > 1e-13:
        assert events[1, 0] - events[0, 0] < 1.1 * math.sqrt(8 * depth / (top * w0**2))


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("depth", [1e-6, 1e-8, 1e-10])
def test_a_graze_agrees_with_dop853(depth, side):
    """A touch of 8 ms down to 0.08 ms, in and out between two samples."""
    top, rate = 2e-3, 50.0
    p = snm(gap_r=(top - depth, 1.0)[::side][0], gap_l=(top - depth, 1.0)[::side][1], damping=0.0)
    w0 = math.sqrt(36e3 / 550)
    state = closed_form.rest_state(p)
    begin = 1.4 / rate * w0
    state[U], state[V] = side * top * math.cos(begin), side * top * w0 * math.sin(begin)
    times = np.arange(4) / rate
    want, contacts = reference(p, state[:4], (False, False), lambda t: 0.0, times, dt=2e-5)
    _, out, impacts = run(p, rate, np.zeros(3), state)
    assert len(impacts) == len(contacts) == 2
    assert np.abs(out[[U, U_R, U_L]] - want[[0, 2, 3], 1:]).max() < 1e-14
    assert np.abs(impacts[:, 0] - contacts[:, 0]).max() < 1e-10
