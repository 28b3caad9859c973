"""Write report.html, summary.json and figures/ of a campaign from the files in its folder."""

from collections.abc import Iterable
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from table_io.block import Float1D
from table_io.units import GRAVITY_M_S2
from twin.campaign.figures import draw_campaign_figures, draw_gap_pairs
from twin.campaign.gap_comparison import (
    COMPROMISE,
    ETA_A,
    ETA_D,
    FORCE_RATIO,
    GapComparison,
    format_gap,
)
from twin.campaign.summary import CampaignData, read_campaign
from twin.drawing.page import embed_images, format_significant, render_page
from twin.drawing.panels import Picture
from twin.results.contracts import PeakAndRms, RunSummary

SYMBOLS = {
    ETA_A: "η<sub>a</sub>",
    ETA_D: "η<sub>d</sub>",
    COMPROMISE: "√½(η<sub>a</sub>² + η<sub>d</sub>²)",
    FORCE_RATIO: "r",
}
SMALLER, LARGER, FORCE = "#1a9850", "#d6404e", "#3f7fc1"  # colours of the cells of the tables
MAX_SHARE = 62.0  # of a colour over the ground of the page, in percent
FULL_RATIO = 4.0  # ratio to the reference, or its inverse, at which a colour is full


def write_campaign_report(folder: Path) -> Path:
    """Write summary.json, figures/ and report.html; return the path of report.html."""
    campaign = read_campaign(folder)
    campaign.summary.write(folder / "summary.json")
    pictures = draw_campaign_figures(campaign, folder / "figures")
    pairs = draw_gap_pairs(campaign.gaps, folder / "figures")
    path = folder / "report.html"
    path.write_text(render_campaign_report(campaign, pictures, pairs), encoding="utf-8")
    return path


def render_campaign_report(
    campaign: CampaignData, pictures: list[Picture], pairs: list[tuple[Picture, Picture]]
) -> str:
    """Return the HTML page with embedded figures and relative links to the reports of the runs.

    `pairs` are the figures of the comparison of gaps, on a light and on a dark ground.
    """
    text = (campaign.folder / "campaign.toml").read_text(encoding="utf-8")
    runs = list(zip(campaign.summary.runs, campaign.runs, strict=True))
    return render_page(
        Path(__file__).with_name("campaign.html"),
        summary=campaign.summary,
        state=campaign.state,
        runs=runs,
        swept=[(run, data) for run, data in runs if data.profile.steps],
        histories=[
            (run, data, find_history_peaks(run, data.profile.specimen.gap_mm))
            for run, data in runs
            if not data.profile.steps
        ],
        stars=campaign.free_flight,
        has_sweeps=any(run.profile.steps for run in campaign.runs),
        gaps=campaign.summary.gap_comparison,
        tables=list_gap_tables(campaign.gaps),
        symbols=SYMBOLS,
        gap_name=format_gap,
        pictures=embed_pairs(pairs),
        reports={path.parent.name for path in campaign.folder.glob("*/report.html")},
        images=embed_images(pictures),
        text=text,
        digest=sha256(text.encode()).hexdigest(),
    )


def embed_pairs(pairs: list[tuple[Picture, Picture]]) -> list[tuple[Any, Any, int]]:
    """Return ((picture, its PNG in base64), the same on a dark ground, number) of each pair."""
    embedded = [embed_images(pair) for pair in pairs]
    return [(light, dark, number) for number, (light, dark) in enumerate(embedded, 1)]


@dataclass(frozen=True, slots=True)
class HistoryPeaks:
    """Measured peaks of a displacement history in display units; NaN if unknown."""

    table_g: float
    u_mm: float
    a_g: float
    force_kn: float
    impacts: str  # right / left


def find_history_peaks(run: RunSummary, gap_mm: float) -> HistoryPeaks:
    """Return the measured peaks of a displacement history; the force without bumpers is noise."""
    windows = run.windows or []
    measured = [window.measured for window in windows if window.measured]

    def find_largest(values: Iterable[PeakAndRms]) -> float:
        return max((value.peak for value in values if value.peak is not None), default=np.nan)

    def count(numbers: list[int | None]) -> str:
        known = [number for number in numbers if number is not None]
        return str(sum(known)) if known else "–"

    forces = [force for motion in measured for force in (motion.force_r, motion.force_l)]
    right = count([motion.impacts_right for motion in measured])
    left = count([motion.impacts_left for motion in measured])
    return HistoryPeaks(
        table_g=find_largest(window.table_acc for window in windows) / GRAVITY_M_S2,
        u_mm=1e3 * find_largest(motion.u for motion in measured),
        a_g=find_largest(motion.a for motion in measured) / GRAVITY_M_S2,
        force_kn=np.nan if np.isinf(gap_mm) else 1e-3 * find_largest(forces),
        impacts=f"{right} / {left}",
    )


