"""Response of a table to its command: delay, frequency response, friction and a resonance.

    a(t) = a_c(t - T) + sum_k [ sum_l c_kl x_k(t - T - t_l) + (p_k w + s_k d/dt) w q_k(t - T) ]
    q_k'' + 2 z w q_k' + w^2 q_k = x_k

a is the table's acceleration in the band of the twin, a_c that of the command, both in m/s2; beyond
it the table is its late command. The inputs x_k are a_c itself and functions of the
commanded speed, which stand for friction: TERMS. Each moves the table through its own smooth
response c_kl and, where one is found, through a resonance w with damping z, for instance of a
specimen that reacts on the table. The command is known ahead, so some lags t_l are negative. Force
balance and oil column are not resolved: what stands on the table is part of the response, and a
twin of it holds for that specimen.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.fft import next_fast_len

from table_io.block import Float1D, Float2D, Int1D
from table_io.config.excitation.waveform import smoothstep
from twin.earthquakes.table_model import TableModel

Complex1D = npt.NDArray[np.complex128]
Complex2D = npt.NDArray[np.complex128]
SPEED_CORNER_HZ = 30.0  # of the low-pass of the commanded speed, which carries the log's noise
PADDING_S = 30.0  # after the motion, in which a resonance decays
FIRST_LAG_S, LAST_LAG_S = -0.03, 0.12  # of the smooth response
LAGS_PER_PERIOD = 6.5  # of the highest frequency of the band
ROWS_PER_PERIOD = 2.2  # samples in which a band-limited signal is kept, per highest period
MAX_DELAY_S, DELAY_STEP_S = 0.15, 2.5e-4
MIN_DELAY_S = -0.02  # a command may be logged late
RIDGE_SHARE = 1e-3  # of the regression, relative to the size of each column
WEIGHT_WIDTH_HZ = 0.5  # of the smoothing of what a delay leaves, whose inverse is the weight
WEIGHT_FLOOR = 0.1  # of the largest power that a delay leaves: less is not weighted up further
RESONANCE_DAMPINGS = 0.003, 0.005, 0.01, 0.03
RESONANCE_SHIFTS = -0.008, -0.004, -0.002, 0.0, 0.002, 0.004, 0.008  # relative, round the peak

# Inputs by name, from commanded speed in m/s and acceleration in m/s2. Friction reverses with the
# speed; that of seals and bearings still changes at some cm/s.
TERMS: dict[str, Callable[[Float1D, Float1D], Float1D]] = {
    "command": lambda speed, acceleration: acceleration,
    "friction_2_mm_s": lambda speed, acceleration: np.tanh(speed / 2e-3),
    "friction_20_mm_s": lambda speed, acceleration: np.tanh(speed / 2e-2),
}
FRICTION_TERMS = tuple(TERMS)
ESTIMATED_FRICTION = tuple(f"estimated_{name}" for name in FRICTION_TERMS[1:])
CROSSOVER_HZ = 1.5  # below: displacement; above: acceleration


@dataclass(frozen=True)
class ResponseStructure:
    """Row of the table of structures: inputs, whether they have lags, whether a resonance."""

    id: str
    description: str
    terms: tuple[str, ...] = ()
    has_lags: bool = True
    has_resonance: bool = False
    first_lag_s: float = FIRST_LAG_S


# From the simplest to the richest; the first three are the baselines of a judgement.
STRUCTURES = (
    ResponseStructure("pure_delay", "delay"),
    ResponseStructure("delay_gain", "delay and gain", ("command",), has_lags=False),
    ResponseStructure("frf", "smooth frequency response", ("command",)),
    ResponseStructure(
        "frf_resonance", "frequency response with a resonance", ("command",), has_resonance=True
    ),
    ResponseStructure("friction", "frequency response and friction", FRICTION_TERMS),
    ResponseStructure(
        "friction_resonance",
        "frequency response, friction and a resonance that it excites",
        FRICTION_TERMS,
        has_resonance=True,
    ),
)
STRUCTURE_BY_ID = {structure.id: structure for structure in STRUCTURES}


@dataclass(frozen=True)
class Resonance:
    """A resonance of the table with what stands on it: frequency in Hz and damping ratio."""

    hz: float
    damping: float

    def respond(self, frequency_hz: Float1D) -> Complex2D:
        """Return w^2 q and w q' over the input, (2, frequency)."""
        ratio = frequency_hz / self.hz
        displacement = 1.0 / (1.0 - ratio**2 + 2j * self.damping * ratio)
        return np.array([displacement, 1j * ratio * displacement])


