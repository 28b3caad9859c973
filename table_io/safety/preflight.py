"""Pre-flight check: demands of a drive against the limits of the rig, before anything moves."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from decimal import ROUND_DOWN, Context

import numpy as np

from table_io.block import Float2D, Label
from table_io.config.excitation import History
from table_io.config.excitation.drive_file import DRIVE_KEY, DRIVE_REMEDY
from table_io.config.excitation.waveform import smoothstep
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.config.sensor import CLIP_RATIO
from table_io.control.orbit_feedback import MAX_COMMAND_RATIO
from table_io.control.table_response import evaluate_gain
from table_io.errors import InputError
from table_io.excitation.drive import Drive, HistorySegment, Segment, envelope_acceleration
from table_io.records import FrequencyResponse, Step
from table_io.safety.loop_check import is_below_friction, list_known_faults, plan_targets
from table_io.units import GRAVITY_M_S2

LOOP_CHECK = "loop check"
STOP_POINTS = 1000  # stops of a history, and points of each, that are evaluated
CORRECTION_HEADROOM = 1.2  # factor of amplitude correction for which stroke should remain
PAYLOAD_RATIO_RANGE = (0.01, 2.0)  # plausible mass of a specimen over the table's moving mass


@dataclass(frozen=True, slots=True)
class StepDemand:
    """Peak demands of one step, its blends included; SI, `amplitude_lsb` in DAC steps.

    The motions of the loop check have step -1 and direction "loop check". Of a displacement
    history, `step` is a window, or for the worst stop in motion the number of windows, `direction`
    names it, and the frequency is NaN.
    """

    step: int
    direction: str
    frequency_hz: float
    displacement_m: float  # of the command; the other peaks are those of the resulting motion
    velocity_m_s: float
    acceleration_m_s2: float
    force_n: float
    amplitude_lsb: float

    @property
    def name(self) -> str:
        """Label of the step for messages."""
        if self.step < 0:
            return f"{self.direction} ({self.frequency_hz:g} Hz)"
        if math.isnan(self.frequency_hz):
            return self.direction
        return f"step {self.step} ({self.frequency_hz:g} Hz {self.direction})"


@dataclass(frozen=True, slots=True)
class RigLimit:
    """A limit of the rig in its display unit, and the demand that it bounds."""

    name: str
    unit: str
    allowed: float
    demand: Callable[[StepDemand], float]


def list_limits(rig: RigConfig) -> tuple[RigLimit, ...]:
    """List the limits of a rig: displacement, velocity, acceleration, force, flow if stated."""
    limits = rig.limits
    area_m2, flow_l_min = (limits.piston_area_cm2 or 0.0) * 1e-4, limits.peak_flow_l_min
    flow = RigLimit(
        "flow", "l/min", flow_l_min or math.inf, lambda row: row.velocity_m_s * area_m2 * 6e4
    )
    stroke = min(limits.stroke_mm, rig.output.span_mm)
    return (
        RigLimit("displacement", "mm", stroke, lambda row: row.displacement_m * 1e3),
        RigLimit("velocity", "mm/s", limits.velocity_mm_s, lambda row: row.velocity_m_s * 1e3),
        RigLimit(
            "acceleration",
            "g",
            limits.acceleration_g,
            lambda row: row.acceleration_m_s2 / GRAVITY_M_S2,
        ),
        RigLimit("force", "kN", limits.force_kn, lambda row: row.force_n * 1e-3),
        *([flow] if flow_l_min is not None else []),
    )


def compute_demands(drive: Drive, profile: Profile, rig: RigConfig) -> tuple[StepDemand, ...]:
    """Compute the peak demands of each motion of the loop check, then of each step.

    Peaks are those of an ideal table over the held cycles and the blend before them. Steps that
    are not in the drive yet count with their held cycles only.
    """
    check_peaks: dict[float, list[tuple[float, float, float]]] = {}
    step_peaks: dict[int, list[tuple[float, float, float]]] = {}
    for segment in drive.sine_segments:
        peaks = _segment_peaks(segment, drive.rate_hz)
        if segment.step < 0:
            check_peaks.setdefault(segment.f1, []).append(peaks)
        else:
            step_peaks.setdefault(segment.step, []).append(peaks)
    mass = rig.moving_mass_kg + profile.specimen.mass_kg
    check_levels = {
        segment.f1: segment.level1
        for segment in drive.sine_segments
        if segment.step < 0 and segment.level1
    }
    rows = [
        _build_demand(Step(-1, LOOP_CHECK, f, check_levels[f]), segment_peaks, mass, rig)
        for f, segment_peaks in sorted(check_peaks.items())
    ]
    for step in drive.steps:
        peaks_of_step = step_peaks.get(step.index, [_steady_peaks(step)])
        largest = tuple(max(values) for values in zip(*peaks_of_step, strict=True))
        peaks_of_step = [_add_feedback(profile, step, largest)]
        rows.append(_build_demand(step, peaks_of_step, mass, rig))
    if profile.swept_sine is not None:
        rows += _sweep_demands(drive, step_peaks, mass, rig)
    for history in drive.segments:
        if isinstance(history, HistorySegment):
            rows += _history_demands(history, drive.rate_hz, mass, rig)
    return tuple(rows)


def _sweep_demands(
    drive: Drive, peaks: dict[int, list[tuple[float, float, float]]], mass: float, rig: RigConfig
) -> list[StepDemand]:
    """Return the demands of each part of a swept sine, named by its frequencies."""
    rows = []
    for window, peaks_of_window in sorted(peaks.items()):
        ends = [f for s in drive.sine_segments if s.step == window for f in (s.f0, s.f1)]
        d, v, a = (max(values) for values in zip(*peaks_of_window, strict=True))
        name = f"{min(ends):.3g} to {max(ends):.3g} Hz"
        rows.append(StepDemand(window, name, math.nan, d, v, a, mass * a, d / rig.output.lsb_m))
    return rows


def _add_feedback(
    profile: Profile, step: Step, peaks: tuple[float, ...]
) -> tuple[float, float, float]:
    """Return the bounds of (displacement, velocity, acceleration) with a feedback, if any, SI.

    The amplitude of the feedback is limited to a share of the held step, and the acceleration of
    both together (`control/orbit_feedback.py`). |q'| <= sqrt(2 max|q| max|q''|) for any motion that
    begins and ends at rest. A stop multiplies both, which are close to a sine, by its decay.
    """
    if profile.continuation is None:
        return peaks[0], peaks[1], peaks[2]
    (d, _, a), rate_hz = _steady_peaks(step), profile.acquisition.rate_hz
    stop = Segment(0, 1, Label.STOP, step.index, step.frequency_hz, step.frequency_hz, a, 0.0, 0.0)
    stop = replace(stop, count=stop.decay_samples(0.0, rate_hz))
    decaying = envelope_acceleration(stop, np.linspace(0.0, 1.0, 401), rate_hz)
    displacement = peaks[0] + profile.continuation.max_feedback * d
    acceleration = MAX_COMMAND_RATIO * float(decaying.max())
    velocity = math.sqrt(2.0 * displacement * acceleration)
    return (displacement, velocity, max(peaks[2], acceleration))


def _history_demands(
    history: HistorySegment, rate_hz: float, mass: float, rig: RigConfig
) -> list[StepDemand]:
    """Return the demands of each window of a history, then those of the worst stop in it."""
    x = np.arange(history.count) / history.count
    motion = (history.displacement(x, rate_hz), *history.motion(x, rate_hz))
    window, _, _ = history.labels(x, rate_hz)
    peaks = [
        tuple(float(np.abs(row[window == k]).max()) for row in motion)
        for k in range(history.windows)
    ]
    names = [f"window {k}" for k in range(history.windows)]
    worst_stop = _worst_stop(history, np.array(motion), rate_hz)
    return [
        StepDemand(step, name, math.nan, d, v, a, mass * a, d / rig.output.lsb_m)
        for step, (name, (d, v, a)) in enumerate(
            zip((*names, "a stop"), (*peaks, worst_stop), strict=True)
        )
    ]


def _worst_stop(
    history: HistorySegment, motion: Float2D, rate_hz: float
) -> tuple[float, float, float]:
    """Return the peak (displacement, velocity, acceleration) of a decay from anywhere, SI."""
    length = history.decay_samples(0.0, rate_hz)
    stops = np.arange(0, history.count, max(history.count // STOP_POINTS, 1))
    peaks = np.zeros(3)
    for x in np.arange(STOP_POINTS + 1) / STOP_POINTS:
        at = np.rint(stops + x * length).astype(np.int64)
        d, v, a = np.where(at < history.count, motion[:, np.minimum(at, history.count - 1)], 0.0)
        factor = 1.0 - float(smoothstep(np.array([x]))[0])
        slope = -30.0 * x**2 * (1.0 - x) ** 2 * rate_hz / length
        curvature = -60.0 * x * (1.0 - x) * (1.0 - 2.0 * x) * (rate_hz / length) ** 2
        stopped = d * factor, v * factor + d * slope, a * factor + 2 * v * slope + d * curvature
        peaks = np.maximum(peaks, np.abs(stopped).max(axis=1))
    return float(peaks[0]), float(peaks[1]), float(peaks[2])


def _build_demand(
    step: Step, peaks: list[tuple[float, float, float]], mass: float, rig: RigConfig
) -> StepDemand:
    d, v, a = (max(values) for values in zip(*peaks, strict=True))
    lsb = _steady_peaks(step)[0] / rig.output.lsb_m
    return StepDemand(step.index, step.direction, step.frequency_hz, d, v, a, mass * a, lsb)


def _steady_peaks(step: Step) -> tuple[float, float, float]:
    """Return the amplitudes of (displacement, velocity, acceleration) of a held step, SI."""
    w = 2 * math.pi * step.frequency_hz
    a = step.acceleration_m_s2
    return a / w**2, a / w, a


def _segment_peaks(segment: Segment, rate_hz: float) -> tuple[float, float, float]:
    """Return the peak (displacement, velocity, acceleration) of a segment, SI."""
    points = int(min(segment.count, 200 * max(segment.cycles, 4)))
    x = np.linspace(0.0, 1.0, points + 1)
    v, a = segment.motion(x, rate_hz)
    d = segment.displacement(x, rate_hz)
    return float(abs(d).max()), float(abs(v).max()), float(abs(a).max())


def check_limits(
    rows: tuple[StepDemand, ...], profile: Profile, rig: RigConfig, source: str
) -> None:
    """Raise an InputError with step, limit and remedy for every limit that is exceeded."""
    has_points = getattr(profile.excitation, "level_points", ())
    level_key = "sweep.level_points" if has_points else "sweep.acceleration_g"
    faults = [
        *_find_rate_faults(profile, rig),
        *_find_exceeded_limits(rows, rig, _suggest_level(rows, profile, rig), level_key),
        *_find_clipped_sensors(rows, rig),
        *_find_coarse_outputs(rows, rig, level_key),
        *(
            InputError(
                sentence,
                where="loop check",
                remedy="raise the level, use a quieter sensor or a smaller range, or correct "
                "noise_rms in the rig file; a tare out of date is replaced by `shaketwin tare`",
            )
            for sentence in list_known_faults(profile, rig)
        ),
    ]
    if faults:
        raise InputError(
            f"the table {rig.name!r} cannot do this test; nothing was started",
            where=source,
            faults=tuple(faults),
        )


def check_drive_rig(profile: Profile, rig: RigConfig, source: str) -> None:
    """Raise an InputError if the drive of a history was computed for another rig."""
    excitation = profile.excitation
    if not isinstance(excitation, History) or excitation.drive_header is None:
        return
    rigs = [made_for.name for made_for in excitation.drive_header.provenance.rigs]
    if rigs and rig.name not in rigs:
        raise InputError(
            f"{excitation.drive} is a drive for rig {rigs[0]!r}, the test is for rig {rig.name!r}; "
            "nothing was started",
            where=source,
            key=DRIVE_KEY,
            allowed=f"a drive computed with a table twin of {rig.name!r}",
            remedy=f"run it with the rig file of {rigs[0]!r}, or compute a drive for {rig.name!r}: "
            "shaketwin table-drive PROFILE --table-twin FILE",
        )


def _list_drive_changes(profile: Profile, rig: RigConfig) -> list[str]:
    """List how rig and specimen of a test differ from those that its drive was computed for."""
    excitation = profile.excitation
    if not isinstance(excitation, History) or excitation.drive is None:
        return []
    header, drive = excitation.drive_header, f"the drive {excitation.drive}"
    if header is None or not header.provenance.rigs:
        return [f"{drive} does not say which rig it was computed for; {DRIVE_REMEDY}"]
    made_for = header.provenance
    gap_mm = 1e3 * sum(profile.specimen.gaps_m)
    return [
        *made_for.list_rig_changes(rig, drive),
        *made_for.list_mass_changes(profile.specimen.mass_kg, drive),
        *made_for.list_gap_changes(gap_mm, drive),
    ]


def _find_coarse_outputs(
    rows: tuple[StepDemand, ...], rig: RigConfig, level_key: str
) -> list[InputError]:
    """List a fault if the smallest step or the peak of a history is too few steps of the DAC."""
    steps = [row for row in rows if row.step >= 0 and row.frequency_hz > 0]
    histories = [row for row in rows if math.isnan(row.frequency_hz)]
    candidates = []
    if steps:
        coarsest = min(steps, key=lambda row: row.amplitude_lsb)
        candidates.append(
            (
                coarsest.amplitude_lsb,
                f"step {coarsest.step} ({coarsest.frequency_hz:g} Hz)",
                "amplitude",
                f"raise {level_key}, lower sweep.stop_hz,",
            )
        )
    if histories:
        peak_lsb = max(row.amplitude_lsb for row in histories)
        candidates.append((peak_lsb, "the peak of the history", "displacement", "raise its level,"))
    return [
        InputError(
            f"{size_lsb:.1f} steps of the DAC",
            where=where,
            key=key,
            allowed=f"at least {rig.output.least_lsb}",
            remedy=f"{advice} or use an output with more bits or a smaller span",
        )
        for size_lsb, where, key, advice in candidates
        if size_lsb < rig.output.least_lsb
    ]


def _find_rate_faults(profile: Profile, rig: RigConfig) -> list[InputError]:
    """List a fault for each rate or frequency that the rig does not support."""
    faults = []
    if profile.acquisition.rate_hz not in rig.rates_hz:
        rates = ", ".join(f"{rate:g}" for rate in rig.rates_hz)
        faults.append(
            InputError(
                "not a rate of this table",
                key="acquisition.rate_hz",
                value=profile.acquisition.rate_hz,
                allowed=rates,
            )
        )
    per_cycle, high_hz = profile.excitation.MIN_SAMPLES_PER_CYCLE, profile.plan.high_hz
    if profile.acquisition.rate_hz < per_cycle * high_hz:
        faults.append(
            InputError(
                f"{profile.acquisition.rate_hz:g} Hz gives fewer than {per_cycle:g} samples per "
                f"cycle at the highest frequency, {high_hz:g} Hz",
                key="acquisition.rate_hz",
                allowed=f"at least {per_cycle * high_hz:g}",
            )
        )
    max_hz = rig.limits.frequency_hz
    top_key = "sweep.stop_hz" if profile.steps else "upper end of the excitation's band"
    requested_hz = {top_key: high_hz}
    if profile.loop_check.enabled and profile.loop_check.frequencies_hz:
        requested_hz["loop_check.frequencies_hz"] = max(profile.loop_check.frequencies_hz)
    faults += [
        InputError("too fast for this table", key=key, value=f, allowed=f"at most {max_hz:g}")
        for key, f in requested_hz.items()
        if f > max_hz
    ]
    return faults


def _suggest_level(rows: tuple[StepDemand, ...], profile: Profile, rig: RigConfig) -> str:
    """Return the remedy for a history beyond the limits: the largest level that fits them all.

    All demands of a history are in proportion to its level, those of its worst stop included.
    """
    history = [row for row in rows if math.isnan(row.frequency_hz)]
    bounds = [(limit.demand, limit.allowed) for limit in list_limits(rig)]
    bounds += [
        (TABLE_SENSORS[sensor.channel], sensor.clipping_level_si)
        for sensor in rig.sensors
        if sensor.channel in TABLE_SENSORS
    ]
    shares = [allowed / peak for row in history for demand, allowed in bounds
              if (peak := demand(row)) > 0.0]  # fmt: skip
    share = min(shares, default=1.0)
    excitation = profile.excitation
    key = "level_points" if getattr(excitation, "level_points", ()) else excitation.LEVEL_KEY
    level = getattr(excitation, key, None) if key else None
    if isinstance(level, int | float):
        return f"the largest that fits: {key} = {_round_towards_zero(level * share):g}"
    return f"multiply {key or 'the history'} by {_round_towards_zero(share):g}, which fits"


def _round_towards_zero(value: float) -> float:
    """Return a value with three significant digits, none larger than it in magnitude."""
    return float(Context(prec=3, rounding=ROUND_DOWN).create_decimal_from_float(value))


def _find_exceeded_limits(
    rows: tuple[StepDemand, ...],
    rig: RigConfig,
    history_remedy: str = "",
    level_key: str = "sweep.acceleration_g",
) -> list[InputError]:
    """List a fault per exceeded limit: its first row and the number of further rows."""
    faults = []
    for limit in list_limits(rig):
        exceeding = [row for row in rows if limit.demand(row) > limit.allowed]
        if exceeding:
            first = exceeding[0]
            suffix = f" and {len(exceeding) - 1} more" if len(exceeding) > 1 else ""
            remedy = (
                "raise loop_check.frequencies_hz or lower loop_check.level"
                if first.step < 0
                else history_remedy
                if math.isnan(first.frequency_hz)
                else f"lower {level_key} or raise sweep.start_hz"
            )
            faults.append(
                InputError(
                    f"{limit.demand(first):.4g} {limit.unit}",
                    where=f"{first.name}{suffix}",
                    key=limit.name,
                    allowed=f"at most {limit.allowed:g} {limit.unit}",
                    remedy=remedy,
                )
            )
    return faults


def _find_clipped_sensors(rows: tuple[StepDemand, ...], rig: RigConfig) -> list[InputError]:
    """List a fault for each sensor of the table that the drive would clip."""
    faults = []
    for sensor in rig.sensors:
        if sensor.channel not in TABLE_SENSORS:
            continue
        worst = max(rows, key=TABLE_SENSORS[sensor.channel])
        peak = TABLE_SENSORS[sensor.channel](worst)
        if peak >= sensor.clipping_level_si:
            faults.append(
                InputError(
                    f"{peak / sensor.si_per_unit:.4g} {sensor.unit}",
                    where=worst.name,
                    key=sensor.channel,
                    allowed=f"below {CLIP_RATIO:g} of its range, {sensor.range:g} {sensor.unit}",
                    remedy="lower the level, or use a sensor with a larger range",
                )
            )
    return faults


TABLE_SENSORS: dict[str, Callable[[StepDemand], float]] = {
    "drive_disp_m": lambda row: row.displacement_m,
    "table_disp_m": lambda row: row.displacement_m,
    "table_acc_m_s2": lambda row: row.acceleration_m_s2,
}


def list_drive_warnings(rows: tuple[StepDemand, ...], rig: RigConfig) -> list[str]:
    """List warnings about low DAC resolution and missing headroom for amplitude correction."""
    messages = []
    steps = [row for row in rows if row.step >= 0 and row.frequency_hz > 0]
    coarse = [row for row in steps if row.amplitude_lsb < rig.output.warn_lsb]
    if coarse:
        lowest = min(coarse, key=lambda row: row.amplitude_lsb)
        messages.append(
            f"{len(coarse)} steps have an amplitude below {rig.output.warn_lsb} DAC steps "
            f"(least: {lowest.amplitude_lsb:.0f} at {lowest.frequency_hz:g} Hz); their motion may "
            "be coarse"
        )
    stroke = list_limits(rig)[0]
    tight = [row for row in steps if CORRECTION_HEADROOM * stroke.demand(row) > stroke.allowed]
    if tight:
        messages.append(
            f"{tight[0].name}: {stroke.demand(tight[0]):.4g} mm of {stroke.allowed:g} mm leave no "
            f"room to correct the command by {100 * (CORRECTION_HEADROOM - 1):.0f} %"
        )
    return messages


def list_setup_warnings(profile: Profile, rig: RigConfig) -> list[str]:
    """List warnings about implausible values of specimen, loop check or buffer, and the drive."""
    messages = []
    mass_ratio = profile.specimen.mass_kg / rig.moving_mass_kg
    if not PAYLOAD_RATIO_RANGE[0] <= mass_ratio <= PAYLOAD_RATIO_RANGE[1]:
        messages.append(
            f"specimen.mass_kg {profile.specimen.mass_kg:g} is {mass_ratio:.3g} times the moving "
            f"mass of the table, {rig.moving_mass_kg:g} kg; is it in kg?"
        )
    max_gap_m = max(
        (abs(gap) for gap in profile.specimen.gaps_m if math.isfinite(gap)), default=0.0
    )
    if max_gap_m * 1e3 > rig.limits.stroke_mm:
        messages.append(
            f"a gap of {max_gap_m * 1e3:g} mm per side exceeds the stroke of the table, "
            f"{rig.limits.stroke_mm:g} mm; is it in mm?"
        )
    targets = plan_targets(profile, rig) if profile.loop_check.enabled else ()
    requested_hz = max(profile.loop_check.frequencies_hz, default=profile.plan.high_hz)
    if targets and max(target.frequency_hz for target in targets) < 0.999 * requested_hz:
        highest_hz = max(target.frequency_hz for target in targets)
        messages.append(
            f"the loop check ends at {highest_hz:.3g} Hz: at {requested_hz:g} Hz its level has "
            f"fewer than {rig.output.least_lsb} DAC steps; the response above {highest_hz:.3g} Hz "
            "is extrapolated"
        )
    if is_below_friction(profile, rig):
        messages.append(
            f"the level is {profile.plan.level_m_s2 / GRAVITY_M_S2:.3g} g at most, below "
            f"table_response.least_level_g = {rig.table_response.least_level_g:g}: friction shapes "
            "what this table plays, and the loop check takes no gain as too low, nor delays as too "
            "far apart; raise the level"
        )
    if {"acceleration_g", "level_points"} <= profile.excitation.model_fields_set:
        kind = profile.excitation.kind
        messages.append(f"{kind}: acceleration_g is not used beside level_points")
    messages += rig.backend_section.warnings
    messages += _list_drive_changes(profile, rig)
    block_s = profile.acquisition.block_samples / profile.acquisition.rate_hz
    if block_s > rig.output.lead_s / 4:
        messages.append(
            f"a block lasts {block_s:g} s, so {rig.output.lead_s:g} s of queued command are fewer "
            "than four blocks; lower acquisition.block_samples"
        )
    return messages


def find_correction_room(
    profile: Profile, rig: RigConfig, frequency_hz: float, level_m_s2: float
) -> float:
    """Return the largest correction of a level in m/s2 whose command is within a rig's limits."""
    demand = _command_demand(profile, Step(0, "forward", frequency_hz, level_m_s2), 1.0)
    peaks = [(limit.allowed, limit.demand(demand)) for limit in list_limits(rig)]
    return min((allowed / peak for allowed, peak in peaks if peak > 0.0), default=math.inf)


