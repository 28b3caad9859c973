"""Where model and measurement disagree: a map over steps, phases and rows, against the noise.

A cell's excess is its mean square over the noise, less the floor; its significance comes from the
scatter of the blocks in it. The floor is what repeated periods do not repeat, at least the noise.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import welch

from table_io.block import Float1D, Int1D, Label
from table_io.records import Step
from twin.learn.sheet import PULLS, Sheet

PHASES = ("flight", "contact_right", "contact_left", "contact_both")
MOST = 0.8  # of the excess: what is said to lie somewhere lies there so far
NOTABLE = 0.15  # of the excess: a row or harmonic with less is not mentioned
HARMONICS = 7
NO_STEP = -1
STEPPED = 0.4  # of the time that it moves: less in steps is no stepped sine
SEGMENT_S = 20.0  # of a spectrum, where there are no steps
ABOVE = 3.0  # times the noise's power: a line of a spectrum with less may be noise
PULLED = 3.0  # mean square over the noise from which on a side is said to pull
CHANNELS = {
    "damper": ("mass_acc_m_s2",), "damper itself": ("damper_force_n",),
    "right": ("force_r1_n", "force_r2_n"), "left": ("force_l1_n", "force_l2_n"),
    "mass": ("mass_disp_m", "mass_acc_m_s2"),
    "table": ("table_disp_m", "table_acc_m_s2"),
    "mass against table": ("rel_disp_m", "mass_acc_m_s2", "table_acc_m_s2"),
    "right cells": ("force_r1_n", "force_r2_n"), "left cells": ("force_l1_n", "force_l2_n"),
    "right pull": ("force_r1_n", "force_r2_n"), "left pull": ("force_l1_n", "force_l2_n"),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Cell:
    """One place: a log, a step, a phase, a row; `excess` is its mean square over the floor's."""

    log: int
    step: int
    phase: str
    row: str
    count: int
    mean_square: float
    excess: float
    errors: float  # standard errors by which the excess differs from none


@dataclass(frozen=True, slots=True)
class Where:
    """Where most of the excess lies; empty or None where there is none."""

    frequency_hz: tuple[float, float] | None
    direction: str
    phase: str
    channels: tuple[str, ...]
    harmonics: tuple[int, ...]


def phase_of(sheet: Sheet) -> Int1D:
    """(entry,) place in `PHASES`; a side that pulls is in contact."""
    touched = (sheet.touched > 0).astype(np.int64)
    found: Int1D = (touched[0] + 2 * touched[1])[sheet.sample_of]
    for side, name in enumerate(PULLS):
        if name in sheet.rows:
            found[sheet.row_of == sheet.rows.index(name)] |= 1 + side
    return found


def stepped(sheet: Sheet) -> bool:
    """False where steps are but spots of a motion that is no stepped sine."""
    moving = sheet.motion().moving
    return bool((moving & (sheet.readings.step >= 0)).sum() > STEPPED * moving.sum())


def cells(sheets: Sequence[Sheet], left: Sequence[Float1D], floor: float) -> tuple[Cell, ...]:
    """The map of a residual over the noise, (entry,) a log; `floor` is a mean square.

    A log that is no stepped sine is one step, -1.
    """
    found = []
    for sheet, r in zip(sheets, left, strict=True):
        in_steps = stepped(sheet)
        step = np.where(in_steps, sheet.readings.step, NO_STEP)[sheet.sample_of]
        held = np.flatnonzero(((step >= 0) | (not in_steps)) & (sheet.row_of < len(sheet.rows)))
        keys = np.stack([sheet.row_of, step, phase_of(sheet)])[:, held]
        order = np.lexsort(keys[::-1])
        keys = keys[:, order]
        new = np.diff(keys, axis=1, prepend=-1).any(axis=0)
        parts = np.split(held[order], np.flatnonzero(new)[1:]) if held.size else []
        for (row, number, phase), mine in zip(keys[:, new].T.tolist(), parts, strict=True):
            found.append(_cell(sheet, r, mine, number, PHASES[phase], sheet.rows[row], floor))
    return tuple(found)


