"""Imperfect laboratory: instruments and set-up between the true values and the converter.

    true values -> cells -> pitch, cross axis, bracket, low cut, cable -> skew -> laser, gain drift
    + offset, noise, 1/f, hum, offset drift -> anti-alias filter -> converter

Definitions are in `imperfections.py`. Samples must come in order; readings do not depend on the
division into calls: filters keep their state, functions of time are computed in whole chunks
because the rounding of vectorised functions may depend on the length of an array.

A filter starts in the steady state of its first sample: the signal is constant before sample 0.
"""

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from table_io.block import Float1D, Float2D
from table_io.channels import LEFT_CELLS, RIGHT_CELLS, Channel
from table_io.config.rig import RigConfig
from table_io.config.sensor import SensorConfig
from table_io.sim.imperfections import ALL_QUANTITIES, Imperfection, acts_on, resolve_sides
from table_io.units import GRAVITY_M_S2

CUBIC_POINTS = 4  # samples of the interpolation
SETTLING_TIME_CONSTANTS = 40.0  # e^-40 is below the rounding error


class FractionalDelay:
    """Delay of one channel by causal cubic interpolation; lag in samples, not necessarily whole."""

    def __init__(self, lag: float) -> None:
        self._whole_samples = max(math.floor(lag) - 1, 0)
        # Positions of the four samples relative to the delayed time.
        positions = self._whole_samples + np.arange(CUBIC_POINTS) - lag
        self._weights = [math.prod(a / (a - b) for a in positions if a != b) for b in positions]
        self._recent: Float1D | None = None

    def apply(self, values: Float1D) -> Float1D:
        """Return the values a lag earlier, (sample,)."""
        if values.size == 0:
            return values
        depth = self._whole_samples + CUBIC_POINTS - 1
        recent = np.full(depth, values[0]) if self._recent is None else self._recent
        known = np.concatenate([recent, values])
        self._recent = known[known.size - depth :]
        delayed: Float1D = np.zeros(values.size)
        for back, weight in enumerate(self._weights):
            delayed += weight * known[depth - self._whole_samples - back :][: values.size]
        return delayed


class AnalogFilter:
    """Continuous-time filter, exact for a signal that is linear between samples (ramp invariant).

    H(s) = gain prod (s - zero) / prod (s - pole) = direct + sum residue / (s - pole), with distinct
    poles of negative real part, in rad/s, and at most as many zeros. Each pole is integrated in
    closed form; of a conjugate pair, one pole and twice its real part.
    """

    def __init__(
        self, zeros: list[complex], poles: list[complex], gain: float, rate_hz: float
    ) -> None:
        from scipy.signal import lfilter  # slow to import, and few tables have such a filter

        self._run_section = lfilter
        self._direct = gain if len(zeros) == len(poles) else 0.0
        self._sections = []
        self.settling_samples = math.ceil(
            SETTLING_TIME_CONSTANTS * rate_hz / min(-np.real(pole) for pole in poles)
        )
        for pole in poles:
            if pole.imag < 0:
                continue
            residue = gain * math.prod((pole - zero for zero in zeros), start=1.0 + 0j)
            residue /= math.prod((pole - other for other in poles if other != pole), start=1.0 + 0j)
            step = pole / rate_hz
            growth = np.expm1(step)
            ramp = (growth - step) / (pole * step)  # response to a ramp from 0 to 1 over a sample
            weight = 2.0 if pole.imag > 0 else 1.0
            self._sections.append(
                (
                    weight * residue * np.array([ramp, growth / pole - ramp]),
                    np.array([1.0, -np.exp(step)]),
                    -weight * residue / pole,  # static gain
                )
            )
        self._states: list[np.ndarray] = []

    def apply(self, values: Float2D) -> Float2D:
        """Return the filtered values, (channel, sample) as given."""
        if values.shape[1] == 0:
            return values
        if not self._states:
            start = values[:, :1]
            self._states = [(static - b[0]) * start for b, _, static in self._sections]
        filtered: Float2D = self._direct * values
        for n, (b, a, _) in enumerate(self._sections):
            response, self._states[n] = self._run_section(b, a, values, axis=1, zi=self._states[n])
            filtered += response.real
        return filtered


CHUNK_SAMPLES = 512  # of the functions of time
ONE_OVER_F_START_HZ = 1e-3  # the density is constant below
# Of the 1/f filter: its density is exact to 0.1 dB up to rate / 20, and 1.6 dB high at rate / 5.
POLES_PER_DECADE = 2
GRID_PER_LENGTH = 8  # points of a light-spot profile per correlation length
HARMONICS = ((1, ""), (2, "_2"), (3, "_3"), (5, "_5"))


