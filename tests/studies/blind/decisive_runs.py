"""Study of decisive runs: what a proposed test decides on the same hidden plant, and a random one.

The first recording of a case is that of `study discovery`, or of a poorer test, one frequency at
one level, with bumpers or in free flight. Where its verdict leaves something open, or names less
than what is hidden, the proposed test and a random one as long are played with other noise, and all
recordings judged again.
"""

import json
import shutil
from collections.abc import Iterable, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from table_io.clock import cpu_seconds
from table_io.config.toml_text import format_toml
from table_io.errors import InputError
from tests.studies.blind.generation import find_shares, hash_truth, make_truth, record_test
from tests.studies.blind.rates import Rate
from tests.studies.blind.rig_setup import MODEL_TOML, PROFILE_TOML, make_rig_toml
from tests.studies.blind.strata import Case, draw_case, list_case_numbers
from twin.discovery.decisive_test import (
    CandidateTest,
    draw_random_test,
    list_candidate_tests,
    propose_tests,
)
from twin.discovery.discover import Discovery, discover_effects
from twin.discovery.experiment_design import rank_tests
from twin.discovery.law_search import LawProposal, propose_law
from twin.discovery.loading import load_logs
from twin.report.finalize import EXIT_INTERRUPTED
from twin.results.recordings import open_recording
from twin.setup.folders import claim_folder, make_output_folder
from twin.setup.run_config import read_model_template
from twin.system.process_pool import Workers, run_tasks
from twin.system.terminal import catch_interrupts, print_line

Json = dict[str, Any]
DEFAULT_CELLS = ("pair/*/1%", "pair/*/5%")
FIRST_TESTS = ("sweep", "one-frequency", "flight")
RESULTS_FILE = "decisive_runs.jsonl"
MAX_TEST_MIN = 10.0
MAX_CASE_S = 900.0  # wall clock: what nothing explains takes long to judge, and counts as failed
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
PROFILES = {
    "sweep": PROFILE_TOML,
    "one-frequency": POOR_PROFILE_TOML,
    "flight": POOR_PROFILE_TOML.replace("gap_mm = 4.0", "gap_mm = inf"),
}
PROBABILITY_BINS = (0.0, 0.5, 0.9, 1.0)


def run_decide_study(
    out: Path | None,
    seeds: int,
    cells: Sequence[str],
    workers: int | None,
    resume: bool,
    first: str,
) -> int:
    """Evaluate decisive runs on the cases that have no result; return the exit code.

    `first` is the first test of a case, of `FIRST_TESTS`.
    """
    if first not in FIRST_TESTS:
        raise InputError(
            "unknown first test", key="--first", value=first, allowed=", ".join(FIRST_TESTS)
        )
    numbers = list_case_numbers(seeds, cells or DEFAULT_CELLS)
    if out is not None and resume:
        claim_folder(out)
    folder = out if out is not None and resume else make_output_folder(out, "study-decide")
    path = folder / RESULTS_FILE
    rows = read_json_lines(path)
    finished = {row["number"] for row in rows}
    pending = [number for number in numbers if number not in finished]
    task = partial(evaluate_decision, folder, first)
    with (
        catch_interrupts("stopping after the cases in progress") as stop,
        path.open("a", encoding="utf-8") as file,
    ):
        processes = Workers.from_options(workers)
        for result in run_tasks(task, pending, processes, stop, max_task_s=MAX_CASE_S):
            row = result.value or {"number": result.number, "failed": result.failure}
            rows.append(row)
            file.write(json.dumps(row) + "\n")
            file.flush()
            print_line(f"{len(rows):>4}/{len(numbers)} {format_decision(row)}")
    text = format_rates(rows)
    (folder / "decisive_runs.md").write_text(text, encoding="utf-8")
    print_line(text)
    return 0 if len(rows) >= len(numbers) else EXIT_INTERRUPTED


def read_json_lines(path: Path) -> list[Json]:
    """Return the rows of a file of JSON lines; none without the file."""
    if not path.is_file():
        return []
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def evaluate_decision(root: Path, first: str, number: int) -> Json:
    """Return the row of a case: the first verdict, and after the proposed and a random test."""
    case, start_s = draw_case(number), cpu_seconds()
    plant = _SealedPlant(case, root / "cases" / case.label, has_bumpers=first != "flight")
    plant.play(PROFILES[first], "first")
    discovery, law = plant.discover("first")
    row: Json = {
        "number": number, "cell": case.cell.name, "truth": plant.truth,
        "first": plant.score_discovery(discovery, law),
    }  # fmt: skip
    if row["first"]["right"] and row["first"]["decided"]:
        return row | {"seconds": cpu_seconds() - start_s}
    recorded = open_recording(plant.log("first")).start
    rig = recorded.rig_toml
    candidates = list_candidate_tests(recorded, rig, MAX_TEST_MIN)
    proposals = propose_tests(discovery, candidates, law=law.fitted if law else None)
    if not proposals:
        return row | {"proposal": None, "seconds": cpu_seconds() - start_s}
    proposal = proposals[0]
    generator = np.random.default_rng(np.random.SeedSequence([number]))
    random = draw_random_test(recorded, rig, proposal.test.minutes, generator)
    row["proposal"] = {
        "title": proposal.test.title,
        "minutes": proposal.test.minutes,
        "rivals": [rival.name for rival in proposal.prediction.rivals],
        "sigma": proposal.prediction.sigma,
        "probability": proposal.prediction.probability,
    }
    rivals, problem = proposal.prediction.rivals, discovery.prepared.problem
    by_chance = rank_tests(problem, rivals, [random.motion])
    row["random_probability"] = by_chance[0].probability if by_chance else 0.0
    for label, test in (("proposed", proposal.test), ("random", random)):
        row[label] = plant.evaluate_test(test, label)
    return row | {"seconds": cpu_seconds() - start_s}


