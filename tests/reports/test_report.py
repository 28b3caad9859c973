"""The report of a run: what it shows is what was recorded, whatever is missing."""

import csv
import math
import re
from dataclasses import replace
from pathlib import Path

import pytest

from table_io.block import Block
from table_io.errors import InputError
from table_io.records import Comparison, Event, Fault, RunStop, SampleGap, Timing
from tests.command_line import call_main
from tests.input_errors import raises_input_error
from tests.reports.folders import Drawn, Maker
from tests.reports.recordings import MEASURED, blocks, one_step, start_record, summary
from twin.campaign import STATE_FILE
from twin.drawing.page import format_significant
from twin.recording.mcap_log import write_items
from twin.recording.reader import read_recording
from twin.report.report import load_report_data, render_report, write_report
from twin.transport.codec import Item


def page(folder: Path) -> str:
    return write_report(folder).read_text(encoding="utf-8")


def bare(folder: Path) -> str:
    """The page without its pictures, which take their time."""
    return render_report(load_report_data(folder), [])


def words(html: str) -> str:
    """The page as a reader sees it, markup and pictures left out."""
    return " ".join(re.sub(r"<[^>]*>", " ", html).split())


def test_numbers_are_those_of_the_summary(run_folder: Maker) -> None:
    text = words(bare(run_folder()))
    for number in ("0.123", "0.136", "0.568", "0.0345", "0.212", "2 3 2", "1.23", "0.488", "2.15"):
        assert number in text
    for number in ("30.54", "2.057", "1.11", "2.22", "3.33", "5.1 %", "0.102"):
        assert number in text


def test_report_lists_jumps_and_hysteresis_below_the_verdict(run_folder: Maker) -> None:
    text = words(bare(run_folder()))
    assert "hysteresis right both 1.5 2" in text
    assert "jump 1 down forward 2 2.5" in text
    assert text.index("8 of 8 steps; right hysteresis 1.5 to 2 Hz") < text.index("What was run")


def test_page_refers_to_nothing_outside_itself(drawn_report: Drawn) -> None:
    assert not re.search(r"https?://|url\(|@import|<link|<script\s|<iframe", drawn_report.html)
    sources = re.findall(r'(?:src|href|srcset)="([^"]{0,22})', drawn_report.html)
    assert all(source.startswith(("data:", "#")) for source in sources)
    assert "default-src 'none'" in drawn_report.html


def test_markup_in_texts_and_events_is_escaped(run_folder: Maker) -> None:
    html = bare(run_folder([*blocks(), Event(3, "note", "<img src=x onerror=y>")]))
    assert "<script>alert" not in html
    assert "<img src=x" not in html
    assert "&lt;script&gt;alert" in html
    assert "&lt;img src=x onerror=y&gt;" in html
    assert "<h1>Quick &lt;i&gt;look&lt;/i&gt;</h1>" in html


def test_report_lists_gaps_faults_and_latencies(run_folder: Maker) -> None:
    items: list[Item] = [
        *blocks(), SampleGap(100, 7, "force_l2_n", "clipped"),
        Fault(500, "twin", 500, 750, "killed"),
        Timing(900, "recorder", 1.5, 4.25, 9.75, 3, 10, 0.1, "SCHED_FIFO"),
    ]  # fmt: skip
    text = words(bare(run_folder(items)))
    assert "0.200 100 7 force_l2_n clipped" in text
    assert "twin 1.000 1.500 killed" in text
    assert "recorder 1.50 4.25 9.75 3 10 10.0 SCHED_FIFO" in text
    assert "lab-host" in text
    assert "mass_disp_m – – – – – – – 0.0001250 m" in text


def test_stopped_before_the_first_step(run_folder: Maker) -> None:
    values = {**summary(), "steps": [], "jumps": [], "hysteresis": [], "verdict": "stopped"}
    text = words(page(run_folder([RunStop(0, "stopped", "operator")], values)))
    assert "0 of 8 steps" in text
    assert "No step was finished." in text


def test_stopped_after_one_step_and_a_recording_at_hand_is_not_read_again(
    run_folder: Maker,
) -> None:
    folder = run_folder(*one_step())
    recording = read_recording(folder / "run.mcap")
    (folder / "run.mcap").unlink()
    assert "1 of 8 steps" in words(write_report(folder, recording).read_text(encoding="utf-8"))


def test_missing_numbers_are_dashes(run_folder: Maker) -> None:
    values = summary()
    values["steps"][2]["measured"] = None
    values["steps"][3]["twin"]["eta_d"] = None
    values["steps"][4]["measured"]["eta_a"] = math.nan
    values["steps"][5].update(thd=None, table_acc_peak_m_s2=None)
    values.update(u_star_m=None, comparison={"rel_disp_m": {"nrmse": None}})
    values["timing"]["latency_ms"] = {"p50": None, "p99": None, "max": None}
    text = words(page(run_folder(run_summary=values)))
    assert not re.search(r"\bnan\b", text)
    assert "None" not in text.replace("None.", "")
    assert "u* = – mm" in text


