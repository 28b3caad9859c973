"""Page and tables of periodic branches; the page is self-contained and can be explored."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np

from twin.drawing.attractor_study import AttractorStudy
from twin.drawing.branch_curves import (
    BranchSet,
    count_impacts,
    describe_bifurcation,
    format_multiplier,
    round_to,
)
from twin.drawing.branch_figures import (
    BIFURCATION_MARKERS,
    draw_branch_figures,
    period_colour,
)
from twin.drawing.page import embed_images, render_page
from twin.dynamics.continuation import Branch, BranchEnd
from twin.dynamics.orbits import Orbit
from twin.results.contract import Json, write_json

PORTRAIT_SAMPLES = 96  # per period, of the motion that the page shows
MAX_PORTRAIT_SAMPLES = 384


def write_branch_report(
    folder: Path,
    branches: BranchSet,
    title: str,
    subtitle: str,
    model_toml: str,
    attractors: AttractorStudy | None = None,
) -> Path:
    """Write report.html, branches.json, branches.csv and figures/*.png to `folder`.

    Return the path of the page.
    """
    pictures = draw_branch_figures(branches, folder / "figures", attractors)
    write_json(make_summary(branches, title), folder / "branches.json")
    write_table(branches, folder / "branches.csv")
    data = make_page_data(branches)
    text = render_page(
        Path(__file__).with_name("page.html"),
        title=title,
        subtitle=subtitle,
        headline=format_branch_headline(branches),
        parameter=branches.axis.label,
        bifurcations=list_bifurcations(branches),
        branches=[_branch_row(branches, branch) for branch in branches.branches],
        images=embed_images(pictures),
        model=model_toml,
        data=json.dumps(data, separators=(",", ":")).replace("</", "<\\/"),
    )
    path = folder / "report.html"
    path.write_text(text, encoding="utf-8")
    return path


def make_summary(branches: BranchSet, title: str) -> Json:
    """Return the content of branches.json: every branch, bifurcation and chaotic range, in SI."""
    return {
        "title": title,
        "parameter": branches.axis.name,
        "branches": [
            {
                "periods": branch.points[0].orbit.periods,
                "ends": [
                    {"reason": end.reason, "value": end.value, "residual": end.residual}
                    for end in branch.ends
                ],
                "bifurcations": [
                    {
                        "kind": item.kind, "value": item.value, "index": item.index,
                        "frequency_hz": item.orbit.frequency_hz,
                        "level_m_s2": item.orbit.acceleration_m_s2, "side": item.side,
                        "turns_back": item.turns_back,
                    }
                    for item in branch.bifurcations
                ],
                "points": [_point(point.value, point.orbit) for point in branch.points],
            }
            for branch in branches.branches
        ],
        "chaotic": [list(band) for band in branches.chaotic],
    }  # fmt: skip


def _point(value: float, orbit: Orbit) -> Json:
    right, left = count_impacts(orbit)
    return {
        "value": value,
        "u_max_m": orbit.extreme("u_max"),
        "u_min_m": orbit.extreme("u_min"),
        "a_max_m_s2": orbit.extreme("a_max"),
        "a_min_m_s2": orbit.extreme("a_min"),
        "force_r_n": orbit.extreme("f_r_max"),
        "force_l_n": orbit.extreme("f_l_min"),
        "impacts_right": right,
        "impacts_left": left,
        "stable": orbit.stable,
        "multipliers": [[value.real, value.imag] for value in orbit.multipliers.tolist()],
    }


def write_table(branches: BranchSet, path: Path) -> None:
    """Write one row per point as CSV, in SI, without loss of precision."""
    columns = [
        "branch", "periods", branches.axis.name, "u_max_m", "u_min_m", "a_max_m_s2", "a_min_m_s2",
        "force_r_n", "force_l_n", "impacts_right", "impacts_left", "stable",
        "largest_multiplier_real", "largest_multiplier_imag",
    ]  # fmt: skip
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        for number, branch in enumerate(branches.branches, 1):
            for point in branch.points:
                row = _point(point.value, point.orbit)
                multipliers = row.pop("multipliers")
                value = row.pop("value")
                row["stable"] = int(row["stable"])
                writer.writerow(
                    [number, point.orbit.periods, value, *row.values(), *multipliers[0]]
                )


def format_branch_headline(branches: BranchSet) -> str:
    """Summarize jumps, stable motions at once and chaos in one or two sentences."""
    factor, unit = branches.axis.factor, branches.axis.label.rsplit(" in ", 1)[-1]
    jumps = sorted(
        {
            round(factor * item.value, 4)
            for branch, item in branches.bifurcations
            if item.turns_back and branch.points[0].orbit.periods == 1
        }
    )
    count = len(branches.branches)
    parts = [f"{count} branch{'es' if count != 1 else ''}"]
    if jumps:
        listed = ", ".join(f"{value:.5g}" for value in jumps[:6])
        more = f" and {len(jumps) - 6} more" if len(jumps) > 6 else ""
        parts.append(f"the motion can jump at {listed}{more} {unit}")
    else:
        parts.append("no fold in this range")
    if branches.chaotic:
        bands = ", ".join(
            f"{factor * low:.4g} to {factor * high:.4g}" for low, high in branches.chaotic
        )
        parts.append(f"chaotic at {bands} {unit}")
    return "; ".join(parts) + "."


def list_bifurcations(branches: BranchSet) -> list[dict[str, Any]]:
    """Return a row per bifurcation, in order of the parameter."""
    factor = branches.axis.factor
    quantity = branches.quantities[0]
    return [
        {
            "kind": item.kind,
            "x": f"{factor * item.value:.6g}",
            "u": f"{quantity.of(item.orbit):.4g}",
            "period": item.orbit.periods,
            "meaning": describe_bifurcation(item),
        }
        for _, item in branches.bifurcations
    ]


def _branch_row(branches: BranchSet, branch: Branch) -> dict[str, Any]:
    x = branches.x(branch)
    return {
        "period": branch.points[0].orbit.periods,
        "points": len(branch.points),
        "stable": f"{100 * np.mean(branch.stable):.0f} %",
        "low": f"{x.min():.5g}",
        "high": f"{x.max():.5g}",
        "begins": format_end(branches, branch.ends[0]),
        "ends": format_end(branches, branch.ends[1]),
    }


def format_end(branches: BranchSet, end: BranchEnd) -> str:
    """Format why a branch ends, and where."""
    text = f"{end.reason} at {branches.axis.factor * end.value:.6g}"
    return f"{text}, residual {end.residual:.1e}" if end.residual else text


def make_page_data(branches: BranchSet) -> Json:
    """Return what the page's script draws, in displayed units."""
    factor, quantities = branches.axis.factor, branches.quantities
    return {
        "parameter": {"label": branches.axis.label},
        "quantities": [{"key": quantity.key, "label": quantity.label} for quantity in quantities],
        "branches": [_branch_data(branches, branch) for branch in branches.branches],
        "bifurcations": [
            {
                "x": factor * item.value,
                "values": {quantity.key: quantity.of(item.orbit) for quantity in quantities},
                "colour": _marker_colour(item.kind),
                "text": f"{item.kind} at {factor * item.value:.6g}: {describe_bifurcation(item)}",
            }
            for _, item in branches.bifurcations
        ],
        "bands": [[factor * low, factor * high] for low, high in branches.chaotic],
        "measured": [
            {
                "x": round_to(curve.x),
                "values": {key: round_to(values) for key, values in curve.values.items()},
                "colour": curve.colour,
                "label": curve.label,
            }
            for curve in branches.measured
        ],
    }


def _marker_colour(kind: str) -> str:
    colour = str(BIFURCATION_MARKERS[kind]["mfc"])
    return "#8a929c" if colour == "white" else colour


def _branch_data(branches: BranchSet, branch: Branch) -> Json:
    orbits = [point.orbit for point in branch.points]
    return {
        "period": orbits[0].periods,
        "colour": period_colour(orbits[0].periods),
        "x": round_to(branches.x(branch), 7),
        "stable": [int(stable) for stable in branch.stable],
        "values": {
            quantity.key: round_to(branches.y(branch, quantity)) for quantity in branches.quantities
        },
        "multipliers": [
            [format_multiplier(value) for value in orbit.multipliers[:2].tolist()]
            for orbit in orbits
        ],
        "impacts": [count_impacts(orbit) for orbit in orbits],
        "orbits": [_portrait(orbit) for orbit in orbits],
        "walls": [_walls_mm(orbit) for orbit in orbits],
    }


def _portrait(orbit: Orbit) -> list[list[float | None]]:
    """Return u in mm and u' in mm/s of a motion, for its phase portrait."""
    count = min(PORTRAIT_SAMPLES * orbit.periods, MAX_PORTRAIT_SAMPLES)
    u, v = orbit.sample_motion(count)[:2]
    return [round_to(1e3 * u, 4), round_to(1e3 * v, 4)]


def _walls_mm(orbit: Orbit) -> list[float]:
    """Return the positions of the bumpers at rest in mm."""
    parameters = orbit.period_map.model.parameters
    walls = np.array([1e3 * parameters.gap_r, -1e3 * parameters.gap_l])
    return [float(wall) for wall in walls[np.isfinite(walls)]]
