"""Comparison table: one row per statement of the paper, with the model's result and a verdict.

The verdict follows from the numbers by the rule stated in the row; no parameter is tuned to agree.
What stands in quotation marks is the paper's text, word by word, with its place.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

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
from twin.results.report_data import DIRECTIONS, extract_prc

AGREES, IN_KIND, DEPARTS = "agrees", "agrees in kind", "departs"
NOT_COMPARED = "no number to compare"
VERDICTS = (AGREES, IN_KIND, DEPARTS, NOT_COMPARED)
FREQUENCY_TOLERANCE = 0.05  # relative; a frequency within it agrees
KIND_TOLERANCE = 0.15  # relative; a secondary resonance within it is taken for the paper's
MAX_CHAOTIC_HZ = 1.5  # above it the model is periodic
ZERO_GAP_HZ = 4.8  # resonance of G0 in the paper
NO_HYSTERESIS = "no hysteresis"
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
    """

    key: str
    case: str
    quotes: tuple[Quote, ...]
    model: str
    verdict: str
    rule: str
    values: RowValues = field(default_factory=dict)
    paper_note: str = ""

    @property
    def paper(self) -> str:
        """What the paper reports: its words with their places, and the note."""
        return "; ".join([*map(str, self.quotes), *([self.paper_note] if self.paper_note else [])])


def make_comparison_table(study: PaperStudy) -> list[ComparisonRow]:
    """Return every row, in the order of the paper."""
    comparisons: tuple[Callable[[PaperStudy], Iterator[ComparisonRow]], ...] = (
        _compare_definition,
        _compare_free_flight,
        _compare_hardening,
        _compare_trends,
        _compare_bumpers,
        _compare_coexistence,
        _compare_left_hystereses,
        _compare_secondary_positions,
        _compare_impact_counts,
        _compare_second_impacts,
        _compare_superposition,
        _compare_irregular_motion,
        _compare_chaos,
        _compare_zero_gap,
        _compare_small_precompression,
        _compare_large_precompression,
    )
    return [row for compare in comparisons for row in compare(study)]


def _compare_definition(study: PaperStudy) -> Iterator[ComparisonRow]:
    """Yield the row on Eq. 1: the mean over cycles against the extremes over all of them."""
    excess, at_hz, cycles = max(
        _list_excesses(study.cases["G4"]), key=lambda entry: entry[0], default=(0.0, np.nan, 0)
    )
    yield ComparisonRow(
        "eta_definition", "Eq. 1, G4", (Quote("the normalized excursion of the relative "
        "displacement of the mass η_d", "Sect. 3"),),
        f"every η here is the mean over the last {cycles} cycles of each cycle's ratio; with the "
        f"largest and the smallest value over these cycles η_d is the same where the motion is "
        f"periodic, and up to {100 * excess:.1f} % more in chaos (at {at_hz:g} Hz)",
        NOT_COMPARED, "the text does not say over how many cycles the extremes are taken",
        {"largest_excess": excess, "at_hz": at_hz},
    )  # fmt: skip


def _list_excesses(case: PaperCase) -> Iterator[tuple[float, float, int]]:
    """Yield (excess of eta_d over all measured cycles, frequency in Hz, cycles) of each step."""
    for test in case.tests:
        cycles = test.profile.sweep.measured_cycles
        u_max, u_min = (test.response.column(name)[:, -cycles:] for name in ("u_max", "u_min"))
        excess = (u_max.max(axis=1) - u_min.min(axis=1)) / (u_max - u_min).mean(axis=1) - 1
        for step, value in zip(test.steps, excess.tolist(), strict=True):
            if step.frequency_hz < MAX_CHAOTIC_HZ:  # above, a motion may be falling from its branch
                yield value, step.frequency_hz, cycles


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
        "free_flight", "Free flight", (),
        f"{hz:.3f} Hz, u* = {1e3 * u:.3f} mm, a* = {a:.3f} m/s² ({method}); "
        f"{1e3 * u_scale * eta_d.max():.2f} mm at {peak_hz:g} Hz on the 0.1 Hz grid",
        NOT_COMPARED,
        "every η here is divided by the continuous u*, a*, so G∞ stays below 1 on the grid "
        f"(η_d {eta_d.max():.2f}). Off resonance the experiment lies above the model: "
        + str(Quote("in particular, the numerical curve is below the experimental one", "Sect. 5")),
        {"resonance_hz": hz, "u_star_mm": 1e3 * u, "a_star_m_s2": a,
         "grid_u_max_mm": float(1e3 * u_scale * eta_d.max()), "grid_hz": peak_hz},
        "no number in the text",
    )  # fmt: skip


