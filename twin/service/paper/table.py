"""The paper reports / the model gives / agrees or departs: one row a statement, each computed.

A row's verdict follows from its numbers by the rule that it states; nothing is tuned to agree.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from table_io.block import Float1D
from twin.model.parameters import resonance
from twin.service.paper import findings
from twin.service.paper.cases import curve
from twin.service.paper.study import CHAOS_HZ, COEXISTING_HZ, IRREGULAR_HZ, SECONDARY_HZ, Study

AGREES, IN_KIND, DEPARTS = "agrees", "agrees in kind", "departs"
CLOSE = 0.05  # of a frequency: what still agrees


@dataclass(frozen=True, slots=True)
class Row:
    """One statement of the paper, what the model gives, and the rule that the verdict follows."""

    key: str
    case: str
    paper: str
    model: str
    verdict: str
    rule: str
    values: dict[str, float | str | bool | list[float] | list[list[float]]] = field(
        default_factory=dict
    )


def table(found: Study) -> list[Row]:
    """Every row, in the order of the paper."""
    parts: tuple[Callable[[Study], Iterator[Row]], ...] = (
        _free_flight, _hardening, _trends, _coexistence, _secondary, _irregular, _chaos, _zero,
        _softening, _beyond,
    )  # fmt: skip
    return [row for part in parts for row in part(found)]


def _percent(model: float, paper: float) -> str:
    return f"{100 * (model / paper - 1):+.0f} %".replace("-", "−")


def _free_flight(found: Study) -> Iterator[Row]:
    case = found.cases["G∞"]
    u, a, hz = resonance(case.parameters, case.acceleration)
    f, eta = curve(case.points, "twin", "forward", "eta_d")
    yield Row(
        "free_flight", "Free flight", "resonance at about 1.3 Hz",
        f"{hz:.3f} Hz, u* = {1e3 * u:.3f} mm, a* = {a:.3f} m/s² (continuous in frequency); "
        f"{1e3 * u * eta.max():.2f} mm at {f[eta.argmax()]:g} Hz on the 0.1 Hz grid",
        AGREES if abs(hz / 1.3 - 1) < CLOSE else DEPARTS,
        "resonance within 5 %. Every η here is divided by the continuous u*, a*. The real damper "
        "is nonlinear: off resonance the experiment lies above the model",
        {"resonance_hz": hz, "u_star_mm": 1e3 * u, "a_star_m_s2": a,
         "grid_u_max_mm": float(1e3 * u * eta.max()), "grid_hz": float(f[eta.argmax()])},
    )  # fmt: skip


def _hardening(found: Study) -> Iterator[Row]:
    for name in ("G30", "G16", "G10"):
        fold = found.folds[name]
        right = fold is not None and fold.kind == "right"
        down, up = (fold.forward_hz, fold.backward_hz) if fold else (np.nan, np.nan)
        yield Row(
            name.lower(), name, "jumps and a right hysteresis",
            f"down-jump at {down:.3f} Hz, up-jump at {up:.3f} Hz (folds)",
            AGREES if right else DEPARTS,
            "the forward branch is the larger between two folds",
            {"down_hz": down, "up_hz": up},
        )  # fmt: skip
    fold = found.folds["G4"]
    if fold is None:
        return
    graze = findings.graze_hz(found.cases["G4"])
    last = found.cases["G4"].tests[-1]
    f, hits = curve(last.points, "twin", "forward", "eta_r")
    passed = float(f[hits > 0].max())
    inside = fold.backward_hz < COEXISTING_HZ < fold.forward_hz
    yield Row(
        "g4", "G4", "3.4 Hz lies inside the right hysteresis",
        f"fold down {fold.forward_hz:.3f} Hz, graze {graze:.3f} Hz, fold up "
        f"{fold.backward_hz:.3f} Hz; in ten-cycle steps the forward sweep still impacts at "
        f"{passed:g} Hz: passage is later than the fold",
        AGREES if inside else DEPARTS,
        "3.4 Hz lies between the folds",
        {"fold_down_hz": fold.forward_hz, "graze_hz": graze, "fold_up_hz": fold.backward_hz,
         "passage_from_hz": passed, "passage_to_hz": passed + last.profile.sweep.step_hz},
    )  # fmt: skip


def _trends(found: Study) -> Iterator[Row]:
    names = ("G30", "G16", "G10", "G4", "G0", "G-1")
    d, a = (
        [
            float(max(one.max() for one in getattr(found.slow[name], what).values()))
            for name in names
        ]
        for what in ("eta_d", "eta_a")
    )
    yield Row(
        "displacement_trend", "G30 to G-1", "the largest η_d falls as the gap falls",
        "largest η_d " + ", ".join(f"{size:.3f}" for size in d),
        AGREES if all(np.diff(d) < 0) else DEPARTS,
        "each is below the one before, from G30 to G-1 (slow passage)", {"eta_d": d},
    )  # fmt: skip
    top = int(np.argmax(a))
    yield Row(
        "acceleration_trend", "G30 to G-1", "the largest η_a first rises, then falls",
        "largest η_a " + ", ".join(f"{size:.2f}" for size in a) + f": greatest at {names[top]}",
        AGREES if top > 0 and all(np.diff(a[top:]) < 0) else DEPARTS,
        "greatest neither at the first nor at the last of them, falling after it", {"eta_a": a},
    )  # fmt: skip


def _coexistence(found: Study) -> Iterator[Row]:
    orbits = findings.coexisting(found.cases["G4"], found.slow["G4"], COEXISTING_HZ)
    said = 'two solutions; the unstable third "could not be obtained"'
    rule = "two stable motions, and Newton on the one-period map finds the third between them"
    if orbits is None:
        yield Row("g4_coexisting", "G4, 3.4 Hz", said, "one solution", DEPARTS, rule)
        return
    up, down, unstable = orbits
    one, other = (float(abs(m)) for m in unstable.multipliers[:2])
    yield Row(
        "g4_coexisting", "G4, 3.4 Hz", said,
        f"{1e3 * up.u_max:.3f} mm impacting, {1e3 * down.u_max:.3f} mm in flight, and the UNSTABLE "
        f"{1e3 * unstable.u_max:.3f} mm (multipliers {one:.3f}, {other:.3f})",
        AGREES, rule,
        {"impacting_mm": 1e3 * up.u_max, "flight_mm": 1e3 * down.u_max,
         "unstable_mm": 1e3 * unstable.u_max, "multiplier_1": one, "multiplier_2": other},
    )  # fmt: skip


def shares(found: Study, hz: float) -> str:
    """The distribution of impacts right/left per cycle in words."""
    parts = [f"{r}/{l_} in {100 * share:.0f} %" for (r, l_), share in found.impacts[hz].shares[:4]]
    return ", ".join(parts) + " of the cycles"


def _secondary(found: Study) -> Iterator[Row]:
    first, second, third = SECONDARY_HZ
    for hz, key, usual, sometimes, said in (
        (first, "g4_053", (3, 3), 4, "3 impacts a side, sometimes 4"),
        (second, "g4_071", (2, 2), 3, "2 a side, sometimes a slight third"),
    ):
        seen = found.impacts[hz]
        more = seen.at_least(sometimes)
        yield Row(
            key, f"G4, {hz:g} Hz", said, f"impacts right/left {shares(found, hz)}",
            AGREES if seen.usual == usual and more > 0 else DEPARTS,
            f"most cycles {usual[0]}/{usual[1]}, some with {sometimes} or more on a side",
            {"usual_share": seen.share(usual), "sometimes_share": more},
        )  # fmt: skip
    seen = found.impacts[third]
    gap = findings.twice_a_side_mm(found.cases["G4"], third)
    yield Row(
        "g4_11", f"G4, {third:g} Hz", "2 a side, the second weak",
        f"impacts right/left {shares(found, third)}; 2/2 only up to G = {gap:.2f} mm",
        AGREES if seen.usual == (2, 2) else DEPARTS, "most cycles 2/2",
        {"one_one_share": seen.share((1, 1)), "two_two_share": seen.share((2, 2)),
         "two_two_gap_mm": gap},
    )  # fmt: skip


def _irregular(found: Study) -> Iterator[Row]:
    seen = found.impacts[IRREGULAR_HZ]
    share = seen.share((1, 2), (2, 1))
    sides = "right" if seen.share((2, 1)) > seen.share((1, 2)) else "left"
    yield Row(
        "g4_14", f"G4, {IRREGULAR_HZ:g} Hz", "left twice, right once",
        f"one side twice, the other once in {100 * share:.0f} % of the cycles (from rest: {sides} "
        "twice); by symmetry the mirror attractor coexists, history picks the side",
        AGREES if share > 0.5 else DEPARTS, "2 on one side and 1 on the other in most cycles",
        {"twice_once_share": share},
    )  # fmt: skip


def _chaos(found: Study) -> Iterator[Row]:
    bands = findings.bands(CHAOS_HZ, found.exponents)
    exponents = [findings.exponent(found.cases["G4"], hz) for hz in (*SECONDARY_HZ, IRREGULAR_HZ)]
    text = ", ".join(f"{low:.3f} to {high:.3f}" for low, high in bands)
    yield Row(
        "g4_chaos", "G4 below 1.5 Hz",
        "counts change from cycle to cycle; \"slightly quasi-periodic\", irregular 1 to 1.5 Hz",
        f"chaotic at {text} Hz; largest Lyapunov exponents "
        + ", ".join(f"{one:+.2f}" for one in exponents)
        + " per cycle at 0.53, 0.71, 1.1, 1.4 Hz",
        IN_KIND if min(exponents) > 0 else DEPARTS,
        "not periodic at these frequencies; the model's motion is chaotic, which is more than "
        "quasi-periodic",
        {"bands_hz": bands, "exponents": exponents},
    )  # fmt: skip


def _zero(found: Study) -> Iterator[Row]:
    seen = found.slow["G0"]
    none = seen.difference < findings.SAME
    near = abs(seen.peak_hz / 4.8 - 1) < CLOSE
    yield Row(
        "g0", "G0", "resonance at about 4.8 Hz, no hysteresis",
        f"{seen.peak_hz:.2f} Hz ({_percent(seen.peak_hz, 4.8)}), "
        + ("none" if none else "hysteresis"),
        AGREES if none and near else DEPARTS,
        "both directions are one curve, resonance within 5 %",
        {"resonance_hz": seen.peak_hz, "hysteresis": not none},
    )  # fmt: skip


def _softening(found: Study) -> Iterator[Row]:
    fold = found.folds["G-1"]
    left = fold is not None and fold.kind == "left"
    low, high = (fold.backward_hz, fold.forward_hz) if fold else (np.nan, np.nan)
    middle = (low + high) / 2
    near = left and low < 6 < high
    yield Row(
        "gm1", "G-1", "softening, left hysteresis, 6 Hz inside",
        f"left hysteresis, {low:.3f} to {high:.3f} Hz ({_percent(middle, 6.0)})",
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
        f"{seen.peak_hz:.2f} Hz ({_percent(seen.peak_hz, 7.3)})" if fold and detaches
        else f"{seen.peak_hz:.2f} Hz ({_percent(seen.peak_hz, 7.3)})",
        DEPARTS if fold or detaches else AGREES, "never detaches, both directions one curve",
        {"from_hz": low, "to_hz": high, "resonance_hz": seen.peak_hz, "detaches": detaches},
    )  # fmt: skip


def _held(found: Study, hz: float) -> Row:
    case = found.cases["G-1"]
    pressed = -1e3 * case.parameters.gap_r
    orbits = findings.coexisting(case, found.slow["G-1"], hz)
    size = 1e3 * orbits[0].u_max if orbits else np.nan
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


def _beyond(found: Study) -> Iterator[Row]:
    seen = found.slow["G-10"]
    none = seen.difference < findings.SAME and not findings.detaches(found.cases["G-10"], -10.0)
    near = abs(seen.peak_hz / 7.6 - 1) < CLOSE
    yield Row(
        "gm10", "G-10", "7.6 Hz, never detaches, no hysteresis",
        f"{seen.peak_hz:.2f} Hz ({_percent(seen.peak_hz, 7.6)}), "
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
    checked = [findings.detaches(found.cases["G-10"], gap + step) for step in (0.015, -0.015)]
    yield Row(
        "permanent_contact", "Onset of permanent contact", "G between −1 and −2 mm",
        f"G = {gap:.3f} mm".replace("-", "−")
        + ("; a sweep 15 µm to either side confirms it" if checked == [True, False] else ""),
        AGREES if -2 <= gap <= -1 else DEPARTS, "between −1 and −2 mm",
        {"gap_mm": gap, "confirmed": checked == [True, False]},
    )  # fmt: skip
