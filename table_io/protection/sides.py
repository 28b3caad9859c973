"""What one look finds at the load cells: how two of them share the force of their side, and what
they show where nothing can touch them.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from table_io.channels import LEFT_CELLS, RIGHT_CELLS
from table_io.protection.consistency import Shared, shared
from table_io.protection.cycle import Cycle, Doubt, drifted, spoken

SWING = 20.0  # times the noise: a force that tells how it is shared
LEARNT = 20  # looks, ten cycles with contact, over which it is learnt
ANGLE = math.radians(3.0)  # a tenth more or less force on one of two cells
UNEVEN = math.radians(25.0)  # off equal shares where nothing is known yet: one bears a third
CELL_OFFSET = 0.5  # of the force that counts as contact


@dataclass(frozen=True, slots=True)
class Share:
    """How the cells of a side share their force: angle in rad, means in N, from so many looks."""

    angle: float
    means: tuple[float, float]
    looks: int = 1

    def after(self, seen: Shared) -> "Share":
        """With one more look, until it is learnt: from then on it must not change."""
        if self.looks >= LEARNT:
            return self
        part = 1.0 / (self.looks + 1)
        angle = self.angle + part * (seen.angle - self.angle)
        first, second = (
            m + part * (new - m) for m, new in zip(self.means, seen.means, strict=True)
        )
        return Share(angle, (first, second), self.looks + 1)


def cells(cycle: Cycle, before: Mapping[str, Share]) -> tuple[list[Doubt], dict[str, Share]]:
    """(doubts, how the cells of each side share their force)."""
    doubts: list[Doubt] = []
    known = dict(before)
    u = cycle.relative()
    gaps = cycle.bench.profile.specimen.gaps_m
    for side, sign, gap in ((RIGHT_CELLS, 1.0, gaps[0]), (LEFT_CELLS, -1.0, gaps[1])):
        present = [name for name in side if cycle.has(name)]
        if u is not None and gap > 0:
            bearing = list(_unloaded(cycle, present, sign * u < 0))
            doubts += bearing if len(bearing) < max(len(present), 2) else [_misplaced(bearing)]
        if len(present) < 2:
            continue
        noise = max(cycle.sigma(name) for name in side)
        seen = shared(cycle.clean(side[0]), cycle.clean(side[1]), noise)
        if seen.swing > SWING * noise and seen.swing > 0:
            share = known.get(side[0])
            found = list(_uneven(cycle, side, seen, share))
            if not found:
                known[side[0]] = share.after(seen) if share else Share(seen.angle, seen.means)
            doubts += found
    return doubts, known


def _unloaded(cycle: Cycle, names: list[str], free: npt.NDArray[np.bool_]) -> Iterator[Doubt]:
    """With a gap nothing touches beyond the middle, so the cells of this side bear nothing."""
    count = int(free.sum())
    if count < 5:
        return
    for name in names:
        bears = float(cycle.clean(name)[free].mean())
        limit = CELL_OFFSET * cycle.bench.profile.comparison.contact_n
        limit += 6.0 * cycle.sigma(name) / math.sqrt(count)
        if abs(bears) > limit:
            yield drifted(name, bears, limit, "N")


def _misplaced(bearing: list[Doubt]) -> Doubt:
    """Where all cells of a side bear a force beyond the gap, the gap is not where u says."""
    one = bearing[0]
    text = (
        f"{' and '.join(each.channel for each in bearing)} bear {spoken(one.value, 'N')} on the "
        "other side of the gap: the displacement of the mass or of the table has drifted"
    )
    return Doubt("drift", "mass_disp_m", one.value, one.limit, text)


def _uneven(
    cycle: Cycle, side: tuple[str, str], seen: Shared, share: Share | None
) -> Iterator[Doubt]:
    """Two cells that no longer share the force of their side as they did."""
    usual, most = (share.angle, ANGLE) if share else (math.pi / 4, UNEVEN)
    off = seen.angle - usual
    if abs(off) > most + 6.0 * seen.sigma_angle:
        # Accused is the one that bears less: it may as well be that the other one shows more.
        channel = side[0] if seen.means[0] < seen.means[1] else side[1]
        now, then = (100 / (1 + math.tan(angle)) for angle in (seen.angle, usual))
        text = f"{side[0]} bears {now:.0f} % of what it bears with {side[1]}, {then:.0f} % expected"
        limit = usual + math.copysign(most, off)
        yield Doubt("share", channel, seen.angle, limit, text, about=side[0])
        return
    if share is None:
        return
    first, second = (now - then for now, then in zip(seen.means, share.means, strict=True))
    across = second * math.cos(share.angle) - first * math.sin(share.angle)
    unsure = seen.sigma_angle / math.sqrt(share.looks) * math.hypot(first, second)
    limit = CELL_OFFSET * cycle.bench.profile.comparison.contact_n * math.sqrt(2.0)
    limit += 6.0 * math.hypot(unsure, 2.0 * seen.sigma)
    if abs(across) > limit:
        yield drifted(side[0] if across < 0 else side[1], abs(across), limit, "N")
