"""The next test that would decide between what recordings leave open: variants that a rig can play.

They vary what an operator can: frequencies, level, direction, dwell, waveform, and by hand the gap.
A test beyond the limits of the rig is left out by the same check as before a run.
"""

import math
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from table_io.block import Block, Label
from table_io.config.base import format_toml, parse_toml
from table_io.config.excitation import MIN_BLEND_CYCLES
from table_io.config.folders import find_config
from table_io.config.profile import Profile
from table_io.config.rig_file import load_rig
from table_io.errors import InputError
from table_io.records import RunStart, Step
from table_io.safety.preflight import CORRECTION_HEADROOM, check_limits
from table_io.units import GRAVITY_M_S2
from twin.discovery.discover import Discovery
from twin.discovery.experiment_design import (
    IdealTableMotion,
    TestPrediction,
    list_rivals,
    rank_tests,
)
from twin.discovery.law_search import LawProposal
from twin.discovery.result import (
    DecisiveTest,
    ExpectedPeak,
    OtherTest,
    RivalPrediction,
    Verdict,
)
from twin.discovery.selection import FittedSet, ProgressCallback, SelectionProgress
from twin.results.recordings import open_recording
from twin.setup.run_config import RunConfig, from_texts

Table = dict[str, Any]
BUDGET_MIN = 10.0  # of rig time, by default
PROFILE_FILE = "decide.toml"  # of the proposed test, next to the verdict
MAX_OTHER_TESTS = 4  # listed after the proposed one
TEST_S = 75.0  # intended duration: a recording that discovery judges in seconds
LEVEL_RATIOS = (1.0, 0.5, 2.0, 4.0)  # to the level of the recorded test
BAND_RATIO = 2.0  # by which the band is extended to either side
GRID_INTERVALS = 5  # between the frequencies of a sweep
MIN_CYCLES, MAX_CYCLES = 4, 60  # held at each frequency
DWELL_SCHEDULE_DB = (-12.0, -6.0, 0.0)  # levels of a dwell, which grows
GAP_RATIOS = (math.inf, 0.5, 2.0)  # to the gap of the recorded test; inf: without bumpers
SIGNIFICANT_DIGITS = 3  # significant, of frequencies and levels
MIN_PROBABILITY = 0.05  # of a decision, below which a test is not worth its time
# Tables of a recorded test that are about that run alone.
OWN_TABLES = ("sweep", "excitation", "dwell", "track", "refine", "resume", "set_up", "tracking")


@dataclass(frozen=True)
class DecideOptions:
    """Options of `--decide`: file of the proposed profile, rig, rig time, who is asked, speed.

    Without `profile` it is written next to the verdict.
    """

    profile: Path | None = None
    rig: str = ""
    budget_min: float = BUDGET_MIN
    asks: bool = True
    unpaced: bool = False

    def check(self) -> None:
        """Raise InputError if the profile exists or the budget is no time."""
        if self.profile is not None and self.profile.exists():
            raise InputError(
                "exists; nothing is overwritten",
                key="--decide",
                value=str(self.profile),
                remedy="give a new file",
            )
        if not self.budget_min > 0:
            raise InputError(
                "no rig time", key="--budget-min", value=self.budget_min, allowed="above 0 min"
            )


@dataclass(frozen=True, eq=False)
class CandidateTest:
    """Test that the rig can play, and the change of the set-up that it asks of the operator."""

    config: RunConfig
    set_up: str = ""

    @property
    def title(self) -> str:
        """Title of its profile: what is played."""
        return self.config.profile.title

    @property
    def minutes(self) -> float:
        """Expected duration in min."""
        return self.config.expected_s / 60.0

    @cached_property
    def motion(self) -> IdealTableMotion:
        """Motion of an ideal table."""
        config, drive = self.config, self.config.ideal_drive
        rest = round(config.profile.acquisition.rest_s * drive.rate_hz)
        count = drive.planned_end + rest
        values = np.array([drive.command(0, count), drive.acceleration(0, count)])
        channels = ("table_disp_m", "table_acc_m_s2")
        block = Block("meas", 0, drive.rate_hz, channels, values, *drive.labels(0, count))
        specimen = config.profile.specimen
        # the specimen may differ from every rival
        allowed_peaks = {
            sensor.channel: sensor.range_si / CORRECTION_HEADROOM for sensor in config.rig.sensors
        }
        return IdealTableMotion(
            self.title, block, specimen.mass_kg, specimen.gaps_m, self.minutes, allowed_peaks
        )


