"""Report of a study: table.md with metrics and tables, metrics.json, and confusion.png."""

import json
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tests.studies.blind.comparison_tables import format_baseline_table, format_control_table
from tests.studies.blind.laboratory_report import (
    compute_laboratory_metrics,
    format_laboratory_tables,
)
from tests.studies.blind.rates import (
    Rate,
    StudyMetric,
    compute_calibration,
    compute_metrics,
    cross_tabulate,
    select_latest,
    select_usable,
)
from tests.studies.blind.scoring import select_worst_misses
from twin.results.summary import dump_strict_json

Json = dict[str, Any]
RESULTS_FILE, CONTROLS_FILE = "results.jsonl", "controls.jsonl"
TABLE_FILE, METRICS_FILE, CONFUSION_FILE = "table.md", "metrics.json", "confusion.png"
OTHER_VERDICTS = ("none", "ambiguous", "unexplained", "failed")
NO_EFFECT = "(nothing)"
TABLE_SPECS = (
    ("One effect: top-1", ("single", "sensor"), "top1"),
    ("One effect: among the first two", ("single", "sensor"), "two"),
    ("Nothing hidden: false alarm", ("none",), "false_alarm"),
    ("Two effects: both named", ("pair",), "both"),
    ("Not in the library: unexplained", ("unknown",), "unexplained"),
    ("Not in the library: wrong name", ("unknown",), "wrong_name"),
    ("Not in the library: region correct", ("unknown",), "region"),
)


def read_rows(path: Path) -> list[Json]:
    """Read the rows of a results.jsonl; skip an incomplete last line."""
    rows = []
    for line in path.read_text(encoding="utf-8").splitlines() if path.is_file() else ():
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    return rows


