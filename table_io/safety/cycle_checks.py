"""Cycle checks: level, response, drift, sensors and load cells over one whole cycle of the drive.

Each function yields suspicions; one that persists over several checks becomes a finding.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from table_io.block import Float1D, Float2D, Label
from table_io.channels import CONTROL_CHANNELS, LEFT_CELLS, RIGHT_CELLS
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.control.sweep_control import combine_levels
from table_io.harmonics import HarmonicFit, track_channels, track_harmonics
from table_io.safety.consistency import (
    MAX_CELL_OFFSET_RATIO,
    CellPairFit,
    WeakFormPair,
    WeakFormWindow,
    compare_motion,
    fit_cell_pair,
    make_window,
    remove_spikes,
)
from table_io.safety.findings import Suspicion, format_si, suspect_drift
from table_io.sensor_errors import AVERAGING_CHECKS, PairErrorEstimate, PairErrors

TRACKED_HARMONICS = 5  # separated from the fundamental of the table's motion


@dataclass(frozen=True, eq=False)
class ProtectionContext:
    """Profile, rig, and noise of its sensors at rest: rms and spike threshold, SI, (channel,)."""

    profile: Profile
    rig: RigConfig
    sigma: Float1D  # (channel,)
    spike_limit: Float1D

    @property
    def rate_hz(self) -> float:
        return self.profile.acquisition.rate_hz

    def range_si(self, name: str) -> float:
        """Return the full-scale range of a sensor on either side, SI."""
        return self.rig.sensor(name).range_si


@dataclass(frozen=True, eq=False)
class DriveCycle:
    """About one cycle of the drive: values (channel, sample), command and phase (sample,).

    The phase is unwrapped; `level` and `label` are those of the last sample.
    """

    context: ProtectionContext
    values: Float2D
    command: Float1D
    phase: Float1D
    level: float
    label: int

    @cached_property
    def _clean_values(self) -> Float2D:
        return remove_spikes(self.values, self.context.spike_limit[:, None])

    @cached_property
    def _complete_channels(self) -> frozenset[str]:
        rows = np.flatnonzero(~np.isnan(self.values).any(axis=1)).tolist()
        return frozenset(self.context.rig.channels[row] for row in rows)

    @cached_property
    def tones(self) -> dict[str, HarmonicFit]:
        """Harmonics of the command ("command"), of its read-back and of the table's channels."""
        rows = [*(self.clean_channel(name) for name in CONTROL_CHANNELS), self.command]
        tracked = track_channels(np.array(rows), self.phase, TRACKED_HARMONICS)
        return dict(zip((*CONTROL_CHANNELS, "command"), tracked, strict=True))

    @cached_property
    def window(self) -> WeakFormWindow:
        """Test functions over the cycle."""
        middle = 0.5 * float(self.phase[0] + self.phase[-1])
        return make_window(self.phase.size, self.cycle_count, middle, self.context.rate_hz)

    def has(self, *names: str) -> bool:
        """Return True if the rig has these channels and no sample of them is lost."""
        return self._complete_channels.issuperset(names)

    def clean_channel(self, name: str) -> Float1D:
        """Return a channel with spikes of one sample removed, (sample,)."""
        row: Float1D = self._clean_values[self.context.rig.channels.index(name)]
        return row

    @property
    def cycle_count(self) -> float:
        """Cycles of the drive, including the interval after the last sample."""
        count = self.phase.size
        return float(self.phase[-1] - self.phase[0]) * count / (count - 1)

    @property
    def omega(self) -> float:
        """Angular frequency, rad/s."""
        return 2 * math.pi * self.cycle_count * self.context.rate_hz / self.phase.size

    def sigma(self, *names: str) -> float:
        """Return the rms noise of a sum of channels."""
        return math.hypot(
            *(self.context.sigma[self.context.rig.channels.index(name)] for name in names)
        )

    def relative_displacement(self) -> Float1D | None:
        """Return u in m, right positive, (sample,); None where it is not measured."""
        if self.has("rel_disp_m"):
            return self.clean_channel("rel_disp_m")
        if self.has("mass_disp_m", "table_disp_m"):
            return self.clean_channel("mass_disp_m") - self.clean_channel("table_disp_m")
        return None


