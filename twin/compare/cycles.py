"""One forcing cycle -> its extremes and contact onsets; the cycles of a step -> its PRC point.

Measurement and twin go through the same functions, so an estimator's bias cancels in the
comparison. Peaks are taken from a short least-squares parabola, a tenth of the shortest half period
of the contact: noise does not lift them and a contact is not smeared.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from table_io.block import Float1D, Label
from table_io.records import Cycle, Extremes, Point, Quantities, Step
from table_io.units import GRAVITY_M_S2
from twin.model.parameters import Parameters

HARMONICS = 10


@dataclass(frozen=True)
class Scale:
    """What turns SI extremes into the ratios of the paper's Eq. 1."""

    parameters: Parameters
    rate_hz: float
    contact_n: float
    u_star_m: float
    a_star_m_s2: float
    gaps_m: tuple[float, float]  # (right, left) of the specimen, whatever the model thinks of them

    @cached_property
    def weights(self) -> Float1D:
        """Smoothing weights of a least-squares parabola, symmetric, odd length."""
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
    def lead(self) -> int:
        """Samples before a cycle that its extremes need: what the parabola cannot see of it.

        Without them a peak at the cut between two cycles is lost to both (3 % at 5 Hz). All of
        them lie before the cycle, so that it is finished when its last sample is there: what is
        searched is as long as the cycle and ends half a parabola earlier.
        """
        return self.weights.size - 1


def smooth(x: Float1D, weights: Float1D) -> Float1D:
    """Running least-squares parabola of x, (sample,), shorter by the ends that it cannot see."""
    return np.convolve(x, weights, "valid") if x.size >= weights.size else x


def onsets(
    force: Float1D, contact_n: float, touching: bool | None
) -> tuple[list[int], bool | None]:
    """(places where contact begins, whether it touches at the end) of a force >= 0.

    Contact begins above `contact_n` and ends below half of it, so noise counts nothing twice.
    Where `touching` before the first sample is not known (None), contact there is no onset.
    """
    states = np.full(force.size, -1, dtype=np.int8)
    states[force > contact_n] = 1
    states[force < 0.5 * contact_n] = 0
    known = np.flatnonzero(states >= 0)
    if not known.size:
        return [], touching
    levels = np.concatenate([states[known[:1]] if touching is None else [touching], states[known]])
    begins = known[np.flatnonzero(np.diff(levels) == 1)]
    return begins.tolist(), bool(levels[-1])


@dataclass(frozen=True, slots=True)
class Motion:
    """One source's motion over consecutive samples, SI: u, a, F_R >= 0, -F_L >= 0, (sample,)."""

    u: Float1D
    a: Float1D
    right: Float1D
    left: Float1D


Touching = tuple[bool | None, bool | None]  # right, left; None = not known
UNKNOWN: Touching = (None, None)


def extremes(
    motion: Motion, first: int, scale: Scale, touching: Touching, lead: int = 0
) -> tuple[Extremes | None, Touching]:
    """(extremes of one cycle whose first sample is `first`, contact state after it).

    The first `lead` samples of the motion come before the cycle, see `Scale.lead`. None where the
    displacement has lost samples. The extremes of an acceleration or a force that has lost some are
    NaN; contact at a lost sample is what it was before.
    """
    if not np.isfinite(motion.u).all():
        return None, UNKNOWN
    u, a = smooth(motion.u, scale.weights), smooth(motion.a, scale.weights)
    forces: list[float] = []
    begins: list[tuple[int, ...]] = []
    after: list[bool | None] = []
    for force, was in ((motion.right, touching[0]), (motion.left, touching[1])):
        forces.append(float(smooth(force, scale.weights).max()))
        places, now = onsets(force[lead:], scale.contact_n, was)
        begins.append(tuple(first + place for place in places))
        after.append(now)
    return Extremes(
        float(u.max()),
        float(u.min()),
        float(a.max()),
        float(a.min()),
        forces[0],
        forces[1],
        begins[0],
        begins[1],
    ), (after[0], after[1])


def _impacts(cycles: list[Cycle], all_onsets: list[int], before: bool) -> tuple[int, ...]:
    """Onsets per measured cycle, counted between cuts that lie in the longest time without one.

    A cut at the drive's zero crossing could split a contact's jitter over two cycles (0 and 2). The
    cuts lie up to a cycle early if the cycle `before` was seen too, else at most half a cycle off.
    """
    starts = [cycle.index - cycle.count for cycle in cycles]
    length = np.mean([cycle.count for cycle in cycles])
    inside = [place for place in all_onsets if place >= starts[0] - length]
    if not inside:
        return (0,) * len(cycles)
    phases = np.sort((np.array(inside) - starts[0]) / length % 1.0)
    gaps = np.diff(np.append(phases, phases[0] + 1.0))
    widest = int(np.argmax(gaps))
    shift = (phases[widest] + 0.5 * gaps[widest]) % 1.0
    offset = (shift - 1.0 if (shift > 0.0 if before else shift >= 0.5) else shift) * length
    return tuple(
        sum(1 for place in inside if 0 <= place - start - offset < cycle.count)
        for start, cycle in zip(starts, cycles, strict=True)
    )