def write_study_pages(folder: Path) -> Path:
    """Write table.md and confusion.png from the results in a folder; return the table's path."""
    rows = read_rows(folder / RESULTS_FILE)
    every_usable_row = select_usable(rows)
    usable_rows = [row for row in every_usable_row if not row.get("laboratory")]
    in_laboratory = [row for row in every_usable_row if row.get("laboratory")]
    if any(row["kind"] != "pair" for row in usable_rows):
        from tests.studies.blind.confusion_matrix import draw_confusion_matrix

        draw_confusion_matrix(*compute_confusion(usable_rows), folder / CONFUSION_FILE)
    path = folder / TABLE_FILE
    metrics = [
        *(compute_metrics(rows) if usable_rows or not in_laboratory else []),
        *(compute_laboratory_metrics(rows) if in_laboratory else []),
    ]
    (folder / METRICS_FILE).write_text(
        dump_strict_json({"metrics": [metric.to_json() for metric in metrics]}), encoding="utf-8"
    )
    lines = [
        *_format_head(rows, len(every_usable_row)),
        *_format_metrics(metrics),
        *format_laboratory_tables(in_laboratory),
        *_format_tables(usable_rows),
        *format_baseline_table(usable_rows),
        *format_control_table(read_rows(folder / CONTROLS_FILE), usable_rows),
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def compute_confusion(rows: Sequence[Json]) -> tuple[list[str], list[str], Any]:
    """Return (truths, verdicts, counts (truth, verdict)) of the cases with at most one effect."""
    outcomes = [(_truth_label(row), verdict_label(row)) for row in rows if row["kind"] != "pair"]
    truths = list(dict.fromkeys(truth for truth, _ in outcomes))
    verdicts = {verdict for _, verdict in outcomes}
    columns = [truth for truth in truths if truth in verdicts]
    columns += sorted(verdicts - {*truths} - {*OTHER_VERDICTS}) + [
        name for name in OTHER_VERDICTS if name in verdicts
    ]
    counts = np.zeros((len(truths), len(columns)), dtype=np.int64)
    for truth, verdict in outcomes:
        counts[truths.index(truth), columns.index(verdict)] += 1
    return truths, columns, counts


def verdict_label(row: Json) -> str:
    """Return the effect that a verdict names first, else its kind."""
    return str(row["named"][0]) if row["said"] == "named" and row["named"] else str(row["said"])


def _truth_label(row: Json) -> str:
    return str(row["truth"][0]) if row["truth"] else NO_EFFECT


def _format_head(rows: Sequence[Json], usable_count: int) -> Iterator[str]:
    latest_rows = select_latest(rows)
    failed = sum(bool(row.get("failed")) for row in latest_rows)
    excluded = Counter(str(row.get("ended", "not made")).split(":")[0] for row in latest_rows
                  if not row.get("sized"))  # fmt: skip
    reasons = ", ".join(f"{word} {count}" for word, count in excluded.most_common()) or "none"
    yield "# Blind study of discovery\n"
    yield (
        f"{len(latest_rows)} cases, {usable_count} evaluated; {failed} without a verdict, "
        f"which count as misses. Excluded: {reasons} (not played: within its bounds the effect "
        "does not reach the size of its cell; aborted: stopped by protection). Rates with "
        "counts and 95 % Wilson intervals.\n"
    )


def _format_tables(usable_rows: Sequence[Json]) -> Iterator[str]:
    """Yield the tables of the cases on the ideal rig."""
    if not usable_rows:
        return
    for title, kinds, key in TABLE_SPECS:
        yield from _format_table(title, [row for row in usable_rows if row["kind"] in kinds], key)
    yield from _format_calibration(usable_rows)
    yield from _format_verdicts(usable_rows)
    yield from _format_worst_misses(usable_rows)


def _format_metrics(metrics: Sequence[StudyMetric]) -> Iterator[str]:
    yield "| metric | target | result | |"
    yield "|---|---|---|---|"
    for metric in metrics:
        mark = {True: "reached", False: "MISSED", None: ""}[metric.is_reached]
        yield f"| {metric.name} | {metric.target} | {metric.value} | {mark} |"


def _format_table(title: str, rows: Sequence[Json], key: str) -> Iterator[str]:
    """Yield a table of hits by effect, over noise and size."""
    if not rows:
        return
    sizes = sorted({(row["noise"], row["size"]) for row in rows})
    heads = [_column_title(*size) for size in sizes]
    row_of: Callable[[Json], str] = (
        (lambda row: "two effects") if rows[0]["kind"] == "pair" else _truth_label
    )
    lines, _, cells = cross_tabulate(
        rows, key, row_of, lambda row: _column_title(row["noise"], row["size"])
    )
    yield f"\n## {title}\n"
    yield f"| hidden | {' | '.join(heads)} | all |"
    yield "|---" * (len(heads) + 2) + "|"
    for line in lines:
        rates = [cells.get((line, head), Rate(0, 0)) for head in heads]
        counts = [f"{rate.hits}/{rate.count}" if rate.count else "" for rate in rates]
        total = Rate(sum(rate.hits for rate in rates), sum(rate.count for rate in rates))
        yield f"| {line} | {' | '.join(counts)} | {total} |"


def _column_title(noise: float, size: float) -> str:
    return f"{100 * noise:g} %" + (f", size {size:g}" if size else "")


def _format_calibration(rows: Sequence[Json]) -> Iterator[str]:
    bins = compute_calibration(rows)
    if bins:
        yield "\n## Stated confidence against hit rate\n"
        yield "| mean stated confidence | hit rate |"
        yield "|---|---|"
        yield from (f"| {100 * confidence:.0f} % | {hit_rate} |" for confidence, hit_rate in bins)


def _format_verdicts(rows: Sequence[Json]) -> Iterator[str]:
    truths, columns, counts = compute_confusion(rows)
    yield f"\n## Verdicts ({CONFUSION_FILE})\n"
    yield "| hidden | cases | verdicts |"
    yield "|---|---|---|"
    for truth, line in zip(truths, counts, strict=True):
        line_counts = Counter(dict(zip(columns, line.tolist(), strict=True)))
        verdicts = ", ".join(
            f"{verdict} {count}" for verdict, count in line_counts.most_common() if count
        )
        yield f"| {truth} | {line.sum()} | {verdicts} |"


def _format_worst_misses(rows: Sequence[Json]) -> Iterator[str]:
    missed = select_worst_misses(rows)
    if missed:
        yield "\n## Worst misses\n"
        yield "| case | cell | hidden | verdict | confidence |"
        yield "|---|---|---|---|---|"
    for row in missed:
        confidence = "" if row["confidence"] is None else f"{row['confidence']:.2f}"
        hidden = ", ".join(row["truth"]) or NO_EFFECT
        outcome = ", ".join(row["named"]) or row.get("failed") or row["said"]
        yield f"| {row['number']} | {row['cell']} | {hidden} | {outcome} | {confidence} |"
