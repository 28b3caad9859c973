"""The simulated truth against closed forms, conservation laws and published numbers."""

import math
from dataclasses import replace

import numpy as np
import pytest

from table_io.block import Float1D, Float2D
from table_io.sim.plant import Plant
from tests.input_errors import raises_input_error

M, K, C, KJ, CJ = 550.0, 36e3, 1100.0, 510e3, 900.0
A = 0.05 * 9.80665
RIG = Plant(M, K, C, KJ, CJ, 2e-3, 2e-3, 2000.0, 20.0, 0.005, False, 1000.0)
FREE = replace(RIG, gap_right_m=np.inf, gap_left_m=np.inf)
Y, Y_ACC, X, X_ACC, F_R, F_L = range(6)


def run(plant: Plant, command: Float1D, state: Float1D | None = None) -> Float2D:
    """SIGNALS, (6, sample), for a command in m that stood at 0 before."""
    state = plant.rest_state() if state is None else state
    out = np.empty((7, command.size))
    plant.advance(state, np.concatenate([np.zeros(plant.history_samples), command]), out)
    return out


def servo_gain(plant: Plant, f: float) -> float:
    """|H| of the double pole that is 3 dB down at the bandwidth."""
    return 1.0 / (1.0 + (math.sqrt(2.0) - 1.0) * (f / plant.servo_bandwidth_hz) ** 2)


def sine(plant: Plant, f: float, seconds: float, acc: float = A) -> Float1D:
    """Command for a table motion of peak acceleration `acc` once the servo has settled."""
    w = 2 * np.pi * f
    time = np.arange(round(seconds * plant.rate_hz)) / plant.rate_hz
    return -acc / w**2 / servo_gain(plant, f) * np.sin(w * time)


def phasor(signal: Float1D, f: float, rate_hz: float) -> complex:
    """Complex amplitude of signal = Im(phasor exp(i w t)), least squares, t from sample 0."""
    wt = 2 * np.pi * f * np.arange(signal.size) / rate_hz
    basis = np.stack([np.sin(wt), np.cos(wt), np.ones_like(wt)], axis=1)
    a, b, _ = np.linalg.lstsq(basis, signal, rcond=None)[0]
    return complex(a, b)


def one_at_a_time(plant: Plant, state: Float1D, samples: int) -> tuple[Float2D, Float2D]:
    """(signals (6, sample), states (8, sample)) with the table commanded to stay at 0."""
    signals, states = np.empty((7, samples)), np.empty((8, samples))
    for i in range(samples):
        plant.advance(state, np.zeros(plant.history_samples + 1), signals[:, i : i + 1])
        states[:, i] = state
    return signals, states


def energy(state: Float2D) -> Float1D:
    """Kinetic and elastic energy in J, faces included; the table at rest."""
    x, v, d_r, d_l = state[0], state[1], state[4], state[5]
    total: Float1D = 0.5 * (M * v**2 + K * x**2 + KJ * (d_r**2 + d_l**2))
    return total


@pytest.mark.parametrize("f", [0.7, 1.268, 3.0])
def test_free_flight_is_the_linear_oscillator(f: float) -> None:
    out = run(FREE, sine(FREE, f, 20.0))
    w = 2 * np.pi * f
    u = phasor((out[X] - out[Y])[-5000:], f, 1000.0)
    table = phasor(out[Y_ACC][-5000:], f, 1000.0)
    assert abs(u) == pytest.approx(M * A / abs(K - M * w**2 + 1j * w * C), rel=2e-4)
    assert np.angle(u / -table) == pytest.approx(-np.angle(K - M * w**2 + 1j * w * C), abs=1e-4)


def test_free_decay_follows_the_closed_form() -> None:
    state = FREE.rest_state()
    state[1] = 0.2
    x = run(FREE, np.zeros(3000), state)[X]
    time, a = np.arange(1, 3001) / 1000.0, C / (2 * M)
    wd = np.sqrt(K / M - a**2)
    np.testing.assert_allclose(x, 0.2 / wd * np.exp(-a * time) * np.sin(wd * time), atol=1e-9)


@pytest.mark.parametrize("start, u_mm", [(0.0, 1.247), (0.1, 5.123)])
def test_both_branches_at_3_4_hz_and_4_mm(start: float, u_mm: float) -> None:
    state = RIG.rest_state()
    state[1] = start
    out = run(RIG, sine(RIG, 3.4, 40.0), state)[:, -1000:]
    u = out[X] - out[Y]
    assert 1e3 * u.max() == pytest.approx(u_mm, abs=6e-4)
    assert 1e3 * u.min() == pytest.approx(-u_mm, abs=6e-4)


