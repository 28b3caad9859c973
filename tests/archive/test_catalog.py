"""The catalogue of an archive, the selection of runs from it, and notes on them."""

import json
import os
import shutil
import sys
import time
import urllib.error
import urllib.request
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from table_io.records import RunStart
from tests.command_line import call_main
from tests.input_errors import raises_input_error
from tests.monitor.browser import open_browser
from tests.reports.recordings import start_record, summary
from twin.archive import run_reading
from twin.archive.catalog import Catalog, update_catalog
from twin.archive.notes import RunNotes, note_run, read_notes
from twin.archive.page_server import serve_runs
from twin.archive.query import index_runs, select_by_comparisons
from twin.recording.mcap_log import write_items
from twin.recording.reader import read_start
from twin.report.run_index import find_run_folders

PROFILES = Path(__file__).parents[2] / "profiles"

GAPS_MM = (4.0, 4.0, 10.0, 30.0)
MISFITS = (1.0, 5.0, 6.0, 2.0)
EXPRESSIONS = {
    "gap_mm = 4 and twin_misfit > 3": ["run1"],
    "gap_mm <> 4 AND twin_misfit <= 6e0": ["run3", "run2"],
    "test = 'quick'": ["run3", "run2", "run1", "run0"],
    "'good' in tags": ["run2"],
    "note = 'it''s B2' and stiffness < 36100": ["run1"],
    "temperature_c > 0": [],  # unknown, which meets nothing
}
SQL = {"gap_mm = 10 or twin_misfit > 4.5": ["run2", "run1"], "len(tags) = 1": ["run1"]}


def state_run(number: int) -> dict[str, Any]:
    """Content of summary.json of a run whose gap, misfit and stiffness are known."""
    values = summary()
    estimate = {"value": 36e3 + number, "sd": 100.0, "drift": None, "drift_sd": None}
    twin_verdict = {
        "verdict": "agrees", "misfit": MISFITS[number], "misfit_worst": 9.0, "reason": "",
        "tolerance": "", "worst": None, "steps_outside": 0, "steps_judged": 8, "missing_jumps": [],
        "unexpected_jumps": [], "warnings": 0, "next_command": "",
    }  # fmt: skip
    info = {"started_at": f"2026-01-0{1 + number}T10:00:00", "gap_m": GAPS_MM[number] / 1e3}
    return values | {
        "run": values["run"] | info,
        "estimates": {"stiffness": estimate},
        "twin_verdict": twin_verdict,
    }


def write_run(folder: Path, number: int) -> None:
    """Write a recording without samples and the summary of the run."""
    start = replace(
        start_record(str(GAPS_MM[number])),
        rig_toml=(PROFILES / "rigs/simulated.toml").read_text(),
        model_toml=(PROFILES / "models/snm.toml").read_text(),
    )
    write_items(folder / "run.mcap", [start], start)
    (folder / "summary.json").write_text(json.dumps(state_run(number)))


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    """Four runs at two depths, two of them with notes."""
    for number in range(4):
        folder = tmp_path / ("year/month" if number % 2 else ".") / f"run{number}"
        folder.mkdir(parents=True)
        write_run(folder, number)
    note_run(tmp_path / "year/month/run1", "it's B2", tags=("later",))
    note_run(tmp_path / "run2", tags=("good", "later"))
    return tmp_path


def list_names(rows: list[Any]) -> list[str]:
    return [Path(row.folder).name for row in rows]


def test_catalogue_holds_a_row_a_run_and_a_row_a_step(archive: Path) -> None:
    pandas = pytest.importorskip("pandas")
    pytest.importorskip("duckdb")
    catalog = update_catalog([archive])
    assert (len(catalog.runs), catalog.steps, catalog.read) == (4, 32, 4)
    runs = pandas.read_parquet(archive / "catalog/runs.parquet").set_index("folder")
    assert list(runs.index) == ["year/month/run3", "run2", "year/month/run1", "run0"]
    first = runs.loc["year/month/run1"]
    assert (first["gap_mm"], first["twin_misfit"], first["note"]) == (4.0, 5.0, "it's B2")
    assert list(first["tags"]) == ["later"]
    assert first["stiffness_high"] - first["stiffness_low"] == pytest.approx(2 * 1.96 * 100.0)
    assert first["model_stiffness"] > 0
    assert first["rig"] == "simulated"
    assert len(first["sha256"]) == 64
    steps = pandas.read_parquet(archive / "catalog/steps.parquet")
    of_run = steps[steps["folder"] == "run2"].sort_values("step")
    expected = [step["measured"]["eta_d"] for step in summary()["steps"]]
    assert of_run["eta_d"].tolist() == expected
    assert of_run["impacts_right"].tolist() == pytest.approx([7 / 3] * 8)


