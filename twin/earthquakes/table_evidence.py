"""Which effects of its library a table has, by the evidence that names those of a specimen.

The rows are the residuals of the table's equation, `RehearsalProblem`, about a fitted twin; the
candidates the effects of LIBRARY; the stranger an unknown smooth force on the table, or change of
its command, by place. All slopes are differences of simulations. Along a simulated motion no slope
carries noise, so none is taken off. How loud the noise is no rehearsal says beforehand: it is what
the richest model leaves, the stranger at every place and the best effects.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from table_io.block import Float1D
from twin.earthquakes.table_effects import LIBRARY, UNTESTED, TableEffect
from twin.earthquakes.table_identification import (
    BOUNDS,
    MAX_WORSE_RATIO,
    RehearsalProblem,
    TableFit,
    build_parameters,
    fit_basic_twin,
    fit_table,
)
from twin.earthquakes.table_model import TableModel
from twin.evidence.linear import (
    CROSSED_HATS,
    HATS,
    UNKNOWN_ERROR_SHARE,
    LinearEvidence,
    Variant,
    absorb_base,
    list_hats,
)
from twin.evidence.selection import RoundEffort, Selection, SelectionProgress, search_sets
from twin.evidence.verdict import MAX_LEVEL, SelectionVerdict, judge_selection
from twin.system.process_pool import map_in_threads

MAX_EFFECTS, MAX_ROUNDS, MAX_REFITS = 2, 3, 3
FOLD_COUNT = 3  # blocks of time are held out by turns
MAX_EVALUATIONS = 12  # of a fit with an effect, which begins near its solution
REWEIGHTED_EVALUATIONS = 4  # of one of which only the weights have changed
WARM_TOLERANCE = 1e-3  # relative fall of the squares at which that fit ends
MAX_WARM_GAP = 0.25  # beyond it the parameters of the twin without the effect are no start
LEAST_NOISE = 1e-4  # of the motion: no reading is better, and the noise is never taken as less
STRANGER_STEP = 0.01  # of the force or the command, by which the stranger's slopes are taken
HAT_WIDTH = 3.0  # rms values of a quantity up to which there are hats of it


@dataclass(frozen=True, eq=False)
class FittedTable:
    """Twin fitted with some effects, and its residuals on held-out blocks."""

    effects: tuple[TableEffect, ...]
    fit: TableFit

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(effect.id for effect in self.effects)

    @cached_property
    def held_out(self) -> Float1D:
        """Residuals after a Gauss-Newton step without their own blocks, (residual - 1,)."""
        left, block = self.fit.residuals.copy(), self.fit.problem.block
        for fold in range(FOLD_COUNT):
            inside = (block >= 0) & (block % FOLD_COUNT == fold)
            left[inside] += self.fit.jacobian[inside] @ self.fit.step_without(inside)
        return left[:-1]

    @property
    def gap(self) -> float:
        """Rms of the held-out residuals over that of the measured motion."""
        return float(np.linalg.norm(self.held_out))

    @property
    def unit(self) -> float:
        """Size of a residual of the least noise."""
        return LEAST_NOISE / math.sqrt(self.fit.residuals.size)

    @property
    def cost(self) -> float:
        return float(np.mean(self.held_out**2)) / self.unit**2

    @property
    def squares(self) -> float:
        return self.fit.cost / self.unit**2


@dataclass(frozen=True, eq=False)
class TableProblem:
    """Rehearsal, twin and library of a selection; `levels` are those of the noise seen so far."""

    rehearsal: RehearsalProblem
    library: tuple[TableEffect, ...] = LIBRARY
    levels: list[float] = field(default_factory=list)

    @property
    def limits(self) -> Mapping[str, Sequence[str]]:
        return {}

    def linearize(
        self, current: FittedTable, tried: Sequence[FittedTable]
    ) -> LinearEvidence[TableEffect]:
        """Return the linear model about a set, its own effects by the secants to their absence.

        So that model leaves of the set what its fit leaves, however large its effects are.
        """
        fit, unit = current.fit, current.unit
        is_base = np.isin(fit.names, [*BOUNDS]) & fit.is_free
        values, steps, secants = fit.scaled_values, [fit.residuals], []
        for effect in current.effects:
            size = values[effect.amplitude.name]
            values |= {effect.amplitude.name: 0.0}
            steps.append(self._evaluate(values))
            secants.append((steps[-2] - steps[-1]) / (size or math.inf))
        own = [
            Variant(effect, tuple(fit.scaled_values[p.name] for p in effect.parameters[1:]),
                    int(effect.amplitude.low >= 0.0))
            for effect in current.effects
        ]  # fmt: skip
        trials = [
            (effect, trial)
            for effect in self.library
            for trial in effect.trials
            if effect not in current.effects
        ]
        slopes = map_in_threads(lambda pair: self._find_slope(fit, *pair), trials)
        variants = own + [
            Variant(effect, trial[1:], int(effect.amplitude.low >= 0.0)) for effect, trial in trials
        ]
        forces = list_stranger_forces(fit)
        strangers = map_in_threads(lambda pair: self._move_stranger(fit, *pair[1:]), forces)
        of_places = np.array([place for place, _, _ in forces])
        places = {
            str(place): len(variants) + np.flatnonzero(of_places == place)
            for place in dict.fromkeys(of_places)
        }
        base = fit.jacobian.T[is_base]
        columns = np.array([*base, *secants, *slopes, *strangers, steps[-1]]) / unit
        columns[~np.isfinite(columns).all(axis=1)] = 0.0
        block = fit.problem.block
        evidence = absorb_base(
            columns, np.zeros((len(columns), len(columns))), len(base),
            np.where(block < 0, block.max() + 1, block), tuple(variants), places, 1.0 / unit,
            range(len(own)), np.ones(columns.shape[1]), UNKNOWN_ERROR_SHARE,
        )  # fmt: skip
        self.levels.append(evidence.level)
        return evidence

    def refit(
        self, current: FittedTable, chosen: Sequence[tuple[Variant[TableEffect], float]]
    ) -> FittedTable:
        """Return a fit with variants in place of a set's effects, from the best of some sizes."""
        effects = tuple(variant.candidate for variant, _ in chosen)
        base = {name: current.fit.scaled_values[name] for name in BOUNDS}
        sizes: dict[str, float] = {}
        for variant, size in chosen:
            own = variant.candidate.amplitude
            values = (min(max(size, own.low), own.high), *variant.shape)
            sizes |= _name_values(variant.candidate, values)
        trials = [sizes] + [
            sizes | _name_values(effect, trial) for effect in effects for trial in effect.trials
        ]
        starts = [base | trial for trial in trials]
        misfits = map_in_threads(self.rehearsal.measure_misfit, starts)
        start = starts[int(np.argmin(misfits))]
        after = _fit_effects(self.rehearsal, effects, start)
        if min(misfits) > MAX_WARM_GAP:
            bounds = {name: ends for effect in effects for name, ends in effect.bounds.items()}
            from_nothing = FittedTable(effects, fit_basic_twin(self.rehearsal, bounds, trials))
            after = min(after, from_nothing, key=lambda fitted: fitted.squares)
        return after

    def leaves_noise(self, fitted: FittedTable) -> bool:
        """Return True if a set leaves no more than the richest model that was seen."""
        return fitted.cost <= MAX_LEVEL * min(self.levels, default=math.inf)

    def select_simplest(self, fitted_sets: Sequence[FittedTable]) -> FittedTable:
        """Return the set with the fewest effects that is not worse on held-out blocks."""
        least = min(fitted.gap for fitted in fitted_sets)
        good = [fitted for fitted in fitted_sets if fitted.gap <= MAX_WORSE_RATIO * least]
        return min(good, key=lambda fitted: (len(fitted.effects), fitted.gap))

    def _evaluate(self, scaled_values: Mapping[str, float]) -> Float1D:
        values = np.array([*scaled_values.values()])
        parameters = build_parameters(tuple(scaled_values), values, self.rehearsal)
        return self.rehearsal.compute_residuals(parameters)

    def _find_slope(self, fit: TableFit, effect: TableEffect, trial: tuple[float, ...]) -> Float1D:
        """Return the change of the residuals per size of an effect, (residual,), at its trial."""
        after = self._evaluate(fit.scaled_values | _name_values(effect, trial))
        return (after - fit.residuals) / trial[0]

    def _move_stranger(self, fit: TableFit, force_n: Float1D, command_m: Float1D) -> Float1D:
        """Return the change of the residuals by a force on the table and a part of its command."""
        motion = fit.problem.motion
        moved = replace(
            motion,
            reaction_n=motion.reaction_n + force_n,
            command_m=motion.command_m + command_m,
        )
        problem = replace(fit.problem, motion=moved)
        return (problem.compute_residuals(fit.parameters) - fit.residuals) / STRANGER_STEP