MAX_MISMATCH_RATIO = 0.12  # of the motion; slightly more than the limit of the loop check
MAX_MISMATCH_CHANGE = 0.05  # of the motion; change from the errors of the last ten cycles
MIN_BASELINE_CHECKS = 6  # checks from which those errors are known
OFFSET_RANGE_RATIO = 1e-3  # of a sensor's range
MAX_OFFSET_RESIDUAL_RATIO = 0.3  # remaining share of a mismatch that an offset explains
OFFSET_AMPLITUDE_RATIO = 0.02  # of the table's motion
MAX_READ_BACK_ERROR = 0.02  # of the command
MAX_GAIN_CHANGE = 0.2  # of the identified response
MAX_LAG_CHANGE_RATIO, MAX_LAG_CHANGE_S = 0.5, 0.003  # of the identified lag, and absolute minimum
MAX_SWING_ASYMMETRY = 0.35  # of the swing of the mass: twice that of the chaotic case G4


@dataclass(frozen=True, slots=True)
class PairBaseline:
    """Baseline of a sensor pair: last consistent comparison, and its errors."""

    last: WeakFormPair | None = None
    estimate: PairErrorEstimate = field(default_factory=PairErrorEstimate)

    @property
    def errors(self) -> PairErrors:
        return self.estimate.errors

    @property
    def is_known(self) -> bool:
        """True if the errors of the pair are known."""
        return self.estimate.check_count >= MIN_BASELINE_CHECKS

    def update(self, pair: WeakFormPair, omega: float) -> "PairBaseline":
        """Return the baseline updated with one more consistent comparison at `omega` rad/s."""
        if not pair.is_clear:
            return replace(self, last=pair)
        return PairBaseline(pair, self.estimate.update(pair.normal_equations(), omega))


def sum_channels(rig: RigConfig, values: Float2D, names: tuple[str, ...]) -> Float1D:
    """Return the sum of channels, (sample,), from values (channel, sample)."""
    return np.asarray(sum(values[rig.channels.index(name)] for name in names))


def compare_sensor_pair(
    cycle: DriveCycle, names: tuple[str, ...], acceleration: str, filtered: Float1D, low_cut: float
) -> WeakFormPair:
    """Compare displacement channels with an acceleration channel.

    `filtered` is the sum of the displacements behind a high-pass of `low_cut` rad/s, (sample,).
    """
    x = np.sum([cycle.clean_channel(name) for name in names], axis=0)
    noise = cycle.sigma(*names), cycle.sigma(acceleration)
    values = cycle.clean_channel(acceleration)
    return compare_motion(cycle.window, x, values, noise, (filtered, low_cut))


def check_sensor_pair(
    cycle: DriveCycle,
    names: tuple[str, ...],
    acceleration: str,
    pair: WeakFormPair,
    baseline: PairBaseline,
) -> Iterator[Suspicion]:
    """Yield a suspicion if a displacement and an acceleration are inconsistent, or became so.

    Low cut and delay of sound sensors are no inconsistency. The sensor that changed more since the
    last consistent check is suspected; if the motion itself changes from cycle to cycle, it may be
    the other one.
    """
    known = replace(baseline.errors, gain=1.0) if baseline.is_known else pair.fit_phase_errors()
    fitted = pair.remove_errors(known)
    share = fitted.mismatch / fitted.size if fitted.size else 0.0
    limit, problem = MAX_MISMATCH_RATIO, "does not fit"
    if share <= MAX_MISMATCH_RATIO and baseline.is_known:
        fitted = pair.remove_errors(baseline.errors)
        share = fitted.fundamental_mismatch / fitted.size
        limit = MAX_MISMATCH_CHANGE
        problem = "no longer fits"
    max_offset = OFFSET_RANGE_RATIO * cycle.context.range_si(acceleration) + 6.0 * pair.sigma_offset
    if share <= limit:
        # A gain error within its limit may cause an apparent offset of this size.
        if abs(fitted.offset) > max_offset + MAX_MISMATCH_RATIO * fitted.average:
            yield suspect_drift(
                acceleration,
                fitted.offset,
                max_offset + MAX_MISMATCH_RATIO * fitted.average,
                "m/s2",
            )
        return
    if (
        abs(fitted.offset) > max_offset
        and fitted.mismatch_without_offset < MAX_OFFSET_RESIDUAL_RATIO * fitted.mismatch
    ):
        yield suspect_drift(acceleration, fitted.offset, max_offset, "m/s2")
        return
    suspected, other = names[0], acceleration
    if baseline.last is not None:
        displacement_change = abs(pair.displacement[1] - baseline.last.displacement[1])
        if abs(pair.acceleration[1] - baseline.last.acceleration[1]) > displacement_change:
            suspected, other = acceleration, names[0]
    text = f"{suspected} {problem} {other}: they differ by {100 * share:.0f} % of the motion; "
    text += f"allowed: {100 * limit:.0f} %"
    yield Suspicion("consistency", suspected, share, limit, text, group=names[0])


