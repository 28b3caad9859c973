"""From samples to looks: half a cycle of the drive after another, the last whole one looked at.

Which samples a look sees is decided by the drive's phase alone, so the cut into blocks changes
nothing.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from table_io.block import Float1D, Float2D
from table_io.protection import looks, sides
from table_io.protection.cycle import Bench, Cycle, Doubt
from table_io.protection.looks import Swing, Usual
from table_io.protection.sides import Share
from table_io.records import Response
from table_io.response import transfer_at

HOLDS = 2  # keys from here on are motions of constant frequency and level
WHOLE = 1.0 - 1e-3  # of a cycle
USUAL_GAIN, MOST_LAG_S = (0.5, 1.5), 0.1  # of a table that may be followed sample by sample
CLOSE = 0.1  # change of the response from look to look that is no fault


@dataclass(frozen=True, slots=True, eq=False)
class Stretch:
    """Samples between two marks: values (channel, sample), the rest (sample,).

    `level` and `label` are those at its end, `key` tells motions apart (0 is rest, below it the
    loop check), `whole` says that it is half a cycle from end to end.
    """

    values: Float2D
    command: Float1D
    phase: Float1D
    level: float
    label: int
    key: int
    whole: bool


def _empty() -> Mapping[Any, Any]:
    return MappingProxyType({})


@dataclass(frozen=True)
class Tracks:
    """What the looks so far have left; `gain` and `lag_s` (NaN: unknown) of the table."""

    stretches: tuple[Stretch, ...] = ()
    response: Response | None = None
    visits: Mapping[float, complex] = field(default_factory=_empty)
    usual: Mapping[str, Usual] = field(default_factory=_empty)
    shares: Mapping[str, Share] = field(default_factory=_empty)
    streaks: Mapping[tuple[str, str, str], int] = field(default_factory=_empty)
    swing: Swing = field(default_factory=Swing)
    gain: float = 1.0
    lag_s: float = math.nan

    def following(self, table: complex, frequency_hz: float) -> "Tracks":
        """The tracks with a table that follows its command so, where that is plausible."""
        lag_s = looks.lag(table, 2 * math.pi * frequency_hz)
        usual = USUAL_GAIN[0] < abs(table) < USUAL_GAIN[1] and 0.0 <= lag_s < MOST_LAG_S
        if not usual or (self.lag_s >= 0 and abs(abs(table) / self.gain - 1.0) > CLOSE):
            return self
        return replace(self, gain=abs(table), lag_s=lag_s)


def look(bench: Bench, tracks: Tracks, stretch: Stretch) -> tuple[Tracks, tuple[Doubt, ...]]:
    """(tracks, the doubts that are now confirmed) after one more stretch."""
    if stretch.key <= 0:
        return replace(tracks, stretches=(), streaks=_empty()), ()
    kept = [stretch]
    for one in reversed(tracks.stretches):
        if _turns(kept) > WHOLE:
            break
        kept.insert(0, one)
    tracks = replace(tracks, stretches=tuple(kept))
    if _turns(kept) < WHOLE:
        return tracks, ()
    tracks, doubts = _moving(tracks, _joined(bench, kept))
    last = kept[-2:]
    steady = stretch.key >= HOLDS and all(one.whole and one.key == stretch.key for one in last)
    if len(last) == 2 and steady:
        tracks, found = _held(tracks, _joined(bench, last))
        doubts += found
    streaks = {one.key: tracks.streaks.get(one.key, 0) + 1 for one in doubts}
    told = [one for one in doubts if streaks[one.key] == one.looks]
    return replace(tracks, streaks=MappingProxyType(streaks)), tuple(told)


def _moving(tracks: Tracks, cycle: Cycle) -> tuple[Tracks, list[Doubt]]:
    """What holds for any motion."""
    doubts: list[Doubt] = []
    usual = dict(tracks.usual)
    for names, acceleration, seen in looks.fit(cycle):
        before = usual.get(names[0])
        found = list(looks.misfit(cycle, names, acceleration, seen, before))
        if not found:
            usual[names[0]] = (before or Usual(seen)).after(seen)
        doubts += found
    uneven, shares = sides.cells(cycle, tracks.shares)
    return replace(tracks, usual=usual, shares=shares), doubts + uneven


def _held(tracks: Tracks, cycle: Cycle) -> tuple[Tracks, list[Doubt]]:
    """What holds at a constant frequency and level."""
    swing = looks.swung(cycle, tracks.swing)
    tracks = replace(tracks, swing=swing)
    doubts = [*looks.level(cycle), *looks.read_back(cycle)]
    doubts += [*looks.table_mean(cycle), *looks.mass_mean(cycle, swing)]
    seen = looks.transfer(cycle)
    f = round(cycle.omega / (2 * math.pi), 3)
    known = tracks.visits.get(f)
    if tracks.response is not None:
        known = transfer_at(tracks.response, f)
    if known is not None:
        doubts += looks.response(cycle, seen, known)
    table = seen[0]
    if not doubts and math.isfinite(abs(table)):
        visits = tracks.visits if f in tracks.visits else {**tracks.visits, f: table}
        tracks = replace(tracks, visits=visits)
    return tracks.following(table, f), doubts


def _turns(stretches: list[Stretch]) -> float:
    """Cycles that the drive turns in some stretches."""
    return sum(float(_steps(one.phase).sum()) for one in stretches)


def _steps(phase: Float1D) -> Float1D:
    """Advance of a phase in cycles from sample to sample, the last one repeated, (sample,)."""
    steps = np.diff(phase)
    steps -= np.floor(steps + 0.5)  # a drive may count its cycles anew
    return np.append(steps, steps[-1:])


def _joined(bench: Bench, stretches: list[Stretch]) -> Cycle:
    last = stretches[-1]
    phase = np.concatenate([one.phase for one in stretches])
    turned = np.cumsum(_steps(phase)[:-1])
    return Cycle(
        bench,
        np.concatenate([one.values for one in stretches], axis=1),
        np.concatenate([one.command for one in stretches]),
        phase[0] + np.concatenate([[0.0], turned]),
        last.level,
        last.label,
    )