def test_only_what_changed_is_read_again(archive: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("duckdb")
    before = update_catalog([archive])
    reads: list[Path] = []

    def note_read(path: Path) -> RunStart:
        reads.append(path)
        return read_start(path)

    monkeypatch.setattr(run_reading, "read_start", note_read)
    os.utime(archive / "run0/run.mcap", (1.0, 1.0))  # copied: another time, the same content
    os.utime(archive / "run2/summary.json", (1.0, 1.0))
    note_run(archive / "run2", "noted since")
    assert update_catalog([archive]).read == 0
    assert reads == []
    content = state_run(3)
    content["estimates"]["stiffness"]["value"] = 1e3
    content["steps"] = content["steps"][:3]
    (archive / "year/month/run3/summary.json").write_text(json.dumps(content))
    shutil.rmtree(archive / "run0")
    after = update_catalog([archive])
    assert reads == [archive / "year/month/run3/run.mcap"]
    assert (after.read, after.removed, after.steps) == (1, 1, 19)
    assert [row.values["stiffness"] for row in after.runs if row.values] == [1e3, 36002, 36001]
    assert after.runs[1].note == "noted since"
    assert after.runs[2].values == before.runs[2].values


def test_runs_and_single_logs_are_the_same_with_and_without_a_catalogue(archive: Path) -> None:
    """At any depth, and with a catalogue that is damaged."""
    pytest.importorskip("duckdb")
    shutil.move(archive / "run0", archive / "year/month/week/run0")
    for name in ("imported.mcap", ".trash/run.mcap"):
        (archive / name).parent.mkdir(exist_ok=True)
        shutil.copy(archive / "run2/run.mcap", archive / name)
    (archive / "run2/run.foxglove.mcap").write_bytes(b"an export")
    rows = index_runs(archive)
    names = ["run3", "run2", "run1", "run0", "imported.mcap"]
    assert list_names(rows) == names
    assert [row.problem for row in rows] == [None] * 5
    (single,) = (row for row in rows if row.folder == "imported.mcap")
    assert (single.gap_mm, single.verdict, single.rig) == (10.0, None, "simulated")
    update_catalog([archive])
    assert list_names(index_runs(archive)) == names
    assert find_run_folders(archive) == [archive / row.folder for row in rows[:-1]]
    (archive / "catalog/runs.ndjson").write_bytes(b'{"root": ".", "fol')
    assert list_names(index_runs(archive, "gap_mm = 10")) == ["run2", "imported.mcap"]


def test_a_recording_that_is_cut_off_is_a_problem(archive: Path) -> None:
    """The start can still be read of it, and the summary states a whole run."""
    log = archive / "run0/run.mcap"
    log.write_bytes(log.read_bytes()[:-1])
    rows = {Path(row.folder).name: row for row in index_runs(archive)}
    assert "cut off" in str(rows["run0"].problem)
    assert (rows["run0"].verdict, rows["run2"].problem) == ("complete", None)


def damage(archive: Path) -> None:
    """Damage each of four runs in another way."""
    (archive / "run0/summary.json").write_text('{"verdict": 3')
    (archive / "run2/run.mcap").write_bytes(b"no recording")
    content = state_run(1)
    (archive / "year/month/run1/summary.json").write_text(
        json.dumps(content | {"key_of_tomorrow": 1, "twin_verdict": None})
    )
    (archive / "year/month/run1/notes.toml").write_text("tags = 3")
    (archive / "year/month/run3/summary.json").unlink()


def test_damaged_and_other_runs_have_a_row_that_states_why(archive: Path) -> None:
    pytest.importorskip("duckdb")
    damage(archive)
    assert call_main("catalog", archive).returncode == 0
    rows = {Path(row.folder).name: row for row in index_runs(archive)}
    assert "cannot read the summary" in str(rows["run0"].problem)
    assert (rows["run0"].verdict, rows["run0"].gap_mm, rows["run0"].rig) == (None, 4.0, "simulated")
    assert "no start of the recording" in str(rows["run2"].problem)
    assert (rows["run2"].verdict, rows["run2"].gap_mm) == ("complete", 10.0)
    assert "notes.toml" in str(rows["run1"].problem)
    assert (rows["run1"].verdict, rows["run1"].twin_verdict) == ("complete", None)
    assert "file not found" in str(rows["run3"].problem)
    assert [row.problem for row in index_runs(archive, "test = 'quick'")].count(None) == 0


@pytest.mark.parametrize("expression", EXPRESSIONS)
def test_expressions_select_the_same_runs_with_and_without_duckdb(
    archive: Path, expression: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("duckdb")
    update_catalog([archive])
    assert list_names(index_runs(archive, expression)) == EXPRESSIONS[expression]
    rows = [row.to_columns() for row in index_runs(archive)]
    assert [Path(str(row["folder"])).name for row in select_by_comparisons(rows, expression)] == (
        EXPRESSIONS[expression]
    )
    monkeypatch.setitem(sys.modules, "duckdb", None)
    result = call_main("runs", archive / "year/month", "--json", "--where", expression)
    names = {row["folder"] for row in json.loads(result.stdout)["runs"]}
    assert names == {"run1", "run3"} & set(EXPRESSIONS[expression])


@pytest.mark.parametrize("expression", SQL)
def test_other_expressions_are_selected_by_duckdb(archive: Path, expression: str) -> None:
    pytest.importorskip("duckdb")
    update_catalog([archive])
    assert list_names(index_runs(archive, expression)) == SQL[expression]


def test_runs_that_changed_since_the_catalogue_are_selected_as_they_are(archive: Path) -> None:
    pytest.importorskip("duckdb")
    update_catalog([archive])
    content = state_run(0)
    content["twin_verdict"]["misfit"] = 7.0
    (archive / "run0/summary.json").write_text(json.dumps(content))
    assert list_names(index_runs(archive, "gap_mm = 4 and twin_misfit > 3")) == ["run1", "run0"]


@pytest.mark.parametrize(
    ("expression", "key"),
    [("gapmm = 4", "gapmm"), ("gap_mm = 'four'", "gap_mm"), ("test = 4", "test"),
     ("tags < 'a'", "tags"),
     ("gap_mm = 4 or gap_mm = 10", ""), ("gap_mm = 4 twin_misfit > 3", ""), ("", ""),
     ("gap_mm = 4 and", ""), ("read_text('/etc/passwd') = 'x'", "")],
)  # fmt: skip
def test_faulty_expressions_get_one_error(archive: Path, expression: str, key: str) -> None:
    """Without DuckDB what it would take, too, with the remedy."""
    rows = [row.to_columns() for row in index_runs(archive)]
    with raises_input_error(where="--where") as caught:
        select_by_comparisons(rows, expression)
    assert caught.value.key == key
    assert key or 'pip install "shaketwin[archive]"' in str(caught.value)


@pytest.mark.parametrize(
    "expression",
    ["gapmm = 4", "gap_mm = ", "", " ", "gap_mm = 4; DROP TABLE runs",
     "1 = 1); SELECT 99 AS number WHERE (1 = 1",
     "(SELECT count(*) FROM read_text('/etc/hostname')) = 1"],
)  # fmt: skip
def test_sql_that_is_no_expression_over_the_columns_is_refused(
    archive: Path, expression: str
) -> None:
    pytest.importorskip("duckdb")
    with raises_input_error(where="--where", value=expression):
        index_runs(archive, expression)


def test_several_folders_have_one_catalogue_elsewhere(archive: Path, tmp_path: Path) -> None:
    pytest.importorskip("duckdb")
    folders = [archive / "run0", archive / "year"]
    with raises_input_error(key="--out"):
        update_catalog(folders)
    with raises_input_error(where=archive / "run0"):
        update_catalog(folders, archive / "run0")
    catalog: Catalog = update_catalog(folders, tmp_path / "both")
    assert list_names(index_runs(catalog.folder)) == ["run3", "run1", "run0"]
    assert [row.folder for row in index_runs(tmp_path / "both", "twin_misfit = 1")] == ["../run0"]


def test_notes_stand_beside_what_was_recorded(archive: Path) -> None:
    run = archive / "run0"
    recorded = {path.name: path.read_bytes() for path in run.iterdir()}
    text = 'cell "R1" re-zeroed\n\tÅ \\ \x7f'
    assert note_run(run, text, ("a", "b", "a")).tags == ("a", "b")
    assert note_run(run, untag=("a",), tags=("c",)) == note_run(run)
    assert (note_run(run).note, note_run(run).tags) == (text, ("b", "c"))
    assert {name: (run / name).read_bytes() for name in recorded} == recorded
    with raises_input_error(where=run, key="--untag"):
        note_run(run, untag=("a",))
    with raises_input_error(where=run, key="--tag"):
        note_run(run, tags=("",))
    with raises_input_error(where=archive):
        note_run(archive, "no run here")


def test_the_page_filters_sorts_compares_and_shows_trends(archive: Path, tmp_path: Path) -> None:
    pytest.importorskip("duckdb")
    update_catalog([archive])
    page = tmp_path / "index.html"
    assert call_main("runs", archive, "--page", page).returncode == 0
    with open_browser(tmp_path / "profile") as browser:
        browser.open(page.as_uri(), width=420, dark=True)
        assert browser.evaluate("document.documentElement.scrollWidth") == 420
        shown = "lines.filter((line) => !line.hidden).map((line) => rowOf(line).folder).join()"
        browser.evaluate(
            "document.getElementById('filter').value = 'gap_mm<10 twin_misfit>=5'; filter()"
        )
        assert browser.evaluate(shown) == "year/month/run1"
        browser.evaluate("document.getElementById('filter').value = ''; filter()")
        browser.evaluate("table.tHead.querySelector('[data-key=twin_misfit] button').click()")
        assert browser.evaluate(shown) == "run2,year/month/run1,year/month/run3,run0"
        browser.evaluate("lines.slice(0, 2).forEach((line) => box(line).click())")
        pair = browser.evaluate("document.getElementById('chosen').textContent")
        assert "stiffness" in pair
        assert f"shaketwin compare '{archive / 'run2'}'" in pair
        browser.evaluate("box(lines[0]).click()")
        note = browser.evaluate("document.querySelector('#chosen pre').textContent")
        assert note == f"shaketwin note '{archive / 'year/month/run1'}'"
        circles = "document.querySelectorAll('#trend circle').length"
        assert browser.evaluate(circles) == 4
        browser.open(page.as_uri(), width=1280, dark=False)
        assert browser.evaluate("table.parentNode.scrollWidth <= table.parentNode.clientWidth")
        browser.evaluate("for (let k = 0; k < 60; k++) table.append(lines[3].cloneNode(true))")
        browser.evaluate("box(lines[0]).click()")
        end = "document.getElementById('chosen').getBoundingClientRect().bottom"
        assert browser.evaluate(f"{end} <= innerHeight"), "what was chosen is out of sight"
        assert browser.console == []


def test_notes_are_edited_on_the_served_page(archive: Path, tmp_path: Path) -> None:
    (archive / "run0" / "report.html").write_text("<p>the report</p>")
    note_run(archive / "run2", "old", ("kept", "gone"))
    with serve_runs(archive, None) as address, open_browser(tmp_path / "profile") as browser:
        browser.open(address, width=420, dark=True)
        assert browser.evaluate("document.documentElement.scrollWidth") == 420
        browser.evaluate("box(lines.find((line) => rowOf(line).folder === 'run2')).click()")
        browser.evaluate(
            "const [note, tags] = document.querySelectorAll('#chosen input');"
            "note.value = 'it\\'s <b>B2</b>'; tags.value = 'kept, new'"
        )
        browser.evaluate("document.querySelector('#chosen button').click()")
        saved = "document.querySelector('#chosen [role=status]').textContent"
        deadline = time.monotonic() + 20.0
        while browser.evaluate(saved) == "" and time.monotonic() < deadline:
            time.sleep(0.05)
        assert browser.evaluate(saved) == "Saved."
        assert read_notes(archive / "run2") == RunNotes("it's <b>B2</b>", ("kept", "new"))
        cell = "lines.find((line) => rowOf(line).folder === 'run2').querySelector('.remark')"
        assert browser.evaluate(f"{cell}.textContent") == "keptnewit's <b>B2</b>"
        assert browser.console == []
        note_run(archive / "run2", "by another person")
        browser.evaluate("document.querySelector('#chosen button').click()")
        while browser.evaluate(saved) == "Saved." and time.monotonic() < deadline:
            time.sleep(0.05)
        assert "noted on since" in browser.evaluate(saved)
    assert read_notes(archive / "run2").note == "by another person"


def test_the_served_page_writes_for_nobody_else(archive: Path) -> None:
    change = {"folder": "run2", "before": "", "note": "x", "tags": [], "untag": []}
    with serve_runs(archive, "gap_mm = 10") as address:
        origin = address[: address.index("/", 8)]

        def post(path: str = "note", origin: str = origin, host: str = "", **keys: Any) -> int:
            headers = {"Origin": origin} | ({"Host": host} if host else {})
            body = json.dumps(change | keys).encode()
            request = urllib.request.Request(address + path, body, headers)
            try:
                return int(urllib.request.urlopen(request, timeout=10).status)
            except urllib.error.HTTPError as error:
                return error.code

        assert post(origin="http://example.com") == 404
        assert post(host="example.com") == 404
        assert post("../note") == 404
        assert post(folder="run0") == 409  # not among those that are shown
        assert post(folder="../..") == 409
        assert post(note=1) == 400
        assert read_notes(archive / "run2") == RunNotes("", ("good", "later"))
        assert post() == 200
        assert urllib.request.urlopen(address, timeout=10).status == 200
        for path in (origin, f"{address}report?run0", f"{address}report?../../run0"):
            with pytest.raises(urllib.error.HTTPError):
                urllib.request.urlopen(path, timeout=10)
    assert read_notes(archive / "run2").note == "x"
