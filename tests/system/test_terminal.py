"""What the terminal shows, where results go, and what is said while kernels compile."""

import io
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import segno
from rich.console import Console
from rich.table import Table

from table_io.config.folders import find_config
from table_io.records import Event, Fault, NormalizedResponse, PrcPoint, SampleGap
from tests.input_errors import raises_input_error
from tests.reports.recordings import summary
from twin.inspection.curves import print_prc
from twin.results.contracts import RunSummary
from twin.setup import folders, warm_up
from twin.setup.folders import make_output_folder, make_run_folder
from twin.setup.run_config import read_run_config
from twin.system import terminal
from twin.system.progress import GAP_SERIES_SAMPLES, RunProgress


def print_lines(width: int) -> list[str]:
    """The PRC of the summary at hand, as lines of a terminal of this width."""
    out = io.StringIO()
    print_prc(Console(file=out, width=width), RunSummary.model_validate(summary()))
    return out.getvalue().splitlines()


@pytest.mark.parametrize("width", [40, 48, 52, 64, 80, 100, 130, 400])
def test_curves_are_readable_at_any_width(width: int) -> None:
    lines = print_lines(width)
    assert all(len(line) <= width for line in lines)
    assert not any("…" in line for line in lines)
    steps = [line for line in lines if re.search(r"(forward|backward).* \d\.\d{3}", line)]
    assert len(steps) == 8
    for line, step in zip(steps, summary()["steps"], strict=True):
        assert f"{step['measured']['eta_d']:.3f} | {step['twin']['eta_d']:.3f}" in line


def test_a_line_each_where_no_table_fits() -> None:
    lines = print_lines(24)
    assert any(line.startswith("  direction forward: f [Hz] 1.000, eta_d 0.123 | 0.136")
               for line in lines)  # fmt: skip


def test_omitted_columns_are_announced_on_terminals_only() -> None:
    assert any("--json" in line for line in print_lines(60))
    wide = print_lines(terminal.FILE_COLUMNS)
    assert not any("--json" in line for line in wide)
    assert any("impacts L" in line and "eta_R" in line for line in wide)


def test_a_table_without_room_is_a_line_a_row() -> None:
    table = Table("sensor", "most", "used", title="sensors")
    table.add_row("mass_acc_m_s2", "0.48 g", "10 %")
    table.add_row("table_disp_m", "49.7 mm", "")
    out = io.StringIO()
    terminal.print_table(Console(file=out, width=20), table)
    assert out.getvalue().splitlines() == [
        "sensors", "  sensor mass_acc_m_s2: most 0.48 g, used 10 %",
        "  sensor table_disp_m: most 49.7 mm",
    ]  # fmt: skip


def test_two_runs_of_one_second_have_folders_and_names_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(folders, "make_run_id", lambda name: f"20250101-000000-{name}")
    made = [make_run_folder(None, "quick") for _ in range(3)]
    names = ["20250101-000000-quick", "20250101-000000-quick-2", "20250101-000000-quick-3"]
    assert [folder for folder, _ in made] == [Path("runs") / name for name in names]
    assert [run for _, run in made] == names
    assert make_run_folder(tmp_path / "mine", "quick") == (tmp_path / "mine", names[0])


def test_a_folder_with_content_is_refused_an_empty_one_taken(tmp_path: Path) -> None:
    assert make_output_folder(tmp_path, "x") == tmp_path
    (tmp_path / "mine").touch()
    for folder, problem in ((tmp_path, "has content"), (Path("/dev/null/x"), "cannot write here")):
        with raises_input_error(key="--out", value=str(folder), problem=problem, remedy="give a"):
            make_output_folder(folder, "x")


def test_two_commands_never_write_into_one_folder(tmp_path: Path) -> None:
    out = tmp_path / "out"
    code = f"""
from pathlib import Path
from twin.setup.folders import make_output_folder
make_output_folder(Path({str(out)!r}), "")
print("mine", flush=True)
input()
"""
    other = subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert other.stdout is not None
    assert other.stdout.readline() == "mine\n"
    with raises_input_error(key="--out", value=str(out)):
        make_output_folder(out, "")
    other.communicate("\n", timeout=60)
    assert make_output_folder(out, "") == out, "the other has ended and left nothing"


