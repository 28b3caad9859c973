"""Figures of a result, recomputed by a plain path: numpy alone, with force laws of its own."""

import math
from dataclasses import replace

import numpy as np
import pytest

from table_io.block import Block, Float1D, Label
from tests.recovery.scaled_specimens import (
    GAP,
    MASS,
    RATE_HZ,
    Hidden,
    prepare,
    record_block,
    start_model,
)
from twin.discovery.build_verdict import build_verdict
from twin.discovery.discover import Discovery, discover_effects
from twin.discovery.held_out import compute_force_error
from twin.discovery.identify import IdentificationResult, identify_parameters
from twin.discovery.parameters import (
    DAMPING,
    SLIP_SPEED,
    STIFFNESS,
    EffectKey,
    ParameterKey,
    ParameterSet,
)
from twin.discovery.result import HeldOutLog, IdentificationReport
from twin.discovery.task import build_report

FRICTION = Hidden("coulomb_friction", 120.0)
CUBIC = Hidden("cubic_stiffness", 3e6)
NOISE, HELD_OUT_NOISE, CUT_HZ = 0.003, 3e-4, 50.0


def moving(block: Block) -> np.ndarray:
    """The samples in motion, without half a second at the open end of the record."""
    used: np.ndarray = block.label != Label.REST
    used[-round(0.5 * RATE_HZ) :] = False
    return used


def differentiate(u: Float1D, order: int) -> Float1D:
    """Displacement below `CUT_HZ` (order 0) or its rate (order 1), with the open end faded out."""
    fade = round(0.5 * RATE_HZ)
    faded = u.copy()
    faded[-fade:] *= np.cos(np.linspace(0.0, 0.5 * np.pi, fade)) ** 2
    hz = np.fft.rfftfreq(4 * u.size, 1.0 / RATE_HZ)
    spectrum = np.fft.rfft(faded, 4 * u.size) * (hz < CUT_HZ) * (2j * np.pi * hz) ** order
    return np.fft.irfft(spectrum)[: u.size]


def plain_nrmse(block: Block, values: dict[ParameterKey, float]) -> float:
    """NRMSE of the force -M a - (K u + C v + law) on the raw record."""
    u, v = (differentiate(block.channel("rel_disp_m"), order) for order in (0, 1))
    force = -MASS * block.channel("mass_acc_m_s2")
    model = values[STIFFNESS] * u + values[DAMPING] * v
    model = model + values.get(EffectKey("cubic_stiffness", "k3"), 0.0) * u**3
    fc, slip = values.get(EffectKey("coulomb_friction", "fc"), 0.0), values.get(SLIP_SPEED, 1e-9)
    model = model + fc * np.tanh(v / slip)
    used = moving(block)
    return float((force - model)[used].std() / force[used].std())


def discover_and_hold_out(hidden: Hidden) -> tuple[Discovery, HeldOutLog, Block]:
    """Discover on one record, and judge on another of the same specimen with other noise."""
    discovery = discover_effects([prepare(record_block(hidden), hidden)], start_model())
    apart = record_block(hidden, noise=HELD_OUT_NOISE, seed=11)
    log = prepare(apart, hidden)
    verdict = build_verdict(discovery, held_out_logs=[log], given=start_model())
    return discovery, verdict.held_out_logs[0], apart


@pytest.mark.parametrize("hidden", [FRICTION, CUBIC], ids=lambda hidden: hidden.name)
def test_the_force_errors_of_a_held_out_log(hidden: Hidden) -> None:
    discovery, figures, apart = discover_and_hold_out(hidden)
    given: dict[ParameterKey, float] = {
        STIFFNESS: start_model().base.stiffness,
        DAMPING: start_model().base.damping,
    }
    null = dict(discovery.selection.null.fit.values)
    best = dict(discovery.verdict.best.fit.values)
    for key, values in (("given", given), ("before", null), ("after", best)):
        assert getattr(figures, f"nrmse_{key}") == pytest.approx(
            plain_nrmse(apart, values), rel=0.03, abs=0.015
        ), key  # the plain rate is noisier where friction turns
    assert figures.nrmse_after < 0.5 * figures.nrmse_before
    assert figures.nrmse_given is not None
    assert figures.nrmse_before <= figures.nrmse_given
    # that of the accelerometer, of the inertia force, and a little of the displacement
    assert 0.8 * HELD_OUT_NOISE < figures.noise_floor < 1.5 * HELD_OUT_NOISE


