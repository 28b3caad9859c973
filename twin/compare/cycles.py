"""Extremes and contact onsets of a forcing cycle; PRC point of a step from its cycles.

Measurement and twin go through the same functions, so an estimator's bias cancels in the
comparison. Peaks come from a short least-squares parabola, a tenth of the shortest half period of
the contact, so that noise hardly raises them and contacts are not smeared. Where all cycles are
alike, the peaks of the measured u are those of its harmonics, which noise does not raise.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from table_io.block import Float1D, Float2D, Label
from table_io.harmonics import find_steady_extremes
from table_io.records import CycleExtremes, Extremes, NormalizedResponse, PrcPoint, Step
from table_io.units import GRAVITY_M_S2
from twin.model.parameters import Parameters

MAX_HARMONIC = 10


@dataclass(frozen=True)
class PrcScale:
    """Scales that turn SI extremes into the ratios of the paper's Eq. 1."""

    parameters: Parameters
    rate_hz: float
    contact_n: float
    u_star_m: float
    a_star_m_s2: float
    gaps_m: tuple[float, float]  # (right, left) of the specimen as stated, not of the model

    @cached_property
    def smoothing_weights(self) -> Float1D:
        """Weights of a smoothing least-squares parabola, symmetric, odd length."""
        p = self.parameters
        stiffness = p.stiffness
        for gap, bumper in ((p.gap_r, p.bumper_stiffness_r), (p.gap_l, p.bumper_stiffness_l)):
            stiffness += bumper if np.isfinite(gap) else 0.0
        half_period = np.pi * np.sqrt(p.mass / stiffness) * self.rate_hz
        half = int(np.clip(half_period / 20, 1, 16))
        x = np.arange(-half, half + 1.0)
        basis = np.array([np.ones_like(x), x, x * x])
        return np.asarray(np.linalg.solve(basis @ basis.T, basis)[0])

    @property
    def lead_samples(self) -> int:
        """Number of samples before a cycle that its extremes need, because smoothing drops ends.

        Without them a peak at the boundary of two cycles is lost to both (3 % at 5 Hz). All of
        them lie before the cycle, so that it is complete with its last sample: the searched
        interval is as long as the cycle and ends half a parabola earlier.
        """
        return self.smoothing_weights.size - 1


def smooth(x: Float1D, weights: Float1D) -> Float1D:
    """Smooth x, (sample,), by a running least-squares parabola; drops the ends."""
    return np.convolve(x, weights, "valid") if x.size >= weights.size else x


def detect_onsets(
    force: Float1D, contact_n: float, in_contact: bool | None
) -> tuple[list[int], bool | None]:
    """Detect contact of a force >= 0: return (onset indices, contact state at the end).

    Contact begins above `contact_n` and ends below half of it, so that noise adds no onsets.
    If `in_contact` before the first sample is unknown (None), contact there is no onset.
    """
    states = np.full(force.size, -1, dtype=np.int8)
    states[force > contact_n] = 1
    states[force < 0.5 * contact_n] = 0
    known = np.flatnonzero(states >= 0)
    if not known.size:
        return [], in_contact
    levels = np.concatenate(
        [states[known[:1]] if in_contact is None else [in_contact], states[known]]
    )
    onset_indices = known[np.flatnonzero(np.diff(levels) == 1)]
    return onset_indices.tolist(), bool(levels[-1])


@dataclass(frozen=True, slots=True)
class CycleMotion:
    """Motion of one source over consecutive samples, SI: u, a, F_R >= 0, -F_L >= 0, (sample,)."""

    u: Float1D
    a: Float1D
    right: Float1D
    left: Float1D


ContactState = tuple[bool | None, bool | None]  # right, left; None = unknown
UNKNOWN_CONTACT: ContactState = (None, None)


def cycle_extremes(
    motion: CycleMotion, first: int, scale: PrcScale, contact: ContactState, lead_samples: int = 0
) -> tuple[Extremes | None, ContactState]:
    """Return (extremes of the cycle whose first sample is `first`, contact state after it).

    The first `lead_samples` samples of the motion come before the cycle, see
    `PrcScale.lead_samples`. Extremes are None if displacement samples are lost; those of an
    acceleration or force with lost samples are NaN. Contact does not change at a lost sample.
    """
    if not np.isfinite(motion.u).all():
        return None, UNKNOWN_CONTACT
    u, a = smooth(motion.u, scale.smoothing_weights), smooth(motion.a, scale.smoothing_weights)
    forces: list[float] = []
    onsets: list[tuple[int, ...]] = []
    after: list[bool | None] = []
    for force, was_in_contact in ((motion.right, contact[0]), (motion.left, contact[1])):
        forces.append(float(smooth(force, scale.smoothing_weights).max()))
        indices, is_in_contact = detect_onsets(
            force[lead_samples:], scale.contact_n, was_in_contact
        )
        onsets.append(tuple(first + index for index in indices))
        after.append(is_in_contact)
    ends = (float(u.max()), float(u.min()), float(a.max()), float(a.min()))
    return Extremes(*ends, forces[0], forces[1], onsets[0], onsets[1]), (after[0], after[1])


