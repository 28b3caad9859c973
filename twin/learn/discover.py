"""Find, name, add, show: from the readings of logs and a model to what the model lacks."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from table_io.block import Float1D
from table_io.card import BadInput
from table_io.records import Step
from twin.learn.fit import Fit, Mapped, fit
from twin.learn.guess import (
    GAP,
    INPUT_GAIN,
    INPUT_OFFSET,
    SENSOR,
    ZERO,
    Free,
    Guess,
    base_free,
    effects_of,
    log_of,
)
from twin.learn.library import Candidate, candidates
from twin.learn.naming import Bench, Explained, Named, Tell, Trying, named
from twin.learn.readings import Readings, derives_acc
from twin.learn.sheet import Sheet, sheets_of
from twin.learn.verdict import Verdict, judge
from twin.learn.where import Cell, Where, cells, pulling, repeated, where
from twin.model.model import Model

LEAST_ENTRIES, LEAST_BLOCKS = 1000, 9
MODEL_LIMITED = 50.0  # rms over the noise: from here on noise is not what limits the model
FAR = 1.5  # a parameter so many times that of the model is not the same specimen


@dataclass(frozen=True, eq=False)
class Log:
    """A recording made ready: what it holds, from which force on there is contact, its steps."""

    readings: Readings
    contact_n: float
    steps: tuple[Step, ...] = ()


@dataclass(frozen=True, eq=False)
class Prepared:
    """The bench of a set of logs, the first fit on it, what fell away, what to say."""

    bench: Bench
    first: Fit
    away: dict[str, str]
    notes: tuple[str, ...]

    @property
    def guess(self) -> Guess:
        return self.first.guess


@dataclass(frozen=True, eq=False)
class Discovery:
    """All that was found. `map_before` and `map_after` are of what was held out."""

    prepared: Prepared
    named: Named
    verdict: Verdict
    where: Where
    map_before: tuple[Cell, ...]
    map_after: tuple[Cell, ...]
    notes: tuple[str, ...]

    @property
    def model(self) -> Model:
        """The model with the effects found, sensors apart."""
        return self.verdict.best.fit.guess.model()


def prepare(
    logs: Sequence[Log], model: Model, without: Sequence[str] = (), each: Mapped = map
) -> Prepared:
    """The logs on one bench, with the noise that the model's own stiffnesses make of the sensors'.

    `without` leaves effects out of the library. BadInput where there is too little to learn from.
    """
    if not logs:
        raise BadInput("no log; give at least one recording")
    pairs = [(log.readings, log.contact_n) for log in logs]
    sheets = sheets_of(pairs, model)
    for sheet in sheets:
        _enough(sheet)
    guess, free = start(sheets, model)
    first = fit(sheets, guess, free, each=each)
    sheets = sheets_of(pairs, first.guess.model())
    first = fit(sheets, first.guess, free, each=each)
    rms = [_rms(sheet.residual(first.guess)) for sheet in sheets]
    notes = []
    if (thinned := sheets[0].thinned) > 1:
        notes.append(
            f"so much was recorded that of each step's cycles only the last are used, one in "
            f"{thinned}, at least two"
        )
    if min(rms) > MODEL_LIMITED:
        sheets = sheets_of(pairs, first.guess.model(), rms)
        notes.append(
            f"the model misses by {min(rms):.0f} times the noise and more: each log counts the "
            "same, whatever its noise"
        )
    library, away = candidates(sheets, guess, without)
    return Prepared(Bench(sheets, free, library, each), first, away, tuple(notes))


def start(sheets: Sequence[Sheet], model: Model) -> tuple[Guess, tuple[Free, ...]]:
    """(where a fit of the model starts, what it may move)."""
    touched = [bool((sheet.touched != 0).any()) for sheet in sheets]
    own = any(
        derives_acc(sheet.readings.channels) and "damper_force_n" not in sheet.readings.channels
        for sheet in sheets
    )
    guess = Guess.of(model, len(sheets))
    if own:
        guess = guess.moved({INPUT_GAIN: _input_gain(sheets[0], model), INPUT_OFFSET: 0.0})
    doubt = [{what: one.readings.at_rest(what)[1] for what in one.readings.zeros} for one in sheets]
    guess = guess.moved({f"{ZERO}{k}.{what}": 0.0 for k, log in enumerate(doubt) for what in log})
    return guess, (*base_free(model, touched, own, doubt), *effects_of(model))


def _input_gain(sheet: Sheet, model: Model) -> float:
    """A first estimate: the input that it would take, by the model, against the one measured."""
    m, p = sheet.motion(), model.parameters
    needed = m.acc - m.table_acc + (p.stiffness * m.u + p.damping * m.v) / p.mass
    there = m.table_acc
    slope = float(np.nanmean(needed * there) / max(float(np.nanmean(there**2)), 1e-300))
    return 1.0 / abs(slope) if slope else 1.0


def _enough(sheet: Sheet) -> None:
    entries, blocks = sheet.row_of.size, np.unique(sheet.block_of).size
    if entries < LEAST_ENTRIES or blocks < LEAST_BLOCKS:
        raise BadInput(
            f"{sheet.readings.name}: {entries} usable samples in {blocks} cycles are too few to "
            f"learn from; needed: {LEAST_ENTRIES} in {LEAST_BLOCKS}; record a longer test"
        )


def far(model: Model, found: Fit) -> list[str]:
    """Sentences about parameters that are not those of the same specimen."""
    flat, notes = model.flat(), []
    for one in found.free:
        was, now = flat.get(one.keys[0], 0.0), found.values[one.name]
        apart = was > 0 and one.unit in ("N/m", "N s/m") and not was / FAR < now < was * FAR
        if apart and now > 0:
            notes.append(
                f"{one.name}: the recording says {now:.4g} {one.unit}, the model {was:.4g}; is "
                "this the model of this specimen, and its mass right?"
            )
        if one.name.startswith(GAP) and log_of(one.name) is not None and abs(now) > 1e-3:
            notes.append(f"{one.name}: each gap is {1e3 * now:+.2f} mm off what the log says")
    return notes


def _rms(residual: Float1D) -> float:
    return math.sqrt(float(residual @ residual) / max(residual.size, 1))


def discover(
    logs: Sequence[Log],
    model: Model,
    tell: Tell = lambda now: None,
    without: Sequence[str] = (),
    each: Mapped = map,
    fitted: bool = False,
) -> Discovery:
    """What the model lacks of what the logs say; see `verdict`.

    `each` is a map on more cores. `fitted`: the model's numbers come from recordings, where they
    have taken up what it lacks: then they are no second opinion on those found here.
    """
    tell(Trying("the model as it is"))
    prepared = prepare(logs, model, without, each)
    bench = prepared.bench
    found = named(bench, prepared.guess, tell)
    steps = [log.steps for log in logs]
    least = min(one.weight for one in bench.sheets) ** -2
    # what is left cannot be less than the noise: where it is, the noise was overrated
    floor = min(least * repeated(bench.sheets, found.best.left), found.best.cost)
    verdict = judge(bench, found, floor, {} if fitted else model.flat(), least)
    # with the effects found the base may be the specimen's again: what is far off then is said
    pulls = pulling(bench.sheets, verdict.best.left)
    notes = (*prepared.notes, *far(model, verdict.best.fit), *pulls)
    before = cells(bench.sheets, found.null.left, floor)
    seen = where(bench.sheets, found.null.left, before, steps)
    after = cells(bench.sheets, verdict.best.left, floor)
    return Discovery(prepared, found, verdict, seen, before, after, notes)


def structured(logs: Sequence[Log], model: Model, effects: Sequence[str]) -> Explained | None:
    """Exactly these effects with the base, fitted: what an oracle would reach. None: unknown."""
    prepared = prepare(logs, model)
    known = {one.name: one for one in prepared.bench.library}
    if not set(effects) <= known.keys():
        return None
    best = None
    chosen: list[Candidate] = [known[name] for name in effects]
    for rung in range(max((len(one.shapes) for one in chosen), default=1)):
        guess = prepared.guess
        for one in chosen:
            shape = one.shapes[min(rung, len(one.shapes) - 1)]
            guess = one.put(guess, shape, _little(one))
        found = fit(prepared.bench.sheets, guess, prepared.bench.free(chosen))
        if best is None or found.cost < best.cost:
            best = found
    return prepared.bench.explain(best.guess, chosen) if best else None


def _little(one: Candidate) -> float:
    free = one.amplitude
    return min(max(one.vanishing + 1e-3 * free.scale, free.low), free.high)


def transferred(log: Log, found: Explained) -> float:
    """NRMSE of the damper's force on a log that nothing was fitted on, gaps as that log says."""
    guess = found.fit.guess
    own = Guess.of(guess.model(), 1).moved(
        {name: value for name, value in guess.values.items() if name.startswith(SENSOR)}
    )
    (sheet,) = sheets_of([(log.readings, log.contact_n)], guess.model())
    motion = sheet.motion(own.sensors())
    mass = own.local(0, motion).parameters.mass
    damper = sheet.row_of == 0
    left = sheet.residual(own)[damper] * sheet.noise(motion, mass)[0]
    there = sheet.measured(motion, mass)[0][sheet.sample_of[damper]]
    return float(left.std() / there.std())
