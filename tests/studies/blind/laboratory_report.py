"""Metrics and tables of the study in imperfect laboratories. No I/O."""

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

from tests.studies.blind.rates import (
    Rate,
    StudyMetric,
    compute_rate,
    make_coverage_metric,
    make_max_metric,
    make_median_metric,
    make_min_metric,
    select_kind,
    select_usable,
)

Json = dict[str, Any]
SET_UP_EFFECTS = frozenset({"gap_offset", "mass_error"})  # not of the specimen
MAX_PARAMETER_ERROR = 0.01  # of an identified parameter
# Residual of the refitted base model over the noise from which an imperfection can be seen.
MIN_VISIBLE_SIZE = 1.5
TOGETHER = "(all together)"


def compute_laboratory_metrics(rows: Sequence[Json]) -> list[StudyMetric]:
    """Return every metric of the cases in a laboratory, in the order of its page."""
    usable_rows = [row for row in select_usable(rows) if row.get("laboratory")]
    typical = [row for row in usable_rows if row["laboratory"] == "typical"]
    bad = [row for row in usable_rows if row["laboratory"] == "bad"]
    specimen, set_up = _split_single(typical)
    return [
        *_make_clean_metrics(select_kind(typical, "none")),
        make_min_metric(
            "bad, clean: named as the instrument's", compute_rate(bad, "on_channel"), 0.90
        ),
        make_min_metric(
            "bad, clean: named with kind and size", compute_rate(bad, "instrument"), None
        ),
        make_min_metric(
            "bad, clean, visible: named as the instrument's",
            compute_rate([row for row in bad if is_visible(row)], "on_channel"),
            0.90,
        ),
        make_max_metric("bad, clean: a physical effect named", compute_rate(bad, "physics"), 0.02),
        make_min_metric("one effect: named", compute_rate(specimen, "hit"), 0.95),
        make_max_metric("one effect: wrong name", compute_rate(specimen, "wrong_name"), 0.02),
        make_min_metric(
            "one planted error of a sensor or the set-up: named", compute_rate(set_up, "hit"), None
        ),
        *_make_pair_metrics(select_kind(typical, "pair")),
        *_make_unknown_metrics(select_kind(typical, "unknown")),
        *_make_interval_metrics(typical, specimen),
        *_make_identification_metrics(select_kind(typical, "identify")),
        make_median_metric("laboratory: CPU time per case in s", usable_rows, "seconds", 60.0),
    ]


def is_visible(row: Json) -> bool:
    """Return whether the imperfections leave more than noise in the residual of the base model."""
    return bool((row.get("imperfection_size") or 0.0) >= MIN_VISIBLE_SIZE)


def _split_single(typical: Sequence[Json]) -> tuple[list[Json], list[Json]]:
    """Return the rows with one hidden effect: of the specimen, and of sensors and set-up."""
    single = [*select_kind(typical, "single"), *select_kind(typical, "sensor")]
    is_set_up = [row["kind"] == "sensor" or row["truth"][0] in SET_UP_EFFECTS for row in single]
    return (
        [row for row, flag in zip(single, is_set_up, strict=True) if not flag],
        [row for row, flag in zip(single, is_set_up, strict=True) if flag],
    )


def _make_clean_metrics(clean: Sequence[Json]) -> list[StudyMetric]:
    alone = [row for row in clean if row["imperfection"]]
    together = [row for row in clean if not row["imperfection"]]
    return [
        make_min_metric(
            "typical, clean: none or true instrument", compute_rate(clean, "healthy"), 0.98
        ),
        make_min_metric("typical, clean, one imperfection", compute_rate(alone, "healthy"), 0.98),
        make_min_metric("typical, clean, all together", compute_rate(together, "healthy"), 0.98),
        make_max_metric(
            "typical, clean: a physical effect named", compute_rate(clean, "physics"), 0.02
        ),
    ]


def _make_pair_metrics(pairs: Sequence[Json]) -> list[StudyMetric]:
    return [
        make_min_metric("two effects in a laboratory: both", compute_rate(pairs, "both"), 0.75),
        make_min_metric(
            "two effects in a laboratory: at least one", compute_rate(pairs, "one"), 0.95
        ),
        make_max_metric(
            "two effects in a laboratory: wrong name", compute_rate(pairs, "wrong_name"), 0.02
        ),
    ]


def _make_unknown_metrics(unknown: Sequence[Json]) -> list[StudyMetric]:
    name = "not in the library, in a laboratory"
    return [
        make_min_metric(f"{name}: unexplained", compute_rate(unknown, "unexplained"), 0.90),
        make_max_metric(f"{name}: wrong name", compute_rate(unknown, "wrong_name"), 0.05),
    ]


