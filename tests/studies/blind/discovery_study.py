"""Study of discovery: cases judged blind, scored against the sealed truth; negative controls.

The controls are verdicts where no confident name can be correct:

reversed    recording reversed in time: dissipation becomes generation, which no effect does
without     true effect removed from the library: any confident name is wrong
shuffled    verdicts scored against the truths of other cases, see `compute_shuffled_rates`
"""

import contextlib
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from table_io.clock import cpu_seconds
from tests.studies.blind.cases import LaboratoryLevel, draw_case, list_case_numbers
from tests.studies.blind.harness import Study, StudyOptions, format_error, run_study
from tests.studies.blind.oracle import fit_known_effects
from tests.studies.blind.page import (
    CONTROL_TITLES,
    CONTROLS_FILE,
    describe_outcome,
    write_study_pages,
)
from tests.studies.blind.plant import CasePaths, generate_case
from tests.studies.blind.rivals import describe_missing, find_rivals, load_case
from tests.studies.blind.scoring import (
    format_effect_name,
    score_identification,
    score_laboratory,
    score_verdict,
    select_case_facts,
)
from twin.discovery.build_verdict import build_verdict
from twin.discovery.discover import PreparedLog, discover_effects
from twin.discovery.signals import LogSignals
from twin.discovery.task import identify
from twin.model.model import Model
from twin.results.contract import format_json
from twin.system.terminal import print_line

Json = dict[str, Any]
Method = Callable[[Path], Json]  # folder of a case -> verdict as in verdict.json
Spectrum = npt.NDArray[np.complex128]
CONTROL_CELLS = "single/*/3/1%"
MIN_FOOLED_CONFIDENCE = 0.5  # a name with a higher confidence counts as confident
# Rivals on the same recording; their verdicts are scored in the same way.
RIVALS: dict[str, Method] = find_rivals()


def run_discovery_study(
    options: StudyOptions, laboratory: LaboratoryLevel = "none", has_controls: bool = False
) -> int:
    """Evaluate the cases that have no result, then the controls; return the exit code."""
    folder, numbers, workers = options.prepare("study-discovery", laboratory=laboratory)
    if describe_missing():
        print_line(describe_missing())
    study = Study(partial(evaluate_case, folder), format_row, write_study_pages)
    exit_code = run_study(study, folder, numbers, workers)
    if not has_controls or exit_code:
        return exit_code
    print_line(f"negative controls on {CONTROL_CELLS}")
    controls = Study(partial(run_controls, folder), format_row, write_study_pages, CONTROLS_FILE)
    return run_study(controls, folder, list_case_numbers(options.seeds, [CONTROL_CELLS]), workers)


def format_row(row: Json) -> str:
    """Return one line about a case."""
    mark = "right" if row["right"] else "MISSED"
    if "said" not in row:
        results = (
            f"{control}: {row[control]['said']} {' + '.join(row[control]['named'])}"
            for control in CONTROL_TITLES
        )
        return f"{'; '.join(results)}: {mark}"
    confidence = "" if row["confidence"] is None else f" ({row['confidence']:.2f})"
    seconds = "" if row.get("seconds") is None else f", {row['seconds']:.1f} s"
    return f"{describe_outcome(row)}{confidence}: {mark}{seconds}"


def evaluate_case(root: Path, number: int, method: Method | None = None) -> Json:
    """Return the row of a case; a failed verdict counts as a miss, with the error in `failed`.

    A case without the size of its cell, or stopped by protection, is excluded. `method` is
    discovery, or identification where nothing is hidden but parameters.
    """
    case = draw_case(number)
    start_s = cpu_seconds()  # CPU time of this process only
    try:
        paths = generate_case(case, root)
    except Exception as error:
        return {"number": number, "cell": case.cell.name, "failed": format_error(error)}
    about = json.loads(paths.about.read_text(encoding="utf-8"))
    made_s = cpu_seconds()
    if not about["sized"]:
        return select_case_facts(about) | {"label": case.label, "made_in": made_s - start_s}
    own_method = identify_in_case if about["kind"] == "identify" else discover_in_case
    verdict, failure = run_method(method or own_method, paths.case_dir)
    timing = {
        "label": case.label, "seconds": cpu_seconds() - made_s, "made_in": made_s - start_s,
        **({"failed": failure} if failure else {}),
    }  # fmt: skip
    paths.verdict.write_text(format_json(verdict), encoding="utf-8")
    if about["kind"] == "identify":
        return score_identification(verdict, about) | timing
    if "laboratory" in about:  # which oracle and rivals do not know
        row = score_verdict(verdict, about)
        return row | score_laboratory(row, verdict, about) | timing
    truth = [effect["name"] for effect in about["effects"]]
    oracle = None if about["kind"] == "unknown" else _fit_oracle(paths, truth)
    row = score_verdict(verdict, about, oracle)
    if oracle and about["kind"] == "pair":
        row["mark"] = _compute_mark(paths, truth, oracle)
    rivals = {}
    for name, rival in RIVALS.items():
        verdict, failure = run_method(rival, paths.case_dir)
        rivals[name] = score_verdict(verdict, about) | ({"failed": failure} if failure else {})
    return row | timing | ({"rivals": rivals} if rivals else {})


