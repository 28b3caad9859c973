"""Data of a loop check by channel: rest, held motions and tones.

A tone is the complex fundamental of a channel over a held motion, divided by the commanded peak
acceleration; it is 1 for a perfect table. Displacements are converted to acceleration (-w^2 x),
forces are in N per m/s2.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from table_io.block import Block, Float1D, Label, finite_std
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.excitation.drive import Drive, Segment
from table_io.harmonics import track_channels, track_harmonics
from table_io.safety.consistency import WeakFormPair, compare_motion, make_window
from table_io.sensor_errors import PairErrors, highpass, solve_errors

Complex1D = npt.NDArray[np.complex128]
TRACKED_ORDERS = 5  # fitted together; higher orders are orthogonal over whole cycles
REST_WINDOW_S = 1.0  # at the end of the rest after the motion, when residual motion has decayed
MAX_RATIO_ERROR = 0.02  # standard error above which sensors are not compared at a frequency
MAX_MISMATCH_RATIO = 0.1  # of two sensors of one body
NOTICE_SIGMAS = 3.0  # of the noise, beyond which a mismatch is stated
LOW_CUT_ITERATIONS = 4  # the equations are linear but for the square of the low cut
MIN_LOW_CUT_RAD_S = 2 * math.pi * 0.02  # below it turns the phase by 2 degrees at 0.5 Hz


class SensorComparison(NamedTuple):
    """Displacements against the acceleration of one body, without low cut and delay `errors`.

    `mismatch` is |ratio - 1|, the largest over the held motions with low enough noise, and
    `excess` the largest beyond NOTICE_SIGMAS of its noise; NaN if there is none.
    """

    mismatch: float = math.nan
    excess: float = math.nan
    errors: PairErrors = PairErrors()


# Allowed force (low, high) in N on the (right, left) bumper, compression positive.
PreloadLimits = tuple[tuple[float, float], tuple[float, float]]


@dataclass(frozen=True)
class LoopCheckData:
    """Recorded loop check; `block` holds rest, motions and rest after them; SI, tared.

    `tare_noise` is the rms of each channel during the tare, as far as known, and `preload_n` the
    allowed force on the bumpers at rest.
    """

    block: Block
    drive: Drive
    profile: Profile
    rig: RigConfig
    tare_noise: dict[str, float]
    preload_n: PreloadLimits | None = None

    @cached_property
    def holds(self) -> tuple[Segment, ...]:
        """The held motions, lowest frequency first."""
        segments = [
            segment
            for segment in self.drive.sine_segments
            if segment.step < 0 and segment.label == Label.CHECK
        ]
        inside = [
            segment
            for segment in segments
            if self.block.index <= segment.start < segment.end <= self.block.end
        ]
        return tuple(sorted(inside, key=lambda segment: segment.f0))

    @cached_property
    def frequencies_hz(self) -> Float1D:
        """Frequency of each held motion, (hold,)."""
        return np.array([hold.f0 for hold in self.holds])

    @cached_property
    def levels_m_s2(self) -> Float1D:
        """Commanded peak acceleration of each held motion, (hold,)."""
        return np.array([hold.level0 * hold.correction0 for hold in self.holds])

    @cached_property
    def expected_tones(self) -> Complex1D | None:
        """Tone of the table at each held motion that the test relies on, (hold,); None if unknown.

        The twin of the table foretells it with the drive of a history, at the level of the check.
        """
        response = self.profile.plan.response
        if response is None:
            return None
        return response.find_tones(self.frequencies_hz, self.levels_m_s2)

    @cached_property
    def rest_before(self) -> Block:
        """Samples at rest before the motion."""
        return self.block.cut(self.block.index, self._motion_span[0])

    @cached_property
    def rest_after(self) -> Block:
        """Last REST_WINDOW_S of the rest after the motion."""
        rest = self.block.end - self._motion_span[1]
        count = min(rest, math.ceil(REST_WINDOW_S * self.block.rate_hz))
        return self.block.cut(self.block.end - count, self.block.end)

    @cached_property
    def moving(self) -> Block:
        """Samples from the first held motion to the end of the last one."""
        return self.block.cut(min(h.start for h in self.holds), max(h.end for h in self.holds))

    @cached_property
    def _motion_span(self) -> tuple[int, int]:
        segments = [segment for segment in self.drive.sine_segments if segment.step < 0]
        return segments[0].start, max(segment.end for segment in segments)

    @property
    def test_level(self) -> float:
        """Peak acceleration of the test, m/s2."""
        return self.profile.plan.level_m_s2

    def has(self, *names: str) -> bool:
        """Return True if all these channels exist and none is lost entirely."""
        return all(
            name in self.block.channels and np.isfinite(self.block.channel(name)).any()
            for name in names
        )

    def window(self, hold: Segment) -> Block:
        """Return the last whole cycles of a held motion, without its first, settling cycle."""
        cycles = max(math.floor(hold.count * hold.f0 / self.block.rate_hz + 1e-6) - 1, 1)
        count = min(round(cycles * self.block.rate_hz / hold.f0), hold.count)
        return self.block.cut(hold.end - count, hold.end)

    def phase(self, window: Block) -> Float1D:
        """Return the phase of the drive over a window, in cycles, (sample,)."""
        return self.drive.phase(window.index, len(window))

    def compare_sensors(
        self, displacements: tuple[str, ...], acceleration: str
    ) -> SensorComparison:
        """Compare the second derivative of a sum of displacements with an acceleration.

        Without the low cut and delay that explain all held motions best.
        """
        sensors = (*displacements, acceleration)
        if sensors not in self._comparisons:  # the table waits at rest for the verdict
            self._comparisons[sensors] = self._compare(displacements, acceleration)
        return self._comparisons[sensors]

    @cached_property
    def _comparisons(self) -> dict[tuple[str, ...], SensorComparison]:
        return {}

    def _compare(self, displacements: tuple[str, ...], acceleration: str) -> SensorComparison:
        block, rate_hz = self.block, self.block.rate_hz
        x = np.sum([block.channel(name) for name in displacements], axis=0)
        a = block.channel(acceleration)
        noise = math.hypot(*map(self.noise, displacements)), self.noise(acceleration)
        errors, pairs = PairErrors(), list[WeakFormPair]()
        for _ in range(LOW_CUT_ITERATIONS):
            filtered = highpass(x, errors.low_cut, rate_hz)
            pairs = []
            for hold in self.holds:
                window = self.window(hold)
                span = slice(window.index - block.index, window.end - block.index)
                if not np.isfinite(x[span] + a[span]).all():
                    continue
                phase, cycles = self.phase(window), len(window) * hold.f0 / rate_hz
                middle = 0.5 * float(phase[0] + phase[-1])
                test_functions = make_window(len(window), cycles, middle, rate_hz)
                high_passed = filtered[span], errors.low_cut
                pair = compare_motion(test_functions, x[span], a[span], noise, high_passed)
                if pair.sigma[1] <= MAX_RATIO_ERROR * pair.size:
                    pairs.append(pair)
            if not pairs:
                return SensorComparison()
            equations = [pair.normal_equations() for pair in pairs]
            low_cut = errors.low_cut
            errors = solve_errors(
                np.sum([matrix for matrix, _ in equations], axis=0),
                np.sum([rhs for _, rhs in equations], axis=0),
            )
            if errors.low_cut == low_cut:  # so the next iteration would be this one again
                break
        phase_errors = replace(errors, gain=1.0)
        corrected = [pair.remove_errors(phase_errors) for pair in pairs]
        ratios = np.array([pair.displacement[1] / pair.acceleration[1] for pair in corrected])
        noise_ratios = [pair.sigma[1] / abs(pair.acceleration[1]) for pair in corrected]
        mismatches = np.abs(ratios - 1.0)
        excess = np.maximum(mismatches - NOTICE_SIGMAS * np.array(noise_ratios), 0.0)
        return SensorComparison(float(mismatches.max()), float(excess.max()), errors)

    @cached_property
    def table_low_cut(self) -> float:
        """Low cut of the table's accelerometer in rad/s; 0 if it has none or is not comparable."""
        return self._measure_low_cut(("table_disp_m",), "table_acc_m_s2")

    @cached_property
    def mass_low_cut(self) -> float:
        """Low cut of the mass's accelerometer in rad/s; 0 if it has none or is not comparable."""
        mass = ("mass_disp_m",) if self.has("mass_disp_m") else ("rel_disp_m", "table_disp_m")
        return self._measure_low_cut(mass, "mass_acc_m_s2")

    def _measure_low_cut(self, displacements: tuple[str, ...], acceleration: str) -> float:
        if not self.has(*displacements, acceleration):
            return 0.0
        mismatch, _, errors = self.compare_sensors(displacements, acceleration)
        is_proven = mismatch <= MAX_MISMATCH_RATIO and errors.low_cut >= MIN_LOW_CUT_RAD_S
        return errors.low_cut if is_proven else 0.0

    def tones(self, name: str) -> Complex1D:
        """Return the tone of a channel at each held motion, (hold,); NaN where it is lost.

        Accelerations are those in front of the low cut of their sensor.
        """
        units = np.array([self._tone_scale(name, hold) for hold in self.holds], dtype=complex)
        low_cut = {
            "table_acc_m_s2": lambda: self.table_low_cut,
            "mass_acc_m_s2": lambda: self.mass_low_cut,
        }.get(name, float)()
        if low_cut:
            units *= 1.0 + low_cut / (2j * math.pi * self.frequencies_hz)
        return self._fundamentals[self.block.channels.index(name)] * units

    @cached_property
    def _fundamentals(self) -> npt.NDArray[np.complex128]:
        """Fundamental of every channel at each held motion, (channel, hold)."""
        fundamentals = np.empty((len(self.block.channels), len(self.holds)), dtype=np.complex128)
        for k, hold in enumerate(self.holds):
            window = self.window(hold)
            phase = self.phase(window)
            for n, tracked in enumerate(track_channels(window.values, phase, TRACKED_ORDERS)):
                values = window.values[n]
                finite = np.isfinite(values)
                harmonics = (
                    tracked
                    if finite.all()
                    else track_harmonics(values[finite], phase[finite], TRACKED_ORDERS)
                )
                fundamentals[n, k] = harmonics.amplitudes[0]
        return fundamentals

    def tone_errors(self, name: str) -> Float1D:
        """Return the standard error of |tone| due to the noise at rest, (hold,)."""
        noise = self.noise(name)
        return np.array(
            [
                noise * math.sqrt(2.0 / len(self.window(hold))) * abs(self._tone_scale(name, hold))
                for hold in self.holds
            ]
        )

    def tone_snr(self, name: str) -> float:
        """Return the largest ratio of tone to standard error of a channel; 0 if it is lost."""
        ratios = np.abs(self.tones(name)) / self.tone_errors(name)
        return float(np.nan_to_num(ratios, nan=0.0).max())

    def _tone_scale(self, name: str, hold: Segment) -> float:
        """Return the factor from an amplitude of the channel to its tone."""
        return (
            -((2 * math.pi * hold.f0) ** 2) if self.rig.channel_by_name[name].unit == "m" else 1.0
        ) / (hold.level0 * hold.correction0)

    def noise(self, name: str) -> float:
        """Return the rms of a channel at rest about its mean, SI; at least its rounding noise."""
        rest_rms = finite_std(self.rest_before.channel(name))
        rounding = self.rig.sensor(name).lsb_si / math.sqrt(12.0)
        return (
            max(rest_rms, self.tare_noise.get(name, 0.0), rounding) if rest_rms >= 0 else math.nan
        )