def _compare_hardening(study: PaperStudy) -> Iterator[ComparisonRow]:
    for name in ("G30", "G16", "G10"):
        fold = study.folds[name]
        is_right = fold is not None and fold.kind == "right"
        down, up = (fold.forward_hz, fold.backward_hz) if fold else (np.nan, np.nan)
        yield ComparisonRow(
            name.lower(), name, (Quote(
                "the hardening caused by the impact between the mass and the bumpers bends the "
                "PRCs to the right, causing the occurrence of jumps", "Sect. 3"),),
            f"down-jump at {down:.3f} Hz, up-jump at {up:.3f} Hz ({fold.method})"
            if fold else NO_HYSTERESIS,
            AGREES if is_right else DEPARTS,
            "the forward branch is the larger one between two jumps",
            {"down_hz": down, "up_hz": up},
        )  # fmt: skip
    fold = study.folds["G4"]
    statement = (Quote("that is in the frequency range between the two jumps (primary right "
                       "hysteresis)", "Sect. 5, on 3.4 Hz"),)  # fmt: skip
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
        "displacement_trend", "G30 to G-1",
        (Quote("the maximum value of η_d decreases", "Sect. 3, as G decreases"),),
        "largest η_d " + ", ".join(f"{value:.3f}" for value in eta_d),
        AGREES if all(np.diff(eta_d) < 0) else DEPARTS,
        "each value is below the one before, from G30 to G-1 (slow passage)", {"eta_d": eta_d},
    )  # fmt: skip
    largest = int(np.argmax(eta_a))
    yield ComparisonRow(
        "acceleration_trend", "G30 to G-1",
        (Quote("the maximum acceleration, after an initial increase, starts to decrease",
               "Sect. 3"),),
        "largest η_a " + ", ".join(f"{value:.2f}" for value in eta_a)
        + f": largest at {names[largest]}",
        AGREES if largest > 0 and all(np.diff(eta_a[largest:]) < 0) else DEPARTS,
        "largest at neither the first nor the last gap, falling after the maximum",
        {"eta_a": eta_a},
    )  # fmt: skip


def _list_ratios(points: tuple[PrcPoint, ...], *names: str) -> Float1D:
    """Return ratios of the model at every point, (name, point) flattened."""
    return np.array([getattr(point.twin, name) for name in names for point in points])


def _compare_bumpers(study: PaperStudy) -> Iterator[ComparisonRow]:
    """Yield the rows on eta_j and r_j: trend, zero without impact, offset by precompression."""
    points = {name: case.points for name, case in study.cases.items()}
    names = (*POSITIVE_GAPS, "G0", "G-1")
    eta_j, r_j = (
        [float(_list_ratios(points[name], *sides).max()) for name in names]
        for sides in (("eta_r", "eta_l"), ("r_r", "r_l"))
    )
    largest = int(np.argmax(eta_j)), int(np.argmax(r_j))
    rises_and_falls = all(
        0 < top < len(POSITIVE_GAPS) and all(np.diff(values[: top + 1]) > 0)
        and all(np.diff(values[top:]) < 0)
        for top, values in zip(largest, (eta_j, r_j), strict=True)
    )  # fmt: skip
    yield ComparisonRow(
        "bumper_trend", "G30 to G-1",
        (Quote("The trends of both the deformation (Fig. 2c) and the contact force (Fig. 2d) for "
               "decreasing positive gaps are similar to that of the acceleration of the mass",
               "Sect. 3"),),
        "largest η_j " + ", ".join(f"{value:.4f}" for value in eta_j)
        + "; largest r_j " + ", ".join(f"{value:.4f}" for value in r_j)
        + f": largest at {names[largest[0]]} and {names[largest[1]]}",
        AGREES if rises_and_falls else DEPARTS, "each first rises, then falls",
        {"eta_j": eta_j, "r_j": r_j},
    )  # fmt: skip
    flights = [
        point.twin for name in POSITIVE_GAPS for point in points[name]
        if point.twin and not any((*point.twin.impacts_right, *point.twin.impacts_left))
    ]  # fmt: skip
    largest_ratio = max(
        (max(each.eta_r, each.eta_l, each.r_r, each.r_l) for each in flights), default=np.nan
    )
    yield ComparisonRow(
        "no_impact", "G30 to G4",
        (Quote("are zero at the frequency values for which the impact does not occur", "Sect. 3, "
               "on η_j and r_j"),),
        f"largest η_j or r_j {largest_ratio:g} at the {len(flights)} grid points without impact",
        AGREES if largest_ratio == 0 else DEPARTS, "exactly zero",
        {"points": len(flights), "largest": largest_ratio},
    )  # fmt: skip
    smallest = {
        name: float(_list_ratios(points[name], "eta_r", "eta_l", "r_r", "r_l").min())
        for name in ("G0", "G-1", "G-2", "G-10")
    }
    yield ComparisonRow(
        "always_contact", "G0 to G-10",
        (Quote("always different from zero", "Sect. 3, on η_j and r_j"),),
        "smallest η_j or r_j " + ", ".join(f"{value:.4f}" for value in smallest.values()),
        AGREES if min(smallest.values()) > 0 else DEPARTS, "greater than zero at every frequency",
        {"smallest": list(smallest.values())},
    )  # fmt: skip
    yield from _compare_offsets(study)


