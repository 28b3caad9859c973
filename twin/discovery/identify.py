"""Identification of parameters, gaps and uncertainties from recordings: joint fit, cross-checks.

The joint fit uses all forces on the measured motion of all logs. Cross-checks follow the manual
procedure of the paper's authors, each on its own samples: free flight gives K and C, the load cells
of each bumper give K_j, C_j and its gap, the positions of contact onset and release give the gaps;
and the same fit is repeated on small and large motion, forward and backward, early and late. Where
they disagree, the model lacks an effect or the specimen changed.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from table_io.block import Block, Label
from table_io.channels import relative_displacement
from twin.compare import TWIN_CHANNELS
from twin.compare.twins import TwinSetup, advance_twins, start_twins
from twin.discovery.contact_onsets import ContactGaps, estimate_contact_gaps
from twin.discovery.cross_checks import (
    SubsetEstimate,
    estimate_subsets,
    list_asymmetry_warnings,
    list_disagreements,
    list_fit_warnings,
    list_onset_warnings,
    select_observable,
)  # fmt: skip
from twin.discovery.discover import (
    PreparedLog,
    find_implausible_parameters,
    prepare_problem,
)
from twin.discovery.least_squares import FitResult, fit_parameters, fit_with_misfit
from twin.discovery.nuisances import widen_intervals
from twin.discovery.parameters import (
    EffectKey,
    NuisanceKey,
    ParameterKey,
    ParameterSet,
    is_correction,
    list_effect_parameters,
)
from twin.discovery.residuals import LogResiduals
from twin.discovery.selection import SelectionProblem
from twin.discovery.signals import LogSignals
from twin.laws.library import find_effect
from twin.model.model import Model

WINDOW_S = 1.0
GAP_OFFSET = EffectKey("gap_offset", "offset")
MIN_REPORTED_CORRELATION = 0.7


@dataclass(frozen=True, eq=False)
class IdentificationResult:
    """Result of an identification.

    `window_errors` are (nrmse of u before, after) of each log, or None, and `window_floors` what
    the noise of u alone would leave in them.
    """

    problem: SelectionProblem
    start: ParameterSet
    fit: FitResult
    undetermined: tuple[ParameterKey, ...]  # not determined by the logs: kept as in the start model
    subsets: tuple[SubsetEstimate, ...]
    # right gap minus half the total gap, and its standard deviation, in m
    asymmetry: tuple[float, float] | None
    contact_gaps: tuple[ContactGaps, ...]
    window_errors: tuple[tuple[float, float] | None, ...]
    window_floors: tuple[float, ...]
    warnings: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def rms_over_noise(self) -> float:
        """Rms of the residual in motion over the noise of the sensors, whatever the weights."""
        return self.problem.measure_fitted_misfit(self.fit)

    @property
    def correlated_pairs(self) -> tuple[tuple[str, str, float], ...]:
        """Pairs of strongly correlated parameters, with their correlation."""
        correlation, free = self.fit.correlation, self.fit.free
        return tuple(
            (free[i].name, free[k].name, float(correlation[i, k]))
            for i in range(len(free))
            for k in range(i)
            if abs(correlation[i, k]) > MIN_REPORTED_CORRELATION
            and not is_correction(free[i].key)
            and not is_correction(free[k].key)
        )


def identify_parameters(
    logs: Sequence[PreparedLog], blocks: Sequence[Sequence[Block]], model: Model
) -> IdentificationResult:
    """Identify the parameters of a model from logs and their measured blocks; see the module.

    Raise InputError if a log holds too few usable samples.
    """
    prepared = prepare_problem(logs, model)
    problem = prepared.problem
    log_residuals = problem.log_residuals
    start = prepared.parameters
    determined = select_observable(log_residuals, start)
    fixed = tuple(parameter.key for parameter in start.free if parameter not in determined)
    joint = fit_with_misfit(log_residuals, start.with_free(determined))
    joint = widen_intervals(joint, log_residuals)
    p = joint.parameters.to_model().base
    laws = (
        (p.bumper_stiffness_r, p.bumper_damping_r),
        (p.bumper_stiffness_l, p.bumper_damping_l),
    )
    contact_gaps = tuple(
        gaps
        for residuals, log_blocks in zip(log_residuals, blocks, strict=True)
        for gaps in estimate_contact_gaps(residuals, log_blocks, laws, joint.parameters)
    )
    asymmetry = _estimate_asymmetry(log_residuals, joint)
    parts = estimate_subsets(log_residuals, [log.steps for log in logs], joint)
    start = ParameterSet.from_model(model, len(log_residuals))
    windows = tuple(
        _compare_windows(residuals, log_blocks, start, joint.parameters)
        for residuals, log_blocks in zip(log_residuals, blocks, strict=True)
    )
    warnings = (
        *list_fit_warnings(log_residuals, joint, fixed),
        *list_asymmetry_warnings(asymmetry, log_residuals[0].scale),
        *list_disagreements(joint, parts, log_residuals[0].scale),
        *list_onset_warnings(log_residuals, joint, contact_gaps),
    )
    return IdentificationResult(
        problem,
        start,
        joint,
        fixed,
        parts,
        asymmetry,
        contact_gaps,
        windows,
        tuple(_window_noise(residuals.signals) for residuals in log_residuals),
        warnings,
        (*prepared.notes, *find_implausible_parameters(model, joint)),
    )


def _estimate_asymmetry(
    log_residuals: Sequence[LogResiduals], joint: FitResult
) -> tuple[float, float] | None:
    """Return (offset of the gaps, standard deviation) in m from the joint fit extended by it."""
    both_sides = all((residuals.contact_state > 0).any(axis=1).all() for residuals in log_residuals)
    if not both_sides or GAP_OFFSET in joint.parameters.values:
        return None
    # the nuisance of the gaps is the same quantity; the signals have been corrected for a part
    gaps = [key for key in joint.values if isinstance(key, NuisanceKey) and key.kind == "gap"]
    kept = [parameter for parameter in joint.free if parameter.key not in gaps]
    zeros: dict[ParameterKey, float] = dict.fromkeys((GAP_OFFSET, *gaps), 0.0)
    scale = log_residuals[0].scale
    free = (*kept, *list_effect_parameters(find_effect("gap_offset"), scale))
    start = joint.parameters.with_values(zeros).with_free(free)
    fit = fit_parameters(log_residuals, start)
    corrected = float(np.mean([residuals.gap_correction for residuals in log_residuals]))
    return corrected + fit.values[GAP_OFFSET], fit.std_errors[GAP_OFFSET]


def _compare_windows(
    residuals: LogResiduals, blocks: Sequence[Block], *parameter_sets: ParameterSet
) -> tuple[float, float] | None:
    """Return the nrmse of u of two parameter sets over windows restarted from the measured state.

    In chaotic motion a free run diverges after a few cycles. None without table acceleration, and
    where the rate is too low for a model. Bumpers that were not touched are left out: they may be
    those of a default.
    """
    if not blocks or "table_acc_m_s2" not in residuals.signals.channels:
        return None
    m, contact = residuals.motion(), residuals.contact_state
    right, left = m.gaps_m
    # without load cells, contact is where the gaps are exceeded
    touches = bool((np.where(contact < 0, [m.u > right, -m.u > left], contact) > 0).any())
    models = []
    for parameters in parameter_sets:
        model = parameters.model_for_log(residuals.log_number, m)
        if not touches:
            effects = tuple(i for i in model.effects if not i.effect.is_in_bumpers)
            model = Model(replace(model.base, gap_r=math.inf, gap_l=math.inf), effects)
        if model.min_rate_hz > blocks[0].rate_hz:
            return None
        models.append(model)
    contact_n = max(residuals.contact_thresholds_n)
    before, after = (window_nrmse(blocks, model, contact_n) for model in models)
    return before, after


def _window_noise(signals: LogSignals) -> float:
    """Return the rms noise of the measured u over the rms of u: a floor of `window_nrmse`."""
    pair = ("mass_disp_m", "table_disp_m")
    channels = pair if {*pair} <= {*signals.channels} else ("rel_disp_m",)
    # rms of one sample: white noise of rms s has the density s at every frequency
    noise = math.hypot(*(float(np.sqrt(np.mean(signals.noise[c] ** 2))) for c in channels))
    u = signals.grid.to_time_domain(signals.relative_spectrum)[signals.label != Label.REST]
    return noise / max(float(np.sqrt(np.mean(u**2))), 1e-300)


def window_nrmse(blocks: Sequence[Block], model: Model, contact_n: float) -> float:
    """Return the rms of measured minus predicted u over the rms of u, in windows of `WINDOW_S`."""
    window = round(WINDOW_S * blocks[0].rate_hz)
    setup = TwinSetup(model, blocks[0].rate_hz, window, window, contact_n)
    row, errors, squares = TWIN_CHANNELS.index("window/rel_disp_m"), 0.0, 0.0
    for block in blocks:
        # Fortran order: the channels of a sample are contiguous
        copy = replace(block, values=np.asfortranarray(block.values))
        _, predicted, _ = advance_twins(setup, start_twins(setup, block.index), copy)
        u, u_predicted = relative_displacement(block), predicted.values[row]
        finite = np.isfinite(u) & np.isfinite(u_predicted) & (block.label != Label.REST)
        errors += float(((u - u_predicted)[finite] ** 2).sum())
        squares += float((u[finite] ** 2).sum())
    return math.sqrt(errors / squares) if squares else math.nan
