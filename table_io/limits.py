"""Margins of a drive against a machine card before anything moves, and the limits of each block."""

from dataclasses import dataclass

import numpy as np

from table_io.block import Block
from table_io.card import BadInput
from table_io.drive import Drive, Segment, displacement, motion
from table_io.profile import Profile
from table_io.rig import Rig
from table_io.units import GRAVITY_M_S2


@dataclass(frozen=True, slots=True)
class Margin:
    """What one step, its blends included, asks of the machine; SI, `lsb` DAC steps an amplitude."""

    step: int
    direction: str
    frequency_hz: float
    displacement_m: float
    velocity_m_s: float
    acceleration_m_s2: float
    force_n: float
    lsb: float


def margins(drive: Drive, profile: Profile, rig: Rig) -> tuple[Margin, ...]:
    """One Margin a step: peaks of the ideal table over its held cycles and the blend before it."""
    mass = rig.moving_mass_kg + profile.specimen.mass_kg
    peaks: dict[int, list[tuple[float, float, float]]] = {}
    for segment in drive.segments:
        peaks.setdefault(segment.step, []).append(_peaks(segment, drive.rate_hz))
    rows = []
    for step in drive.steps:
        d, v, a = (max(values) for values in zip(*peaks[step.index], strict=True))
        held = step.acceleration_m_s2 / (2 * np.pi * step.frequency_hz) ** 2
        rows.append(
            Margin(
                step.index,
                step.direction,
                step.frequency_hz,
                d,
                v,
                a,
                mass * a,
                held / rig.output.lsb_m,
            )
        )
    return tuple(rows)


def _peaks(segment: Segment, rate_hz: float) -> tuple[float, float, float]:
    """Peak (displacement, velocity, acceleration) of a segment, SI."""
    points = int(min(segment.count, 200 * max(segment.cycles, 4)))
    x = np.linspace(0.0, 1.0, points + 1)
    v, a = motion(segment, x, rate_hz)
    d = displacement(segment, x, rate_hz)
    return float(abs(d).max()), float(abs(v).max()), float(abs(a).max())


def refuse(rows: tuple[Margin, ...], profile: Profile, rig: Rig, where: str) -> None:
    """BadInput that names the step, the limit and the way out, if any limit is exceeded."""
    limits, faults = rig.limits, []
    if profile.acquisition.rate_hz not in rig.rates_hz:
        rates = ", ".join(f"{rate:g}" for rate in rig.rates_hz)
        faults.append(f"acquisition.rate_hz {profile.acquisition.rate_hz:g} Hz; allowed: {rates}")
    if profile.sweep.stop_hz > limits.frequency_hz:
        faults.append(
            f"sweep.stop_hz {profile.sweep.stop_hz:g} Hz; allowed: at most {limits.frequency_hz:g}"
        )
    checks = (
        ("displacement", "mm", 1e3, min(limits.stroke_mm, rig.output.span_mm), "displacement_m"),
        ("velocity", "mm/s", 1e3, limits.velocity_mm_s, "velocity_m_s"),
        ("acceleration", "g", 1 / GRAVITY_M_S2, limits.acceleration_g, "acceleration_m_s2"),
        ("force", "kN", 1e-3, limits.force_kn, "force_n"),
    )
    for name, unit, scale, limit, field in checks:
        beyond = [row for row in rows if getattr(row, field) * scale > limit]
        if beyond:
            first = beyond[0]
            more = f" and {len(beyond) - 1} more" if len(beyond) > 1 else ""
            faults.append(
                f"step {first.step} ({first.frequency_hz:g} Hz {first.direction}){more}: {name} "
                f"{getattr(first, field) * scale:.4g} {unit}; allowed: at most {limit:g} {unit}. "
                "Lower sweep.acceleration_g or raise sweep.start_hz"
            )
    coarse = min(rows, key=lambda row: row.lsb)
    if coarse.lsb < rig.output.least_lsb:
        faults.append(
            f"step {coarse.step} ({coarse.frequency_hz:g} Hz): amplitude is {coarse.lsb:.1f} steps "
            f"of the DAC; allowed: at least {rig.output.least_lsb}. Raise sweep.acceleration_g, "
            "lower sweep.stop_hz, or use an output with more bits or a smaller span"
        )
    if faults:
        head = f"{where}: the table {rig.name!r} cannot do this test; nothing was started"
        raise BadInput("\n".join([head, *(f"  {fault}" for fault in faults)]))


def warnings(rows: tuple[Margin, ...], rig: Rig) -> list[str]:
    """Sentences about what is allowed but deserves a look."""
    coarse = [row for row in rows if row.lsb < rig.output.warn_lsb]
    if not coarse:
        return []
    lowest = min(coarse, key=lambda row: row.lsb)
    return [
        f"{len(coarse)} steps have an amplitude below {rig.output.warn_lsb} DAC steps "
        f"(least: {lowest.lsb:.0f} at {lowest.frequency_hz:g} Hz)"
    ]


def tripped(block: Block, rig: Rig) -> str | None:
    """Why this block must stop the table, or None: stroke, acceleration, or a lost table sensor."""
    checks = (
        ("table_disp_m", rig.limits.stroke_mm * 1e-3, 1e3, "mm"),
        ("table_acc_m_s2", rig.limits.acceleration_g * GRAVITY_M_S2, 1 / GRAVITY_M_S2, "g"),
    )
    for name, limit, scale, unit in checks:
        values = np.abs(block.channel(name))
        if np.isnan(values).all():
            return f"{name} is lost from sample {block.index} on"
        beyond = np.flatnonzero(values > limit)
        if beyond.size:
            at = int(beyond[0])
            return (
                f"{name} = {values[at] * scale:.4g} {unit} at sample {block.index + at} exceeds "
                f"{limit * scale:.4g} {unit}"
            )
    return None
