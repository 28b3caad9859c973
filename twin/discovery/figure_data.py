"""Data of the discovery figures: residual forces, close-ups, sensor checks.

"Before" is the base model alone, refitted; "after" includes the effects of the verdict. Both are
cross-validation residuals.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from table_io.block import Float1D, Float2D, Int1D, Label
from table_io.records import Step
from twin.discovery.candidates import Candidate
from twin.discovery.discover import Discovery, PreparedLog
from twin.discovery.law_search import LawProposal
from twin.discovery.localization import PHASES, classify_phases, is_stepped_sine
from twin.discovery.motion import MeasuredMotion
from twin.discovery.nuisances import resolve_samples
from twin.discovery.parameters import ParameterSet
from twin.discovery.residuals import FORCE_ROWS, LogResiduals
from twin.discovery.selection import FittedSet

MIN_ENTRIES = 20  # of a step in a residual row, for a close-up
CLOSE_UP_CYCLES = 2
CLOSE_UP_S = 3.0  # length of a close-up without steps
# of the rms of u: change from period to period above which a motion is not periodic
MAX_PERIOD_CHANGE = 0.3
# excess over the noise, and its standard errors, at which a sensor check fails
MIN_GATE_EXCESS, MIN_GATE_SIGMA = 0.1, 4.0
MAX_DRAWN_FREQUENCY = 8.0  # of the main frequency: of a force without an accelerometer
Pair = tuple[FittedSet, FittedSet]


@dataclass(frozen=True, eq=False)
class CloseUp:
    """Segment of a log shown in detail: title, direction and samples, (sample,)."""

    title: str
    direction: str
    samples: Int1D


@dataclass(frozen=True, eq=False)
class TermForces:
    """Forces of one or several terms on a log in N, (3, sample) each, as in `FORCE_ROWS`.

    `required` is measured minus model without the terms, `law` what they add. NaN where unused.
    """

    label: str
    required: Float2D
    law: Float2D

    @property
    def remaining(self) -> Float2D:
        """Measured minus model with the terms."""
        return self.required - self.law


@dataclass(frozen=True, slots=True)
class InstrumentGate:
    """Sensor check free of force laws: mean square or value over the noise, before and after."""

    log: str
    label: str
    before: float
    after: float
    passed: bool


@dataclass(frozen=True, eq=False)
class DiscoveryView:
    """Discovery with its logs, and derived quantities that several figures share."""

    discovery: Discovery
    logs: Sequence[PreparedLog]
    proposal: LawProposal | None = None  # then its law stands for the effects

    @cached_property
    def log_residuals(self) -> tuple[LogResiduals, ...]:
        """Residuals of each log at the samples: what is drawn."""
        return self._list_samples(self._best)

    def evaluate(self, fitted: FittedSet, log: int) -> Float1D:
        """Return the residual of a log over its noise at the samples, (entry,)."""
        return self._list_samples(fitted)[log].evaluate(fitted.fit.parameters)

    def _list_samples(self, fitted: FittedSet) -> tuple[LogResiduals, ...]:
        """Return the residuals at the samples, less the instrument errors fitted with a set.

        The samples of a row are those of the best set: contacts that the displacement shows move
        with the instrument errors.
        """
        known = self._sample_cache.get(fitted)
        if known is None:
            parameters = fitted.fit.parameters
            problem = self.discovery.prepared.problem
            known = tuple(resolve_samples(each, parameters) for each in problem.log_residuals)
            if fitted is not self._best:
                best = self.log_residuals
                known = tuple(
                    replace(each, fixed_mask=drawn.row_mask)
                    for each, drawn in zip(known, best, strict=True)
                )
            self._sample_cache[fitted] = known
        return known

    @cached_property
    def _sample_cache(self) -> dict[FittedSet, tuple[LogResiduals, ...]]:
        return {}

    @property
    def before_after(self) -> Pair:
        """Sets (before, after)."""
        return self.discovery.selection.null, self._best

    @property
    def _best(self) -> FittedSet:
        return self.proposal.fitted if self.proposal else self.discovery.verdict.best

    @property
    def models(self) -> tuple[FittedSet, FittedSet, FittedSet]:
        """Sets (model as given, refitted without an effect, with the effects)."""
        return (self.discovery.given, *self.before_after)

    @property
    def law(self) -> FittedSet | None:
        """Set whose force is drawn; None if nothing was found."""
        return self._best if self._best.effects else None

    @property
    def law_name(self) -> str:
        """Names of the terms whose force is drawn."""
        return " + ".join(format_term(term) for term in self._best.effects)

    def title_suffix(self, number: int) -> str:
        """Return " · log name" to append to a title; empty with a single log."""
        return (
            f" · {self.log_residuals[number].signals.name}" if len(self.log_residuals) > 1 else ""
        )

    def sweep_steps(self, number: int) -> tuple[Step, ...]:
        """Return the steps of a log; empty if its motion is no stepped sine."""
        return tuple(self.logs[number].steps) if is_stepped_sine(self.log_residuals[number]) else ()

    @cached_property
    def worst_log(self) -> int:
        """Number of the log with the largest residual before, used for the close-ups."""
        squares = [
            float(values @ values) / max(values.size, 1) for values in self.before_after[0].held_out
        ]
        return int(np.argmax(squares))

    @cached_property
    def law_forces(self) -> TermForces | None:
        """Forces of all terms that are drawn together; None if nothing was found."""
        if self.law is None:
            return None
        residuals = self.log_residuals[self.worst_log]
        return compute_term_forces(residuals, self.law.fit.parameters, self.law.effects)

    @cached_property
    def forces_of_each(self) -> tuple[TermForces, ...]:
        """Forces of each effect found; sensor errors have none."""
        residuals, parameters = self.log_residuals[self.worst_log], self._best.fit.parameters
        return tuple(
            compute_term_forces(residuals, parameters, [term])
            for term in self._best.effects
            if not term.channel
        )


def format_term(term: Candidate) -> str:
    """Return the name of an effect for a reader."""
    return f"{term.effect.title}: {term.effect.force}" if term.effect.is_of_file else term.name


def compute_term_forces(
    residuals: LogResiduals, parameters: ParameterSet, terms: Sequence[Candidate]
) -> TermForces:
    """Return the force that terms of a fitted set add, and what the measurement requires of it."""
    without = parameters
    for term in terms:
        without = term.remove_from(without)
    required, remaining = (
        residuals.force_errors(own, residuals.motion(own.assumed_sensors()))
        for own in (without, parameters)
    )
    if residuals.whitening is not None:
        # the force of inertia is then a second derivative, whose noise would hide any law
        omega = residuals.signals.omega * residuals.scale.time_s
        gain = 1.0 / (1.0 + (omega / MAX_DRAWN_FREQUENCY) ** 8)
        for force in (required[0], remaining[0]):
            usable = np.where(residuals.signals.good, force, 0.0)  # not at an open end
            force[:] = residuals.signals.grid.apply_gain(usable, gain)
    unused = ~residuals.row_mask[: len(FORCE_ROWS)]
    required[unused], remaining[unused] = np.nan, np.nan
    label = " + ".join(format_term(term) for term in terms)
    return TermForces(label, required, required - remaining)


def entries_to_samples(
    residuals: LogResiduals, row: int, values: Float1D, parameters: ParameterSet
) -> Float1D:
    """Return the entries of a row as samples, (sample,), in N for a force; NaN without entry.

    `parameters` must be those of the residual: they determine its noise.
    """
    in_row = residuals.entry_row == row
    samples = np.full(residuals.signals.time_s.size, np.nan)
    samples[residuals.entry_sample[in_row]] = values[in_row] * residuals.entry_weight[in_row]
    if not is_force(residuals, row):
        return samples
    m, mass = _assumed_motion(residuals, parameters)
    return samples * float(residuals.force_noise(m, mass)[row])


def _assumed_motion(
    residuals: LogResiduals, parameters: ParameterSet
) -> tuple[MeasuredMotion, float]:
    """Return (motion, mass in kg) with the sensor errors and the mass of a parameter set."""
    m = residuals.motion(parameters.assumed_sensors())
    return m, parameters.model_for_log(residuals.log_number, m).parameters.mass


def is_force(residuals: LogResiduals, row: int) -> bool:
    """Return False if a row is whitened or no force; it is then shown relative to its noise."""
    return row < len(FORCE_ROWS) and not (row == 0 and residuals.whitening is not None)


def measured_forces(residuals: LogResiduals, parameters: ParameterSet) -> list[Float1D]:
    """Return measured damper force, F_R, -F_L in N, (sample,) each, for the parameters' sensors."""
    m, mass = _assumed_motion(residuals, parameters)
    if m.damper is not None:
        return [m.damper, m.right, m.left]
    bumper_force = m.right - m.left if m.has_load_cells else 0.0
    return [-mass * m.acc - bumper_force, m.right, m.left]


