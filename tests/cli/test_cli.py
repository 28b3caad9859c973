"""The command line as its user meets it: what it refuses, how it says so, and what it leaves.

Each kind of outcome is seen once from a process of its own; the rest call `main` in this one.
"""

import json
import os
import re
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest
from mcap.writer import Writer

from tests.builders.profiles import format_test
from tests.command_line import call_main
from twin.cli import table as cli

SHAKETWIN = str(Path(sys.executable).parent / "shaketwin")
ROOT = Path(__file__).resolve().parents[2]
SHORT = format_test(3.4, 3.6, 0.2)


def shaketwin(*words: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [SHAKETWIN, *map(str, words)],
        capture_output=True,
        text=True,
        cwd=cwd,
        check=False,
    )


def require_refusal(result: subprocess.CompletedProcess[str], *words: str) -> None:
    """Exit code 2, one message that holds the words, no traceback."""
    assert result.returncode == 2, result.stdout + result.stderr
    assert "Traceback" not in result.stderr
    for word in words:
        assert word in result.stderr, result.stderr


@pytest.fixture
def profile(tmp_path: Path) -> Path:
    path = tmp_path / "short.toml"
    path.write_text(SHORT)
    return path


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of an unpaced run."""
    folder = tmp_path_factory.mktemp("recorded")
    (folder / "short.toml").write_text(SHORT)
    result = shaketwin("run", folder / "short.toml", "--speed", "max", "--out", folder / "out")
    assert result.returncode == 0, result.stderr
    return folder / "out"


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("cycles = 4", "cycels = 4", ["sweep.cycels", "did you mean 'cycles'?", "missing"]),
        ("[sweep]", "[sweep]\nacceleration_g = 2.0", ["step 0 (3.4 Hz forward)", "1 g"]),
        ("start_hz = 3.4", "start_hz = 0.4", ["displacement", "77.", "60 mm", "step 0 (0.4 Hz"]),
        ("[sweep]", "[sweep]\nacceleration_g = 1e-4", ["steps of the DAC", "at least 20"]),
        ("[specimen]", 'rig = "simulatd"\n[specimen]', ["simulatd", "did you mean 'simulated'?"]),
        ("[specimen]", 'model = "snn"\n[specimen]', ["snn", "did you mean 'snm'?"]),
        ("title", "title = =", ["not valid TOML"]),
    ],
)
def test_a_bad_profile_is_refused_before_anything_starts(
    old: str, new: str, words: list[str], profile: Path, tmp_path: Path
) -> None:
    profile.write_text(SHORT.replace(old, new, 1))
    require_refusal(call_main("run", profile, "--out", tmp_path / "out"), "short.toml", *words)
    assert not (tmp_path / "out").exists()


def test_every_fault_of_a_profile_is_said_at_once(profile: Path) -> None:
    profile.write_text(SHORT.replace("550.0", "-1").replace("cycles = 4", "cyclse = 4"))
    require_refusal(shaketwin("check", profile), "mass_kg", "cyclse", "sweep.cycles: missing")


def test_a_folder_with_content_is_refused_and_kept(profile: Path, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "run.mcap").write_bytes(b"precious")
    for command in (["run"], ["run", "--speed", "max"], ["simulate"]):
        result = call_main(command[0], profile, *command[1:], "--out", tmp_path / "out")
        require_refusal(result, "exists and has content")
    assert (tmp_path / "out" / "run.mcap").read_bytes() == b"precious"


def test_a_folder_that_cannot_be_written_is_refused(profile: Path) -> None:
    place = Path("/proc/shaketwin") if os.getuid() == 0 else Path("/shaketwin")
    require_refusal(call_main("run", profile, "--out", place), str(place), "cannot write here")


@pytest.mark.parametrize("command", ["replay", "prc", "view"])
def test_a_log_that_is_none_is_refused(command: str, run_folder: Path, tmp_path: Path) -> None:
    text, foreign, cut = tmp_path / "a.mcap", tmp_path / "b.mcap", tmp_path / "c.mcap"
    text.write_text("time_s,u\n0,1\n")
    with foreign.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel("/camera", "json", writer.register_schema("x", "", b""))
        writer.add_message(channel, 0, b"{}", 0)
        writer.finish()
    whole = (run_folder / "run.mcap").read_bytes()
    cut.write_bytes(whole[:40])
    files = set(tmp_path.iterdir())
    require_refusal(call_main(command, text, cwd=tmp_path), "not an MCAP file")
    require_refusal(call_main(command, foreign, cwd=tmp_path), "not a shaketwin log", "/camera")
    require_refusal(call_main(command, cut, cwd=tmp_path), str(cut))
    missing = call_main(command, tmp_path / "none.mcap", cwd=tmp_path)
    require_refusal(missing, "none.mcap", "No such file")
    assert set(tmp_path.iterdir()) == files


def test_a_truncated_log_still_shows_its_curve(run_folder: Path, tmp_path: Path) -> None:
    whole = (run_folder / "run.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: int(0.9 * len(whole))])
    result = call_main("prc", tmp_path / "cut.mcap", "--json")
    assert result.returncode == 0, result.stderr
    steps = json.loads(result.stdout)["steps"]
    full = json.loads((run_folder / "summary.json").read_text())["steps"]
    assert 0 < len(steps) < len(full)
    assert steps == full[: len(steps)]


def test_prc_says_the_numbers_of_the_summary(run_folder: Path) -> None:
    result = call_main("prc", run_folder, "--json")
    assert result.returncode == 0, result.stderr
    printed = json.loads(result.stdout)
    assert printed["steps"] == json.loads((run_folder / "summary.json").read_text())["steps"]
    table = call_main("prc", run_folder).stdout
    assert "3.400" in table
    assert f"{printed['steps'][0]['measured']['eta_d']:.3f}" in table


def test_prc_fits_a_narrow_terminal_and_a_file_is_not_cut(run_folder: Path) -> None:
    def read_curves(environment: Mapping[str, str]) -> str:
        # in a process of its own: the width is that of the stream at its start
        command = [SHAKETWIN, "prc", str(run_folder)]
        return subprocess.run(
            command, capture_output=True, text=True, check=True, env=dict(environment)
        ).stdout

    unset = {name: value for name, value in os.environ.items() if name != "COLUMNS"}
    narrow, file = read_curves({**unset, "COLUMNS": "40"}), read_curves(unset)
    assert max(map(len, narrow.splitlines()[:9])) <= 40
    assert "3.400" in narrow
    assert "impacts L" in file
    assert "…" not in file + narrow


@pytest.mark.parametrize(
    ("module", "slow"),
    [
        ("twin.cli.table", "numpy numba scipy pydantic matplotlib mcap zenoh rerun"),
        ("twin.guide.reference_command", "numba scipy matplotlib zenoh"),
        ("twin.live.control", "typer numpy numba pydantic rich google.protobuf ssl"),
        ("twin.inspection.folder_report", "matplotlib scipy.signal"),
    ],
)
def test_help_report_and_a_stop_order_import_nothing_slow(module: str, slow: str) -> None:
    """What is slow to import is imported by the command that needs it."""
    code = (
        f"import sys, twin.cli.entry, {module}; "
        f"print([name for name in {slow.split()} if name in sys.modules])"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == "[]"


@pytest.mark.parametrize(("command", "kept"), [("run", True), ("campaign", True), ("prc", False)])
def test_only_what_records_says_that_the_recording_is_kept(
    command: str, kept: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full() -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(cli, "app", full)
    monkeypatch.setattr(sys, "argv", ["shaketwin", command, "x"])
    with pytest.raises(SystemExit, match="2"):
        cli.main()
    message = capsys.readouterr().err
    assert "No space left on device" in message
    assert ("the recording is kept" in message) == kept


def test_replay_with_another_model_differs_and_says_by_how_much(
    run_folder: Path, tmp_path: Path
) -> None:
    text = (ROOT / "profiles" / "models" / "snm.toml").read_text()
    (tmp_path / "stiff.toml").write_text(text.replace("36000.0", "39600.0"))
    out = tmp_path / "out"
    result = call_main("replay", run_folder, "--model", tmp_path / "stiff.toml", "--out", out)
    assert result.returncode == 0, result.stderr
    summary = json.loads((out / "summary.json").read_text())
    assert not summary["replay"]["identical"]
    assert summary["replay"]["differing"] > 100
    before = summary["replay"]["recorded_comparison"]["rel_disp_m"]["nrmse"]
    assert summary["comparison"]["rel_disp_m"]["nrmse"] > 2 * before


@pytest.mark.parametrize("speed", ["0", "-1", "fast", "nan"])
def test_a_replay_speed_that_is_none_is_refused(speed: str, run_folder: Path) -> None:
    require_refusal(call_main("replay", run_folder, "--speed", speed), "--speed", "allowed: max")


def test_simulate_measures_nothing(profile: Path, tmp_path: Path) -> None:
    result = call_main("simulate", profile, "--out", tmp_path / "out")
    assert result.returncode == 0, result.stderr
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert [step["measured"] for step in summary["steps"]] == [None] * 4
    assert all(step["twin"]["eta_d"] > 0 for step in summary["steps"])
    assert (tmp_path / "out" / "report.html").exists()


def test_check_moves_nothing_and_draws_the_drive(profile: Path, tmp_path: Path) -> None:
    result = call_main("check", profile, "--out", tmp_path / "drive", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "ready: " in result.stdout
    assert (tmp_path / "drive" / "drive.png").stat().st_size > 10_000
    assert not (tmp_path / "runs").exists()


def test_no_monitor_no_view_where_nothing_runs() -> None:
    require_refusal(call_main("view", "--connect", "tcp/127.0.0.1:1"), "127.0.0.1:1")


@pytest.mark.parametrize(
    ("words", "remedy"),
    [
        (("control", "stopp"), "'stopp': did you mean 'stop'?"),
        (("run", "g4_ss1", "--speed", "fast"), "'fast': known: realtime, max"),
    ],
)
def test_wrong_word_is_answered_with_the_known_ones(words: tuple[str, ...], remedy: str) -> None:
    require_refusal(call_main(*words), remedy)


@pytest.mark.parametrize("name", ["run", "identify", "check"])
def test_help_names_values_for_people(name: str) -> None:
    text = call_main(name, "--help").stdout
    assert "TEXT" in text
    assert not re.search(r"<\w*(bool|str|path|list)", text)