@dataclass(frozen=True, eq=False)
class ResponseModel:
    """Table that follows its late command but for a correction of the acceleration in `band_hz`.

    `coefficients` holds for each term those of the lags `lags_s`, then the two of the resonance.
    """

    structure: str
    delay_s: float
    band_hz: tuple[float, float]
    lags_s: tuple[float, ...] = ()
    coefficients: Mapping[str, Sequence[float]] | None = None
    resonance: Resonance | None = None

    def simulate(
        self, command_m: Float1D, rate_hz: float, reaction_n: Float1D | None = None
    ) -> Float2D:
        """Return table displacement in m and acceleration in m/s2, (2, sample), from rest.

        `command_m` is (sample,). The specimen is part of the response: `reaction_n` is not used.
        """
        extended = extend_motion(command_m, rate_hz)
        frequency_hz = np.asarray(np.fft.rfftfreq(extended.size, 1.0 / rate_hz), np.float64)
        w = math.tau * frequency_hz
        late = np.exp(-1j * w * self.delay_s)
        correction: Complex1D = np.zeros(frequency_hz.size, np.complex128)
        for name, spectrum in compute_terms(extended, rate_hz, self.coefficients or ()).items():
            correction += spectrum * self._respond(name, frequency_hz)
        displacement = np.fft.rfft(extended) * late
        acceleration = correction * late - w**2 * displacement
        displacement -= correction * late / np.where(w > 0.0, w, 1.0) ** 2
        return np.array(
            [
                np.fft.irfft(row, extended.size)[: command_m.size]
                for row in (displacement, acceleration)
            ]
        )

    def frequency_response(self, frequency_hz: Float1D) -> Complex1D:
        """Return table displacement over command without friction, (frequency,), complex."""
        linear = np.ones(frequency_hz.size, complex)
        if self.coefficients is not None:
            linear += self._respond("command", np.asarray(frequency_hz, np.float64))
        response: Complex1D = linear * np.exp(-2j * math.pi * frequency_hz * self.delay_s)
        return response

    def _respond(self, name: str, frequency_hz: Float1D) -> Complex1D:
        """Return the correction over one input, (frequency,); 0 outside of the band."""
        assert self.coefficients is not None
        inside = (frequency_hz >= self.band_hz[0]) & (frequency_hz <= self.band_hz[1])
        columns = _list_columns(frequency_hz[inside], self.lags_s, self.resonance)
        response = np.zeros(frequency_hz.size, complex)
        response[inside] = np.asarray(self.coefficients[name]) @ columns
        return response


PredictiveModel = TableModel | ResponseModel  # of a table, from its command


def _list_columns(
    frequency_hz: Float1D, lags_s: Sequence[float], resonance: Resonance | None
) -> Complex2D:
    """Return the responses whose sum a term passes through, (lag and resonance, frequency)."""
    columns = np.exp(-2j * math.pi * np.outer(lags_s, frequency_hz))
    return columns if resonance is None else np.vstack([columns, resonance.respond(frequency_hz)])


def extend_motion(motion: Float1D, rate_hz: float) -> Float1D:
    """Return a motion that goes back to its start in at least PADDING_S after its end."""
    size = next_fast_len(motion.size + math.ceil(PADDING_S * rate_hz))
    back = smoothstep(np.arange(1, size - motion.size + 1) / (size - motion.size + 1))
    return np.concatenate([motion, motion[-1] + (motion[0] - motion[-1]) * back])


def compute_terms(
    command_m: Float1D, rate_hz: float, names: Sequence[str] | Mapping[str, object]
) -> dict[str, Complex1D]:
    """Return the spectra of inputs by name, (frequency,) each, of an extended command in m."""
    w = math.tau * np.fft.rfftfreq(command_m.size, 1.0 / rate_hz)
    low_pass = np.exp(-((w / (math.tau * SPEED_CORNER_HZ)) ** 4))
    spectrum = np.fft.rfft(command_m) * low_pass * 1j * w
    speed = np.fft.irfft(spectrum, command_m.size)
    acceleration = np.fft.irfft(spectrum * 1j * w, command_m.size)
    return {name: np.fft.rfft(TERMS[name](speed, acceleration)) for name in names}