@pytest.mark.parametrize("toward", [1.0, -1.0])
def test_touch_from_zero_gap_follows_the_closed_form_of_the_contact(toward: float) -> None:
    plant = replace(RIG, gap_right_m=0.0, gap_left_m=0.0, substep_s=1e-4)
    state = plant.rest_state()
    state[1] = 0.1 * toward
    out = run(plant, np.zeros(40), state)
    time, a = np.arange(1, 41) / 1000.0, (C + CJ) / (2 * M)
    wd = np.sqrt((K + KJ) / M - a**2)
    x = 0.1 / wd * np.exp(-a * time) * np.sin(wd * time)
    v = 0.1 * np.exp(-a * time) * (np.cos(wd * time) - a / wd * np.sin(wd * time))
    np.testing.assert_allclose(toward * out[X], x, atol=1e-10)
    push = out[F_R] if toward > 0 else -out[F_L]
    np.testing.assert_allclose(push, KJ * x + CJ * v, atol=1e-4)


def test_bumpers_that_never_detach_make_a_stiffer_linear_oscillator() -> None:
    plant = replace(RIG, gap_right_m=-5e-3, gap_left_m=-5e-3)
    out = run(plant, sine(plant, 6.95, 10.0))
    w = 2 * np.pi * 6.95
    u = phasor((out[X] - out[Y])[-2000:], 6.95, 1000.0)
    table = phasor(out[Y_ACC][-2000:], 6.95, 1000.0)
    stiff = K + 2 * KJ - M * w**2 + 1j * w * (C + 2 * CJ)
    assert abs(u / table) == pytest.approx(M / abs(stiff), rel=2e-4)
    assert out[F_R].min() > 0
    assert out[F_L].max() < 0


@pytest.mark.parametrize("bumper_damping", [900.0, 20.0])
def test_contact_never_creates_energy(bumper_damping: float) -> None:
    plant = replace(RIG, damper_damping_n_s_m=0.0, bumper_damping_n_s_m=bumper_damping)
    state = plant.rest_state()
    state[1] = 0.3
    signals, states = one_at_a_time(plant, state, 2000)
    assert (signals[F_R] > 0).any()
    assert (signals[F_L] < 0).any()
    assert np.diff(energy(states)).max() < 1e-11


def test_energy_lost_is_the_work_of_the_dashpots() -> None:
    rate = 64000.0
    plant = replace(RIG, rate_hz=rate)
    state = plant.rest_state()
    state[1] = 0.3
    _, states = one_at_a_time(plant, state, 12800)
    v, touched = states[1], states[6:8] > 0
    power, jumps = C * v**2, 0.0
    for j in range(2):
        power += np.where(touched[j], CJ * v**2, KJ**2 / CJ * states[4 + j] ** 2)
        onset = np.flatnonzero(np.diff(touched[j].astype(int)) > 0) + 1
        assert onset.size > 0
        jumps += (CJ * v[onset] ** 2).sum()
    lost = energy(states)[0] - energy(states)[-1]
    # The trapezoid does not know where inside a sample the power jumps.
    assert lost == pytest.approx(np.trapezoid(power, dx=1 / rate), abs=0.5 * jumps / rate)


def test_bumper_pushes_and_never_pulls_and_the_mass_obeys_newton() -> None:
    plant = replace(RIG, rate_hz=4000.0)
    out = run(plant, sine(plant, 1.1, 5.0))
    assert out[F_R].min() == 0.0 < out[F_R].max()
    assert out[F_L].max() == 0.0 > out[F_L].min()
    u = out[X] - out[Y]
    assert (u[out[F_R] > 0] > 0).all()
    assert (u[out[F_L] < 0] < 0).all()
    balance = M * out[X_ACC] + C * np.gradient(u, 1 / 4000.0) + K * u + out[F_R] + out[F_L]
    touched = ((out[F_R] > 0) | (out[F_L] < 0)).astype(int)
    # Central differences are off only where an onset kinks the velocity between two samples.
    smooth = np.convolve(np.abs(np.diff(touched, prepend=0)), np.ones(3), "same") == 0
    assert np.abs(balance[smooth][1:-1]).max() < 0.5


def test_released_face_remembers() -> None:
    plant = replace(RIG, bumper_damping_n_s_m=KJ * 0.2)  # relaxes in 0.2 s
    state = plant.rest_state()
    state[1] = 0.3
    _, states = one_at_a_time(plant, state, 400)
    left = np.flatnonzero(np.diff(states[6]) < 0)[0] + 1
    decay = states[4, left + 50] / states[4, left]
    assert states[4, left] > 1e-4
    assert decay == pytest.approx(np.exp(-0.050 / 0.2), rel=1e-6)