OnsetDepths = tuple[Float2D, Float2D]  # (right, left), each (2, onset) in m
NO_ONSETS: OnsetDepths = (np.empty((2, 0)), np.empty((2, 0)))
NO_SAMPLES: Float1D = np.empty(0)


def extract_onset_depths(motion: CycleMotion, extremes: Extremes | None, first: int) -> OnsetDepths:
    """Return u, towards each bumper, at the samples before and at each contact onset.

    `first` is the index of the first sample of the motion.
    """
    if extremes is None:
        return NO_ONSETS
    depths = []
    for sign, onsets in ((1, extremes.onsets_r), (-1, extremes.onsets_l)):
        at = np.array([index - first for index in onsets if index > first], dtype=np.int64)
        depths.append(sign * np.array([motion.u[at - 1], motion.u[at]]))
    return depths[0], depths[1]


def correct_gaps(scale: PrcScale, onsets: Sequence[OnsetDepths]) -> tuple[float, float]:
    """Return the gaps (right, left) in m that the contact onsets of a step allow.

    A contact begins between two samples, and later by the deformation at which the force passes the
    threshold. A stated gap within this interval, averaged over the onsets, stays; another is moved
    to its nearest end.
    """
    p, gaps = scale.parameters, []
    for side, stiffness in enumerate((p.bumper_stiffness_r, p.bumper_stiffness_l)):
        depths = np.concatenate([NO_ONSETS[side], *(pair[side] for pair in onsets)], axis=1)
        gap = scale.gaps_m[side]
        if depths.size and math.isfinite(gap):
            before, at = depths.mean(axis=1).tolist()
            gap = min(max(gap, before - scale.contact_n / stiffness), at)
        gaps.append(gap)
    return gaps[0], gaps[1]


def _impacts_per_cycle(
    cycles: list[CycleExtremes], all_onsets: list[int], has_cycle_before: bool
) -> tuple[int, ...]:
    """Count onsets per measured cycle, between cuts in the longest interval without onsets.

    A cut at the drive's zero crossing could split the jitter of a contact over two cycles (0 and
    2). Cuts lie up to a cycle early if the previous cycle is known, else at most half a cycle off.
    """
    starts = [cycle.index - cycle.count for cycle in cycles]
    length = np.mean([cycle.count for cycle in cycles])
    onsets = [index for index in all_onsets if index >= starts[0] - length]
    if not onsets:
        return (0,) * len(cycles)
    phases = np.sort((np.array(onsets) - starts[0]) / length % 1.0)
    gaps = np.diff(np.append(phases, phases[0] + 1.0))
    widest = int(np.argmax(gaps))
    shift = (phases[widest] + 0.5 * gaps[widest]) % 1.0
    offset = (
        shift - 1.0 if (shift > 0.0 if has_cycle_before else shift >= 0.5) else shift
    ) * length
    return tuple(
        sum(1 for index in onsets if 0 <= index - start - offset < cycle.count)
        for start, cycle in zip(starts, cycles, strict=True)
    )


