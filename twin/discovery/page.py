"""HTML pages of a discovery and of an identification: each one self-contained file.

The numbers are those of verdict.json and identify.json.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from twin.discovery.discover import PreparedLog
from twin.discovery.figure_data import DiscoveryView, check_instruments
from twin.discovery.figures import draw_discovery_figures
from twin.discovery.free_running import compute_misfits, run_logs_free
from twin.discovery.identify_figures import draw_identification_figures
from twin.discovery.parameters import GAP_PREFIX
from twin.discovery.result import Interval, Verdict
from twin.discovery.task import DiscoveredModel, FittedModel
from twin.discovery.units import MIN_STEP_UNITS
from twin.discovery.words import (
    CHANNEL_KINDS,
    KIND_LABELS,
    describe_excluded,
    describe_laws,
    describe_sensors,
    format_effect,
    format_interval,
    format_share,
    format_verdict,
    tabulate_channels,
    tabulate_comparisons,
    tabulate_nuisances,
    typeset_proposal,
)
from twin.drawing.page import MAX_PLAIN, embed_images, format_significant, write_page
from twin.results.quantities import format_quantity

DIGITS, MAX_DECIMALS = 4, 9  # of a fitted value
SECTIONS = {
    "where": "Location of the discrepancy", "candidates": "Candidates", "gates": "Sensor checks",
    "forces": "Residual forces", "histories": "Before and after, on the measured motion",
    "twin": "The run replayed with each model", "time": "Residual over time",
}  # fmt: skip


def write_discovery_page(folder: Path, result: DiscoveredModel) -> Path:
    """Write folder/report.html and its figures to folder/figures; return the path of the page."""
    verdict, logs = result.verdict, result.logs
    view = DiscoveryView(result.discovery, logs, result.law)
    runs = run_logs_free(view)
    pictures = draw_discovery_figures(view, verdict, runs, folder / "figures")
    return write_page(
        folder,
        Path(__file__).with_name("page.html"),
        verdict=verdict,
        sentence=format_verdict(verdict),
        laws=[] if verdict.law else describe_laws(verdict),
        excluded=describe_excluded(verdict),
        proposed=verdict.law,
        proposed_terms=typeset_proposal(verdict.law) if verdict.law else [],
        quantity=format_interval,
        held_out=describe_held_out(view),
        percent=format_share,
        nuisance_rows=tabulate_nuisances(verdict.nuisances),
        rows=list_parameter_rows(verdict, [log.signals.name for log in logs]),
        logs=[_log_facts(log) for log in logs],
        sections=order_sections(verdict),
        complete=result.is_complete,
        gates=check_instruments(view),
        sensor_rows=tabulate_channels(verdict.sensors),
        channel_columns=("channel", *(KIND_LABELS[kind] for kind in CHANNEL_KINDS)),
        comparison_rows=tabulate_comparisons(verdict.sensors),
        misfits=compute_misfits(view, runs),
        images={
            section: embed_images(section_pictures)
            for section, section_pictures in pictures.items()
        },
        model=result.model_toml,
    )


def order_sections(verdict: Verdict) -> dict[str, str]:
    """Return the headings by section; the force that no effect explains comes first."""
    if verdict.verdict != "unexplained":
        return SECTIONS
    return {"forces": SECTIONS["forces"]} | SECTIONS


def list_parameter_rows(
    verdict: Verdict, names: Sequence[str]
) -> list[tuple[str, str, list[str], str]]:
    """Return (group, parameter, [value, low, high], unit) of all fitted values, lengths in mm."""
    law = verdict.law
    groups = [
        (format_effect(effect), effect.parameters)
        for effect in verdict.effects
        if law is None or format_effect(effect) in law.with_effects
    ]
    if law is not None:
        groups += [(f"proposed law, {part.title}", part.parameters) for part in law.terms]
    fitted_base = law.base if law else verdict.base
    base = {_gap_label(name, names): value for name, value in fitted_base.items()}
    rows = []
    for title, parameters in (*groups, ("base parameters, refitted", base)):
        for k, (name, value) in enumerate(parameters.items()):
            factor, unit = (1e3, "mm") if value.unit == "m" else (1.0, value.unit or "–")
            texts = format_with_interval(value, factor)
            rows.append(("" if k else title, name, texts, unit))
    return rows


def _gap_label(name: str, logs: Sequence[str]) -> str:
    number = name.removeprefix(GAP_PREFIX)
    return f"gap correction per side, {logs[int(number)]}" if number.isdigit() else name


def format_with_interval(interval: Interval, factor: float = 1.0) -> list[str]:
    """Format a value and its bounds with the decimals that show two digits of half the interval.

    Without an interval each has `DIGITS` significant digits. All are multiplied by `factor`.
    """
    value = factor * interval.value
    if interval.low is None or interval.high is None:
        return [format_significant(value, DIGITS), *2 * [format_significant(None)]]
    low = factor * interval.low
    high = factor * interval.high
    numbers = (value, low, high)
    half_width = 0.5 * (high - low)
    if not half_width > 0:
        return [format_significant(number, DIGITS) for number in numbers]
    decimals = max(0, 1 - math.floor(math.log10(half_width)))
    if decimals > MAX_DECIMALS or max(abs(low), abs(high)) >= MAX_PLAIN:
        size = max(abs(value), half_width)
        digits = max(DIGITS, 2 + math.floor(math.log10(size)) - math.floor(math.log10(half_width)))
        return [format_significant(number, digits) for number in numbers]
    return [_group_thousands(f"{number:z,.{decimals}f}") for number in numbers]


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


@dataclass(frozen=True)
class LogFacts:
    """What was recorded: name, length, steps, mass, channels and gaps in words."""

    name: str
    seconds: float
    steps: int
    mass: float
    channels: tuple[str, ...]
    gaps: str


def _log_facts(log: PreparedLog) -> LogFacts:
    signals = log.signals
    gaps = [f"{1e3 * gap:g}" for gap in signals.gaps_m]
    return LogFacts(
        name=signals.name,
        seconds=float(signals.time_s[-1] - signals.time_s[0]),
        steps=len(log.steps),
        mass=signals.mass_kg,
        channels=signals.channels,
        gaps="no bumpers" if gaps[0] == "inf" else f"gaps {gaps[0]} and {gaps[1]} mm",
    )


def write_identification_page(folder: Path, fitted: FittedModel, model_name: str) -> Path:
    """Write folder/report.html of an identification and its figures; return the path."""
    return write_page(
        folder,
        Path(__file__).with_name("identify.html"),
        report=fitted.report,
        estimate=format_estimate,
        quantity=format_quantity,
        sensor_lines=describe_sensors(fitted.report.sensors),
        images=embed_images(draw_identification_figures(fitted.identification, folder)),
        model=fitted.model_toml,
        model_name=model_name,
    )


def format_estimate(estimate: Interval) -> str:
    """Format an estimate with half its 95 % interval, or alone with four digits."""
    half = estimate.half_width or None
    return format_quantity(estimate.value, estimate.unit, half, digits=4)