def select_close_ups(residuals: LogResiduals, steps: Sequence[Step], row: int) -> list[CloseUp]:
    """Select close-ups with samples in a row: lowest, highest and largest-amplitude step.

    Without steps: segments of small, medium and large motion.
    """
    m, used = residuals.motion(), residuals.row_mask[row]
    sizes: dict[int, float] = {}
    for step in steps:
        measured = used & (m.step == step.index) & (m.label == Label.MEASURE)
        if measured.sum() >= MIN_ENTRIES:
            sizes[step.index] = float(np.abs(m.u[measured]).max())
    if not sizes:
        return [] if steps else _select_stretches(residuals, row)
    directions = [step.direction for step in steps if step.index in sizes]
    direction = max(directions, key=directions.count)  # the first one if equal
    candidates = [step for step in steps if step.index in sizes and step.direction == direction]
    candidates.sort(key=lambda step: step.frequency_hz)
    inner = candidates[1:-1] or candidates
    largest = max(inner, key=lambda step: sizes[step.index])
    chosen = {step.index: step for step in (candidates[0], largest, candidates[-1])}
    return [
        CloseUp(
            f"{step.frequency_hz:g} Hz {step.direction}",
            step.direction,
            _last_cycles(residuals, step.index),
        )
        for step in chosen.values()
    ]


