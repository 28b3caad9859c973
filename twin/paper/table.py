"""Comparison table: one row per statement of the paper, with the model's result and a verdict.

`statements.toml` has the words of the paper, their places and the rule of the verdict; `FINDINGS`
has the function that computes each. No parameter is tuned to agree.
"""

import tomllib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from table_io.block import Float1D
from table_io.records import PrcPoint
from twin.model.parameters import free_flight_resonance
from twin.paper import findings, low_frequency
from twin.paper.low_frequency import ImpactSequence
from twin.paper.slow_passage import MAX_DIRECTION_DIFFERENCE
from twin.paper.study import (
    CHAOS_SCAN_HZ,
    COEXISTING_HZ,
    IRREGULAR_HZ,
    POSITIVE_GAPS,
    SECONDARY_HZ,
    PaperStudy,
)
from twin.results.paper_cases import PaperCase
from twin.results.players import SystemMotion
from twin.results.report_data import DIRECTIONS, extract_prc

AGREES, IN_KIND, DEPARTS = "agrees", "agrees in kind", "departs"
NOT_COMPARED = "no number to compare"
VERDICTS = (AGREES, IN_KIND, DEPARTS, NOT_COMPARED)
FREQUENCY_TOLERANCE = 0.05  # relative; a frequency within it agrees
KIND_TOLERANCE = 0.15  # relative; a secondary resonance within it is taken for the paper's
MAX_CURVE_DIFFERENCE = 0.1  # of the peak; curves within it overlap
MAX_CHAOTIC_HZ = 1.5  # above it the model is periodic
ZERO_GAP_HZ = 4.8  # resonance of G0 in the paper
NO_HYSTERESIS = "no hysteresis"
BUMPER_RATIOS = {"eta_j": ("eta_r", "eta_l"), "r_j": ("r_r", "r_l")}
_SYMBOLS = {"eta_d": "η_d", "eta_a": "η_a", "eta_j": "η_j", "r_j": "r_j"}
TREND_GAPS = (*POSITIVE_GAPS, "G0", "G-1")  # in the order of the paper's trends
RowValues = dict[str, float | str | bool | list[int] | list[float] | list[list[float]]]


@dataclass(frozen=True, slots=True)
class Quote:
    """Words of the paper, and where they stand."""

    text: str
    place: str

    def __str__(self) -> str:
        return f"“{self.text}” ({self.place})"


@dataclass(frozen=True, slots=True)
class ComparisonRow:
    """Quotes of the paper, result of the model, verdict, and the rule of the verdict.

    `paper_note`: what the paper gives beside the quoted words, such as a frequency in a caption.
    `cause`: why the model departs; "" where it does not.
    """

    key: str
    case: str
    quotes: tuple[Quote, ...]
    model: str
    verdict: str
    rule: str
    values: RowValues = field(default_factory=dict)
    paper_note: str = ""
    cause: str = ""

    @property
    def paper(self) -> str:
        """What the paper reports: its words with their places, and the note."""
        return "; ".join([*map(str, self.quotes), *([self.paper_note] if self.paper_note else [])])


@dataclass(frozen=True, slots=True)
class ModelFinding:
    """What the model gives on a statement, in words and numbers, and the verdict.

    `hz` stands in the name of the case, and `rule` in place of the statement's.
    """

    model: str
    verdict: str
    values: RowValues = field(default_factory=dict)
    hz: float | None = None
    rule: str = ""


def make_comparison_table(study: PaperStudy) -> list[ComparisonRow]:
    """Return every row, in the order of the paper."""
    text = Path(__file__).with_name("statements.toml").read_text(encoding="utf-8")
    document, rows = tomllib.loads(text), []
    for statement in document["statement"]:
        finding = FINDINGS[statement["key"]](study)
        if finding is None:
            continue
        quotes = tuple(Quote(*quote) for quote in statement.get("quotes", ()))
        case, _, detail = statement["case"].partition("{hz}")
        if detail:
            case += "" if finding.hz is None else f" {finding.hz:.3f} Hz,"
        rows.append(
            ComparisonRow(
                statement["key"],
                case + detail,
                quotes,
                finding.model,
                finding.verdict,
                finding.rule or statement["rule"],
                finding.values,
                statement.get("note", ""),
                document["causes"].get(statement.get("cause"), f"{statement['key']}, for itself")
                if finding.verdict == DEPARTS
                else "",
            )
        )
    return rows


def count_causes(rows: Sequence[ComparisonRow]) -> dict[str, int]:
    """Count the departures by their cause, most frequent first."""
    return dict(Counter(row.cause for row in rows if row.verdict == DEPARTS).most_common())


def _judge(agrees: bool, in_kind: bool = False) -> str:
    return AGREES if agrees else IN_KIND if in_kind else DEPARTS


def _falls(values: Sequence[float] | Float1D) -> bool:
    return bool(all(np.diff(values) < 0))


def _rises(values: Sequence[float] | Float1D) -> bool:
    return bool(all(np.diff(values) > 0))


def _list(values: Sequence[float] | Float1D, form: str) -> str:
    return ", ".join(f"{value:{form}}" for value in values)


def _format_difference(model: float, paper: float) -> str:
    """Return the relative difference between model and paper in percent, with sign."""
    return f"{100 * (model / paper - 1):+.0f} %".replace("-", "−")