def run_method(method: Method, case_dir: Path) -> tuple[Json, str]:
    """Run a method; return (verdict, error message), so that a failure ends only one case."""
    try:
        return method(case_dir), ""
    except Exception as error:
        return {"verdict": "failed", "reason": format_error(error)}, format_error(error)


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


def discover_in_case(case_dir: Path) -> dict[str, Any]:
    """Run discovery on the recording of a case; return the verdict as in verdict.json."""
    logs, notes, model = load_case(case_dir)
    verdict = build_verdict(discover_effects(logs, model), notes=notes).to_plain()
    for effect in verdict["effects"]:
        effect["parameters"] = {
            name: cover_every_value(estimate) for name, estimate in effect["parameters"].items()
        }
    return verdict


def cover_every_value(estimate: dict[str, Any]) -> dict[str, Any]:
    """Return an estimate whose interval is infinite where it is unknown: it covers the truth."""
    if estimate.get("low", 0.0) is None:
        return estimate | {"low": -math.inf, "high": math.inf}
    return estimate


def identify_in_case(case_dir: Path) -> Json:
    """Return what `identify` states of the recording of a case: parameters and gaps.

    The gap of a side has no interval.
    """
    report = identify([case_dir / "log.mcap"], case_dir / "model.toml").report
    (gap,) = report.gaps.values()
    total = gap.interval.to_plain() if gap.interval else {"value": gap.right + gap.left}
    estimates = {name: estimate.to_plain() for name, estimate in report.parameters.items()}
    sides = {"gap_right": {"value": gap.right}, "gap_left": {"value": gap.left}}
    return {
        "verdict": "identified",
        "parameters": {
            **{name: cover_every_value(e) for name, e in (estimates | {"gap": total}).items()},
            **sides,
        },
        "rms_over_noise": report.rms_over_noise,
        "warnings": report.warnings,
    }


def fit_true_structure(case_dir: Path, effects: Sequence[str]) -> float | None:
    """Return the held-out rms over the noise with these effects fitted; None if they cannot be."""
    logs, _, model = load_case(case_dir)
    fit = fit_known_effects(logs, model, effects)
    return math.sqrt(fit.cost) if fit is not None else None


def run_controls(root: Path, number: int) -> Json:
    """Return the row of a case with both controls; `sized` is False if it misses its size."""
    case = draw_case(number)
    row: Json = {"number": number, "cell": case.cell.name}
    try:
        paths = generate_case(case, root)
        about = json.loads(paths.about.read_text(encoding="utf-8"))
        row |= {"sized": about["sized"], "ended": about["ended"]}
        if not about["sized"]:
            return row
        row["truth"] = [effect["name"] for effect in about["effects"]]
        logs, _, model = load_case(paths.case_dir)
        ids = [planted.effect.definition.id for planted in case.planted]
        verdicts = (discover_reversed(logs, model), discover_without(logs, model, ids))
        outcomes = {
            control: summarize_verdict(verdict)
            for control, verdict in zip(CONTROL_TITLES, verdicts, strict=True)
        }
    except Exception as error:
        return row | {"failed": format_error(error)}
    return row | outcomes | {"right": not any(outcome["fooled"] for outcome in outcomes.values())}


def discover_reversed(logs: Sequence[PreparedLog], model: Model) -> Json:
    """Return the verdict on time-reversed recordings."""
    return build_verdict(discover_effects([reverse_log(log) for log in logs], model)).to_plain()


def discover_without(logs: Sequence[PreparedLog], model: Model, effects: Sequence[str]) -> Json:
    """Return the verdict with these effects removed from the library."""
    return build_verdict(discover_effects(logs, model, without=effects)).to_plain()


def summarize_verdict(verdict: Json) -> Json:
    """Return the summary of a verdict; `fooled` is True for a confident name."""
    effects = verdict["effects"] if verdict["verdict"] == "named" else []
    confidence = max((float(effect["confidence"]) for effect in effects), default=None)
    return {
        "said": verdict["verdict"], "named": [format_effect_name(effect) for effect in effects],
        "confidence": confidence,
        "fooled": confidence is not None and confidence > MIN_FOOLED_CONFIDENCE,
    }  # fmt: skip


def reverse_log(log: PreparedLog) -> PreparedLog:
    """Return the log reversed in time: velocities change sign, the other signals do not.

    Sensor noise, readings at rest and step labels are kept.
    """
    signals = log.signals
    reversed_signals = replace(
        signals,
        spectra={
            name: _reverse_spectrum(signals, spectrum) for name, spectrum in signals.spectra.items()
        },
        unit_spectrum=_reverse_spectrum(signals, signals.unit_spectrum),
        step=signals.step[::-1],
        label=signals.label[::-1],
        cycle=signals.cycle[::-1],
        good=signals.good[::-1],
    )
    return replace(log, signals=reversed_signals)


def _reverse_spectrum(signals: LogSignals, spectrum: Spectrum) -> Spectrum:
    """Return the spectrum of x(T - t), with T the time of the last kept sample."""
    last_s = (signals.time_s.size - 1) * signals.grid.decimation / signals.grid.rate_hz
    reversed_spectrum: Spectrum = np.conj(spectrum) * np.exp(-1j * signals.omega * last_s)
    return reversed_spectrum
