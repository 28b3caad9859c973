"""Customer's report of a test: one content, as a page and as a PDF of A4 sheets.

Title, set-up, instruments with their calibration, demand and achieved, deviations, signatures.
"""

import re
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from pydantic import BaseModel

from table_io.config.base import parse_toml
from table_io.config.channel import read_channels
from table_io.config.key_reference import derive_unit
from table_io.config.profile import Profile
from table_io.records import SampleGap
from table_io.units import GRAVITY_M_S2
from twin.drawing.page import embed_images, render_page
from twin.drawing.panels import CaptionedFigure, PanelFigure, Picture
from twin.drawing.pictures import RC_PARAMS, draw_panels, save_figures, scale_style
from twin.report.figures import draw_figures
from twin.results.excitation_verdict import list_level_errors
from twin.results.report_data import ReportData
from twin.results.sensor_table import build_sensor_rows
from twin.results.summary import parse_toml_tables
from twin.results.table_motion import format_required, format_tracking
from twin.system.files import hash_file

CUSTOMER_FIGURES = ("swept_sine", "table_spectrum", "table_acceleration", "level", "prc")
MAX_ALARMS = 10
PAGE_IN, MARGIN, LINE = (8.27, 11.69), 0.09, 0.0155  # A4; shares of the page
Rows = Sequence[tuple[str, ...]]


@dataclass(frozen=True, slots=True)
class ReportSection:
    """Section of a customer's report: a table with or without headers, and lines of text."""

    title: str
    rows: Rows
    headers: tuple[str, ...] = ()
    lines: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class CustomerReport:
    """Content of a customer's report."""

    title: str
    verdict: str
    cover: Rows
    sections: tuple[ReportSection, ...]
    signatures: tuple[str, ...]
    figures: tuple[CaptionedFigure, ...]


def build_customer_report(run: ReportData) -> CustomerReport:
    """Return the content of the customer's report of a run."""
    start, summary = run.recording.start, run.summary
    profile = parse_toml(start.profile_toml, Profile, "recorded profile")
    texts, excitation = profile.customer, summary.excitation_verdict
    verdict = f"Test {summary.verdict}: {summary.reason}."
    if excitation is not None:
        verdict += f" Excitation {excitation.verdict}: {excitation.reason}."
    cover = [
        ("Laboratory", texts.laboratory),
        ("Customer", texts.customer),
        ("Order", texts.order),
        ("Specimen", texts.specimen),
        ("Specification", texts.specification),
        ("Run", start.run),
        ("Begin", start.started_at),
        ("Recording, SHA-256", hash_file(run.recording.path)),
        ("Program", f"shaketwin {start.versions.get('shaketwin', '')}"),
    ]
    sections = (
        ReportSection("Set-up", _list_set_up(run, profile)),
        ReportSection("Instruments", _list_instruments(run), INSTRUMENT_HEADERS),
        ReportSection("Demand and achieved", *_list_results(run)),
        ReportSection("Deviations", [], lines=tuple(_list_deviations(run))),
    )
    chosen = {figure.name: figure for figure in draw_figures(run)}
    figures = tuple(chosen[name] for name in CUSTOMER_FIGURES if name in chosen)
    rows = [(name, value) for name, value in cover if value]
    title = profile.title or start.name
    return CustomerReport(title, verdict, rows, sections, texts.signatures, figures)


INSTRUMENT_HEADERS = ("channel", "instrument", "serial", "sensitivity", "calibrated", "due")


def _list_set_up(run: ReportData, profile: Profile) -> Rows:
    rig = parse_toml_tables(run.recording.start.rig_toml)
    channels = read_channels(run.recording.start.rig_toml)
    excitation = profile.excitation.model_dump(exclude_unset=True, exclude={"files", "prediction"})
    gaps = "none" if run.gaps_m is None else " and ".join(f"{1e3 * g:g} mm" for g in run.gaps_m)
    rows = [
        ("Table", str(rig.get("title") or rig.get("name") or "")),
        ("Moving mass of the specimen", f"{profile.specimen.mass_kg:g} kg"),
        ("Gap of the bumpers, right and left", gaps),
        ("Sampling", f"{profile.acquisition.rate_hz:g} Hz"),
        *(_describe_setting(profile.excitation, *entry) for entry in excitation.items()),
        ("Alarm and stop of the level",
         f"±{100 * profile.protection.alarm:g} %, ±{profile.protection.abort_db:g} dB"),
    ]  # fmt: skip
    rows += [
        (
            f"Limit of {entry.channel}",
            f"{entry.limit:g} {entry.unit or channels[entry.channel].unit}: {entry.action}",
        )
        for entry in profile.limits
    ]
    return [*rows, *([("Notes", profile.notes)] if profile.notes else [])]


def _describe_setting(settings: BaseModel, key: str, value: object) -> tuple[str, str]:
    """Return what a key of the excitation states, in words, and its value with the unit."""
    described = type(settings).model_fields[key].description or key.replace("_", " ")
    words = re.split(r"[.:;]", described)[0]
    text = _format_value(value)
    text = text.replace("_", " ") if key == "kind" else f"{text} {derive_unit(key)}".strip()
    return f"Excitation: {words[:1].lower()}{words[1:]}", text