def _relative_difference(reference: Float1D, curve: Float1D) -> float:
    """Return the largest difference of two curves relative to the peak of the first."""
    return float(np.abs(reference - curve).max() / reference.max())


def _compare_definition(study: PaperStudy) -> ModelFinding:
    """Compare the mean over cycles of Eq. 1 with the extremes over all of them."""
    excess, at_hz, cycles = max(
        _list_excesses(study.cases["G4"]), key=lambda entry: entry[0], default=(0.0, np.nan, 0)
    )
    return ModelFinding(
        f"every η here is the mean over the last {cycles} cycles of each cycle's ratio; with the "
        f"largest and the smallest value over these cycles η_d is the same where the motion is "
        f"periodic, and up to {100 * excess:.1f} % more in chaos (at {at_hz:g} Hz)",
        NOT_COMPARED,
        {"largest_excess": excess, "at_hz": at_hz},
    )


def _list_excesses(case: PaperCase) -> Iterator[tuple[float, float, int]]:
    """Yield (excess of eta_d over all measured cycles, frequency in Hz, cycles) of each step."""
    for test in case.tests:
        cycles = test.profile.sweep.measured_cycles
        u_max, u_min = (test.response.column(name)[:, -cycles:] for name in ("u_max", "u_min"))
        excess = (u_max.max(axis=1) - u_min.min(axis=1)) / (u_max - u_min).mean(axis=1) - 1
        for step, value in zip(test.steps, excess.tolist(), strict=True):
            if step.frequency_hz < MAX_CHAOTIC_HZ:  # above, a motion may be falling from its branch
                yield value, step.frequency_hz, cycles


def _find_free_flight(study: PaperStudy) -> ModelFinding:
    case = study.cases["G∞"]
    u, a, hz = free_flight_resonance(case.parameters, case.acceleration)
    method = "continuous in frequency"
    if not study.is_exact:
        hz = study.slow_sweeps["G∞"].peak_hz
        method = "u*, a* of its linear part, resonance by slow passage"
    frequencies, eta_d = extract_prc(case.points, "twin", "forward", "eta_d")
    peak_mm, peak_hz = 1e3 * case.scale[0] * eta_d.max(), float(frequencies[eta_d.argmax()])
    off_resonance = Quote(
        "in particular, the numerical curve is below the experimental one", "Sect. 5"
    )
    return ModelFinding(
        f"{hz:.3f} Hz, u* = {1e3 * u:.3f} mm, a* = {a:.3f} m/s² ({method}); "
        f"{peak_mm:.2f} mm at {peak_hz:g} Hz on the 0.1 Hz grid",
        NOT_COMPARED,
        {
            "resonance_hz": hz,
            "u_star_mm": 1e3 * u,
            "a_star_m_s2": a,
            "grid_u_max_mm": float(peak_mm),
            "grid_hz": peak_hz,
        },
        rule="every η here is divided by the continuous u*, a*, so G∞ stays below 1 on the grid "
        f"(η_d {eta_d.max():.2f}). Off resonance the experiment lies above the model: "
        f"{off_resonance}",
    )


def _find_hardening(study: PaperStudy, name: str) -> ModelFinding:
    fold = study.folds[name]
    if fold is None:
        return ModelFinding(NO_HYSTERESIS, DEPARTS, {"down_hz": np.nan, "up_hz": np.nan})
    down, up = fold.forward_hz, fold.backward_hz
    return ModelFinding(
        f"down-jump at {down:.3f} Hz, up-jump at {up:.3f} Hz ({fold.method})",
        _judge(fold.kind == "right"),
        {"down_hz": down, "up_hz": up},
    )


def _find_hysteresis(study: PaperStudy) -> ModelFinding:
    """Find the folds and the graze of G4, and where ten-cycle steps leave its upper branch."""
    fold = study.folds["G4"]
    if fold is None:
        return ModelFinding(NO_HYSTERESIS, DEPARTS)
    graze = findings.find_graze_hz(study.cases["G4"], study.slow_sweeps["G4"])
    last_test = study.cases["G4"].tests[-1]
    frequencies, eta_r = extract_prc(last_test.points, "twin", "forward", "eta_r")
    last_hz = float(frequencies[eta_r > 0].max())
    name = "fold" if study.is_exact else "jump"
    return ModelFinding(
        f"{name} down {fold.forward_hz:.3f} Hz, graze {graze:.3f} Hz, {name} up "
        f"{fold.backward_hz:.3f} Hz ({fold.method}); in ten-cycle steps the forward sweep still "
        f"impacts at {last_hz:g} Hz",
        _judge(fold.backward_hz < COEXISTING_HZ < fold.forward_hz and fold.kind == "right"),
        {
            "fold_down_hz": fold.forward_hz,
            "graze_hz": graze,
            "fold_up_hz": fold.backward_hz,
            "passage_from_hz": last_hz,
            "passage_to_hz": last_hz + last_test.profile.sweep.step_hz,
        },
    )


def _list_peaks(study: PaperStudy, quantity: str) -> list[float]:
    """Return the largest value of a ratio in the slow passage of each gap of the trends."""
    sweeps = (getattr(study.slow_sweeps[name], quantity) for name in TREND_GAPS)
    return [float(max(eta.max() for eta in sweep.values())) for sweep in sweeps]


