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
from twin.campaign.gap_comparison import (
    compare_gaps,
    describe_comparison,
    format_gap,
    list_record_runs,
)
from twin.campaign.messages import print_gap_comparison
from twin.campaign.report import SYMBOLS, embed_pairs, list_gap_tables
from twin.campaign.result import CampaignInfo, CampaignSummary
from twin.drawing.page import render_page
from twin.model.valid_range import EVENT_KIND
from twin.results.contracts import MotionResult, PeakAndRms, RunInfo, RunSummary, WindowResult
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
    runs, warnings = [], []
    with show_status("simulating") as show_part:
        for run in planned:
            show_part(run.label)
            peaks, range_exits = simulate_peaks(run.bundle)
            runs.append((run.label, run.bundle.profile, peaks))
            warnings += [f"{run.label}: {text}" for text in range_exits]
    comparison = compare_gaps(list_record_runs(runs, names), ("twin",))
    assert comparison is not None
    pairs = draw_gap_pairs(comparison, folder / "figures")
    described = describe_comparison(comparison)
    summary = CampaignSummary(
        campaign=CampaignInfo(
            title=plan.config.title,
            citation=plan.config.citation,
            notes=plan.config.notes,
            model=_name_models(planned),
        ),
        verdict="complete",
        reason=f"{len(comparison.records)} records at {len(comparison.gaps_mm)} gaps",
        gap_comparison=described,
        warnings=warnings,
    )
    summary.write(folder / "summary.json")
    page = render_page(
        Path(__file__).with_name("gap_page.html"),
        summary=summary,
        gaps=described,
        pictures=embed_pairs(pairs),
        text=plan.text,
        digest=sha256(plan.text.encode()).hexdigest(),
        tables=list_gap_tables(comparison),
        symbols=SYMBOLS,
        gap_name=format_gap,
    )
    (folder / "report.html").write_text(page, encoding="utf-8")
    print_gap_comparison(described)
    for text in warnings:
        print_line(f"warning: {text}")
    print_line(f"{summary.reason}, model alone -> {folder / 'report.html'}")
    return 0


def simulate_peaks(config: RunConfig) -> tuple[RunSummary, list[str]]:
    """Return a summary with the peaks of the model on an ideal table, over the whole history.

    And warnings where a law leaves the range in which it was fitted.
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
    return _describe_motion(**peaks), warnings


def _describe_motion(
    u: float, a: float = math.nan, force_r: float = math.nan, force_l: float = math.nan
) -> RunSummary:
    """Return the summary of a history with one window, by peaks in SI."""
    twin = MotionResult(
        u=PeakAndRms(peak=u),
        a=PeakAndRms(peak=a),
        force_r=PeakAndRms(peak=force_r),
        force_l=PeakAndRms(peak=force_l),
    )
    window = WindowResult(index=0, from_s=0.0, to_s=math.nan, twin=twin)
    return RunSummary(run=RunInfo(), verdict="complete", steps=[], windows=[window])


def _name_models(runs: list[PlannedRun]) -> str:
    """Return the titles of the models of the runs."""
    titles = [tomllib.loads(run.bundle.model_toml).get("title", "model") for run in runs]
    return ", ".join(dict.fromkeys(titles))
