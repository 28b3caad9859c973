"""The rows of G0 and of precompressed bumpers: softening, permanent contact."""

from collections.abc import Iterator

import numpy as np

from table_io.block import Float1D
from twin.service.paper import findings
from twin.service.paper.passage import SAME
from twin.service.paper.rows import AGREES, CLOSE, DEPARTS, IN_KIND, NONE, Row, percent
from twin.service.paper.study import Study


def zero(found: Study) -> Iterator[Row]:
    seen = found.slow["G0"]
    none = seen.difference < SAME
    near = abs(seen.peak_hz / 4.8 - 1) < CLOSE
    yield Row(
        "g0", "G0", "resonance at about 4.8 Hz, no hysteresis",
        f"{seen.peak_hz:.2f} Hz ({percent(seen.peak_hz, 4.8)}), "
        + ("none" if none else "hysteresis"),
        AGREES if none and near else DEPARTS,
        "both directions are one curve, resonance within 5 %",
        {"resonance_hz": seen.peak_hz, "hysteresis": not none},
    )  # fmt: skip


def softening(found: Study) -> Iterator[Row]:
    fold = found.folds["G-1"]
    left = fold is not None and fold.kind == "left"
    low, high = (fold.backward_hz, fold.forward_hz) if fold else (np.nan, np.nan)
    middle = (low + high) / 2
    near = left and low < 6 < high
    yield Row(
        "gm1", "G-1", "softening, left hysteresis, 6 Hz inside",
        f"{fold.kind} hysteresis, {low:.3f} to {high:.3f} Hz ({percent(middle, 6.0)}; {fold.how})"
        if fold else NONE,
        AGREES if near else IN_KIND if left else DEPARTS,
        "in kind: a left hysteresis; wholly: 6 Hz inside it", {"from_hz": low, "to_hz": high},
    )  # fmt: skip
    if fold is not None:
        yield _held(found, middle)
    fold, seen = found.folds["G-2"], found.slow["G-2"]
    low, high = (fold.backward_hz, fold.forward_hz) if fold else (np.nan, np.nan)
    detaches = findings.detaches(found.cases["G-2"], -2.0)
    yield Row(
        "gm2", "G-2", "7.3 Hz, never detaches, no hysteresis",
        f"detaches, {fold.kind} hysteresis {low:.3f} to {high:.3f} Hz, largest η_d at "
        f"{seen.peak_hz:.2f} Hz ({percent(seen.peak_hz, 7.3)})" if fold and detaches
        else f"{seen.peak_hz:.2f} Hz ({percent(seen.peak_hz, 7.3)})",
        DEPARTS if fold or detaches else AGREES, "never detaches, both directions one curve",
        {"from_hz": low, "to_hz": high, "resonance_hz": seen.peak_hz, "detaches": detaches},
    )  # fmt: skip


def _held(found: Study, hz: float) -> Row:
    case = found.cases["G-1"]
    pressed = -1e3 * case.parameters.gap_r
    size = 1e3 * findings.steady_m(case, found.slow["G-1"], hz, "forward")
    return Row(
        "gm1_forward", f"G−1, {hz:.3f} Hz", "forward: always in contact with both bumpers",
        f"amplitude {size:.3f} mm, pre-strain {pressed:g} mm: "
        + ("always in contact" if size <= pressed else "it leaves each bumper for a moment"),
        AGREES if size <= pressed else DEPARTS,
        "the smaller of the two motions stays within the pre-strain", {"amplitude_mm": size},
    )  # fmt: skip


def _same(one: Float1D, other: Float1D) -> float:
    """Largest difference of two curves relative to the height of the first."""
    return float(np.abs(one - other).max() / one.max())


def beyond(found: Study) -> Iterator[Row]:
    seen = found.slow["G-10"]
    none = seen.difference < SAME and not findings.detaches(found.cases["G-10"], -10.0)
    near = abs(seen.peak_hz / 7.6 - 1) < CLOSE
    yield Row(
        "gm10", "G-10", "7.6 Hz, never detaches, no hysteresis",
        f"{seen.peak_hz:.2f} Hz ({percent(seen.peak_hz, 7.6)}), "
        + ("never detaches, no hysteresis" if none else "detaches"),
        AGREES if none and near else IN_KIND if none else DEPARTS,
        "in kind: always in contact, one curve; wholly: resonance within 5 %",
        {"resonance_hz": seen.peak_hz},
    )  # fmt: skip
    apart = max(
        _same(seen.eta_d[one], found.slow["G-2"].eta_d[one]) for one in ("forward", "backward")
    )
    yield Row(
        "overlap", "G-2 and G-10", "their η_d and η_a practically coincide",
        f"η_d differs by up to {100 * apart:.0f} % of G-10's peak: G-2 still detaches",
        AGREES if apart < 0.1 else DEPARTS, "everywhere within a tenth of the peak",
        {"difference": apart},
    )  # fmt: skip
    gap = findings.permanent_contact_mm(found.cases["G-10"])
    if np.isnan(gap):
        yield Row(
            "permanent_contact", "Onset of permanent contact", "G between −1 and −2 mm",
            f"not between 0 and {findings.DEEPEST_MM:g} mm".replace("-", "−"), DEPARTS,
            "between −1 and −2 mm",
        )  # fmt: skip
        return
    checked = [findings.detaches(found.cases["G-10"], gap + step) for step in (0.015, -0.015)]
    yield Row(
        "permanent_contact", "Onset of permanent contact", "G between −1 and −2 mm",
        f"G = {gap:.3f} mm".replace("-", "−")
        + ("; a sweep 15 µm to either side confirms it" if checked == [True, False] else ""),
        AGREES if -2 <= gap <= -1 else DEPARTS, "between −1 and −2 mm",
        {"gap_mm": gap, "confirmed": checked == [True, False]},
    )  # fmt: skip
