"""Ratios of the benchmarks, kept over time: each is our time or size over a peer's of the same run.

A ratio hardly depends on the machine. Every benchmark states its own in `extra_info`, as
`over_PEER`, where less is better. `.ci/bench` runs them all and compares with `.ci/ratios.json`.

    pytest tests/bench --benchmark-only --benchmark-json=FILE
    python -m tests.bench.ratios FILE [--keep]
"""

import json
import sys
from pathlib import Path

KEPT_RATIOS = Path(__file__).parents[2] / ".ci" / "ratios.json"
PREFIX = "over_"
MAX_GROWTH = 0.2  # of a ratio, beyond which it is a regression


def read_ratios(path: Path) -> dict[str, float]:
    """Return the ratios of a file of pytest-benchmark by name: benchmark and peer."""
    return {
        f"{benchmark['name'].removeprefix('test_')} {key.removeprefix(PREFIX)}": float(value)
        for benchmark in json.loads(path.read_text())["benchmarks"]
        for key, value in benchmark["extra_info"].items()
        if key.startswith(PREFIX)
    }


def find_regressions(ratios: dict[str, float], kept: dict[str, float]) -> list[str]:
    """Return the names of the ratios that grew by more than MAX_GROWTH, or are missing."""
    return [
        name
        for name, value in kept.items()
        if name not in ratios or not ratios[name] <= (1 + MAX_GROWTH) * value
    ]


def format_table(ratios: dict[str, float], kept: dict[str, float]) -> str:
    """Return the page: a table in Markdown with every ratio, now and kept, and its change."""
    regressions = find_regressions(ratios, kept)
    lines = ["| benchmark, over its peer | now | kept | change |", "|---|---:|---:|---:|"]
    for name in sorted({*ratios, *kept}):
        value, before = ratios.get(name), kept.get(name)
        change = "" if value is None or before is None else f"{100 * (value / before - 1):+.0f} %"
        mark = " **regression**" if name in regressions else ""
        cells = ("" if number is None else f"{number:.3g}" for number in (value, before))
        lines.append(f"| {name} | {' | '.join(cells)} | {change}{mark} |")
    return "\n".join(lines)


def main() -> int:
    """Print the page; return 1 if a ratio regressed. With --keep the ratios are kept instead."""
    ratios = read_ratios(Path(sys.argv[1]))
    if "--keep" in sys.argv[2:]:
        KEPT_RATIOS.write_text(json.dumps(dict(sorted(ratios.items())), indent=1) + "\n")
    kept = json.loads(KEPT_RATIOS.read_text())
    print(format_table(ratios, kept))
    return 1 if find_regressions(ratios, kept) else 0


if __name__ == "__main__":
    raise SystemExit(main())