def _compare_offsets(study: PaperStudy) -> Iterator[ComparisonRow]:
    """Yield the rows on the pre-strain: offset of eta_j, and eta_j of G-2 and G-10 without it."""
    offsets = {
        name: -case.parameters.gap_r / case.scale[0]
        for name, case in study.cases.items()
        if case.parameters.gap_r < 0
    }
    eta = {
        name: {d: extract_prc(study.cases[name].points, "twin", d, "eta_r")[1] for d in DIRECTIONS}
        for name in offsets
    }
    above = {
        name: min(float(curve.min()) for curve in eta[name].values()) - offset
        for name, offset in offsets.items()
    }
    yield ComparisonRow(
        "offset", "G-1, G-2, G-10",
        (Quote("causes an offset of the PRCs of η_j", "Sect. 3, on the pre-strain"),),
        "η_j starts above the pre-strain over u*: "
        + ", ".join(f"{offset + above[name]:.4f} against {offset:.4f}"
                    for name, offset in offsets.items()),
        AGREES if min(above.values()) > 0 else DEPARTS,
        "the smallest η_j lies above the pre-strain over u*",
        {"offsets": list(offsets.values()), "smallest_above": list(above.values())},
    )  # fmt: skip
    shifted = {
        name: {d: curve - offsets[name] for d, curve in eta[name].items()} for name in offsets
    }
    difference = max(
        _relative_difference(shifted["G-10"][d], shifted["G-2"][d]) for d in DIRECTIONS
    )
    yield ComparisonRow(
        "shift", "G-2 and G-10",
        (Quote("once the initial shift value has been removed, the resulting PRCs are "
               "substantially overlapped", "Sect. 4.2, on η_j and r_j"),),
        f"η_j less the pre-strain differs by up to {100 * difference:.0f} % of G-10's peak: G-2 "
        "still detaches",
        AGREES if difference < 0.1 else DEPARTS, "difference below a tenth of the peak everywhere",
        {"difference": difference},
    )  # fmt: skip


def _compare_coexistence(study: PaperStudy) -> Iterator[ComparisonRow]:
    orbits = findings.find_coexisting_orbits(
        study.cases["G4"], study.slow_sweeps["G4"], COEXISTING_HZ
    )
    statement = (
        Quote("two co-existing stable solutions are observed", "Sect. 4.1"),
        Quote("there would be also a third unstable solution, that could not be obtained "
              "experimentally", "Sect. 4.1"),
    )  # fmt: skip
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


def _format_intervals(study: PaperStudy, name: str) -> str:
    return ", ".join(
        f"{interval.from_hz:.3f} to {interval.to_hz:.3f}"
        for interval in study.secondary[name].intervals
    )


