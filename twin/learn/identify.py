"""Parameters, gaps and their uncertainty from recordings: the joint fit, and its witnesses apart.

The joint fit takes all forces along the measured motion of all logs. Beside it stands what the
paper's authors did by hand, each from samples of its own: free flight gives K and C, each bumper's
load cells its K_j, C_j and gap, the places of contact onset and release the gaps; and the same fit
on small and large motion, forward and backward, early and late. Where they disagree the model lacks
something, or the specimen changed.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from table_io.block import Block, Label
from table_io.channels import rel_disp
from twin.compare import PREDICTED
from twin.compare.windows import TwinSetup, begin, follow
from twin.learn.discover import Log, far, prepare
from twin.learn.fit import Fit, fit, slopes
from twin.learn.guess import ZERO, Free, Guess, effect_free
from twin.learn.naming import Bench
from twin.learn.onsets import Onsets, onsets
from twin.learn.parts import (
    Part,
    asymmetric,
    disagreeing,
    misplaced,
    parts_of,
    plain,
    sensed,
)  # fmt: skip
from twin.learn.readings import Readings
from twin.learn.sheet import Sheet
from twin.model.effects import find_effect
from twin.model.model import Model

WINDOW_S = 1.0
OFFSET = "gap_offset.offset"
TIED = 0.7  # correlation that is told


@dataclass(frozen=True, eq=False)
class Identified:
    """All that was identified. `windows` are (nrmse of u before, after) of each log, or None."""

    bench: Bench
    began: Guess
    fit: Fit
    fixed: tuple[str, ...]  # asked for, but nothing in the logs says it; as in the start model
    parts: tuple[Part, ...]
    asymmetry: tuple[float, float] | None  # right gap less half the total, and deviation, in m
    onsets: tuple[Onsets, ...]
    windows: tuple[tuple[float, float] | None, ...]
    warnings: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def tied(self) -> tuple[tuple[str, str, float], ...]:
        """Pairs of parameters that are hard to tell apart, with their correlation."""
        c, names = self.fit.correlation, [one.name for one in self.fit.free]
        return tuple(
            (names[i], names[k], float(c[i, k]))
            for i in range(len(names))
            for k in range(i)
            if abs(c[i, k]) > TIED and not names[i].startswith(ZERO)
        )


def identify(logs: Sequence[Log], blocks: Sequence[Sequence[Block]], model: Model) -> Identified:
    """What the logs, with their measured blocks, say of a model's parameters; see the module.

    BadInput where a log holds too little to learn from.
    """
    prepared = prepare(logs, model)
    bench = prepared.bench
    sheets = bench.sheets
    joint, fixed = _told_apart(sheets, prepared.guess, bench.base)
    joint = cured(sheets, joint)
    flat = joint.guess.model().flat()
    law_r, law_l = ((flat[f"bumper_stiffness_{s}"], flat[f"bumper_damping_{s}"]) for s in "rl")
    crossed = tuple(
        one
        for sheet, mine in zip(sheets, blocks, strict=True)
        for one in onsets(sheet, mine, (law_r, law_l), joint.guess)
    )
    asymmetry = _asymmetry(sheets, joint)
    parts = parts_of(sheets, [log.steps for log in logs], joint)
    began = Guess.of(model, len(sheets))
    windows = tuple(
        _windows(sheet, mine, began, joint.guess)
        for sheet, mine in zip(sheets, blocks, strict=True)
    )
    warnings = (
        *plain(sheets, joint, fixed), *asymmetric(asymmetry), *disagreeing(joint, parts),
        *misplaced(sheets, joint, crossed),
    )  # fmt: skip
    return Identified(
        bench,
        began,
        joint,
        fixed,
        parts,
        asymmetry,
        crossed,
        windows,
        warnings,
        (*prepared.notes, *far(model, joint)),
    )


def _told_apart(
    sheets: Sequence[Sheet], guess: Guess, free: Sequence[Free]
) -> tuple[Fit, tuple[str, ...]]:
    """(the fit of what the logs say something of, the names of the rest)."""
    known = sensed(sheets, guess, free, None)
    fixed = tuple(one.name for one in free if one not in known)
    return fit(sheets, guess, known), fixed


def cured(sheets: Sequence[Sheet], found: Fit) -> Fit:
    """The fit less what the noise of u and u' itself does to it (errors in variables).

    With e the noise of the motion a residual has -(K e_u + C e_v + M e_a)/s and its slope -e_u/s,
    so at the truth the gradient is not 0 but, a sample, in the damper row and in a bumper's

        b_K = (K var_u + M cov(u, a)) / s^2,   b_C = C var_v / s^2,   b_Kj = K_j var_u / s^2, ...

    and least squares is off by -H^-1 b. The displacement is fused with the accelerometer, so
    cov(u, a) = -w^2 P_u summed: less the variance of the mass's velocity.
    """
    pull = np.zeros(len(found.free))
    hessian = np.zeros((pull.size, pull.size))
    flat = found.guess.model().flat()
    for sheet in sheets:
        before = sheet.residual(found.guess)
        rows = np.array([slopes([sheet], found.guess, one, [before])[0] for one in found.free])
        hessian += rows @ rows.T
        m = sheet.motion()
        if sheet.whitening is not None or (m.damper is None and not m.cells):
            continue  # noise shaped otherwise; the selection of the samples is the model's own
        counts = np.bincount(sheet.row_of, minlength=3)[:3] / sheet.weight**2
        with_acc = m.mass_kg * _shared(sheet.readings) if m.damper is None else 0.0
        n, noise = m.noise, sheet.noise(m, m.mass_kg)
        for row, ends in enumerate((("stiffness", "damping"), *_bumpers())):
            if not counts[row]:
                continue
            k, c = (flat[name] for name in ends)
            share = counts[row] / noise[row] ** 2
            pulls = (k * n.u**2 - (with_acc if row == 0 else 0.0), c * n.v**2)
            for name, amount in zip(ends, pulls, strict=True):
                pull += [share * amount if name in one.keys else 0.0 for one in found.free]
    size = np.sqrt(np.maximum(np.diag(hessian), 1e-300))
    moved = np.linalg.lstsq(hessian / np.outer(size, size), pull / size, rcond=1e-14)[0] / size
    values = {
        one.name: one.outside(one.inside(found.values[one.name]) + float(step))
        for one, step in zip(found.free, moved, strict=True)
        if one.name not in found.at_bound
    }
    new = {key: values[one.name] for one in found.free if one.name in values for key in one.keys}
    return replace(found, guess=found.guess.moved(new), values={**found.values, **values})


def _bumpers() -> tuple[tuple[str, str], ...]:
    return tuple((f"bumper_stiffness_{side}", f"bumper_damping_{side}") for side in "rl")


def _shared(readings: Readings) -> float:
    """-cov(u, a) in m2/s2 of the noise that the accelerometer of the mass brings into u."""
    noise, own = readings.noise, 1.0
    s_x, s_a = noise.get("mass_disp_m"), noise.get("mass_acc_m_s2")
    if s_a is None:
        return 0.0
    if s_x is None or "table_disp_m" not in noise:
        if "table_acc_m_s2" not in noise:
            return 0.0
        both = math.hypot(s_a, noise["table_acc_m_s2"])
        s_x, s_a, own = noise["rel_disp_m"], both, (s_a / both) ** 2
    fused = s_a * s_x / np.hypot(s_a, readings.w**2 * s_x)
    return own * readings.grid.rms(readings.w * fused * readings.low) ** 2


def _asymmetry(sheets: Sequence[Sheet], joint: Fit) -> tuple[float, float] | None:
    """(offset of the gaps in m, its deviation) as one more number of the joint fit."""
    both = all((sheet.touched > 0).any(axis=1).all() for sheet in sheets)
    if not both or OFFSET in joint.guess.values:
        return None
    free = (*joint.free, *effect_free(find_effect("gap_offset")))
    found = fit(sheets, joint.guess.moved({OFFSET: 0.0}), free)
    return found.values[OFFSET], found.spread[OFFSET]


def _windows(sheet: Sheet, blocks: Sequence[Block], *guesses: Guess) -> tuple[float, float] | None:
    """nrmse of u of each of two guesses over windows that restart from the measured state.

    In chaos a free run says nothing after a few cycles. None where nothing drives a model.
    """
    if not blocks or "table_acc_m_s2" not in sheet.readings.channels:
        return None
    before, after = (
        nrmse(blocks, guess.local(sheet.number, sheet.motion()), sheet.contact_n)
        for guess in guesses
    )
    return before, after


def nrmse(blocks: Sequence[Block], model: Model, contact_n: float) -> float:
    """rms of measured less predicted u over the rms of u, windows of `WINDOW_S` each."""
    window = round(WINDOW_S * blocks[0].rate_hz)
    setup = TwinSetup(model, blocks[0].rate_hz, window, window, contact_n)
    row, errors, squares = PREDICTED.index("window/rel_disp_m"), 0.0, 0.0
    for block in blocks:
        loose = replace(block, values=np.asfortranarray(block.values))  # rows are copied on the way
        _, predicted, _ = follow(setup, begin(setup, block.index), loose)
        u, there = rel_disp(block), predicted.values[row]
        known = np.isfinite(u) & np.isfinite(there) & (block.label != Label.REST)
        errors += float(((u - there)[known] ** 2).sum())
        squares += float((u[known] ** 2).sum())
    return math.sqrt(errors / squares) if squares else math.nan