@dataclass(frozen=True, eq=False)
class TestProposal:
    """Candidate test with its expected outcome, its rank, and how many were compared."""

    __test__ = False  # no test of pytest

    test: CandidateTest
    prediction: TestPrediction
    rank: int
    count: int

    @property
    def purpose(self) -> str:
        """What the test is for, as a clause."""
        names = [rival.name for rival in self.prediction.rivals]
        if self.prediction.is_confirmation:
            return f"confirms {names[0]}: shows further effects that the recordings may hide"
        return f"decides between {' and '.join(names)}"

    def format_profile(self, rig: str, extra: Mapping[str, Table] | None = None) -> str:
        """Return the text of its profile, which states what it is for and what is expected.

        Without `rig` it is that of the recorded test.
        """
        content = tomllib.loads(self.test.config.profile_toml)
        expected = (
            f"Proposed by `shaketwin discover --decide`, which compared {self.count} tests. "
            f"Expected in {self.test.minutes:.2g} min: {self.prediction.sigma:.2g} standard "
            f"errors, a decision with probability {self.prediction.probability:.2f}."
        )
        title = f"{self.test.title}: {self.purpose}"
        head = {
            "title": title,
            "notes": expected,
            "rig": rig or self.test.config.profile.rig,
        }
        return format_toml(
            head | {k: v for k, v in content.items() if k not in head} | dict(extra or {})
        )


def propose_decisive_test(
    verdict: Verdict,
    discovery: Discovery,
    law: LawProposal | None,
    recorded: RunStart,
    rig_toml: str,
    options: DecideOptions,
    report: ProgressCallback,
) -> tuple[Verdict, tuple[TestProposal, ...]]:
    """Return (verdict with the test that would decide best, all proposals, the best first)."""

    def show(title: str) -> None:
        stage = f"simulating candidate tests: {title}"
        report(SelectionProgress(stage, best=discovery.verdict.best))

    tests = list_candidate_tests(recorded, rig_toml, options.budget_min, options.asks)
    proposals = propose_tests(discovery, tests, show, law.fitted if law else None)
    if not proposals:
        next_run = (
            f"of {len(tests)} tests that the rig can play, none separates with every sensor within "
            "its range"
        )
        return verdict.model_copy(update={"decide": None, "next_run": next_run}), ()
    name = options.profile.name if options.profile else PROFILE_FILE
    decisive = _build_decisive_test(proposals, name)
    next_run = _describe_next_run(decisive)
    return (
        verdict.model_copy(update={"decide": decisive, "next_run": next_run}),
        tuple(proposals),
    )


def _build_decisive_test(proposals: Sequence[TestProposal], profile: str) -> DecisiveTest:
    """Return the block `decide` of verdict.json; `profile` is the file of the best test."""
    proposal, *others = proposals
    prediction, test = proposal.prediction, proposal.test
    return DecisiveTest(
        title=test.title,
        purpose=proposal.purpose,
        profile=profile,
        set_up=test.set_up,
        confirmation=prediction.is_confirmation,
        minutes=test.minutes,
        sigma=prediction.sigma,
        probability=prediction.probability,
        separation_per_min=prediction.separation_per_minute,
        count=proposal.count,
        rivals=[
            _build_rival(prediction, index, test.config.steps)
            for index in range(len(prediction.rivals))
        ],
        others=[
            OtherTest(
                title=other.test.title,
                minutes=other.test.minutes,
                sigma=other.prediction.sigma,
                probability=other.prediction.probability,
            )
            for other in others[:MAX_OTHER_TESTS]
        ],
    )


def _describe_next_run(decide: DecisiveTest) -> str:
    """Return the sentence on the proposed test that stands for the general suggestion."""
    set_up = f", {decide.set_up}" if decide.set_up else ""
    return (
        f"{decide.title}{set_up} ({decide.profile}, {decide.minutes:.2g} min): "
        f"{decide.purpose}; {decide.sigma:.2g} standard errors are expected, with a "
        f"probability of {100 * decide.probability:.0f} %"
        f"{' for each' if decide.confirmation else ' for a decision'}"
    )