class RowImperfection(NamedTuple):
    """Imperfection of the channel at `row` of the readings."""

    row: int
    entry: Imperfection
    p: dict[str, float]


class Laboratory:
    """Imperfections of a rig, with their state. Without any, readings are unchanged to the bit.

    `seed` fixes what belongs to the instruments, `noise` draws what differs from run to run.
    `first` is the index of the first sample.
    """

    def __init__(
        self,
        imperfections: Iterable[Imperfection],
        rig: RigConfig,
        rate_hz: float,
        seed: int,
        noise: np.random.Generator,
        first: int = 0,
    ) -> None:
        entries = list(imperfections)
        self._rig, self._rate_hz, self._noise, self._next = rig, rate_hz, noise, first
        _check_channels(entries, rig)
        self._shares = resolve_sides(entries, "load_sharing")
        self._plates = resolve_sides(entries, "plate_mass")
        parameters_by_id = {entry.id: entry.parameters for entry in entries}
        pitch = parameters_by_id.get("table_pitch", {})
        self._pitch = pitch.get("per_acceleration", 0.0), pitch.get("per_travel", 0.0)
        skew = parameters_by_id.get("channel_skew", {}).get("skew", 0.0) * rate_hz
        last = len(rig.channels) - 1
        self._delays = {
            row: FractionalDelay((last - row) * skew)
            for row, name in enumerate(rig.channels)
            if skew and row < last and rig.channel_by_name[name].body != "command"
        }

        def select(imperfection_id: str) -> list[RowImperfection]:
            return _select_rows(entries, rig, imperfection_id)

        self._cross_axis = [
            (item, *_vertical_filters(item.p, rate_hz)) for item in select("cross_axis")
        ]
        self._sensor_filters = [
            (item.row, _sensor_filter(item, rate_hz))
            for imperfection_id in ("mounting_resonance", "highpass")
            for item in select(imperfection_id)
        ]
        self._cables = [(item.row, _cable_filter(item.p, rate_hz)) for item in select("cable")]
        self._laser_errors = select("laser_nonlinearity")
        self._profiles = [
            (
                item.row,
                LightSpotProfile(item.p, rig.sensors[item.row].range_si, [seed, 3, item.row]),
            )
            for item in select("light_spot")
        ]
        self._drifts, self._hums = select("drift"), select("hum")
        self._one_over_f: HalfOrderNoise | None = None
        if coloured := select("one_over_f"):
            self._one_over_f = HalfOrderNoise(
                [item.row for item in coloured],
                [self._noise_rms(item.row) * math.sqrt(item.p["corner_hz"]) for item in coloured],
                rate_hz,
                noise,
            )
        self._alias_filters = _group_alias_filters(select("anti_alias_filter"), rate_hz)
        self._effective_bits = {item.row: int(item.p["bits"]) for item in select("quantisation")}
        self._is_settled = False
        self._chunk: tuple[int, Float2D] | None = None

    @property
    def sensors(self) -> tuple[SensorConfig, ...]:
        """Sensors of the rig, with the effective bits of their converters."""
        return tuple(
            sensor.model_copy(update={"bits": min(sensor.bits, self._effective_bits[row])})
            if row in self._effective_bits
            else sensor
            for row, sensor in enumerate(self._rig.sensors)
        )

    def cell_forces(self, signals: Float2D) -> dict[str, Float1D]:
        """Return the force on each load cell, compression positive, from SIGNALS of the plant.

        The plate in front of the cells of a side moves with the table: mass y'' = N_R - cells on
        the right, and cells - N_L on the left.
        """
        y, y_acc, x, _, right, left = signals[:6]
        forces = {}
        for side, names, contact, sign in (
            ("right", RIGHT_CELLS, right, 1.0),
            ("left", LEFT_CELLS, -left, -1.0),
        ):
            p = self._shares.get(side)
            share = np.clip(p["share"] + p["share_per_m"] * (x - y), 0.0, 1.0) if p else 0.5
            for name, part in zip(names, (share, 1.0 - share), strict=True):
                forces[name] = part * contact
                if side in self._plates:
                    forces[name] = forces[name] - 0.5 * sign * self._plates[side]["mass"] * y_acc
        return forces

    def measure(self, values: Float2D, signals: Float2D) -> Float2D:
        """Return the noise-free output of the sensors, (channel, sample), from true values.

        `signals` are those of the plant, (signal, sample).
        """
        count = values.shape[1]
        if count == 0:
            return values
        values = values.copy()
        y, y_acc, _, _, right, left = signals[:6]
        angle = self._pitch[0] * y_acc + self._pitch[1] * y
        sine = np.zeros(count)
        if any(self._pitch):
            sine = np.fromiter(map(math.sin, angle.tolist()), float, count)
            for row, name in enumerate(self._rig.channels):
                channel = self._rig.channel_by_name[name]
                if channel.quantity == "acceleration" and channel.body != "ground":
                    values[row] += (channel.sign or 0.0) * GRAVITY_M_S2 * sine
        for item, bounce, rocking in self._cross_axis:
            vertical = bounce.apply(y_acc[None])[0]
            if any(self._pitch):
                vertical = vertical + rocking.apply(angle[None])[0]
                vertical -= GRAVITY_M_S2 * sine**2 / (1.0 + np.sqrt(1.0 - sine**2))
            values[item.row] += item.p["share"] * vertical
        for row, sensor_filter in self._sensor_filters:
            values[row] = sensor_filter.apply(values[row : row + 1])[0]
        for row, whip in self._cables:
            values[row] += whip.apply((right + left)[None])[0]
        for row, delay in self._delays.items():
            values[row] = delay.apply(values[row])
        for row, _, p in self._laser_errors:
            full_scale = self._rig.sensors[row].range_si
            values[row] += full_scale * _laser_error(values[row] / full_scale, p)
        for row, profile in self._profiles:
            values[row] += profile.evaluate(values[row])
        hours = (self._next + np.arange(count)) / (3600.0 * self._rate_hz)
        for row, _, p in self._drifts:
            values[row] *= 1.0 + p["gain_per_h"] * hours
        return values

    def condition(self, values: Float2D, noise: Float2D) -> Float2D:
        """Return what reaches the converter, (channel, sample) in SI.

        `values` are those of `measure` plus offset, `noise` is the white noise of the sensors.
        """
        count = values.shape[1]
        if count == 0:
            return values
        if not self._is_settled:
            self._settle(values[:, :1])
        conditioned = self._add_interference(self._next, values + noise)
        for rows, alias_filter in self._alias_filters:
            conditioned[rows] = alias_filter.apply(conditioned[rows])
        self._next += count
        return conditioned

    def _settle(self, rest: Float2D) -> None:
        """Let the noise before the first sample pass the filters, so that it is stationary.

        `rest`: values before the first sample, (channel, 1).
        """
        self._is_settled = True
        if not self._alias_filters:
            return
        count = max(alias_filter.settling_samples for _, alias_filter in self._alias_filters)
        rms = np.array([self._noise_rms(row) for row in range(len(rest))])
        before = rest + (rms * self._noise.standard_normal((count, rms.size))).T
        before = self._add_interference(self._next - count, before)
        for rows, alias_filter in self._alias_filters:
            alias_filter.apply(before[rows])

    def _add_interference(self, first: int, analog: Float2D) -> Float2D:
        """Return a copy with 1/f noise, hum and drift from sample `first` on."""
        analog = analog.copy()
        if self._one_over_f is not None:
            analog[self._one_over_f.rows] += self._one_over_f.draw(analog.shape[1])
        if self._hums or self._drifts:
            done, end = first, first + analog.shape[1]
            while done < end:
                number, start = divmod(done, CHUNK_SAMPLES)
                if self._chunk is None or self._chunk[0] != number:
                    self._chunk = number, self._compute_chunk(number)
                part = self._chunk[1][:, start : start + end - done]
                analog[:, done - first : done - first + part.shape[1]] += part
                done += part.shape[1]
        return analog

    def _compute_chunk(self, number: int) -> Float2D:
        """Compute hum and drift of offset, (channel, CHUNK_SAMPLES)."""
        t = (number * CHUNK_SAMPLES + np.arange(CHUNK_SAMPLES)) / self._rate_hz
        chunk = np.zeros((len(self._rig.channels), CHUNK_SAMPLES))
        for row, _, p in self._hums:
            weights = [1.0, *(p[f"harmonic{suffix}"] for _, suffix in HARMONICS[1:])]
            rms = p["rms"] + p["rms_over_noise"] * self._noise_rms(row)
            amplitude = math.sqrt(2.0) * rms / math.hypot(*weights)
            for (order, suffix), weight in zip(HARMONICS, weights, strict=True):
                phase = math.tau * order * p["frequency"] * t + p[f"phase{suffix}"]
                chunk[row] += amplitude * weight * np.sin(phase)
        for row, _, p in self._drifts:
            full_scale = self._rig.sensors[row].range_si
            rate = p["offset_per_h"] + p["offset_share_per_h"] * full_scale
            warm_up = p["warm_up"] + p["warm_up_share"] * full_scale
            chunk[row] += rate / 3600.0 * t - warm_up * np.expm1(-t / p["warm_up_time"])
        return chunk

    def _noise_rms(self, row: int) -> float:
        """Return the white noise of a sensor in SI."""
        return self._rig.sensors[row].noise_si