def _find_displacement_trend(study: PaperStudy) -> ModelFinding:
    eta_d = _list_peaks(study, "eta_d")
    return ModelFinding(
        f"largest η_d {_list(eta_d, '.3f')}", _judge(_falls(eta_d)), {"eta_d": eta_d}
    )


def _find_acceleration_trend(study: PaperStudy) -> ModelFinding:
    eta_a = _list_peaks(study, "eta_a")
    largest = int(np.argmax(eta_a))
    return ModelFinding(
        f"largest η_a {_list(eta_a, '.2f')}: largest at {TREND_GAPS[largest]}",
        _judge(largest > 0 and _falls(eta_a[largest:])),
        {"eta_a": eta_a},
    )


def _find_transition_trend(study: PaperStudy) -> ModelFinding:
    names = ("G4", "G0", "G-1")
    values = {q: _list_peaks(study, q)[-len(names) :] for q in ("eta_d", "eta_a")}
    for quantity, sides in BUMPER_RATIOS.items():
        values[quantity] = [
            float(_list_ratios(study.cases[name].points, *sides).max()) for name in names
        ]
    texts = [f"{_SYMBOLS[name]} {_list(series, '.4f')}" for name, series in values.items()]
    return ModelFinding(
        f"largest {'; '.join(texts)}", _judge(all(map(_falls, values.values()))), {**values}
    )


def _compare_sides(study: PaperStudy) -> ModelFinding:
    """Compare the ratios of both bumpers: their largest values, and at every frequency."""
    of_peaks, anywhere = [], []
    for name in (*TREND_GAPS, "G-2", "G-10"):
        points = study.cases[name].points
        for sides in BUMPER_RATIOS.values():
            right, left = (_list_ratios(points, side) for side in sides)
            of_peaks.append(abs(float(left.max() / right.max()) - 1))
            difference = np.abs(right - left) / right.max()
            at = int(difference.argmax())
            anywhere.append((float(difference[at]), name, points[at].frequency_hz))
    most, name, hz = max(anywhere)
    return ModelFinding(
        f"the largest values of B_R and B_L differ by up to {100 * max(of_peaks):.1f} %; at one "
        f"frequency by up to {100 * most:.0f} % of them ({name}, {hz:g} Hz)",
        _judge(max(of_peaks) < MAX_CURVE_DIFFERENCE),
        {"of_peaks": max(of_peaks), "anywhere": most},
    )


def _compare_quantities(motions: Sequence[SystemMotion], case: PaperCase) -> list[float]:
    """Return how far the directions differ in η_d, η_a, η_j, r_j, relative to the larger one."""
    peaks = np.array(
        [
            [np.ptp(each.u), np.ptp(each.a), (each.u - case.gaps_m[0]).max(), each.force_r.max()]
            for each in motions
        ]
    ).clip(min=0.0)
    return (np.ptp(peaks, axis=0) / peaks.max(axis=0)).tolist()


def _format_quantities(differences: Sequence[float]) -> str:
    return ", ".join(
        f"{symbol} {100 * share:.0f} %"
        for symbol, share in zip(_SYMBOLS.values(), differences, strict=True)
    )


def _find_hysteresis_in_all(study: PaperStudy) -> ModelFinding:
    case, scan = study.cases["G4"], study.secondary["G4"]
    rows = {COEXISTING_HZ: [case.simulate_motion(COEXISTING_HZ, d, 4) for d in DIRECTIONS]}
    for interval in scan.intervals:
        hz = (interval.from_hz + interval.to_hz) / 2
        rows[hz] = [
            low_frequency.simulate_secondary_motion(case, scan, hz, d, 4) for d in DIRECTIONS
        ]
    differences = {hz: _compare_quantities(motions, case) for hz, motions in rows.items()}
    texts = [f"at {hz:.3g} Hz {_format_quantities(row)}" for hz, row in differences.items()]
    return ModelFinding(
        "forward and backward differ " + "; ".join(texts),
        _judge(len(rows) > 1 and min(map(min, differences.values())) > MAX_DIRECTION_DIFFERENCE),
        {"differences": [*differences.values()]},
    )


def _find_softening_in_all(study: PaperStudy) -> ModelFinding | None:
    """Compare the directions within the hysteresis of G-1; None without."""
    hz, case = _middle_of_softening(study), study.cases["G-1"]
    if hz is None:
        return None
    sweep = study.slow_sweeps["G-1"]
    motions = [findings.simulate_steady_motion(case, sweep, hz, d, 1) for d in DIRECTIONS]
    differences = _compare_quantities(motions, case)
    return ModelFinding(
        f"forward and backward differ at {hz:.3f} Hz {_format_quantities(differences)}",
        _judge(min(differences) > MAX_DIRECTION_DIFFERENCE),
        {"differences": differences},
    )


def _middle_of_softening(study: PaperStudy) -> float | None:
    fold = study.folds["G-1"]
    return None if fold is None else (fold.backward_hz + fold.forward_hz) / 2


def _list_ratios(points: tuple[PrcPoint, ...], *names: str) -> Float1D:
    """Return ratios of the model at every point, (name, point) flattened."""
    return np.array([getattr(point.twin, name) for name in names for point in points])


