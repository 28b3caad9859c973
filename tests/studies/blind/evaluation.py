"""Evaluation of a case: generate it, run discovery blind, score against the sealed truth."""

import contextlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from table_io.clock import cpu_seconds
from tests.studies.blind.adapter import (
    discover_in_case,
    fit_true_structure,
    identify_in_case,
)
from tests.studies.blind.baselines import find_baselines
from tests.studies.blind.generation import CasePaths, generate_case
from tests.studies.blind.laboratory_scores import score_identification, score_laboratory
from tests.studies.blind.scoring import score_verdict
from tests.studies.blind.strata import draw_case
from twin.results.summary import dump_strict_json

Json = dict[str, Any]
Method = Callable[[Path], Json]  # folder of a case -> verdict as in verdict.json
# Baselines on the same recording; their verdicts are scored in the same way.
BASELINES: dict[str, Method] = find_baselines()


def evaluate_case(root: Path, number: int, method: Method = discover_in_case) -> Json:
    """Return the row of a case; a failed verdict counts as a miss, with the error in `failed`.

    A case without the size of its cell, or stopped by protection, is excluded.
    """
    case = draw_case(number)
    start_s = cpu_seconds()  # CPU time of this process only
    try:
        paths = generate_case(case, root)
    except Exception as error:
        return {"number": number, "cell": case.cell.name, "failed": _format_error(error)}
    about = json.loads(paths.about.read_text(encoding="utf-8"))
    made_s = cpu_seconds()
    if not about["sized"]:
        return select_case_facts(about) | {"label": case.label, "made_in": made_s - start_s}
    is_identified = about["kind"] == "identify"
    verdict, failure = run_method(identify_in_case if is_identified else method, paths.case_dir)
    evaluated_s = cpu_seconds()
    paths.verdict.write_text(dump_strict_json(verdict), encoding="utf-8")
    timing = {
        "label": case.label, "seconds": evaluated_s - made_s, "made_in": made_s - start_s,
        **({"failed": failure} if failure else {}),
    }  # fmt: skip
    if "laboratory" in about:
        return _score_in_laboratory(verdict, about) | timing
    truth = [effect["name"] for effect in about["effects"]]
    oracle = None if about["kind"] == "unknown" else _fit_oracle(paths, truth)
    row = _score_verdict(verdict, about, oracle)
    if oracle and about["kind"] == "pair":
        row["mark"] = _compute_mark(paths, truth, oracle)
    runs = {name: run_method(baseline, paths.case_dir) for name, baseline in BASELINES.items()}
    baselines = {
        name: _score_verdict(baseline_verdict, about)
        | ({"failed": baseline_failure} if baseline_failure else {})
        for name, (baseline_verdict, baseline_failure) in runs.items()
    }
    return row | timing | ({"rivals": baselines} if baselines else {})


def select_case_facts(about: Json) -> Json:
    """Return what a row says of its case, whatever is judged."""
    keys = ("number", "cell", "kind", "noise", "size", "reached", "ended", "sized")
    return {key: about[key] for key in keys}


def _score_in_laboratory(verdict: Json, about: Json) -> Json:
    """Return the row of a case in a laboratory; baselines and oracle know no laboratory."""
    if about["kind"] == "identify":
        laboratory = about["laboratory"]
        return select_case_facts(about) | {
            "laboratory": laboratory["level"], "imperfection": laboratory["imperfection"],
            "truth": [], "named": [], "said": verdict["verdict"], "confidence": None,
            **score_identification(verdict, about),
        }  # fmt: skip
    row = _score_verdict(verdict, about)
    return row | score_laboratory(row, verdict, about)


def _score_verdict(verdict: Json, about: Json, oracle: float | None = None) -> Json:
    """Return the score with the held-out error (rms over the noise)."""
    gap = verdict.get("gap") or {}
    return score_verdict(verdict, about, oracle) | {"held_out": gap.get("held_out_after")}


def run_method(method: Method, case_dir: Path) -> tuple[Json, str]:
    """Run a method; return (verdict, error message), so that a failure ends only one case."""
    try:
        return method(case_dir), ""
    except Exception as error:
        return {"verdict": "failed", "reason": _format_error(error)}, _format_error(error)


def _fit_oracle(paths: CasePaths, effects: Sequence[str]) -> float | None:
    """Return the held-out error with the true effects fitted; None if that fails."""
    with contextlib.suppress(Exception):  # the oracle is optional
        return fit_true_structure(paths.case_dir, effects)
    return None


def _compute_mark(paths: CasePaths, truth: Sequence[str], oracle: float) -> float | None:
    """Return the smaller factor by which removing one of two effects raises the held-out error."""
    alone = [_fit_oracle(paths, [name]) for name in truth]
    known = [error / oracle for error in alone if error is not None]
    return min(known) if len(known) == len(truth) else None


def _format_error(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"