@dataclass(frozen=True, eq=False)
class BandProjection:
    """Band-limited signals of one log, kept in ROWS_PER_PERIOD samples per highest period."""

    count: int
    rate_hz: float
    band_hz: tuple[float, float]

    @cached_property
    def size(self) -> int:
        return next_fast_len(self.count + math.ceil(PADDING_S * self.rate_hz))

    @cached_property
    def used(self) -> npt.NDArray[np.bool_]:
        frequency_hz = np.fft.rfftfreq(self.size, 1.0 / self.rate_hz)
        return (frequency_hz >= self.band_hz[0]) & (frequency_hz <= self.band_hz[1])

    @cached_property
    def frequency_hz(self) -> Float1D:
        """Frequencies of the band in Hz, (frequency,)."""
        return np.asarray(np.fft.rfftfreq(self.size, 1.0 / self.rate_hz)[self.used], np.float64)

    def to_rows(self, spectrum: npt.NDArray[np.complex128]) -> npt.NDArray[np.float64]:
        """Return signals in time, (..., row), from their spectra in the band, (..., frequency)."""
        size = self._row_count
        whole = np.zeros((*spectrum.shape[:-1], size // 2 + 1), complex)
        first = int(np.flatnonzero(self.used)[0])
        whole[..., first : first + spectrum.shape[-1]] = spectrum
        rows = np.fft.irfft(whole, size) * size / self.size
        kept: npt.NDArray[np.float64] = rows[..., : round(size * self.count / self.size)]
        return kept

    @property
    def _row_count(self) -> int:
        """Rows of a log with its padding, even."""
        duration_s = self.size / self.rate_hz
        return 2 * math.ceil(0.5 * ROWS_PER_PERIOD * self.band_hz[1] * duration_s)

    def to_spectrum(self, rows: Float1D) -> Complex1D:
        """Return the spectrum in the band, (frequency,), of a signal that ends at rest, (row,)."""
        first, size = int(np.flatnonzero(self.used)[0]), self._row_count
        spectrum = np.fft.rfft(rows, size)[first : first + self.frequency_hz.size]
        scaled: Complex1D = spectrum * self.size / size
        return scaled

    def to_samples(self, spectrum: Complex1D) -> Float1D:
        """Return a signal, (sample,), from its spectrum in the band, (frequency,)."""
        whole = np.zeros(self.used.size, complex)
        whole[self.used] = spectrum
        signal: Float1D = np.fft.irfft(whole, self.size)[: self.count]
        return signal

    def differentiate(self, displacement_m: Float1D) -> Complex1D:
        """Return the spectrum of the acceleration of a displacement in m, (frequency,)."""
        spectrum = np.fft.rfft(extend_motion(displacement_m, self.rate_hz))[self.used]
        acceleration: Complex1D = -((math.tau * self.frequency_hz) ** 2) * spectrum
        return acceleration

    def transform_motion(
        self, displacement_m: Float1D, acceleration_m_s2: Float1D | None
    ) -> Complex1D:
        """Return the spectrum of the acceleration, (frequency,), of a motion, (sample,) each.

        Below CROSSOVER_HZ, or without an acceleration, it is that of the displacement.
        """
        spectrum = self.differentiate(displacement_m)
        if acceleration_m_s2 is not None:
            fast = self.frequency_hz >= CROSSOVER_HZ
            spectrum[fast] = np.fft.rfft(acceleration_m_s2, self.size)[self.used][fast]
        return spectrum


@dataclass(frozen=True, eq=False)
class ResponseData:
    """One log of a fit: command and measured acceleration in the band, and parts of its time.

    `part` of each row says which rows are left out together.
    """

    projection: BandProjection
    command_m: Float1D
    measured_spectrum: Complex1D  # of the acceleration in the band, (frequency,)
    part: Int1D  # (row,)
    channels: Mapping[str, Float1D] = field(
        default_factory=dict
    )  # further measured ones, (sample,) each

    @cached_property
    def measured_rows(self) -> Float1D:
        """Measured acceleration in the band in m/s2, (row,)."""
        return self.projection.to_rows(self.measured_spectrum)

    @cached_property
    def term_spectra(self) -> dict[str, Complex1D]:
        """Spectra of the inputs and further channels in the band, (frequency,) each."""
        projection = self.projection
        extended = extend_motion(self.command_m, projection.rate_hz)
        spectra = compute_terms(extended, projection.rate_hz, tuple(TERMS))
        for name, row in self.channels.items():
            spectra[name] = np.fft.rfft(row - row.mean(), projection.size)
        return {name: spectrum[projection.used] for name, spectrum in spectra.items()}

    @cached_property
    def command_spectrum(self) -> Complex1D:
        """Spectrum of the command's acceleration in the band, (frequency,)."""
        return self.projection.differentiate(self.command_m)

    def delay_command(self, delay_s: float) -> Float1D:
        """Return the acceleration of the late command in m/s2, (row,)."""
        late = np.exp(-2j * math.pi * self.projection.frequency_hz * delay_s)
        return self.projection.to_rows(self.command_spectrum * late)

    def add_estimated_friction(self, left: Float1D, delay_s: float) -> "ResponseData":
        """Return the log with the friction of its measured motion less `left`, (row,), as channels.

        Friction acts on the speed of the table, of which that of the command is a first guess.
        """
        projection = self.projection
        change = projection.to_spectrum(self.measured_rows - left - self.delay_command(delay_s))
        jw = 2j * math.pi * projection.frequency_hz
        moved_m = self.command_m + projection.to_samples(change * np.exp(jw * delay_s) / jw**2)
        extended = extend_motion(moved_m, projection.rate_hz)
        spectra = compute_terms(extended, projection.rate_hz, FRICTION_TERMS[1:])
        rows = (np.fft.irfft(row, extended.size)[: moved_m.size] for row in spectra.values())
        friction = dict(zip(ESTIMATED_FRICTION, rows, strict=True))
        return replace(self, channels={**self.channels, **friction})

    def compute_columns(
        self,
        terms: Sequence[str],
        delay_s: float,
        lags_s: Sequence[float],
        resonance: Resonance | None,
    ) -> Float2D:
        """Return the columns of the regression, (column, row)."""
        frequency_hz = self.projection.frequency_hz
        late = np.exp(-2j * math.pi * frequency_hz * delay_s)
        columns = _list_columns(frequency_hz, lags_s, resonance) * late
        spectra = [self.term_spectra[name] * columns for name in terms]
        return self.projection.to_rows(np.concatenate(spectra))

    def compute_weight(self, residual: Float1D) -> Float1D:
        """Return the weight of each frequency of the rows by the power of a residual, (row,)."""
        power = np.abs(np.fft.rfft(residual)) ** 2
        row_rate_hz = residual.size * self.projection.rate_hz / self.projection.count
        width = min(max(round(WEIGHT_WIDTH_HZ * residual.size / row_rate_hz), 1), power.size)
        smooth = np.convolve(power, np.ones(width) / width, mode="same")
        weight: Float1D = np.maximum(smooth, WEIGHT_FLOOR * smooth.max()) ** -0.5
        return weight


def find_delay(data: Sequence[ResponseData]) -> float:
    """Return the delay in s with which the command is nearest to the measured motion of all logs.

    Each log counts by the relative square of its error.
    """
    delays = np.arange(MIN_DELAY_S, MAX_DELAY_S, DELAY_STEP_S)
    gains = np.zeros(delays.size)
    for log in data:
        cross = np.conj(log.command_spectrum) * log.measured_spectrum
        turns = np.exp(2j * math.pi * np.outer(delays, log.projection.frequency_hz))
        gains += (turns @ cross).real / float(np.sum(np.abs(log.measured_spectrum) ** 2))
    return float(delays[int(np.argmax(gains))])


def list_lags(structure: ResponseStructure, band_hz: tuple[float, float]) -> tuple[float, ...]:
    """Return the lags of a structure in s, that resolve its band."""
    if not structure.terms or not structure.has_lags:
        return (0.0,)
    count = math.ceil((LAST_LAG_S - structure.first_lag_s) * LAGS_PER_PERIOD * band_hz[1])
    return tuple(np.linspace(structure.first_lag_s, LAST_LAG_S, count).tolist())


@dataclass(frozen=True, eq=False)
class ResponseRegression:
    """Regression of what the late command leaves on the inputs of one structure.

    `columns`, (column, row), and `residuals`, (row,), are those of each log; `grams` and `moments`
    their weighted normal equations by part: (part, column, column) and (part, column).
    """

    structure: ResponseStructure
    delay_s: float
    lags_s: tuple[float, ...]
    resonance: Resonance | None
    data: tuple[ResponseData, ...]
    columns: tuple[Float2D, ...]
    residuals: tuple[Float1D, ...]
    grams: npt.NDArray[np.float64]
    moments: Float2D

    @classmethod
    def from_data(
        cls,
        structure: ResponseStructure,
        data: Sequence[ResponseData],
        delay_s: float,
        resonance: Resonance | None = None,
    ) -> "ResponseRegression":
        """Return the regression of a structure on logs whose parts are numbered through."""
        lags_s = list_lags(structure, data[0].projection.band_hz)
        resonance = resonance if structure.has_resonance else None
        size = len(structure.terms) * (len(lags_s) + 2 * (resonance is not None))
        parts = 1 + max(int(log.part.max()) for log in data)
        grams, moments = np.zeros((parts, size, size)), np.zeros((parts, size))
        columns, residuals = [], []
        for log in data:
            residual = log.measured_rows - log.delay_command(delay_s)
            own = np.zeros((0, residual.size))
            if structure.terms:
                own = log.compute_columns(structure.terms, delay_s, lags_s, resonance)
            weight = log.compute_weight(residual)
            weighted = np.fft.irfft(np.fft.rfft(own) * weight, residual.size)
            target = np.fft.irfft(np.fft.rfft(residual) * weight, residual.size)
            share = 1.0 / float(target @ target)
            for part in np.unique(log.part):
                rows = log.part == part
                grams[part] += share * weighted[:, rows] @ weighted[:, rows].T
                moments[part] += share * weighted[:, rows] @ target[rows]
            columns.append(own)
            residuals.append(residual)
        return cls(
            structure,
            delay_s,
            lags_s,
            resonance,
            tuple(data),
            tuple(columns),
            tuple(residuals),
            grams,
            moments,
        )

    def solve(self, left_out: int | None = None) -> Float1D:
        """Return the coefficients, (column,), of all parts but one."""
        gram, moment = self.grams.sum(axis=0), self.moments.sum(axis=0)
        scale = 1.0 / np.sqrt(np.diag(gram) + 1e-300)
        if left_out is not None:
            gram, moment = gram - self.grams[left_out], moment - self.moments[left_out]
        ridge = RIDGE_SHARE * np.eye(scale.size)
        solution = np.linalg.solve(gram * np.outer(scale, scale) + ridge, moment * scale)
        return np.asarray(scale * solution, np.float64)

    @cached_property
    def held_out(self) -> tuple[Float1D, ...]:
        """What the regression leaves of each log, (row,), by coefficients without its part."""
        left = [residual.copy() for residual in self.residuals]
        for part in range(self.moments.shape[0]):
            coefficients = self.solve(part)
            for log, columns, rest in zip(self.data, self.columns, left, strict=True):
                rows = log.part == part
                rest[rows] -= coefficients @ columns[:, rows]
        return tuple(left)

    def leave(self, log: ResponseData) -> Float1D:
        """Return what the regression leaves of a log that it was not fitted to, m/s2, (row,)."""
        columns = log.compute_columns(
            self.structure.terms, self.delay_s, self.lags_s, self.resonance
        )
        return log.measured_rows - log.delay_command(self.delay_s) - self.solve() @ columns

    def build_model(self) -> ResponseModel:
        """Return the model with the coefficients of all parts."""
        coefficients = None
        if self.structure.terms:
            rows = self.solve().reshape(len(self.structure.terms), -1)
            named = zip(self.structure.terms, rows.tolist(), strict=True)
            coefficients = {name: tuple(row) for name, row in named}
        return ResponseModel(
            self.structure.id,
            self.delay_s,
            self.data[0].projection.band_hz,
            self.lags_s,
            coefficients,
            self.resonance,
        )


def find_resonance(data: Sequence[ResponseData], delay_s: float) -> Resonance:
    """Return the resonance that explains most of what a delay leaves, on held-out parts.

    It is sought round the highest peak of the power of the residuals, relative to each log's.
    """
    grid_hz = np.arange(data[0].projection.band_hz[0], data[0].projection.band_hz[1], 0.02)
    power = np.zeros(grid_hz.size)
    for log in data:
        residual = log.measured_rows - log.delay_command(delay_s)
        own = np.abs(np.fft.rfft(residual)) ** 2 / float(residual @ residual)
        row_rate_hz = residual.size * log.projection.rate_hz / log.projection.count
        width = max(round(0.1 * residual.size / row_rate_hz), 1)
        own_hz = np.fft.rfftfreq(residual.size, 1.0 / row_rate_hz)
        power += np.interp(grid_hz, own_hz, np.convolve(own, np.ones(width) / width, mode="same"))
    peak_hz = float(grid_hz[int(np.argmax(power))])

    def measure(resonance: Resonance) -> float:
        structure = STRUCTURE_BY_ID["friction_resonance"]
        return measure_held_out(
            ResponseRegression.from_data(structure, data, delay_s, resonance).held_out, data
        )

    damping = RESONANCE_DAMPINGS[1]
    by_hz = [Resonance(peak_hz * (1.0 + shift), damping) for shift in RESONANCE_SHIFTS]
    nearest = min(by_hz, key=measure)
    by_damping = [Resonance(nearest.hz, damping) for damping in RESONANCE_DAMPINGS]
    return min(by_damping, key=measure)


def measure_held_out(held_out: Sequence[Float1D], data: Sequence[ResponseData]) -> float:
    """Return the rms over the logs of what is left over the rms of the measured motion."""
    shares = [
        float(rest @ rest) / float(log.measured_rows @ log.measured_rows)
        for rest, log in zip(held_out, data, strict=True)
    ]
    return math.sqrt(sum(shares) / len(shares))