def _compare_left_hystereses(study: PaperStudy) -> Iterator[ComparisonRow]:
    """Yield the rows on the secondary resonances with left hysteresis: at all, and their number."""
    intervals = {
        name: [[i.from_hz, i.to_hz] for i in scan.intervals]
        for name, scan in study.secondary.items()
    }
    listed = "; ".join(
        f"{name} at {_format_intervals(study, name)} Hz" for name in intervals if intervals[name]
    )
    yield ComparisonRow(
        "left_hystereses", "G10 and G4, low frequencies",
        (Quote("The numerical model highlighted the existence of several secondary resonances, of "
               "different type (with left hysteresis and of non-regular type), in the low "
               "frequency range", "Sect. 5"),),
        f"left hysteresis of {listed} (slow passage; the tests start at 0.5 Hz)" if listed
        else "no left hysteresis",
        AGREES if len(intervals["G4"]) > 1 else DEPARTS,
        "several left hystereses of G4 below 1.7 Hz, by the rule of `prc`",
        {"g4_hz": intervals["G4"], "g10_hz": intervals["G10"]},
    )  # fmt: skip
    counts = [len(intervals[name]) for name in POSITIVE_GAPS]
    yield ComparisonRow(
        "secondary_number", "G30 to G4",
        (Quote("the number of secondary resonances was found to increase decreasing G", "Sect. 3"),
         Quote("for quite small gaps (G10 and G4) secondary resonances in the low frequency range "
               "were observed", "Sect. 3")),
        "left hystereses " + ", ".join(
            f"{name}: {count}" for name, count in zip(POSITIVE_GAPS, counts, strict=True)),
        AGREES if all(np.diff(counts) >= 0) and 0 < counts[-2] < counts[-1] else DEPARTS,
        "G10 has some, G4 more, and no gap fewer than a larger one", {"counts": counts},
    )  # fmt: skip


def _compare_secondary_positions(study: PaperStudy) -> Iterator[ComparisonRow]:
    own = [study.find_own_hz(hz) for hz in SECONDARY_HZ]
    pairs = [(hz, paper) for hz, paper in zip(own, SECONDARY_HZ, strict=True) if hz is not None]
    errors = [hz / paper - 1 for hz, paper in pairs]
    worst = max(map(abs, errors)) if len(errors) == len(own) else np.inf
    yield ComparisonRow(
        "secondary_positions", "G4, position",
        (Quote("Three secondary resonances were observed at frequencies", "Sect. 4.3"),),
        ", ".join(f"{hz:.3f} Hz ({_format_difference(hz, paper)})" for hz, paper in pairs)
        + " (where the forward sweep jumps up)" if pairs else "none of the three",
        AGREES if worst < FREQUENCY_TOLERANCE else IN_KIND if worst < KIND_TOLERANCE else DEPARTS,
        "in kind: within 15 %; fully: within 5 %",
        {"own_hz": [hz for hz, _ in pairs], "errors": errors}, "0.53, 0.71 and 1.1 Hz (Sect. 4.3)",
    )  # fmt: skip


def _measure_own_impacts(study: PaperStudy, paper_hz: float, count: int) -> ImpactSequence | None:
    """Measure the impacts of the forward motion at the model's own secondary resonance."""
    hz, case = study.find_own_hz(paper_hz), study.cases["G4"]
    if hz is None:
        return None
    state = study.secondary["G4"].state_at(hz, "forward")
    return low_frequency.measure_impact_sequence(case, hz, state, count)


