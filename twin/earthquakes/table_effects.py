"""Missing effects of a table: library, and which of them a rehearsal shows.

The basic twin of `table_identification.py` is fitted first. Every effect of LIBRARY is screened:
its slope, the change of the residuals by a small size of it, is added to those of the basic
parameters, and the linear problem is solved and judged by three-fold cross-validation over blocks
of time. The few that promise most are fitted in full together with all basic parameters, and judged
again on blocks that the last step did not use. An effect is named if its gain there is a clear
share of the residual squares, is many standard errors of the scatter over the blocks, and if its
interval excludes 0. A second effect is looked for on top of the first.

No term of a twin is exact, so that some further term always reduces the residuals by a little: the
limits below are therefore shares, not the chance of a given noise.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from table_io.block import Float1D, Float2D
from twin.earthquakes.table_identification import (
    BOUNDS,
    TableFit,
    build_parameters,
    fit_basic_twin,
    fit_table,
)
from twin.earthquakes.table_model import TableParameters
from twin.system.process_pool import map_in_threads

FOLD_COUNT = 3  # blocks of time are held out by turns
MAX_EFFECTS = 2
MAX_REFITS = 2  # candidates that are fitted in full in a round
MIN_PROMISED_SHARE = 0.03  # of the held-out squares: a candidate that promises less is not fitted
MIN_GAIN_SHARE = 0.1  # of the held-out squares that an effect must remove
MIN_GAIN_SIGMA = 4.0  # standard errors of its gain, from the scatter over the blocks
MIN_EFFECT_SIGMA = 2.0  # half widths of its 95 % interval by which its size must differ from 0
RIVAL_SHARE = 0.8  # of the gain of the best: another effect with as much is not told apart
MAX_EVALUATIONS = 12  # of a fit with an effect, which begins near its solution
MAX_WARM_GAP = 0.25  # beyond it the parameters of the twin without the effect are no start


@dataclass(frozen=True)
class TableEffectParameter:
    """Parameter of an effect in SI: typical (its size for screening), smallest, largest value."""

    name: str
    unit: str
    typical: float
    low: float
    high: float
    meaning: str


@dataclass(frozen=True)
class TableEffect:
    """An effect that a table may have: its first parameter makes it vanish at 0.

    `trials` are the values with which it is screened, of all its parameters in their order.
    """

    id: str
    description: str
    equation: str
    source: str
    parameters: tuple[TableEffectParameter, ...]
    trials: tuple[tuple[float, ...], ...]

    @property
    def bounds(self) -> dict[str, tuple[float, float, float]]:
        """Return typical, smallest and largest value by name, as those of BOUNDS."""
        return {
            parameter.name: (parameter.typical, parameter.low, parameter.high)
            for parameter in self.parameters
        }


def _list_trials(*sizes: float) -> tuple[tuple[float, ...], ...]:
    return tuple((size,) for size in sizes)


LIBRARY: tuple[TableEffect, ...] = (
    TableEffect(
        "dead_band",
        "dead band of the valve: the spool overlaps its ports",
        "u -> u - d_v sat(u / d_v)",
        "Merritt, Hydraulic Control Systems (1967), chapter 5",
        (
            TableEffectParameter(
                "dead_band_m_s", "m/s", 1e-3, 0.0, 0.1, "No-load speed lost on either side."
            ),
        ),
        _list_trials(1e-4, 5e-4, 1.5e-3, 4e-3, 1e-2),
    ),
    TableEffect(
        "valve_hysteresis",
        "hysteresis of the valve: its opening depends on the direction of its last motion",
        "u -> u - w_h z_h / 2, z_h' = 2 u' / w_h (1 - z_h sign(u'))",
        "Merritt (1967), chapter 7; loop of Dahl, Aerospace Corp. TOR-0158 (1968)",
        (
            TableEffectParameter(
                "valve_hysteresis_m_s", "m/s", 1e-3, 0.0, 0.1, "Width of the loop, no-load speed."
            ),
        ),
        _list_trials(2e-4, 1e-3, 3e-3, 8e-3),
    ),
    TableEffect(
        "flow_asymmetry",
        "flow that differs with direction: unequal piston areas or ports of the valve",
        "u -> u (1 + a_u sign(u))",
        "Merritt (1967), chapter 6",
        (
            TableEffectParameter(
                "flow_asymmetry", "", 0.02, -0.6, 0.6, "Half the difference over the mean."
            ),
        ),
        _list_trials(0.05),
    ),
    TableEffect(
        "friction_drift",
        "friction that drifts with time, as oil and seals warm up",
        "F -> (1 + d_F t) F",
        "Merritt (1967), chapter 1: viscosity of oil over temperature",
        (
            TableEffectParameter(
                "friction_drift_1_s", "1/s", 2e-3, -0.02, 0.05, "Relative change per time."
            ),
        ),
        _list_trials(2e-3),
    ),
    TableEffect(
        "friction_asymmetry",
        "friction that differs with direction",
        "z -> +-(1 + a_F sign(v)) instead of +-1, of the same stiffness",
        "Armstrong-Hélouvry et al., Automatica 30 (1994) 1083",
        (
            TableEffectParameter(
                "friction_asymmetry", "", 0.02, -0.8, 0.8, "Half the difference over the mean."
            ),
        ),
        _list_trials(0.05),
    ),
    TableEffect(
        "friction_slope",
        "friction that changes along the stroke",
        "z -> +-(1 + g_F (y - y_f)) instead of +-1, of the same stiffness",
        "Armstrong-Hélouvry et al. (1994)",
        (
            TableEffectParameter(
                "friction_slope_1_m", "1/m", 2.0, -200.0, 200.0, "Relative change per length."
            ),
        ),
        _list_trials(5.0),
    ),
    TableEffect(
        "backlash",
        "backlash of the coupling between piston and table",
        "f -> f - K b/2 sat(2 f / (K b))",
        "Nordin, Gutman, Automatica 38 (2002) 1633",
        (
            TableEffectParameter(
                "backlash_m", "m", 1e-5, 0.0, 5e-3, "Free travel from stop to stop."
            ),
        ),
        _list_trials(3e-6, 1e-5, 4e-5, 1.5e-4),
    ),
    TableEffect(
        "transducer_gain",
        "gain error of the transducer that closes the stroke loop",
        "q_t = (1 + g_t) (y - y_f)",
        "Conte, Trombetti, Earthquake Engng Struct. Dyn. 29 (2000) 1375",
        (
            TableEffectParameter(
                "transducer_gain_error", "", 0.005, -0.3, 0.3, "Relative error; + reads too much."
            ),
        ),
        _list_trials(0.01),
    ),
    TableEffect(
        "transducer_lag",
        "lag of the transducer in the stroke loop, of its filter",
        "t_t q_t' = y - y_f - q_t",
        "Conte, Trombetti (2000)",
        (TableEffectParameter("transducer_lag_s", "s", 1e-3, 0.0, 0.05, "Time constant."),),
        _list_trials(2e-3, 8e-3),
    ),
    TableEffect(
        "second_frame_mode",
        "second resonance of the frame or of the floor that bears the actuator",
        "y_f -> y_f + y_2, y_2'' = -r_2 (f - F) / m - w_2 (w_2 y_2 + 2 z_2 y_2')",
        "Conte, Trombetti (2000), extended by a mode",
        (
            TableEffectParameter(
                "second_frame_ratio", "", 0.005, 0.0, 1.0, "Mass of the table over its modal mass."
            ),
            TableEffectParameter("second_frame_hz", "Hz", 25.0, 4.0, 60.0, "Its frequency."),
            TableEffectParameter("second_frame_damping", "", 0.05, 0.01, 0.5, "Its damping."),
        ),
        tuple((0.005, hz, 0.06) for hz in (6.0, 8.0, 10.0, 18.0, 21.0, 24.0, 27.0, 30.0, 34.0)),
    ),
)
EFFECT_BY_ID = {effect.id: effect for effect in LIBRARY}
# What a table may have too, and why a rehearsal at low level does not show it.
UNTESTED = {
    "valve null offset": "it only shifts the table, which the tare takes away",
    "saturation of valve opening or slew": "the valve opens by a few percent of its travel only",
    "sag of the supply pressure": "the flow is a few percent of the largest only",
    "oil stiffness along the stroke": "the stroke used changes the oil volumes by too little",
    "error of the moving mass": "a motion shows ratios of force to mass only",
}


@dataclass(frozen=True, eq=False)
class HeldOutBase:
    """Slopes of the basic parameters and their pseudo-inverses, once for the trials of all effects.

    `rows` are the residuals that the fit of each fold uses; the last fold holds out none.
    """

    jacobian: Float2D  # (residual, parameter), columns scaled
    rows: tuple[npt.NDArray[np.bool_], ...]
    inverses: tuple[Float2D, ...]  # (parameter, row)

    @classmethod
    def from_fit(cls, fit: TableFit) -> "HeldOutBase":
        """Return the factorised slopes of the free parameters of a fit."""
        slopes, block = fit.jacobian[:, fit.is_free], fit.problem.block
        scaled = slopes / (np.linalg.norm(slopes, axis=0) + 1e-30)
        fold = np.where(block >= 0, block % FOLD_COUNT, FOLD_COUNT)
        rows = tuple(fold != index for index in range(FOLD_COUNT))
        rows += (np.ones(fold.size, bool),)
        return cls(scaled, rows, tuple(np.linalg.pinv(scaled[row], rcond=1e-8) for row in rows))

    def cross_validate(self, residuals: Float1D, slope: Float1D | None = None) -> Float1D:
        """Return the residuals after a Gauss-Newton step without their fold, (residual - 1,).

        The step is of the basic parameters and, with its `slope`, of an effect.
        """
        held_out = residuals.copy()
        for index in range(FOLD_COUNT):
            own = self._project_out(residuals, index)
            if slope is not None:
                own_slope = self._project_out(slope, index)
                row = self.rows[index]
                own = own + _solve_size(own_slope[row], own[row]) * own_slope
            inside = ~self.rows[index]
            held_out[inside] = own[inside]
        return held_out[:-1]

    def solve_amplitude(self, slope: Float1D, residuals: Float1D) -> float:
        """Return the size of an effect by the linear problem."""
        return _solve_size(self._project_out(slope, FOLD_COUNT), residuals)

    def _project_out(self, values: Float1D, index: int) -> Float1D:
        """Return (residual,) less its fit by the slopes in the rows of one fold."""
        return values - self.jacobian @ (self.inverses[index] @ values[self.rows[index]])


def _solve_size(slope: Float1D, residuals: Float1D) -> float:
    return -float(slope @ residuals) / max(float(slope @ slope), 1e-300)


@dataclass(frozen=True, eq=False)
class EffectFit:
    """Fit of the twin with some effects, and its residuals on held-out blocks."""

    effects: tuple[TableEffect, ...]
    fit: TableFit
    held_out: Float1D  # (residual,) without what is known beforehand

    @property
    def gap(self) -> float:
        """Rms of the held-out residuals over that of the measured motion."""
        return float(np.linalg.norm(self.held_out))

    @classmethod
    def from_fit(cls, effects: Sequence[TableEffect], fit: TableFit) -> "EffectFit":
        """Return the fit with its residuals on blocks that one Gauss-Newton step left out."""
        return cls(tuple(effects), fit, HeldOutBase.from_fit(fit).cross_validate(fit.residuals))


@dataclass(frozen=True)
class RivalEffect:
    """Another effect that was fitted in place of the named one, and the gap that it leaves."""

    id: str
    gap: float


@dataclass(frozen=True)
class EffectFinding:
    """A named effect: gaps on held-out data before and after it, and its rivals, best first.

    `undecided` are the rivals that explain nearly as much: the rehearsal does not tell them apart.
    """

    id: str
    gap_before: float
    gap_after: float
    rivals: tuple[RivalEffect, ...] = ()
    undecided: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class EffectDiscovery:
    """Outcome: the final fit, the effects found, and the nearest one that was not named."""

    fit: TableFit
    findings: tuple[EffectFinding, ...]
    gap: float
    closest: RivalEffect | None


def discover_table_effects(
    basic: TableFit, report: Callable[[str], None] = lambda stage: None
) -> EffectDiscovery:
    """Find which effects of LIBRARY the basic twin lacks; `report` gets the stage in words."""
    best = EffectFit.from_fit((), basic)
    findings: list[EffectFinding] = []
    closest: RivalEffect | None = None
    while len(best.effects) < MAX_EFFECTS:
        report(f"screening the effects of a table ({len(best.effects)} named)")
        screened = screen_effects(best)
        fitted = []
        for candidate in screened[:MAX_REFITS]:
            if candidate.gain_share < MIN_PROMISED_SHARE:
                break
            report(f"fitting {candidate.effect.id.replace('_', ' ')}")
            fitted.append(_refit(best, candidate))
        fitted.sort(key=lambda trial: trial.gap)
        if not fitted:
            break
        winner, others = fitted[0], fitted[1:]
        if not is_worthwhile(best, winner):
            closest = RivalEffect(winner.effects[-1].id, winner.gap)
            break
        rivals = tuple(RivalEffect(other.effects[-1].id, other.gap) for other in others)
        gain = best.gap**2 - winner.gap**2
        undecided = tuple(
            rival.id for rival in rivals if best.gap**2 - rival.gap**2 > RIVAL_SHARE * gain
        )
        findings.append(
            EffectFinding(winner.effects[-1].id, best.gap, winner.gap, rivals, undecided)
        )
        best = winner
    return EffectDiscovery(best.fit, tuple(findings), best.gap, closest)


def is_worthwhile(before: EffectFit, after: EffectFit) -> bool:
    """Return True if an effect is visible and gains a clear share that chance does not give."""
    share, sigma = compute_gain(before, after)
    effect = after.effects[-1]
    size = abs(describe_size(effect, after.fit.parameters))
    half_width = after.fit.estimate_half_widths()[effect.parameters[0].name]
    return (
        share > MIN_GAIN_SHARE and sigma > MIN_GAIN_SIGMA and size > MIN_EFFECT_SIGMA * half_width
    )


def compute_gain(before: EffectFit, after: EffectFit) -> tuple[float, float]:
    """Return (share of the held-out squares that is removed, the gain in standard errors).

    The standard error is that of the sum over the blocks, from their scatter.
    """
    block = before.fit.problem.block[:-1]
    gains = np.bincount(block, weights=before.held_out**2 - after.held_out**2)
    chance = math.sqrt(gains.size) * float(gains.std(ddof=1))
    return float(gains.sum()) / before.gap**2, float(gains.sum()) / max(chance, 1e-300)


@dataclass(frozen=True, eq=False)
class ScreenedEffect:
    """Effect by the linear problem: share of the held-out squares promised, and start."""

    effect: TableEffect
    start: dict[str, float]
    gain_share: float


def screen_effects(current: EffectFit) -> list[ScreenedEffect]:
    """Return the effects not yet in a fit, that which promises most first."""
    fit, before = current.fit, current.gap**2
    base = HeldOutBase.from_fit(fit)
    screened = []
    effects = [effect for effect in LIBRARY if effect not in current.effects]
    sizes = [(effect, trial) for effect in effects for trial in effect.trials]
    slopes = dict(
        zip(
            sizes, map_in_threads(lambda size: _compute_trial_slope(fit, *size), sizes), strict=True
        )
    )
    for effect in effects:
        trials = []
        for trial in effect.trials:
            slope = slopes[effect, trial]
            held_out = base.cross_validate(fit.residuals, slope)
            share = 1.0 - float(held_out @ held_out) / before
            size = base.solve_amplitude(slope, fit.residuals)
            first = effect.parameters[0]
            # Of the size of its trial: the law need not be linear, nor a dead band negative.
            held_out = base.cross_validate(fit.residuals + trial[0] * slope)
            share_of_trial = 1.0 - float(held_out @ held_out) / before
            if share_of_trial > share or not first.low <= size <= first.high:
                share, size = share_of_trial, trial[0]
            values = (size, *trial[1:])
            names = (parameter.name for parameter in effect.parameters)
            start = dict(zip(names, values, strict=True))
            trials.append(ScreenedEffect(effect, start, share))
        screened.append(max(trials, key=lambda candidate: candidate.gain_share))
    return sorted(screened, key=lambda candidate: -candidate.gain_share)


def _compute_trial_slope(fit: TableFit, effect: TableEffect, trial: tuple[float, ...]) -> Float1D:
    """Return the change of the residuals per size of an effect, (residual,), at its trial."""
    names = (*fit.names, *(parameter.name for parameter in effect.parameters))
    parameters = build_parameters(names, np.array([*fit.values, *trial]), fit.problem)
    return (fit.problem.compute_residuals(parameters) - fit.residuals) / trial[0]


def _refit(current: EffectFit, candidate: ScreenedEffect) -> EffectFit:
    """Fit the twin with an effect in addition, from the current fit."""
    fit, effects = current.fit, (*current.effects, candidate.effect)
    bounds: dict[str, tuple[float, float, float]] = {}
    for effect in effects:
        bounds |= effect.bounds
    names = [parameter.name for parameter in candidate.effect.parameters]
    trials = [candidate.start]
    trials += [dict(zip(names, trial, strict=True)) for trial in candidate.effect.trials]
    starts = [fit.scaled_values | trial for trial in trials]
    start = min(starts, key=fit.problem.measure_misfit)
    after = fit_table(fit.problem, {**BOUNDS, **bounds}, start, MAX_EVALUATIONS)
    if current.gap > MAX_WARM_GAP:
        kept = {name: fit.scaled_values[name] for name in bounds if name not in names}
        from_nothing = fit_basic_twin(fit.problem, bounds, [kept | trial for trial in trials])
        after = min(after, from_nothing, key=lambda trial: trial.cost)
    return EffectFit.from_fit(effects, after)


def describe_size(effect: TableEffect, parameters: TableParameters) -> float:
    """Return the size of an effect in a twin, SI: its first parameter."""
    return float(getattr(parameters, effect.parameters[0].name))


def describe_discovery(discovery: EffectDiscovery) -> list[str]:
    """Return the outcome in words, a line each: effects, what remains, what is not judged."""
    lines = []
    widths, parameters = discovery.fit.estimate_half_widths(), discovery.fit.parameters
    for finding in discovery.findings:
        effect = EFFECT_BY_ID[finding.id]
        lines.append(f"missing effect: {effect.description}")
        lines.append(f"  equation: {effect.equation} ({effect.source})")
        for parameter in effect.parameters:
            value = getattr(parameters, parameter.name)
            lines.append(
                f"  {parameter.name} = {value:.4g} +- {widths[parameter.name]:.2g} {parameter.unit}"
                f" (95 %): {parameter.meaning}"
            )
        lines.append(
            f"  left on held-out data: {100 * finding.gap_before:.3g} % -> "
            f"{100 * finding.gap_after:.3g} % of the motion"
        )
        if finding.undecided:
            lines.append(f"  cannot be told apart from {_list_names(finding.undecided)}")
        elif finding.rivals:
            rival = finding.rivals[0]
            lines.append(f"  next best: {_list_names([rival.id])}, {100 * rival.gap:.3g} %")
    if not discovery.findings:
        lines.append("missing effects: none is named")
        lines.append(f"  left on held-out data: {100 * discovery.gap:.3g} % of the motion")
    if discovery.closest is not None:
        lines.append(
            f"  {_list_names([discovery.closest.id])} would leave "
            f"{100 * discovery.closest.gap:.3g} %: too little gained, or too unevenly over the "
            "time, to name it"
        )
    lines.append("cannot be judged from this rehearsal:")
    lines += [f"  {name}: {reason}" for name, reason in UNTESTED.items()]
    return lines


def _list_names(ids: Sequence[str]) -> str:
    return ", ".join(name.replace("_", " ") for name in ids)
