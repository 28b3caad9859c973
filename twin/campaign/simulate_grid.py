"""Comparison of gaps by the model alone: the records of a campaign at their gaps, no table."""

import math
import tomllib
from hashlib import sha256
from pathlib import Path

import numpy as np

from table_io.block import Block, Float1D, Label
from table_io.channels import contact_forces, relative_displacement
from table_io.config.excitation.record import RecordedHistory
from table_io.errors import InputError
from table_io.records import Event
from twin.campaign.config import PlannedRun, read_plan
from twin.campaign.figures import draw_gap_pairs
from twin.campaign.gap_comparison import compare_gaps, describe_comparison, list_record_runs
from twin.campaign.messages import print_gap_comparison
from twin.campaign.report import embed_pairs, list_gap_values
from twin.drawing.page import render_page
from twin.model.valid_range import EVENT_KIND
from twin.results.summary import Json, write_json
from twin.results.windows import extract_free_twin
from twin.setup.folders import make_run_folder
from twin.setup.run_config import RunConfig
from twin.setup.unpaced import generate_ideal_twin
from twin.setup.warm_up import compile_kernels
from twin.system.terminal import print_line, show_status


def simulate_grid(path: Path, model: str | None, out: Path | None) -> int:
    """Simulate the records of a campaign at their gaps; write and print the comparison of the gaps.

    InputError if the campaign does not play a record at several gaps.
    """
    with show_status("checking the runs"):
        plan = read_plan(path, None, model, lambda *_: None)
    names = plan.config.record_names
    planned = [
        run for run in plan.runs if isinstance(run.bundle.profile.excitation, RecordedHistory)
    ]
    blank = [(run.label, run.bundle.profile, _describe_motion(math.nan)) for run in planned]
    if compare_gaps(list_record_runs(blank, names), ("twin",)) is None:
        raise InputError(
            "the model alone is simulated for records at several gaps",
            where=path,
            allowed="a campaign with [records]",
            remedy="simulate a single test, or play the campaign with `shaketwin campaign`",
        )
    compile_kernels(planned[0].bundle)
    folder, _ = make_run_folder(out, f"{plan.path.stem}-model")
    runs = []
    with show_status("simulating") as show_part:
        for run in planned:
            show_part(run.label)
            runs.append((run.label, run.bundle.profile, simulate_peaks(run.bundle)))
    comparison = compare_gaps(list_record_runs(runs, names), ("twin",))
    assert comparison is not None
    warnings = [
        f"{label}: {text}"
        for label, _, run_summary in runs
        for text in run_summary.get("warnings", ())
    ]
    pairs = draw_gap_pairs(comparison, folder / "figures")
    described = describe_comparison(comparison)
    summary = {
        "campaign": {
            "title": plan.config.title,
            "citation": plan.config.citation,
            "notes": plan.config.notes,
            "model": _name_models(planned),
        },
        "verdict": "complete",
        "reason": f"{len(comparison.records)} records at {len(comparison.gaps_mm)} gaps",
        "gap_comparison": described,
        "warnings": warnings,
    }
    write_json(summary, folder / "summary.json")
    page = render_page(
        Path(__file__).with_name("gap_page.html"),
        summary=summary,
        gaps=described,
        pictures=embed_pairs(pairs),
        text=plan.text,
        digest=sha256(plan.text.encode()).hexdigest(),
        **list_gap_values(comparison),
    )
    (folder / "report.html").write_text(page, encoding="utf-8")
    print_gap_comparison(described)
    for text in warnings:
        print_line(f"warning: {text}")
    print_line(f"{summary['reason']}, model alone -> {folder / 'report.html'}")
    return 0


def simulate_peaks(config: RunConfig) -> Json:
    """Return a summary with the peaks of the model on an ideal table, over the whole history.

    Its warnings say where a law leaves the range in which it was fitted.
    """
    parts: dict[str, list[Float1D]] = {name: [] for name in ("u", "a", "force_r", "force_l")}
    warnings = []
    for item in generate_ideal_twin(config):
        if isinstance(item, Event) and item.kind == EVENT_KIND:
            warnings.append(item.text)
        if not isinstance(item, Block) or item.stream != "pred":
            continue
        playing = item.label == Label.MEASURE
        if not playing.any():
            continue
        twin = extract_free_twin(item)
        right, left = contact_forces(twin)
        motion = relative_displacement(twin), twin.channel("mass_acc_m_s2"), right, -left
        for name, values in zip(parts, motion, strict=True):
            parts[name].append(values[playing])
    peaks = {name: float(np.abs(np.concatenate(blocks)).max()) for name, blocks in parts.items()}
    return _describe_motion(**peaks) | {"warnings": warnings}


def _describe_motion(
    u: float, a: float = math.nan, force_r: float = math.nan, force_l: float = math.nan
) -> Json:
    """Return the summary of a history with one window, by peaks in SI."""
    peaks = {"u": u, "a": a, "force_r": force_r, "force_l": force_l}
    twin = {name: {"peak": peak} for name, peak in peaks.items()}
    return {"verdict": "complete", "windows": [{"measured": None, "twin": twin}]}


def _name_models(runs: list[PlannedRun]) -> str:
    """Return the titles of the models of the runs."""
    titles = [tomllib.loads(run.bundle.model_toml).get("title", "model") for run in runs]
    return ", ".join(dict.fromkeys(titles))