def _compare_impact_counts(study: PaperStudy) -> Iterator[ComparisonRow]:
    """Yield the rows on the number of impacts at the three secondary resonances."""
    first_hz, second_hz, third_hz = SECONDARY_HZ
    for hz, key, usual, sometimes, quotes in (
        (first_hz, "g4_053", (3, 3), 4,
         (Quote("the mass impacts, in an evident way, each bumper three times", "Sect. 4.3"),
          Quote("sometimes four impacts were observed", "Sect. 4.3"))),
        (second_hz, "g4_071", (2, 2), 3,
         (Quote("the mass continues to impact each bumper twice, but the second impact is more "
                "evident", "Sect. 4.3"),
          Quote("also a third slight impact was sometimes observed", "Sect. 4.3"))),
    ):  # fmt: skip
        distribution = study.impacts[hz]
        share_sometimes = distribution.share_at_least(sometimes)
        yield ComparisonRow(
            key, f"G4, {hz:g} Hz, count", quotes, f"impacts right/left {format_shares(study, hz)}",
            AGREES if distribution.most_frequent == usual and share_sometimes > 0 else DEPARTS,
            f"most cycles {usual[0]}/{usual[1]}, some with {sometimes} or more on a side",
            {"usual_share": distribution.share(usual), "sometimes_share": share_sometimes},
        )  # fmt: skip
    distribution, own_hz = study.impacts[third_hz], study.find_own_hz(third_hz)
    gap = findings.find_two_impact_gap_mm(study.cases["G4"], third_hz)
    own = _measure_own_impacts(study, third_hz, 2)
    own_share = own.share if own else 0.0
    yield ComparisonRow(
        "g4_11", f"G4, {third_hz:g} Hz, count",
        (Quote("the mass impact each bumper twice", "Sect. 4.3"),),
        (f"2 a side in {100 * own_share:.0f} % of the cycles at its own resonance, {own_hz:.3f} Hz "
         "forward; " if own_hz else "")
        + f"at {third_hz:g} Hz right/left {format_shares(study, third_hz)}; there "
        + (f"2/2 only up to G = {gap:.2f} mm" if gap > 0 else "2/2 at no gap up to 4 mm"),
        AGREES if own_share > 0.5 else DEPARTS,
        "most cycles 2 a side at the resonance, wherever it lies: its position is a row of its own",
        {"one_one_share": distribution.share((1, 1)), "two_two_share": distribution.share((2, 2)),
         "two_two_gap_mm": gap, "own_hz": own_hz or np.nan, "own_two_share": own_share},
    )  # fmt: skip


def _compare_second_impacts(study: PaperStudy) -> Iterator[ComparisonRow]:
    """Yield the rows on the strength of the impacts of one cycle."""
    third_hz, first_hz = SECONDARY_HZ[2], SECONDARY_HZ[0]
    impacts, hz = _measure_own_impacts(study, third_hz, 2), study.find_own_hz(third_hz)
    statement = (Quote("with both the intensity and duration of the second impact lower than the "
                       "first one", "Sect. 4.3, on 1.1 Hz"),)  # fmt: skip
    rule = "peak force and duration of the second impact below those of the first"
    if impacts is None or hz is None:
        yield ComparisonRow("second_impact", "G4, second impact", statement, "one impact a side",
                            DEPARTS, rule)  # fmt: skip
    else:
        force = impacts.peaks_n[1] / impacts.peaks_n[0]
        duration = impacts.durations_s[1] / impacts.durations_s[0]
        yield ComparisonRow(
            "second_impact", f"G4, {hz:.3f} Hz, second impact", statement,
            f"{impacts.peaks_n[1]:.0f} N after {impacts.peaks_n[0]:.0f} N "
            f"({100 * force:.0f} %), {1e3 * impacts.durations_s[1]:.0f} ms after "
            f"{1e3 * impacts.durations_s[0]:.0f} ms ({100 * duration:.0f} %), at its own resonance",
            AGREES if max(force, duration) < 1 else DEPARTS, rule,
            {"force_ratio": force, "duration_ratio": duration},
        )  # fmt: skip
    case = study.cases["G4"]
    settled = case.simulator.sweep([first_hz], case.acceleration, findings.SETTLE_CYCLES).states[0]
    chaotic = low_frequency.measure_impact_sequence(case, first_hz, settled, 3)
    peaks_n = chaotic.peaks_n if chaotic else []
    yield ComparisonRow(
        "three_impacts", f"G4, {first_hz:g} Hz, three impacts",
        (Quote("with the intensity of the impact decreasing passing from the first one to the "
               "third one", "Sect. 4.3"),),
        ("mean peak forces " + ", ".join(f"{peak:.0f}" for peak in peaks_n)
         + " N over the cycles with three") if peaks_n else "no cycle with three impacts",
        AGREES if len(peaks_n) == 3 and all(np.diff(peaks_n) < 0) else DEPARTS,
        "each mean peak force below the one before", {"peaks_n": peaks_n},
    )  # fmt: skip


