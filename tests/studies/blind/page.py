"""Page of the study of discovery: table.md with metrics and tables."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

from tests.studies.blind.harness import RESULTS_FILE, read_rows
from tests.studies.blind.metrics import (
    MAX_PARAMETER_ERROR,
    Rate,
    StudyMetric,
    compute_calibration,
    compute_laboratory_metrics,
    compute_metrics,
    select_kind,
    select_latest,
    select_usable,
)
from tests.studies.blind.scoring import select_worst_misses

Json = dict[str, Any]
CONTROLS_FILE = "controls.jsonl"
TABLE_FILE = "table.md"
NO_EFFECT = "(nothing)"
DISCOVERY = "discovery"
ERROR_ONLY_RIVALS = frozenset({"blackbox", "pyoperon"})  # they name no effect
CONTROL_TITLES = {
    "reversed": "time reversed: confident name",
    "without": "truth not in the library: confident name",
}
IDEAL_TABLES = (
    ("One effect: top-1", ("single", "sensor"), "top1"),
    ("One effect: among the first two", ("single", "sensor"), "two"),
    ("Nothing hidden: false alarm", ("none",), "false_alarm"),
    ("Two effects: both named", ("pair",), "both"),
    ("Not in the library: unexplained", ("unknown",), "unexplained"),
    ("Not in the library: wrong name", ("unknown",), "wrong_name"),
    ("Not in the library: region correct", ("unknown",), "region"),
)
LABORATORY_TABLES = (
    ("One hidden effect: named, and nothing false", ("single", "sensor"), "right"),
    ("Two hidden effects: both named", ("pair",), "both"),
    ("Not in the library: unexplained", ("unknown",), "unexplained"),
)


def write_study_pages(folder: Path) -> Path:
    """Write table.md from the results in a folder; return its path."""
    rows = read_rows(folder / RESULTS_FILE)
    usable = select_usable(rows)
    ideal = [row for row in usable if not row.get("laboratory")]
    in_laboratory = [row for row in usable if row.get("laboratory")]
    metrics = [
        *(compute_metrics(rows) if ideal or not in_laboratory else []),
        *(compute_laboratory_metrics(rows) if in_laboratory else []),
    ]
    lines = [
        *_format_head(rows, len(usable)),
        *_format_metrics(metrics),
        *_format_laboratory(in_laboratory),
        *_format_ideal(ideal),
        *_format_misses(usable),
        *format_rival_table(ideal),
        *_format_controls(read_rows(folder / CONTROLS_FILE), ideal),
    ]
    path = folder / TABLE_FILE
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def describe_outcome(row: Json) -> str:
    """Return what a verdict names first, else its kind; in a laboratory all, with their class."""
    if row["said"] != "named" or not row["named"]:
        return str(row["said"])
    if row.get("findings"):
        return " + ".join(f"{f['name']} ({f['class']})" for f in row["findings"])
    return str(row["named"][0])


def _describe_truth(row: Json) -> str:
    return " + ".join(row["truth"]) or NO_EFFECT


def _format_head(rows: Sequence[Json], usable_count: int) -> Iterator[str]:
    latest_rows = select_latest(rows)
    failed = sum(bool(row.get("failed")) for row in latest_rows)
    excluded = Counter(
        str(row.get("ended", "not made")).split(":")[0]
        for row in latest_rows
        if not row.get("sized")
    )
    reasons = ", ".join(f"{word} {count}" for word, count in excluded.most_common()) or "none"
    yield "# Blind study of discovery\n"
    yield (
        f"{len(latest_rows)} cases, {usable_count} evaluated; {failed} without a verdict, "
        f"which count as misses. Excluded: {reasons} (not played: within its bounds the effect "
        "does not reach the size of its cell; aborted: stopped by protection). Rates with "
        "counts and 95 % Wilson intervals.\n"
    )


def _format_metrics(metrics: Sequence[StudyMetric]) -> Iterator[str]:
    yield "| metric | target | result | |"
    yield "|---|---|---|---|"
    for metric in metrics:
        mark = {True: "reached", False: "MISSED", None: ""}[metric.is_reached]
        yield f"| {metric.name} | {metric.target} | {metric.value} | {mark} |"


def _format_ideal(rows: Sequence[Json]) -> Iterator[str]:
    """Yield the tables of the cases on the ideal rig."""
    for title, kinds, key in IDEAL_TABLES:
        yield from format_table(title, select_kind(rows, *kinds), key)
    if bins := compute_calibration(rows):
        yield "\n## Stated confidence against hit rate\n"
        yield "| mean stated confidence | hit rate |"
        yield "|---|---|"
        yield from (f"| {100 * confidence:.0f} % | {hit_rate} |" for confidence, hit_rate in bins)


def _format_laboratory(rows: Sequence[Json]) -> Iterator[str]:
    """Yield the tables of the cases in a laboratory: by imperfection, and by hidden effect."""
    typical, bad = (
        [row for row in rows if row["laboratory"] == level] for level in ("typical", "bad")
    )
    for title, some, key in (
        ("typical: none or a true instrument finding", typical, "healthy"),
        ("bad: named as the instrument's", bad, "on_channel"),
    ):
        yield from format_table(
            f"Clean recordings in a laboratory, {title}", select_kind(some, "none"), key,
            lambda row: row["imperfection"] or "(all together)",
        )  # fmt: skip
    for title, kinds, key in LABORATORY_TABLES:
        yield from format_table(f"{title}, typical laboratory", select_kind(typical, *kinds), key)


def format_table(
    title: str,
    rows: Sequence[Json],
    key: str,
    describe: Callable[[Json], str] = _describe_truth,
) -> Iterator[str]:
    """Yield a table of hits by what is hidden: by noise and size, in all, and all verdicts."""
    if not rows:
        return
    sizes = sorted({(row["noise"], row["size"]) for row in rows})
    heads = [f"{100 * noise:g} %" + (f", size {size:g}" if size else "") for noise, size in sizes]
    yield f"\n## {title}\n"
    yield f"| hidden | {' | '.join(heads)} | all | verdicts |"
    yield "|---" * (len(heads) + 3) + "|"
    for name in dict.fromkeys(map(describe, rows)):
        some = [row for row in rows if describe(row) == name]
        by_size = [
            Rate.of([row for row in some if (row["noise"], row["size"]) == size], key)
            for size in sizes
        ]
        counts = [f"{rate.hits}/{rate.count}" if rate.count else "" for rate in by_size]
        verdicts = Counter(map(describe_outcome, some)).most_common()
        words = ", ".join(f"{verdict} {count}" for verdict, count in verdicts)
        yield f"| {name} | {' | '.join(counts)} | {Rate.of(some, key)} | {words} |"


def _format_misses(rows: Sequence[Json]) -> Iterator[str]:
    missed = select_worst_misses(rows)
    if not missed:
        return
    yield "\n## Worst misses\n"
    yield "| case | cell | hidden | verdict | confidence | rms over noise | why |"
    yield "|---|---|---|---|---|---|---|"
    for row in missed:
        confidence = "" if row["confidence"] is None else f"{row['confidence']:.2f}"
        rms = [f"{row[key]:.3g}" for key in ("before", "after") if row.get(key) is not None]
        far = [
            f"{estimate['name']} off by {100 * estimate['error']:.2g} %"
            for estimate in row.get("estimates", [])
            if estimate["error"] > MAX_PARAMETER_ERROR
        ]
        cells = (
            str(row["number"]), row["cell"], _describe_truth(row), describe_outcome(row),
            confidence, " to ".join(rms), row.get("failed") or row.get("why") or "; ".join(far),
        )  # fmt: skip
        yield f"| {' | '.join(cells)} |"


def format_rival_table(rows: Sequence[Json]) -> Iterator[str]:
    """Yield a table by effect: hits and median held-out error of discovery and its rivals."""
    compared = [row for row in select_kind(rows, "none", "single", "sensor") if row.get("rivals")]
    if not compared:
        return
    rivals = list(dict.fromkeys(name for row in compared for name in row["rivals"]))
    methods = (DISCOVERY, *rivals)
    naming = [method for method in methods if method not in ERROR_ONLY_RIVALS]
    heads = [f"correct: {method}" for method in naming]
    heads += [f"held out: {method}" for method in methods]
    yield "\n## Rivals on the same recordings\n"
    yield (
        "Correct: the hidden effect named first, or no effect if none is hidden. Held out: median "
        "of the rms over the noise on held-out steps, over the same entries.\n"
    )
    yield f"| hidden | {' | '.join(heads)} |"
    yield "|---" * (len(heads) + 1) + "|"
    groups: dict[str, list[Json]] = {}
    for row in compared:
        groups.setdefault(_describe_truth(row), []).append(row)
    for hidden, group in [*groups.items(), ("all", compared)]:
        results = {
            method: [row if method == DISCOVERY else row["rivals"].get(method, {}) for row in group]
            for method in methods
        }
        rates = [Rate.of(results[method], "right") for method in naming]
        cells = [str(rate) if hidden == "all" else f"{rate.hits}/{rate.count}" for rate in rates]
        for method in methods:
            errors = [result.get("held_out") for result in results[method]]
            known = [float(error) for error in errors if error is not None]
            cells.append(f"{median(known):.3f}" if known else "-")
        yield f"| {hidden} | {' | '.join(cells)} |"


def _format_controls(controls: Sequence[Json], rows: Sequence[Json]) -> Iterator[str]:
    """Yield a table of the negative controls: false confident names, verdicts, shuffled truths."""
    results = [row for row in select_latest(controls) if "right" in row]
    if not results:
        return
    yield "\n## Negative controls\n"
    yield "| control | fooled | verdicts |"
    yield "|---|---|---|"
    for control, title in CONTROL_TITLES.items():
        outcomes = [row[control] for row in results]
        words = Counter(outcome["said"] for outcome in outcomes).most_common()
        counts = ", ".join(f"{verdict} {count}" for verdict, count in words)
        yield f"| {title} | {Rate.of(outcomes, 'fooled')} | {counts} |"
    single = select_kind(rows, "single")
    if len(single) > 1:
        own, other, constant = (f"{100 * rate:.1f} %" for rate in compute_shuffled_rates(single))
        truths = f"own truth {own}; best constant answer {constant}"
        yield f"| truths shuffled: hits | {other} | {truths} |"


def compute_shuffled_rates(rows: Sequence[Mapping[str, Any]]) -> tuple[float, float, float]:
    """Return hit rates: on the own truth, on the truths of other cases, of a constant answer.

    `rows` are from `score_verdict`, with one effect each. The second rate is exact: the mean over
    all permutations without a fixed point. The constant answer is the most frequent truth.
    """
    names = [row["named"][0] if row["said"] == "named" and row["named"] else None for row in rows]
    truths = [row["truth"][0] for row in rows]
    own_hits = sum(a == b for a, b in zip(names, truths, strict=True))
    counts = Counter(truths)
    all_hits = sum(counts[name] for name in names)
    count = max(len(rows), 1)
    other_rate = (all_hits - own_hits) / max(count * (count - 1), 1)
    return own_hits / count, other_rate, max(counts.values(), default=0) / count