def _build_rival(prediction: TestPrediction, index: int, steps: Sequence[Step]) -> RivalPrediction:
    """Return a rival with its expected separation and peaks."""
    as_true = [pair.sigma for pair in prediction.pairs if pair.truth == index]
    as_other = [pair.misfit for pair in prediction.pairs if pair.other == index]
    simulated = prediction.simulated.get(index)
    return RivalPrediction(
        id=prediction.rivals[index].name,
        misfit=max(as_other, default=None),
        sigma=min(as_true, default=None),
        peaks=_list_peaks(simulated, steps) if simulated is not None else [],
    )


def _list_peaks(block: Block, steps: Sequence[Step]) -> list[ExpectedPeak]:
    """Return the largest displacement of the mass against the table in each step or window."""
    if "rel_disp_m" in block.channels:
        disp = block.channel("rel_disp_m")
    else:
        disp = block.channel("mass_disp_m") - block.channel("table_disp_m")
    measured = block.label == Label.MEASURE
    by_index = {step.index: step for step in steps}
    return [
        ExpectedPeak(
            frequency_hz=by_index[number].frequency_hz if number in by_index else None,
            direction=by_index[number].direction if number in by_index else f"window {number}",
            peak_disp_m=float(np.abs(disp[measured & (block.step == number)]).max()),
        )
        for number in np.unique(block.step[measured]).tolist()
        if number >= 0
    ]


def read_recorded_test(paths: Sequence[Path], options: DecideOptions) -> tuple[RunStart, str]:
    """Return the last recorded test and the text of the rig; InputError if either is unknown."""
    recorded = open_recording(paths[-1]).start
    rig_toml = load_named_rig(options.rig) if options.rig else recorded.rig_toml
    if not recorded.profile_toml or not rig_toml:
        raise InputError(
            "no test can be proposed: its profile and rig are not in the recording",
            where=paths[-1],
            remedy="import it with --profile, or omit --decide",
        )
    return recorded, rig_toml


def load_named_rig(rig: str) -> str:
    """Return the text of a rig file by its name or path."""
    return load_rig(find_config(rig, "rigs", option="--table"))[1]


def propose_tests(
    discovery: Discovery,
    tests: Sequence[CandidateTest],
    report: Callable[[str], None] = lambda title: None,
    law: FittedSet | None = None,
) -> list[TestProposal]:
    """Return the tests that separate what a discovery leaves open, the best first.

    `law` is the set with a law that was proposed for what the library does not explain.
    """
    problem = discovery.prepared.problem
    rivals = list_rivals(discovery.selection, discovery.verdict, law)
    by_title = {test.title: test for test in tests}
    motions = [test.motion for test in by_title.values()]
    return [
        TestProposal(by_title[prediction.motion.name], prediction, rank, len(motions))
        for rank, prediction in enumerate(rank_tests(problem, rivals, motions, report), 1)
        if max(prediction.probability, prediction.best_probability) >= MIN_PROBABILITY
    ]


def list_candidate_tests(
    recorded: RunStart, rig_toml: str, max_min: float, can_change_gap: bool = False
) -> list[CandidateTest]:
    """Return the variants of a recorded test that a rig can play in `max_min` minutes each."""
    profile, kept = _read_profile(recorded)
    excitations, tests = [*list_excitations(profile)], []
    for title, excitation in excitations:
        tests += _build_tests(kept | {"title": title, "excitation": excitation}, recorded, rig_toml)
    if can_change_gap and math.isfinite(profile.specimen.gap_mm) and profile.specimen.gap_mm > 0:
        title, excitation = excitations[0]
        for ratio in GAP_RATIOS:
            gap_mm = _round(ratio * profile.specimen.gap_mm)
            specimen = {"mass_kg": profile.specimen.mass_kg, "gap_mm": gap_mm}
            gap = "no bumpers" if math.isinf(gap_mm) else f"total gap {gap_mm:g} mm"
            own = {"title": f"{title}, {gap}", "excitation": excitation, "specimen": specimen}
            tests += _build_tests(kept | own, recorded, rig_toml, f"set: {gap}")
    return [test for test in tests if test.minutes <= max_min]


def _read_profile(recorded: RunStart) -> tuple[Profile, Table]:
    """Return the profile of a recorded test, and of its tables those that any test keeps."""
    profile = parse_toml(recorded.profile_toml, Profile, f"recording {recorded.run}")
    tables = tomllib.loads(recorded.profile_toml)
    return profile, {key: value for key, value in tables.items() if key not in OWN_TABLES}


