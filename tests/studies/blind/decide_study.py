"""Study of decisive runs: what a proposed test decides on the same hidden plant, and a random one.

The first recording of a case is that of the study of discovery, or of a poorer test, one frequency
at one level, with bumpers or in free flight. Where its verdict leaves something open, or names less
than what is hidden, the proposed test and a random one as long are played with other noise, and all
recordings judged again.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from table_io.clock import cpu_seconds
from table_io.errors import InputError
from table_io.records import RunStart
from tests.studies.blind.cases import draw_case
from tests.studies.blind.harness import RESULTS_FILE, Study, StudyOptions, read_rows, run_study
from tests.studies.blind.metrics import Rate, select_latest
from tests.studies.blind.plant import CasePaths, SealedPlant, find_shares, make_truth
from tests.studies.blind.rig import MODEL_TOML, PROFILE_TOML
from twin.discovery.decisive_test import (
    BAND_RATIO,
    LEVEL_RATIOS,
    CandidateTest,
    _build_tests,
    _make_sweep,
    _measure_test,
    _read_profile,
    list_candidate_tests,
    propose_tests,
)
from twin.discovery.discover import Discovery, discover_effects
from twin.discovery.experiment_design import rank_tests
from twin.discovery.law_search import LawProposal, propose_law
from twin.discovery.loading import load_logs
from twin.results.recordings import open_recording
from twin.setup.run_config import read_model_template
from twin.system.terminal import print_line

Json = dict[str, Any]
DEFAULT_CELLS = ("pair/*/1%", "pair/*/5%")
TABLE_FILE = "decisive_runs.md"
MAX_TEST_MIN = 10.0
MAX_DRAWS = 1000  # of a random test
STUDY_SWEEP = PROFILE_TOML[PROFILE_TOML.index("start_hz") : PROFILE_TOML.index("[acquisition]")]
POOR_SWEEP = """\
start_hz = 2.0
stop_hz = 2.0
step_hz = 0.4
cycles = 15
acceleration_g = 0.05
directions = ["forward"]

