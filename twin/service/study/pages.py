"""What a study says: table.md with figures, tables and the worst misses, and confusion.png."""

import json
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from twin.service.study.beside import compared, controlled
from twin.service.study.rates import Figure, Rate, calibration, figures, latest, table, usable
from twin.service.study.scoring import worst

Json = dict[str, Any]
RESULTS, CONTROLS = "results.jsonl", "controls.jsonl"
TABLE, CONFUSION = "table.md", "confusion.png"
OTHERS = ("none", "ambiguous", "unexplained", "failed")
NOTHING = "(nothing)"
TABLES = (
    ("One effect: top-1", ("single", "sensor"), "top1"),
    ("One effect: among two", ("single", "sensor"), "two"),
    ("Nothing hidden: false alarm", ("none",), "false_alarm"),
    ("Two effects: both named", ("pair",), "both"),
    ("Not in the library: unexplained", ("unknown",), "unexplained"),
    ("Not in the library: a wrong name", ("unknown",), "wrong_name"),
    ("Not in the library: region right", ("unknown",), "region"),
)


def read_rows(path: Path) -> list[Json]:
    """The rows of a results.jsonl; a last line that was cut off is left out."""
    rows = []
    for line in path.read_text(encoding="utf-8").splitlines() if path.is_file() else ():
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    return rows


def write_pages(folder: Path) -> Path:
    """table.md and confusion.png of the results in a folder; the path of the table."""
    rows = read_rows(folder / RESULTS)
    good = usable(rows)
    if any(one["kind"] != "pair" for one in good):
        from twin.service.study.picture import draw

        draw(*confusion(good), folder / CONFUSION)
    path = folder / TABLE
    lines = [*_page(rows, good), *compared(good), *controlled(read_rows(folder / CONTROLS), good)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def confusion(rows: Sequence[Json]) -> tuple[list[str], list[str], Any]:
    """(truths, what was said, counts (truth, said)) of the cases with at most one effect."""
    told = [(_truth(one), said(one)) for one in rows if one["kind"] != "pair"]
    truths = list(dict.fromkeys(truth for truth, _ in told))
    every = {what for _, what in told}
    columns = [one for one in truths if one in every]
    columns += sorted(every - {*truths} - {*OTHERS}) + [one for one in OTHERS if one in every]
    counts = np.zeros((len(truths), len(columns)), dtype=np.int64)
    for truth, what in told:
        counts[truths.index(truth), columns.index(what)] += 1
    return truths, columns, counts


def said(row: Json) -> str:
    """A verdict in a word: the effect that is named first, else the kind of the verdict."""
    return str(row["named"][0]) if row["said"] == "named" and row["named"] else str(row["said"])


def _truth(row: Json) -> str:
    return str(row["truth"][0]) if row["truth"] else NOTHING


def _page(rows: Sequence[Json], good: Sequence[Json]) -> Iterator[str]:
    whole = latest(rows)
    failed = sum(bool(one.get("failed")) for one in whole)
    out = Counter(str(one.get("ended", "not made")).split(":")[0] for one in whole
                  if not one.get("sized"))  # fmt: skip
    why = ", ".join(f"{word} {count}" for word, count in out.most_common()) or "none"
    yield "# Blind study of discovery\n"
    yield (
        f"{len(whole)} cases, {len(good)} judged; {failed} without a verdict, which count as "
        f"misses. Left out: {why} (not played: within its bounds the effect does not reach the "
        "size of its cell; aborted: protection stopped the test). Rates with counts and 95 % "
        "Wilson intervals.\n"
    )
    yield from _figures(figures(rows))
    for title, kinds, key in TABLES:
        yield from _table(title, [one for one in good if one["kind"] in kinds], key)
    yield from _calibration(good)
    yield from _said_instead(good)
    yield from _worst(good)


def _figures(found: Sequence[Figure]) -> Iterator[str]:
    yield "| figure | target | found | |"
    yield "|---|---|---|---|"
    for one in found:
        mark = {True: "reached", False: "MISSED", None: ""}[one.reached]
        yield f"| {one.what} | {one.target} | {one.found} | {mark} |"


def _table(title: str, rows: Sequence[Json], key: str) -> Iterator[str]:
    """By effect, over size and noise; hits of count."""
    if not rows:
        return
    sizes = sorted({(one["noise"], one["size"]) for one in rows})
    heads = [_column(*one) for one in sizes]
    of: Callable[[Json], str] = (lambda row: "two effects") if rows[0]["kind"] == "pair" else _truth
    lines, _, cells = table(rows, key, of, lambda row: _column(row["noise"], row["size"]))
    yield f"\n## {title}\n"
    yield f"| hidden | {' | '.join(heads)} | all |"
    yield "|---" * (len(heads) + 2) + "|"
    for line in lines:
        each = [cells.get((line, head), Rate(0, 0)) for head in heads]
        counts = [f"{one.hits}/{one.count}" if one.count else "" for one in each]
        whole = Rate(sum(one.hits for one in each), sum(one.count for one in each))
        yield f"| {line} | {' | '.join(counts)} | {whole} |"


def _column(noise: float, size: float) -> str:
    return f"{100 * noise:g} %" + (f", size {size:g}" if size else "")


def _calibration(rows: Sequence[Json]) -> Iterator[str]:
    bins = calibration(rows)
    if bins:
        yield "\n## Stated confidence against hit rate\n"
        yield "| stated, mean | hit |"
        yield "|---|---|"
        yield from (f"| {100 * stated:.0f} % | {found} |" for stated, found in bins)


def _said_instead(rows: Sequence[Json]) -> Iterator[str]:
    truths, columns, counts = confusion(rows)
    yield f"\n## What was said ({CONFUSION})\n"
    yield "| hidden | cases | said |"
    yield "|---|---|---|"
    for truth, line in zip(truths, counts, strict=True):
        each = Counter(dict(zip(columns, line.tolist(), strict=True)))
        told = ", ".join(f"{what} {count}" for what, count in each.most_common() if count)
        yield f"| {truth} | {line.sum()} | {told} |"


def _worst(rows: Sequence[Json]) -> Iterator[str]:
    missed = worst(rows)
    if missed:
        yield "\n## The misses that weigh most\n"
        yield "| case | cell | hidden | said | confidence |"
        yield "|---|---|---|---|---|"
    for one in missed:
        sure = "" if one["confidence"] is None else f"{one['confidence']:.2f}"
        hidden = ", ".join(one["truth"]) or NOTHING
        told = ", ".join(one["named"]) or one.get("failed") or one["said"]
        yield f"| {one['number']} | {one['cell']} | {hidden} | {told} | {sure} |"
