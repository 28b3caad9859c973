"""Figures of a campaign: PRC families as in the paper's Figs. 2 and 5, and level errors."""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from table_io.config.excitation.stepped_sine import Sweep
from table_io.records import PrcPoint
from twin.campaign.gap_comparison import GapComparison
from twin.campaign.gap_figures import draw_gap_figures
from twin.campaign.summary import CampaignData, CampaignRunData, describe_normalization
from twin.drawing.panels import CaptionedFigure, CaptionedFigures, Picture
from twin.drawing.pictures import direction_handles, save_figures
from twin.drawing.plot_style import DIRECTION_COLOURS, GUIDE_COLOUR, TRANSITION_COLOURS, LineStyle
from twin.drawing.prc_families import draw_all_gaps, draw_transition
from twin.results.excitation_verdict import list_level_errors
from twin.results.measured_campaign import MeasuredCampaign
from twin.results.paper_cases import PaperCase, PaperTest, name_gap
from twin.results.report_data import DIRECTIONS
from twin.results.summary import prc_points

NEAR_HZ = 1e-9


def draw_campaign_figures(campaign: CampaignData, folder: Path) -> list[Picture]:
    """Draw the figures as PNG files in `folder`; return them with titles and captions."""
    return save_figures(_draw_each(campaign), folder)


def draw_gap_pairs(comparison: GapComparison | None, folder: Path) -> list[tuple[Picture, Picture]]:
    """Draw the comparison of gaps in `folder`; return pairs on a light and on a dark ground."""
    if comparison is None:
        return []
    light = save_figures(draw_gap_figures(comparison), folder)
    dark = save_figures(draw_gap_figures(comparison), folder / "dark", dark=True)
    return list(zip(light, dark, strict=True))


def _draw_each(campaign: CampaignData) -> CaptionedFigures:
    cases, measured_campaign = prc_families(campaign)
    if not cases:
        return
    drawn = [draw_all_gaps(cases, measured_campaign)]
    if sum(name in cases for name in TRANSITION_COLOURS) > 1:
        drawn.append(draw_transition(cases, measured_campaign))
    normalization = describe_normalization(campaign.free_flight)
    for drawing in drawn:
        caption = f"{drawing.caption} {normalization[0].upper()}{normalization[1:]}."
        yield replace(drawing, name=drawing.name.removeprefix("rig_"), caption=caption)
    if list_swept_runs(campaign):
        yield _draw_levels(campaign)


@dataclass(frozen=True, eq=False)
class CampaignGap(PaperCase):
    """A gap of a campaign; where its sweeps overlap, only the finest grid is drawn."""

    @cached_property
    def points(self) -> tuple[PrcPoint, ...]:
        sweeps = [test.profile.sweep for test in self.tests]
        return tuple(
            point
            for test in self.tests
            for point in test.points
            if not _is_covered_finer(point, test.profile.sweep, sweeps)
        )


def _is_covered_finer(point: PrcPoint, of: Sweep, sweeps: list[Sweep]) -> bool:
    """Return whether another sweep covers a point of a sweep in finer steps, in its direction."""
    return any(
        sweep.step_hz < of.step_hz
        and point.direction in sweep.directions
        and sweep.start_hz - NEAR_HZ <= point.frequency_hz <= sweep.stop_hz + NEAR_HZ
        for sweep in sweeps
    )


def list_swept_runs(campaign: CampaignData) -> list[CampaignRunData]:
    """List the runs of a stepped sine of which a step was measured: only they are drawn."""
    return [run for run in campaign.runs if run.profile.steps and run.summary.steps]


def prc_families(campaign: CampaignData) -> tuple[dict[str, PaperCase], MeasuredCampaign]:
    """Return the model's curves and the measured points by gap, the largest gap first."""
    stars = campaign.free_flight.stars if campaign.free_flight else None
    by_gap: dict[float, list[CampaignRunData]] = {}
    for run in list_swept_runs(campaign):
        by_gap.setdefault(run.profile.specimen.gap_mm, []).append(run)
    cases: dict[str, PaperCase] = {}
    measured_campaign = MeasuredCampaign()
    for gap_mm in sorted(by_gap, reverse=True):
        runs = by_gap[gap_mm]
        name = name_gap(gap_mm)
        tests = {
            (run.test, run.profile.sweep): PaperTest(
                run.test, run.profile, run.model.parameters,
                run.model if run.model.present_effects else None, stars,
            )
            for run in runs
        }  # fmt: skip
        cases[name] = CampaignGap(name, tuple(tests.values()))
        sweeps = [run.profile.sweep for run in runs]
        measured_campaign.points[name] = [
            point
            for run in runs
            for point in prc_points(run.summary.steps)
            if not _is_covered_finer(point, run.profile.sweep, sweeps)
        ]
    return cases, measured_campaign


def _draw_levels(campaign: CampaignData) -> CaptionedFigure:
    """Draw the level error: fundamental of the table acceleration over the demand, minus 1."""
    figure = Figure(figsize=(11, 3.4))
    ax = figure.subplots()
    band = 100 * max(run.profile.control.tolerance for run in campaign.runs)
    ax.axhspan(-band, band, color="#1a7f37", alpha=0.10, lw=0)
    errors = [
        (step.direction, step.frequency_hz, 100 * error)
        for run in list_swept_runs(campaign)
        for error, step in list_level_errors(run.summary.steps)
    ]
    for direction in DIRECTIONS:
        own = [place for name, *place in errors if name == direction]
        ax.plot(*np.reshape(own, (-1, 2)).T, **_dot_style(direction))
    ax.axhline(0, color=GUIDE_COLOUR, lw=0.8)
    low, high = ax.get_ylim()
    ax.set_ylim(min(low, -1.2 * band), max(high, 1.2 * band))
    ax.set_xlabel("frequency in Hz")
    ax.set_ylabel("level error in %")
    handles = direction_handles(_dot_style)
    figure.legend(handles=handles, loc="outside upper center", ncols=2)
    return CaptionedFigure(
        "level", "Level of the table at every measured step",
        "Fundamental of the measured table acceleration over the demanded one, minus one. Green: "
        f"the tolerance of ±{band:g} %.",
        figure,
    )  # fmt: skip


def _dot_style(direction: str) -> LineStyle:
    return {"color": DIRECTION_COLOURS[direction], "ls": "", "marker": "o", "ms": 2.8, "mew": 0}
