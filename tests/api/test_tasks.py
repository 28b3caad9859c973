"""A task is one function: the API is what the commands call, and returns what they write."""

import ast
import json
from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from table_io.config.base import PROFILES_DIR, format_toml
from table_io.config.provenance import Provenance
from tests.builders.rigs import read_model_text
from tests.command_line import call_main
from tests.sweeps.small_study import STUDY, read_stored_bytes, write_study
from twin import api
from twin.cli.table import COMMANDS
from twin.discovery.task import FittedModel
from twin.results.contract import format_json
from twin.system.files import hash_file

ROOT = Path(__file__).resolve().parents[2]
# The tasks of each command that computes.
TASKS = {
    "branches": ("follow_branches",),
    "calibrate": ("calibrate",),
    "check": ("check_test", "check_table"),
    "discover": ("discover", "discover_features", "decide"),
    "drive": ("export_drive",),
    "export": ("export_log",),
    "identify": ("identify",),
    "import": ("import_table",),
    "map": ("compute_map",),
    "compare": ("compare_runs",),
    "prc": ("read_curves",),
    "replay": ("replay",),
    "report": ("write_folder_report",),
    "runs": ("index_runs",),
    "record": ("compute_spectrum_records",),
    "catalog": ("update_catalog",),
    "fleet": ("run_fleet",),
    "note": ("note_run",),
    "simulate": ("simulate",),
    "table-drive": ("compute_drive",),
    "table-twin": ("identify_table",),
    "tare": ("tare",),
    "verify": ("verify", "repair_log"),
}


def list_called_names(module: str) -> set[str]:
    """Return the names of the functions that the modules in the folder of a module call."""
    folder = (ROOT / module.replace(".", "/")).parent
    trees = [ast.parse(path.read_text()) for path in folder.glob("*.py")]
    return {
        node.func.id
        for tree in trees
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    }


@pytest.mark.parametrize("command", TASKS)
def test_a_command_calls_the_function_of_the_api(command: str) -> None:
    """Which is defined once, in the rooms, and never in `twin.api`."""
    (row,) = (row for row in COMMANDS if row.name == command)
    module = row.target.partition(":")[0]
    for name in TASKS[command]:
        task = getattr(api, name)
        assert name in api.__all__
        assert task.__module__ != api.__name__
        assert name in list_called_names(task.__module__) | list_called_names(module)


def read_json(path: Path) -> dict[str, object]:
    """Return the content of a JSON file without what a clock measured."""
    content: dict[str, object] = json.loads(path.read_text())
    return content | {"seconds": 0}


def compare_branches(log: Path, folder: Path) -> tuple[object, object]:
    words = ("--from", 3.0, "--to", 3.2, "--out", folder / "shell")
    assert call_main("branches", "quickstart", *words).returncode == 0
    api.follow_branches(api.BranchOptions("quickstart", low=3.0, high=3.2, out=folder / "python"))
    returned, written = (folder / name / "branches.json" for name in ("python", "shell"))
    return returned.read_text(), written.read_text()


def compare_curves(log: Path, folder: Path) -> tuple[object, object]:
    result = call_main("prc", log, "--json")
    return format_json(api.read_curves(log).to_plain()), result.stdout.rstrip("\n")


def compare_comparisons(log: Path, folder: Path) -> tuple[object, object]:
    """With the page that is written next to it, and the index of both runs."""
    runs = [api.replay(log, folder / name).path.parent for name in ("first", "second")]
    assert call_main("compare", *runs, "--out", folder / "shell").returncode == 0
    compared = api.compare_runs(*runs)
    (folder / "python").mkdir()
    compared.write(folder / "python")
    listed = json.loads(call_main("runs", folder, "--json").stdout)["runs"]
    assert [run.to_columns() for run in api.index_runs(folder)] == listed
    returned, written = (
        [(folder / name / file).read_text() for file in ("comparison.json", "compare.html")]
        for name in ("python", "shell")
    )
    return returned, written