def check_table_mean(cycle: DriveCycle) -> Iterator[Suspicion]:
    """Check that the mean of the table's displacement over a held cycle is that of its command.

    The command has one while a feedback changes it within the cycle.
    """
    if not cycle.has("table_disp_m"):
        return
    table = cycle.tones["table_disp_m"]
    limit = OFFSET_RANGE_RATIO * cycle.context.range_si("table_disp_m")
    limit += OFFSET_AMPLITUDE_RATIO * table.fundamental + cycle.sigma("table_disp_m")
    drift = table.offset - cycle.tones["command"].offset
    if abs(drift) > limit:
        yield suspect_drift("table_disp_m", drift, limit, "m")


@dataclass(frozen=True, slots=True)
class SwingAverage:
    """Mean and half the range of u in m, averaged over about AVERAGING_CHECKS checks."""

    mean: float = 0.0
    half: float = 0.0
    check_count: int = 0


def update_swing(cycle: DriveCycle, average: SwingAverage) -> SwingAverage:
    """Return the average updated with one more cycle; unchanged where u is not measured."""
    u = cycle.relative_displacement()
    if u is None:
        return average
    weight = 1.0 / min(average.check_count + 1, AVERAGING_CHECKS)
    mean, half = float(u.mean()), 0.5 * float(np.ptp(u))
    return SwingAverage(
        average.mean + weight * (mean - average.mean),
        average.half + weight * (half - average.half),
        average.check_count + 1,
    )


def check_mass_mean(cycle: DriveCycle, swing: SwingAverage) -> Iterator[Suspicion]:
    """Check that the mass swings about the middle, averaged over AVERAGING_CHECKS checks.

    The limit allows for impacts on one side more than on the other, and for unequal gaps.
    """
    right, left = cycle.context.profile.specimen.gaps_m
    gap_asymmetry = abs(right - left) / 2 if right != left else 0.0
    name = "rel_disp_m" if "rel_disp_m" in cycle.context.rig.channels else "mass_disp_m"
    if swing.check_count < AVERAGING_CHECKS or name not in cycle.context.rig.channels:
        return
    limit = (
        OFFSET_RANGE_RATIO * cycle.context.range_si(name)
        + MAX_SWING_ASYMMETRY * swing.half
        + gap_asymmetry
    )
    if abs(swing.mean) > limit:
        yield suspect_drift(name, swing.mean, limit, "m")