def _name_values(effect: TableEffect, values: Sequence[float]) -> dict[str, float]:
    return dict(zip((parameter.name for parameter in effect.parameters), values, strict=True))


def list_stranger_forces(fit: TableFit) -> list[tuple[str, Float1D, Float1D]]:
    """Return (place, force on the table in N, change of its command in m) of each column.

    Hat functions, (sample,), of what either can depend on along the motion of a twin: speed,
    stroke, acceleration, direction and time, each as large as STRANGER_STEP of the inertial force
    or of the command.
    """
    motion = fit.problem.motion
    y, a = TableModel(fit.problem.mass_kg, fit.parameters).simulate(
        motion.command_m, motion.rate_hz, motion.reaction_n
    )
    v = np.gradient(y) * motion.rate_hz
    stroke, speed, acceleration = (
        row / max(HAT_WIDTH * float(np.sqrt(np.mean(row**2))), 1e-300) for row in (y, v, a)
    )
    direction = np.tanh(5.0 * HAT_WIDTH * speed)
    time = np.linspace(0.0, 1.0, y.size)
    force_n = STRANGER_STEP * fit.problem.mass_kg * float(a.std())
    command_m = STRANGER_STEP * float(motion.command_m.std())
    rows = {
        "friction": [
            *list_hats(speed, HATS), *list_hats(stroke, HATS),
            *(hat * direction for row in (stroke, acceleration)
              for hat in list_hats(row, CROSSED_HATS)),
        ],
        "friction over time": [direction * time, speed * time],
    }  # fmt: skip
    changes = {
        "valve and oil": [
            *list_hats(speed, HATS), *list_hats(acceleration, HATS),
            *(hat * direction for hat in list_hats(acceleration, CROSSED_HATS)),
        ],
        "stroke loop over time": [speed * time, acceleration * time],
    }  # fmt: skip
    nothing = np.zeros(y.size)
    return [
        *((place, force_n * row, nothing) for place, own in rows.items() for row in own),
        *((place, nothing, command_m * row) for place, own in changes.items() for row in own),
    ]


