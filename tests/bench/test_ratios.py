"""Comparison of benchmark ratios with those that were kept: what it lets pass and what it names."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.bench.ratios import (
    KEPT_RATIOS,
    collect_ratios,
    find_regressions,
    format_table,
    format_times,
    read_benchmarks,
)


@pytest.mark.parametrize(
    ("ratio", "regressions"),
    [(1.0, []), (2.3, []), (2.5, ["a peer"]), (float("nan"), ["a peer"]), (None, ["a peer"])],
)
def test_a_growth_of_a_fifth_is_a_regression(ratio: float | None, regressions: list[str]) -> None:
    ratios = {"b peer": 5.0} | ({} if ratio is None else {"a peer": ratio})
    assert find_regressions(ratios, {"a peer": 2.0}) == regressions
    assert format_table(ratios, {"a peer": 2.0}).count("regression") == len(regressions)


def test_the_smallest_ratio_counts_and_the_page_has_the_times(tmp_path: Path) -> None:
    paths = [tmp_path / "first.json", tmp_path / "again.json"]
    for path, ratio in zip(paths, (0.25, 0.2), strict=True):
        benchmark = {
            "name": "test_sweep",
            "group": "solver",
            "extra_info": {"over_solve_ivp": ratio, "points": 200},
            "stats": {"min": 0.0012, "median": 1.5},
        }
        path.write_text(json.dumps({"benchmarks": [benchmark]}))
    assert collect_ratios(read_benchmarks(paths[:1])) == {"sweep solve_ivp": 0.25}
    assert collect_ratios(read_benchmarks(paths)) == {"sweep solve_ivp": 0.2}
    assert format_times(read_benchmarks(paths[:1])).splitlines()[-1] == (
        "| sweep | solver | 1.2 ms | 1.5 s | points 200 |"
    )


def test_the_kept_ratios_are_those_of_benchmarks() -> None:
    kept = json.loads(KEPT_RATIOS.read_text())
    texts = "".join(path.read_text() for path in Path(__file__).parent.glob("test_bench_*.py"))
    names = {name.split("[")[0].split(" ")[0] for name in kept}
    assert kept
    assert not [name for name in names if f"def test_{name}(" not in texts]


@pytest.mark.slow  # 5 s
def test_the_benchmarks_run_by_one_option(tmp_path: Path) -> None:
    """`--benchmark-only` alone: no other option of the folder's defaults is in its way."""
    test = "tests/bench/test_bench_model.py::test_one_block"
    command = [sys.executable, "-m", "pytest", test, "--benchmark-only", "-p", "no:cacheprovider"]
    command += [f"--benchmark-json={tmp_path / 'out.json'}", "--benchmark-max-time=0.01"]
    inherited = {k: v for k, v in os.environ.items() if not k.startswith("PYTEST")}
    ended = subprocess.run(
        command,
        check=False,
        cwd=KEPT_RATIOS.parents[1],
        env=inherited,
        capture_output=True,
        text=True,
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert json.loads((tmp_path / "out.json").read_text())["benchmarks"]
