"""Gap estimates from the positions of contact onset and release.

Where the load cells of a side cross a threshold T, the bumper law gives the depth:

    u_j = (T - C_j v) / K_j        v the speed into the bumper, > 0 at an onset, < 0 at a release

so G0j = |u| - u_j. At an onset F jumps to C_j v at the bumper face itself: u_j = 0 where C_j v > T.
The crossings are taken from the raw samples, u and v from the fused motion. The fit enters only
through this small correction, so the estimate is nearly independent of that from the force law.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from table_io.block import Block, Float1D, Int1D
from table_io.channels import LEFT_CELLS, RIGHT_CELLS, contact_forces
from twin.discovery.parameters import ParameterSet
from twin.discovery.residuals import LogResiduals

DEBOUNCE_S = 0.005  # no contact for this time before an onset, and mostly contact after it
SIDE_NAMES = ("right", "left")
MIN_CROSSINGS = 5  # for an estimate


@dataclass(frozen=True, eq=False)
class ContactGaps:
    """Gaps of one side of a log in m from its onsets or its releases, (crossing,).

    `depth` is the correction u_j in m, (crossing,).
    """

    log: int
    side: str
    kind: str  # "onset" or "release"
    gaps: Float1D
    depth: Float1D

    @property
    def value(self) -> float:
        """Median in m, robust to grazing contacts."""
        return float(np.median(self.gaps))

    @property
    def scatter(self) -> float:
        """Robust standard deviation of one crossing in m (1.4826 MAD)."""
        return float(1.4826 * np.median(np.abs(self.gaps - self.value)))

    @property
    def std_error(self) -> float:
        """Standard error of the median in m."""
        return 1.25 * self.scatter / math.sqrt(self.gaps.size)


def estimate_contact_gaps(
    residuals: LogResiduals,
    blocks: Sequence[Block],
    laws: tuple[tuple[float, float], tuple[float, float]],
    parameters: ParameterSet,
) -> tuple[ContactGaps, ...]:
    """Estimate the gaps of a log from its crossings; none without load cells or crossings.

    `laws` are K_j in N/m and C_j in N s/m of the right and of the left bumper; `parameters` supply
    the tare error of u.
    """
    m = residuals.motion()
    if not m.has_load_cells:
        return ()
    estimates = []
    position = m.u - parameters.tare_error(residuals.log_number, "u")
    channels = residuals.signals.channels
    for side, law in enumerate(laws):
        if not any(cell in channels for cell in (RIGHT_CELLS, LEFT_CELLS)[side]):
            continue  # a side without a bumper
        sign = 1.0 if side == 0 else -1.0
        for edge, kind in ((1, "onset"), (-1, "release")):
            times, level = [], 0.0
            for block in blocks:
                force = sign * contact_forces(block)[side]
                level = _contact_threshold(force, block, residuals, side)
                times.append(
                    (_find_crossings(force > level, block.rate_hz, edge) + block.index - 0.5)
                    / block.rate_hz
                )
            crossing_s = np.concatenate(times)
            index = np.searchsorted(m.time_s, crossing_s).clip(0, m.time_s.size - 1)
            crossing_s = crossing_s[m.moving[index]]
            if crossing_s.size < MIN_CROSSINGS:
                continue
            u, v = (sign * np.interp(crossing_s, m.time_s, row) for row in (position, m.v))
            depth = (residuals.contact_thresholds_n[side] - law[1] * v) / law[0]
            if edge > 0:
                depth = np.maximum(depth, 0.0)
            estimates.append(
                ContactGaps(residuals.log_number, SIDE_NAMES[side], kind, u - depth, depth)
            )
    return tuple(estimates)


def _contact_threshold(force: Float1D, block: Block, residuals: LogResiduals, side: int) -> float:
    """Return the contact threshold of a side in N, as in `LogResiduals.contact_state`.

    The reading of the load cells at rest is added to it.
    """
    threshold = residuals.contact_thresholds_n[side]
    rest = block.label == 0
    if min(residuals.signals.gaps_m) > 0 and rest.any():
        threshold += float(np.nanmedian(force[rest]))
    return threshold


def _find_crossings(loaded: np.ndarray, rate_hz: float, edge: int) -> Int1D:
    """Return the first samples in contact (`edge` 1) or out of contact (-1), debounced."""
    window = max(round(DEBOUNCE_S * rate_hz), 1)
    sums = np.concatenate([[0], np.cumsum(loaded)])
    samples = np.flatnonzero(np.diff(loaded.astype(np.int8)) == edge) + 1
    samples = samples[(samples >= window) & (samples <= loaded.size - window)]
    before, after = sums[samples] - sums[samples - window], sums[samples + window] - sums[samples]
    if edge < 0:  # a release is an onset in reversed time
        before, after = after, before
    confirmed: Int1D = samples[(before == 0) & (after > window // 2)]
    return confirmed