def _find_bumper_trend(study: PaperStudy) -> ModelFinding:
    eta_j, r_j = (
        [float(_list_ratios(study.cases[name].points, *sides).max()) for name in TREND_GAPS]
        for sides in BUMPER_RATIOS.values()
    )
    largest = [int(np.argmax(values)) for values in (eta_j, r_j)]
    rises_and_falls = all(
        0 < top < len(POSITIVE_GAPS) and _rises(values[: top + 1]) and _falls(values[top:])
        for top, values in zip(largest, (eta_j, r_j), strict=True)
    )
    return ModelFinding(
        f"largest η_j {_list(eta_j, '.4f')}; largest r_j {_list(r_j, '.4f')}: largest at "
        + " and ".join(TREND_GAPS[top] for top in largest),
        _judge(rises_and_falls),
        {"eta_j": eta_j, "r_j": r_j},
    )


def _find_ratios_in_flight(study: PaperStudy) -> ModelFinding:
    flights = [
        point.twin
        for name in POSITIVE_GAPS
        for point in study.cases[name].points
        if point.twin and not any((*point.twin.impacts_right, *point.twin.impacts_left))
    ]
    largest = max(
        (max(each.eta_r, each.eta_l, each.r_r, each.r_l) for each in flights), default=np.nan
    )
    return ModelFinding(
        f"largest η_j or r_j {largest:g} at the {len(flights)} grid points without impact",
        _judge(largest == 0),
        {"points": len(flights), "largest": largest},
    )


def _find_ratios_in_contact(study: PaperStudy) -> ModelFinding:
    smallest = [
        float(_list_ratios(study.cases[name].points, "eta_r", "eta_l", "r_r", "r_l").min())
        for name in ("G0", "G-1", "G-2", "G-10")
    ]
    return ModelFinding(
        f"smallest η_j or r_j {_list(smallest, '.4f')}",
        _judge(min(smallest) > 0),
        {"smallest": smallest},
    )


def _list_offsets(study: PaperStudy) -> dict[str, float]:
    """Return the pre-strain over u* of each gap below zero."""
    return {
        name: -case.parameters.gap_r / case.scale[0]
        for name, case in study.cases.items()
        if case.parameters.gap_r < 0
    }


def _find_offset(study: PaperStudy) -> ModelFinding:
    offsets = _list_offsets(study)
    smallest = [
        min(
            float(extract_prc(study.cases[name].points, "twin", direction, "eta_r")[1].min())
            for direction in DIRECTIONS
        )
        for name in offsets
    ]
    above = [eta - offset for eta, offset in zip(smallest, offsets.values(), strict=True)]
    pairs = zip(above, offsets.values(), strict=True)
    return ModelFinding(
        "η_j starts above the pre-strain over u*: "
        + ", ".join(f"{offset + rest:.4f} against {offset:.4f}" for rest, offset in pairs),
        _judge(min(above) > 0),
        {"offsets": list(offsets.values()), "smallest_above": above},
    )


def _find_shift(study: PaperStudy) -> ModelFinding:
    offsets = _list_offsets(study)

    def shift(name: str, direction: str) -> Float1D:
        eta = extract_prc(study.cases[name].points, "twin", direction, "eta_r")[1]
        return eta - offsets[name]

    difference = max(_relative_difference(shift("G-10", d), shift("G-2", d)) for d in DIRECTIONS)
    return ModelFinding(
        f"η_j less the pre-strain differs by up to {100 * difference:.0f} % of G-10's peak: G-2 "
        "still detaches",
        _judge(difference < MAX_CURVE_DIFFERENCE),
        {"difference": difference},
    )


def _find_coexistence(study: PaperStudy) -> ModelFinding:
    orbits = findings.find_coexisting_orbits(
        study.cases["G4"], study.slow_sweeps["G4"], COEXISTING_HZ
    )
    if orbits is None:
        return ModelFinding("one solution", DEPARTS)
    impacting_mm, flight_mm = 1e3 * orbits.forward_m, 1e3 * orbits.backward_m
    text = f"{impacting_mm:.3f} mm impacting, {flight_mm:.3f} mm in flight"
    values: RowValues = {"impacting_mm": impacting_mm, "flight_mm": flight_mm}
    if orbits.unstable is None:
        text += "; the third is computed only for models in closed form"
        return ModelFinding(text, AGREES, values, rule="two steady motions, one for each direction")
    unstable_mm = 1e3 * orbits.unstable.u_max
    first, second = (float(abs(m)) for m in orbits.unstable.multipliers[:2])
    text += f", and the UNSTABLE {unstable_mm:.3f} mm (multipliers {first:.3f}, {second:.3f})"
    values |= {"unstable_mm": unstable_mm, "multiplier_1": first, "multiplier_2": second}
    return ModelFinding(text, AGREES, values)


def format_shares(study: PaperStudy, hz: float) -> str:
    """Return the most frequent impact counts right/left with their shares of cycles."""
    phrases = [
        f"{r}/{l_} in {100 * share:.0f} %" for (r, l_), share in study.impacts[hz].shares[:4]
    ]
    return ", ".join(phrases) + " of the cycles"


