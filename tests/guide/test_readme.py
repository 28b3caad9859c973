"""The README: short, its links and pictures are there, its commands exist."""

import re
from pathlib import Path

from twin.cli.table import COMMANDS

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text()
MAX_WORDS, MAX_ANIMATION_BYTES = 620, 1_500_000


def test_its_links_and_pictures_are_there() -> None:
    targets = [target for target in re.findall(r"\]\(([^)#]+)", README) if "://" not in target]
    assert len(targets) > 15
    assert [target for target in targets if not (ROOT / target).is_file()] == []
    pictures = [ROOT / target for target in targets if target.endswith((".png", ".webp"))]
    assert len(pictures) == 4
    assert max(path.stat().st_size for path in pictures) < MAX_ANIMATION_BYTES


def test_it_is_short() -> None:
    text = re.sub(r"\]\([^)]*\)|```.*?```", "", README, flags=re.DOTALL)
    assert len(re.findall(r"\w[\w.'/-]*", text)) < MAX_WORDS


def test_its_commands_exist() -> None:
    names = set(re.findall(r"(?:^|`|bin/)shaketwin ([a-z]+)", README, re.MULTILINE))
    assert {"run", "check", "discover", "guide"} <= names
    assert names <= {command.name for command in COMMANDS}


def test_the_line_of_the_tests_is_the_one_that_the_pipeline_looks_for() -> None:
    lines = re.findall(r"^python3 -m venv .* && \.venv/bin/pytest$", README, re.MULTILINE)
    assert len(lines) == 1
    pattern = (ROOT / ".ci" / "run").read_text()
    assert r"^python3 -m venv .* && \.venv/bin/pytest$" in pattern