def compare_drives(log: Path, folder: Path) -> tuple[object, object]:
    assert call_main("drive", "quickstart", "-o", folder / "shell.csv").returncode == 0
    profile = PROFILES_DIR / "tests" / "quickstart.toml"
    api.export_drive(api.DriveOptions(profile, folder / "python.csv"))
    return (folder / "python.csv").read_text(), (folder / "shell.csv").read_text()


def compare_exports(log: Path, folder: Path) -> tuple[object, object]:
    words = ("--csv", "--channel", "rel_disp_m", "--steps", "1:2", "-o", folder / "shell")
    assert call_main("export", log, *words).returncode == 0
    options = api.ExportOptions(log, ("csv",), folder / "python", ("rel_disp_m",), (1, 2))
    assert api.export_log(options).rows > 1000
    return (folder / "python.csv").read_text(), (folder / "shell.csv").read_text()


@cache
def identify_once(log: Path) -> FittedModel:
    """Return what is identified from a recording, which takes seconds."""
    return api.identify([log])


def compare_fits(log: Path, folder: Path) -> tuple[object, object]:
    assert call_main("identify", log, "--out", folder / "shell.toml").returncode == 0
    fitted = identify_once(log)
    fitted.save_model(folder / "python.toml")
    report = json.loads(fitted.report.to_json()) | {"seconds": 0}
    written = read_json(folder / "shell" / "identify.json")
    return (
        ((folder / "python.toml").read_text(), report),
        ((folder / "shell.toml").read_text(), written),
    )


def compare_imports(log: Path, folder: Path) -> tuple[object, object]:
    api.export_log(api.ExportOptions(log, ("csv",), folder / "table"))
    words = ("--accept", "--profile", "quickstart", "-o", folder / "shell.mcap")
    result = call_main("import", folder / "table.csv", *words)
    assert result.returncode == 0, result.stderr
    imported = api.import_data(folder / "table.csv", folder / "python.mcap", profile="quickstart")
    other = api.open_log(folder / "shell.mcap")
    assert imported.start.steps == other.start.steps
    return imported.predicted.tobytes(), other.predicted.tobytes()


def compare_maps(log: Path, folder: Path) -> tuple[object, object]:
    study = write_study(folder, STUDY.replace("count = 6", "count = 2"))
    assert call_main("map", study, "--workers", 1, "--out", folder / "shell").returncode == 0
    stored = api.compute_map(api.MapOptions(study, folder / "python", workers=1))
    assert stored.is_complete
    return read_stored_bytes(stored.folder), read_stored_bytes(folder / "shell")


def compare_plans(log: Path, folder: Path) -> tuple[object, object]:
    """Of a test whose model was identified at another mass."""
    text = read_model_text("snm")
    provenance = Provenance(masses_kg=(700.0,), gaps_mm=(4.0,))
    (folder / "model.toml").write_text(text + format_toml({"provenance": provenance.model_dump()}))
    profile = (PROFILES_DIR / "tests" / "quickstart.toml").read_text()
    (folder / "test.toml").write_text(profile.replace('"snm"', '"model.toml"'))
    checked = api.check_test(folder / "test.toml")
    assert any("700 kg, the test has 550 kg" in warning for warning in checked.warnings)
    lines = call_main("check", folder / "test.toml").stdout.splitlines()
    shown = [line.partition(": ")[2] for line in lines if line.startswith("warning: ")]
    return [*checked.warnings], shown


def compare_sweeps(log: Path, folder: Path) -> tuple[object, object]:
    words = ("--gap", "4", "--gap", "inf", "--workers", 1, "--out", folder / "shell")
    assert call_main("simulate", "quickstart", *words).returncode == 0
    quickstart = PROFILES_DIR / "tests" / "quickstart.toml"
    options = api.SweepOptions(quickstart, gaps=("4", "inf"), workers=1, out=folder / "python")
    simulated = api.simulate_sweeps(options)
    written = read_json(folder / "shell" / "summary.json")
    tables = [(each / "batch.csv").read_text() for each in (simulated.folder, folder / "shell")]
    cases = json.loads(simulated.summary.to_json())["cases"]
    return (cases, tables[0]), (written["cases"], tables[1])