def _find_left_hystereses(study: PaperStudy) -> ModelFinding:
    intervals = {
        name: [[i.from_hz, i.to_hz] for i in scan.intervals]
        for name, scan in study.secondary.items()
    }
    listed = "; ".join(
        f"{name} at " + ", ".join(f"{low:.3f} to {high:.3f}" for low, high in own) + " Hz"
        for name, own in intervals.items()
        if own
    )
    return ModelFinding(
        f"left hysteresis of {listed} (slow passage; the tests start at 0.5 Hz)"
        if listed
        else "no left hysteresis",
        _judge(len(intervals["G4"]) > 1),
        {"g4_hz": intervals["G4"], "g10_hz": intervals["G10"]},
    )


def _count_left_hystereses(study: PaperStudy) -> ModelFinding:
    counts = [len(study.secondary[name].intervals) for name in POSITIVE_GAPS]
    pairs = zip(POSITIVE_GAPS, counts, strict=True)
    return ModelFinding(
        "left hystereses " + ", ".join(f"{name}: {count}" for name, count in pairs),
        _judge(all(np.diff(counts) >= 0) and 0 < counts[-2] < counts[-1]),
        {"counts": counts},
    )


def _find_secondary_positions(study: PaperStudy) -> ModelFinding:
    own = [study.find_own_hz(hz) for hz in SECONDARY_HZ]
    pairs = [(hz, paper) for hz, paper in zip(own, SECONDARY_HZ, strict=True) if hz is not None]
    errors = [hz / paper - 1 for hz, paper in pairs]
    worst = max(map(abs, errors)) if len(errors) == len(own) else np.inf
    return ModelFinding(
        ", ".join(f"{hz:.3f} Hz ({_format_difference(hz, paper)})" for hz, paper in pairs)
        + " (where the forward sweep jumps up)"
        if pairs
        else "none of the three",
        _judge(worst < FREQUENCY_TOLERANCE, worst < KIND_TOLERANCE),
        {"own_hz": [hz for hz, _ in pairs], "errors": errors},
    )


def _measure_own_impacts(study: PaperStudy, paper_hz: float, count: int) -> ImpactSequence | None:
    """Measure the impacts of the forward motion at the model's own secondary resonance."""
    hz, case = study.find_own_hz(paper_hz), study.cases["G4"]
    if hz is None:
        return None
    state = study.secondary["G4"].state_at(hz, "forward")
    return low_frequency.measure_impact_sequence(case, hz, state, count)


def _count_impacts(study: PaperStudy, hz: float, usual: int) -> ModelFinding:
    """Count the impacts of a cycle: `usual` a side, sometimes one more."""
    distribution, pair = study.impacts[hz], (usual, usual)
    share_sometimes = distribution.share_at_least(usual + 1)
    return ModelFinding(
        f"impacts right/left {format_shares(study, hz)}",
        _judge(distribution.most_frequent == pair and share_sometimes > 0),
        {"usual_share": distribution.share(pair), "sometimes_share": share_sometimes},
    )


def _count_impacts_at_third(study: PaperStudy) -> ModelFinding:
    hz = SECONDARY_HZ[2]
    distribution, own_hz = study.impacts[hz], study.find_own_hz(hz)
    gap = findings.find_two_impact_gap_mm(study.cases["G4"], hz)
    own = _measure_own_impacts(study, hz, 2)
    own_share = own.share if own else 0.0
    at_own = (
        f"2 a side in {100 * own_share:.0f} % of the cycles at its own resonance, {own_hz:.3f} Hz "
        "forward; "
        if own_hz
        else ""
    )
    only = f"2/2 only up to G = {gap:.2f} mm" if gap > 0 else "2/2 at no gap up to 4 mm"
    return ModelFinding(
        f"{at_own}at {hz:g} Hz right/left {format_shares(study, hz)}; there {only}",
        _judge(own_share > 0.5),
        {
            "one_one_share": distribution.share((1, 1)),
            "two_two_share": distribution.share((2, 2)),
            "two_two_gap_mm": gap,
            "own_hz": own_hz or np.nan,
            "own_two_share": own_share,
        },
    )


def _compare_second_impact(study: PaperStudy) -> ModelFinding:
    hz = SECONDARY_HZ[2]
    impacts, own_hz = _measure_own_impacts(study, hz, 2), study.find_own_hz(hz)
    if impacts is None or own_hz is None:
        return ModelFinding("one impact a side", DEPARTS)
    force = impacts.peaks_n[1] / impacts.peaks_n[0]
    duration = impacts.durations_s[1] / impacts.durations_s[0]
    return ModelFinding(
        f"{impacts.peaks_n[1]:.0f} N after {impacts.peaks_n[0]:.0f} N ({100 * force:.0f} %), "
        f"{1e3 * impacts.durations_s[1]:.0f} ms after {1e3 * impacts.durations_s[0]:.0f} ms "
        f"({100 * duration:.0f} %), at its own resonance",
        _judge(max(force, duration) < 1),
        {"force_ratio": force, "duration_ratio": duration},
        own_hz,
    )


