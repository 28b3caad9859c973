"""Margins of a drive against a machine card, before anything moves."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from table_io.card import BadInput
from table_io.control import MOST
from table_io.drive import Drive, Segment, displacement, motion
from table_io.loop_check import aims
from table_io.profile import Profile
from table_io.records import Response, Step
from table_io.response import gain_at
from table_io.rig import Rig
from table_io.units import GRAVITY_M_S2

CHECK = "loop check"
ROOM = 1.2  # a correction of the command for which there should be room
PAYLOAD = (0.01, 2.0)  # mass of a specimen over the moving mass of the table


@dataclass(frozen=True, slots=True)
class Margin:
    """What one step, its blends included, asks of the machine; SI, `lsb` DAC steps an amplitude.

    Step -1 and direction "loop check" for the motions before the sweep.
    """

    step: int
    direction: str
    frequency_hz: float
    displacement_m: float  # of the command; the rest is the motion that it should give
    velocity_m_s: float
    acceleration_m_s2: float
    force_n: float
    lsb: float

    @property
    def name(self) -> str:
        """The row in words."""
        if self.step < 0:
            return f"{self.direction} ({self.frequency_hz:g} Hz)"
        return f"step {self.step} ({self.frequency_hz:g} Hz {self.direction})"


@dataclass(frozen=True, slots=True)
class Limit:
    """One thing that a machine can do only so much of, in the unit for people."""

    name: str
    unit: str
    allowed: float
    used: Callable[[Margin], float]


def limits_of(rig: Rig) -> tuple[Limit, ...]:
    """The limits of a machine card against which every row stands."""
    card = rig.limits
    stroke = min(card.stroke_mm, rig.output.span_mm)
    return (
        Limit("displacement", "mm", stroke, lambda row: row.displacement_m * 1e3),
        Limit("velocity", "mm/s", card.velocity_mm_s, lambda row: row.velocity_m_s * 1e3),
        Limit(
            "acceleration",
            "g",
            card.acceleration_g,
            lambda row: row.acceleration_m_s2 / GRAVITY_M_S2,
        ),
        Limit("force", "kN", card.force_kn, lambda row: row.force_n * 1e-3),
    )


def margins(drive: Drive, profile: Profile, rig: Rig) -> tuple[Margin, ...]:
    """One Margin for each motion of the loop check, then one a step.

    Peaks of the ideal table over held cycles and the blend before them; of a step that the drive
    does not reach yet, over held cycles alone.
    """
    check: dict[float, list[tuple[float, float, float]]] = {}
    swept: dict[int, list[tuple[float, float, float]]] = {}
    for segment in drive.segments:
        peaks = _peaks(segment, drive.rate_hz)
        if segment.step < 0:
            check.setdefault(segment.f1, []).append(peaks)
        else:
            swept.setdefault(segment.step, []).append(peaks)
    mass = rig.moving_mass_kg + profile.specimen.mass_kg
    level = {one.f1: one.level1 for one in drive.segments if one.step < 0 and one.level1}
    rows = [
        _row(Step(-1, CHECK, f, level[f]), found, mass, rig) for f, found in sorted(check.items())
    ]
    for step in drive.steps:
        rows.append(_row(step, swept.get(step.index, [_held(step)]), mass, rig))
    return tuple(rows)


def _row(step: Step, peaks: list[tuple[float, float, float]], mass: float, rig: Rig) -> Margin:
    d, v, a = (max(values) for values in zip(*peaks, strict=True))
    lsb = _held(step)[0] / rig.output.lsb_m
    return Margin(step.index, step.direction, step.frequency_hz, d, v, a, mass * a, lsb)


def _held(step: Step) -> tuple[float, float, float]:
    """Amplitudes of (displacement, velocity, acceleration) of a held step, SI."""
    w = 2 * math.pi * step.frequency_hz
    a = step.acceleration_m_s2
    return a / w**2, a / w, a


def _peaks(segment: Segment, rate_hz: float) -> tuple[float, float, float]:
    """Peak (displacement, velocity, acceleration) of a segment, SI."""
    points = int(min(segment.count, 200 * max(segment.cycles, 4)))
    x = np.linspace(0.0, 1.0, points + 1)
    v, a = motion(segment, x, rate_hz)
    d = displacement(segment, x, rate_hz)
    return float(abs(d).max()), float(abs(v).max()), float(abs(a).max())


def refuse(rows: tuple[Margin, ...], profile: Profile, rig: Rig, where: str) -> None:
    """BadInput that names the step, the limit and the way out, if any limit is exceeded."""
    faults = [*_rates(profile, rig), *_exceeded(rows, rig), *_out_of_range(rows, rig)]
    coarse = min((row for row in rows if row.step >= 0), key=lambda row: row.lsb)
    if coarse.lsb < rig.output.least_lsb:
        faults.append(
            f"step {coarse.step} ({coarse.frequency_hz:g} Hz): amplitude is {coarse.lsb:.1f} steps "
            f"of the DAC; allowed: at least {rig.output.least_lsb}. Raise sweep.acceleration_g, "
            "lower sweep.stop_hz, or use an output with more bits or a smaller span"
        )
    if faults:
        head = f"{where}: the table {rig.name!r} cannot do this test; nothing was started"
        raise BadInput("\n".join([head, *(f"  {fault}" for fault in faults)]))


def _rates(profile: Profile, rig: Rig) -> list[str]:
    """Rates and frequencies that the card does not have."""
    faults = []
    if profile.acquisition.rate_hz not in rig.rates_hz:
        rates = ", ".join(f"{rate:g}" for rate in rig.rates_hz)
        faults.append(f"acquisition.rate_hz {profile.acquisition.rate_hz:g} Hz; allowed: {rates}")
    most = rig.limits.frequency_hz
    asked = {"sweep.stop_hz": profile.sweep.stop_hz}
    if profile.loop_check.enabled and profile.loop_check.frequencies_hz:
        asked["loop_check.frequencies_hz"] = max(profile.loop_check.frequencies_hz)
    faults += [f"{key} {f:g} Hz; allowed: at most {most:g}" for key, f in asked.items() if f > most]
    return faults


def _exceeded(rows: tuple[Margin, ...], rig: Rig) -> list[str]:
    """One sentence for each limit that is exceeded: the first row, and how many more."""
    faults = []
    for limit in limits_of(rig):
        beyond = [row for row in rows if limit.used(row) > limit.allowed]
        if beyond:
            first = beyond[0]
            more = f" and {len(beyond) - 1} more" if len(beyond) > 1 else ""
            remedy = (
                "Raise loop_check.frequencies_hz or lower loop_check.level"
                if first.step < 0
                else "Lower sweep.acceleration_g or raise sweep.start_hz"
            )
            faults.append(
                f"{first.name}{more}: {limit.name} {limit.used(first):.4g} {limit.unit}; "
                f"allowed: at most {limit.allowed:g} {limit.unit}. {remedy}"
            )
    return faults


def _out_of_range(rows: tuple[Margin, ...], rig: Rig) -> list[str]:
    """Sensors of the table that would clip at what the drive asks for."""
    faults = []
    for sensor in rig.sensors:
        if sensor.channel not in TABLE_SENSORS:
            continue
        worst = max(rows, key=TABLE_SENSORS[sensor.channel])
        peak = TABLE_SENSORS[sensor.channel](worst) / sensor.si_per_unit
        if peak > sensor.range:
            faults.append(
                f"{worst.name}: {sensor.channel} {peak:.4g} {sensor.unit}; allowed: at most its "
                f"range, {sensor.range:g} {sensor.unit}. Lower sweep.acceleration_g, or use a "
                "sensor with a larger range"
            )
    return faults


TABLE_SENSORS: dict[str, Callable[[Margin], float]] = {
    "drive_disp_m": lambda row: row.displacement_m,
    "table_disp_m": lambda row: row.displacement_m,
    "table_acc_m_s2": lambda row: row.acceleration_m_s2,
}


def warnings(rows: tuple[Margin, ...], rig: Rig) -> list[str]:
    """Sentences about what is allowed but deserves a look."""
    said = []
    steps = [row for row in rows if row.step >= 0]
    coarse = [row for row in steps if row.lsb < rig.output.warn_lsb]
    if coarse:
        lowest = min(coarse, key=lambda row: row.lsb)
        said.append(
            f"{len(coarse)} steps have an amplitude below {rig.output.warn_lsb} DAC steps "
            f"(least: {lowest.lsb:.0f} at {lowest.frequency_hz:g} Hz)"
        )
    stroke = limits_of(rig)[0]
    tight = [row for row in steps if ROOM * stroke.used(row) > stroke.allowed]
    if tight:
        said.append(
            f"{tight[0].name}: {stroke.used(tight[0]):.4g} mm of {stroke.allowed:g} mm leave no "
            f"room to correct the command by {100 * (ROOM - 1):.0f} %"
        )
    return said


def doubts(profile: Profile, rig: Rig) -> list[str]:
    """Sentences about what of the specimen, loop check or buffer hardly fits the machine."""
    said = []
    share = profile.specimen.mass_kg / rig.moving_mass_kg
    if not PAYLOAD[0] <= share <= PAYLOAD[1]:
        said.append(
            f"specimen.mass_kg {profile.specimen.mass_kg:g} is {share:.3g} of the table's own "
            f"{rig.moving_mass_kg:g} kg; is it in kg?"
        )
    reach = max((abs(gap) for gap in profile.specimen.gaps_m if math.isfinite(gap)), default=0.0)
    if reach * 1e3 > rig.limits.stroke_mm:
        said.append(
            f"a gap of {reach * 1e3:g} mm a side is more than the stroke of the table, "
            f"{rig.limits.stroke_mm:g} mm; is it in mm?"
        )
    motions = aims(profile, rig) if profile.loop_check.enabled else ()
    wanted = max(profile.loop_check.frequencies_hz, default=profile.sweep.stop_hz)
    if motions and max(aim.frequency_hz for aim in motions) < 0.999 * wanted:
        top = max(aim.frequency_hz for aim in motions)
        said.append(
            f"the loop check ends at {top:.3g} Hz: at {wanted:g} Hz a tenth of the level has fewer "
            f"than {rig.output.least_lsb} DAC steps; the response beyond it is extrapolated"
        )
    if rig.backend == "ni" and rig.ni is not None:
        said += rig.ni.doubts
    block_s = profile.acquisition.block_samples / profile.acquisition.rate_hz
    if block_s > rig.output.lead_s / 4:
        said.append(
            f"a block lasts {block_s:g} s and {rig.output.lead_s:g} s of command are queued ahead: "
            "fewer than four blocks; lower acquisition.block_samples"
        )
    return said


def recheck(steps: tuple[Step, ...], response: Response, rig: Rig) -> list[str]:
    """What the corrected command would exceed, in words, with the response of the loop check.

    The table then moves as demanded, but its command is larger by 1 / gain: so displacement,
    velocity and acceleration of the command are held against the card, and the correction against
    what amplitude control may do. Empty where all is within.
    """
    rows, hard = [], []
    for step in steps:
        correction = 1.0 / gain_at(response, step.frequency_hz)
        d, v, a = (correction * one for one in _held(step))
        rows.append(Margin(step.index, step.direction, step.frequency_hz, d, v, a, 0.0, math.inf))
        if correction > MOST:
            hard.append((correction, rows[-1]))
    faults = [
        f"corrected for the table's response, {fault}" for fault in _exceeded(tuple(rows), rig)
    ]
    if hard:
        correction, row = max(hard, key=lambda one: one[0])
        faults.append(
            f"{row.name}: the table follows with a gain of {1.0 / correction:.3g}, so the command "
            f"would have to be {correction:.3g} times as large; allowed: at most {MOST:g}. Lower "
            "sweep.stop_hz, or tune the servo"
        )
    return faults
