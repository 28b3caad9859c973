"""The parameters of a fit from some of the samples alone, and the sentences where they disagree."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from table_io.block import Bool2D
from table_io.records import Step
from twin.learn.fit import Fit, fit, slopes
from twin.learn.guess import GAP, ZERO, Free, Guess
from twin.learn.onsets import Onsets
from twin.learn.sheet import Sheet

LEAST_BLOCKS = 6  # in a part: fewer and its spread is not known
APART = 4.0  # standard deviations at which two estimates disagree: some thirty are compared
NOTABLE, NOTABLE_M = 0.01, 2e-5  # and by so much: of the value, of a gap in m
OPPOSED = (
    ("small motion", "large motion"), ("forward", "backward"), ("early", "late"),
    ("contact right", "contact left"),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Part:
    """An estimate from some of the samples; `values` hold (value, standard deviation) in SI."""

    source: str
    values: Mapping[str, tuple[float, float]]
    entries: int
    converged: bool


def sensed(
    sheets: Sequence[Sheet], guess: Guess, free: Sequence[Free], train: Sequence[Bool2D] | None
) -> tuple[Free, ...]:
    """Those that change a residual at all, where `train`, (entry,) each, is True."""
    before = [sheet.residual(guess) for sheet in sheets]
    masks = train or [np.ones(one.size, dtype=bool) for one in before]
    return tuple(
        one
        for one in free
        if any(
            slope[mask].any()
            for slope, mask in zip(slopes(sheets, guess, one, before), masks, strict=True)
        )
    )


def parts_of(
    sheets: Sequence[Sheet], steps: Sequence[Sequence[Step]], joint: Fit
) -> tuple[Part, ...]:
    """Flight, each side's contacts, and opposed halves of the recordings; those that say much."""
    free = [one for one in joint.free if not one.name.startswith(ZERO)]  # only the rest pins it
    flight = [one for one in free if not one.name.startswith(("bumper_", GAP))]
    found = [_part("free flight", sheets, joint, flight, [*map(_flying, sheets)])]
    for row, side in ((1, "right"), (2, "left")):
        own = [
            replace(one, keys=(f"{one.name}_{side[0]}",)) if one.name.startswith("bumper_") else one
            for one in free
            if one.name.startswith(("bumper_", GAP)) and "." not in one.name
        ]
        rows = [sheet.row_of == row for sheet in sheets]
        found.append(_part(f"contact {side}", sheets, joint, own, rows))
    halves = [_halves(sheet, some) for sheet, some in zip(sheets, steps, strict=True)]
    for name in halves[0]:
        masks = [one[name] for one in halves]
        if any(mask.any() for mask in masks) and not all(mask.all() for mask in masks):
            found.append(_part(name, sheets, joint, free, masks))
    return tuple(one for one in found if one.values)


def _flying(sheet: Sheet) -> Bool2D:
    """(entry,) of the damper row while no side bears; where nobody knows, well inside the gaps."""
    m = sheet.motion()
    right, left = m.gaps_m
    inside = (m.u < 0.9 * right) & (m.u > -0.9 * left)
    if m.damper is not None:
        inside = np.ones(m.u.size, dtype=bool)
    flying = np.where((sheet.touched < 0).any(axis=0), inside, (sheet.touched == 0).all(axis=0))
    found: Bool2D = (sheet.row_of == 0) & flying[sheet.sample_of]
    return found


def _halves(sheet: Sheet, steps: Sequence[Step]) -> dict[str, Bool2D]:
    """(entry,) of each half, by name; the rest values belong to none."""
    m, sample = sheet.motion(), sheet.sample_of
    peaks = np.zeros(int(sheet.blocks[-1]) + 1)
    np.maximum.at(peaks, sheet.blocks, np.abs(m.u))
    peak = peaks[sheet.blocks]
    middle = float(np.median(peak[m.moving]))
    late = m.time_s > float(np.median(m.time_s[m.moving]))
    found = {
        "small motion": peak <= middle, "large motion": peak > middle, "early": ~late, "late": late,
    }  # fmt: skip
    for way in ("forward", "backward"):
        found[way] = np.isin(m.step, [step.index for step in steps if step.direction == way])
    own = sheet.row_of < len(sheet.rows)
    return {name: mask[sample] & own for name, mask in found.items()}


