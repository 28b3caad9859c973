"""Study of decisive runs: what a proposed test decides on the same hidden plant, and a random one.

The first recording of a case is that of `study discovery`, or of a poorer test, one frequency at
one level. Where its verdict leaves something open, or names less than what is hidden, the proposed
test and a random one as long are played with other noise, and all recordings judged again.
"""

import json
from collections.abc import Iterable, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from table_io.clock import cpu_seconds
from table_io.config.toml_text import format_toml
from table_io.errors import InputError
from twin.identification.discover import Discovery, discover_effects
from twin.reports.discovery.loading import load_logs
from twin.reports.finalize import EXIT_INTERRUPTED
from twin.run.decisive_test import (
    CandidateTest,
    draw_random_test,
    list_candidate_tests,
    propose_tests,
)
from twin.run.folders import claim_folder, make_output_folder
from twin.run.recordings import open_recording
from twin.run.run_config import read_model_template
from twin.run.tasks import Workers, run_tasks
from twin.run.terminal import catch_interrupts, print_line
from twin.validation.study.generation import find_shares, hash_truth, make_truth, record_test
from twin.validation.study.rates import Rate
from twin.validation.study.rig_setup import MODEL_TOML, PROFILE_TOML, make_rig_toml
from twin.validation.study.strata import Case, draw_case, list_case_numbers

Json = dict[str, Any]
DEFAULT_CELLS = ("pair/*/1%", "pair/*/5%")
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
PROBABILITY_BINS = (0.0, 0.5, 0.9, 1.0)


def run_decide_study(
    out: Path | None,
    seeds: int,
    cells: Sequence[str],
    workers: int | None,
    resume: bool,
    poor: bool,
) -> int:
    """Evaluate decisive runs on the cases that have no result; return the exit code."""
    numbers = list_case_numbers(seeds, cells or DEFAULT_CELLS)
    if out is not None and resume:
        claim_folder(out)
    folder = out if out is not None and resume else make_output_folder(out, "study-decide")
    path = folder / RESULTS_FILE
    rows = read_json_lines(path)
    finished = {row["number"] for row in rows}
    pending = [number for number in numbers if number not in finished]
    task = partial(evaluate_decision, folder, poor)
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


def evaluate_decision(root: Path, poor: bool, number: int) -> Json:
    """Return the row of a case: the first verdict, and after the proposed and a random test."""
    case, start_s = draw_case(number), cpu_seconds()
    plant = _SealedPlant(case, root / "cases" / case.label)
    plant.play(POOR_PROFILE_TOML if poor else PROFILE_TOML, "first")
    first = plant.discover("first")
    truth = [planted.effect.name for planted in case.planted]
    row: Json = {
        "number": number, "cell": case.cell.name, "truth": truth,
        "first": _score_discovery(first, truth),
    }  # fmt: skip
    if row["first"]["right"]:
        return row | {"seconds": cpu_seconds() - start_s}
    recorded = open_recording(plant.log("first")).start
    rig = recorded.rig_toml
    proposals = propose_tests(first, list_candidate_tests(recorded, rig, MAX_TEST_MIN))
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
        "is_open": not proposal.prediction.is_confirmation,
    }
    for label, test in (("proposed", proposal.test), ("random", random)):
        row[label] = plant.evaluate_test(test, label, truth)
    return row | {"seconds": cpu_seconds() - start_s}


class _SealedPlant:
    """Plant of a case with its sealed truth, on which several tests can be played."""

    def __init__(self, case: Case, folder: Path) -> None:
        self.case, self.folder, self.tests = case, folder, 0
        folder.mkdir(parents=True, exist_ok=True)
        shares, _ = find_shares(case)
        text = f"# {case.salt}\n" + format_toml(make_truth(case, case.planted, shares))
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

    def discover(self, *names: str) -> Discovery:
        """Return the discovery from recordings together."""
        logs, _ = load_logs([self.log(name) for name in names])
        return discover_effects(logs, read_model_template(str(self.folder / "model.toml"))[0])

    def evaluate_test(self, test: CandidateTest, name: str, truth: Sequence[str]) -> Json:
        """Return the verdict after a further test, or why there is none."""
        facts: Json = {"title": test.title, "excitation": str(test.config.profile.excitation)}
        ended = self.play(test.config.profile_toml, name)
        if ended != "complete":
            return facts | {"ended": ended, "outcome": ended, "right": False, "decided": False}
        try:
            return facts | _score_discovery(self.discover("first", name), truth)
        except InputError as error:
            return facts | {"outcome": str(error), "right": False, "decided": False}


def _score_discovery(discovery: Discovery, truth: Sequence[str]) -> Json:
    """Return the verdict; right: it names all that is hidden and nothing else."""
    verdict = discovery.verdict
    named = [*verdict.best.names]
    return {
        "outcome": verdict.outcome, "named": named, "remainder": verdict.has_remainder,
        "confidence": verdict.confidence, "decided": verdict.is_decided,
        "right": verdict.outcome == "named" and {*named} == {*truth},
        "all_named": verdict.outcome == "named" and {*truth} <= {*named},
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
    mark = "right" if score["right"] else "MISSED"
    return f"{score['outcome']} {'+'.join(score.get('named', ()))} {mark}"


def format_rates(rows: Iterable[Json]) -> str:
    """Return the rates of decisive and random tests with Wilson intervals, and the calibration."""
    usable = [row for row in rows if "first" in row]
    asked = [row for row in usable if not row["first"]["right"]]
    played = [row for row in asked if row.get("proposal")]
    undecided = [row for row in asked if not row["first"]["decided"]]
    lines = ["| | rate | 95 % interval |", "|---|---|---|"]

    def add_rate(name: str, hits: Iterable[bool]) -> None:
        flags = [*hits]
        lines.append(f"| {name} | {Rate(sum(flags), len(flags))} |")

    def is_right(row: Json, test: str) -> bool:
        return bool(row.get(test, {}).get("right"))

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
            (is_right(row, test) for row in undecided),
        )
    lines += ["", "| stated probability | mean | decided |", "|---|---|---|"]
    for low, high in pairwise(PROBABILITY_BINS):
        rows_of_bin = [
            row
            for row in played
            if row["proposal"]["is_open"]
            and low <= row["proposal"]["probability"] < high + (high == 1.0)
        ]
        stated = [row["proposal"]["probability"] for row in rows_of_bin]
        hits = sum(bool(row["proposed"].get("decided")) for row in rows_of_bin)
        mean = f"{np.mean(stated):.2f}" if stated else "-"
        lines.append(f"| {low:g} to {high:g} | {mean} | {Rate(hits, len(stated))} |")
    return "\n".join(lines) + "\n"
