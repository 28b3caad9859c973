"""Features of a model: what each would be, and its distance from the published one."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from table_io.errors import InputError
from twin.discovery.features.config import KIND_KEYS, Feature, FeatureSet
from twin.discovery.features.continued_curve import (
    compute_curve,
    find_permanent_gap_mm,
)
from twin.discovery.features.curve import ResponseCurve
from twin.discovery.features.describing_function import approximate_curve
from twin.dynamics.period_map import set_total_gap
from twin.model.ideal_response import simulate_sweep
from twin.model.model import Model

Quantities = tuple[float, ...]  # from which a feature is judged; NaN where the model has none
# In tolerances, in a fit: of a feature that a model has not at all, and the largest of any.
MISSING_DISTANCE, MAX_DISTANCE = 20.0, 100.0
TRANSIENT_CYCLES, COUNTED_CYCLES = 60, 120  # of the impacts of a steady, maybe chaotic motion
DEFAULT_PRECOMPRESSION_MM = -10.0  # from which permanent contact is searched


@dataclass(frozen=True, slots=True)
class PredictedFeature:
    """A feature of a model: in words, by numbers, and its distance in tolerances.

    The model explains it if the distance is at most 1; inf where it has no such feature.
    """

    text: str
    quantities: Quantities
    distance: float
    method: str

    @property
    def is_explained(self) -> bool:
        return self.distance <= 1.0


class Measurement(NamedTuple):
    """Quantities of every feature of a model, how each was computed, and the curves by gap in mm.

    Those of impacts are (): they cost the most and are counted only at the end of a fit.
    """

    quantities: list[Quantities]
    methods: list[str]
    curves: dict[float, ResponseCurve | None]


def measure_model(
    features: FeatureSet, model: Model, make_curve: Callable[[Model], ResponseCurve | None]
) -> Measurement:
    """Return the quantities of every feature but impacts of a model, with the given curves."""
    curves = {gap: make_curve(set_total_gap(model, gap / 1e3)) for gap in features.gaps_mm}
    quantities: list[Quantities] = []
    methods: list[str] = []
    for feature in features.features:
        method = "simulation"
        if feature.kind == "impacts":
            quantities.append(())
        elif feature.kind == "permanent_contact_gap":
            deepest = min(DEFAULT_PRECOMPRESSION_MM, *features.gaps_mm)
            quantities.append((find_permanent_gap_mm(model, deepest, make_curve),))
            method = "continuation"
        else:
            assert feature.gap_mm is not None
            curve = curves[feature.gap_mm]
            quantities.append(read_curve(feature, curve))
            method = curve.method if curve else "no response curve"
        methods.append(method)
    return Measurement(quantities, methods, curves)


def read_curve(feature: Feature, curve: ResponseCurve | None) -> Quantities:
    """Return the quantities of a feature of a response curve.

    Of a hysteresis and its jumps: its middle and its signed width in Hz. Else the value.
    """
    if curve is None:
        return (math.nan,)
    match feature.kind:
        case "peak_frequency":
            return (curve.find_peak()[0],)
        case "peak_displacement":
            return (1e3 * curve.find_peak()[1],)
        case "hysteresis" | "jump_up_frequency" | "jump_down_frequency":
            return curve.measure_hysteresis()
        case "displacement":
            assert feature.at_hz is not None
            assert feature.direction is not None
            return (1e3 * curve.interpolate(feature.at_hz, feature.direction)[0],)
        case _:
            if feature.at_hz is None or feature.direction is None:
                return (1e3 * curve.largest_excess_m,)
            return (1e3 * curve.interpolate(feature.at_hz, feature.direction)[1],)


def measure_impact_share(features: FeatureSet, feature: Feature, model: Model) -> float:
    """Return the share of steady cycles with the impacts of a feature, on either side."""
    assert feature.at_hz is not None
    assert feature.gap_mm is not None
    try:
        sweep = simulate_sweep(
            set_total_gap(model, feature.gap_mm / 1e3),
            [feature.at_hz],
            features.test.acceleration_m_s2,
            TRANSIENT_CYCLES + COUNTED_CYCLES,
            COUNTED_CYCLES,
        )
    except InputError:
        return math.nan
    counts = np.sort(np.stack([sweep.column("onsets_r")[0], sweep.column("onsets_l")[0]]), axis=0)
    wanted = np.array(sorted(feature.impacts), dtype=np.float64)
    return float(np.all(wanted == counts.T, axis=1).mean())


def compute_residuals(feature: Feature, quantities: Quantities, step_hz: float) -> list[float]:
    """Return distances in tolerances, signed where a direction is known, as many for every model.

    Within +-`MAX_DISTANCE`; `MISSING_DISTANCE` where the model has no such feature.
    """
    if not quantities or not all(
        math.isfinite(value) or value == -math.inf for value in quantities
    ):
        return [MISSING_DISTANCE] * (1 + len(feature.inside_hz))
    residuals: list[float]
    match feature.kind:
        case "hysteresis":
            residuals = _compare_hysteresis(feature, quantities[0], quantities[1], step_hz)
        case "contact":
            excess = quantities[0]
            wrong = min(excess, 0.0) if feature.contact == "some" else max(excess, 0.0)
            residuals = [wrong / feature.tolerance]
        case "impacts":
            residuals = [(1.0 - quantities[0]) / feature.tolerance]
        case _:
            value, (low, high) = find_value(feature, quantities), feature.limits
            residuals = [(min(value - low, 0.0) + max(value - high, 0.0)) / feature.tolerance]
    return [float(np.clip(residual, -MAX_DISTANCE, MAX_DISTANCE)) for residual in residuals]


def find_value(feature: Feature, quantities: Quantities) -> float:
    """Return the value of a feature that is a number: of a jump, the fold at which it happens."""
    if feature.kind == "jump_up_frequency":
        return quantities[0] - quantities[1] / 2
    if feature.kind == "jump_down_frequency":
        return quantities[0] + quantities[1] / 2
    return quantities[0]


def _compare_hysteresis(
    feature: Feature, middle: float, width: float, step_hz: float
) -> list[float]:
    if feature.shape == "none":
        return [max(abs(width) - step_hz, 0.0) / feature.tolerance]
    signed = width if feature.shape == "right" else -width
    lacking = min(signed - step_hz, 0.0) / feature.tolerance
    if lacking < 0:
        lacking -= 1.0  # a hysteresis that no sweep would show is never within the tolerance
    outside = [
        max(abs(hz - middle) - max(signed, 0.0) / 2, 0.0)
        * math.copysign(1.0, hz - middle)
        / feature.tolerance
        for hz in feature.inside_hz
    ]
    return [lacking, *outside]


def judge_feature(
    feature: Feature, quantities: Quantities, step_hz: float, method: str
) -> PredictedFeature:
    """Return what a model predicts for a feature, and how far that is from what was published."""
    distance = max(abs(r) for r in compute_residuals(feature, quantities, step_hz))
    text = "none"
    is_jump = feature.kind.startswith("jump")
    if not all(map(math.isnan, quantities)):
        text = format_quantities(feature, quantities, step_hz)
    if not quantities or any(map(math.isnan, quantities)):
        distance = math.inf
    elif is_jump and abs(quantities[1]) < step_hz:
        distance, text = math.inf, "no jump"
    return PredictedFeature(text, quantities, distance, method)


def format_quantities(feature: Feature, quantities: Quantities, step_hz: float) -> str:
    """Return what a model predicts in words."""
    match feature.kind:
        case "hysteresis":
            return format_hysteresis(quantities[0], quantities[1], step_hz)
        case "contact":
            return format_contact(feature, quantities[0])
        case "impacts":
            return f"so in {100 * quantities[0]:.0f} % of the cycles"
        case _:
            unit = {"hz": "Hz", "mm": "mm"}[KIND_KEYS[feature.kind].unit]
            return f"{find_value(feature, quantities):.2f} {unit}".replace("-", "−")


def format_hysteresis(middle: float, width: float, step_hz: float) -> str:
    """Return the shape and the ends of a hysteresis; "none" if it is narrower than a step."""
    if abs(width) < step_hz:
        return "none" if abs(width) < 1e-3 else f"none wider than {step_hz:g} Hz"
    shape, half = "right" if width > 0 else "left", abs(width) / 2
    return f"{shape}, {middle - half:.2f} to {middle + half:.2f} Hz"


def format_contact(feature: Feature, excess_mm: float) -> str:
    """Return the contact of a motion that passes the touch of a bumper by `excess_mm`."""
    is_precompressed = feature.gap_mm is not None and feature.gap_mm <= 0
    if excess_mm == -math.inf:
        return "no bumpers"
    if excess_mm > 0:
        return f"{'leaves a bumper' if is_precompressed else 'impacts'} by {excess_mm:.2f} mm"
    state = "always in contact" if is_precompressed else "none"
    return f"{state}, {-excess_mm:.2f} mm to spare"


def describe_feature(feature: Feature) -> str:
    """Return a published feature in words, without its gap."""
    keys = KIND_KEYS[feature.kind]
    unit = {"hz": "Hz", "mm": "mm", "share": ""}[keys.unit]
    at = "" if feature.at_hz is None else f" at {feature.at_hz:g} Hz"
    at += "" if feature.direction is None else f", {feature.direction}"
    match feature.kind:
        case "hysteresis":
            if feature.shape == "none":
                return "no hysteresis"
            inside = " and ".join(f"{hz:g}" for hz in feature.inside_hz)
            return f"{feature.shape} hysteresis" + (f", {inside} Hz inside" if inside else "")
        case "contact":
            return f"contact{at}: {feature.contact}"
        case "impacts":
            return f"{feature.impacts[0]} and {feature.impacts[1]} impacts per cycle{at}"
    low, high = feature.limits
    label = feature.kind.replace("_", " ")
    if low == high:
        amount = f"{low:g}"
    elif math.isinf(high):
        amount = f"at least {low:g}"
    elif math.isinf(low):
        amount = f"at most {high:g}"
    else:
        amount = f"{low:g} to {high:g}"
    return f"{label}{at} {amount} {unit}".replace("-", "−")


def continue_features(features: FeatureSet, model: Model) -> Measurement:
    """Return the quantities of every feature but impacts by continuation."""
    return measure_model(features, model, lambda own: compute_curve(own, features.test))


def approximate_quantities(features: FeatureSet, model: Model) -> list[Quantities]:
    """Return the quantities of every feature but impacts by describing functions."""
    level = features.test.acceleration_m_s2
    return measure_model(features, model, lambda own: approximate_curve(own, level)).quantities


def predict_features(
    features: FeatureSet, model: Model, measurement: Measurement
) -> tuple[PredictedFeature, ...]:
    """Return what a model predicts for every feature; the impacts are counted by simulation."""
    predicted = []
    for feature, quantities, method in zip(
        features.features, measurement.quantities, measurement.methods, strict=True
    ):
        own = quantities
        if feature.kind == "impacts":
            own = (measure_impact_share(features, feature, model),)
        predicted.append(judge_feature(feature, own, features.test.step_hz, method))
    return tuple(predicted)