class LightSpotProfile:
    """Fixed random error of a laser over position, linear between points of a fine grid."""

    def __init__(self, p: dict[str, float], full_scale: float, seed: list[int]) -> None:
        self._spacing = p["correlation_length"] / GRID_PER_LENGTH
        self._half = math.ceil(full_scale / self._spacing) + 1
        # The correlation of smoothed white noise is sqrt(2) wider than the kernel.
        offsets = np.arange(-4 * GRID_PER_LENGTH, 4 * GRID_PER_LENGTH + 1)
        kernel = np.exp(-((offsets / GRID_PER_LENGTH) ** 2))
        kernel *= p["rms"] / np.linalg.norm(kernel)
        white = np.random.default_rng(seed).standard_normal(2 * self._half + offsets.size)
        self._errors: Float1D = np.convolve(white, kernel, mode="valid")

    def evaluate(self, position: Float1D) -> Float1D:
        """Return the error in m at positions in m; beyond the full scale that of its end."""
        place = np.clip(position / self._spacing, -self._half, self._half - 1) + self._half
        index = place.astype(np.int64)
        low = self._errors[index]
        error: Float1D = low + (place - index) * (self._errors[index + 1] - low)
        return error


class HalfOrderNoise:
    """Noise of density white / f: white noise through a filter of order one half.

    `scales`: rms of the white noise times the root of the corner frequency in Hz.
    """

    def __init__(
        self, rows: list[int], scales: list[float], rate_hz: float, noise: np.random.Generator
    ) -> None:
        self.rows = rows
        self._scales = np.array(scales)[:, None]
        self._noise = noise
        from scipy import signal  # slow to import, and few tables have such noise

        self._filter = signal.sosfilt
        decades = math.log10(0.5 * rate_hz / ONE_OVER_F_START_HZ)
        ratio = 10.0 ** (1.0 / POLES_PER_DECADE)
        corners = ONE_OVER_F_START_HZ * ratio ** np.arange(math.floor(decades * POLES_PER_DECADE))
        poles, zeros = (
            np.exp(-math.tau * corner / rate_hz) for corner in (corners, corners * math.sqrt(ratio))
        )
        self._sos = signal.zpk2sos(zeros, poles, 1.0)
        frequencies = np.geomspace(10 * ONE_OVER_F_START_HZ, 0.05 * rate_hz, 200)
        response = np.abs(signal.sosfreqz(self._sos, frequencies, fs=rate_hz)[1])
        self._sos[0, :3] /= np.exp(np.mean(np.log(response * np.sqrt(frequencies))))
        self._state = self._draw_stationary_state()

    def draw(self, count: int) -> Float2D:
        """Draw the next samples, (row, sample)."""
        white = self._scales * self._noise.standard_normal((count, len(self.rows))).T
        coloured, self._state = self._filter(self._sos, white, axis=1, zi=self._state)
        noise: Float2D = coloured
        return noise

    def _draw_stationary_state(self) -> Float2D:
        """Draw a state of the filter, (section, row, 2), as after an infinite time."""
        from scipy import linalg

        sections = len(self._sos)
        size = 2 * sections

        def advance(sample: float, state: Float1D) -> Float1D:
            zi = state.reshape(sections, 2)
            after: Float1D = self._filter(self._sos, np.array([sample]), zi=zi)[1].ravel()
            return after

        transition = np.array([advance(0.0, unit) for unit in np.eye(size)]).T
        entry = advance(1.0, np.zeros(size))
        covariance = linalg.solve_discrete_lyapunov(transition, np.outer(entry, entry))
        values, vectors = np.linalg.eigh(covariance)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        states = self._scales * self._noise.standard_normal((len(self.rows), size)) @ root.T
        return states.reshape(len(self.rows), sections, 2).transpose(1, 0, 2).copy()