@dataclass(frozen=True, slots=True)
class GapCell:
    """Cell of a table of records and gaps: the measured value, that of the twin, its colour."""

    measured: str
    twin: str
    heat: str
    share: str  # of the colour, in percent
    is_best: bool


@dataclass(frozen=True, slots=True)
class GapRow:
    """Row of a table of records and gaps; `reference` is the peak at the reference, with unit."""

    name: str
    reference: str
    cells: list[GapCell]
    is_median: bool = False


@dataclass(frozen=True, slots=True)
class GapTable:
    """Table of records and gaps of one criterion."""

    title: str
    reference_header: str
    gaps: list[str]
    rows: list[GapRow]


def list_gap_tables(comparison: GapComparison | None) -> list[GapTable]:
    """Return the tables of acceleration, displacement and force, with median and largest."""
    if comparison is None:
        return []
    peak_a = comparison.values[comparison.main_source, "a_m_s2"][:, 0] / GRAVITY_M_S2
    peak_u = comparison.values[comparison.main_source, "u_m"][:, 0] * 1e3
    where = comparison.reference
    without = [""] * len(comparison.records)
    return [
        _make_table(comparison, ETA_A, "Acceleration of the mass, η<sub>a</sub>",
                    f", peak {where}", _format_all(peak_a, "g")),
        _make_table(comparison, ETA_D, "Displacement of the bearing, η<sub>d</sub>",
                    f", peak {where}", _format_all(peak_u, "mm")),
        _make_table(comparison, COMPROMISE, "Compromise of both", "", without),
        _make_table(comparison, FORCE_RATIO, "Force of a bumper over weight, r", "", without),
    ]  # fmt: skip


def _format_all(values: Float1D, unit: str) -> list[str]:
    return [f"{format_significant(value)} {unit}" for value in values.tolist()]


def _make_table(
    comparison: GapComparison, criterion: str, title: str, header: str, references: list[str]
) -> GapTable:
    # The reference itself is 1, or has no force.
    skipped = 0 if criterion == FORCE_RATIO and np.isfinite(comparison.reference_mm) else 1
    measured, twin = (
        comparison.values[source, criterion][:, skipped:]
        for source in (comparison.main_source, "twin")
    )
    full = float(np.nanmax(measured)) if np.isfinite(measured).any() else 1.0

    def make_cells(first: Float1D, second: Float1D) -> list[GapCell]:
        known = first[np.isfinite(first)]
        best = known.min() if known.size else None
        return [
            GapCell(
                _format_cell(value),
                _format_cell(predicted),
                *_choose_colour(value, criterion, full),
                value == best,
            )
            for value, predicted in zip(first.tolist(), second.tolist(), strict=True)
        ]

    rows = [
        GapRow(name, reference, make_cells(measured[k], twin[k]))
        for k, (name, reference) in enumerate(zip(comparison.records, references, strict=True))
    ]
    for name, combine in (("median", np.median), ("largest", np.max)):
        cells = make_cells(combine(measured, axis=0), combine(twin, axis=0))
        rows.append(GapRow(name, "", cells, is_median=True))
    gaps = [format_gap(gap_mm) for gap_mm in comparison.gaps_mm[skipped:]]
    return GapTable(title, header, gaps, rows)


def _format_cell(value: float) -> str:
    return f"{value:.2f}" if np.isfinite(value) else "–"


def _choose_colour(value: float, criterion: str, full: float) -> tuple[str, str]:
    """Return the colour of a cell and its share in percent, as text."""
    if not np.isfinite(value):
        return FORCE, "0"
    if criterion == FORCE_RATIO:
        return FORCE, f"{MAX_SHARE * value / full if full > 0 else 0.0:.0f}"
    octaves = np.log(max(value, 1e-9)) / np.log(FULL_RATIO)
    return LARGER if octaves > 0 else SMALLER, f"{MAX_SHARE * min(abs(octaves), 1.0):.0f}"