def quantities(cycles: list[Cycle], source: str, scale: Scale) -> Quantities | None:
    """The ratios of Eq. 1 over the measured cycles of a step; None without a whole one.

    `source` is "measured" or "twin". What a lost sensor would have to tell is not told: NaN, and no
    impacts. A deformation is then that of the displacement alone.
    """
    used = [c for c in cycles if c.label == Label.MEASURE and getattr(c, source) is not None]
    if not used:
        return None
    some: list[Extremes] = [getattr(cycle, source) for cycle in used]
    every: list[Extremes] = [e for c in cycles if (e := getattr(c, source)) is not None]
    before = every[0] is not some[0]
    cells = all(np.isfinite(e.force_r + e.force_l) for e in some)
    p, u_star = scale.parameters, scale.u_star_m
    eta = np.array([(e.u_max - e.u_min) / (2 * u_star) for e in some])
    weight = p.mass * GRAVITY_M_S2

    gap_r, gap_l = scale.gaps_m if source == "measured" else (p.gap_r, p.gap_l)

    def deformation(depth: float, force: float) -> float:
        return 0.0 if force <= scale.contact_n else max(depth, 0.0) / u_star

    def ratio(force: float) -> float:
        return 0.0 if force <= scale.contact_n else force / weight

    return Quantities(
        eta_d=float(eta.mean()),
        eta_a=float(np.mean([(e.a_max - e.a_min) / (2 * scale.a_star_m_s2) for e in some])),
        eta_r=float(np.mean([deformation(e.u_max - gap_r, e.force_r) for e in some])),
        eta_l=float(np.mean([deformation(-e.u_min - gap_l, e.force_l) for e in some])),
        r_r=float(np.mean([ratio(e.force_r) for e in some])),
        r_l=float(np.mean([ratio(e.force_l) for e in some])),
        impacts_right=_impacts(used, [place for e in every for place in e.onsets_r], before)
        if cells
        else (),
        impacts_left=_impacts(used, [place for e in every for place in e.onsets_l], before)
        if cells
        else (),
        drift=float((eta[-1] - eta[0]) / eta.mean()),
        spread=float(np.ptp(eta) / eta.mean()),
    )


def table_motion(
    base_acc: Float1D, frequency_hz: float, rate_hz: float
) -> tuple[float, float, float]:
    """(peak in m/s2, fundamental amplitude in m/s2, THD) of the table over whole cycles.

    THD is the root sum of squares of harmonics 2 to 10 over the fundamental. A cycle is no whole
    number of samples, so the harmonics leak into each other (up to 1 % at 10 Hz); by how much is
    known, and undone: the result is that of a least-squares fit of all of them.
    """
    n = base_acc.size
    if n < 2 * HARMONICS + 1 or not np.isfinite(base_acc).all():
        return (float("nan"),) * 3
    turn = 2 * np.pi * frequency_hz / rate_hz
    waves = np.cumprod(np.tile(np.exp(-1j * turn * np.arange(n)), (HARMONICS, 1)), axis=0)
    seen = (waves * base_acc).mean(axis=1)
    orders = np.arange(-HARMONICS, HARMONICS + 1)
    half = 0.5 * turn * np.subtract.outer(orders, orders)
    # mean of exp(-2i half k) over the samples k: what a unit of one order shows in another
    leak = np.exp(-1j * (n - 1) * half) * np.sinc(n * half / np.pi) / np.sinc(half / np.pi)
    both = np.concatenate([seen[::-1].conj(), [base_acc.mean()], seen])
    amplitudes = 2 * np.abs(np.linalg.solve(leak, both)[HARMONICS + 1 :])
    return (
        float(np.abs(base_acc).max()),
        float(amplitudes[0]),
        float(np.sqrt(np.sum(np.square(amplitudes[1:]))) / amplitudes[0]),
    )


def point(step: Step, cycles: list[Cycle], base_acc: Float1D, scale: Scale) -> Point:
    """The PRC point of a step from its held cycles; `base_acc` of the measured ones."""
    peak, fundamental, thd = table_motion(base_acc, step.frequency_hz, scale.rate_hz)
    return Point(
        cycles[-1].index,
        step.index,
        step.direction,
        step.frequency_hz,
        quantities(cycles, "measured", scale),
        quantities(cycles, "twin", scale),
        peak,
        fundamental,
        thd,
    )