def _make_interval_metrics(typical: Sequence[Json], specimen: Sequence[Json]) -> list[StudyMetric]:
    """Return the coverage of intervals: the base of clean cases, effects where they are named."""
    clean = [
        e for row in select_kind(typical, "none") if row["said"] == "none" for e in row["base"]
    ]
    named = [e for row in specimen if row["right"] for e in row["base"]]
    effects = [e for row in specimen for e in row["parameters"] if e["alike"]]
    groups = {
        "base, clean": clean,
        "base, with an effect": named,
        "effect, the library's form": effects,
    }
    return [
        make_coverage_metric(
            f"intervals in a laboratory: {what}", compute_rate(estimates, "covered"), 0.90, 0.98
        )
        for what, estimates in groups.items()
    ]


def _make_identification_metrics(rows: Sequence[Json]) -> list[StudyMetric]:
    estimates = [estimate for row in rows for estimate in row.get("estimates", [])]
    names = dict.fromkeys(estimate["name"] for estimate in estimates)
    covered = compute_rate(estimates, "covered")
    metrics = [
        make_min_metric("identify: K, C, K_j, C_j, gaps within 1 %", _count_close(estimates), 1.0),
        make_coverage_metric("identify: intervals hold", covered, 0.93, None),
    ]
    for name in names:
        some = [estimate for estimate in estimates if estimate["name"] == name]
        held = compute_rate(some, "covered")
        metrics.append(make_min_metric(f"identify: {name} within 1 %", _count_close(some), None))
        if held.count:
            metrics.append(make_min_metric(f"identify: {name}, interval holds", held, None))
    return metrics


def _count_close(estimates: Sequence[Json]) -> Rate:
    close = sum(estimate["error"] <= MAX_PARAMETER_ERROR for estimate in estimates)
    return Rate(close, len(estimates))


def format_laboratory_tables(rows: Sequence[Json]) -> Iterator[str]:
    """Yield the tables of usable rows: verdicts by imperfection, and by hidden effect."""
    for level in ("typical", "bad"):
        clean = [row for row in rows if row["kind"] == "none" and row["laboratory"] == level]
        key = "healthy" if level == "typical" else "on_channel"
        title = (
            "none or a true instrument finding"
            if level == "typical"
            else "named as the instrument's"
        )
        yield from _format_group(
            f"Clean recordings, {level} laboratory: {title}", clean, "imperfection", key,
            lambda row: row["imperfection"] or TOGETHER,
        )  # fmt: skip
    typical = [row for row in rows if row["laboratory"] == "typical"]
    for title, kinds, key in (
        (
            "One hidden effect, typical laboratory: named, and nothing false",
            ("single", "sensor"),
            "right",
        ),
        ("Two hidden effects, typical laboratory: both named", ("pair",), "both"),
        ("Not in the library, typical laboratory: unexplained", ("unknown",), "unexplained"),
    ):
        some = [row for row in typical if row["kind"] in kinds]
        yield from _format_group(title, some, "hidden", key, lambda row: " + ".join(row["truth"]))
    yield from _format_misses([row for row in rows if not row["right"]])


def _format_group(
    title: str, rows: Sequence[Json], head: str, key: str, name_of: Any
) -> Iterator[str]:
    if not rows:
        return
    yield f"\n## {title}\n"
    yield f"| {head} | rate | verdicts |"
    yield "|---|---|---|"
    for name in dict.fromkeys(map(name_of, rows)):
        some = [row for row in rows if name_of(row) == name]
        counts = Counter(describe_outcome(row) for row in some)
        verdicts = ", ".join(f"{outcome} {count}" for outcome, count in counts.most_common())
        yield f"| {name} | {compute_rate(some, key)} | {verdicts} |"


def describe_outcome(row: Json) -> str:
    """Return the verdict of a row; of named ones each name with its class."""
    if row["said"] == "named" and row.get("findings"):
        return " + ".join(f"{f['name']} ({f['class']})" for f in row["findings"])
    return str(row["said"])


def _format_misses(missed: Sequence[Json]) -> Iterator[str]:
    if not missed:
        return
    yield "\n## Misses in a laboratory\n"
    yield "| case | cell | hidden | verdict | confidence | rms over noise | why |"
    yield "|---|---|---|---|---|---|---|"
    for row in missed:
        confidence = "" if row["confidence"] is None else f"{row['confidence']:.2f}"
        rms = " to ".join(
            f"{row[key]:.3g}" for key in ("before", "after") if row.get(key) is not None
        )
        why = row.get("failed") or row.get("why") or "; ".join(
            f"{e['name']} off by {100 * e['error']:.2g} %"
            for e in row.get("estimates", []) if e["error"] > MAX_PARAMETER_ERROR
        )  # fmt: skip
        hidden = " + ".join(row["truth"])
        yield (
            f"| {row['number']} | {row['cell']} | {hidden} | {describe_outcome(row)} | "
            f"{confidence} | {rms} | {why} |"
        )
