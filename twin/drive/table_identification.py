"""Identification of the table's twin from a rehearsal: command, table motion, specimen force.

The simulation of `table_model.py` is fitted to the measured table by least squares over the
frequencies of the rehearsal (output error): the displacement below CROSSOVER_HZ, where an
accelerometer says little, the acceleration above, both as acceleration.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import optimize, stats

from table_io.block import Float1D
from table_io.errors import InputError
from twin.drive.table_model import TableModel, TableParameters

CROSSOVER_HZ = 1.5  # below: displacement; above: acceleration
LOWEST_HZ, HIGHEST_HZ = 0.2, 45.0  # of the fit
MIN_DURATION_S = 10.0
CONFIDENCE_LEVEL = 0.95  # of the intervals
# Starting value, smallest and largest value of each parameter that is fitted.
BOUNDS: dict[str, tuple[float, float, float]] = {
    "gain_1_s": (20.0, 1.0, 200.0),
    "velocity_feedforward": (0.3, 0.0, 1.5),
    "delay_s": (0.006, 0.001, 0.15),  # with that of the valve
    "valve_hz": (80.0, 30.0, 200.0),
    "oil_hz": (30.0, 6.0, 150.0),
    "oil_damping": (0.1, 0.001, 1.0),
    "pressure_feedback_s": (0.002, 0.0, 0.1),
    "friction_n": (0.01, 0.0, 0.5),  # over the weight of the table
    "static_excess_n": (0.003, 0.0, 0.3),  # likewise
    "presliding_m": (2e-5, 1e-6, 5e-4),
    "stribeck_speed_m_s": (0.01, 0.004, 0.025),
    "stick_damping_n_s_m": (5.0, 0.0, 100.0),  # likewise
    "viscous_n_s_m": (0.1, 0.0, 20.0),  # over the mass of the table, 1/s
    "frame_hz": (15.0, 4.0, 60.0),
    "frame_damping": (0.08, 0.005, 1.0),
    "frame_ratio": (0.02, 0.0, 1.0),
}
STARTING_GAINS_1_S = 8.0, 20.0, 50.0


@dataclass(frozen=True, eq=False)
class TableRehearsal:
    """Rehearsal: command and table in SI, (sample,) each, from rest; reaction of the specimen."""

    rate_hz: float
    command_m: Float1D
    displacement_m: Float1D
    acceleration_m_s2: Float1D
    reaction_n: Float1D


@dataclass(frozen=True)
class TableIdentification:
    """Twin of a table, half widths of the 95 % intervals by parameter, and what it leaves.

    `residual` is the rms of what the twin leaves over the rms of the measured motion.
    """

    model: TableModel
    half_widths: dict[str, float]
    residual: float


def identify_table(
    motion: TableRehearsal, mass_kg: float, stall_force_n: float = math.inf
) -> TableIdentification:
    """Fit the table's twin to a rehearsal; InputError if that is too short or shows no motion."""
    count = motion.command_m.size
    if count < MIN_DURATION_S * motion.rate_hz or not motion.command_m.any():
        raise InputError(
            f"the rehearsal has {count / motion.rate_hz:.0f} s of motion",
            allowed=f"at least {MIN_DURATION_S:g} s",
        )
    frequency_hz = np.fft.rfftfreq(count, 1.0 / motion.rate_hz)
    used = (frequency_hz >= LOWEST_HZ) & (frequency_hz <= HIGHEST_HZ)
    slow = frequency_hz[used] < CROSSOVER_HZ
    square = (math.tau * frequency_hz[used]) ** 2
    weights = _weigh_frequencies(motion, used)

    def spectrum(displacement: Float1D, acceleration: Float1D) -> Float1D:
        by_displacement = -square * np.fft.rfft(displacement)[used]
        by_acceleration = np.fft.rfft(acceleration)[used]
        values = np.where(slow, by_displacement, by_acceleration) * weights
        return np.concatenate([values.real, values.imag])

    measured = spectrum(motion.displacement_m, motion.acceleration_m_s2)
    scale = float(np.linalg.norm(measured))

    def build(values: Float1D) -> TableModel:
        return _build_model(values, mass_kg, stall_force_n)

    def residuals(values: Float1D) -> Float1D:
        out = build(values).simulate(motion.command_m, motion.rate_hz, motion.reaction_n)
        if not np.isfinite(out).all():
            return np.full(measured.size, 10.0)
        return (spectrum(out[0], out[1]) - measured) / scale

    start, low, high = (np.array(column) for column in zip(*BOUNDS.values(), strict=True))
    typical = np.where(start > 0.0, start, 1.0)
    starts = []
    for gain in STARTING_GAINS_1_S:
        trial = start.copy()
        trial[0] = gain
        starts.append(trial)
    first = min(starts, key=lambda trial: float(np.linalg.norm(residuals(trial))))
    fit = optimize.least_squares(
        residuals, first, bounds=(low, high), x_scale=typical, diff_step=1e-3, max_nfev=60,
        loss="linear", xtol=1e-6, ftol=1e-7,
    )  # fmt: skip
    scaled = fit.jac * typical  # parameters of one size, so that the inverse is well conditioned
    covariance = np.linalg.pinv(scaled.T @ scaled) * 2.0 * fit.cost / max(measured.size - 1, 1)
    deviation = typical * np.sqrt(np.clip(np.diag(covariance), 0.0, None))
    half = stats.norm.ppf(0.5 + 0.5 * CONFIDENCE_LEVEL) * deviation
    units = _to_si(np.ones(half.size), mass_kg)
    names = list(BOUNDS)
    return TableIdentification(
        build(fit.x),
        {name: float(width * unit) for name, width, unit in zip(names, half, units, strict=True)},
        math.sqrt(2.0 * fit.cost),
    )


def _weigh_frequencies(motion: TableRehearsal, used: npt.NDArray[np.bool_]) -> Float1D:
    """Return the weight of each frequency: less where the motion is large, so that all count."""
    spectrum = np.abs(np.fft.rfft(motion.acceleration_m_s2)[used])
    width = max(int(2.0 * motion.command_m.size / motion.rate_hz), 1)  # 2 Hz
    smooth = np.convolve(spectrum, np.ones(width) / width, mode="same")
    weights: Float1D = 1.0 / np.maximum(smooth, 0.05 * smooth.max())
    return weights


def _to_si(values: Float1D, mass_kg: float) -> Float1D:
    """Return fitted values in SI: friction over weight, viscous friction over mass."""
    factors = {
        "friction_n": 9.81 * mass_kg,
        "static_excess_n": 9.81 * mass_kg,
        "stick_damping_n_s_m": mass_kg,
        "viscous_n_s_m": mass_kg,
    }
    return values * np.array([factors.get(name, 1.0) for name in BOUNDS])


def _build_model(values: Float1D, mass_kg: float, stall_force_n: float) -> TableModel:
    fitted = dict(zip(BOUNDS, map(float, _to_si(values, mass_kg)), strict=True))
    damping = TableParameters().valve_damping
    valve_lag_s = 2.0 * damping / (math.tau * fitted["valve_hz"])
    fitted["delay_s"] = max(fitted["delay_s"] - valve_lag_s, 0.0)
    return TableModel(mass_kg, TableParameters(**fitted, stall_force_n=stall_force_n))
