"""Identification of the table's twin from a rehearsal: command, table motion, specimen force.

The simulation of `table_model.py` is fitted to the measured table by least squares over the
frequencies of the rehearsal (output error): the displacement below CROSSOVER_HZ, where an
accelerometer says little, the acceleration above, both as acceleration.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from itertools import product
from types import MappingProxyType

import numpy as np
import numpy.typing as npt
from scipy import optimize, stats

from table_io.block import Float1D, Float2D, Int1D
from table_io.errors import InputError
from twin.earthquakes.table_model import MAX_STEP_S, TableModel, TableParameters
from twin.earthquakes.table_response import CROSSOVER_HZ
from twin.system.process_pool import map_in_threads

LOWEST_HZ, HIGHEST_HZ = 0.2, 45.0  # of the fit
MIN_DURATION_S = 10.0
CONFIDENCE_LEVEL = 0.95  # of the intervals
RESIDUAL_RATE_RATIO = 2.2  # of the residuals over the highest frequency
MAX_WORSE_RATIO = 1.02  # of held-out errors: a simpler twin is not worse up to this
WHITENING_HZ = 2.0  # over which the power of the residuals is smoothed
WHITENING_FLOOR = 0.01  # of its largest value: less is not weighted up further
BLOCK_S, MIN_BLOCKS = 2.5, 8  # of time that is left out together
DIFFERENCE_STEP = 2e-3  # of a parameter, or of its typical value if that is larger
# Starting value, smallest and largest value of each parameter that is fitted.
BOUNDS: dict[str, tuple[float, float, float]] = {
    "gain_1_s": (20.0, 1.0, 200.0),
    "velocity_feedforward": (0.3, 0.0, 1.5),
    "delay_s": (0.006, 0.001, 0.15),  # with that of the valve
    "valve_hz": (80.0, 30.0, 200.0),
    "valve_damping": (0.8, 0.4, 1.4),
    "oil_hz": (30.0, 6.0, 150.0),
    "oil_damping": (0.1, 0.001, 1.0),
    "pressure_feedback_s": (0.002, 0.0, 0.1),
    "friction_n": (0.01, 0.0, 0.5),  # over the weight of the table
    "static_excess_n": (0.003, 0.0, 0.3),  # likewise
    "presliding_m": (2e-5, 1e-6, 5e-4),
    "stribeck_speed_m_s": (0.01, 0.004, 0.025),
    "friction_memory": (0.8, 0.0, 3.0),
    "stick_damping_n_s_m": (5.0, 0.0, 100.0),  # likewise
    "viscous_n_s_m": (0.1, 0.0, 20.0),  # over the mass of the table, 1/s
    "frame_hz": (15.0, 4.0, 60.0),
    "frame_damping": (0.08, 0.005, 1.0),
    "frame_ratio": (0.02, 0.0, 1.0),
}
# Values from which the fit may begin, in all combinations.
STARTING_VALUES: dict[str, tuple[float, ...]] = {
    "gain_1_s": (8.0, 20.0, 50.0),
    "oil_hz": (12.0, 18.0, 26.0, 38.0, 60.0),
    "friction_n": (0.01, 0.03, 0.08),  # over the weight of the table
    "pressure_feedback_s": (0.001, 0.004),
}
FRAME_NAMES = "frame_hz", "frame_damping", "frame_ratio"
STARTING_FRAMES_HZ = 5.0, 40.0, 24  # first, last, number
MAX_FRAMES = 2  # a mode of the oil column may look like a frame
ROUGH_EVALUATIONS = 6  # of the fits that only lead to a start
ROUGH_SHARE = 0.3  # of the energy of the motion, on which those fits look: up to that moment
ROUGH_STEP_S = 5e-4  # of the integrator in those fits, whose values are only a start
VALVE_DAMPING = 0.8, 0.2  # mean and standard deviation before the rehearsal: data sheets
NO_BLOCK = -1
LENGTH_STEP = 100  # samples, of which a rehearsal is a multiple


@dataclass(frozen=True, eq=False)
class TableRehearsal:
    """Rehearsal: command and table in SI, (sample,) each, from rest; reaction of the specimen.

    Without an accelerometer the acceleration is that of the displacement, below HIGHEST_HZ.
    """

    rate_hz: float
    command_m: Float1D
    displacement_m: Float1D
    acceleration_m_s2: Float1D
    reaction_n: Float1D
    has_accelerometer: bool = True

    def cut(self, count: int) -> "TableRehearsal":
        """Return the first samples."""
        rows = {
            row.name: getattr(self, row.name)[:count]
            for row in fields(self)
            if isinstance(getattr(self, row.name), np.ndarray)
        }
        return replace(self, **rows)


@dataclass(frozen=True)
class TableIdentification:
    """Twin of a table, half widths of the 95 % intervals by parameter, and what it leaves.

    `residual` is the rms of what the twin leaves over the rms of the measured motion.
    """

    model: TableModel
    half_widths: dict[str, float]
    residual: float


@dataclass(frozen=True, eq=False)
class RehearsalProblem:
    """Regression of a table's twin on a rehearsal: weighted residuals and their blocks of time.

    The residuals are the weighted spectrum of simulation less measurement, back in the time domain
    at RESIDUAL_RATE_RATIO times the highest frequency of the fit: their squares sum up to 1 for a
    table that does not move, and each belongs to a block of about BLOCK_S. The last one, of no
    block, is what is known beforehand, the damping of a valve: its departure from VALVE_DAMPING in
    standard deviations, times `noise`, the size of the other residuals.
    """

    motion: TableRehearsal
    mass_kg: float
    stall_force_n: float
    used: npt.NDArray[np.bool_]
    weights: Float1D  # (frequency used,)
    measured: npt.NDArray[np.complex128]  # (frequency used,), weighted
    block: Int1D  # of each residual, (residual,); NO_BLOCK for the last one
    noise: float
    max_step_s: float = MAX_STEP_S  # of the integrator

    @classmethod
    def from_rehearsal(
        cls, motion: TableRehearsal, mass_kg: float, stall_force_n: float = math.inf
    ) -> "RehearsalProblem":
        """Return the problem; InputError if the rehearsal is too short or shows no motion."""
        count = motion.command_m.size
        if count < MIN_DURATION_S * motion.rate_hz or not motion.command_m.any():
            raise InputError(
                f"the rehearsal has {count / motion.rate_hz:.0f} s of motion",
                allowed=f"at least {MIN_DURATION_S:g} s",
            )
        # A length that is quick to transform; the table rests at the end.
        count -= count % LENGTH_STEP
        motion = motion.cut(count)
        frequency_hz = np.asarray(np.fft.rfftfreq(count, 1.0 / motion.rate_hz), np.float64)
        used = (frequency_hz >= LOWEST_HZ) & (frequency_hz <= HIGHEST_HZ)
        weights = _weigh_frequencies(motion, used)
        measured = _transform_motion(
            motion.displacement_m, motion.acceleration_m_s2, frequency_hz[used], used
        )
        size = 2 * math.ceil(0.5 * RESIDUAL_RATE_RATIO * HIGHEST_HZ * count / motion.rate_hz)
        blocks = max(round(count / motion.rate_hz / BLOCK_S), MIN_BLOCKS)
        block = (np.arange(size) * blocks) // size
        scale = float(np.linalg.norm(measured * weights))
        weights /= scale
        block = np.append(block, NO_BLOCK)
        return cls(
            motion,
            mass_kg,
            stall_force_n,
            used,
            weights,
            measured * weights,
            block,
            0.1 / size**0.5,
        )

    def cut_beginning(self) -> "RehearsalProblem":
        """Return the problem of the beginning of the rehearsal, which is quicker to fit."""
        energy = np.cumsum(self.motion.acceleration_m_s2**2)
        count = int(np.searchsorted(energy, ROUGH_SHARE * energy[-1])) + LENGTH_STEP
        count = max(count, math.ceil(MIN_DURATION_S * self.motion.rate_hz) + LENGTH_STEP)
        beginning = self.from_rehearsal(self.motion.cut(count), self.mass_kg, self.stall_force_n)
        return replace(beginning, max_step_s=ROUGH_STEP_S)

    def compute_residuals(self, parameters: TableParameters) -> Float1D:
        """Return the residuals of a twin of the table, (residual,)."""
        motion = self.motion
        model = TableModel(self.mass_kg, parameters)
        out = model.simulate(motion.command_m, motion.rate_hz, motion.reaction_n, self.max_step_s)
        if not np.isfinite(out).all():
            return np.full(self.block.size, 10.0)
        all_hz = np.fft.rfftfreq(motion.command_m.size, 1.0 / motion.rate_hz)
        frequency_hz = np.asarray(all_hz[self.used], np.float64)
        values = _transform_motion(out[0], out[1], frequency_hz, self.used) * self.weights
        size = self.block.size - 1
        spectrum = np.zeros(size // 2 + 1, complex)
        first = int(np.flatnonzero(self.used)[0])
        spectrum[first : first + values.size] = values - self.measured
        # Parseval: the squares of the residuals sum up to those of the spectrum.
        residuals = np.fft.irfft(spectrum, size) * math.sqrt(0.5 * size)
        mean, deviation = VALVE_DAMPING
        return np.append(residuals, self.noise * (parameters.valve_damping - mean) / deviation)

    def measure_misfit(self, scaled_values: Mapping[str, float]) -> float:
        """Return the rms of the residuals over that of the motion, for scaled values by name."""
        values = np.array(list(scaled_values.values()))
        return float(
            np.linalg.norm(
                self.compute_residuals(build_parameters(tuple(scaled_values), values, self))
            )
        )

    def whiten(self, fit: "TableFit") -> "RehearsalProblem":
        """Return the problem with weights by which what a fit leaves of it is white.

        Then its residuals are independent, as if they were noise of one size.
        """
        power = np.abs(np.fft.rfft(fit.residuals[:-1])) ** 2
        first, count = int(np.flatnonzero(self.used)[0]), int(self.used.sum())
        seconds = self.motion.command_m.size / self.motion.rate_hz
        width = min(max(round(WHITENING_HZ * seconds), 1), count)
        around = np.ones(width)
        smooth = np.convolve(power[first : first + count], around, mode="same")
        smooth /= np.convolve(np.ones(count), around, mode="same")
        factor = np.maximum(smooth, WHITENING_FLOOR * smooth.max()) ** -0.5
        factor /= float(np.linalg.norm(self.measured * factor) / np.linalg.norm(self.measured))
        whitened = replace(self, weights=self.weights * factor, measured=self.measured * factor)
        return whitened.with_noise_of(fit)

    def with_noise_of(self, fit: "TableFit") -> "RehearsalProblem":
        """Return the problem with the size of the residuals that a fit leaves."""
        return replace(self, noise=math.sqrt(fit.cost / (self.block.size - 1)))


@dataclass(frozen=True, eq=False)
class TableFit:
    """Least-squares fit of a twin: scaled values of the free parameters, residuals and slopes.

    `jacobian`, (residual, parameter), is that of the residuals over the scaled values; parameters
    at a bound are marked in `is_free`, (parameter,).
    """

    problem: RehearsalProblem
    names: tuple[str, ...]
    values: Float1D
    residuals: Float1D
    jacobian: Float2D
    is_free: npt.NDArray[np.bool_]

    @property
    def parameters(self) -> TableParameters:
        return build_parameters(self.names, self.values, self.problem)

    @property
    def scaled_values(self) -> dict[str, float]:
        return dict(zip(self.names, map(float, self.values), strict=True))

    @property
    def cost(self) -> float:
        """Sum of the squares of the residuals: 1 for a table that does not move."""
        return float(self.residuals[:-1] @ self.residuals[:-1])

    def estimate_half_widths(self) -> dict[str, float]:
        """Return the half widths of the 95 % intervals, SI, by parameter: jackknife over blocks.

        Each block of time is left out in turn (one Gauss-Newton step each): errors of the model are
        correlated within a block, so samples are not counted one by one.
        """
        count = int(self.problem.block.max()) + 1
        estimates = np.zeros((count, self.values.size))
        for block in range(count):
            estimates[block] = self.step_without(self.problem.block == block, all_free=True)
        spread = np.sqrt((count - 1) / count * ((estimates - estimates.mean(axis=0)) ** 2).sum(0))
        half = stats.t.ppf(0.5 + 0.5 * CONFIDENCE_LEVEL, count - 1) * spread
        units = _to_si(self.names, np.ones(half.size), self.problem.mass_kg)
        return dict(zip(self.names, map(float, half * units), strict=True))

    def to_identification(self) -> TableIdentification:
        """Return the twin with its intervals."""
        return TableIdentification(
            TableModel(self.problem.mass_kg, self.parameters),
            self.estimate_half_widths(),
            math.sqrt(self.cost),
        )

    def step_without(self, is_left_out: npt.NDArray[np.bool_], all_free: bool = False) -> Float1D:
        """Return the change of the scaled values, (parameter,), if residuals are left out.

        Parameters at a bound stay, unless all are free: then the change has no bounds.
        """
        step = np.zeros(self.values.size)
        is_free = np.ones(step.size, bool) if all_free else self.is_free
        slopes = self.jacobian[~is_left_out][:, is_free]
        size = np.sqrt((slopes**2).sum(axis=0)) + 1e-30
        solution = np.linalg.lstsq(slopes / size, -self.residuals[~is_left_out], rcond=1e-8)[0]
        step[is_free] = solution / size
        return step


def fit_basic_twin(
    problem: RehearsalProblem,
    effect_bounds: Mapping[str, tuple[float, float, float]] = MappingProxyType({}),
    trials: Sequence[Mapping[str, float]] = (MappingProxyType({}),),
) -> TableFit:
    """Fit the twin from nothing, without further effects or with those whose bounds are given.

    First on the beginning of the rehearsal without a frame, whose resonance is narrow; then from
    the MAX_FRAMES frequencies of the frame at which the misfit has its lowest minima. `trials` are
    starting values of the parameters of the effects.
    """
    bounds = {**BOUNDS, **effect_bounds}
    start = {name: values[0] for name, values in bounds.items()}
    frameless_bounds = dict(bounds)
    for name in FRAME_NAMES:
        del frameless_bounds[name]
    starts = [
        start | dict(zip(STARTING_VALUES, values, strict=True)) | {"frame_ratio": 0.0} | dict(trial)
        for values in product(*STARTING_VALUES.values())
        for trial in trials
    ]
    beginning = problem.cut_beginning()
    first = starts[int(np.argmin(map_in_threads(beginning.measure_misfit, starts)))]
    frameless = fit_table(
        beginning,
        frameless_bounds,
        {name: first[name] for name in frameless_bounds},
        ROUGH_EVALUATIONS,
        1e-2,
    )
    start |= frameless.scaled_values
    frames = [start | {"frame_hz": float(hz)} for hz in np.geomspace(*STARTING_FRAMES_HZ)]
    misfits = np.array(map_in_threads(beginning.measure_misfit, frames))
    padded = np.pad(misfits, 1, constant_values=math.inf)
    is_minimum = (misfits <= padded[:-2]) & (misfits <= padded[2:])
    count = min(MAX_FRAMES, int(is_minimum.sum()))
    lowest = np.argsort(np.where(is_minimum, misfits, math.inf))[:count].tolist()
    fits = [fit_table(beginning, bounds, frames[k], ROUGH_EVALUATIONS, 1e-2) for k in lowest]
    rough = min(fits, key=lambda fit: fit.cost)
    near = fit_table(problem, bounds, rough.scaled_values, tolerance=1e-3)
    return fit_table(problem.with_noise_of(near), bounds, near.scaled_values)


def fit_table(
    problem: RehearsalProblem,
    bounds: Mapping[str, tuple[float, float, float]],
    start: Mapping[str, float],
    max_evaluations: int = 20,
    tolerance: float = 1e-4,
) -> TableFit:
    """Fit free parameters, each with a typical, smallest and largest value, from a start.

    It ends when the squares fall by less than the relative `tolerance`.
    """
    names = tuple(bounds)
    typical, low, high = (np.array(column) for column in zip(*bounds.values(), strict=True))

    def simulate(values: Float1D) -> Float1D:
        return problem.compute_residuals(build_parameters(names, values, problem))

    @lru_cache(maxsize=2)  # a Jacobian begins at the values of the last step
    def simulate_once(values: bytes) -> Float1D:
        return simulate(np.frombuffer(values))

    def residuals(values: Float1D) -> Float1D:
        return simulate_once(values.tobytes())

    def slopes(values: Float1D) -> Float2D:
        """Return the Jacobian by differences whose steps do not vanish with a parameter."""
        trials = np.tile(values, (values.size, 1))
        for index, size in enumerate(np.maximum(np.abs(values), typical)):
            step = DIFFERENCE_STEP * size
            trials[index, index] += -step if values[index] + step > high[index] else step
        before = residuals(values)
        jacobian = np.empty((problem.block.size, values.size))
        for index, changed in enumerate(map_in_threads(simulate, list(trials))):
            jacobian[:, index] = (changed - before) / (trials[index, index] - values[index])
        return jacobian

    values = np.clip([start[name] for name in names], low, high)
    fit = optimize.least_squares(
        residuals, values, slopes, bounds=(low, high), x_scale="jac", max_nfev=max_evaluations,
        xtol=1e-6, ftol=tolerance,
    )  # fmt: skip
    margin = 1e-3 * typical
    is_free = (fit.x > low + margin) & (fit.x < high - margin)
    return TableFit(problem, names, fit.x, fit.fun, fit.jac, is_free)


def _transform_motion(
    displacement_m: Float1D,
    acceleration_m_s2: Float1D,
    frequency_hz: Float1D,
    used: npt.NDArray[np.bool_],
) -> npt.NDArray[np.complex128]:
    """Return the spectrum of the acceleration, below CROSSOVER_HZ by the displacement."""
    by_displacement = -((math.tau * frequency_hz) ** 2) * np.fft.rfft(displacement_m)[used]
    by_acceleration = np.fft.rfft(acceleration_m_s2)[used]
    spectrum: npt.NDArray[np.complex128] = np.where(
        frequency_hz < CROSSOVER_HZ, by_displacement, by_acceleration
    )
    return spectrum


def _weigh_frequencies(motion: TableRehearsal, used: npt.NDArray[np.bool_]) -> Float1D:
    """Return the weight of each frequency: less where the motion is large, so that all count."""
    spectrum = np.abs(np.fft.rfft(motion.acceleration_m_s2)[used])
    width = max(int(2.0 * motion.command_m.size / motion.rate_hz), 1)  # 2 Hz
    smooth = np.convolve(spectrum, np.ones(width) / width, mode="same")
    weights: Float1D = 1.0 / np.maximum(smooth, 0.05 * smooth.max())
    return weights


def _to_si(names: Sequence[str], values: Float1D, mass_kg: float) -> Float1D:
    """Return fitted values in SI: friction over weight, viscous friction over mass."""
    factors = {
        "friction_n": 9.81 * mass_kg,
        "static_excess_n": 9.81 * mass_kg,
        "stick_damping_n_s_m": mass_kg,
        "viscous_n_s_m": mass_kg,
    }
    return values * np.array([factors.get(name, 1.0) for name in names])


def build_parameters(
    names: Sequence[str], values: Float1D, problem: RehearsalProblem
) -> TableParameters:
    """Return the parameters of a twin from the scaled values of some of them."""
    fitted = dict(zip(names, map(float, _to_si(names, values, problem.mass_kg)), strict=True))
    valve_lag_s = 2.0 * fitted["valve_damping"] / (math.tau * fitted["valve_hz"])
    fitted["delay_s"] = max(fitted["delay_s"] - valve_lag_s, 0.0)
    return TableParameters(**fitted, stall_force_n=problem.stall_force_n)