def test_only_a_long_wait_is_announced(capsys: pytest.CaptureFixture[str]) -> None:
    before = signal.getsignal(signal.SIGALRM)
    with terminal.announce_if_slow("compiling", 0.05):
        pass
    time.sleep(0.1)
    assert capsys.readouterr().out == ""
    with terminal.announce_if_slow("compiling", 0.05):
        time.sleep(0.2)
    assert capsys.readouterr().out == "compiling\n"
    assert signal.getsignal(signal.SIGALRM) is before


def test_compile_kernels_compiles_all_a_command_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the cache holds: a part of it is not the whole."""
    warmed: list[str] = []
    monkeypatch.setattr(warm_up, "compile_twin_kernels", lambda: warmed.append("twin"))
    monkeypatch.setattr(warm_up, "compile_rig_kernels", lambda bundle: warmed.append("rig"))
    bundle = read_run_config(find_config("quickstart", "tests"))
    warm_up.compile_kernels(bundle)
    assert warmed == ["twin"]
    warm_up.compile_kernels(bundle, table=True)
    assert warmed == ["twin", "rig", "twin"]


def test_texts_of_a_remote_twin_are_printable() -> None:
    quantities = NormalizedResponse(1.0, 1.0, 1.0, 1.0, 1.0, 1.0, (), (), 0.0, 0.0)
    evil = "\x1b[2J\x1b]0;owned\x07\nstate: at rest\u202e"
    out = io.StringIO()
    show = RunProgress(Console(file=out), 3, 100)
    show(PrcPoint(1, 1, evil, 1.0, quantities, quantities, 1.0, 1.0, 0.0))
    show(Fault(1, "twin", 0, 1, evil))
    show(Event(1, "drift", evil))
    lines = out.getvalue().splitlines()
    assert all(line.isprintable() for line in lines)
    assert [line[:12] for line in lines[2:]] == [f"{'':>7}  fau", f"{'':>7}  dri"]


def test_first_gap_of_a_series_is_shown_with_a_note() -> None:
    """A sensor off its range brings one a block; another channel, or the next series, is new."""
    out = io.StringIO()
    show = RunProgress(Console(file=out, width=200), 3, 100)
    for index in range(0, 6000, 20):
        show(SampleGap(index, 20, "mass_disp_m", "clipped"))
        if index == 3000:
            show(SampleGap(index, 5, "force_r1_n", "clipped"))
            show(SampleGap(index, 7, "mass_disp_m", "lost"))
    show(SampleGap(6000 + GAP_SERIES_SAMPLES, 3, "mass_disp_m", "clipped"))
    shown = [line.split("gap: ")[1].split() for line in out.getvalue().splitlines()]
    assert [(words[0], words[3], words[4].strip(";")) for words in shown] == [
        ("20", "mass_disp_m", "clipped"), ("more", "mass_disp_m", "clipped"),
        ("5", "force_r1_n", "clipped"), ("7", "mass_disp_m", "lost"),
        ("3", "mass_disp_m", "clipped"),
    ]  # fmt: skip


def test_a_qr_code_is_drawn_module_by_module() -> None:
    text = "https://rig.lab.example:7480/#abcd-efgh"
    lines = terminal.draw_qr_code(text)
    halves = {"█": (0, 0), "▀": (0, 1), "▄": (1, 0), " ": (1, 1)}
    drawn = [[halves[cell][half] for cell in line] for line in lines for half in (0, 1)]
    modules = [[*row] for row in segno.make(text, error="l").matrix_iter(border=2)]
    assert drawn[: len(modules)] == modules
    assert not any(map(any, drawn[len(modules) :]))


@pytest.mark.parametrize("is_terminal", [True, False])
def test_status_of_a_silent_phase_is_shown_on_terminals_only(
    is_terminal: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = io.StringIO()
    monkeypatch.setattr(
        terminal, "console", Console(file=out, force_terminal=is_terminal, width=80)
    )
    with terminal.show_status("drawing") as show_part, terminal.show_status("inside"):
        show_part("[curves]")
        time.sleep(0.2)
    assert ("drawing: [curves]" in out.getvalue()) == is_terminal
    if not is_terminal:
        assert out.getvalue() == ""