def _check_channels(entries: list[Imperfection], rig: RigConfig) -> None:
    """Raise InputError if an imperfection cannot act on its channel."""
    for entry in entries:
        allowed = [
            name
            for name in rig.channels
            if _can_act(entry, rig.channel_by_name[name], is_stated=True)
        ]
        entry.check_channel(
            allowed, "the rig has no sensor of this channel, or the imperfection cannot act on it"
        )


def _can_act(entry: Imperfection, channel: Channel, is_stated: bool) -> bool:
    """Return whether an entry acts on a channel; the command read back must be stated."""
    if channel.body == "command":
        return is_stated and entry.definition.quantities == ALL_QUANTITIES
    return acts_on(entry.definition, channel.quantity)


def _select_rows(
    entries: list[Imperfection], rig: RigConfig, imperfection_id: str
) -> list[RowImperfection]:
    """Return an imperfection by channel, if not absent; an entry with a channel wins."""
    by_row = {
        row: entry
        for entry in sorted(entries, key=lambda entry: entry.channel is not None)
        if entry.id == imperfection_id
        for row, name in enumerate(rig.channels)
        if entry.channel in (None, name)
        and _can_act(entry, rig.channel_by_name[name], entry.channel is not None)
    }
    return [
        RowImperfection(row, entry, entry.parameters)
        for row, entry in sorted(by_row.items(), key=lambda item: item[0])
        if not entry.is_absent
    ]