def _command_demand(profile: Profile, step: Step, correction: float) -> StepDemand:
    """Return the demands of the corrected command of a held step, which moves no mass itself."""
    d, v, a = (correction * peak for peak in _add_feedback(profile, step, _steady_peaks(step)))
    return StepDemand(step.index, step.direction, step.frequency_hz, d, v, a, 0.0, math.inf)


def check_corrected_drive(
    profile: Profile, steps: tuple[Step, ...], response: FrequencyResponse, rig: RigConfig
) -> list[str]:
    """List a message per limit that the command corrected for the measured response exceeds.

    The table then moves as demanded, but its command is larger by 1 / gain. So displacement,
    velocity and acceleration of the command are compared with the limits of the rig, and 1 / gain
    with the largest correction that the gains which it accepts allow.
    """
    max_correction = rig.table_response.max_correction
    rows, excessive = [], []
    for step in steps:
        correction = 1.0 / evaluate_gain(response, step.frequency_hz)
        rows.append(_command_demand(profile, step, correction))
        if correction > max_correction:
            excessive.append((correction, rows[-1]))
    faults = [
        f"corrected for the table's response, {fault}"
        for fault in _find_exceeded_limits(tuple(rows), rig)
    ]
    if excessive:
        correction, row = max(excessive, key=lambda item: item[0])
        faults.append(
            f"{row.name}: the table follows with a gain of {1.0 / correction:.3g}, so the command "
            f"would have to be {correction:.3g} times as large; "
            f"allowed: at most {max_correction:g}, see table_response.top_gain of the rig. "
            "Lower sweep.stop_hz, or tune the servo"
        )
    return faults
