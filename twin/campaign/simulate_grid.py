"""Comparison of gaps by the model alone: the records of a campaign at their gaps, no table."""

import math
import tomllib
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

import numpy as np

from table_io.block import Block, Float1D, Label
from table_io.channels import contact_forces, relative_displacement
from table_io.config.excitation.record import RecordedHistory
from table_io.config.profile import Profile
from table_io.errors import InputError
from table_io.records import Event
from twin.campaign.config import PlannedRun, read_plan
from twin.campaign.figures import draw_gap_pairs
from twin.campaign.gap_comparison import (
    GapComparison,
    compare_gaps,
    describe_comparison,
    format_gap,
    list_record_runs,
)
from twin.campaign.messages import print_gap_comparison
from twin.campaign.report import SYMBOLS, embed_pairs, list_gap_tables
from twin.campaign.result import CampaignInfo, CampaignSummary
from twin.drawing.page import write_page
from twin.model.valid_range import EVENT_KIND
from twin.results.contracts import MotionResult, PeakAndRms, RunInfo, RunSummary, WindowResult
from twin.results.windows import extract_free_twin
from twin.setup.folders import make_run_folder
from twin.setup.run_config import RunConfig
from twin.setup.unpaced import generate_ideal_twin
from twin.setup.warm_up import compile_kernels
from twin.system.exit_codes import EXIT_INTERRUPTED
from twin.system.grid import Watch, run_grid, watch_on_terminal
from twin.system.process_pool import Workers
from twin.system.terminal import print_line, show_status


@dataclass(frozen=True, slots=True)
class GapOptions:
    """A campaign that plays records at several gaps, and the model, by default its own."""

    campaign: Path
    model: str | None = None
    out: Path | None = None


@dataclass(frozen=True, slots=True)
class SimulatedGaps:
    """The comparison of gaps by the model alone, the page of it, and what the laws warn of."""

    comparison: GapComparison
    page: Path
    reason: str
    warnings: tuple[str, ...]


def simulate_grid(options: GapOptions) -> int:
    """Simulate the records of a campaign at their gaps; print the comparison of the gaps."""
    with watch_on_terminal("stopping after the record in progress") as watch:
        result = simulate_gaps(options, watch)
    if result is None:
        print_line("stopped: nothing is written before every record is simulated")
        return EXIT_INTERRUPTED
    print_gap_comparison(describe_comparison(result.comparison))
    for text in result.warnings:
        print_line(f"warning: {text}")
    print_line(f"{result.reason}, model alone -> {result.page}")
    return 0


def simulate_gaps(options: GapOptions, watch: Watch | None = None) -> SimulatedGaps | None:
    """Simulate the records of a campaign at their gaps on an ideal table, and compare the gaps.

    Writes summary.json, figures and report.html; None if the watch stops it. InputError if the
    campaign does not play a record at several gaps.
    """
    watch = watch or Watch()
    with show_status("checking the runs"):
        plan = read_plan(options.campaign, None, options.model, lambda *_: None)
    names = plan.config.record_names
    planned = [
        run for run in plan.runs if isinstance(run.bundle.profile.excitation, RecordedHistory)
    ]
    blank = [(run.label, run.bundle.profile, _describe_motion(math.nan)) for run in planned]
    if compare_gaps(list_record_runs(blank, names), ("twin",)) is None:
        raise InputError(
            "the model alone is simulated for records at several gaps",
            where=options.campaign,
            allowed="a campaign with [records]",
            remedy="simulate a single test, or play the campaign with `shaketwin campaign`",
        )
    compile_kernels(planned[0].bundle)
    folder, _ = make_run_folder(options.out, f"{plan.path.stem}-model")
    runs: list[tuple[str, Profile, RunSummary]] = []
    warnings: list[str] = []

    def keep(number: int, simulated: tuple[RunSummary, list[str]]) -> int:
        peaks, range_exits = simulated
        label = planned[number].label
        runs.append((label, planned[number].bundle.profile, peaks))
        warnings.extend(f"{label}: {text}" for text in range_exits)
        return 1

    run_grid(
        lambda number: simulate_peaks(planned[number].bundle),
        range(len(planned)), Workers(1, in_threads=True), keep, watch,
        unit="records", total=len(planned), is_ordered=True,
        describe_failure=lambda number, reason: InputError(reason, where=planned[number].label),
    )  # fmt: skip
    if len(runs) < len(planned):
        return None
    comparison = compare_gaps(list_record_runs(runs, names), ("twin",))
    assert comparison is not None
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
    page = write_page(
        folder,
        Path(__file__).with_name("gap_page.html"),
        summary=summary,
        gaps=described,
        pictures=embed_pairs(draw_gap_pairs(comparison, folder / "figures")),
        text=plan.text,
        digest=sha256(plan.text.encode()).hexdigest(),
        tables=list_gap_tables(comparison),
        symbols=SYMBOLS,
        gap_name=format_gap,
    )
    return SimulatedGaps(comparison, page, summary.reason, tuple(warnings))


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
