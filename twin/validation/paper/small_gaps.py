"""Comparison rows for G0 and precompressed bumpers: softening, permanent contact."""

from collections.abc import Iterator

import numpy as np

from table_io.block import Float1D
from twin.reports.slow_passage import MAX_DIRECTION_DIFFERENCE
from twin.validation.paper import findings
from twin.validation.paper.rows import (
    AGREES,
    DEPARTS,
    FREQUENCY_TOLERANCE,
    IN_KIND,
    NO_HYSTERESIS,
    ComparisonRow,
    format_difference,
)
from twin.validation.paper.study import PaperStudy


def compare_zero_gap(study: PaperStudy) -> Iterator[ComparisonRow]:
    """Yield the row of G0: resonance frequency, no hysteresis."""
    sweep = study.slow_sweeps["G0"]
    is_single_curve = sweep.max_difference < MAX_DIRECTION_DIFFERENCE
    is_close = abs(sweep.peak_hz / 4.8 - 1) < FREQUENCY_TOLERANCE
    yield ComparisonRow(
        "g0", "G0", "resonance at about 4.8 Hz, no hysteresis",
        f"{sweep.peak_hz:.2f} Hz ({format_difference(sweep.peak_hz, 4.8)}), "
        + ("none" if is_single_curve else "hysteresis"),
        AGREES if is_single_curve and is_close else DEPARTS,
        "both directions follow one curve, resonance within 5 %",
        {"resonance_hz": sweep.peak_hz, "hysteresis": not is_single_curve},
    )  # fmt: skip


def compare_small_precompression(study: PaperStudy) -> Iterator[ComparisonRow]:
    """Yield the rows of G-1 and G-2: softening hysteresis, loss of contact."""
    fold = study.folds["G-1"]
    is_left = fold is not None and fold.kind == "left"
    low, high = (fold.backward_hz, fold.forward_hz) if fold else (np.nan, np.nan)
    middle = (low + high) / 2
    is_inside = is_left and low < 6 < high
    yield ComparisonRow(
        "gm1", "G-1", "softening, left hysteresis, 6 Hz inside",
        f"{fold.kind} hysteresis, {low:.3f} to {high:.3f} Hz "
        f"({format_difference(middle, 6.0)}; {fold.method})"
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
        f"{sweep.peak_hz:.2f} Hz ({format_difference(sweep.peak_hz, 7.3)})" if fold and detaches
        else f"{sweep.peak_hz:.2f} Hz ({format_difference(sweep.peak_hz, 7.3)})",
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


def compare_large_precompression(study: PaperStudy) -> Iterator[ComparisonRow]:
    """Yield the rows of G-10, of G-2 against G-10, and of the onset of permanent contact."""
    sweep = study.slow_sweeps["G-10"]
    stays = sweep.max_difference < MAX_DIRECTION_DIFFERENCE and not findings.detaches(
        study.cases["G-10"], -10.0
    )
    is_close = abs(sweep.peak_hz / 7.6 - 1) < FREQUENCY_TOLERANCE
    yield ComparisonRow(
        "gm10", "G-10", "7.6 Hz, never detaches, no hysteresis",
        f"{sweep.peak_hz:.2f} Hz ({format_difference(sweep.peak_hz, 7.6)}), "
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