def test_the_speed_of_slip_is_that_of_the_fit() -> None:
    """Without it friction would jump where the record slides through zero."""
    discovery, figures, _ = discover_and_hold_out(FRICTION)
    best = discovery.verdict.best.fit.parameters
    assert SLIP_SPEED in best.values
    log = prepare(record_block(FRICTION, noise=HELD_OUT_NOISE, seed=11), FRICTION)
    without = ParameterSet({k: v for k, v in best.values.items() if k != SLIP_SPEED})
    assert figures.nrmse_after < 0.9 * compute_force_error(log, without).nrmse


def test_without_an_accelerometer_force_and_error_have_one_unit() -> None:
    """The force is then that of the displacement, and noisier, but as large."""
    block = record_block(CUBIC, noise=1e-4)
    kept = [k for k, name in enumerate(block.channels) if name != "mass_acc_m_s2"]
    bare = replace(
        block, channels=tuple(block.channels[k] for k in kept), values=block.values[kept]
    )
    parameters = ParameterSet.from_model(start_model(), 1)
    known = compute_force_error(prepare(block, CUBIC), parameters)
    derived = compute_force_error(prepare(bare, CUBIC), parameters)
    # independent noise of the derivative adds to the error and to the force
    error = math.hypot(known.nrmse, derived.noise_floor) / math.hypot(1.0, derived.noise_floor)
    assert derived.nrmse == pytest.approx(error, rel=0.1)
    assert derived.noise_floor > 3 * known.noise_floor


def identify(
    hidden: Hidden, noise: float = NOISE
) -> tuple[IdentificationResult, IdentificationReport, Block]:
    block = record_block(hidden, noise=noise)
    result = identify_parameters([prepare(block, hidden)], [(block,)], start_model())
    return result, build_report(result), block


def test_model_error_many_times_the_noise_is_reported() -> None:
    """Where model error rules every log gets the same weight; the figure is over the noise."""
    hidden = Hidden("bouc_wen", 900.0, 3e-3)
    result, report, block = identify(hidden, noise=2e-4)
    values = dict(result.fit.values)
    u, acc = block.channel("rel_disp_m"), block.channel("mass_acc_m_s2")
    error = -MASS * acc - values[STIFFNESS] * u - values[DAMPING] * differentiate(u, 1)
    used = moving(block)
    plain = float(error[used].std()) / (MASS * 2e-4 * float(acc.std()))
    assert plain > 50
    # other rows are noise, and lasers have errors in motion that a rest does not show
    assert 0.05 * plain < report.rms_over_noise < plain


def test_motion_errors_of_windows_have_their_noise_floor() -> None:
    result, report, block = identify(Hidden(gap=GAP))
    (window,) = report.windows
    u = block.channel("rel_disp_m")
    used = block.label != Label.REST
    rms = float(np.sqrt(np.mean(u[used] ** 2)))
    noise = NOISE * float(u.std())  # of `record_block`, nearly
    assert window.noise_floor == pytest.approx(noise / rms, rel=0.2)
    assert window.noise_floor < window.nrmse_identified < window.nrmse_start
    assert result.window_errors[0] == (window.nrmse_start, window.nrmse_identified)


def test_the_motion_errors_are_those_of_a_plain_integration() -> None:
    """Windows of a second from the measured state, with steps of a quarter of a sample."""
    result, report, block = identify(Hidden(), noise=3e-4)
    (window,) = report.windows
    start = start_model().base
    fitted = result.fit.values
    for key, k, c in (
        ("start", start.stiffness, start.damping),
        ("identified", fitted[STIFFNESS], fitted[DAMPING]),
    ):
        plain = integrate_windows(block, k, c)
        assert getattr(window, f"nrmse_{key}") == pytest.approx(plain, rel=0.05, abs=5e-3), key


def integrate_windows(block: Block, k: float, c: float) -> float:
    """NRMSE of u over windows of one second, each from the measured u and a smooth u'."""
    u, acc = block.channel("rel_disp_m"), block.channel("table_acc_m_s2")
    v, size = differentiate(u, 1), round(RATE_HZ)
    errors, squares, h = 0.0, 0.0, 0.25 / RATE_HZ
    first = size * math.ceil(float(np.flatnonzero(block.label != Label.REST)[0]) / size)
    for begin in range(first, u.size - size + 1, size):
        x, y = u[begin - 1], v[begin - 1]
        for n in range(size):
            a0, a1 = acc[begin - 1 + n], acc[begin + n]
            for part in range(4):
                a = a0 + (a1 - a0) * (part + 0.5) / 4
                mid_x, mid_y = x + 0.5 * h * y, y - 0.5 * h * ((k * x + c * y) / MASS + a)
                x, y = x + h * mid_y, y - h * ((k * mid_x + c * mid_y) / MASS + a)
            errors += float((u[begin + n] - x) ** 2)
        squares += float((u[begin : begin + size] ** 2).sum())
    return math.sqrt(errors / squares)