def _compare_superposition(study: PaperStudy) -> Iterator[ComparisonRow]:
    """Yield the row on forward and backward curves at the secondary resonances."""
    scan, case = study.secondary["G4"], study.cases["G4"]
    differences = []
    for low_hz, high_hz in ((i.from_hz, i.to_hz) for i in scan.intervals):
        hz = (low_hz + high_hz) / 2
        excursions = [
            float(np.ptp(low_frequency.simulate_secondary_motion(case, scan, hz, d, 4).a))
            for d in DIRECTIONS
        ]
        differences.append(abs(excursions[0] - excursions[1]) / max(excursions))
    largest = max(differences, default=0.0)
    yield ComparisonRow(
        "superimposed", "G4, secondary resonances",
        (Quote("forward and backward PRCs are substantially superimposed", "Sect. 4.3"),),
        f"in the left hystereses η_a differs by {100 * min(differences):.0f} to "
        f"{100 * largest:.0f} % of the larger one" if differences else "one curve",
        DEPARTS if largest > 0.1 else AGREES,
        "difference of η_a below a tenth in the middle of each. The experiment saw no left "
        "hysteresis: " + str(Quote("but not the left hysteresis, due to the limitations of the "
                                   "shaking table", "Sect. 5")),
        {"differences": differences},
    )  # fmt: skip


def _compare_irregular_motion(study: PaperStudy) -> Iterator[ComparisonRow]:
    distribution = study.impacts[IRREGULAR_HZ]
    share = distribution.share((1, 2), (2, 1))
    side = "right" if distribution.share((2, 1)) > distribution.share((1, 2)) else "left"
    yield ComparisonRow(
        "g4_14", f"G4, {IRREGULAR_HZ:g} Hz",
        (Quote("the mass impacts the left bumper twice and the right bumper once", "Sect. 5"),),
        f"one side twice, the other once in {100 * share:.0f} % of the cycles"
        + (f" (from rest: {side} twice); by symmetry the mirror attractor coexists, and the "
           "initial conditions decide the side" if share > 0.5
           else f", {format_shares(study, IRREGULAR_HZ)}"),
        AGREES if share > 0.5 else DEPARTS, "2 on one side and 1 on the other in most cycles",
        {"twice_once_share": share},
    )  # fmt: skip


def format_uncertain(value: float, error: float) -> str:
    """Return a value with its standard error in units of the last digit, as +0.6099(12)."""
    digits = int(np.clip(1 - np.floor(np.log10(max(error, 1e-6))), 0, 6))
    return f"{value:+.{digits}f}({round(error * 10**digits)})".replace("-", "−")


def _compare_chaos(study: PaperStudy) -> Iterator[ComparisonRow]:
    """Yield the rows on irregular motion below 1.5 Hz: where, of which kind, how it grows."""
    chaotic_bands = findings.find_bands(CHAOS_SCAN_HZ, study.exponents)
    intervals = ", ".join(f"{low:.3f} to {high:.3f}" for low, high in chaotic_bands)
    irregular = [band for band in chaotic_bands if band[1] > 1 and band[0] < 1.5]
    yield ComparisonRow(
        "g4_irregular", "G4, 1 to 1.5 Hz",
        (Quote("the numerical model highlighted also the existence of irregularities between 1 Hz "
               "and 1.5 Hz", "Sect. 5"),),
        f"chaotic at {intervals} Hz" if chaotic_bands else "nowhere chaotic",
        AGREES if irregular and all(low > 1 and high < 1.5 for low, high in irregular) else DEPARTS,
        "a chaotic band within 1 to 1.5 Hz, and none across its ends",
        {"bands_hz": chaotic_bands},
    )  # fmt: skip
    measures = [study.chaos[hz] for hz in (*SECONDARY_HZ, IRREGULAR_HZ)]
    exponents, errors = ([getattr(m, name) for m in measures] for name in ("exponent", "error"))
    yield ComparisonRow(
        "g4_chaos", "G4, type of motion",
        (Quote("the numerical response is slightly quasi-periodic", "Sect. 5"),),
        "largest Lyapunov exponents "
        + ", ".join(format_uncertain(m.exponent, m.error) for m in measures)
        + " per cycle at 0.53, 0.71, 1.1, 1.4 Hz, with standard errors: "
        + ("chaotic" if min(exponents) > 0 else "not all chaotic"),
        IN_KIND if min(exponents) > 0 else DEPARTS,
        "not periodic at these frequencies; the model's motion is chaotic, which is more than "
        "quasi-periodic",
        {"bands_hz": chaotic_bands, "exponents": exponents, "errors": errors},
    )  # fmt: skip
    scatters = [study.chaos[hz].scatter for hz in SECONDARY_HZ]
    yield ComparisonRow(
        "g4_growth", "G4, 0.53 to 1.1 Hz",
        (Quote("with the extent of the quasi-periodicity increasing with the frequency",
               "Sect. 5"),),
        "standard deviation of η_d over cycles "
        + ", ".join(f"{100 * scatter:.1f} %" for scatter in scatters)
        + " at 0.53, 0.71, 1.1 Hz, like the exponents largest at "
        + f"{SECONDARY_HZ[int(np.argmax(scatters))]:g} Hz",
        AGREES if all(np.diff(scatters) > 0) else DEPARTS,
        "each scatter greater than that at the frequency before", {"scatters": scatters},
    )  # fmt: skip


