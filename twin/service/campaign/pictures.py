"""The campaign's pictures: all gaps as in the paper's Figs. 2 and 5, and the level of each step."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from table_io.profile import Sweep
from table_io.records import Point
from table_io.units import GRAVITY_M_S2
from twin.service.campaign.joined import points
from twin.service.campaign.whole import Told, Whole, normalisation
from twin.service.figures import Picture
from twin.service.paper.cases import Case, Test
from twin.service.paper.families import all_gaps, transition
from twin.service.paper.look import (
    COLOUR,
    DIRECTIONS,
    GUIDE,
    PAPER_STYLE,
    TRANSITION,
    Drawing,
    minus,
)
from twin.service.paper.rig import Rig

NEAR_HZ = 1e-9


def draw_all(whole: Whole, folder: Path) -> list[Picture]:
    """The pictures, as PNG files in `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    pictures = []
    with mpl.rc_context(PAPER_STYLE):
        for one in _drawings(whole):
            path = folder / f"{one.name}.png"
            one.figure.savefig(path)
            pictures.append(Picture(path, one.title, one.caption))
    return pictures


def _drawings(whole: Whole) -> Iterator[Drawing]:
    cases, rig = families(whole)
    drawn = [all_gaps(cases, rig)]
    if sum(name in cases for name in TRANSITION) > 1:
        drawn.append(transition(cases, rig))
    by = normalisation(whole.stars)
    for one in drawn:
        caption = f"{one.caption} {by[0].upper()}{by[1:]}."
        yield replace(one, name=one.name.removeprefix("rig_"), caption=caption)
    if any(run.summary["steps"] for run in whole.runs):
        yield _levels(whole)


@dataclass(frozen=True, eq=False)
class Gap(Case):
    """A gap of a campaign: where its sweeps overlap, the finest grid is drawn."""

    @cached_property
    def points(self) -> tuple[Point, ...]:
        sweeps = [test.profile.sweep for test in self.tests]
        return tuple(
            point
            for test in self.tests
            for point in test.points
            if not _finer(point.frequency_hz, test.profile.sweep, sweeps)
        )


def _finer(hz: float, of: Sweep, sweeps: list[Sweep]) -> bool:
    """True where another of the sweeps goes through a frequency in finer steps."""
    return any(
        one.step_hz < of.step_hz and one.start_hz - NEAR_HZ <= hz <= one.stop_hz + NEAR_HZ
        for one in sweeps
    )


def families(whole: Whole) -> tuple[dict[str, Case], Rig]:
    """(the model's lines, the measured points) by gap, the largest first."""
    stars = (whole.stars["u_star_m"], whole.stars["a_star_m_s2"]) if whole.stars else None
    by_gap: dict[float, list[Told]] = {}
    for run in whole.runs:
        by_gap.setdefault(run.profile.specimen.gap_mm, []).append(run)
    cases: dict[str, Case] = {}
    rig = Rig()
    for gap_mm in sorted(by_gap, reverse=True):
        runs = by_gap[gap_mm]
        name = "G∞" if math.isinf(gap_mm) else f"G{gap_mm:g}"
        tests = {
            (run.test, run.profile.sweep): Test(
                run.test, run.profile, run.model.parameters,
                run.model if run.model.present else None, stars,
            )
            for run in runs
        }  # fmt: skip
        cases[name] = Gap(name, tuple(tests.values()))
        sweeps = [run.profile.sweep for run in runs if run.summary["steps"]]
        rig.points[name] = [
            point
            for run in runs
            for point in points(run.summary["steps"])
            if not _finer(point.frequency_hz, run.profile.sweep, sweeps)
        ]
    return cases, rig


def _levels(whole: Whole) -> Drawing:
    """How far the fundamental of the table's acceleration was from its demand."""
    figure = Figure(figsize=(11, 3.4))
    ax = figure.subplots()
    band = 100 * max(run.profile.control.tolerance for run in whole.runs)
    ax.axhspan(-band, band, color="#1a7f37", alpha=0.10, lw=0)
    for run in whole.runs:
        level = run.profile.sweep.acceleration_g * GRAVITY_M_S2
        for one in DIRECTIONS:
            mine = [point for point in points(run.summary["steps"]) if point.direction == one]
            f = np.array([point.frequency_hz for point in mine])
            seen = np.array([point.table_acc_fundamental_m_s2 for point in mine])
            ax.plot(f, 100 * (seen / level - 1), "o", ms=2.8, mew=0, color=COLOUR[one])
    ax.axhline(0, color=GUIDE, lw=0.8)
    low, high = ax.get_ylim()
    ax.set_ylim(min(low, -1.2 * band), max(high, 1.2 * band))
    ax.set_xlabel("$f$ in Hz")
    ax.set_ylabel("level error in %")
    handles = [Line2D([], [], color=c, marker="o", ls="", label=one) for one, c in COLOUR.items()]
    figure.legend(handles=handles, loc="outside upper center", ncols=2)
    return Drawing(
        "level", "", "Level of the table at every measured step of every run",
        "Fundamental of the measured table acceleration over the demanded one, less one. Green: "
        f"the tolerance of ±{band:g} %.",
        figure,
    )  # fmt: skip


def gap_name(gap_mm: float) -> str:
    """G16, G−1, G∞: as the paper writes it."""
    return "G∞" if math.isinf(gap_mm) else minus(f"G{gap_mm:g}")
