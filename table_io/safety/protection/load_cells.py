"""Load-cell checks of the protection: force sharing of a side, and offset without contact."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from table_io.channels import LEFT_CELLS, RIGHT_CELLS
from table_io.safety.protection.consistency import CellPairFit, fit_cell_pair
from table_io.safety.protection.cycle import DriveCycle, Suspicion, format_si, suspect_drift

MIN_SWING_SIGMAS = 20.0  # times the noise: force from which sharing is evaluated
BASELINE_CHECKS = 20  # ten cycles with contact, over which the baseline is averaged
MAX_ANGLE_CHANGE_RAD = math.radians(3.0)  # a tenth more or less force on one of two cells
MAX_UNEVEN_ANGLE_RAD = math.radians(
    25.0
)  # from equal shares while there is no baseline: one cell bears a third of the other
MAX_CELL_OFFSET_RATIO = 0.5  # of the contact threshold


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
            bearing = list(_check_unloaded_cells(cycle, present, sign * u < 0))
            suspicions += (
                bearing if len(bearing) < max(len(present), 2) else [_suspect_displacement(bearing)]
            )
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
    if count < 5:
        return
    for name in names:
        force = float(cycle.clean_channel(name)[free].mean())
        limit = MAX_CELL_OFFSET_RATIO * cycle.context.profile.comparison.contact_n
        limit += 6.0 * cycle.sigma(name) / math.sqrt(count)
        if abs(force) > limit:
            yield suspect_drift(name, force, limit, "N")


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