def _conjugate_poles(frequency_hz: float, damping_ratio: float) -> list[complex]:
    """Return the poles of a damped oscillator in rad/s."""
    natural = math.tau * frequency_hz
    real, imaginary = damping_ratio, math.sqrt(1.0 - damping_ratio**2)
    return [natural * complex(-real, imaginary), natural * complex(-real, -imaginary)]


def _vertical_filters(p: dict[str, float], rate_hz: float) -> tuple[AnalogFilter, AnalogFilter]:
    """Return the filters from table acceleration, and from pitch, to vertical acceleration."""
    poles = _conjugate_poles(p["frequency"], p["damping_ratio"])
    square = (math.tau * p["frequency"]) ** 2
    return (
        AnalogFilter([], poles, p["vertical_share"] * square, rate_hz),
        AnalogFilter([0j, 0j], poles, p["lever"] * square, rate_hz),
    )


def _sensor_filter(item: RowImperfection, rate_hz: float) -> AnalogFilter:
    """Return the filter of a bracket, or of the low cut of an accelerometer."""
    if item.entry.id == "highpass":
        return AnalogFilter([0j], [complex(-math.tau * item.p["corner_hz"])], 1.0, rate_hz)
    natural, damping = math.tau * item.p["frequency"], item.p["damping_ratio"]
    poles = _conjugate_poles(item.p["frequency"], damping)
    zero = complex(-natural / (2.0 * damping))
    return AnalogFilter([zero], poles, 2.0 * damping * natural, rate_hz)


def _cable_filter(p: dict[str, float], rate_hz: float) -> AnalogFilter:
    """Return the filter from contact force to the error of a whipping cable."""
    decay = 1.0 / p["decay_time"]
    return AnalogFilter(
        [0j], [complex(-decay), complex(-10.0 * decay)], 10.0 * decay * p["error_per_n"], rate_hz
    )


def _group_alias_filters(
    items: list[RowImperfection], rate_hz: float
) -> list[tuple[list[int], AnalogFilter]]:
    """Return the anti-alias filters with their rows; channels with equal ones share one."""
    if not items:
        return []
    from scipy import signal  # slow to import, and few tables have such filters

    rows: dict[tuple[str, float, float], list[int]] = {}
    for row, entry, p in items:
        rows.setdefault((entry.form, p["order"], p["corner_hz"]), []).append(row)
    filters = []
    for (form, order, corner_hz), group in rows.items():
        options = {"analog": True, "output": "zpk"}
        if form == "bessel":
            zpk = signal.bessel(int(order), math.tau * corner_hz, norm="mag", **options)
        else:
            zpk = signal.butter(int(order), math.tau * corner_hz, **options)
        # Exactly conjugate and exactly real poles: one of each pair is integrated.
        upper = [complex(pole) for pole in zpk[1] if pole.imag > 1e-9 * abs(pole)]
        real = [complex(pole.real) for pole in zpk[1] if abs(pole.imag) <= 1e-9 * abs(pole)]
        poles = [*upper, *(pole.conjugate() for pole in upper), *real]
        gain = math.prod(poles, start=1.0 + 0j) * (-1) ** int(order)
        filters.append((group, AnalogFilter([], poles, gain.real, rate_hz)))
    return filters


def _laser_error(s: Float1D, p: dict[str, float]) -> Float1D:
    """Return the error over full scale at positions s over full scale."""
    s = np.clip(s, -1.0, 1.0)
    square = s * s
    odd = s * (((64.0 * square - 112.0) * square + 56.0) * square - 7.0)
    even = square * ((16.0 * square - 24.0) * square + 9.0)
    error: Float1D = p["share"] * odd + p["even_share"] * even
    return error
