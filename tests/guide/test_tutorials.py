"""Tutorials run as written, each cell, in a folder of its own; links and commands of the README."""

import json
import re
from pathlib import Path
from typing import Any

import matplotlib as mpl
import pytest
from matplotlib import pyplot as plt

from twin.cli.table import COMMANDS
from twin.guide.site import CHAPTERS, TUTORIALS_DIR

# Each runs a test and discovers or fits; the fast ones are enough to see that the interface holds.
SLOW_TUTORIALS = {"find-a-hidden-effect", "fit-a-specimen", "look-at-a-log"}
TUTORIALS = [
    pytest.param(path, id=path.stem, marks=[pytest.mark.slow] * (path.stem in SLOW_TUTORIALS))
    for path in sorted(TUTORIALS_DIR.glob("*.ipynb"))
]


def run_cells(path: Path) -> dict[str, Any]:
    """Run the code cells of a notebook in order; return its names."""
    names: dict[str, Any] = {"__name__": "__main__"}
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    codes = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    for number, cell in enumerate(codes):
        exec(compile(cell, f"{path.name}, cell {number}", "exec"), names)
    return names


@pytest.mark.parametrize("path", TUTORIALS)
def test_a_tutorial_runs(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with mpl.rc_context({"backend": "agg"}):
        names = run_cells(path)
        plt.close("all")
    match path.stem:
        case "find-a-hidden-effect":
            assert [effect.id for effect in names["verdict"].effects] == ["coulomb_friction"]
        case "fit-a-specimen":
            stiffness = names["fitted"].parameters["stiffness"]
            assert stiffness.low < 38500.0 * 1.001
            assert stiffness.high > 38500.0 * 0.999
            assert names["after"] < 0.5 * names["before"]
        case "import-your-csv":
            assert names["log"].units["mass_disp_m"] == "m"
        case "look-at-a-log":
            assert names["log"].stop.verdict == "complete"
        case "write-a-backend":
            assert names["displacement"].max() == pytest.approx(0.98 * names["command"].max())
        case "write-an-effect":
            assert names["swing_mm"].shape == names["frequencies"].shape


def test_every_tutorial_is_in_the_guide() -> None:
    listed = {page.markdown_path for chapter in CHAPTERS for page in chapter.pages}
    tutorials = set(TUTORIALS_DIR.glob("*.ipynb"))
    assert len(tutorials) == 6
    assert tutorials <= listed


ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text()
MAX_WORDS, MAX_ANIMATION_BYTES = 620, 1_500_000


def test_links_and_pictures_of_the_readme_exist() -> None:
    targets = [target for target in re.findall(r"\]\(([^)#]+)", README) if "://" not in target]
    assert len(targets) > 15
    assert [target for target in targets if not (ROOT / target).is_file()] == []
    pictures = [ROOT / target for target in targets if target.endswith((".png", ".webp"))]
    assert len(pictures) == 4
    assert max(path.stat().st_size for path in pictures) < MAX_ANIMATION_BYTES


def test_readme_is_short() -> None:
    text = re.sub(r"\]\([^)]*\)|```.*?```", "", README, flags=re.DOTALL)
    assert len(re.findall(r"\w[\w.'/-]*", text)) < MAX_WORDS


def test_commands_of_the_readme_exist() -> None:
    names = set(re.findall(r"(?:^|`|bin/)shaketwin ([a-z]+)", README, re.MULTILINE))
    assert {"run", "check", "discover", "guide"} <= names
    assert names <= {command.name for command in COMMANDS}


def test_the_line_of_the_tests_is_the_one_that_the_pipeline_looks_for() -> None:
    lines = re.findall(r"^python3 -m venv .* && \.venv/bin/pytest$", README, re.MULTILINE)
    assert len(lines) == 1
    pattern = (ROOT / ".ci" / "run").read_text()
    assert r"^python3 -m venv .* && \.venv/bin/pytest$" in pattern