def _format_value(value: object) -> str:
    if isinstance(value, tuple | list):
        return ", ".join(map(_format_value, value))
    return f"{value:g}" if isinstance(value, float) else f"{value}"


def _list_instruments(run: ReportData) -> Rows:
    return [
        (
            row.channel,
            row.instrument or "not stated",
            row.serial,
            row.sensitivity,
            row.calibrated or "not stated",
            f"{row.due}, OVERDUE" if row.overdue else row.due,
        )
        for row in build_sensor_rows(run.recording.start)
    ]


def _list_results(run: ReportData) -> tuple[Rows, tuple[str, ...]]:
    """Return (rows, headers) of what was demanded and achieved."""
    summary = run.summary
    if summary.swept_sine is not None:
        swept = summary.swept_sine
        rows = [
            ("Passes", f"{swept.passes} of {swept.planned_passes}"),
            ("Level measured on", ", ".join(swept.control_channels)),
            (f"Time within ±{100 * swept.tolerance:g} %", f"{100 * swept.inside:.2f} %"),
            ("Least achieved over demanded",
             f"{swept.lowest_ratio:.3f} at {swept.lowest_hz:.4g} Hz"),
            ("Largest achieved over demanded",
             f"{swept.highest_ratio:.3f} at {swept.highest_hz:.4g} Hz"),
            ("Time with a reduced level", f"{100 * swept.notched:.2f} %"),
            *(
                (f"Resonance, pass {entry.sweep + 1} {entry.direction}",
                 f"{entry.frequency_hz:.4g} Hz, {entry.amplification:.3g} times the level")
                for entry in swept.resonances
            ),
        ]  # fmt: skip
        return rows, ()
    if summary.tracking is not None:
        required = summary.tracking.required_spectrum
        rows = [("Table against its target", format_tracking(summary.tracking))]
        if required is not None and required.outside is not None:
            rows += [
                ("Required spectrum", format_required(required)),
                ("Ordinates at 1/6 octave", f"{required.count}, {required.outside} outside"),
                ("Tolerance", f"{required.lower:g} to {required.upper:g} of the required"),
                ("Least and largest ratio",
                 f"{required.lowest_ratio or 0.0:.3f} at {required.lowest_hz or 0.0:.3g} Hz, "
                 f"{required.highest_ratio or 0.0:.3f} at {required.highest_hz or 0.0:.3g} Hz"),
            ]  # fmt: skip
        return rows, ()
    headers = ("f in Hz", "direction", "demanded in g", "achieved in g", "error")
    errors = {step.index: error for error, step in list_level_errors(summary.steps)}
    return [
        (
            f"{step.frequency_hz:g}",
            step.direction,
            f"{step.demanded_m_s2 / GRAVITY_M_S2:.4f}",
            f"{step.table_acc_fundamental_m_s2 / GRAVITY_M_S2:.4f}",
            f"{100 * errors[step.index]:+.1f} %" if step.index in errors else "not known",
        )
        for step in run.steps
    ], headers


def _list_deviations(run: ReportData) -> list[str]:
    """List what departs from the plan of the test; a sentence if nothing does."""
    summary, recording = run.summary, run.recording
    lines = []
    if summary.verdict != "complete":
        lines.append(f"The test was {summary.verdict}: {summary.reason}.")
    lines += [f"Protection: {trip.text}." for trip in summary.trips]
    excitation = summary.excitation_verdict
    if excitation is not None and excitation.verdict == "missed":
        lines.append(f"The excitation was missed: {excitation.reason}.")
    swept = summary.swept_sine
    if swept is not None and swept.notched:
        names = sorted({point.limited_by for point in swept.points} - {""})
        lines.append(
            f"The level was reduced for {100 * swept.notched:.3g} % of the time by the limit of "
            f"{', '.join(names)}."
        )
    lines += [f"{each.kind.capitalize()}: {each.text}." for each in summary.alarms[:MAX_ALARMS]]
    if len(summary.alarms) > MAX_ALARMS:
        lines.append(f"{len(summary.alarms) - MAX_ALARMS} further alarms are in the recording.")
    gaps = recording.records(SampleGap)
    if gaps or recording.missing_samples:
        lines.append(f"{len(gaps)} gaps in the samples, {recording.missing_samples} lost.")
    overdue = [row.channel for row in build_sensor_rows(recording.start) if row.overdue]
    if overdue:
        lines.append(f"Calibration overdue at the time of the test: {', '.join(overdue)}.")
    return lines or ["None."]