def _format_difference(model: float, paper: float) -> str:
    """Return the relative difference between model and paper in percent, with sign."""
    return f"{100 * (model / paper - 1):+.0f} %".replace("-", "−")


def _compare_zero_gap(study: PaperStudy) -> Iterator[ComparisonRow]:
    """Yield the rows of G0: resonance frequency, no hysteresis; flight and elastic limit."""
    sweep = study.slow_sweeps["G0"]
    is_single_curve = sweep.max_difference < MAX_DIRECTION_DIFFERENCE
    is_close = abs(sweep.peak_hz / ZERO_GAP_HZ - 1) < FREQUENCY_TOLERANCE
    yield ComparisonRow(
        "g0", "G0",
        (Quote("the resonance shifted to higher frequencies (about 4.8 Hz) and without jumps or "
               "hysteresis", "Sect. 3"),),
        f"{sweep.peak_hz:.2f} Hz ({_format_difference(sweep.peak_hz, ZERO_GAP_HZ)}), "
        + ("none" if is_single_curve else "hysteresis"),
        AGREES if is_single_curve and is_close else DEPARTS,
        "both directions follow one curve, resonance within 5 %",
        {"resonance_hz": sweep.peak_hz, "hysteresis": not is_single_curve},
    )  # fmt: skip
    flight = findings.measure_zero_gap_flight(study.cases["G0"], ZERO_GAP_HZ)
    yield ComparisonRow(
        "g0_flight", f"G0, {ZERO_GAP_HZ:g} Hz, flight",
        (Quote("there is a short time interval in which the mass is not in contact with either "
               "bumper", "Sect. 4.1"),
         Quote("This phase vanishes for purely elastic bumpers", "Sect. 4.1")),
        f"{100 * flight.share:.1f} % of the time in flight, {100 * flight.elastic_share:.1f} % "
        "with a tenth of C_j",
        AGREES if 0 < flight.share < 0.05 and flight.elastic_share < flight.share / 5 else DEPARTS,
        "flight of less than 5 % of the time, and less than a fifth of it with a tenth of C_j",
        {"share": flight.share, "elastic_share": flight.elastic_share},
    )  # fmt: skip
    yield ComparisonRow(
        "g0_release", f"G0, {ZERO_GAP_HZ:g} Hz, release",
        (Quote("the mass detaches from one bumper when the latter has recovered practically all "
               "its deformation", "Sect. 4.1"),),
        f"{100 * flight.remaining:.1f} % of the largest deformation left at release",
        AGREES if flight.remaining < 0.1 else DEPARTS, "less than a tenth left",
        {"remaining": flight.remaining},
    )  # fmt: skip


