"""Sensitivity and offset come back with the uncertainty that the noise really makes."""

import math

import numpy as np
import pytest

from table_io.config.calibration import CalibrationFit, MeanVoltage, fit_calibration, mean_voltage
from table_io.errors import InputError

SENSITIVITY, OFFSET = 0.13, -0.4  # volts = SENSITIVITY (value + OFFSET)


def volts(applied: tuple[float, ...]) -> list[float]:
    return [SENSITIVITY * (value + OFFSET) for value in applied]


@pytest.mark.parametrize("points", [(0.0, 10.0), (-5.0, 0.0, 2.0, 10.0)])
def test_uncertainty_is_the_scatter_of_many_calibrations(points: tuple[float, ...]) -> None:
    """Each point with its own noise: the standard deviation over 2000 of them is what is stated."""
    draw, sd = np.random.default_rng(1), np.linspace(1e-4, 4e-4, len(points))
    fits: list[CalibrationFit] = []
    for _ in range(2000):
        noisy = np.array(volts(points)) + sd * draw.standard_normal(len(points))
        fits.append(
            fit_calibration(points, 0.0, tuple(map(MeanVoltage, noisy.tolist(), sd.tolist())))
        )
    stated = min(fits, key=lambda fit: fit.volts_per_unit_sd)  # not inflated by a chance scatter
    assert np.std([fit.volts_per_unit for fit in fits]) == pytest.approx(
        stated.volts_per_unit_sd, rel=0.06
    )
    assert np.std([fit.offset for fit in fits]) == pytest.approx(stated.offset_sd, rel=0.06)
    assert np.mean([fit.volts_per_unit for fit in fits]) == pytest.approx(SENSITIVITY, abs=2e-5)


def test_points_far_from_zero_and_near_together_are_no_trouble() -> None:
    points = (1e6, 1e6 + 1e-3)
    fit = fit_calibration(points, 0.0, tuple(MeanVoltage(mean, 1e-6) for mean in volts(points)))
    assert fit.volts_per_unit == pytest.approx(SENSITIVITY, rel=1e-6)
    assert fit.volts_per_unit_sd == pytest.approx(math.sqrt(2) * 1e-3, rel=1e-6)


def test_fit_calibration_refuses_equal_points() -> None:
    with pytest.raises(InputError):
        fit_calibration((1.0, 1.0), 0.0, (MeanVoltage(0.1, 1e-4), MeanVoltage(0.1, 1e-4)))


def test_standard_error_is_that_of_the_mean_also_of_slow_noise() -> None:
    draw = np.random.default_rng(2)
    slow = np.repeat(draw.standard_normal((400, 20)), 100, axis=1)  # 50 ms long each
    for noise in (draw.standard_normal((400, 2000)), slow):
        means = [mean_voltage(row) for row in noise]
        scatter = np.std([mean.volts for mean in means])
        stated = np.sqrt(np.mean([mean.sd**2 for mean in means]))
        assert stated == pytest.approx(scatter, rel=0.1)


@pytest.mark.parametrize("hz", [50.0, 60.0])
def test_hum_does_not_move_the_mean(hz: float) -> None:
    t = np.arange(2000) / 2000.0
    mean = mean_voltage(0.25 + 0.1 * np.sin(2 * np.pi * hz * t + 1.0))
    assert mean.volts == pytest.approx(0.25, abs=1e-9)
    assert mean.sd < 1e-9


def test_lost_samples_do_not_count() -> None:
    row = np.full(2000, 0.5)
    row[:700] = np.nan
    assert mean_voltage(row).volts == 0.5
    assert math.isnan(mean_voltage(np.full(2000, np.nan)).volts)


@pytest.mark.parametrize("known_chunks", range(11))
def test_mean_is_that_of_the_tenths_that_have_samples(known_chunks: int) -> None:
    row = np.random.default_rng(known_chunks).standard_normal(400)
    tenths = row.reshape(10, 40)
    tenths[known_chunks:] = np.nan
    tenths[0, :39] = np.nan  # one sample is enough for its tenth
    mean = mean_voltage(row)
    means = [np.nanmean(tenth) for tenth in tenths[:known_chunks]]
    if known_chunks < 2:
        assert np.isnan([mean.volts, mean.sd]).all()
        return
    assert mean.volts == pytest.approx(np.mean(means), rel=1e-12)
    scatter = np.sum((np.array(means) - np.mean(means)) ** 2) / (known_chunks - 1)
    assert mean.sd == pytest.approx(math.sqrt(scatter / known_chunks), rel=1e-12)


@pytest.mark.parametrize("sensitivity", [0.13, -2.0])
@pytest.mark.parametrize("count", [2, 3, 6])
@pytest.mark.parametrize("noise", [0.2, 5.0])
@pytest.mark.parametrize("applied_sd", [0.0, 0.02])
@pytest.mark.parametrize("zeros", [0, 1])
def test_fit_is_weighted_least_squares_with_propagated_covariance(
    sensitivity: float, count: int, noise: float, applied_sd: float, zeros: int
) -> None:
    """`noise` in the stated errors; `zeros` points have none, so all weigh the same then."""
    draw = np.random.default_rng(count)
    applied = draw.permutation(np.linspace(-4.0, 9.0, count))
    sd = 1e-3 * draw.uniform(1.0, 4.0, count)
    volts = sensitivity * (applied - 0.7) + noise * sd * draw.standard_normal(count)
    sd[:zeros] = 0.0
    fit = fit_calibration(
        tuple(applied.tolist()), applied_sd, tuple(map(MeanVoltage, volts.tolist(), sd.tolist()))
    )
    total = np.hypot(sd, applied_sd * np.polyfit(applied, volts, 1)[0])
    is_known = bool((total > 0).all())
    weight = 1.0 / total if is_known else np.ones(count)
    basis = np.stack([applied, np.ones(count)], axis=1)
    (slope, constant), *_ = np.linalg.lstsq(basis * weight[:, None], volts * weight, rcond=None)
    residuals = volts - basis @ [slope, constant]
    scatter = np.sum((weight * residuals) ** 2) / (count - 2) if count > 2 else 0.0
    scale = max(scatter, 1.0) if is_known else scatter
    covariance = scale * np.linalg.inv((basis * weight[:, None] ** 2).T @ basis)
    gradient = np.array([-constant / slope**2, 1.0 / slope])
    assert fit.volts_per_unit == pytest.approx(slope, rel=1e-9)
    assert fit.offset == pytest.approx(constant / slope, rel=1e-9)
    assert fit.volts_per_unit_sd == pytest.approx(math.sqrt(covariance[0, 0]), rel=1e-6)
    offset_sd = math.sqrt(max(gradient @ covariance @ gradient, 0.0))
    assert fit.offset_sd == pytest.approx(offset_sd, rel=1e-6)
    if count == 2:
        assert fit.linearity_percent is None
    else:
        share = np.abs(residuals).max() / abs(slope * 13.0)
        assert fit.linearity_percent == pytest.approx(100.0 * share, rel=1e-6)


def test_dead_sensor_has_no_offset_and_no_linearity() -> None:
    means = (MeanVoltage(0.0, 1e-4),) * 3
    fit = fit_calibration((-5.0, 0.0, 5.0), 0.0, means)
    assert fit.volts_per_unit == 0.0
    assert np.isnan([fit.offset, fit.offset_sd]).all()
    assert fit.linearity_percent is None