def write_customer_report(run: ReportData, folder: Path) -> tuple[Path, Path]:
    """Write customer.html and customer.pdf to a folder; return their paths."""
    report = build_customer_report(run)
    page, sheet = folder / "customer.html", folder / "customer.pdf"
    pictures = save_figures(iter(report.figures), folder / "figures")
    images = embed_images(pictures)
    template = Path(__file__).with_name("customer_report.html")
    page.write_text(render_page(template, report=report, images=images), encoding="utf-8")
    with mpl.rc_context(RC_PARAMS | {"pdf.fonttype": 42}), PdfPages(sheet) as pdf:
        writer = _SheetWriter(pdf, report.title)
        writer.write_cover(report)
        for section in report.sections:
            writer.write_section(section)
            if section.title == "Demand and achieved":
                for figure, picture in zip(report.figures, pictures, strict=True):
                    writer.write_figure(figure, picture)
        writer.write_signatures(report.signatures)
        writer.close()
    return page, sheet


class _SheetWriter:
    """Writes text, tables and figures from top to bottom of A4 sheets, with numbers and a title."""

    def __init__(self, pdf: PdfPages, title: str) -> None:
        self._pdf, self._title, self._number = pdf, title, 0
        self._figure = self._open()

    def _open(self) -> Figure:
        self._number += 1
        figure = Figure(figsize=PAGE_IN)
        figure.set_layout_engine("none")
        figure.text(MARGIN, 0.04, self._title, size=7, color="#666666", parse_math=False)
        figure.text(1 - MARGIN, 0.04, f"{self._number}", size=7, ha="right", color="#666666")
        self._y = 1.0 - MARGIN
        return figure

    def close(self) -> None:
        """Write the last sheet."""
        self._save()

    def _save(self) -> None:
        self._pdf.savefig(self._figure)  # type: ignore[no-untyped-call]

    def _need(self, height: float) -> None:
        if self._y - height < MARGIN:
            self._save()
            self._figure = self._open()

    def _write(self, text: str, x: float = 0.0, size: float = 8.5, weight: str = "normal") -> None:
        self._figure.text(
            MARGIN + x, self._y, text, size=size, weight=weight, va="top", parse_math=False
        )

    def write_cover(self, report: CustomerReport) -> None:
        """Write the title page."""
        self._y = 0.72
        for line in textwrap.wrap(report.title, 40):
            self._write(line, size=20, weight="bold")
            self._y -= 0.035
        self._write("Test report", size=12)
        self._y -= 0.05
        self._write_rows(report.cover)
        self._y -= LINE
        self._write_lines([report.verdict])
        self._need(1.0)

    def write_section(self, section: ReportSection) -> None:
        """Write the heading, table and lines of a section."""
        self._need(6 * LINE)
        self._y -= LINE
        self._write(section.title, size=12, weight="bold")
        self._y -= 1.8 * LINE
        if section.headers:
            self._write_rows([section.headers], weight="bold")
        self._write_rows(section.rows)
        self._write_lines(section.lines)

    def _write_lines(self, lines: Sequence[str]) -> None:
        for line in lines:
            for part in textwrap.wrap(line, 100):
                self._need(LINE)
                self._write(part)
                self._y -= LINE

    def _write_rows(self, rows: Rows, weight: str = "normal") -> None:
        """Write rows of cells in columns of equal width; of two, the second is wider."""
        for row in rows:
            width = (1.0 - 2 * MARGIN) / len(row)
            places = [0.0, 0.3] if len(row) == 2 else [width * k for k in range(len(row))]
            size = 8.5 if len(row) <= 3 else 7.0
            room = [34, 52] if len(row) == 2 else [round(150 / len(row))] * len(row)
            cells = [textwrap.wrap(c, n) or [""] for c, n in zip(row, room, strict=True)]
            for number in range(max(map(len, cells))):
                self._need(LINE)
                for place, parts in zip(places, cells, strict=True):
                    if number < len(parts):
                        self._write(parts[number], place, size, weight)
                self._y -= LINE

    def write_figure(self, figure: CaptionedFigure, picture: Picture) -> None:
        """Write a figure in the width of the sheet, with its title."""
        assert isinstance(figure.figure, PanelFigure)
        width_in, height_in = figure.figure.size_in
        width = 1.0 - 2 * MARGIN
        height = width * height_in / width_in * PAGE_IN[0] / PAGE_IN[1]
        self._need(height + 4 * LINE)
        self._y -= LINE
        self._write(picture.title, weight="bold")
        self._y -= 1.3 * LINE
        grid = self._figure.add_gridspec(
            3, 3, wspace=0, hspace=0, width_ratios=(MARGIN, width, MARGIN),
            height_ratios=(1.0 - self._y, height, self._y - height),
        )  # fmt: skip
        with mpl.rc_context(scale_style(width * PAGE_IN[0] / width_in)):
            draw_panels(figure.figure, self._figure.add_subfigure(grid[1, 1]))
        self._y -= height + LINE

    def write_signatures(self, names: Sequence[str]) -> None:
        """Write a line to sign on for each name."""
        self._need((4 + 4 * len(names)) * LINE)
        self._y -= LINE
        self._write("Signatures", size=12, weight="bold")
        for name in names:
            self._y -= 4 * LINE
            self._write("_" * 40)
            self._write("_" * 22, 0.5)
            self._y -= LINE
            self._write(name, size=7.5)
            self._write("date", 0.5, size=7.5)
