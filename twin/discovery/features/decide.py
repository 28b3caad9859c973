"""The test that would decide between two models that explain the features about equally well."""

import itertools
import math
import statistics
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from twin.discovery.features.config import FeatureSet, FeatureTest
from twin.discovery.features.continued_curve import compute_curve
from twin.discovery.features.curve import ResponseCurve
from twin.discovery.features.describing_function import approximate_curve
from twin.discovery.features.prediction import format_hysteresis
from twin.dynamics.period_map import set_total_gap
from twin.model.model import Model

LEVEL_FACTORS = (0.5, 1.0, 2.0)  # of the level of the features
DEFAULT_TOLERANCES = {"peak_frequency": 0.05, "peak_displacement": 0.15}  # relative
SHORTLISTED_TESTS = 4  # of the tests by describing functions, computed by continuation
RANGE_MARGIN = 0.2  # of the frequencies, on either side of what the models predict


@dataclass(frozen=True, slots=True)
class DecidingTest:
    """A stepped sine at a gap and a level, and in what two models differ most there.

    `difference` in tolerances of the features file.
    """

    gap_mm: float
    acceleration_g: float
    start_hz: float
    end_hz: float
    quantity: str
    first: str
    second: str
    difference: float


def choose_deciding_test(features: FeatureSet, first: Model, second: Model) -> DecidingTest | None:
    """Return the test in which two models differ most relative to the tolerances; None without.

    Among the gaps of the features and those halfway between, at half, once and twice their level;
    by describing functions, then the best few by continuation.
    """

    def approximate(model: Model, test: FeatureTest) -> ResponseCurve | None:
        return approximate_curve(model, test.acceleration_m_s2)

    settings = [(gap, factor) for gap in list_test_gaps(features) for factor in LEVEL_FACTORS]
    tests = _compare_settings(features, first, second, settings, approximate)
    best = sorted(tests, key=lambda test: -test.difference)[:SHORTLISTED_TESTS]
    shortlist = [(test.gap_mm, test.acceleration_g / features.test.acceleration_g) for test in best]
    return max(
        _compare_settings(features, first, second, shortlist, compute_curve),
        key=lambda test: test.difference,
        default=None,
    )


def list_test_gaps(features: FeatureSet) -> list[float]:
    """Return the gaps in mm of the features and those halfway between neighbors."""
    gaps = features.gaps_mm
    finite = [gap for gap in gaps if gap < float("inf")]
    halfway = [(a + b) / 2 for a, b in itertools.pairwise(finite)]
    return sorted({*gaps, *halfway}, reverse=True)


def _compare_settings(
    features: FeatureSet,
    first: Model,
    second: Model,
    settings: list[tuple[float, float]],
    make_curve: Callable[[Model, FeatureTest], ResponseCurve | None],
) -> Iterator[DecidingTest]:
    for gap_mm, factor in settings:
        level_g = factor * features.test.acceleration_g
        own = features.test.model_copy(update={"acceleration_g": level_g})
        curves = [make_curve(set_total_gap(model, gap_mm / 1e3), own) for model in (first, second)]
        if curves[0] is None or curves[1] is None:
            continue
        test = _compare_curves(features, curves[0], curves[1], gap_mm, factor)
        if test is not None:
            yield test


def _compare_curves(
    features: FeatureSet, first: ResponseCurve, second: ResponseCurve, gap_mm: float, factor: float
) -> DecidingTest | None:
    """Return the quantity in which two curves differ most; None without a peak in both."""
    step_hz = features.test.step_hz
    peaks = first.find_peak(), second.find_peak()
    loops = first.measure_hysteresis(), second.measure_hysteresis()
    if any(map(math.isnan, itertools.chain(*peaks))):
        return None
    (hz, mm), (other_hz, other_mm) = ((peak[0], 1e3 * peak[1]) for peak in peaks)
    frequency_tolerance = find_relative_tolerance(features, "peak_frequency") * min(hz, other_hz)
    amplitude_tolerance = find_relative_tolerance(features, "peak_displacement") * min(mm, other_mm)
    candidates = [
        (abs(hz - other_hz) / frequency_tolerance, "frequency of the peak",
         f"{hz:.2f} Hz", f"{other_hz:.2f} Hz"),
        (abs(mm - other_mm) / amplitude_tolerance, "displacement at the peak",
         f"{mm:.2f} mm", f"{other_mm:.2f} mm"),
    ]  # fmt: skip
    if max(abs(width) for _, width in loops) >= step_hz:
        shift = max(
            abs((loops[0][0] + sign * loops[0][1] / 2) - (loops[1][0] + sign * loops[1][1] / 2))
            for sign in (1, -1)
        )
        texts = [format_hysteresis(*loop, step_hz) for loop in loops]
        candidates.append((shift / frequency_tolerance, "hysteresis", texts[0], texts[1]))
    difference, quantity, text, other_text = max(candidates)
    edges = [hz, other_hz, *(m + s * w / 2 for m, w in loops for s in (1, -1))]
    test = features.test
    return DecidingTest(
        gap_mm, factor * test.acceleration_g,
        round(max(test.start_hz, (1 - RANGE_MARGIN) * min(edges)), 1),
        round(min(test.end_hz, (1 + RANGE_MARGIN) * max(edges)), 1),
        quantity, text, other_text, difference,
    )  # fmt: skip


def find_relative_tolerance(features: FeatureSet, kind: str) -> float:
    """Return the median relative tolerance of the features of a kind, or the usual one."""
    shares = [
        feature.tolerance / abs(feature.limits[0])
        for feature in features.features
        if feature.kind == kind and feature.limits[0] == feature.limits[1] != 0
    ]
    return statistics.median(shares) if shares else DEFAULT_TOLERANCES[kind]


def describe_test(test: DecidingTest, first: str, second: str) -> str:
    """Return the test in a sentence: what to run, and what each model predicts."""
    gap = "without bumpers" if test.gap_mm == float("inf") else f"gap {test.gap_mm:g} mm"
    return (
        f"stepped sine, {gap}, {test.acceleration_g:g} g, {test.start_hz:g} to {test.end_hz:g} Hz, "
        f"both directions: {test.quantity}: {first} predicts {test.first}, {second} {test.second} "
        f"({test.difference:.1f} tolerances apart)"
    ).replace("gap -", "gap −")