def normalized_response(
    cycles: list[CycleExtremes],
    source: str,
    scale: PrcScale,
    steady_m: tuple[float, float] | None = None,
) -> NormalizedResponse | None:
    """Return the ratios of Eq. 1 over the measured cycles of a step; None without a whole one.

    `source` is "measured" or "twin", `steady_m` (max u, min u) of cycles that are alike. Quantities
    of a lost sensor are NaN, without impacts; deformations then come from the displacement alone.
    """
    used = [c for c in cycles if c.label == Label.MEASURE and getattr(c, source) is not None]
    if not used:
        return None
    used_extremes: list[Extremes] = [getattr(cycle, source) for cycle in used]
    all_extremes: list[Extremes] = [e for c in cycles if (e := getattr(c, source)) is not None]
    has_cycle_before = all_extremes[0] is not used_extremes[0]
    has_forces = all(np.isfinite(e.force_r + e.force_l) for e in used_extremes)
    p, u_star = scale.parameters, scale.u_star_m
    eta = np.array([(e.u_max - e.u_min) / (2 * u_star) for e in used_extremes])
    motions = [(e, steady_m or (e.u_max, e.u_min)) for e in used_extremes]
    eta_a = np.array([(e.a_max - e.a_min) / (2 * scale.a_star_m_s2) for e in used_extremes])
    weight = p.mass * GRAVITY_M_S2

    gap_r, gap_l = scale.gaps_m if source == "measured" else (p.gap_r, p.gap_l)

    def deformation(depth: float, force: float) -> float:
        return 0.0 if force <= scale.contact_n else max(depth, 0.0) / u_star

    def ratio(force: float) -> float:
        return 0.0 if force <= scale.contact_n else force / weight

    return NormalizedResponse(
        eta_d=float(np.mean([top - low for _, (top, low) in motions]) / (2 * u_star)),
        eta_a=float(eta_a.mean()),
        eta_r=float(np.mean([deformation(top - gap_r, e.force_r) for e, (top, _) in motions])),
        eta_l=float(np.mean([deformation(-low - gap_l, e.force_l) for e, (_, low) in motions])),
        r_r=float(np.mean([ratio(e.force_r) for e in used_extremes])),
        r_l=float(np.mean([ratio(e.force_l) for e in used_extremes])),
        impacts_right=_impacts_per_cycle(
            used, [index for e in all_extremes for index in e.onsets_r], has_cycle_before
        )
        if has_forces
        else (),
        impacts_left=_impacts_per_cycle(
            used, [index for e in all_extremes for index in e.onsets_l], has_cycle_before
        )
        if has_forces
        else (),
        drift=float((eta[-1] - eta[0]) / eta.mean()),
        spread=float(np.ptp(eta) / eta.mean()),
        # a dead accelerometer has no mean to relate to
        spread_a=float(np.ptp(eta_a) / eta_a.mean()) if eta_a.mean() > 0 else None,
    )


def measure_table_motion(
    base_acc: Float1D, frequency_hz: float, rate_hz: float
) -> tuple[float, float, float]:
    """Return (peak in m/s2, fundamental amplitude in m/s2, THD) of the table over whole cycles.

    THD is the root sum of squares of harmonics 2 to 10 over the fundamental. A cycle is not a whole
    number of samples, so harmonics leak into each other (up to 1 % at 10 Hz). The leakage is known
    and inverted: the result is that of a least-squares fit of all harmonics.
    """
    n = base_acc.size
    if n < 2 * MAX_HARMONIC + 1 or not np.isfinite(base_acc).all():
        return (float("nan"),) * 3
    phase_step = 2 * np.pi * frequency_hz / rate_hz
    waves = np.cumprod(np.tile(np.exp(-1j * phase_step * np.arange(n)), (MAX_HARMONIC, 1)), axis=0)
    projections = (waves * base_acc).mean(axis=1)
    orders = np.arange(-MAX_HARMONIC, MAX_HARMONIC + 1)
    half = 0.5 * phase_step * np.subtract.outer(orders, orders)
    # mean of exp(-2i half k) over the samples k: leakage of a unit of one order into another
    leakage = np.exp(-1j * (n - 1) * half) * np.sinc(n * half / np.pi) / np.sinc(half / np.pi)
    two_sided = np.concatenate([projections[::-1].conj(), [base_acc.mean()], projections])
    amplitudes = 2 * np.abs(np.linalg.solve(leakage, two_sided)[MAX_HARMONIC + 1 :])
    return (
        float(np.abs(base_acc).max()),
        float(amplitudes[0]),
        float(np.sqrt(np.sum(np.square(amplitudes[1:]))) / amplitudes[0]),
    )


def build_prc_point(
    step: Step,
    cycles: list[CycleExtremes],
    base_acc: Float1D,
    scale: PrcScale,
    onsets: Sequence[OnsetDepths] = (),
    u_m: Float1D = NO_SAMPLES,
) -> PrcPoint:
    """Build the PRC point of a step from its held cycles; `base_acc` of the measured ones.

    `onsets` are those of the measurement, which correct its gaps and with them eta_j; `u_m` is the
    measured u over all measured cycles, (sample,).
    """
    scale = replace(scale, gaps_m=correct_gaps(scale, onsets))
    peak, fundamental, thd = measure_table_motion(base_acc, step.frequency_hz, scale.rate_hz)
    phase = step.frequency_hz / scale.rate_hz * np.arange(u_m.size, dtype=np.float64)
    return PrcPoint(
        cycles[-1].index,
        step.index,
        step.direction,
        step.frequency_hz,
        normalized_response(cycles, "measured", scale, find_steady_extremes(u_m, phase)),
        normalized_response(cycles, "twin", scale),
        peak,
        fundamental,
        thd,
    )