class _SealedPlant:
    """Plant of a case with its sealed truth, on which several tests can be played."""

    def __init__(self, case: Case, folder: Path, has_bumpers: bool) -> None:
        self.case, self.folder, self.tests = case, folder, 0
        self.truth = [planted.effect.name for planted in case.planted]
        shutil.rmtree(folder, ignore_errors=True)  # of a study that was interrupted in this case
        folder.mkdir(parents=True)
        shares, _ = find_shares(case)
        truth = make_truth(case, case.planted, shares)
        if not has_bumpers:  # the gaps are then those of the profile
            truth["base"] = {k: v for k, v in truth["base"].items() if not k.startswith("gap_")}
        text = f"# {case.salt}\n" + format_toml(truth)
        (folder / "truth.toml").write_text(text, encoding="utf-8")
        (folder / "model.toml").write_text(MODEL_TOML, encoding="utf-8")
        self.sha256 = hash_truth(text)

    def log(self, name: str) -> Path:
        """Path of a recording."""
        return self.folder / f"{name}.mcap"

    def play(self, profile_toml: str, name: str) -> str:
        """Record a test, each with noise of its own; return how it ended."""
        seed = self.case.noise_seed + self.tests
        self.tests += 1
        truth = str((self.folder / "truth.toml").resolve())
        rig = make_rig_toml(self.case.cell.noise, seed, truth, self.sha256)
        return record_test(rig, self.case.label, self.log(name), True, profile_toml).verdict

    def discover(self, *names: str) -> tuple[Discovery, LawProposal | None]:
        """Return the discovery from recordings together, and a law for what it leaves open."""
        logs, _ = load_logs([self.log(name) for name in names])
        model = read_model_template(str(self.folder / "model.toml"))[0]
        return propose_law(discover_effects(logs, model))

    def evaluate_test(self, test: CandidateTest, name: str) -> Json:
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


def format_decision(row: Json) -> str:
    """Return one line about a case."""
    if row.get("failed"):
        return f"{row['number']}: FAILED: {row['failed']}"
    first = row["first"]
    head = f"{row['number']} {row['cell']} {'+'.join(row['truth'])}: {_format_verdict(first)}"
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


def format_rates(rows: Iterable[Json]) -> str:
    """Return the rates of decisive and random tests with Wilson intervals, and the calibration."""
    usable = [row for row in rows if "first" in row]
    asked = [row for row in usable if not row["first"]["right"]]
    undecided = [row for row in usable if not row["first"]["decided"]]
    confident = [row for row in usable if row["first"]["decided"]]
    lines = ["| | rate | 95 % interval |", "|---|---|---|"]

    def add_rate(name: str, hits: Iterable[bool]) -> None:
        flags = [*hits]
        lines.append(f"| {name} | {Rate(sum(flags), len(flags))} |")

    def is_right(row: Json, test: str) -> bool:
        return bool(row.get(test, {}).get("right"))

    add_rate("decided by the first recording, of these right", (
        row["first"]["right"] for row in confident
    ))  # fmt: skip
    add_rate("all named by the first recording", (row["first"]["right"] for row in usable))
    for test in ("proposed", "random"):
        add_rate(
            f"all named after at most one {test} test",
            (row["first"]["right"] or is_right(row, test) for row in usable),
        )
        add_rate(
            f"named wrongly or in part before, right after {test}",
            (is_right(row, test) for row in asked),
        )
        add_rate(
            f"undecided before, decided after {test}",
            (bool(row.get(test, {}).get("decided")) for row in undecided),
        )
        add_rate(
            f"undecided before, decided and right after {test}",
            (is_decided_right(row.get(test, {})) for row in undecided),
        )
    stated = [
        (row["proposal"]["probability"], is_decided_right(row["proposed"]))
        for row in undecided
        if row.get("proposal")
    ] + [
        (row["random_probability"], is_decided_right(row["random"]))
        for row in undecided
        if row.get("proposal")
    ]
    lines += ["", "| stated probability, proposed and random | mean | decided and right |"]
    lines += ["|---|---|---|", *_format_bins(stated)]
    confidences = [
        (score["confidence"], score["right"])
        for row in usable
        for score in (row["first"], row.get("proposed", {}), row.get("random", {}))
        if score.get("outcome") in ("none", "named")
    ]
    lines += ["", "| stated confidence, all verdicts | mean | right |"]
    lines += ["|---|---|---|", *_format_bins(confidences)]
    return "\n".join(lines) + "\n"


def is_decided_right(score: Json) -> bool:
    """Return True if a verdict leaves nothing open and is right."""
    return bool(score.get("decided") and score["right"])


def _format_bins(stated: Sequence[tuple[float, bool]]) -> list[str]:
    """Return the rate of hits by stated probability, one row of a table a bin."""
    rows = []
    for low, high in pairwise(PROBABILITY_BINS):
        pairs = [(p, hit) for p, hit in stated if low <= p < high + (high == 1.0)]
        mean = f"{np.mean([p for p, _ in pairs]):.2f}" if pairs else "-"
        rate = Rate(sum(hit for _, hit in pairs), len(pairs))
        rows.append(f"| {low:g} to {high:g} | {mean} | {rate} |")
    return rows