def _compare_three_impacts(study: PaperStudy) -> ModelFinding:
    case, hz = study.cases["G4"], SECONDARY_HZ[0]
    settled = case.simulator.sweep([hz], case.acceleration, findings.SETTLE_CYCLES).states[0]
    chaotic = low_frequency.measure_impact_sequence(case, hz, settled, 3)
    peaks_n = chaotic.peaks_n if chaotic else []
    return ModelFinding(
        f"mean peak forces {_list(peaks_n, '.0f')} N over the cycles with three"
        if peaks_n
        else "no cycle with three impacts",
        _judge(len(peaks_n) == 3 and _falls(peaks_n)),
        {"peaks_n": peaks_n},
    )


def _format_loops(study: PaperStudy, hz: float) -> str:
    right, left = map(format_uncertain, study.loops[hz].mean, study.loops[hz].error)
    return f"at {hz:g} Hz {right} right, {left} left".replace("+", "")


def _find_sides_apart(study: PaperStudy, hz: float) -> bool:
    """Return whether the sides differ in internal loops, by a tenth and beyond chance."""
    loops = study.loops[hz]
    difference = abs(loops.mean[0] - loops.mean[1])
    return bool(difference > max(3 * np.hypot(*loops.error), 0.1 * sum(loops.mean) / 2))


def _find_growth_of_loops(study: PaperStudy) -> ModelFinding:
    counts = [sum(study.loops[hz].mean) / 2 for hz in SECONDARY_HZ]
    reaching = [study.loops[hz].reaching for hz in SECONDARY_HZ]
    return ModelFinding(
        f"{_list(counts, '.1f')} internal loops a side and cycle, "
        f"{', '.join(f'{100 * share:.0f} %' for share in reaching)} of them intersecting an "
        "obstacle, at 0.53, 0.71, 1.1 Hz",
        _judge(_falls(counts) and _falls(reaching)),
        {"loops": counts, "reaching": reaching},
    )


def _compare_sides_of_loops(study: PaperStudy) -> ModelFinding:
    apart = [_find_sides_apart(study, hz) for hz in SECONDARY_HZ[:2]]
    return ModelFinding(
        "internal loops a cycle "
        + ", ".join(_format_loops(study, hz) for hz in SECONDARY_HZ[:2])
        + " (from rest, with standard errors)",
        _judge(all(apart), any(apart)),
        {"loops": [list(study.loops[hz].mean) for hz in SECONDARY_HZ[:2]]},
    )


def _find_symmetry_at_third(study: PaperStudy) -> ModelFinding:
    hz = SECONDARY_HZ[2]
    return ModelFinding(
        f"internal loops a cycle {_format_loops(study, hz)}",
        _judge(not _find_sides_apart(study, hz)),
        {"loops": list(study.loops[hz].mean)},
    )


def _count_irregular_loops(study: PaperStudy) -> ModelFinding:
    fewer, more = sorted(study.loops[IRREGULAR_HZ].mean)
    return ModelFinding(
        f"internal loops a cycle {_format_loops(study, IRREGULAR_HZ)}",
        _judge(fewer < 0.1 and 0.5 < more < 1.5),
        {"loops": [fewer, more]},
    )


def _compare_directions(study: PaperStudy) -> ModelFinding:
    """Compare forward and backward curves in the middle of each left hysteresis of G4."""
    scan, case = study.secondary["G4"], study.cases["G4"]
    differences = []
    for interval in scan.intervals:
        hz = (interval.from_hz + interval.to_hz) / 2
        excursions = [
            float(np.ptp(low_frequency.simulate_secondary_motion(case, scan, hz, d, 4).a))
            for d in DIRECTIONS
        ]
        differences.append(abs(excursions[0] - excursions[1]) / max(excursions))
    largest = max(differences, default=0.0)
    return ModelFinding(
        f"in the left hystereses η_a differs by {100 * min(differences):.0f} to "
        f"{100 * largest:.0f} % of the larger one"
        if differences
        else "one curve",
        _judge(largest <= MAX_CURVE_DIFFERENCE),
        {"differences": differences},
    )


def _count_irregular_impacts(study: PaperStudy) -> ModelFinding:
    distribution = study.impacts[IRREGULAR_HZ]
    share = distribution.share((1, 2), (2, 1))
    side = "right" if distribution.share((2, 1)) > distribution.share((1, 2)) else "left"
    note = f", {format_shares(study, IRREGULAR_HZ)}"
    if share > 0.5:
        note = (
            f" (from rest: {side} twice); by symmetry the mirror attractor coexists, and the "
            "initial conditions decide the side"
        )
    return ModelFinding(
        f"one side twice, the other once in {100 * share:.0f} % of the cycles{note}",
        _judge(share > 0.5),
        {"twice_once_share": share},
    )


def format_uncertain(value: float, error: float) -> str:
    """Return a value with its standard error in units of the last digit, as +0.6099(12)."""
    if error == 0:
        return f"{value:+g}".replace("-", "−")
    digits = int(np.clip(1 - np.floor(np.log10(max(error, 1e-6))), 0, 6))
    return f"{value:+.{digits}f}({round(error * 10**digits)})".replace("-", "−")


def _find_chaotic_bands(study: PaperStudy) -> ModelFinding:
    bands = findings.find_bands(CHAOS_SCAN_HZ, study.exponents)
    irregular = [(low, high) for low, high in bands if high > 1 and low < MAX_CHAOTIC_HZ]
    is_within = all(low > 1 and high < MAX_CHAOTIC_HZ for low, high in irregular)
    intervals = ", ".join(f"{low:.3f} to {high:.3f}" for low, high in bands)
    return ModelFinding(
        f"chaotic at {intervals} Hz" if bands else "nowhere chaotic",
        _judge(bool(irregular) and is_within),
        {"bands_hz": bands},
    )


