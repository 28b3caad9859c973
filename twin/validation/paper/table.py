"""Comparison table: one row per statement of the paper, with the model's result and a verdict.

The verdict follows from the numbers by the rule stated in the row; no parameter is tuned to agree.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from table_io.block import Float1D
from twin.model.parameters import free_flight_resonance
from twin.reports.report_data import extract_prc
from twin.reports.slow_passage import MAX_DIRECTION_DIFFERENCE
from twin.validation.paper import findings
from twin.validation.paper.study import (
    CHAOS_SCAN_HZ,
    COEXISTING_HZ,
    IRREGULAR_HZ,
    SECONDARY_HZ,
    PaperStudy,
)

AGREES, IN_KIND, DEPARTS = "agrees", "agrees in kind", "departs"
FREQUENCY_TOLERANCE = 0.05  # relative; a frequency within it agrees
NO_HYSTERESIS = "no hysteresis"
RowValues = dict[str, float | str | bool | list[float] | list[list[float]]]


@dataclass(frozen=True, slots=True)
class ComparisonRow:
    """Statement of the paper, result of the model, verdict, and the rule of the verdict."""

    key: str
    case: str
    paper: str
    model: str
    verdict: str
    rule: str
    values: RowValues = field(default_factory=dict)


def make_comparison_table(study: PaperStudy) -> list[ComparisonRow]:
    """Return every row, in the order of the paper."""
    comparisons: tuple[Callable[[PaperStudy], Iterator[ComparisonRow]], ...] = (
        _compare_free_flight,
        _compare_hardening,
        _compare_trends,
        _compare_coexistence,
        _compare_secondary_resonances,
        _compare_irregular_motion,
        _compare_chaos,
        _compare_zero_gap,
        _compare_small_precompression,
        _compare_large_precompression,
    )
    return [row for compare in comparisons for row in compare(study)]


def _compare_free_flight(study: PaperStudy) -> Iterator[ComparisonRow]:
    case = study.cases["G∞"]
    u, a, hz = free_flight_resonance(case.parameters, case.acceleration)
    method = "continuous in frequency"
    if not study.is_exact:
        hz, method = (
            study.slow_sweeps["G∞"].peak_hz,
            "u*, a* of its linear part, resonance by slow passage",
        )
    u_scale = case.scale[0]
    frequencies, eta_d = extract_prc(case.points, "twin", "forward", "eta_d")
    peak_hz = float(frequencies[eta_d.argmax()])
    yield ComparisonRow(
        "free_flight", "Free flight", "resonance at about 1.3 Hz",
        f"{hz:.3f} Hz, u* = {1e3 * u:.3f} mm, a* = {a:.3f} m/s² ({method}); "
        f"{1e3 * u_scale * eta_d.max():.2f} mm at {peak_hz:g} Hz on the 0.1 Hz grid",
        AGREES if abs(hz / 1.3 - 1) < FREQUENCY_TOLERANCE else DEPARTS,
        "resonance within 5 %. Every η here is divided by the continuous u*, a*. The real damper "
        "is nonlinear: off resonance the experiment lies above the model",
        {"resonance_hz": hz, "u_star_mm": 1e3 * u, "a_star_m_s2": a,
         "grid_u_max_mm": float(1e3 * u_scale * eta_d.max()), "grid_hz": peak_hz},
    )  # fmt: skip


def _compare_hardening(study: PaperStudy) -> Iterator[ComparisonRow]:
    for name in ("G30", "G16", "G10"):
        fold = study.folds[name]
        is_right = fold is not None and fold.kind == "right"
        down, up = (fold.forward_hz, fold.backward_hz) if fold else (np.nan, np.nan)
        yield ComparisonRow(
            name.lower(), name, "jumps and a right hysteresis",
            f"down-jump at {down:.3f} Hz, up-jump at {up:.3f} Hz ({fold.method})"
            if fold else NO_HYSTERESIS,
            AGREES if is_right else DEPARTS,
            "the forward branch is the larger one between two jumps",
            {"down_hz": down, "up_hz": up},
        )  # fmt: skip
    fold, statement = study.folds["G4"], "3.4 Hz lies inside the right hysteresis"
    rule = "3.4 Hz lies between the jumps"
    if fold is None:
        yield ComparisonRow("g4", "G4", statement, NO_HYSTERESIS, DEPARTS, rule)
        return
    graze = findings.find_graze_hz(study.cases["G4"], study.slow_sweeps["G4"])
    last_test = study.cases["G4"].tests[-1]
    frequencies, eta_r = extract_prc(last_test.points, "twin", "forward", "eta_r")
    last_impact_hz = float(frequencies[eta_r > 0].max())
    is_inside = fold.backward_hz < COEXISTING_HZ < fold.forward_hz and fold.kind == "right"
    name = "fold" if study.is_exact else "jump"
    yield ComparisonRow(
        "g4", "G4", statement,
        f"{name} down {fold.forward_hz:.3f} Hz, graze {graze:.3f} Hz, {name} up "
        f"{fold.backward_hz:.3f} Hz ({fold.method}); in ten-cycle steps the forward sweep still "
        f"impacts at {last_impact_hz:g} Hz",
        AGREES if is_inside else DEPARTS, rule,
        {"fold_down_hz": fold.forward_hz, "graze_hz": graze, "fold_up_hz": fold.backward_hz,
         "passage_from_hz": last_impact_hz,
         "passage_to_hz": last_impact_hz + last_test.profile.sweep.step_hz},
    )  # fmt: skip


def _compare_trends(study: PaperStudy) -> Iterator[ComparisonRow]:
    names = ("G30", "G16", "G10", "G4", "G0", "G-1")
    eta_d, eta_a = (
        [
            float(max(eta.max() for eta in getattr(study.slow_sweeps[name], quantity).values()))
            for name in names
        ]
        for quantity in ("eta_d", "eta_a")
    )
    yield ComparisonRow(
        "displacement_trend", "G30 to G-1", "the largest η_d falls as the gap falls",
        "largest η_d " + ", ".join(f"{value:.3f}" for value in eta_d),
        AGREES if all(np.diff(eta_d) < 0) else DEPARTS,
        "each value is below the one before, from G30 to G-1 (slow passage)", {"eta_d": eta_d},
    )  # fmt: skip
    largest = int(np.argmax(eta_a))
    yield ComparisonRow(
        "acceleration_trend", "G30 to G-1", "the largest η_a first rises, then falls",
        "largest η_a " + ", ".join(f"{value:.2f}" for value in eta_a)
        + f": largest at {names[largest]}",
        AGREES if largest > 0 and all(np.diff(eta_a[largest:]) < 0) else DEPARTS,
        "largest at neither the first nor the last gap, falling after the maximum",
        {"eta_a": eta_a},
    )  # fmt: skip


def _compare_coexistence(study: PaperStudy) -> Iterator[ComparisonRow]:
    orbits = findings.find_coexisting_orbits(
        study.cases["G4"], study.slow_sweeps["G4"], COEXISTING_HZ
    )
    statement = 'two solutions; the unstable third "could not be obtained"'
    rule = "two stable motions, and Newton on the one-period map finds the third between them"
    if orbits is None:
        yield ComparisonRow("g4_coexisting", "G4, 3.4 Hz", statement, "one solution", DEPARTS, rule)
        return
    impacting_mm, flight_mm = 1e3 * orbits.forward_m, 1e3 * orbits.backward_m
    text = f"{impacting_mm:.3f} mm impacting, {flight_mm:.3f} mm in flight"
    values: RowValues = {"impacting_mm": impacting_mm, "flight_mm": flight_mm}
    if orbits.unstable is None:
        text += "; the third is computed only for models in closed form"
        rule = "two steady motions, one for each direction"
    else:
        unstable_mm = 1e3 * orbits.unstable.u_max
        first, second = (float(abs(m)) for m in orbits.unstable.multipliers[:2])
        text += f", and the UNSTABLE {unstable_mm:.3f} mm (multipliers {first:.3f}, {second:.3f})"
        values |= {"unstable_mm": unstable_mm, "multiplier_1": first, "multiplier_2": second}
    yield ComparisonRow("g4_coexisting", "G4, 3.4 Hz", statement, text, AGREES, rule, values)


def format_shares(study: PaperStudy, hz: float) -> str:
    """Return the most frequent impact counts right/left with their shares of cycles."""
    phrases = [
        f"{r}/{l_} in {100 * share:.0f} %" for (r, l_), share in study.impacts[hz].shares[:4]
    ]
    return ", ".join(phrases) + " of the cycles"


def _compare_secondary_resonances(study: PaperStudy) -> Iterator[ComparisonRow]:
    first_hz, second_hz, third_hz = SECONDARY_HZ
    for hz, key, usual, sometimes, statement in (
        (first_hz, "g4_053", (3, 3), 4, "3 impacts a side, sometimes 4"),
        (second_hz, "g4_071", (2, 2), 3, "2 a side, sometimes a slight third"),
    ):
        distribution = study.impacts[hz]
        share_sometimes = distribution.share_at_least(sometimes)
        yield ComparisonRow(
            key, f"G4, {hz:g} Hz", statement, f"impacts right/left {format_shares(study, hz)}",
            AGREES if distribution.most_frequent == usual and share_sometimes > 0 else DEPARTS,
            f"most cycles {usual[0]}/{usual[1]}, some with {sometimes} or more on a side",
            {"usual_share": distribution.share(usual), "sometimes_share": share_sometimes},
        )  # fmt: skip
    distribution = study.impacts[third_hz]
    gap = findings.find_two_impact_gap_mm(study.cases["G4"], third_hz)
    yield ComparisonRow(
        "g4_11", f"G4, {third_hz:g} Hz", "2 a side, the second weak",
        f"impacts right/left {format_shares(study, third_hz)}; "
        + (f"2/2 only up to G = {gap:.2f} mm" if gap > 0 else "2/2 at no gap up to 4 mm"),
        AGREES if distribution.most_frequent == (2, 2) else DEPARTS, "most cycles 2/2",
        {"one_one_share": distribution.share((1, 1)), "two_two_share": distribution.share((2, 2)),
         "two_two_gap_mm": gap},
    )  # fmt: skip


def _compare_irregular_motion(study: PaperStudy) -> Iterator[ComparisonRow]:
    distribution = study.impacts[IRREGULAR_HZ]
    share = distribution.share((1, 2), (2, 1))
    side = "right" if distribution.share((2, 1)) > distribution.share((1, 2)) else "left"
    yield ComparisonRow(
        "g4_14", f"G4, {IRREGULAR_HZ:g} Hz", "left twice, right once",
        f"one side twice, the other once in {100 * share:.0f} % of the cycles"
        + (f" (from rest: {side} twice); by symmetry the mirror attractor coexists, and the "
           "initial conditions decide the side" if share > 0.5
           else f", {format_shares(study, IRREGULAR_HZ)}"),
        AGREES if share > 0.5 else DEPARTS, "2 on one side and 1 on the other in most cycles",
        {"twice_once_share": share},
    )  # fmt: skip


def _compare_chaos(study: PaperStudy) -> Iterator[ComparisonRow]:
    chaotic_bands = findings.find_bands(CHAOS_SCAN_HZ, study.exponents)
    exponents = [
        findings.compute_lyapunov_exponent(study.cases["G4"], hz)
        for hz in (*SECONDARY_HZ, IRREGULAR_HZ)
    ]
    intervals = ", ".join(f"{low:.3f} to {high:.3f}" for low, high in chaotic_bands)
    text = f"chaotic at {intervals} Hz" if chaotic_bands else "nowhere chaotic"
    yield ComparisonRow(
        "g4_chaos", "G4 below 1.5 Hz",
        "counts change from cycle to cycle; \"slightly quasi-periodic\", irregular 1 to 1.5 Hz",
        f"{text}; largest Lyapunov exponents "
        + ", ".join(f"{exponent:+.2f}" for exponent in exponents)
        + " per cycle at 0.53, 0.71, 1.1, 1.4 Hz",
        IN_KIND if min(exponents) > 0 else DEPARTS,
        "not periodic at these frequencies; the model's motion is chaotic, which is more than "
        "quasi-periodic",
        {"bands_hz": chaotic_bands, "exponents": exponents},
    )  # fmt: skip


def _format_difference(model: float, paper: float) -> str:
    """Return the relative difference between model and paper in percent, with sign."""
    return f"{100 * (model / paper - 1):+.0f} %".replace("-", "−")


def _compare_zero_gap(study: PaperStudy) -> Iterator[ComparisonRow]:
    """Yield the row of G0: resonance frequency, no hysteresis."""
    sweep = study.slow_sweeps["G0"]
    is_single_curve = sweep.max_difference < MAX_DIRECTION_DIFFERENCE
    is_close = abs(sweep.peak_hz / 4.8 - 1) < FREQUENCY_TOLERANCE
    yield ComparisonRow(
        "g0", "G0", "resonance at about 4.8 Hz, no hysteresis",
        f"{sweep.peak_hz:.2f} Hz ({_format_difference(sweep.peak_hz, 4.8)}), "
        + ("none" if is_single_curve else "hysteresis"),
        AGREES if is_single_curve and is_close else DEPARTS,
        "both directions follow one curve, resonance within 5 %",
        {"resonance_hz": sweep.peak_hz, "hysteresis": not is_single_curve},
    )  # fmt: skip


def _compare_small_precompression(study: PaperStudy) -> Iterator[ComparisonRow]:
    """Yield the rows of G-1 and G-2: softening hysteresis, loss of contact."""
    fold = study.folds["G-1"]
    is_left = fold is not None and fold.kind == "left"
    low, high = (fold.backward_hz, fold.forward_hz) if fold else (np.nan, np.nan)
    middle = (low + high) / 2
    is_inside = is_left and low < 6 < high
    yield ComparisonRow(
        "gm1", "G-1", "softening, left hysteresis, 6 Hz inside",
        f"{fold.kind} hysteresis, {low:.3f} to {high:.3f} Hz "
        f"({_format_difference(middle, 6.0)}; {fold.method})"
        if fold else NO_HYSTERESIS,
        AGREES if is_inside else IN_KIND if is_left else DEPARTS,
        "in kind: a left hysteresis; fully: 6 Hz inside it", {"from_hz": low, "to_hz": high},
    )  # fmt: skip
    if fold is not None:
        yield _compare_forward_contact(study, middle)
    fold, sweep = study.folds["G-2"], study.slow_sweeps["G-2"]
    low, high = (fold.backward_hz, fold.forward_hz) if fold else (np.nan, np.nan)
    detaches = findings.detaches(study.cases["G-2"], -2.0)
    yield ComparisonRow(
        "gm2", "G-2", "7.3 Hz, never detaches, no hysteresis",
        f"detaches, {fold.kind} hysteresis {low:.3f} to {high:.3f} Hz, largest η_d at "
        f"{sweep.peak_hz:.2f} Hz ({_format_difference(sweep.peak_hz, 7.3)})" if fold and detaches
        else f"{sweep.peak_hz:.2f} Hz ({_format_difference(sweep.peak_hz, 7.3)})",
        DEPARTS if fold or detaches else AGREES, "never detaches, both directions follow one curve",
        {"from_hz": low, "to_hz": high, "resonance_hz": sweep.peak_hz, "detaches": detaches},
    )  # fmt: skip


def _compare_forward_contact(study: PaperStudy, hz: float) -> ComparisonRow:
    case = study.cases["G-1"]
    precompression_mm = -1e3 * case.parameters.gap_r
    amplitude_mm = 1e3 * findings.steady_amplitude_m(case, study.slow_sweeps["G-1"], hz, "forward")
    stays = amplitude_mm <= precompression_mm
    return ComparisonRow(
        "gm1_forward", f"G−1, {hz:.3f} Hz", "forward: always in contact with both bumpers",
        f"amplitude {amplitude_mm:.3f} mm, pre-strain {precompression_mm:g} mm: "
        + ("always in contact" if stays else "it leaves each bumper for a moment"),
        AGREES if stays else DEPARTS,
        "the smaller of the two motions stays within the pre-strain",
        {"amplitude_mm": amplitude_mm},
    )  # fmt: skip


def _relative_difference(reference: Float1D, curve: Float1D) -> float:
    """Return the largest difference of two curves relative to the peak of the first."""
    return float(np.abs(reference - curve).max() / reference.max())


def _compare_large_precompression(study: PaperStudy) -> Iterator[ComparisonRow]:
    """Yield the rows of G-10, of G-2 against G-10, and of the onset of permanent contact."""
    sweep = study.slow_sweeps["G-10"]
    stays = sweep.max_difference < MAX_DIRECTION_DIFFERENCE and not findings.detaches(
        study.cases["G-10"], -10.0
    )
    is_close = abs(sweep.peak_hz / 7.6 - 1) < FREQUENCY_TOLERANCE
    yield ComparisonRow(
        "gm10", "G-10", "7.6 Hz, never detaches, no hysteresis",
        f"{sweep.peak_hz:.2f} Hz ({_format_difference(sweep.peak_hz, 7.6)}), "
        + ("never detaches, no hysteresis" if stays else "detaches"),
        AGREES if stays and is_close else IN_KIND if stays else DEPARTS,
        "in kind: always in contact, one curve; fully: resonance within 5 %",
        {"resonance_hz": sweep.peak_hz},
    )  # fmt: skip
    difference = max(
        _relative_difference(sweep.eta_d[direction], study.slow_sweeps["G-2"].eta_d[direction])
        for direction in ("forward", "backward")
    )
    yield ComparisonRow(
        "overlap", "G-2 and G-10", "their η_d and η_a practically coincide",
        f"η_d differs by up to {100 * difference:.0f} % of G-10's peak: G-2 still detaches",
        AGREES if difference < 0.1 else DEPARTS, "difference below a tenth of the peak everywhere",
        {"difference": difference},
    )  # fmt: skip
    gap = findings.find_permanent_contact_mm(study.cases["G-10"])
    if np.isnan(gap):
        yield ComparisonRow(
            "permanent_contact", "Onset of permanent contact", "G between −1 and −2 mm",
            f"not between 0 and {findings.MIN_GAP_MM:g} mm".replace("-", "−"), DEPARTS,
            "between −1 and −2 mm",
        )  # fmt: skip
        return
    detachments = [findings.detaches(study.cases["G-10"], gap + step) for step in (0.015, -0.015)]
    yield ComparisonRow(
        "permanent_contact", "Onset of permanent contact", "G between −1 and −2 mm",
        f"G = {gap:.3f} mm".replace("-", "−")
        + ("; a sweep 15 µm to either side confirms it" if detachments == [True, False] else ""),
        AGREES if -2 <= gap <= -1 else DEPARTS, "between −1 and −2 mm",
        {"gap_mm": gap, "confirmed": detachments == [True, False]},
    )  # fmt: skip
