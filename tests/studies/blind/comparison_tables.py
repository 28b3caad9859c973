"""Tables of a study's page: discovery against baselines, and negative controls. No I/O."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from statistics import median
from typing import Any

from tests.studies.blind.rates import Rate, compute_rate, select_latest

Json = Mapping[str, Any]
DISCOVERY = "discovery"
ERROR_ONLY_BASELINES = frozenset({"blackbox", "pyoperon"})  # baselines that name no effect
CONTROL_TITLES = {
    "reversed": "time reversed: confident name",
    "without": "truth not in the library: confident name",
}


def format_baseline_table(rows: Sequence[Json]) -> Iterator[str]:
    """Yield a table by effect: hits and median held-out error of discovery and the baselines."""
    compared_rows = [
        row for row in rows if row.get("rivals") and row["kind"] in ("none", "single", "sensor")
    ]
    baselines = list(dict.fromkeys(name for row in compared_rows for name in row["rivals"]))
    if not compared_rows:
        return
    names = [DISCOVERY, *(method for method in baselines if method not in ERROR_ONLY_BASELINES)]
    yield "\n## Baselines on the same recordings\n"
    yield (
        "Correct: the hidden effect named first, or no effect if none is hidden. Held out: median "
        "of the rms over the noise on held-out steps, over the same entries.\n"
    )
    headings = [f"correct: {method}" for method in names] + [
        f"held out: {method}" for method in (DISCOVERY, *baselines)
    ]
    yield f"| hidden | {' | '.join(headings)} |"
    yield "|---" * (len(headings) + 1) + "|"
    groups: dict[str, list[Json]] = {}
    for row in compared_rows:
        groups.setdefault((row["truth"] or ["(nothing)"])[0], []).append(row)
    for hidden, group in [*groups.items(), ("all", compared_rows)]:
        hit_columns = [
            str(compute_rate([_get_result(row, method) for row in group], "right"))
            if hidden == "all"
            else _format_count([_get_result(row, method) for row in group])
            for method in names
        ]
        error_columns = [
            _format_median([_get_result(row, method) for row in group])
            for method in (DISCOVERY, *baselines)
        ]
        yield f"| {hidden} | {' | '.join([*hit_columns, *error_columns])} |"


def _get_result(row: Json, method: str) -> dict[str, Any]:
    result: dict[str, Any] = dict(row) if method == DISCOVERY else row["rivals"].get(method, {})
    return result


def _format_count(rows: Sequence[dict[str, Any]]) -> str:
    hit_rate = compute_rate(select_rows_with(rows, "right"), "right")
    return f"{hit_rate.hits}/{hit_rate.count}"


def select_rows_with(rows: Sequence[dict[str, Any]], key: str) -> list[dict[str, Any]]:
    """Return the rows that have a value of `key`."""
    return [row for row in rows if row.get(key) is not None]


def _format_median(rows: Sequence[dict[str, Any]]) -> str:
    known = [float(row["held_out"]) for row in select_rows_with(rows, "held_out")]
    return f"{median(known):.3f}" if known else "-"


def format_control_table(controls: Sequence[Json], rows: Sequence[Json]) -> Iterator[str]:
    """Yield a table of the negative controls: false confident names, verdicts, shuffled truths."""
    results = [row for row in select_latest(dict(row) for row in controls) if "right" in row]
    if not results:
        return
    yield "\n## Negative controls\n"
    yield "| control | fooled | verdicts |"
    yield "|---|---|---|"
    for control, title in CONTROL_TITLES.items():
        outcomes = [row[control] for row in results]
        fooled = Rate(sum(outcome["fooled"] for outcome in outcomes), len(outcomes))
        counts = ", ".join(
            f"{verdict} {count}"
            for verdict, count in Counter(outcome["said"] for outcome in outcomes).most_common()
        )
        yield f"| {title} | {fooled} | {counts} |"
    single = [row for row in rows if row["kind"] == "single"]
    if len(single) > 1:
        own_rate, other_rate, best_fixed_rate = (
            f"{100 * rate:.1f} %" for rate in compute_shuffled_rates(single)
        )
        yield (
            f"| truths shuffled: hits | {other_rate} | own truth {own_rate}; "
            f"best constant answer {best_fixed_rate} |"
        )


def compute_shuffled_rates(rows: Sequence[Json]) -> tuple[float, float, float]:
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