def _measure_chaos(study: PaperStudy) -> ModelFinding:
    measures = [study.chaos[hz] for hz in (*SECONDARY_HZ, IRREGULAR_HZ)]
    exponents = [measure.exponent for measure in measures]
    errors = [measure.error for measure in measures]
    is_chaotic = min(exponents) > 0
    return ModelFinding(
        "largest Lyapunov exponents "
        + ", ".join(map(format_uncertain, exponents, errors))
        + " per cycle at 0.53, 0.71, 1.1, 1.4 Hz, with standard errors: "
        + ("chaotic" if is_chaotic else "not all chaotic"),
        _judge(agrees=False, in_kind=is_chaotic),
        {
            "bands_hz": findings.find_bands(CHAOS_SCAN_HZ, study.exponents),
            "exponents": exponents,
            "errors": errors,
        },
    )


def _measure_scatter(study: PaperStudy) -> ModelFinding:
    scatters = [study.chaos[hz].scatter for hz in SECONDARY_HZ]
    return ModelFinding(
        "standard deviation of η_d over cycles "
        + ", ".join(f"{100 * scatter:.1f} %" for scatter in scatters)
        + " at 0.53, 0.71, 1.1 Hz, like the exponents largest at "
        + f"{SECONDARY_HZ[int(np.argmax(scatters))]:g} Hz",
        _judge(_rises(scatters)),
        {"scatters": scatters},
    )


def _find_zero_gap_resonance(study: PaperStudy) -> ModelFinding:
    sweep = study.slow_sweeps["G0"]
    is_single_curve = sweep.max_difference < MAX_DIRECTION_DIFFERENCE
    is_close = abs(sweep.peak_hz / ZERO_GAP_HZ - 1) < FREQUENCY_TOLERANCE
    return ModelFinding(
        f"{sweep.peak_hz:.2f} Hz ({_format_difference(sweep.peak_hz, ZERO_GAP_HZ)}), "
        + ("none" if is_single_curve else "hysteresis"),
        _judge(is_single_curve and is_close),
        {"resonance_hz": sweep.peak_hz, "hysteresis": not is_single_curve},
    )


def _measure_zero_gap_flight(study: PaperStudy) -> ModelFinding:
    flight = findings.measure_zero_gap_flight(study.cases["G0"], ZERO_GAP_HZ)
    return ModelFinding(
        f"{100 * flight.share:.2f} % of the time in flight, {100 * flight.elastic_share:.2f} % "
        "with a tenth of C_j",
        _judge(0 < flight.share < 0.05 and flight.elastic_share < flight.share / 5),
        {"share": flight.share, "elastic_share": flight.elastic_share},
    )


def _measure_release(study: PaperStudy) -> ModelFinding:
    remaining = findings.measure_zero_gap_flight(study.cases["G0"], ZERO_GAP_HZ).remaining
    return ModelFinding(
        f"{100 * remaining:.1f} % of the largest deformation left at release",
        _judge(remaining < 0.1),
        {"remaining": remaining},
    )


def _find_softening(study: PaperStudy) -> ModelFinding:
    fold = study.folds["G-1"]
    if fold is None:
        return ModelFinding(NO_HYSTERESIS, DEPARTS, {"from_hz": np.nan, "to_hz": np.nan})
    low, high, is_left = fold.backward_hz, fold.forward_hz, fold.kind == "left"
    return ModelFinding(
        f"{fold.kind} hysteresis, {low:.3f} to {high:.3f} Hz "
        f"({_format_difference((low + high) / 2, 6.0)}; {fold.method})",
        _judge(is_left and low < 6 < high, is_left),
        {"from_hz": low, "to_hz": high},
    )


def _find_forward_contact(study: PaperStudy) -> ModelFinding | None:
    """Find whether the forward motion in the hysteresis of G-1 stays in contact; None without."""
    hz, case = _middle_of_softening(study), study.cases["G-1"]
    if hz is None:
        return None
    precompression_mm = -1e3 * case.parameters.gap_r
    amplitude_mm = 1e3 * findings.steady_amplitude_m(case, study.slow_sweeps["G-1"], hz, "forward")
    stays = amplitude_mm <= precompression_mm
    return ModelFinding(
        f"amplitude {amplitude_mm:.3f} mm, pre-strain {precompression_mm:g} mm: "
        + ("always in contact" if stays else "it leaves each bumper for a moment"),
        _judge(stays),
        {"amplitude_mm": amplitude_mm},
        hz,
    )


def _find_backward_contact(study: PaperStudy) -> ModelFinding | None:
    """Find with how many bumpers the mass is in contact in the larger motion; None without."""
    hz, case = _middle_of_softening(study), study.cases["G-1"]
    if hz is None:
        return None
    shares = findings.measure_contact_shares(case, study.slow_sweeps["G-1"], hz, "backward")
    both, single, none = shares
    return ModelFinding(
        f"in contact with both bumpers for {100 * both:.1f} % of the time, with one for "
        f"{100 * single:.1f} %, with none for {100 * none:.1f} %",
        _judge(both > 0 and single > 0 and none == 0),
        {"shares": [*shares]},
        hz,
    )


