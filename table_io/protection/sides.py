"""What one look finds at the load cells: how two of them share the force of their side, and what
they show where nothing can touch them.
"""

import math
from collections.abc import Iterator, Mapping

import numpy as np
import numpy.typing as npt

from table_io.channels import LEFT_CELLS, RIGHT_CELLS
from table_io.protection.consistency import Shared, shared
from table_io.protection.cycle import Cycle, Doubt, drifted, spoken

SWING = 20.0  # times the noise: a force that tells how it is shared
ANGLE = 3.0  # degrees: a tenth more or less force on one of two cells
UNEVEN = 25.0  # degrees off equal shares where nothing was seen before: one bears a quarter
CELL_OFFSET = 0.5  # of the force that counts as contact


def cells(cycle: Cycle, before: Mapping[str, Shared]) -> tuple[list[Doubt], dict[str, Shared]]:
    """(doubts, how the cells of each side have shared their force when they first bore one)."""
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
        seen = shared(cycle.clean(side[0]), cycle.clean(side[1]), cycle.sigma(*side))
        if seen.swing > SWING * cycle.sigma(*side) and seen.swing > 0:
            found = list(_uneven(cycle, side, seen, known.get(side[0])))
            if not found:
                known.setdefault(side[0], seen)
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
    cycle: Cycle, side: tuple[str, str], seen: Shared, before: Shared | None
) -> Iterator[Doubt]:
    """Two cells that no longer share the force of their side as they did."""
    usual, most = (45.0, UNEVEN) if before is None else (before.angle, ANGLE)
    off = seen.angle - usual
    if abs(off) > most:
        # Accused is the one that bears less: it may as well be that the other one shows more.
        channel = side[0] if cycle.clean(side[0]).mean() < cycle.clean(side[1]).mean() else side[1]
        text = (
            f"{side[0]} and {side[1]} share their force at {seen.angle:.0f} degrees, "
            f"{usual:.0f} expected; allowed: +-{most:g}"
        )
        limit = usual + math.copysign(most, off)
        yield Doubt("share", channel, seen.angle, limit, text, about=side[0])
    apart = seen.apart - (0.0 if before is None else before.apart)
    limit = 2 * CELL_OFFSET * cycle.bench.profile.comparison.contact_n
    if before is not None and abs(apart) > limit + 6.0 * (seen.sigma + before.sigma):
        yield drifted(side[0] if apart < 0 else side[1], abs(apart), limit, "N")
