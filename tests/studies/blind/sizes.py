"""Search for the amplitude at which an effect leaves a residual of a given size.

Each trial simulates the case. The residual is that of the base model with refitted parameters, on
noise-free signals, each row divided by the noise that the sensors would cause in it:

    damper        -M a - F_R - F_L = K u + C u'          while the table moves
    right, left    F_R = K_j u + C_j u' - P,  -F_L = -K_j u - C_j u' - P      in contact
                   0 (no force)                        where a bumper pulls
    mass, table    a + w^2 x = 0                          disagreement of laser and accelerometer

M is the nominal mass; K, C, K_j, C_j and P = K_j G/2 are refitted. The base model is linear in
them, so one least-squares fit suffices. Displacement is the minimum-variance estimate from laser
and accelerometer. With d the rms of all rows and noise of rms 1 on top, the size is sqrt(1 + d^2).
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from scipy.fft import irfft, rfft, rfftfreq

from table_io.block import Bool2D, Float1D, Float2D
from table_io.config.base import parse_toml
from tests.studies.blind.cases import PlantedEffect
from tests.studies.blind.rig import MODEL_TOML, PROFILE, SIGNAL_CHANNELS, StudySignals
from twin.model.config import ModelConfig

BANDWIDTH_HZ = 225.0  # of the fit; discovery uses 500 Hz samples after a low pass
Key = TypeVar("Key", float, str)
MAX_TRIALS = 8
RESIDUAL_TOLERANCE = 0.03  # relative, of the rms
MAX_GROWTH = 10.0  # of the amplitude per trial
PHASES = ("flight", "contact_right", "contact_left", "contact_both")
MIN_RELATIVE_RMS = 0.5  # of the largest rms: a residual above it is prominent


@dataclass(frozen=True, eq=False)
class BaselineResidual:
    """Residual of the base model over the noise: `rms` of all rows, and by frequency and phase."""

    rms: float
    by_frequency: Mapping[float, float]
    by_phase: Mapping[str, float]

    @property
    def size(self) -> float:
        """Size with noise of rms 1 added, sqrt(1 + rms^2)."""
        return math.hypot(1.0, self.rms)

    @property
    def region(self) -> dict[str, object]:
        """Frequency band in Hz and contact phases in which the residual is prominent."""
        band = _select_prominent(self.by_frequency)
        return {"frequency_hz": [min(band), max(band)], "phase": _select_prominent(self.by_phase)}


def _select_prominent(rms: Mapping[Key, float]) -> list[Key]:
    largest = max(rms.values())
    return [key for key, value in rms.items() if value >= MIN_RELATIVE_RMS * largest]


def scale_parameters(planted: PlantedEffect, share: float) -> dict[str, float]:
    """Return the parameters of a planted effect: amplitudes scaled by `share`, and its shapes.

    An amplitude is `share` times its typical value. A parameter that vanishes at a nonzero value is
    scaled logarithmically, so that both signs are equally far.
    """
    values = dict(planted.shapes)
    for parameter in planted.effect.definition.parameters:
        if parameter.vanishing is None:
            if parameter.default is None:
                values.setdefault(parameter.name, parameter.typical)
        elif parameter.vanishing:
            values[parameter.name] = parameter.vanishing * math.exp(
                planted.sign * share * math.log(parameter.typical / parameter.vanishing)
            )
        else:
            values[parameter.name] = planted.sign * share * parameter.typical
    return values


def max_share(planted: PlantedEffect) -> float:
    """Return the largest share that the bounds of the amplitudes allow."""
    share = math.inf
    for parameter in planted.effect.amplitudes:
        vanishing = parameter.vanishing or 0.0
        bound = (
            parameter.high if planted.sign * (parameter.typical - vanishing) > 0 else parameter.low
        )
        if vanishing:
            ratio = math.log(bound / vanishing) / math.log(parameter.typical / vanishing)
        else:
            ratio = bound / parameter.typical
        share = min(share, abs(ratio))
    return share


def find_share(
    planted: PlantedEffect, size: float, residual_at: Callable[[float], BaselineResidual]
) -> tuple[float, BaselineResidual]:
    """Find the share that leaves a residual of `size`; return (share, residual) of the best trial.

    Extrapolates a power law from trial to trial, because jumps and chaos make the residual rough.
    Where d decreases again (sticking friction, a blocked damper), smaller shares are searched.
    """
    target, limit = math.sqrt(size**2 - 1.0), max_share(planted)
    share, slope, falling_share = min(1.0, limit), 1.0, math.inf
    trials: list[tuple[float, BaselineResidual]] = []
    previous = (0.0, 0.0)
    for _ in range(MAX_TRIALS):
        trials.append((share, residual_at(share)))
        d = max(trials[-1][1].rms, 1e-9)
        if abs(d / target - 1.0) < RESIDUAL_TOLERANCE:
            break
        if share > previous[0] and d < previous[1]:
            falling_share, share = share, math.sqrt(share * previous[0])
            continue
        if share >= limit and d < target:
            break
        if previous[0] and share != previous[0]:
            slope = math.log(d / previous[1]) / math.log(share / previous[0])
        previous = share, d
        factor = (target / d) ** (1.0 / min(max(slope, 0.4), 2.5))
        factor = min(max(factor, 1.0 / MAX_GROWTH), MAX_GROWTH)
        share = min(share * factor, limit, math.sqrt(share * falling_share))
    return min(trials, key=lambda trial: abs(math.log(max(trial[1].rms, 1e-9) / target)))


def apply_sensor_effect(
    planted: PlantedEffect, share: float, signals: StudySignals
) -> StudySignals:
    """Apply a planted sensor effect to the signals; return them unchanged for other effects."""
    if not planted.effect.definition.is_sensor_effect:
        return signals
    name, values = planted.effect.channel, scale_parameters(planted, share)
    true = signals.channels[name]
    values_read = values.get("gain", 1.0) * true + values.get("offset", 0.0)
    if "lag" in values:
        w = 2 * np.pi * rfftfreq(true.size, 1.0 / PROFILE.acquisition.rate_hz)
        values_read = irfft(rfft(true) * np.exp(-1j * w * values["lag"]), true.size)
    error = values_read - true
    right = signals.right + (error if name.startswith("force_r") else 0.0)
    left = signals.left - (error if name.startswith("force_l") else 0.0)
    readings = {**signals.channels, name: values_read}
    return StudySignals(readings, right, left, signals.step, signals.label)


def evaluate_residual(
    readings: StudySignals, signals: StudySignals, noise: Mapping[str, float]
) -> BaselineResidual:
    """Return the residual of the refitted base model; `noise` is the rms per channel in SI."""
    u, v, s_u, s_v, disagreements = _fuse_motion(readings, noise)
    nominal = _nominal_parameters()
    band_factor = math.sqrt(2 * BANDWIDTH_HZ / PROFILE.acquisition.rate_hz)
    cell_noise = band_factor * math.sqrt(2.0) * noise["force_r1_n"]
    motion_noise = math.hypot(nominal["stiffness_n_m"] * s_u, nominal["damping_n_s_m"] * s_v)
    inertia_noise = PROFILE.specimen.mass_kg * noise["mass_acc_m_s2"] * band_factor
    bumper_noise = math.hypot(
        cell_noise, nominal["bumper_stiffness_n_m"] * s_u, nominal["bumper_damping_n_s_m"] * s_v
    )
    force = (
        -PROFILE.specimen.mass_kg * readings.channels["mass_acc_m_s2"]
        - readings.right
        - readings.left
    )
    damper_residual = _fit_residual(np.stack([u, v]), force, signals.moving) / math.hypot(
        inertia_noise, motion_noise, math.sqrt(2.0) * cell_noise
    )
    on_r, on_l = signals.right > 0.0, signals.left < 0.0
    side = np.where(on_r, 1.0, -1.0)
    columns = np.stack([side * u, side * v, -np.ones_like(u)])
    bumper_force = np.where(on_r, readings.right, -readings.left)
    in_contact = (on_r ^ on_l) & signals.moving  # one side only
    in_tension = (
        np.minimum(signals.right, -signals.left) < 0.0
    ) & signals.moving  # not in the base model
    bumper_residual = _fit_residual(columns, bumper_force, in_contact) / bumper_noise
    bumper_residual += np.where(
        in_tension, np.minimum(readings.right, -readings.left) / bumper_noise, 0.0
    )
    squares = (
        damper_residual**2
        + bumper_residual**2
        + sum(disagreement**2 for disagreement in disagreements) * signals.moving
    )
    entries = 3.0 * signals.moving + (in_contact | in_tension)
    phase = np.where(on_r & on_l, 3, np.where(signals.right != 0.0, 1, 2 * (signals.left != 0.0)))
    steps = PROFILE.sweep.steps
    grid = {
        hz: np.isin(signals.step, [k for k, step in enumerate(steps) if step.frequency_hz == hz])
        for hz in PROFILE.sweep.frequencies_hz
    }

    def rms(mask: Bool2D) -> float:
        return math.sqrt(float(squares[mask].sum()) / max(float(entries[mask].sum()), 1.0))

    return BaselineResidual(
        rms(signals.moving),
        {hz: rms(mask & signals.moving) for hz, mask in grid.items()},
        {name: rms((phase == k) & signals.moving) for k, name in enumerate(PHASES)},
    )


def _nominal_parameters() -> dict[str, float]:
    """Return the parameters of the start model in SI."""
    parameters: dict[str, float] = parse_toml(MODEL_TOML, ModelConfig, "snm.toml").base.model_dump()
    return parameters


def _fit_residual(columns: Float2D, force: Float1D, mask: Bool2D) -> Float1D:
    """Return the residual (sample,) of a least-squares fit on `mask`, zero elsewhere."""
    weights = np.linalg.lstsq(columns[:, mask].T, force[mask], rcond=None)[0]
    residual: Float1D = np.where(mask, force - weights @ columns, 0.0)
    return residual


def _fuse_motion(
    signals: StudySignals, noise: Mapping[str, float]
) -> tuple[Float1D, Float1D, float, float, list[Float1D]]:
    """Fuse laser and accelerometer: return u, u', their noise, and the disagreements over noise."""
    count, rate = signals.step.size, PROFILE.acquisition.rate_hz
    w = 2 * np.pi * rfftfreq(count, 1.0 / rate)
    inside = w <= 2 * np.pi * BANDWIDTH_HZ
    u = np.zeros(w.size, dtype=np.complex128)
    variance, disagreements = np.zeros(w.size), []
    for sign, displacement, acceleration in (
        (1.0, *SIGNAL_CHANNELS[2:4]),
        (-1.0, *SIGNAL_CHANNELS[:2]),
    ):
        s_x, s_a = noise[displacement], noise[acceleration]
        total_variance = s_a**2 + w**4 * s_x**2
        x, a = rfft(signals.channels[displacement]), rfft(signals.channels[acceleration])
        u += sign * (s_a**2 * x - w**2 * s_x**2 * a) / total_variance
        variance += (s_a * s_x) ** 2 / total_variance
        disagreements.append(irfft((a + w**2 * x) / np.sqrt(total_variance) * inside, count))
    band_factor = math.sqrt(float(np.mean(inside)))
    share = inside / w.size
    s_u = math.sqrt(float(np.sum(variance * share)))
    s_v = math.sqrt(float(np.sum(w**2 * variance * share)))
    return (
        irfft(u * inside, count), irfft(1j * w * u * inside, count), s_u, s_v,
        [disagreement / band_factor for disagreement in disagreements],
    )  # fmt: skip