def _find_small_precompression(study: PaperStudy) -> ModelFinding:
    fold, sweep = study.folds["G-2"], study.slow_sweeps["G-2"]
    low, high = (fold.backward_hz, fold.forward_hz) if fold else (np.nan, np.nan)
    detaches = findings.detaches(study.cases["G-2"], -2.0)
    position = f"{sweep.peak_hz:.2f} Hz ({_format_difference(sweep.peak_hz, 7.3)})"
    return ModelFinding(
        f"detaches, {fold.kind} hysteresis {low:.3f} to {high:.3f} Hz, largest η_d at {position}"
        if fold and detaches
        else position,
        _judge(not (fold or detaches)),
        {"from_hz": low, "to_hz": high, "resonance_hz": sweep.peak_hz, "detaches": detaches},
    )


def _find_large_precompression(study: PaperStudy) -> ModelFinding:
    sweep = study.slow_sweeps["G-10"]
    detaches = findings.detaches(study.cases["G-10"], -10.0)
    stays = sweep.max_difference < MAX_DIRECTION_DIFFERENCE and not detaches
    is_close = abs(sweep.peak_hz / 7.6 - 1) < FREQUENCY_TOLERANCE
    return ModelFinding(
        f"{sweep.peak_hz:.2f} Hz ({_format_difference(sweep.peak_hz, 7.6)}), "
        + ("never detaches, no hysteresis" if stays else "detaches"),
        _judge(stays and is_close, stays),
        {"resonance_hz": sweep.peak_hz},
    )


def _find_overlap(study: PaperStudy) -> ModelFinding:
    curves = (study.slow_sweeps[name].eta_d for name in ("G-10", "G-2"))
    first, second = curves
    difference = max(_relative_difference(first[d], second[d]) for d in DIRECTIONS)
    return ModelFinding(
        f"η_d differs by up to {100 * difference:.0f} % of G-10's peak: G-2 still detaches",
        _judge(difference < MAX_CURVE_DIFFERENCE),
        {"difference": difference},
    )


def _find_permanent_contact(study: PaperStudy) -> ModelFinding:
    case = study.cases["G-10"]
    gap = findings.find_permanent_contact_mm(case)
    if np.isnan(gap):
        text = f"not between 0 and {findings.MIN_GAP_MM:g} mm".replace("-", "−")
        return ModelFinding(text, DEPARTS)
    detachments = [findings.detaches(case, gap + step) for step in (0.015, -0.015)]
    is_confirmed = detachments == [True, False]
    return ModelFinding(
        f"G = {gap:.3f} mm".replace("-", "−")
        + ("; a sweep 15 µm to either side confirms it" if is_confirmed else ""),
        _judge(-2 <= gap <= -1),
        {"gap_mm": gap, "confirmed": is_confirmed},
    )


FINDINGS: dict[str, Callable[[PaperStudy], ModelFinding | None]] = {
    "eta_definition": _compare_definition,
    "free_flight": _find_free_flight,
    "g30": partial(_find_hardening, name="G30"),
    "g16": partial(_find_hardening, name="G16"),
    "g10": partial(_find_hardening, name="G10"),
    "g4": _find_hysteresis,
    "displacement_trend": _find_displacement_trend,
    "acceleration_trend": _find_acceleration_trend,
    "bumper_trend": _find_bumper_trend,
    "transition_trend": _find_transition_trend,
    "bumpers_alike": _compare_sides,
    "no_impact": _find_ratios_in_flight,
    "always_contact": _find_ratios_in_contact,
    "offset": _find_offset,
    "shift": _find_shift,
    "g4_coexisting": _find_coexistence,
    "g4_quantities": _find_hysteresis_in_all,
    "left_hystereses": _find_left_hystereses,
    "secondary_number": _count_left_hystereses,
    "secondary_positions": _find_secondary_positions,
    "g4_053": partial(_count_impacts, hz=SECONDARY_HZ[0], usual=3),
    "g4_071": partial(_count_impacts, hz=SECONDARY_HZ[1], usual=2),
    "g4_11": _count_impacts_at_third,
    "second_impact": _compare_second_impact,
    "three_impacts": _compare_three_impacts,
    "loops_growth": _find_growth_of_loops,
    "loops_left": _compare_sides_of_loops,
    "loops_third": _find_symmetry_at_third,
    "superimposed": _compare_directions,
    "g4_14": _count_irregular_impacts,
    "g4_14_loop": _count_irregular_loops,
    "g4_irregular": _find_chaotic_bands,
    "g4_chaos": _measure_chaos,
    "g4_growth": _measure_scatter,
    "g0": _find_zero_gap_resonance,
    "g0_flight": _measure_zero_gap_flight,
    "g0_release": _measure_release,
    "gm1": _find_softening,
    "gm1_forward": _find_forward_contact,
    "gm1_backward": _find_backward_contact,
    "gm1_quantities": _find_softening_in_all,
    "gm2": _find_small_precompression,
    "gm10": _find_large_precompression,
    "overlap": _find_overlap,
    "permanent_contact": _find_permanent_contact,
}