def _last_cycles(residuals: LogResiduals, index: int) -> Int1D:
    """Return the samples of the last `CLOSE_UP_CYCLES` cycles of a step."""
    m = residuals.motion()
    in_step = (m.step == index) & (m.cycle >= 0)
    samples: Int1D = np.flatnonzero(in_step & (m.cycle > m.cycle[in_step].max() - CLOSE_UP_CYCLES))
    return samples


def _select_stretches(residuals: LogResiduals, row: int) -> list[CloseUp]:
    m, used = residuals.motion(), residuals.row_mask[row]
    width = max(round(CLOSE_UP_S * m.rate_hz), 1)
    starts = [k for k in range(0, used.size, width) if used[k : k + width].sum() >= MIN_ENTRIES]
    ranked = sorted(starts, key=lambda k: float(np.abs(m.u[k : k + width]).max()))
    places = dict.fromkeys((len(ranked) // 2, 4 * len(ranked) // 5, len(ranked) - 1))
    return [
        CloseUp(
            f"from {m.time_s[ranked[place]]:.0f} s",
            "forward",
            np.arange(ranked[place], min(ranked[place] + width, used.size)),
        )
        for place in places
        if 0 <= place < len(ranked)
    ]


def is_periodic(residuals: LogResiduals, step: Step) -> bool:
    """Return False if u differs between the measured periods: chaotic or transient motion."""
    m = residuals.motion()
    samples = np.flatnonzero((m.step == step.index) & (m.label == Label.MEASURE))
    if samples.size < m.rate_hz / step.frequency_hz * 1.5:
        return True
    t, u = m.time_s[samples], m.u[samples]
    first_periods = t + 1.0 / step.frequency_hz <= t[-1]
    change = np.interp(t[first_periods] + 1.0 / step.frequency_hz, t, u) - u[first_periods]
    return float(change.std()) <= MAX_PERIOD_CHANGE * float(u.std())


def check_instruments(view: DiscoveryView) -> list[InstrumentGate]:
    """Return the sensor checks of every log: consistency of redundant sensors, rest values."""
    gates = []
    for residuals, *held_out in zip(
        view.discovery.prepared.problem.log_residuals,
        *(fitted.held_out for fitted in view.before_after),
        strict=True,
    ):
        name = residuals.signals.name
        for row, name_of_row in enumerate(residuals.rows):
            in_row = residuals.entry_row == row
            if row < len(FORCE_ROWS) or not in_row.any():
                continue
            squares = [(r * residuals.entry_weight)[in_row] ** 2 for r in held_out]
            blocks = np.unique(residuals.entry_block[in_row], return_inverse=True)[1]
            sums = np.bincount(blocks, weights=squares[0] - 1.0)
            sigma = sums.sum() / max(math.sqrt(float(sums @ sums)), 1e-300)
            before, after = (float(values.mean()) for values in squares)
            quantity = "equal forces" if "cells" in name_of_row else "consistent motion"
            label = f"{name_of_row}: {quantity}"
            is_healthy = before < 1 + MIN_GATE_EXCESS or sigma < MIN_GATE_SIGMA
            gates.append(InstrumentGate(name, label, before, after, is_healthy))
        at_rest = residuals.entry_row == len(residuals.rows)
        rest_values = (
            (r * residuals.entry_weight)[at_rest][: len(residuals.rest_channels)] for r in held_out
        )
        values = zip(residuals.rest_channels, *rest_values, strict=True)
        for channel, before, after in values:
            label = f"{channel} at rest"
            gates.append(
                InstrumentGate(
                    name, label, float(before), float(after), abs(before) < MIN_GATE_SIGMA
                )
            )
    return gates


def list_phases(residuals: LogResiduals, row: int) -> list[str]:
    """Return the contact phases in which a row has entries."""
    return [PHASES[k] for k in np.unique(classify_phases(residuals)[residuals.entry_row == row])]