def _part(
    source: str, sheets: Sequence[Sheet], joint: Fit, free: Sequence[Free],
    train: Sequence[Bool2D],
) -> Part:  # fmt: skip
    """One estimate, with no values where there is too little for one."""
    entries = sum(int(one.sum()) for one in train)
    blocks = sum(
        np.unique(sheet.block_of[one]).size for sheet, one in zip(sheets, train, strict=True)
    )
    known = sensed(sheets, joint.guess, free, train) if blocks >= LEAST_BLOCKS else ()
    if not known:
        return Part(source, {}, entries, True)
    found = fit(sheets, joint.guess, known, train)
    values = {one.name: (found.values[one.name], found.spread[one.name]) for one in known}
    told = {name: pair for name, pair in values.items() if pair[1] > 0}
    return Part(source, told, entries, found.converged)


def plain(sheets: Sequence[Sheet], joint: Fit, fixed: Sequence[str]) -> Iterator[str]:
    """What must be known before the numbers are believed."""
    if not joint.converged:
        yield "the fit has not converged: its numbers are not to be used"
    for name in joint.at_bound:
        yield f"{name}: at its bound, {joint.values[name]:.4g}; its interval means nothing"
    names = [one.name for one in joint.free]
    if "bumper_stiffness" not in names:
        yield "no log touches a bumper: K_j and C_j are those of the start model, gaps as stated"
    else:
        for sheet in sheets:
            if f"{GAP}{sheet.number}" not in names:
                yield f"{sheet.readings.name}: touches no bumper; its gap is the one it states"
    for name in fixed:
        yield f"{name}: nothing in the logs says it; it stays as it was"


def asymmetric(asymmetry: tuple[float, float] | None) -> Iterator[str]:
    """A sentence where the gaps are not equal."""
    if asymmetry and abs(asymmetry[0]) > max(NOTABLE_M, APART * asymmetry[1]):
        offset, sd = asymmetry
        yield (
            f"the gaps are not as stated to each side: right {1e3 * offset:+.3f} mm, left "
            f"{-1e3 * offset:+.3f} mm (+- {1.96e3 * sd:.3f}); the fit holds them equal: discover "
            "can name gap_offset"
        )


def disagreeing(joint: Fit, parts: Sequence[Part]) -> Iterator[str]:
    """Sentences where opposed parts, or free flight and the whole, do not say the same."""
    by_name = {part.source: part.values for part in parts}
    whole = {name: (value, joint.spread[name]) for name, value in joint.values.items()}
    pairs = [(a, b, by_name.get(a, {}), by_name.get(b, {})) for a, b in OPPOSED]
    pairs.append(("free flight", "all together", by_name.get("free flight", {}), whole))
    units = {one.name: one.unit for one in joint.free}
    for a, b, one, other in pairs:
        for name in one.keys() & other.keys():
            (x, sx), (y, sy) = one[name], other[name]
            if _apart(x - y, math.hypot(sx, sy), y, units[name]):
                yield (
                    f"{name}: {x:.5g} {units[name]} in {a}, {y:.5g} in {b}, "
                    f"{abs(x - y) / math.hypot(sx, sy):.0f} deviations apart: the specimen "
                    "changed, or the model lacks something; discover can name it"
                )


def _apart(difference: float, sd: float, value: float, unit: str) -> bool:
    notable = NOTABLE_M if unit == "m" else NOTABLE * abs(value)
    return abs(difference) > max(APART * sd, notable)


def misplaced(sheets: Sequence[Sheet], joint: Fit, found: Sequence[Onsets]) -> Iterator[str]:
    """Sentences where contact begins or ends elsewhere than the force law says."""
    for one in found:
        gap = local_gap(sheets[one.log], joint, one.side)
        sd = math.hypot(one.sd, joint.spread.get(f"{GAP}{one.log}", 0.0))
        if _apart(one.value - gap, sd, gap, "m"):
            yield (
                f"{sheets[one.log].readings.name}: {one.side} {one.kind}s lie at "
                f"{1e3 * one.value:.3f} mm, the fit's gap at {1e3 * gap:.3f} mm: bumper law, "
                "hunt_crossley, bumper_maxwell or unequal gaps?"
            )


def local_gap(sheet: Sheet, joint: Fit, side: str) -> float:
    """Gap of a side of a log in m, as the fit has it."""
    p = joint.guess.local(sheet.number, sheet.motion()).parameters
    return p.gap_r if side == "right" else p.gap_l