def _build_tests(
    content: Mapping[str, Any], recorded: RunStart, rig_toml: str, set_up: str = ""
) -> list[CandidateTest]:
    """Return the test of a profile as a list; empty if it is invalid or the rig cannot play it."""
    if content["excitation"]["kind"] != "stepped_sine":
        content = {key: value for key, value in content.items() if key != "control"}
    name = "decide"
    try:
        config = from_texts(name, format_toml(dict(content)), rig_toml, recorded.model_toml, name)
        check_limits(config.margins, config.profile, config.rig, name)
    except InputError:
        return []
    return [CandidateTest(config, set_up)]


def list_excitations(profile: Profile) -> Iterator[tuple[str, Table]]:
    """Yield (title, table [excitation]) of the variants of a test; the first is much as it was."""
    low_hz, high_hz, level_g = _measure_test(profile)
    bands = {
        "the same band": (low_hz, high_hz),
        "a wider band": (low_hz / BAND_RATIO, high_hz * BAND_RATIO),
        "higher frequencies": (high_hz, high_hz * BAND_RATIO),
        "lower frequencies": (low_hz / BAND_RATIO, low_hz),
    }
    if low_hz < high_hz:
        bands["the upper half of the band"] = (math.sqrt(low_hz * high_hz), high_hz)
    for text, band in bands.items():
        for ratio in LEVEL_RATIOS:
            level = _round(ratio * level_g)
            yield f"sweep, {text}, {level:g} g", _make_sweep(band, level)
        if text in ("the same band", "a wider band"):
            backward = _make_sweep(band, _round(level_g), directions=("backward",))
            yield f"sweep down alone, {text}, {_round(level_g):g} g", backward
    for frequency in dict.fromkeys((low_hz, math.sqrt(low_hz * high_hz), high_hz)):
        hz, level = _round(frequency), _round(2 * level_g)
        sweep = _make_sweep((hz, hz), level, schedule=DWELL_SCHEDULE_DB, directions=("forward",))
        yield f"dwell at {hz:g} Hz, growing to {level:g} g", sweep
    for text, ratio in product(("the same band", "a wider band"), LEVEL_RATIOS[:3]):
        start_hz, stop_hz = (_round(hz) for hz in bands[text])
        level = _round(ratio * level_g)
        if start_hz == stop_hz:
            continue
        yield (
            f"chirp, {start_hz:g} to {stop_hz:g} Hz, {level:g} g",
            {
                "kind": "chirp", "start_hz": start_hz, "stop_hz": stop_hz, "duration_s": TEST_S,
                "acceleration_g": level,
            },
        )  # fmt: skip


def _measure_test(profile: Profile) -> tuple[float, float, float]:
    """Return the band of a test in Hz and its peak level in g."""
    plan = profile.plan
    return plan.low_hz, plan.high_hz, plan.level_m_s2 / GRAVITY_M_S2


def _make_sweep(
    band_hz: tuple[float, float],
    level_g: float,
    directions: Sequence[str] = ("forward", "backward"),
    schedule: Sequence[float] = (),
    duration_s: float = TEST_S,
) -> Table:
    """Return a table [excitation] of a stepped sine with the cycles that fill a duration."""
    start_hz = _round(band_hz[0])
    step_hz = _round((band_hz[1] - band_hz[0]) / GRID_INTERVALS)
    intervals = GRID_INTERVALS if step_hz > 0 else 0
    grid_hz = start_hz + step_hz * np.arange(intervals + 1)
    sweeps = len(directions) * max(len(schedule), 1)
    # each step begins with a blend
    cycles = duration_s / sweeps / float((1.0 / grid_hz).sum()) - MIN_BLEND_CYCLES
    held = int(min(max(cycles, MIN_CYCLES), MAX_CYCLES))
    return {
        "kind": "stepped_sine", "start_hz": start_hz, "stop_hz": float(f"{grid_hz[-1]:.9g}"),
        "step_hz": step_hz or start_hz, "cycles": held, "measured_cycles": min(3, held),
        "acceleration_g": level_g, "directions": [*directions], "schedule_db": [*schedule],
    }  # fmt: skip


def _round(value: float) -> float:
    return float(f"{value:.{SIGNIFICANT_DIGITS}g}")