def test_nothing_recorded_is_touched(run_folder: Maker) -> None:
    folder = run_folder(*one_step())
    before = [(folder / name).read_bytes() for name in ("run.mcap", "summary.json")]
    assert page(folder) == page(folder)
    assert [(folder / name).read_bytes() for name in ("run.mcap", "summary.json")] == before


@pytest.mark.parametrize("text", ["{", "[]", "{}", '{"run": {}, "verdict": "x", "steps": [1]}'])
def test_damaged_summary_is_one_message(run_folder: Maker, text: str) -> None:
    folder = run_folder()
    (folder / "summary.json").write_text(text)
    with pytest.raises(InputError) as refused:
        write_report(folder)
    assert refused.value.where == str(folder / "summary.json")
    assert refused.value.remedy


def test_a_missing_key_of_the_contract_is_named(run_folder: Maker) -> None:
    values = summary()
    del values["steps"][2]["direction"]
    with pytest.raises(InputError) as refused:
        write_report(run_folder(run_summary=values))
    assert refused.value.key == "steps.2.direction"


@pytest.mark.parametrize("name", ["summary.json", "run.mcap"])
def test_missing_file_is_named(run_folder: Maker, name: str) -> None:
    folder = run_folder()
    (folder / name).unlink()
    with raises_input_error(where=folder / name):
        write_report(folder)


def test_import_without_profile(run_folder: Maker, tmp_path: Path) -> None:
    start = replace(start_record(), profile_toml="", rig_toml="", model_toml="not = [toml")
    run_folder()
    (tmp_path / "run.mcap").unlink()
    write_items(tmp_path / "run.mcap", [start, *blocks()], start)
    assert "Specimen unknown" in words(bare(tmp_path))


def test_model_alone(run_folder: Maker) -> None:
    values = {**summary(("twin",)), "comparison": {}}
    items = [block for block in blocks() if not isinstance(block, Comparison) and block.index >= 0]
    folder = run_folder(
        [i for i in items if not (isinstance(i, Block) and i.stream == "meas")], values
    )
    text = page(folder)
    assert "nothing measured" in words(text)
    assert "0.136" in words(text)
    assert 'id="prc"' in text
    assert 'id="comparison"' not in text
    assert not (folder / "figures").exists()


def test_no_bumpers_no_force_pictures(run_folder: Maker) -> None:
    folder = run_folder(*one_step(MEASURED[:4]), gap="inf")
    text = words(page(folder))
    assert "no bumpers, free flight" in text
    assert "Impacts per forcing cycle" not in text
    assert "Bumper loops" not in text


@pytest.mark.parametrize("lost", ["mass_disp_m", "mass_acc_m_s2", "table_acc_m_s2", "force_l1_n"])
def test_a_lost_channel_never_stops_the_report(run_folder: Maker, lost: str) -> None:
    items, values = one_step(tuple(channel for channel in MEASURED if channel != lost))
    html = page(run_folder(items, {**values, "verdict": "complete"}))
    assert "<b>Test complete</b>" in html


@pytest.mark.parametrize(
    "value, text",
    [(0.12345, "0.123"), (12.345, "12.3"), (1234.5, "1234"), (0.0, "0"), (-0.5, "−0.500"),
     (None, "–"), (math.nan, "–"), (1.5e-12, "1.50·10^−12")],
)  # fmt: skip
def test_significant_digits(value: float | None, text: str) -> None:
    assert format_significant(value) == text


def test_the_steps_table_has_the_fundamental_with_its_error(run_folder: Maker) -> None:
    values = summary()
    for step in values["steps"]:
        step["table_acc_fundamental_m_s2"] = 1.02 * 0.49  # demanded: 0.49 m/s2
    text = words(bare(run_folder(run_summary=values)))
    assert "0.500 0.490 2.00 0.488 2.15" in text


def test_a_report_as_pdf_and_its_figures_in_all_formats(run_folder: Maker) -> None:
    folder = run_folder(*one_step())
    result = call_main("report", folder, "--format", "pdf", "--figures")
    assert result.returncode == 0
    assert (folder / "report.pdf").read_bytes().startswith(b"%PDF")
    pictures = {path.stem for path in (folder / "figures").glob("*.png")}
    for suffix in ("svg", "pdf", "csv"):
        assert {path.stem for path in (folder / "figures").glob(f"*.{suffix}")} == pictures
    with (folder / "figures" / "prc.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    first = [float(row["y"]) for row in rows if row["panel"] == "1" and row["x"] == "1.0"]
    assert first == pytest.approx([0.1234, 1.1 * 0.1234])  # measured, twin


def test_only_the_report_of_a_run_is_a_pdf(run_folder: Maker) -> None:
    folder = run_folder()
    (folder / STATE_FILE).write_text("{}")
    result = call_main("report", folder, "--format", "pdf")
    assert result.returncode == 2
    assert "--format pdf" in result.stderr
    assert not (folder / "report.pdf").exists()
