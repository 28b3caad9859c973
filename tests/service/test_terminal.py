"""What the terminal shows, where results go, and what is said while kernels compile."""

import io
import re
import signal
import time
from pathlib import Path

import pytest
from rich.console import Console
from rich.table import Table

from table_io.card import BadInput, find
from table_io.records import Event, Fault, Point, Quantities
from twin.service import folders, kernels, terminal
from twin.service.bundle import read_bundle
from twin.service.folders import new_folder, new_run
from twin.service.prc_table import print_prc
from twin.service.progress import RunProgress

from .recordings import summary


def printed(width: int) -> list[str]:
    """The PRC of the summary at hand, as lines of a terminal of this width."""
    out = io.StringIO()
    print_prc(Console(file=out, width=width), summary())
    return out.getvalue().splitlines()


@pytest.mark.parametrize("width", [40, 48, 52, 64, 80, 100, 130, 400])
def test_curves_are_readable_at_any_width(width: int) -> None:
    lines = printed(width)
    assert all(len(line) <= width for line in lines)
    assert not any("…" in line for line in lines)
    steps = [line for line in lines if re.search(r"(forward|backward).* \d\.\d{3}", line)]
    assert len(steps) == 8
    for line, step in zip(steps, summary()["steps"], strict=True):
        assert f"{step['measured']['eta_d']:.3f} | {step['twin']['eta_d']:.3f}" in line


def test_a_line_each_where_no_table_fits() -> None:
    lines = printed(24)
    assert any(line.startswith("  direction forward: f [Hz] 1.000, eta_d 0.123 | 0.136")
               for line in lines)  # fmt: skip


def test_what_is_left_out_is_said_and_nothing_is_left_out_in_a_file() -> None:
    assert any("--json has it" in line for line in printed(60))
    wide = printed(terminal.WIDE)
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
    monkeypatch.setattr(folders, "run_id", lambda name: f"20250101-000000-{name}")
    found = [new_run(None, "quick") for _ in range(3)]
    names = ["20250101-000000-quick", "20250101-000000-quick-2", "20250101-000000-quick-3"]
    assert [folder for folder, _ in found] == [Path("runs") / name for name in names]
    assert [run for _, run in found] == names
    assert new_run(tmp_path / "mine", "quick") == (tmp_path / "mine", names[0])


def test_a_folder_with_content_is_refused_an_empty_one_taken(tmp_path: Path) -> None:
    assert new_folder(tmp_path, "x") == tmp_path
    (tmp_path / "mine").touch()
    with pytest.raises(BadInput, match="exists and has content"):
        new_folder(tmp_path, "x")


def test_only_a_long_wait_is_told(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    before = signal.getsignal(signal.SIGALRM)
    monkeypatch.setattr(terminal, "LONG_S", 0.05)
    with terminal.said_if_long("compiling"):
        pass
    time.sleep(0.1)
    assert capsys.readouterr().out == ""
    with terminal.said_if_long("compiling"):
        time.sleep(0.2)
    assert capsys.readouterr().out == "compiling\n"
    assert signal.getsignal(signal.SIGALRM) is before


def test_every_kernel_of_a_command_is_had_before_it_begins(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the cache holds: a part of it is not the whole."""
    warmed: list[str] = []
    monkeypatch.setattr(kernels, "warm_twin", lambda: warmed.append("twin"))
    monkeypatch.setattr(kernels, "warm_rig", lambda bundle: warmed.append("rig"))
    bundle = read_bundle(find("quickstart", "tests"))
    kernels.ready(bundle)
    assert warmed == ["twin"]
    kernels.ready(bundle, table=True)
    assert warmed == ["twin", "rig", "twin"]


def test_what_a_twin_elsewhere_writes_gives_no_orders_to_the_terminal() -> None:
    quantities = Quantities(1.0, 1.0, 1.0, 1.0, 1.0, 1.0, (), (), 0.0, 0.0)
    evil = "\x1b[2J\x1b]0;owned\x07\nstate: at rest\u202e"
    out = io.StringIO()
    show = RunProgress(Console(file=out), 3, 100)
    show(Point(1, 1, evil, 1.0, quantities, quantities, 1.0, 1.0, 0.0))
    show(Fault(1, "twin", 0, 1, evil))
    show(Event(1, "drift", evil))
    said = out.getvalue().splitlines()
    assert all(line.isprintable() for line in said)
    assert [line[:12] for line in said[2:]] == [f"{'':>7}  fau", f"{'':>7}  dri"]