def _cell(
    sheet: Sheet, r: Float1D, mine: Int1D, step: int, phase: str, row: str, floor: float
) -> Cell:
    """The cell of the entries at the places `mine`."""
    squares = r[mine] ** 2
    blocks = np.unique(sheet.block_of[mine], return_inverse=True)[1]
    sums = np.bincount(blocks, weights=squares - floor)
    # noise alone scatters the mean square by sqrt(2 / n); blocks that differ scatter it more
    chance = max(2.0 * floor**2 * squares.size, float(((sums - sums.mean()) ** 2).sum()))
    excess = float(sums.sum())
    return Cell(
        sheet.number, step, phase, row, squares.size, float(squares.mean()),
        excess / squares.size, excess / math.sqrt(chance),
    )  # fmt: skip


def pulling(sheets: Sequence[Sheet], left: Sequence[Float1D]) -> tuple[str, ...]:
    """Sentences about bumpers that pull: no law that pushes only can leave that."""
    found = []
    for sheet, r in zip(sheets, left, strict=True):
        for name in PULLS:
            mine = sheet.row_of == sheet.rows.index(name) if name in sheet.rows else None
            if mine is not None and mine.any() and np.mean(r[mine] ** 2) > PULLED:
                side = name.split()[0]
                found.append(
                    f"{sheet.readings.name}: the {side} bumper pulls after it lets go, as if it "
                    "stuck to the mass; no law of the library does"
                )
    return tuple(found)


def repeated(sheets: Sequence[Sheet], left: Sequence[Float1D]) -> float:
    """Mean square over the noise of what does not repeat from one held cycle to the next.

    Of a residual over the noise. A model's error is the same in every period of a periodic motion,
    noise is not. The lower quartile over the steps: in chaotic ones nothing repeats, and after a
    jump a transient is left. 1 where nothing is held, and for rows that only some samples have.
    """
    found, share = [], []
    for sheet, r in zip(sheets, left, strict=True):
        mine = sheet.row_of == 0
        samples, values = sheet.sample_of[mine], r[mine]
        whole = np.full(sheet.readings.step.size, np.nan)
        whole[samples] = values
        for number in np.unique(sheet.readings.step[sheet.readings.step >= 0]):
            here = (sheet.readings.step == number) & (sheet.readings.label == Label.MEASURE)
            likeness = sheet.readings.grid.neighbours
            one = _unrepeated(whole, sheet.readings.cycle, np.flatnonzero(here), likeness)
            if math.isfinite(one):
                found.append(one)
        share.append(float(mine.mean()))
    if not found:
        return 1.0
    part = float(np.mean(share))
    return part * max(1.0, float(np.percentile(found, 25))) + 1.0 - part


def _unrepeated(whole: Float1D, cycle: Int1D, here: Int1D, likeness: float) -> float:
    """Variance of what two periods do not share, of the values at the samples `here`.

    `likeness` is the correlation of the noise of neighbours.
    """
    if here.size < 4:
        return math.nan
    numbers = cycle[here]
    count = int(np.unique(numbers).size)
    if count < 2:
        return math.nan
    period = here.size / count
    later = here[here + math.ceil(period) < here[-1]]
    if later.size < 8:
        return math.nan
    shift, part = math.floor(period), period - math.floor(period)
    # straight lines between samples halve the noise where part = 1/2
    next_ = (1 - part) * whole[later + shift] + part * whole[later + shift + 1]
    share = 1.0 + (1 - part) ** 2 + part**2 + 2 * part * (1 - part) * likeness
    return float(np.nanmean((whole[later] - next_) ** 2) / share)


def where(
    sheets: Sequence[Sheet],
    left: Sequence[Float1D],
    map_: Sequence[Cell],
    steps: Sequence[Sequence[Step]],
) -> Where:
    """In words: the frequencies, direction, phase and rows that hold most of the excess.

    Of a residual over the noise, (entry,) a log, its map, and the steps of each log.
    """
    sure = [one for one in map_ if one.errors > 3.0 and one.excess > 0]
    total = sum(one.excess * one.count for one in sure)
    if total <= 0:
        return Where(None, "both", "all", (), ())

    def shares(keys: Sequence[object]) -> dict[object, float]:
        sums: dict[object, float] = {}
        for key, one in zip(keys, sure, strict=True):
            sums[key] = sums.get(key, 0.0) + one.excess * one.count / total
        return sums

    known = [{one.index: one for one in log} for log in steps]
    at = [known[one.log].get(one.step) for one in sure]
    frequency = shares([one.frequency_hz if one else None for one in at])
    direction = shares([one.direction if one else None for one in at])
    phase = shares([one.phase for one in sure])
    rows = shares([_measured(sheets[one.log], one.row) for one in sure])
    channels = [c for row, s in rows.items() if s > NOTABLE for c in CHANNELS.get(str(row), ())]
    loose = {
        one.log for one, step in zip(sure, at, strict=True) if not step and one.row == "damper"
    }
    return Where(
        _band(frequency) or _spectral_band(sheets, left, loose),
        next((str(k) for k, s in direction.items() if s > MOST and k), "both"),
        _phase(phase),
        tuple(dict.fromkeys(channels)),
        _harmonics(sheets, left, steps),
    )