def check_level(cycle: DriveCycle) -> Iterator[Suspicion]:
    """Compare the fundamental of the table's acceleration with the demanded level.

    Of a swept sine it is that of its control channels.
    """
    swept = cycle.context.profile.swept_sine
    names = swept.control_channels if swept is not None else ("table_acc_m_s2",)
    if not cycle.has(*names) or cycle.level <= 0.0:
        return
    settings, measured = cycle.context.profile.protection, cycle.tones["table_acc_m_s2"].fundamental
    if swept is not None:
        rows = np.array([cycle.clean_channel(name) for name in names])
        fits = track_channels(rows, cycle.phase, TRACKED_HARMONICS)
        amplitudes = {name: fit.fundamental for name, fit in zip(names, fits, strict=True)}
        measured = combine_levels(swept, amplitudes, cycle.omega)
    error = measured / cycle.level - 1.0
    subject = "table" if swept is None else "level"
    message = f"{subject} at {measured:.4g} m/s2, demanded {cycle.level:.4g} m/s2"
    # Before the measured cycles the level may still be converging.
    if abs(error) > settings.alarm and cycle.label == Label.MEASURE:
        limit = math.copysign(settings.alarm, error)
        text = f"{message}: {100 * error:+.1f} %; allowed: +-{100 * settings.alarm:g} %"
        yield Suspicion("level", names[0], measured, (1 + limit) * cycle.level, text, "alarm", 1)
    error_db = 20 * math.log10(max(measured / cycle.level, 1e-9))
    if abs(error_db) > settings.abort_db:
        limit = math.copysign(settings.abort_db, error_db)
        text = f"{message}: {error_db:+.1f} dB; allowed: +-{settings.abort_db:g} dB"
        bound = 10 ** (limit / 20) * cycle.level
        yield Suspicion("level", names[0], measured, bound, text, "stop")


def check_command_gain(cycle: DriveCycle) -> Iterator[Suspicion]:
    """Compare the gain of the command read back with 1.

    It covers commands too small for the check of every sample.
    """
    commanded = cycle.tones["command"].fundamental
    if not cycle.has("drive_disp_m") or commanded == 0.0:
        return
    limit = MAX_READ_BACK_ERROR + cycle.context.rig.output.lsb_m / commanded
    gain = cycle.tones["drive_disp_m"].fundamental / commanded
    if abs(gain - 1.0) > limit:
        text = f"the command read back is {gain:.3f} of what was queued; allowed: +-{limit:.3f}"
        yield Suspicion("command", "drive_disp_m", gain, 1 + math.copysign(limit, gain - 1), text)


def measure_transfer(cycle: DriveCycle, low_cut: float) -> tuple[complex, complex]:
    """Return (table displacement, table acceleration) over the command, complex; NaN if lost.

    The acceleration is converted to displacement (-1/w^2), in front of the low cut of its sensor in
    rad/s.
    """
    command = complex(cycle.tones["command"].amplitudes[0])
    transfers = []
    from_acceleration = -(cycle.omega**-2) * (1.0 - 1j * low_cut / cycle.omega)
    for name, scale in (("table_disp_m", 1.0), ("table_acc_m_s2", from_acceleration)):
        measurable = cycle.has(name) and command != 0
        tone = scale * complex(cycle.tones[name].amplitudes[0])
        transfers.append(tone / command if measurable else complex("nan"))
    return transfers[0], transfers[1]


def check_response(
    cycle: DriveCycle, transfers: tuple[complex, complex], reference: complex
) -> Iterator[Suspicion]:
    """Compare the table's response to its command with the reference.

    If oil pressure falls, the lag of a servo grows before its amplitude decreases.
    """
    ratios = [transfer / reference for transfer in transfers]
    if not all(math.isfinite(abs(ratio)) and ratio for ratio in ratios):
        return
    lag_s = phase_lag_s(reference, cycle.omega)
    deflection = payload_deflection(cycle, lag_s)
    gain = min(map(abs, ratios), key=lambda ratio: abs(ratio - 1.0))
    max_change = MAX_GAIN_CHANGE + deflection
    # Both sensors must show the change; if only one does, it is a fault of that sensor.
    if abs(gain - 1.0) > max_change:
        text = f"the gain of the table is {gain:.2f} times its earlier value; "
        text += f"allowed: +-{100 * max_change:.0f} %"
        yield Suspicion(
            "response", "table_acc_m_s2", gain, 1 + math.copysign(max_change, gain - 1), text
        )
    extra_lag_s = min((-np.angle(ratio) / cycle.omega for ratio in ratios), key=abs)
    limit = max(MAX_LAG_CHANGE_RATIO * lag_s, MAX_LAG_CHANGE_S) + deflection / cycle.omega
    if abs(extra_lag_s) > limit:
        allowed_s = lag_s + math.copysign(limit, extra_lag_s)
        text = (
            f"the table lags {1e3 * (lag_s + extra_lag_s):.1f} ms behind its command, "
            f"{1e3 * lag_s:.1f} ms before; allowed: {1e3 * allowed_s:.1f} ms"
        )
        yield Suspicion("response", "table_disp_m", lag_s + extra_lag_s, allowed_s, text)