@pytest.mark.parametrize("gaps", [(-1e-3, -1e-3), (-3e-3, -1e-3), (-2e-3, 4e-3), (-2e-3, np.inf)])
def test_static_equilibrium_of_pressed_bumpers_holds(gaps: tuple[float, float]) -> None:
    plant = replace(RIG, gap_right_m=gaps[0], gap_left_m=gaps[1], payload_reaction=True)
    state = plant.rest_state()
    u = state[0]
    expected = [KJ * max(u - gaps[0], 0.0), -KJ * max(-u - gaps[1], 0.0)]
    out = run(plant, np.zeros(500), state)
    assert K * u + sum(expected) == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(
        out[F_R : F_R + 2], np.array(expected)[:, None] * np.ones(500), atol=1e-6
    )
    assert np.abs(out[X] - out[X, 0]).max() < 1e-11


def test_integrator_is_of_fourth_order_through_contacts() -> None:
    command = sine(RIG, 3.4, 0.5, acc=2.0)

    def ends(parts: int) -> Float2D:
        return run(replace(RIG, substep_s=1e-3 / parts), command)[X, -5:]

    reference = run(replace(RIG, substep_s=1e-3 / 256), command)
    errors = [np.abs(ends(n) - reference[X, -5:]).max() for n in (4, 8, 16)]
    assert (np.diff((reference[F_R] > 0).astype(int)) == 1).sum() >= 2
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert (np.abs(orders - 4.0) < 0.4).all(), errors
    assert errors[-1] < 1e-13


@pytest.mark.parametrize("delay_s", [0.0005, 0.005, 0.0123])
def test_servo_is_3_db_down_at_its_bandwidth_after_its_delay(delay_s: float) -> None:
    plant = replace(FREE, servo_delay_s=delay_s, rate_hz=4000.0)
    time = np.arange(8000) / 4000.0
    for f, gain in ((20.0, np.sqrt(0.5)), (5.0, servo_gain(plant, 5.0))):
        command = 1e-3 * np.sin(2 * np.pi * f * time)
        table = run(plant, command)[Y]
        response = phasor(table[-4000:], f, 4000.0) / phasor(command[-4000:], f, 4000.0)
        # The spline of the output stage takes (w h)^2 / 8 off: 1.2e-4 at 20 Hz.
        assert abs(response) == pytest.approx(gain, rel=2e-4)
        lag = 2 * np.arctan(f / 20.0 * np.sqrt(np.sqrt(2.0) - 1.0)) + 2 * np.pi * f * delay_s
        turns = np.angle(response) + lag
        assert np.angle(np.exp(1j * turns)) == pytest.approx(0.0, abs=1e-5)


def test_table_acceleration_is_the_motion_and_has_no_sample_ripple() -> None:
    out = run(FREE, sine(FREE, 3.4, 5.0))[:, -2000:]
    w = 2 * np.pi * 3.4
    from_motion = -(w**2) * phasor(out[Y], 3.4, 1000.0)
    measured = phasor(out[Y_ACC], 3.4, 1000.0)
    assert abs(measured / from_motion - 1.0) < 1e-4
    wt = w * np.arange(2000) / 1000.0
    fitted = measured.real * np.sin(wt) + measured.imag * np.cos(wt)
    assert np.abs(out[Y_ACC] - fitted).max() < 1e-4 * A


def test_specimen_pushes_the_table_back() -> None:
    plant = replace(RIG, payload_reaction=True)
    state = plant.rest_state()
    state[0], state[1] = 10e-3, 0.0  # mass right of the table: the damper pulls the table right
    free = replace(plant, gap_right_m=np.inf, gap_left_m=np.inf)
    out = run(free, np.zeros(300), state)
    p = 2 * np.pi * 20.0 / np.sqrt(np.sqrt(2.0) - 1.0)
    y, y_acc = out[Y], out[Y_ACC]
    v = np.gradient(y, 1e-3)
    on_table = 2000.0 * (y_acc + 2 * p * v + p**2 * y)
    assert y[5] > 0.0
    np.testing.assert_allclose(on_table[5:-5], -M * out[X_ACC][5:-5], atol=2.0)


def test_bumper_too_fast_to_follow_is_refused_with_a_limit() -> None:
    with raises_input_error(key="bumper_damping_n_s_m", value=0.1) as error:
        replace(RIG, bumper_damping_n_s_m=0.1)
    assert error.value.allowed.startswith("at least 5.1")


def test_command_that_does_not_span_the_output_is_refused() -> None:
    with pytest.raises(ValueError, match="does not span"):
        RIG.advance(RIG.rest_state(), np.zeros(3), np.empty((7, 10)))
