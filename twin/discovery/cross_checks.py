"""Cross-checks of a fit: estimates from subsets of the samples, and warnings on disagreement."""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from table_io.block import Bool2D
from table_io.records import Step
from twin.discovery.contact_onsets import ContactGaps
from twin.discovery.least_squares import FitResult, compute_slopes, fit_parameters
from twin.discovery.motion import RecordScale
from twin.discovery.nuisances import MAX_SIZE, fix_nuisances, list_sizes
from twin.discovery.parameters import (
    BUMPER_DAMPING,
    BUMPER_STIFFNESS,
    BaseKey,
    EffectKey,
    FreeParameter,
    GapKey,
    ParameterKey,
    ParameterSet,
    is_correction,
)
from twin.discovery.residuals import LogResiduals

MIN_SUBSET_BLOCKS = 6  # with fewer blocks the standard error of a subset is unreliable
MIN_DETERMINING_BLOCKS = 4.0  # with fewer, a warning
# standard deviations at which two estimates disagree; high because about thirty are compared
MIN_DISAGREEMENT_SIGMA = 4.0
MAX_COMMON_SHIFT = 2.0  # of the scatter of single crossings: shift of all that is no evidence
# smallest disagreement reported: relative, and for a gap of the largest displacement
MIN_DISAGREEMENT_SHARE, MIN_DISAGREEMENT_OF_U = 0.01, 1e-3
OPPOSED_SUBSETS = (
    ("small motion", "large motion"), ("forward", "backward"), ("early", "late"),
    ("contact right", "contact left"),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class SubsetEstimate:
    """Estimate from a subset of the samples; `values` hold (value, standard deviation) in SI.

    The standard deviation is infinite where too few cycles determine the value.
    """

    source: str
    values: Mapping[ParameterKey, tuple[float, float]]
    entry_count: int
    converged: bool


def select_observable(
    log_residuals: Sequence[LogResiduals],
    parameters: ParameterSet,
    train: Sequence[Bool2D] | None = None,
) -> tuple[FreeParameter, ...]:
    """Return the free parameters that change a residual where `train`, (entry,) each, is True."""
    before = [residuals.evaluate(parameters) for residuals in log_residuals]
    masks = train or [np.ones(values.size, dtype=bool) for values in before]
    return tuple(
        parameter
        for parameter in parameters.free
        if any(
            slope[mask].any()
            for slope, mask in zip(
                compute_slopes(log_residuals, parameters, parameter, before), masks, strict=True
            )
        )
    )


def estimate_subsets(
    log_residuals: Sequence[LogResiduals], steps: Sequence[Sequence[Step]], joint: FitResult
) -> tuple[SubsetEstimate, ...]:
    """Estimate the parameters from free flight, contacts of each side, and opposed halves."""
    # errors of instruments are determined by all samples together
    log_residuals = [fix_nuisances(residuals, joint.parameters) for residuals in log_residuals]
    free = [parameter for parameter in joint.free if not is_correction(parameter.key)]
    of_contact = [parameter for parameter in free if is_of_contact(parameter.key, joint.parameters)]
    flight = [parameter for parameter in free if parameter not in of_contact]
    in_flight = [_select_flight(residuals) for residuals in log_residuals]
    masks = [residuals.entry_row == 0 for residuals in in_flight]
    estimates = [_estimate_subset("free flight", in_flight, joint, flight, masks)]
    for row, side in ((1, "right"), (2, "left")):
        side_free = [
            replace(parameter, tied=(BaseKey(f"{parameter.name}_{side[0]}"),))
            if parameter.key in (BUMPER_STIFFNESS, BUMPER_DAMPING)
            else parameter
            for parameter in of_contact
            if not isinstance(parameter.key, EffectKey)
        ]
        side_masks = [residuals.entry_row == row for residuals in log_residuals]
        estimates.append(
            _estimate_subset(f"contact {side}", log_residuals, joint, side_free, side_masks)
        )
    log_halves = [
        _half_masks(residuals, log_steps)
        for residuals, log_steps in zip(log_residuals, steps, strict=True)
    ]
    for name in log_halves[0]:
        masks = [halves[name] for halves in log_halves]
        if any(mask.any() for mask in masks) and not all(mask.all() for mask in masks):
            estimates.append(_estimate_subset(name, log_residuals, joint, free, masks))
    return tuple(estimate for estimate in estimates if estimate.values)


def is_of_contact(key: ParameterKey, parameters: ParameterSet) -> bool:
    """Return True for a parameter of the gaps, of the bumpers, or of an effect in them."""
    if isinstance(key, EffectKey):
        return parameters.get_effect(key.effect).is_in_bumpers
    return isinstance(key, GapKey) or key in (BUMPER_STIFFNESS, BUMPER_DAMPING)


def _select_flight(residuals: LogResiduals) -> LogResiduals:
    """Return the residuals whose damper row has the samples in flight alone.

    Well inside the gaps if contact is unknown.
    """
    m = residuals.motion()
    right, left = m.gaps_m
    inside_gaps = (m.u < 0.9 * right) & (m.u > -0.9 * left)
    if m.damper is not None:
        inside_gaps = np.ones(m.u.size, dtype=bool)
    in_flight = np.where(
        (residuals.contact_state < 0).any(axis=0),
        inside_gaps,
        (residuals.contact_state == 0).all(axis=0),
    )
    mask = residuals.row_mask.copy()
    mask[0] &= in_flight
    return replace(residuals, fixed_mask=mask)


def _half_masks(residuals: LogResiduals, steps: Sequence[Step]) -> dict[str, Bool2D]:
    """Return the entries of each half by name, (entry,) each, without the rest row."""
    m, sample = residuals.motion(), residuals.entry_sample
    peaks = np.zeros(int(residuals.sample_block[-1]) + 1)
    np.maximum.at(peaks, residuals.sample_block, np.abs(m.u))
    peak = peaks[residuals.sample_block]
    median_peak = float(np.median(peak[m.moving]))
    late = m.time_s > float(np.median(m.time_s[m.moving]))
    halves = {
        "small motion": peak <= median_peak, "large motion": peak > median_peak, "early": ~late,
        "late": late,
    }  # fmt: skip
    for direction in ("forward", "backward"):
        halves[direction] = np.isin(
            m.step, [step.index for step in steps if step.direction == direction]
        )
    moving_rows = residuals.entry_row < len(residuals.rows)
    return {name: mask[sample] & moving_rows for name, mask in halves.items()}


def _estimate_subset(
    source: str, log_residuals: Sequence[LogResiduals], joint: FitResult,
    free: Sequence[FreeParameter],
    train: Sequence[Bool2D],
) -> SubsetEstimate:  # fmt: skip
    """Fit one subset; return no values if it has too few blocks."""
    entries = sum(int(mask.sum()) for mask in train)
    blocks = sum(
        np.unique(residuals.entry_block[mask]).size
        for residuals, mask in zip(log_residuals, train, strict=True)
    )
    start = joint.parameters.with_free(free)
    observable = (
        select_observable(log_residuals, start, train) if blocks >= MIN_SUBSET_BLOCKS else ()
    )
    if not observable:
        return SubsetEstimate(source, {}, entries, True)
    fit = fit_parameters(log_residuals, start.with_free(observable), train)
    determined = {
        key: (value, fit.interval_error(key))
        for key, value in fit.values.items()
        if fit.std_errors[key] > 0
    }
    return SubsetEstimate(source, determined, entries, fit.converged)


def list_fit_warnings(
    log_residuals: Sequence[LogResiduals], joint: FitResult, fixed: Sequence[ParameterKey]
) -> Iterator[str]:
    """Yield warnings on convergence, bounds and parameters that the logs do not determine."""
    if not joint.converged:
        yield "the fit has not converged: do not use its values"
    for key, count in joint.block_counts.items():
        if count < MIN_DETERMINING_BLOCKS and not is_correction(key):
            yield (
                f"{key}: determined by {max(round(count), 1)} contacts or cycles alone; its "
                "interval is wide for that and assumes that others would be alike"
            )
    # The bound of a correction is what a rest of the log can hide of it, which is no result.
    for key in itertools.filterfalse(is_correction, joint.at_bound):
        yield f"{key}: at its bound, {joint.values[key]:.4g}; its interval is not valid"
    for residuals in log_residuals:
        for nuisance, z in list_sizes(residuals, joint.parameters):
            if abs(z) > MAX_SIZE:
                yield (
                    f"{residuals.signals.name}: the fit needs an error in {nuisance.kind} of "
                    f"{nuisance.place or 'the set-up'}, {abs(z):.0f} times what is typical: a "
                    "sensor is wrong, or the specimen differs there; run discover to find it"
                )
    if BUMPER_STIFFNESS not in joint.values:
        yield "no log touches a bumper: K_j and C_j are those of the start model, gaps as stated"
    else:
        for residuals in log_residuals:
            if GapKey(residuals.log_number) not in joint.values:
                yield f"{residuals.signals.name}: touches no bumper; its gap is kept as given"
    for key in fixed:
        yield f"{key}: not determined by the logs; kept as in the start model"


def list_asymmetry_warnings(
    asymmetry: tuple[float, float] | None, scale: RecordScale
) -> Iterator[str]:
    """Yield a warning if the gaps differ from the stated ones in opposite directions."""
    if asymmetry and abs(asymmetry[0]) > max(
        MIN_DISAGREEMENT_OF_U * scale.u, MIN_DISAGREEMENT_SIGMA * asymmetry[1]
    ):
        offset, sd = asymmetry
        yield (
            f"the gaps differ from the stated ones: right {1e3 * offset:+.3f} mm, left "
            f"{-1e3 * offset:+.3f} mm (+- {1.96e3 * sd:.3f}); the fit shifts both equally; run "
            "discover to test for gap_offset"
        )


def list_disagreements(
    joint: FitResult, parts: Sequence[SubsetEstimate], scale: RecordScale
) -> Iterator[str]:
    """Yield a warning where opposed subsets, or free flight and the joint fit, disagree."""
    by_name = {part.source: part.values for part in parts}
    joint_values = {key: (value, joint.std_errors[key]) for key, value in joint.values.items()}
    pairs = [(a, b, by_name.get(a, {}), by_name.get(b, {})) for a, b in OPPOSED_SUBSETS]
    pairs.append(("free flight", "the joint fit", by_name.get("free flight", {}), joint_values))
    units = {parameter.key: parameter.unit for parameter in joint.free}
    for a, b, first, second in pairs:
        for key in [key for key in first if key in second]:
            (x, sx), (y, sy) = first[key], second[key]
            notable = _notable_difference(y, units[key], scale)
            if abs(x - y) > max(MIN_DISAGREEMENT_SIGMA * math.hypot(sx, sy), notable):
                yield (
                    f"{key}: {x:.5g} {units[key]} in {a}, {y:.5g} in {b}, "
                    f"{abs(x - y) / math.hypot(sx, sy):.0f} standard deviations apart: the "
                    "specimen changed, or the model lacks an effect; run discover to find it"
                )


def _notable_difference(value: float, unit: str, scale: RecordScale) -> float:
    """Return the smallest difference from a value that is reported, however certain it is."""
    return MIN_DISAGREEMENT_OF_U * scale.u if unit == "m" else MIN_DISAGREEMENT_SHARE * abs(value)


def list_onset_warnings(
    log_residuals: Sequence[LogResiduals], joint: FitResult, contact_gaps: Sequence[ContactGaps]
) -> Iterator[str]:
    """Yield a warning where the gap from contact onsets or releases differs from the fitted gap.

    What filters and sampling shift in all crossings alike is of the size of their scatter.
    """
    for gaps in contact_gaps:
        gap = fitted_gap(log_residuals[gaps.log], joint, gaps.side)
        notable = _notable_difference(gap, "m", log_residuals[gaps.log].scale)
        sd = math.hypot(gaps.std_error, joint.std_errors.get(GapKey(gaps.log), 0.0))
        common = MAX_COMMON_SHIFT * gaps.scatter
        if abs(gaps.value - gap) > max(MIN_DISAGREEMENT_SIGMA * sd, notable, common):
            yield (
                f"{log_residuals[gaps.log].signals.name}: {gaps.side} {gaps.kind}s lie at "
                f"{1e3 * gaps.value:.3f} mm, the fitted gap at {1e3 * gap:.3f} mm: the bumper law "
                "may differ (hunt_crossley, bumper_maxwell), or the gaps may be unequal"
            )


def fitted_gap(residuals: LogResiduals, joint: FitResult, side: str) -> float:
    """Return the fitted gap of a side of a log in m."""
    p = joint.parameters.model_for_log(residuals.log_number, residuals.motion()).parameters
    difference = residuals.gap_reading_error(joint.parameters)
    return p.gap_r + difference if side == "right" else p.gap_l - difference
