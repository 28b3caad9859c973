"""Ratios of the benchmarks, kept over time: each is our time or size over a peer's of the same run.

A ratio hardly depends on the machine. Every benchmark states its own in `extra_info`, as
`over_PEER`, where less is better. `.ci/bench` runs them all and compares with `.ci/ratios.json`.
Of several runs the smallest ratio counts: what a busy machine slowed down once is no regression.

    pytest tests/bench --benchmark-only --benchmark-json=FILE
    python -m tests.bench.ratios FILE... [--keep]
"""

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

CI_FOLDER = Path(__file__).parents[2] / ".ci"
KEPT_RATIOS, KEPT_PAGE = CI_FOLDER / "ratios.json", CI_FOLDER / "benchmarks.md"
PREFIX = "over_"
MAX_GROWTH = 0.2  # of a ratio, beyond which it is a regression
UNITS_S = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}


def read_benchmarks(paths: Sequence[Path]) -> list[dict[str, Any]]:
    """Return the benchmarks in files of pytest-benchmark."""
    return [benchmark for path in paths for benchmark in json.loads(path.read_text())["benchmarks"]]


def collect_ratios(benchmarks: list[dict[str, Any]]) -> dict[str, float]:
    """Return the smallest ratio of each by name: benchmark and peer."""
    ratios: dict[str, float] = {}
    for benchmark in benchmarks:
        for key, value in benchmark["extra_info"].items():
            if key.startswith(PREFIX):
                name = f"{_short_name(benchmark)} {key.removeprefix(PREFIX)}"
                ratios[name] = min(float(value), ratios.get(name, float(value)))
    return ratios


def _short_name(benchmark: dict[str, Any]) -> str:
    return str(benchmark["name"]).removeprefix("test_")


def find_regressions(ratios: dict[str, float], kept: dict[str, float]) -> list[str]:
    """Return the names of the ratios that grew by more than MAX_GROWTH, or are missing."""
    return [
        name
        for name, value in kept.items()
        if name not in ratios or not ratios[name] <= (1 + MAX_GROWTH) * value
    ]


def format_table(ratios: dict[str, float], kept: dict[str, float]) -> str:
    """Return a table in Markdown with every ratio, now and kept, and its change."""
    regressions = find_regressions(ratios, kept)
    lines = ["| benchmark, over its peer | now | kept | change |", "|---|---:|---:|---:|"]
    for name in sorted({*ratios, *kept}):
        value, before = ratios.get(name), kept.get(name)
        change = "" if value is None or before is None else f"{100 * (value / before - 1):+.0f} %"
        mark = " **regression**" if name in regressions else ""
        cells = ("" if number is None else f"{number:.3g}" for number in (value, before))
        lines.append(f"| {name} | {' | '.join(cells)} | {change}{mark} |")
    return "\n".join(lines)


def format_times(benchmarks: list[dict[str, Any]]) -> str:
    """Return a table in Markdown with the shortest time of every benchmark, and its own figures."""
    lines = ["| benchmark | group | shortest | median | figures |", "|---|---|---:|---:|---|"]
    for benchmark in sorted(benchmarks, key=lambda each: (each["group"] or "", each["name"])):
        stats, extra = benchmark["stats"], benchmark["extra_info"]
        times = (_format_time(stats[name]) for name in ("min", "median"))
        figures = ", ".join(
            f"{key} {value}" for key, value in extra.items() if not key.startswith(PREFIX)
        )
        name, group = _short_name(benchmark), benchmark["group"] or ""
        lines.append(f"| {name} | {group} | {' | '.join(times)} | {figures} |")
    return "\n".join(lines)


def _format_time(time_s: float) -> str:
    unit = next((unit for unit, size in UNITS_S.items() if time_s >= size), "ns")
    return f"{time_s / UNITS_S[unit]:.3g} {unit}"


def main() -> int:
    """Print the page; return 1 if a ratio regressed. With --keep ratios and page are kept."""
    benchmarks = read_benchmarks([Path(word) for word in sys.argv[1:] if word != "--keep"])
    ratios = collect_ratios(benchmarks)
    if "--keep" in sys.argv[1:]:
        KEPT_RATIOS.write_text(json.dumps(dict(sorted(ratios.items())), indent=1) + "\n")
    kept = json.loads(KEPT_RATIOS.read_text())
    page = (
        "# Benchmarks\n\n## Ratios to peers in the same run\n\n"
        f"{format_table(ratios, kept)}\n\n## Times\n\n{format_times(benchmarks)}\n"
    )
    if "--keep" in sys.argv[1:]:
        KEPT_PAGE.write_text(page)
    print(page)
    return 1 if find_regressions(ratios, kept) else 0


if __name__ == "__main__":
    raise SystemExit(main())
