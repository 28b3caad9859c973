"""HTML report of a discovery: the discrepancy, the effects found, and the misfit of each model.

The numbers are those of verdict.json; the file is self-contained.
"""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from twin.discovery.discover import Discovery, PreparedLog
from twin.discovery.figure_data import DiscoveryView, check_instruments
from twin.discovery.figures import draw_discovery_figures
from twin.discovery.free_running import compute_misfits, run_logs_free
from twin.discovery.headline import (
    describe_excluded,
    describe_laws,
    format_effect,
    format_interval,
    format_verdict,
    typeset_proposal,
)
from twin.discovery.law_search import LawProposal
from twin.discovery.parameters import GAP_PREFIX
from twin.discovery.screening import MIN_STEP_UNITS
from twin.discovery.sensor_section import (
    CHANNEL_KINDS,
    KIND_LABELS,
    tabulate_channels,
    tabulate_comparisons,
)
from twin.discovery.serialize import Json
from twin.drawing.page import MAX_PLAIN, embed_images, format_significant, render_page

DIGITS, MAX_DECIMALS = 4, 9  # of a fitted value
SECTIONS = {
    "where": "Location of the discrepancy", "candidates": "Candidates", "gates": "Sensor checks",
    "forces": "Residual forces", "histories": "Before and after, on the measured motion",
    "twin": "The run replayed with each model", "time": "Residual over time",
}  # fmt: skip


def write_discovery_page(
    folder: Path,
    discovery: Discovery,
    logs: Sequence[PreparedLog],
    verdict: Json,
    proposal: LawProposal | None = None,
) -> Path:
    """Write folder/report.html and its figures to folder/figures; return the path of the page."""
    view = DiscoveryView(discovery, logs, proposal)
    runs = run_logs_free(view)
    pictures = draw_discovery_figures(view, verdict, runs, folder / "figures")
    text = render_page(
        Path(__file__).with_name("page.html"),
        verdict=verdict,
        sentence=format_verdict(verdict),
        laws=[] if verdict["law"] else describe_laws(verdict),
        excluded=describe_excluded(verdict),
        proposed=verdict["law"],
        proposed_terms=typeset_proposal(verdict["law"]),
        quantity=format_interval,
        held_out=describe_held_out(view),
        rows=list_parameter_rows(verdict, [log.signals.name for log in logs]),
        logs=[_log_facts(log) for log in logs],
        sections=order_sections(verdict),
        complete=discovery.selection.complete,
        gates=check_instruments(view),
        sensor_rows=tabulate_channels(verdict["sensors"]),
        channel_columns=("channel", *(KIND_LABELS[kind] for kind in CHANNEL_KINDS)),
        comparison_rows=tabulate_comparisons(verdict["sensors"]),
        misfits=compute_misfits(view, runs),
        images={
            section: embed_images(section_pictures)
            for section, section_pictures in pictures.items()
        },
        model=(folder / "model.toml").read_text(encoding="utf-8"),
    )
    path = folder / "report.html"
    path.write_text(text, encoding="utf-8")
    return path


def order_sections(verdict: Json) -> dict[str, str]:
    """Return the headings by section; the force that no effect explains comes first."""
    if verdict["verdict"] != "unexplained":
        return SECTIONS
    return {"forces": SECTIONS["forces"]} | SECTIONS


def list_parameter_rows(
    verdict: Json, names: Sequence[str]
) -> list[tuple[str, str, list[str], str]]:
    """Return (group, parameter, [value, low, high], unit) of all fitted values, lengths in mm."""
    term = verdict["remainder"]["evidence"]
    law = verdict["law"]
    groups = [
        (format_effect(effect), effect["parameters"])
        for effect in verdict["effects"]
        if law is None or format_effect(effect) in law["with_effects"]
    ]
    if law is not None:
        groups += [(f"proposed law, {part['title']}", part["parameters"]) for part in law["terms"]]
        term = None
    groups += [(f"generic term, {term['term']}", term["parameters"])] if term else []
    fitted_base = law["base"] if law else verdict["base"]
    base = {_gap_label(name, names): value for name, value in fitted_base.items()}
    rows = []
    for title, parameters in (*groups, ("base parameters, refitted", base)):
        for k, (name, value) in enumerate(parameters.items()):
            factor, unit = (1e3, "mm") if value["unit"] == "m" else (1.0, value["unit"] or "–")
            numbers = [factor * value[key] for key in ("value", "low", "high")]
            texts = format_with_interval(*numbers)
            rows.append(("" if k else title, name, texts, unit))
    return rows


def _gap_label(name: str, logs: Sequence[str]) -> str:
    number = name.removeprefix(GAP_PREFIX)
    return f"gap correction per side, {logs[int(number)]}" if number.isdigit() else name


def format_with_interval(value: float, low: float, high: float) -> list[str]:
    """Format a value and its bounds with the decimals that show two digits of half the interval.

    Without an interval each has `DIGITS` significant digits.
    """
    half_width = 0.5 * (high - low)
    if not (half_width > 0 and math.isfinite(half_width)):
        return [format_significant(number, DIGITS) for number in (value, low, high)]
    decimals = max(0, 1 - math.floor(math.log10(half_width)))
    if decimals > MAX_DECIMALS or max(abs(low), abs(high)) >= MAX_PLAIN:
        size = max(abs(value), half_width)
        digits = max(DIGITS, 2 + math.floor(math.log10(size)) - math.floor(math.log10(half_width)))
        return [format_significant(number, digits) for number in (value, low, high)]
    return [_group_thousands(f"{number:z,.{decimals}f}") for number in (value, low, high)]


def _group_thousands(text: str) -> str:
    """Separate the thousands of a number with commas by thin spaces, from five digits on."""
    separator = "" if len(text.partition(".")[0].lstrip("-")) < len("10,000") else "\u2009"
    return text.replace(",", separator).replace("-", "−")


def describe_held_out(view: DiscoveryView) -> str:
    """Return a sentence that describes the cross-validation."""
    counts = [
        np.unique(residuals.signals.step[residuals.signals.step >= 0]).size
        for residuals in view.log_residuals
    ]
    unit = "steps" if min(counts) >= MIN_STEP_UNITS else "cycles or seconds"
    names = ", ".join(residuals.signals.name for residuals in view.log_residuals)
    return (
        f"{names}: three-fold cross-validation over the {unit}; each third is judged by a fit to "
        "the other two. The parameters are those of a final fit to all data."
    )


def _log_facts(log: PreparedLog) -> Json:
    r = log.signals
    gaps = [f"{1e3 * gap:g}" for gap in r.gaps_m]
    return {
        "name": r.name, "seconds": float(r.time_s[-1] - r.time_s[0]), "steps": len(log.steps),
        "mass": r.mass_kg, "channels": r.channels,
        "gaps": "no bumpers" if gaps[0] == "inf" else f"gaps {gaps[0]} and {gaps[1]} mm",
    }  # fmt: skip