def _measured(sheet: Sheet, row: str) -> str:
    """The row, or which force it is where that was measured itself."""
    own = row == "damper" and "damper_force_n" in sheet.readings.channels
    return "damper itself" if own else row


def _band(shares: dict[object, float]) -> tuple[float, float] | None:
    """The frequencies of the steps that hold most, the largest first, as one interval.

    None where most lies in no step.
    """
    stepped = {k: s for k, s in shares.items() if isinstance(k, float)}
    ranked = sorted(((s, k) for k, s in stepped.items()), reverse=True)
    if sum(stepped.values()) < 0.5:
        return None
    held, chosen = 0.0, []
    for share, hz in ranked:
        chosen.append(hz)
        held += share
        if held > MOST * sum(stepped.values()):
            break
    return (min(chosen), max(chosen)) if chosen else None


def _spectral_band(
    sheets: Sequence[Sheet], left: Sequence[Float1D], logs: set[int]
) -> tuple[float, float] | None:
    """The frequencies in Hz between which most of the damper row's power beyond the noise lies,
    of these logs; None of none."""
    found = []
    for number in sorted(logs):
        sheet, r = sheets[number], left[number]
        mine, rate_hz = sheet.row_of == 0, sheet.readings.motion().rate_hz
        whole = np.zeros(sheet.readings.time_s.size)
        whole[sheet.sample_of[mine]] = r[mine]
        hz, power = welch(whole, rate_hz, nperseg=min(whole.size, round(SEGMENT_S * rate_hz)))
        noise = float(np.median(power))  # most of the band is noise alone
        found.append((hz, np.where(power > ABOVE * noise, power - noise, 0.0) * mine.sum()))
    hz = max((one for one, _ in found), key=lambda one: one[-1], default=np.zeros(0))
    power = np.sum([np.interp(hz, *one, right=0.0) for one in found], axis=0)
    if not np.sum(power) > 0:
        return None
    held = np.cumsum(power) / power.sum()
    low, high = np.searchsorted(held, (0.5 * (1 - MOST), 1 - 0.5 * (1 - MOST)))
    return float(hz[low]), float(hz[high])


def _phase(shares: dict[object, float]) -> str:
    right, left = shares.get("contact_right", 0.0), shares.get("contact_left", 0.0)
    both = right + left + shares.get("contact_both", 0.0)
    if shares.get("flight", 0.0) > MOST:
        return "flight"
    for name, share in (("contact_right", right), ("contact_left", left), ("contact_both", both)):
        if share > MOST:
            return name
    return "all"


def _harmonics(
    sheets: Sequence[Sheet], left: Sequence[Float1D], steps: Sequence[Sequence[Step]]
) -> tuple[int, ...]:
    """The harmonics of the drive that make a notable part of the damper row; 0 is its mean."""
    power = np.zeros(HARMONICS + 1)
    for sheet, r, log in zip(sheets, left, steps, strict=True):
        mine = sheet.row_of == 0
        samples, values = sheet.sample_of[mine], r[mine]
        for one in log:
            here = (sheet.readings.step[samples] == one.index) & (
                sheet.readings.cycle[samples] >= 0
            )
            if here.sum() < 4 * HARMONICS:
                continue
            t = sheet.readings.time_s[samples[here]]
            angle = 2 * np.pi * one.frequency_hz * t[:, None] * np.arange(1, HARMONICS + 1)
            design = np.hstack([np.ones((t.size, 1)), np.cos(angle), np.sin(angle)])
            x = np.linalg.lstsq(design, values[here], rcond=None)[0]
            power[0] += x[0] ** 2 * t.size
            power[1:] += 0.5 * (x[1 : HARMONICS + 1] ** 2 + x[HARMONICS + 1 :] ** 2) * t.size
            power -= 3.0  # what noise would give, generously
    power = np.maximum(power, 0.0)
    total = power.sum()
    return tuple(int(k) for k in np.flatnonzero(power > NOTABLE * total)) if total > 0 else ()