def payload_deflection(cycle: DriveCycle, lag_s: float) -> float:
    """Return the table displacement caused by the specimen, relative to the table's amplitude.

    M / m a / p^2 with p = 2 / lag of a servo with a double pole p.
    """
    if not cycle.has("mass_acc_m_s2", "table_disp_m"):
        return 0.0
    context = cycle.context
    a = track_harmonics(
        cycle.clean_channel("mass_acc_m_s2"), cycle.phase, TRACKED_HARMONICS
    ).fundamental
    ratio = context.profile.specimen.mass_kg / context.rig.moving_mass_kg
    return ratio * a * (0.5 * lag_s) ** 2 / cycle.tones["table_disp_m"].fundamental


def phase_lag_s(ratio: complex, omega: float) -> float:
    """Return the lag of a response in s."""
    return float(-np.angle(ratio)) / omega


MIN_FREE_SAMPLES = 5  # without contact, in a cycle
MIN_TENSION_RATIO = 2.0  # of the pulses of compression, above which a cell is reversed
MIN_SWING_SIGMAS = 20.0  # times the noise: force from which sharing is evaluated
BASELINE_CHECKS = 20  # ten cycles with contact, over which the baseline is averaged
MAX_ANGLE_CHANGE_RAD = math.radians(3.0)  # a tenth more or less force on one of two cells
MAX_UNEVEN_ANGLE_RAD = math.radians(
    25.0
)  # from equal shares while there is no baseline: one cell bears a third of the other


@dataclass(frozen=True, slots=True)
class ForceShare:
    """Baseline of force sharing on a side: angle in rad and means in N, over `check_count`."""

    angle: float
    means: tuple[float, float]
    check_count: int = 1

    def update(self, fit: CellPairFit) -> "ForceShare":
        """Return the baseline with one more fit; fixed after BASELINE_CHECKS."""
        if self.check_count >= BASELINE_CHECKS:
            return self
        weight = 1.0 / (self.check_count + 1)
        angle = self.angle + weight * (fit.angle - self.angle)
        first, second = (
            mean + weight * (new - mean) for mean, new in zip(self.means, fit.means, strict=True)
        )
        return ForceShare(angle, (first, second), self.check_count + 1)


def check_cell_pairs(
    cycle: DriveCycle, shares: Mapping[str, ForceShare]
) -> tuple[list[Suspicion], dict[str, ForceShare]]:
    """Check the load cells of both sides: return (suspicions, force sharing by side)."""
    suspicions: list[Suspicion] = []
    updated = dict(shares)
    u = cycle.relative_displacement()
    gaps = cycle.context.profile.specimen.gaps_m
    for side, sign, gap in ((RIGHT_CELLS, 1.0, gaps[0]), (LEFT_CELLS, -1.0, gaps[1])):
        present = [name for name in side if cycle.has(name)]
        if u is not None and gap > 0:
            free = sign * u < 0
            bearing = list(_check_unloaded_cells(cycle, present, free))
            suspicions += (
                bearing if len(bearing) < max(len(present), 2) else [_suspect_displacement(bearing)]
            )
            if reversed_cells := [name for name in present if _shows_tension(cycle, name, free)]:
                suspicions.append(_suspect_polarity(cycle, reversed_cells))
                continue
        if len(present) < 2:
            continue
        noise = max(cycle.sigma(name) for name in side)
        fit = fit_cell_pair(cycle.clean_channel(side[0]), cycle.clean_channel(side[1]), noise)
        if fit.rms > MIN_SWING_SIGMAS * noise and fit.rms > 0:
            share = updated.get(side[0])
            changes = list(_check_share_change(cycle, side, fit, share))
            if not changes:
                updated[side[0]] = share.update(fit) if share else ForceShare(fit.angle, fit.means)
            suspicions += changes
    return suspicions, updated


