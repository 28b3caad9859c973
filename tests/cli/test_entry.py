"""Orders to a running test: what is sent without the command line, and what it parses."""

import sys
from pathlib import Path

import pytest

from twin.cli import entry
from twin.cli.table import announce_first_start
from twin.live import control
from twin.live.cli import RunCommand
from twin.transport.endpoint import DEFAULT_ENDPOINT

SENT = [
    ("control stop", ("stop", "", DEFAULT_ENDPOINT, "simulated")),
    ("control hold --why tired --rig big", ("hold", "tired", DEFAULT_ENDPOINT, "big")),
    ("control abort --connect tcp/[::1]:9", ("abort", "", "tcp/[::1]:9", "simulated")),
]
PARSED = ["", "run stop", "control", "control --help", "control stop --why", "control sotp",
          "control stop --keys folder", "control --why x stop"]  # fmt: skip


@pytest.mark.parametrize(("line", "order"), SENT)
def test_an_order_is_sent_at_once(
    line: str, order: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    orders = []
    monkeypatch.setattr(control, "send_command", lambda *words: orders.append(words))
    assert entry.send_order(line.split())
    assert orders == [order]


@pytest.mark.parametrize("line", PARSED)
def test_the_command_line_parses_all_else(line: str) -> None:
    assert not entry.send_order(line.split())


def test_the_orders_are_those_of_the_command_line() -> None:
    assert set(entry.ORDERS) == set(RunCommand)


def test_an_order_to_nobody_is_an_input_error(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["shaketwin", "control", "stop", "--connect", "udp/x"])
    with pytest.raises(SystemExit, match="2"):
        entry.run_words(sys.argv[1:])
    assert "udp/x" in capsys.readouterr().err


def test_whatever_fails_an_order_to_a_moving_table_names_the_way_out(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("session closed")

    monkeypatch.setattr("sys.argv", ["shaketwin", "control", "stop"])
    monkeypatch.setattr(control, "request_command", fail)
    with pytest.raises(SystemExit, match="2"):
        entry.run_words(sys.argv[1:])
    error = capsys.readouterr().err
    assert "session closed" in error
    assert "emergency stop" in error


@pytest.mark.parametrize(("command", "expected"), [("run", True), ("list", False)])
def test_only_the_first_start_of_what_computes_is_announced(
    command: str,
    expected: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("sys.argv", ["shaketwin", command])
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kernels"))
    announce_first_start()
    assert bool(capsys.readouterr().err) == expected
    (tmp_path / "kernels").mkdir()
    announce_first_start()
    assert capsys.readouterr().err == ""