def _compare_small_precompression(study: PaperStudy) -> Iterator[ComparisonRow]:
    """Yield the rows of G-1 and G-2: softening hysteresis, loss of contact."""
    fold = study.folds["G-1"]
    is_left = fold is not None and fold.kind == "left"
    low, high = (fold.backward_hz, fold.forward_hz) if fold else (np.nan, np.nan)
    middle = (low + high) / 2
    is_inside = is_left and low < 6 < high
    yield ComparisonRow(
        "gm1", "G-1",
        (Quote("the PRCs bend to the left, due to a softening-like behavior, showing jumps",
               "Sect. 3"),),
        f"{fold.kind} hysteresis, {low:.3f} to {high:.3f} Hz "
        f"({_format_difference(middle, 6.0)}; {fold.method})"
        if fold else NO_HYSTERESIS,
        AGREES if is_inside else IN_KIND if is_left else DEPARTS,
        "in kind: a left hysteresis; fully: 6 Hz inside it", {"from_hz": low, "to_hz": high},
        "6 Hz lies in the left hysteresis (caption of Fig. 7)",
    )  # fmt: skip
    if fold is not None:
        yield _compare_forward_contact(study, middle)
    fold, sweep = study.folds["G-2"], study.slow_sweeps["G-2"]
    low, high = (fold.backward_hz, fold.forward_hz) if fold else (np.nan, np.nan)
    detaches = findings.detaches(study.cases["G-2"], -2.0)
    yield ComparisonRow(
        "gm2", "G-2",
        (Quote("are no longer bent and show neither jumps nor hysteresis", "Sect. 4.2"),
         Quote("the mass, during its motion is always in contact with both bumpers",
               "Sect. 4.2")),
        f"detaches, {fold.kind} hysteresis {low:.3f} to {high:.3f} Hz, largest η_d at "
        f"{sweep.peak_hz:.2f} Hz ({_format_difference(sweep.peak_hz, 7.3)})" if fold and detaches
        else f"{sweep.peak_hz:.2f} Hz ({_format_difference(sweep.peak_hz, 7.3)})",
        DEPARTS if fold or detaches else AGREES, "never detaches, both directions follow one curve",
        {"from_hz": low, "to_hz": high, "resonance_hz": sweep.peak_hz, "detaches": detaches},
        "resonance 7.3 Hz (caption of Fig. 8)",
    )  # fmt: skip


def _compare_forward_contact(study: PaperStudy, hz: float) -> ComparisonRow:
    case = study.cases["G-1"]
    precompression_mm = -1e3 * case.parameters.gap_r
    amplitude_mm = 1e3 * findings.steady_amplitude_m(case, study.slow_sweeps["G-1"], hz, "forward")
    stays = amplitude_mm <= precompression_mm
    return ComparisonRow(
        "gm1_forward", f"G-1, {hz:.3f} Hz, forward",
        (Quote("the mass, during its motion, is always in contact with both bumpers",
               "Sect. 4.1"),),
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
        "gm10", "G-10",
        (Quote("are no longer bent and show neither jumps nor hysteresis", "Sect. 4.2"),
         Quote("the mass, during its motion is always in contact with both bumpers",
               "Sect. 4.2")),
        f"{sweep.peak_hz:.2f} Hz ({_format_difference(sweep.peak_hz, 7.6)}), "
        + ("never detaches, no hysteresis" if stays else "detaches"),
        AGREES if stays and is_close else IN_KIND if stays else DEPARTS,
        "in kind: always in contact, one curve; fully: resonance within 5 %",
        {"resonance_hz": sweep.peak_hz}, "resonance 7.6 Hz (caption of Fig. 8)",
    )  # fmt: skip
    difference = max(
        _relative_difference(sweep.eta_d[direction], study.slow_sweeps["G-2"].eta_d[direction])
        for direction in ("forward", "backward")
    )
    yield ComparisonRow(
        "overlap", "G-2 and G-10",
        (Quote("the PRCs of η_d and η_a corresponding to these two values of the gap are "
               "substantially overlapped", "Sect. 3"),),
        f"η_d differs by up to {100 * difference:.0f} % of G-10's peak: G-2 still detaches",
        AGREES if difference < 0.1 else DEPARTS, "difference below a tenth of the peak everywhere",
        {"difference": difference},
    )  # fmt: skip
    gap = findings.find_permanent_contact_mm(study.cases["G-10"])
    statement = (Quote("when the negative gap exceeds a certain value which, for the considered "
                       "system (mass, damper and bumpers), is between G-1 and G-2",
                       "Sect. 4.2"),)  # fmt: skip
    if np.isnan(gap):
        yield ComparisonRow(
            "permanent_contact", "Onset of permanent contact", statement,
            f"not between 0 and {findings.MIN_GAP_MM:g} mm".replace("-", "−"), DEPARTS,
            "between −1 and −2 mm",
        )  # fmt: skip
        return
    detachments = [findings.detaches(study.cases["G-10"], gap + step) for step in (0.015, -0.015)]
    yield ComparisonRow(
        "permanent_contact", "Onset of permanent contact", statement,
        f"G = {gap:.3f} mm".replace("-", "−")
        + ("; a sweep 15 µm to either side confirms it" if detachments == [True, False] else ""),
        AGREES if -2 <= gap <= -1 else DEPARTS, "between −1 and −2 mm",
        {"gap_mm": gap, "confirmed": detachments == [True, False]},
    )  # fmt: skip
