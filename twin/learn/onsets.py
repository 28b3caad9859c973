"""Gaps from where the mass was when a bumper began to bear and when it ceased to.

Where the load cells of a side cross a threshold T the bumper's law says how deep the mass was:

    u_j = (T - C_j v) / K_j        v the speed into the bumper, > 0 at an onset, < 0 at a release

so G0j = |u| - u_j. At an onset F jumps to C_j v at the face itself: u_j = 0 where C_j v > T. The
crossings are taken from the samples as they came, u and v from the fused motion. Of the fit only
this correction is used, which is small: an estimate of its own beside that of the force law.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from table_io.block import Block, Float1D, Int1D
from table_io.channels import contact_forces
from twin.learn.guess import Guess
from twin.learn.sheet import CONTACT_NOISES, Sheet

SURELY_S = 0.005  # free for so long before an onset, and bearing most of so long after it
SIDES = ("right", "left")
LEAST = 5  # crossings from which a mean is told


@dataclass(frozen=True, eq=False)
class Onsets:
    """Gap of one side of a log in m, (crossing,) each, from onsets or from releases.

    `depth` is the correction u_j that was made, in m.
    """

    log: int
    side: str
    kind: str  # "onset" or "release"
    gaps: Float1D
    depth: Float1D

    @property
    def value(self) -> float:
        """The median, in m: a grazing touch is no measure."""
        return float(np.median(self.gaps))

    @property
    def scatter(self) -> float:
        """Standard deviation of one crossing in m, robust."""
        return float(1.4826 * np.median(np.abs(self.gaps - self.value)))

    @property
    def sd(self) -> float:
        """Standard deviation of the median in m."""
        return 1.25 * self.scatter / math.sqrt(self.gaps.size)


def onsets(
    sheet: Sheet,
    blocks: Sequence[Block],
    laws: tuple[tuple[float, float], tuple[float, float]],
    guess: Guess,
) -> tuple[Onsets, ...]:
    """What the crossings of a log say; none without load cells, or where nothing lets go.

    `laws` are K_j in N/m and C_j in N s/m of the right and of the left bumper; the guess says
    where u is zero.
    """
    m = sheet.motion()
    if not m.cells:
        return ()
    found = []
    position = m.u - guess.zero(sheet.number, "u")
    for side, law in enumerate(laws):
        sign = 1.0 if side == 0 else -1.0
        rms = (m.noise.right, m.noise.left)[side]
        for way, kind in ((1, "onset"), (-1, "release")):
            times, level = [], 0.0
            for block in blocks:
                force = sign * contact_forces(block)[side]
                level = _level(force, block, sheet, rms)
                times.append((_crossings(force > level, block.rate_hz, way) + block.index - 0.5)
                             / block.rate_hz)  # fmt: skip
            when = np.concatenate(times)
            place = np.searchsorted(m.time_s, when).clip(0, m.time_s.size - 1)
            when = when[m.moving[place]]
            if when.size < LEAST:
                continue
            u, v = (sign * np.interp(when, m.time_s, row) for row in (position, m.v))
            depth = (max(sheet.contact_n, CONTACT_NOISES * rms) - law[1] * v) / law[0]
            if way > 0:
                depth = np.maximum(depth, 0.0)
            found.append(Onsets(sheet.number, SIDES[side], kind, u - depth, depth))
    return tuple(found)


def _level(force: Float1D, block: Block, sheet: Sheet, rms: float) -> float:
    """Force in N above which a side bears, as in `Sheet.touched`; the cells' zero apart."""
    threshold = max(sheet.contact_n, CONTACT_NOISES * rms)
    rest = block.label == 0
    if min(sheet.readings.gaps_m) > 0 and rest.any():
        threshold += float(np.nanmedian(force[rest]))
    return threshold


def _crossings(bears: np.ndarray, rate_hz: float, way: int) -> Int1D:
    """First samples that bear (`way` 1) or no longer bear (-1), with no chatter about them."""
    n = max(round(SURELY_S * rate_hz), 1)
    sums = np.concatenate([[0], np.cumsum(bears)])
    at = np.flatnonzero(np.diff(bears.astype(np.int8)) == way) + 1
    at = at[(at >= n) & (at <= bears.size - n)]
    before, after = sums[at] - sums[at - n], sums[at + n] - sums[at]
    if way < 0:  # seen from the end it is an onset
        before, after = after, before
    sure: Int1D = at[(before == 0) & (after > n // 2)]
    return sure
