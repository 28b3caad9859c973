"""What the pictures of a discovery show, looked up in it: forces, close-ups, gates.

Before is the model alone, refitted; after is what the verdict stands for. Both as they are on what
was held out of their fits.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from table_io.block import Float1D, Int1D, Label
from table_io.records import Step
from twin.learn.discover import Discovery, Log
from twin.learn.guess import Guess
from twin.learn.motion import Motion
from twin.learn.naming import Explained
from twin.learn.sheet import FORCES, Sheet
from twin.learn.where import PHASES, phase_of, stepped

LEAST_ENTRIES = 20  # of a step in a row, to be looked at
CYCLES = 2  # of a step in a close-up
SPAN_S = 3.0  # of a close-up where there are no steps
REPEATS = 0.3  # of the rms of u: a motion that differs more from period to period does not repeat
FAILS, SURE = 0.1, 4.0  # excess over the noise, and its standard errors, that fail a gate
Pair = tuple[Explained, Explained]


@dataclass(frozen=True, eq=False)
class Look:
    """A stretch of a log to be looked at closely: what it is, and its samples, (sample,)."""

    title: str
    direction: str
    samples: Int1D


@dataclass(frozen=True, slots=True)
class Gate:
    """A check without any force law: mean square or value over the noise, before and after."""

    log: str
    what: str
    before: float
    after: float
    passed: bool


@dataclass(frozen=True, eq=False)
class Shown:
    """A discovery, its logs, and what is looked up again and again."""

    found: Discovery
    logs: Sequence[Log]

    @property
    def sheets(self) -> tuple[Sheet, ...]:
        return self.found.prepared.bench.sheets

    @property
    def pair(self) -> Pair:
        """(before, after)."""
        return self.found.named.null, self.found.verdict.best

    @property
    def law(self) -> Explained | None:
        """What was found: the effects, or where no name does, the general term."""
        v = self.found.verdict
        return v.general or (v.best if v.best.effects else None)

    @property
    def law_name(self) -> str:
        """Of the effects whose force is drawn."""
        v = self.found.verdict
        names = v.general.names[-1:] if v.general else v.best.names
        return " + ".join(names)

    def of_log(self, number: int) -> str:
        """ " · log" where there are several, to end a title."""
        return f" · {self.sheets[number].readings.name}" if len(self.sheets) > 1 else ""

    def steps(self, number: int) -> tuple[Step, ...]:
        """The steps of a log; none where they are but spots of a motion that is no stepped sine."""
        return tuple(self.logs[number].steps) if stepped(self.sheets[number]) else ()

    @cached_property
    def worst(self) -> int:
        """The log with most above the noise before; of it the close-ups are."""
        squares = [float(one @ one) / max(one.size, 1) for one in self.pair[0].left]
        return int(np.argmax(squares))

    @cached_property
    def delivered(self) -> tuple[Float1D, Float1D, Float1D] | None:
        """(what the law has to deliver, what it delivers, what it leaves), (entry,) over the noise.

        Of the worst log; the first is measured minus the model with the law taken out of it.
        """
        if self.law is None:
            return None
        sheet, guess = self.sheets[self.worst], self.law.fit.guess
        bare = guess
        for effect in self.law.effects:
            if self.found.verdict.general is None or effect is self.law.effects[-1]:
                bare = bare.without(effect.name)
        wanted, left = sheet.residual(bare), sheet.residual(guess)
        return wanted, wanted - left, left


def spread(sheet: Sheet, row: int, entries: Float1D, guess: Guess) -> Float1D:
    """(sample,) of the entries of one row, in N where the row is a force; NaN where none counts.

    The noise that the entries are over is that of the guess that left them.
    """
    mine = sheet.row_of == row
    out = np.full(sheet.readings.time_s.size, np.nan)
    out[sheet.sample_of[mine]] = entries[mine] * sheet.weight
    if not is_force(sheet, row):
        return out
    m, mass = _believed(sheet, guess)
    return out * float(sheet.noise(m, mass)[row])


def _believed(sheet: Sheet, guess: Guess) -> tuple[Motion, float]:
    """(motion, mass in kg) as a guess has them: sensors and mass may be its findings."""
    m = sheet.motion(guess.sensors())
    return m, guess.local(sheet.number, m).parameters.mass


def is_force(sheet: Sheet, row: int) -> bool:
    """False where a row is whitened or no force at all: then it is in parts of its noise."""
    return row < len(FORCES) and not (row == 0 and sheet.whitening is not None)


def measured_forces(sheet: Sheet, guess: Guess) -> list[Float1D]:
    """Damper, F_R and -F_L as measured, N, (sample,) each, with the mass and sensors of a guess."""
    m, mass = _believed(sheet, guess)
    if m.damper is not None:
        return [m.damper, m.right, m.left]
    borne = m.right - m.left if m.cells else 0.0
    return [-mass * m.acc - borne, m.right, m.left]


def looks(sheet: Sheet, steps: Sequence[Step], row: int) -> list[Look]:
    """Close-ups with samples in a row: the lowest step, the highest, the largest between the two.

    Without steps: stretches of small, middling and large motion.
    """
    m, used = sheet.motion(), sheet.used[row]
    sizes: dict[int, float] = {}
    for one in steps:
        mine = used & (m.step == one.index) & (m.label == Label.MEASURE)
        if mine.sum() >= LEAST_ENTRIES:
            sizes[one.index] = float(np.abs(m.u[mine]).max())
    if not sizes:
        return [] if steps else _stretches(sheet, row)
    ways = [one.direction for one in steps if one.index in sizes]
    way = max(ways, key=ways.count)  # forward where both are as many
    known = [one for one in steps if one.index in sizes and one.direction == way]
    known.sort(key=lambda one: one.frequency_hz)
    inner = known[1:-1] or known
    largest = max(inner, key=lambda one: sizes[one.index])
    picked = {one.index: one for one in (known[0], largest, known[-1])}
    return [
        Look(f"{one.frequency_hz:g} Hz {one.direction}", one.direction, _last(sheet, one.index))
        for one in picked.values()
    ]


def _last(sheet: Sheet, index: int) -> Int1D:
    """The samples of the last cycles of a step."""
    m = sheet.motion()
    held = (m.step == index) & (m.cycle >= 0)
    found: Int1D = np.flatnonzero(held & (m.cycle > m.cycle[held].max() - CYCLES))
    return found


def _stretches(sheet: Sheet, row: int) -> list[Look]:
    m, used = sheet.motion(), sheet.used[row]
    width = max(round(SPAN_S * m.rate_hz), 1)
    starts = [k for k in range(0, used.size, width) if used[k : k + width].sum() >= LEAST_ENTRIES]
    ranked = sorted(starts, key=lambda k: float(np.abs(m.u[k : k + width]).max()))
    places = dict.fromkeys((len(ranked) // 2, 4 * len(ranked) // 5, len(ranked) - 1))
    return [
        Look(
            f"from {m.time_s[ranked[p]]:.0f} s on",
            "forward",
            np.arange(ranked[p], min(ranked[p] + width, used.size)),
        )
        for p in places
        if 0 <= p < len(ranked)
    ]


def repeats(sheet: Sheet, one: Step) -> bool:
    """False where u over the measured cycles differs from period to period: chaos, or a passage."""
    m = sheet.motion()
    here = np.flatnonzero((m.step == one.index) & (m.label == Label.MEASURE))
    if here.size < m.rate_hz / one.frequency_hz * 1.5:
        return True
    t, u = m.time_s[here], m.u[here]
    later = t + 1.0 / one.frequency_hz <= t[-1]
    change = np.interp(t[later] + 1.0 / one.frequency_hz, t, u) - u[later]
    return float(change.std()) <= REPEATS * float(u.std())


def gates(shown: Shown) -> list[Gate]:
    """The instrument gates of every log: sensors that contradict each other, and rest values."""
    found = []
    for sheet, *left in zip(shown.sheets, *(one.left for one in shown.pair), strict=True):
        name = sheet.readings.name
        for row, what in enumerate(sheet.rows):
            mine = sheet.row_of == row
            if row < len(FORCES) or not mine.any():
                continue
            squares = [(r[mine] * sheet.weight) ** 2 for r in left]
            blocks = np.unique(sheet.block_of[mine], return_inverse=True)[1]
            sums = np.bincount(blocks, weights=squares[0] - 1.0)
            errors = sums.sum() / max(math.sqrt(float(sums @ sums)), 1e-300)
            before, after = (float(one.mean()) for one in squares)
            told = f"{what}: {'the same force' if 'cells' in what else 'the same motion'}"
            found.append(Gate(name, told, before, after, before < 1 + FAILS or errors < SURE))
        at_rest = sheet.row_of == len(sheet.rows)
        read = (r[at_rest][: len(sheet.resting)] * sheet.weight for r in left)
        values = zip(sheet.resting, *read, strict=True)
        for channel, before, after in values:
            told = f"{channel} at rest"
            found.append(Gate(name, told, float(before), float(after), abs(before) < SURE))
    return found


def phases_of(sheet: Sheet, row: int) -> list[str]:
    """The phases in which a row has entries."""
    return [PHASES[k] for k in np.unique(phase_of(sheet)[sheet.row_of == row])]
