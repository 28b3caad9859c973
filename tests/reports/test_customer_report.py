"""Customer's report: what it states is what the recording holds, and its PDF is a whole file."""

from io import BytesIO
from pathlib import Path

import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_pdf import PdfPages

from tests.command_line import call_main
from tests.setup.test_swept_prediction import PROFILE
from twin.archive.query import index_runs
from twin.inspection.folder_report import write_folder_report
from twin.recording.reader import read_recording
from twin.report.customer_report import MARGIN, _SheetWriter, build_customer_report
from twin.report.report import load_report_data

TEXTS = """
[customer]
laboratory = "Shake & Co"
order = "$x_{$"
specimen = "Valve <7>"
signatures = ["A. Engineer"]
"""
WIDE = 'limits = [{ channel = "mass_acc_m_s2", limit = 1.2, action = "stop" }]'


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A swept sine that a limit stops early."""
    tmp = tmp_path_factory.mktemp("customer")
    lines = [WIDE if line.startswith("limits") else line for line in PROFILE.splitlines()]
    (tmp / "limited.toml").write_text("\n".join(lines) + TEXTS, encoding="utf-8")
    ended = call_main("run", tmp / "limited.toml", "--speed", "max", "--out", tmp / "run")
    assert ended.returncode == 3
    return tmp / "run"


def test_customer_report_states_texts_limits_and_the_stop(folder: Path) -> None:
    report = build_customer_report(load_report_data(folder, read_recording(folder / "run.mcap")))
    cover = {row[0]: row[1] for row in report.cover}
    assert cover["Laboratory"] == "Shake & Co"
    assert len(cover["Recording, SHA-256"]) == 64
    sections = {section.title: section for section in report.sections}
    assert ("Limit of mass_acc_m_s2", "1.2 m/s2: stop") in sections["Set-up"].rows
    assert ("Excitation: order of the passes", "forward") in sections["Set-up"].rows
    assert ("Excitation: lowest frequency", "0.8 Hz") in sections["Set-up"].rows
    assert [row[0] for row in sections["Instruments"].rows][:2] == ["drive_disp_m", "table_disp_m"]
    deviations = " ".join(sections["Deviations"].lines)
    assert "The test was aborted" in deviations
    assert "exceeds the limit of the test" in deviations
    assert report.signatures == ("A. Engineer",)


def test_sweep_that_was_stopped_is_no_whole_pass_on_any_surface(folder: Path) -> None:
    summary = load_report_data(folder, read_recording(folder / "run.mcap")).summary
    assert summary.swept_sine is not None
    assert summary.excitation_verdict is not None
    planned = summary.swept_sine.planned_passes
    assert summary.swept_sine.passes == planned - 1
    assert summary.excitation_verdict.verdict == "missed"
    assert f"{planned - 1} of {planned} passes" in summary.excitation_verdict.reason
    ends = summary.swept_sine.highest_ratio - 1.0, summary.swept_sine.lowest_ratio - 1.0
    assert summary.excitation_verdict.worst_error == max(ends, key=abs)
    (row,) = index_runs(folder.parent)
    assert row.level_g == pytest.approx(0.05)


def test_no_cell_of_two_columns_is_wider_than_the_sheet() -> None:
    """The longest that is stated, a hash in hexadecimal digits, wraps within the margins."""
    with BytesIO() as file, PdfPages(file) as pdf:
        writer = _SheetWriter(pdf, "Title")
        writer._write_rows([("Recording, SHA-256", "d" * 64)])
        figure = writer._figure
        renderer = FigureCanvasAgg(figure).get_renderer()
        ends = [text.get_window_extent(renderer).x1 / figure.bbox.width for text in figure.texts]
    assert max(ends) <= 1.0 - MARGIN + 1e-6


def test_customer_report_is_a_page_and_a_pdf(folder: Path) -> None:
    pages = write_folder_report(folder, for_customer=True)
    assert [page.name for page in pages] == ["report.html", "customer.html", "customer.pdf"]
    html = pages[1].read_text(encoding="utf-8")
    assert "Valve &lt;7&gt;" in html
    assert "http://" not in html.replace("http://www.w3.org", "")
    pdf = pages[2].read_bytes()
    assert pdf.startswith(b"%PDF")
    assert pdf.rstrip().endswith(b"%%EOF")
    assert pdf.count(b"/Type /Page\n") + pdf.count(b"/Type /Page ") >= 2
    assert "<img" in html
    assert b"/Subtype /Image" not in pdf  # its figures are vectors