def _check_unloaded_cells(
    cycle: DriveCycle, names: list[str], free: npt.NDArray[np.bool_]
) -> Iterator[Suspicion]:
    """Check that cells bear no force while the mass is on the other side of the middle.

    With a positive gap there is no contact then.
    """
    count = int(free.sum())
    if count < MIN_FREE_SAMPLES:
        return
    for name in names:
        force = float(cycle.clean_channel(name)[free].mean())
        limit = MAX_CELL_OFFSET_RATIO * cycle.context.profile.comparison.contact_n
        limit += 6.0 * cycle.sigma(name) / math.sqrt(count)
        if abs(force) > limit:
            yield suspect_drift(name, force, limit, "N")


def _shows_tension(cycle: DriveCycle, name: str, free: npt.NDArray[np.bool_]) -> bool:
    """Return whether a cell shows pulses of tension, from its mean where its side is `free`."""
    if int(free.sum()) < MIN_FREE_SAMPLES:
        return False
    force = cycle.clean_channel(name)
    unloaded = float(force[free].mean())
    least = max(cycle.context.profile.comparison.contact_n, MIN_SWING_SIGMAS * cycle.sigma(name))
    tension = unloaded - float(force.min())
    return tension > max(least, MIN_TENSION_RATIO * (float(force.max()) - unloaded))


def _suspect_polarity(cycle: DriveCycle, names: list[str]) -> Suspicion:
    tension = max(-float(cycle.clean_channel(name).min()) for name in names)
    text = (
        f"{' and '.join(names)} in tension where the bumper presses, {format_si(tension, 'N')}: "
        "turn the cells around, or change the sign of volts_per_unit in the rig file"
    )
    return Suspicion("polarity", names[0], -tension, 0.0, text)


def _suspect_displacement(suspicions: list[Suspicion]) -> Suspicion:
    """Suspect a displacement sensor where all cells of a side show force without contact."""
    first = suspicions[0]
    text = (
        f"{' and '.join(suspicion.channel for suspicion in suspicions)} bear "
        f"{format_si(first.value, 'N')} on the other side of the gap: the "
        "displacement of the mass or of the table has drifted"
    )
    return Suspicion("drift", "mass_disp_m", first.value, first.limit, text)


def _check_share_change(
    cycle: DriveCycle, side: tuple[str, str], fit: CellPairFit, share: ForceShare | None
) -> Iterator[Suspicion]:
    """Yield a suspicion if two cells share the force of their side differently than before."""
    expected, max_change = (
        (share.angle, MAX_ANGLE_CHANGE_RAD) if share else (math.pi / 4, MAX_UNEVEN_ANGLE_RAD)
    )
    change = fit.angle - expected
    if abs(change) > max_change + 6.0 * fit.sigma_angle:
        # The cell with less force is suspected, although the other one may read too high.
        channel = side[0] if fit.means[0] < fit.means[1] else side[1]
        measured_percent, expected_percent = (
            100 / (1 + math.tan(angle)) for angle in (fit.angle, expected)
        )
        text = f"{side[0]} bears {measured_percent:.0f} % of its sum with {side[1]}; "
        text += f"expected: {expected_percent:.0f} %"
        limit = expected + math.copysign(max_change, change)
        yield Suspicion("share", channel, fit.angle, limit, text, group=side[0])
        return
    if share is None:
        return
    first, second = (
        measured - baseline for measured, baseline in zip(fit.means, share.means, strict=True)
    )
    deviation = second * math.cos(share.angle) - first * math.sin(share.angle)
    uncertainty = fit.sigma_angle / math.sqrt(share.check_count) * math.hypot(first, second)
    limit = MAX_CELL_OFFSET_RATIO * cycle.context.profile.comparison.contact_n * math.sqrt(2.0)
    limit += 6.0 * math.hypot(uncertainty, 2.0 * fit.sigma)
    if abs(deviation) > limit:
        yield suspect_drift(side[0] if deviation < 0 else side[1], abs(deviation), limit, "N")