@dataclass(frozen=True, eq=False)
class EffectDiscovery:
    """Which effects a table has: the selection, its verdict, and the twin without and with them.

    `fitted` has the effects that are named, or closest where none explains the rehearsal, unless it
    is worse with them.
    """

    selection: Selection[FittedTable, TableEffect]
    verdict: SelectionVerdict[FittedTable]
    basic: FittedTable
    fitted: FittedTable


_Searched = tuple[TableProblem, Selection[FittedTable, TableEffect]]


def _fit_effects(
    rehearsal: RehearsalProblem,
    effects: Sequence[TableEffect],
    start: Mapping[str, float],
    evaluations: int = MAX_EVALUATIONS,
) -> FittedTable:
    """Return a fit with some effects, from values near it."""
    free = {**BOUNDS, **{name: ends for effect in effects for name, ends in effect.bounds.items()}}
    start = {name: start[name] for name in free}
    fit = fit_table(rehearsal, free, start, evaluations, WARM_TOLERANCE)
    return FittedTable(tuple(effects), fit)


def discover_table_effects(
    basic: TableFit, report: Callable[[str], None] = lambda stage: None
) -> EffectDiscovery:
    """Find which effects of LIBRARY the basic twin lacks; `report` gets the stage in words."""

    def tell(progress: SelectionProgress[FittedTable]) -> None:
        names = _join_names(progress.names)
        report(f"fitting {names}" if names else "comparing the effects of a table")

    def search(about: FittedTable, null: FittedTable, count: int) -> _Searched:
        """Search with the weights by which what a set leaves is white."""
        rehearsal = about.fit.problem.whiten(about.fit)
        null, *first = (
            _fit_effects(rehearsal, each.effects, each.fit.scaled_values, REWEIGHTED_EVALUATIONS)
            for each in dict.fromkeys((null, about))
        )
        problem = TableProblem(rehearsal)
        rounds = (RoundEffort(max_effects=MAX_EFFECTS, max_refits=MAX_REFITS),) * count
        return problem, search_sets(problem, null, tell, first[0] if first else None, rounds)

    without = FittedTable((), basic)
    problem, selection = search(without, without, 1)
    if selection.best.effects:
        problem, selection = search(selection.best, selection.null, MAX_ROUNDS)
    verdict = judge_selection(problem, selection)
    fitted = without
    if (best := verdict.best).effects:
        own = _fit_effects(basic.problem, best.effects, best.fit.scaled_values)
        fitted = min(own, without, key=lambda each: each.gap)
    return EffectDiscovery(selection, verdict, without, fitted)


def _join_names(names: Sequence[str]) -> str:
    """Return the names of effects as words."""
    return " and ".join(name.replace("_", " ") for name in names)


def describe_discovery(discovery: EffectDiscovery) -> list[str]:
    """Return the outcome in words, a line each: verdict, effects, what is not judged."""
    verdict = discovery.verdict
    fitted, without = discovery.fitted, discovery.basic
    widths, parameters = fitted.fit.estimate_half_widths(), fitted.fit.parameters
    lines = [
        f"missing effects: {verdict.outcome}, with a probability of {verdict.confidence:.3g}: "
        f"{verdict.reason}"
    ]
    if dropped := [name for name in verdict.best.names if name not in fitted.names]:
        names = _join_names(dropped)
        lines.append(f"  not kept in the twin, which predicts better without: {names}")
    if verdict.place:
        lines.append(f"  what no effect explains lies in: {verdict.place}")
    for effect in fitted.effects:
        lines.append(f"{effect.id.replace('_', ' ')}: {effect.description}")
        lines.append(f"  equation: {effect.equation} ({effect.source})")
        for parameter in effect.parameters:
            value = getattr(parameters, parameter.name)
            lines.append(
                f"  {parameter.name} = {value:.4g} +- {widths[parameter.name]:.2g} {parameter.unit}"
                f" (95 %): {parameter.meaning}"
            )
    change = f"{100 * without.gap:.3g} % -> " if fitted.effects else ""
    lines.append(f"  left on held-out data: {change}{100 * fitted.gap:.3g} % of the motion")
    for other in verdict.alternatives:
        lines.append(f"  cannot be told apart from {_join_names(other.names)}")
    lines.append("cannot be judged from this rehearsal:")
    lines += [f"  {name}: {reason}" for name, reason in UNTESTED.items()]
    return lines
