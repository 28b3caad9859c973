"""Every surface of a run shows one verdict: console, page, list of runs, comparison, demonstration.

Runs are those of `demo`, each with an effect hidden at random, with the model as it is.
"""

import html
import json
import re
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import pytest

from tests.command_line import call_main
from twin.demo.command import FIRST_RUN, read_twin_error, seal_effect

SEEDS = (1, 2, 3, 5, 7, 11)
MORE_SEEDS = tuple(range(12, 36))


@cache
def run_demo_rig(seed: int) -> tuple[Path, str]:
    """Folder of the first run of a demonstration, and what the console said."""
    folder = Path(mkdtemp())
    seal_effect(folder, seed)
    result = call_main(
        "run", "demo", "--table", folder / "rig.toml", "--speed", "max",
        "--out", folder / FIRST_RUN,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    return folder, result.stdout


def read_page(path: Path) -> str:
    """Words of a page."""
    text = re.sub(r"<(style|script).*?</\1>|<[^>]*>", " ", path.read_text(), flags=re.DOTALL)
    return re.sub(r"\s+", " ", html.unescape(text))


def check_surfaces(seed: int) -> None:
    folder, console = run_demo_rig(seed)
    run = folder / FIRST_RUN
    summary = json.loads((run / "summary.json").read_text())
    twin, excitation = summary["twin_verdict"], summary["excitation_verdict"]
    words = f"{twin['verdict']}: {twin['reason']}"
    misfit = f"{twin['misfit']:.2g} times the noise"
    page = read_page(run / "report.html").replace(" :", ":")

    assert f"twin {words}" in console
    assert f"Twin {words}" in page
    assert f"excitation {excitation['verdict']}: {excitation['reason']}" in console
    assert f"Excitation {excitation['verdict']}: {excitation['reason']}" in page
    assert f"misfit of u: {misfit}" in console
    assert misfit in page
    assert twin["next_command"].replace("DIR", str(run)) in console
    assert twin["next_command"].replace("DIR", str(run)) in page

    (row,) = json.loads(call_main("runs", run, "--json").stdout)["runs"]
    for key, value in (("twin_verdict", twin["verdict"]), ("misfit", twin["misfit"]),
                       ("misfit_worst", twin["misfit_worst"]),
                       ("excitation_verdict", excitation["verdict"])):  # fmt: skip
        assert row[key] == value, key
    (described, _) = json.loads(call_main("compare", run, run, "--json").stdout)["runs"]
    assert described["twin_verdict"] == twin["verdict"]
    assert described["misfit"].startswith(misfit)
    assert f"the twin {twin['verdict']}" in str(read_twin_error(run))
    assert misfit in str(read_twin_error(run))

    apart = [step for step in summary["steps"] if not step["branch"]["is_same"]]
    kinds = {warning["kind"] for warning in summary["warnings"]}
    if twin["verdict"] == "agrees":
        assert not apart
        assert not kinds & {"disagreement", "unexpected jump", "no jump"}
    if kinds & {"unexpected jump", "no jump"}:
        assert twin["verdict"] == "departs"
        assert twin["steps_apart"] > 0


@pytest.mark.parametrize("seed", SEEDS)
def test_surfaces_of_a_run_do_not_contradict_each_other(seed: int) -> None:
    check_surfaces(seed)


@pytest.mark.slow
@pytest.mark.parametrize("seed", MORE_SEEDS)
def test_surfaces_of_more_runs_do_not_contradict_each_other(seed: int) -> None:
    check_surfaces(seed)
