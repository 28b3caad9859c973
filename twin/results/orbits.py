"""Orbits that a continuation measured, beside those of its plan: for the summary and the report."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import ValidationError

from table_io.block import Float1D
from table_io.config.excitation import find_excitation
from table_io.config.excitation.continuation import Continuation, OrbitPlan
from table_io.errors import InputError
from table_io.records import OrbitPoint
from twin.recording.reader import Recording
from twin.results.contracts import MeasuredFold, OrbitResult, PlannedOrbitEntry

FOLD_ORBITS = 2  # on either side of a fold, to which a parabola is fitted
MAX_FOLD_DISTANCE = 0.025  # of the frequency of a fold to theirs: a parabola holds close to it only


def summarise_orbits(recording: Recording, plan: OrbitPlan) -> list[OrbitResult]:
    """Return the measured orbits next to those of the plan, in order of measurement."""
    return [_summarise_orbit(orbit, plan) for orbit in recording.records(OrbitPoint)]


def _summarise_orbit(orbit: OrbitPoint, plan: OrbitPlan) -> OrbitResult:
    feedback = orbit.feedback_size_m
    planned = plan.points[orbit.step]
    return OrbitResult(
        index=orbit.step,
        frequency_hz=orbit.frequency_hz,
        acceleration_m_s2=orbit.acceleration_m_s2,
        amplitude_m=orbit.amplitude_m,
        fundamental_m=math.hypot(*orbit.u_m[2:4]),
        phase_deg=90.0 + math.degrees(math.atan2(orbit.u_m[3], orbit.u_m[2])),
        feedback_m=feedback,
        feedback_share=feedback / orbit.command_m,
        feedback_harmonics_m=list(orbit.feedback_m),
        noise_m=orbit.noise_m,
        periods=orbit.periods,
        updates=orbit.updates,
        accepted=orbit.accepted,
        reason=orbit.reason,
        stable=orbit.stable,
        multiplier=orbit.multiplier,
        multiplier_sd=orbit.multiplier_sd,
        planned=PlannedOrbitEntry(
            frequency_hz=planned.frequency_hz,
            amplitude_m=planned.amplitude_m,
            multiplier=planned.multiplier_size,
        ),
    )


def find_measured_folds(orbits: Sequence[OrbitResult]) -> list[MeasuredFold]:
    """Return the folds between measured orbits of one branch.

    Where the plan turns from stable to unstable, a parabola of the frequency over the amplitude
    of u is fitted to the accepted orbits, up to FOLD_ORBITS on either side. None is stated without
    an orbit on either side, or where the parabola turns outside of its orbits or far from them.
    """
    accepted = [orbit for orbit in orbits if orbit.accepted]
    amplitudes = np.array([orbit.amplitude_m for orbit in accepted])
    frequencies = np.array([orbit.frequency_hz for orbit in accepted])
    is_stable = np.array([orbit.stable for orbit in accepted], dtype=bool)
    folds = []
    for last in np.flatnonzero(is_stable[1:] != is_stable[:-1]).tolist():
        near = slice(max(last + 1 - FOLD_ORBITS, 0), last + 1 + FOLD_ORBITS)
        x, y = amplitudes[near] / amplitudes[last], frequencies[near]
        if x.size < 3:
            continue
        parabola = np.polynomial.Polynomial.fit(x, y, 2)
        turns = parabola.deriv().roots()
        if not turns.size:  # three orbits on a straight line
            continue
        turn = float(turns[0])
        fold_hz = float(parabola(turn))
        is_near = np.abs(y - fold_hz).max() <= MAX_FOLD_DISTANCE * fold_hz
        if not (x.min() < turn < x.max() and is_near):
            continue
        folds.append(
            MeasuredFold(
                kind="lower" if parabola.deriv(2)(turn) > 0 else "upper",
                frequency_hz=fold_hz,
                amplitude_m=turn * float(amplitudes[last]),
                orbits=int(x.size),
            )
        )
    return folds


@dataclass(frozen=True, eq=False)
class PlannedBranch:
    """Planned orbits: Hz, m, whether stable, largest Floquet multiplier; (orbit,) each.

    is_backbone: in phase resonance by level, not along a branch at one level.
    """

    frequencies_hz: Float1D
    amplitudes_m: Float1D
    stable: np.ndarray[tuple[int], np.dtype[np.bool_]]
    multipliers: Float1D
    is_backbone: bool


def read_planned_branch(profile_tables: dict[str, Any]) -> PlannedBranch | None:
    """Return the branch of the plan in a recorded profile; None without one."""
    try:
        table = profile_tables.get("excitation") or {}
        kind = find_excitation(table.get("kind"))
        if not issubclass(kind, Continuation):
            return None
        plan = kind.model_validate(table).orbit_plan
    except (ValidationError, InputError):
        return None
    return PlannedBranch(
        np.array([orbit.frequency_hz for orbit in plan.points]),
        np.array([orbit.amplitude_m for orbit in plan.points]),
        np.array([orbit.stable for orbit in plan.points]),
        np.array([orbit.multiplier_size for orbit in plan.points]),
        plan.condition == "phase",
    )