"""
POOR_PROFILE_TOML = PROFILE_TOML.replace(STUDY_SWEEP, POOR_SWEEP)
FIRST_TESTS = {
    "sweep": PROFILE_TOML,
    "one-frequency": POOR_PROFILE_TOML,
    "flight": POOR_PROFILE_TOML.replace("gap_mm = 4.0", "gap_mm = inf"),
}
PROBABILITY_BINS = (0.0, 0.5, 0.9, 1.0)


def run_decide_study(options: StudyOptions, first: str = "sweep") -> int:
    """Evaluate decisive runs on the cases that have no result; return the exit code.

    `first` is the first test of a case, of `FIRST_TESTS`.
    """
    folder, numbers, workers = options.prepare("study-decide", DEFAULT_CELLS)
    task = partial(evaluate_decision, folder, first)
    return run_study(Study(task, format_decision, write_page), folder, numbers, workers)


def evaluate_decision(root: Path, first: str, number: int) -> Json:
    """Return the row of a case: the first verdict, and after the proposed and a random test."""
    start_s = cpu_seconds()
    plant = _DecidedPlant(root, number, has_bumpers=first != "flight")
    plant.play(FIRST_TESTS[first], "first")
    discovery, law = plant.discover("first")
    row: Json = {
        "number": number, "cell": plant.case.cell.name, "truth": plant.truth,
        "first": plant.score_discovery(discovery, law),
    }  # fmt: skip
    if not (row["first"]["right"] and row["first"]["decided"]):
        row |= plant.evaluate_tests(discovery, law)
    return row | {"seconds": cpu_seconds() - start_s}


class _DecidedPlant:
    """The sealed plant of a case, and its recordings, which are judged together."""

    def __init__(self, root: Path, number: int, has_bumpers: bool) -> None:
        self.case = draw_case(number)
        self.truth = [planted.effect.name for planted in self.case.planted]
        self._paths = CasePaths(root, self.case.label)
        self._paths.clear()
        shares, _ = find_shares(self.case)
        truth = make_truth(self.case, self.case.planted, shares)
        if not has_bumpers:  # the gaps are then those of the profile
            truth["base"] = {k: v for k, v in truth["base"].items() if not k.startswith("gap_")}
        self._plant = SealedPlant.seal(self.case, truth, self._paths.truth)
        (self._paths.case_dir / "model.toml").write_text(MODEL_TOML, encoding="utf-8")

    def _log(self, name: str) -> Path:
        return self._paths.case_dir / f"{name}.mcap"

    def play(self, profile_toml: str, name: str) -> str:
        """Record a test; return how it ended."""
        return self._plant.record(self._log(name), True, profile_toml).verdict

    def discover(self, *names: str) -> tuple[Discovery, LawProposal | None]:
        """Return the discovery from recordings together, and a law for what it leaves open."""
        logs, _ = load_logs([self._log(name) for name in names])
        model = read_model_template(str(self._paths.case_dir / "model.toml"))[0]
        discovery = discover_effects(logs, model)
        return discovery, propose_law(discovery)

    def evaluate_tests(self, discovery: Discovery, law: LawProposal | None) -> Json:
        """Return the verdicts after the proposed and a random test; {"proposal": None} without."""
        recorded = open_recording(self._log("first")).start
        candidates = list_candidate_tests(recorded, recorded.rig_toml, MAX_TEST_MIN)
        proposals = propose_tests(discovery, candidates, law=law.fitted if law else None)
        if not proposals:
            return {"proposal": None}
        proposal = proposals[0]
        generator = np.random.default_rng(np.random.SeedSequence([self.case.number]))
        random = draw_random_test(recorded, recorded.rig_toml, proposal.test.minutes, generator)
        rivals, problem = proposal.prediction.rivals, discovery.prepared.problem
        by_chance = rank_tests(problem, rivals, [random.motion])
        return {
            "proposal": {
                "title": proposal.test.title,
                "minutes": proposal.test.minutes,
                "rivals": [rival.name for rival in rivals],
                "sigma": proposal.prediction.sigma,
                "probability": proposal.prediction.probability,
            },
            "random_probability": by_chance[0].probability if by_chance else 0.0,
            "proposed": self._evaluate_test(proposal.test, "proposed"),
            "random": self._evaluate_test(random, "random"),
        }

    def _evaluate_test(self, test: CandidateTest, name: str) -> Json:
        """Return the verdict after a further test, or why there is none."""
        facts: Json = {"title": test.title, "excitation": str(test.config.profile.excitation)}
        ended = self.play(test.config.profile_toml, name)
        if ended != "complete":
            return facts | {"ended": ended, "outcome": ended, "right": False, "decided": False}
        try:
            return facts | self.score_discovery(*self.discover("first", name))
        except InputError as error:
            return facts | {"outcome": str(error), "right": False, "decided": False}

    def score_discovery(self, discovery: Discovery, law: LawProposal | None) -> Json:
        """Return the verdict; right: it names all that is hidden and nothing else.

        What is not in the library is decided by a law that suffices.
        """
        verdict = discovery.verdict
        named = [*verdict.best.names]
        has_law = law is not None and law.is_sufficient
        is_right = verdict.outcome in ("none", "named") and {*named} == {*self.truth}
        if self.case.cell.kind == "unknown":
            is_right = verdict.outcome == "unexplained" and has_law
        return {
            "outcome": verdict.outcome, "named": named, "remainder": verdict.has_remainder,
            "alternatives": [[*fitted.names] for fitted in verdict.alternatives],
            "blind_to": [effect.candidate.name for effect in verdict.blind_to],
            "law": [*law.fitted.names] if law else [],
            "confidence": verdict.confidence, "decided": verdict.is_decided or has_law,
            "right": is_right,
        }  # fmt: skip


def draw_random_test(
    recorded: RunStart, rig_toml: str, minutes: float, generator: np.random.Generator
) -> CandidateTest:
    """Draw a stepped sine within the limits of the rig, of about this duration in min.

    Ends of its band and its level are log-uniform over the range of the candidate tests.
    """
    profile, kept = _read_profile(recorded)
    low_hz, high_hz, level_g = _measure_test(profile)
    limits_hz = np.log([low_hz / BAND_RATIO, high_hz * BAND_RATIO])
    limits_g = np.log([level_g * min(LEVEL_RATIOS), level_g * max(LEVEL_RATIOS)])
    for _ in range(MAX_DRAWS):
        ends_hz = np.sort(np.exp(generator.uniform(limits_hz[0], limits_hz[1], size=2)))
        level = float(np.exp(generator.uniform(limits_g[0], limits_g[1])))
        sweep = _make_sweep((float(ends_hz[0]), float(ends_hz[1])), level, duration_s=60 * minutes)
        content = kept | {"title": "random test", "excitation": sweep}
        if tests := _build_tests(content, recorded, rig_toml):
            return tests[0]
    raise InputError("the rig can play no random test", where=f"recording {recorded.run}")


def format_decision(row: Json) -> str:
    """Return one line about a case."""
    head = f"{'+'.join(row['truth'])}: {_format_verdict(row['first'])}"
    if "proposal" not in row:
        return f"{head}: right at once"
    if row["proposal"] is None:
        return f"{head}; nothing separates"
    return (
        f"{head}; {row['proposal']['title']} ({row['proposal']['probability']:.2f}): "
        f"{_format_verdict(row['proposed'])}; random: {_format_verdict(row['random'])}"
        f"; {row['seconds']:.0f} s"
    )


def _format_verdict(score: Json) -> str:
    mark = ("" if score["decided"] else "open, ") + ("right" if score["right"] else "MISSED")
    return f"{score['outcome']} {'+'.join(score.get('named', ()))} ({mark})"


def write_page(folder: Path) -> Path:
    """Write and print the rates of a study; return the page."""
    text = format_rates(select_latest(read_rows(folder / RESULTS_FILE)))
    (folder / TABLE_FILE).write_text(text, encoding="utf-8")
    print_line(text)
    return folder / TABLE_FILE


def format_rates(rows: Iterable[Json]) -> str:
    """Return the rates of decisive and random tests with Wilson intervals, and the calibration."""
    usable = [row for row in rows if "first" in row]
    asked = [row for row in usable if not row["first"]["right"]]
    undecided = [row for row in usable if not row["first"]["decided"]]
    confident = [row for row in usable if row["first"]["decided"]]
    proposed = [row for row in undecided if row.get("proposal")]
    stated = [
        *((row["proposal"]["probability"], _is_decided_right(row["proposed"])) for row in proposed),
        *((row["random_probability"], _is_decided_right(row["random"])) for row in proposed),
    ]
    confidences = [
        (score["confidence"], score["right"])
        for row in usable
        for score in (row["first"], row.get("proposed", {}), row.get("random", {}))
        if score.get("outcome") in ("none", "named")
    ]
    lines = [
        "| | rate | 95 % interval |",
        "|---|---|---|",
        _format_rate("decided by the first recording, of these right", confident, _is_right_first),
        _format_rate("all named by the first recording", usable, _is_right_first),
        *_format_tests(usable, asked, undecided, "proposed"),
        *_format_tests(usable, asked, undecided, "random"),
        "",
        "| stated probability, proposed and random | mean | decided and right |",
        "|---|---|---|",
        *_format_bins(stated),
        "",
        "| stated confidence, all verdicts | mean | right |",
        "|---|---|---|",
        *_format_bins(confidences),
    ]
    return "\n".join(lines) + "\n"


def _format_tests(
    usable: Sequence[Json], asked: Sequence[Json], undecided: Sequence[Json], test: str
) -> Iterator[str]:
    """Yield the rates after the tests of one kind, by what the first recording left open."""

    def score(row: Json) -> Json:
        return row.get(test) or {"right": False, "decided": False}

    yield _format_rate(
        f"all named after at most one {test} test", usable,
        lambda row: _is_right_first(row) or score(row)["right"],
    )  # fmt: skip
    yield _format_rate(
        f"named wrongly or in part before, right after {test}", asked,
        lambda row: score(row)["right"],
    )  # fmt: skip
    yield _format_rate(
        f"undecided before, decided after {test}", undecided, lambda row: score(row)["decided"]
    )
    yield _format_rate(
        f"undecided before, decided and right after {test}", undecided,
        lambda row: _is_decided_right(score(row)),
    )  # fmt: skip


def _format_rate(name: str, rows: Sequence[Json], is_hit: Callable[[Json], bool]) -> str:
    return f"| {name} | {Rate.of(rows, is_hit)} |"


def _is_right_first(row: Json) -> bool:
    return bool(row["first"]["right"])


def _is_decided_right(score: Json) -> bool:
    """Return True if a verdict leaves nothing open and is right."""
    return bool(score["decided"] and score["right"])


def _format_bins(stated: Sequence[tuple[float, bool]]) -> Iterator[str]:
    """Yield the rate of hits by stated probability, one row of a table a bin."""
    for low, high in pairwise(PROBABILITY_BINS):
        pairs = [(p, hit) for p, hit in stated if low <= p < high + (high == 1.0)]
        mean = f"{np.mean([p for p, _ in pairs]):.2f}" if pairs else "-"
        rate = Rate(sum(hit for _, hit in pairs), len(pairs))
        yield f"| {low:g} to {high:g} | {mean} | {rate} |"