def compare_replays(log: Path, folder: Path) -> tuple[object, object]:
    assert call_main("replay", log, "--steps", "0:2", "--out", folder / "shell").returncode == 0
    replayed = api.replay(log, folder / "python", steps="0:2")
    written = api.open_log(folder / "shell").summary.to_plain()
    assert replayed.result.to_plain() == written["replay"]
    return drop_run(replayed.summary.to_plain()), drop_run(written)


def drop_run(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Return a summary without the name and date of its run."""
    return {**summary, "run": None}


def compare_reports(log: Path, folder: Path) -> tuple[object, object]:
    run = api.replay(log, folder / "run", steps="0:2").path.parent
    assert call_main("report", run).returncode == 0
    written = (run / "report.html").read_text()
    (page,) = api.write_folder_report(run)
    return page.read_text(), written


def compare_simulations(log: Path, folder: Path) -> tuple[object, object]:
    (folder / "test.toml").write_text(api.open_log(log).start.profile_toml)
    assert call_main("simulate", folder / "test.toml", "--out", folder / "shell").returncode == 0
    simulated = api.simulate(folder / "test.toml", folder / "python")
    written = api.open_log(folder / "shell").summary.to_plain()
    return drop_run(simulated.summary.to_plain()), drop_run(written)


def compare_repairs(log: Path, folder: Path) -> tuple[object, object]:
    (folder / "cut.mcap").write_bytes(log.read_bytes()[:-20_000])
    words = ("--repair", folder / "shell.mcap")
    assert call_main("verify", folder / "cut.mcap", *words).returncode == 4
    api.repair_log(api.verify(folder / "cut.mcap"), folder / "python.mcap")
    repaired, other = (api.open_log(folder / f"{name}.mcap") for name in ("python", "shell"))
    assert repaired.start == other.start
    return repaired["mass_disp_m"].tobytes(), other["mass_disp_m"].tobytes()


def compare_verifications(log: Path, folder: Path) -> tuple[object, object]:
    result = call_main("verify", log, "--json")
    assert result.returncode == 0
    return format_json(asdict(api.verify(log).report)), result.stdout.rstrip("\n")


def compare_wirings(log: Path, folder: Path) -> tuple[object, object]:
    shown = json.loads(call_main("check", "--table", "simulated", "--json").stdout)["lines"]
    lines = api.check_table("simulated").lines
    return [(line.name, line.channel, line.verdict) for line in lines], [
        (line["name"], line["channel"], line["verdict"]) for line in shown
    ]


@pytest.mark.parametrize(
    "compare",
    [
        compare_branches,
        compare_comparisons,
        compare_curves,
        compare_drives,
        compare_exports,
        compare_fits,
        compare_imports,
        compare_maps,
        compare_plans,
        compare_repairs,
        compare_sweeps,
        compare_replays,
        compare_reports,
        compare_simulations,
        compare_verifications,
        compare_wirings,
    ],
)
def test_a_task_returns_what_its_command_writes(
    compare: Callable[[Path, Path], tuple[object, object]], log_file: Path, tmp_path: Path
) -> None:
    returned, written = compare(log_file, tmp_path)
    assert returned == written
    assert returned


def test_an_identified_model_states_its_recordings(log_file: Path) -> None:
    fitted = identify_once(log_file)
    log = api.open_log(log_file)
    source = f'sha256 = "{hash_file(log_file)}"'
    assert source in fitted.model_toml
    assert f"masses_kg = [{log.profile.specimen.mass_kg}]" in fitted.model_toml
