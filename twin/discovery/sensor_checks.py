"""Checks of the instruments, apart from any force law: healthy, or to be mended.

Noise is judged on the record at rest. A laser and an accelerometer on one body are compared with
each other, as are the two load cells of a side with their sum. Where errors explain the recordings
together with the model, they are added from the fit: gaps read wrongly, and resonances.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from table_io.block import Bool2D, Float1D, Label
from table_io.channels import CHANNEL_BY_NAME
from twin.compare.hum import find_near_lines
from twin.compare.spectra import Spectrum
from twin.discovery.least_squares import FitResult
from twin.discovery.nuisances import list_sizes
from twin.discovery.parameters import GapKey, NuisanceKey
from twin.discovery.residuals import LogResiduals
from twin.discovery.signals import CELL_PAIRS, OPEN_END_S, SENSOR_PAIRS, LogSignals
from twin.evidence.linear import INTERVAL_SIGMA

STRONG_RATIO = 25.0  # power of a spectral line over its noise: weaker ones are not compared
# Limits of healthy instruments; see `table_io.sim.imperfections` for sizes in laboratories.
MAX_HUM_RATIO = 5.0  # rms over that of the noise
MAX_CORNER_HZ = 100.0  # below it 1/f noise exceeds white noise; 1 Hz is usual, seen to a factor
MAX_RESOLUTION_SHARE = 0.01  # of the rms of the channel in motion
MIN_FILTER_HZ = 125.0  # an impact on a stiff bumper has harmonics up to there
FILTER_SHARE = 0.125  # of the rate, from which an anti-alias filter of a slow recording is its due
MAX_GAIN_ERROR = 0.02  # two calibrations of 1 %, or the slope of a laser for small motions
MAX_LAG_S = 4e-4  # multiplexed converters and unequal filters stay below it
MAX_LOW_CUT_HZ = 0.4  # 8 % at 1 Hz
MAX_REMAINDER_SHARE, MIN_REMAINDER_RATIO = 0.02, 3.0  # of the motion; over the noise
# Of an accelerometer on its bracket; beyond the Nyquist frequency none can be told from a gain that
# rises with frequency.
MIN_RESONANCE_HZ = 400.0
MAX_SHARE_ERROR = 0.05  # of the force, off an equal division between the cells of a side
MAX_PLATE_SHARE = 0.015  # of the mass of the specimen, in front of the cells of a side
MAX_GAP_ERROR_M = 1.5e-4  # a feeler gauge reads to 0.05 mm


@dataclass(frozen=True, slots=True)
class SensorCheck:
    """One checked quantity of a log: value with its 95 % interval, and the limit of its size.

    kind         value
    noise        rms at rest, in the unit of the channel; no limit
    hum          rms of mains hum at rest over that noise
    one_over_f   frequency below which 1/f noise exceeds white noise, Hz
    resolution   smallest step of the readings over the rms in motion
    filter       half-power frequency of an anti-alias filter, Hz; the limit is the least
    resonance    frequency of an accelerometer on its bracket, Hz; the limit is the least
    gain, lag, low_cut, remainder   accelerometer against laser: gain less 1, lag in s, corner in
                 Hz, and what none of them explains, over the motion
    share        force of the first cell of a side over that of both, less 1/2
    plate        mass in front of the cells of a side over that of the specimen
    gap          true gap of a side less the stated one, m
    """

    log: str
    kind: str
    channels: tuple[str, ...]
    value: float
    low: float
    high: float
    limit: float | None
    unit: str = ""

    @property
    def is_healthy(self) -> bool:
        """Return False if the whole interval is beyond the limit."""
        if self.limit is None:
            return True
        if self.kind in ("filter", "resonance"):
            return bool(self.high >= self.limit)
        is_small = min(abs(self.low), abs(self.high)) <= self.limit
        return bool(is_small or self.low < 0 < self.high)


def check_sensors(
    log_residuals: Sequence[LogResiduals], fit: FitResult, is_explained: bool
) -> tuple[SensorCheck, ...]:
    """Return all checks of the instruments of logs, with the parameters of a fit to them.

    Unless the fit leaves noise alone, its errors of instruments may be what the model lacks.
    """
    checks: list[SensorCheck] = []
    for residuals in log_residuals:
        signals = residuals.signals if residuals.nuisances is None else residuals.nuisances.raw
        checks += _check_noise(signals)
        checks += compare_sensors(signals)
        checks += _check_cells(signals)
        if is_explained:
            checks += _check_fitted(residuals, fit)
    return tuple(checks)


def _check_noise(signals: LogSignals) -> Iterator[SensorCheck]:
    rate_hz = signals.grid.rate_hz
    for channel, noise in signals.rest_noise.items():
        rms, motion = max(noise.rms, np.finfo(float).tiny), signals.channel_rms(channel)

        # noise makes up for a coarse step
        step = noise.resolution if noise.resolution > 2.0 * rms else 0.0
        rows: list[tuple[str, float, float | None, str]] = [
            ("noise", rms, None, CHANNEL_BY_NAME[channel].unit),
            ("hum", noise.hum_rms / rms, MAX_HUM_RATIO, ""),
            ("one_over_f", noise.corner_hz, MAX_CORNER_HZ, "Hz"),
            ("resolution", step / motion if motion else 0.0, MAX_RESOLUTION_SHARE, ""),
            ("filter", noise.filter_hz, min(MIN_FILTER_HZ, FILTER_SHARE * rate_hz), "Hz"),
        ]
        for kind, value, limit, unit in rows:
            is_measured = kind != "one_over_f" or value <= 0.5 * rate_hz
            if math.isfinite(value) and is_measured:
                yield SensorCheck(signals.name, kind, (channel,), value, value, value, limit, unit)


def compare_sensors(signals: LogSignals) -> Iterator[SensorCheck]:
    """Yield the checks of each accelerometer against the laser on the same body."""
    signals = signals.in_whole_band
    for channels in SENSOR_PAIRS.values():
        if {*channels} <= {*signals.channels}:
            position, acc = channels[0], channels[1]
            spectrum, variance = signals.spectra[acc], signals.noise[acc] ** 2
            if len(channels) > 2:  # relative displacement: the table's acceleration is taken off
                spectrum = spectrum - signals.spectra[channels[2]]
                variance = variance + signals.noise[channels[2]] ** 2
            variance = variance + (signals.omega**2 * signals.noise[position]) ** 2
            yield from _compare_pair(
                signals, channels, signals.spectra[position], spectrum, variance
            )


def _compare_pair(
    signals: LogSignals, channels: tuple[str, ...], position: Spectrum, acc: Spectrum,
    variance: Float1D,
) -> Iterator[SensorCheck]:  # fmt: skip
    """Yield gain, lag and low cut of an accelerometer against a displacement, by least squares.

    The spectra and the variance of the noise density of their balance are (frequency,).
    """
    sigma = np.sqrt(variance * signals.grid.size)
    strong = (np.abs(acc) ** 2 > STRONG_RATIO * sigma**2) & (signals.omega > 0)
    strong &= signals.low_pass > 0.5
    strong &= ~find_near_lines(signals.omega / (2.0 * np.pi), signals.hum_hz)
    if strong.sum() < 10:
        return
    valid = _select_valid(signals)
    if not valid.any():
        return
    # what is cut out of a record mixes its frequencies
    used = signals.omega > 0
    omega = signals.omega[used]

    def observe(values: Spectrum) -> Spectrum:
        """Return the strong frequencies of what is seen of a signal, from those used."""
        spectrum = np.zeros(used.size, dtype=np.complex128)
        spectrum[used] = values
        return _cut_spectrum(signals, spectrum, valid)[strong]

    expected, measured = (
        values[used] / sigma[used] for values in (-(signals.omega**2) * position, acc)
    )
    measured = observe(measured)

    def residual(errors: Float1D) -> Float1D:
        gain, lag, low_cut = errors[0], 1e-3 * errors[1], errors[2]
        modelled = gain * expected * np.exp(-1j * omega * lag) / (1.0 - 1j * low_cut / omega)
        difference = measured - observe(modelled)
        return np.concatenate([difference.real, difference.imag])

    fit = least_squares(residual, (1.0, 0.0, 0.01), bounds=([-2, -20, 0], [5, 20, 20]))
    count = max(2 * strong.sum() * float(valid.mean()), 4.0)
    chi_square = max(float(fit.fun @ fit.fun) / (count - 3), 1.0)
    sd = np.sqrt(np.diag(np.linalg.pinv(fit.jac.T @ fit.jac)) * chi_square)
    gain, lag, low_cut = fit.x
    rows = (
        ("gain", gain - 1.0, sd[0], MAX_GAIN_ERROR, ""),
        ("lag", 1e-3 * lag, 1e-3 * sd[1], MAX_LAG_S, "s"),
        ("low_cut", low_cut / (2 * np.pi), sd[2] / (2 * np.pi), MAX_LOW_CUT_HZ, "Hz"),
    )
    for kind, value, deviation, limit, unit in rows:
        yield _check_estimate(signals, kind, channels, value, deviation, limit, unit)
    ratio = math.sqrt(chi_square)
    share = float(np.linalg.norm(fit.fun) / np.linalg.norm(measured))
    yield SensorCheck(
        signals.name, "remainder", channels, share, share, share,
        MAX_REMAINDER_SHARE if ratio > MIN_REMAINDER_RATIO else None,
    )  # fmt: skip


def _select_valid(signals: LogSignals) -> Bool2D:
    """Return the samples to compare, (sample,): not the ends, where a mass may still move.

    A displacement that does not end at zero has no acceleration there, only a step.
    """
    valid = signals.good.copy()
    margin = round(OPEN_END_S * signals.grid.rate_hz / signals.grid.decimation)
    valid[:margin] = valid[valid.size - margin :] = False
    return valid


def _cut_spectrum(signals: LogSignals, spectrum: Spectrum, valid: Bool2D) -> Spectrum:
    """Return the spectrum of the valid samples of a signal with white noise, (frequency,).

    Louder noise of other frequencies would leak over the cuts, as would an offset, and the steps at
    lost samples would ring beyond them without the roll-off of the low pass.
    """
    values = signals.grid.to_time_domain(signals.low_pass * spectrum)
    return signals.grid.from_time_domain(np.where(valid, values - values[valid].mean(), 0.0))


def _check_cells(signals: LogSignals) -> Iterator[SensorCheck]:
    moving = signals.good & (signals.label != Label.REST)
    for side, cells in CELL_PAIRS.items():
        if not {*cells} <= {*signals.channels} or not moving.any():
            continue
        first, second = (
            signals.grid.to_time_domain(signals.spectra[cell])[moving] for cell in cells
        )
        force = first + second
        noise = math.hypot(*(signals.grid.white_noise_rms(signals.noise[cell]) for cell in cells))
        loaded = np.abs(force) > STRONG_RATIO * noise
        if loaded.sum() > 100:
            share, sd = _fit_ratio(first[loaded] - second[loaded], force[loaded])
            yield _check_estimate(signals, "share", cells, 0.5 * share, 0.5 * sd, MAX_SHARE_ERROR)
        if "table_acc_m_s2" not in signals.channels:
            continue
        table = signals.grid.to_time_domain(signals.spectra["table_acc_m_s2"])[moving]
        idle = np.abs(force) < max(0.2 * STRONG_RATIO * noise, 0.02 * float(np.abs(force).max()))
        if idle.sum() > 100:
            sign = -1.0 if side == "right cells" else 1.0
            mass, sd = _fit_ratio(sign * force[idle], table[idle])
            yield _check_estimate(
                signals, "plate", cells, mass / signals.mass_kg, sd / signals.mass_kg,
                MAX_PLATE_SHARE,
            )  # fmt: skip


def _fit_ratio(values: Float1D, reference: Float1D) -> tuple[float, float]:
    """Return the ratio of two signals by least squares, and its standard deviation by blocks."""
    parts = [
        (float(v @ r), float(r @ r))
        for v, r in zip(np.array_split(values, 10), np.array_split(reference, 10), strict=True)
    ]
    products, powers = np.array(parts).T
    ratio = products.sum() / powers.sum()
    left_out = (products.sum() - products) / np.maximum(powers.sum() - powers, 1e-300)
    return float(ratio), float(np.sqrt(0.9 * np.sum((left_out - ratio) ** 2)))


def _check_fitted(residuals: LogResiduals, fit: FitResult) -> Iterator[SensorCheck]:
    """Yield the gaps of the fit, and a resonance of an accelerometer on its bracket.

    Lags are judged by pairs of sensors alone: a force law that is wrong would move them.
    """
    signals, number = residuals.signals, residuals.log_number
    unequal = unequal_sd = 0.0
    for nuisance, z in list_sizes(residuals, fit.parameters):
        key = NuisanceKey(number, nuisance.kind, nuisance.place)
        value = nuisance.size * z
        sd = nuisance.size * fit.std_errors.get(key, 0.0)
        if nuisance.kind == "gap":
            unequal, unequal_sd = value, sd
        elif (
            # beside an anti-alias filter the difference of two filters looks like a resonance
            nuisance.kind == "resonance"
            and math.isinf(signals.filter_hz)
            and value > INTERVAL_SIGMA * sd
        ):
            frequency, low, high = (
                (value + deviation) ** -0.5 / (2.0 * math.pi)
                for deviation in (0.0, INTERVAL_SIGMA * sd, -INTERVAL_SIGMA * sd)
            )
            yield SensorCheck(
                signals.name, "resonance", (nuisance.place,), frequency, low, high,
                min(MIN_RESONANCE_HZ, 0.5 * signals.grid.rate_hz), "Hz",
            )  # fmt: skip
    common, sd = fit.values.get(GapKey(number), 0.0), fit.std_errors.get(GapKey(number), 0.0)
    for side, sign, gap in zip(("right", "left"), (1.0, -1.0), signals.gaps_m, strict=True):
        if math.isfinite(gap) and (sd or unequal_sd):
            yield _check_estimate(
                signals, "gap", (side,), common + sign * unequal, math.hypot(sd, unequal_sd),
                MAX_GAP_ERROR_M, "m",
            )  # fmt: skip


def _check_estimate(
    signals: LogSignals, kind: str, channels: tuple[str, ...], value: float, sd: float,
    limit: float, unit: str = "",
) -> SensorCheck:  # fmt: skip
    value, half = float(value), INTERVAL_SIGMA * float(sd)
    return SensorCheck(signals.name, kind, channels, value, value - half, value + half, limit, unit)
