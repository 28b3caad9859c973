"""Hit rates with Wilson intervals, and the metrics of the study with their targets. No I/O."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

Json = dict[str, Any]
NORMAL_QUANTILE = 1.959963984540054  # two-sided 95 % quantile of the normal distribution
CONFIDENCE_BINS = 10  # number of bins of stated confidence
MIN_NAMEABLE_SIZE = 3.0  # effects of this size or more should be named
MAX_LOW_NOISE = 0.011  # relative to the rms of each channel: levels of up to 1 %
MIN_DISTINCT_MARK = (
    1.05  # factor on the held-out error above which each of two effects is identifiable
)


@dataclass(frozen=True, slots=True)
class Rate:
    """Hit rate: `hits` of `count`, with the 95 % interval of Wilson (1927)."""

    hits: int
    count: int

    @property
    def share(self) -> float:
        """Share of hits; NaN if `count` is 0."""
        return self.hits / self.count if self.count else math.nan

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson interval (low, high); (0, 1) if `count` is 0."""
        n = self.count
        if not n:
            return 0.0, 1.0
        p, z2 = self.share, NORMAL_QUANTILE * NORMAL_QUANTILE
        middle = (p + z2 / (2 * n)) / (1 + z2 / n)
        half = NORMAL_QUANTILE / (1 + z2 / n) * math.sqrt(p * (1 - p) / n + z2 / (4 * n * n))
        return max(middle - half, 0.0), min(middle + half, 1.0)

    def __str__(self) -> str:
        if not self.count:
            return "-"
        low, high = (100 * bound for bound in self.interval)
        return f"{100 * self.share:.1f} % ({self.hits}/{self.count}; {low:.1f} to {high:.1f})"


@dataclass(frozen=True, slots=True)
class StudyMetric:
    """Metric of the study: name, target and value as text, and whether the target is reached."""

    name: str
    target: str
    value: str
    is_reached: bool | None  # None: no target, or no cases
    rate: Rate | None = None

    def to_json(self) -> Json:
        """Return the metric with the count and the Wilson interval of its rate."""
        row: Json = {
            "metric": self.name, "target": self.target, "value": self.value,
            "reached": self.is_reached,
        }  # fmt: skip
        if self.rate is not None:
            low, high = self.rate.interval
            row |= {
                "hits": self.rate.hits, "count": self.rate.count,
                "share": self.rate.share if self.rate.count else None, "low": low, "high": high,
            }  # fmt: skip
        return row


def compute_rate(rows: Iterable[Json], key: str) -> Rate:
    """Return how often `key` is true in the rows that have a value of it."""
    values = [row[key] for row in rows if row.get(key) is not None]
    return Rate(sum(map(bool, values)), len(values))


def select_usable(rows: Iterable[Json]) -> list[Json]:
    """Return the last row of each case number whose effect has the size of its cell.

    A case without a verdict counts as a miss; one that could not be generated is excluded.
    """
    return [row for row in select_latest(rows) if row.get("sized")]


def select_latest(rows: Iterable[Json]) -> list[Json]:
    """Return the last row of each case number, sorted by number."""
    return [row for _, row in sorted({entry["number"]: entry for entry in rows}.items())]


def compute_calibration(rows: Iterable[Json]) -> list[tuple[float, Rate]]:
    """Return (mean stated confidence, hit rate) of verdicts with a name, by confidence bin."""
    bins: list[list[Json]] = [[] for _ in range(CONFIDENCE_BINS)]
    for row in rows:
        if row["confidence"] is not None:
            bins[min(int(row["confidence"] * CONFIDENCE_BINS), CONFIDENCE_BINS - 1)].append(row)
    return [
        (float(np.mean([entry["confidence"] for entry in bin_rows])), _count_hits(bin_rows))
        for bin_rows in bins
        if bin_rows
    ]


def _count_hits(rows: Sequence[Json]) -> Rate:
    """Return how often the effect named first is true."""
    return Rate(sum(row["named"][0] in row["truth"] for row in rows), len(rows))


def compute_metrics(rows: Sequence[Json]) -> list[StudyMetric]:
    """Return every metric of the study on the ideal rig, in the order of its page."""
    usable_rows = [row for row in select_usable(rows) if not row.get("laboratory")]
    single = [*select_kind(usable_rows, "single"), *select_kind(usable_rows, "sensor")]
    return [
        *_make_naming_metrics(single),
        *_make_rejection_metrics(usable_rows),
        *_make_pair_metrics(select_kind(usable_rows, "pair")),
        _make_calibration_metric(compute_calibration(usable_rows)),
        *_make_fit_metrics(usable_rows, single),
        *_make_parameter_metrics([row for row in single if abs(row["noise"] - 0.01) < 1e-9]),
        make_median_metric("CPU time per case in s", usable_rows, "seconds", 10.0),
    ]


def select_kind(rows: Sequence[Json], kind: str) -> list[Json]:
    """Return the rows of a kind of cell."""
    return [row for row in rows if row["kind"] == kind]


def _select_nameable(rows: Sequence[Json]) -> list[Json]:
    return [row for row in rows if row["size"] >= MIN_NAMEABLE_SIZE]


def _make_naming_metrics(single: Sequence[Json]) -> list[StudyMetric]:
    """Return how often one hidden effect is named, by its size and the noise."""
    low_noise = [row for row in single if row["noise"] <= MAX_LOW_NOISE]
    high_noise = [row for row in single if row["noise"] > MAX_LOW_NOISE]
    large = _select_nameable(low_noise)
    small = [row for row in low_noise if row["size"] < MIN_NAMEABLE_SIZE]
    top_1, set_of_two, alone = (compute_rate(large, key) for key in ("top1", "two", "exact"))
    return [
        make_min_metric("top-1, size >= 3, noise <= 1 %", top_1, 0.95),
        make_min_metric("set of two, size >= 3, noise <= 1 %", set_of_two, 0.98),
        make_min_metric("named alone, size >= 3, noise <= 1 %", alone, None),
        make_min_metric("top-1, noise 5 %", compute_rate(high_noise, "top1"), 0.75),
        make_min_metric("top-1, size 1.5, noise <= 1 %", compute_rate(small, "top1"), None),
    ]


def _make_rejection_metrics(usable_rows: Sequence[Json]) -> list[StudyMetric]:
    """Return false alarms, and verdicts and regions of effects that the library lacks."""
    nothing, unknown, one_effect = (
        select_kind(usable_rows, kind) for kind in ("none", "unknown", "single")
    )
    unexplained, wrong_name, region = (
        compute_rate(unknown, key) for key in ("unexplained", "wrong_name", "region")
    )
    false_alarm = compute_rate(nothing, "false_alarm")
    return [
        make_max_metric("nothing hidden: false alarm", false_alarm, 0.02),
        make_min_metric("not in the library: unexplained", unexplained, 0.90),
        make_max_metric("not in the library: wrong name", wrong_name, 0.05),
        make_min_metric("not in the library: region correct", region, 0.85),
        make_min_metric("one effect: region correct", compute_rate(one_effect, "region"), None),
    ]


def _make_pair_metrics(pairs: Sequence[Json]) -> list[StudyMetric]:
    """Return how often both or one of two hidden effects are named."""
    distinct = [row for row in pairs if (row.get("mark") or 0.0) >= MIN_DISTINCT_MARK]
    both, at_least_one = compute_rate(distinct, "both"), compute_rate(distinct, "one")
    return [
        make_min_metric("two effects: both", compute_rate(pairs, "both"), 0.80),
        make_min_metric("two effects: at least one", compute_rate(pairs, "one"), 0.97),
        make_min_metric("two effects, both identifiable: both", both, None),
        make_min_metric("two effects, both identifiable: at least one", at_least_one, None),
    ]


def _make_fit_metrics(usable_rows: Sequence[Json], single: Sequence[Json]) -> list[StudyMetric]:
    """Return how well the completed model fits where the effect is named correctly."""
    named_right = [row for row in usable_rows if row["said"] == "named" and row["right"]]
    large_right = [row for row in _select_nameable(single) if row["right"]]
    near_oracle = _count_within(named_right, "after_oracle", 1.05)
    closed = _count_within(large_right, "closed", 0.95, above=True)
    return [
        make_median_metric(
            "held-out after / floor, named correctly", named_right, "after_floor", 1.10
        ),
        make_min_metric("held-out after <= 1.05 oracle, named correctly", near_oracle, 0.90),
        make_min_metric("gap closed >= 0.95, size >= 3", closed, None),
    ]


def make_min_metric(name: str, hit_rate: Rate, target: float | None) -> StudyMetric:
    """Return the metric of a rate that should be at least the target."""
    target_text = f">= {100 * target:.0f} %" if target is not None else ""
    is_reached = hit_rate.share >= target if target is not None and hit_rate.count else None
    return StudyMetric(name, target_text, str(hit_rate), is_reached, hit_rate)


def make_max_metric(name: str, hit_rate: Rate, target: float) -> StudyMetric:
    """Return the metric of a rate that should be at most the target."""
    is_reached = hit_rate.share <= target if hit_rate.count else None
    return StudyMetric(name, f"<= {100 * target:.0f} %", str(hit_rate), is_reached, hit_rate)


def make_median_metric(name: str, rows: Sequence[Json], key: str, target: float) -> StudyMetric:
    """Return the metric of a quantity whose median should be at most the target."""
    values = _collect_values(rows, key)
    if not values:
        return StudyMetric(name, f"median <= {target:g}", "-", None)
    median, percentile_90 = np.percentile(values, [50, 90])
    summary = f"median {median:.3g}, 90 % below {percentile_90:.3g} ({len(values)})"
    return StudyMetric(name, f"median <= {target:g}", summary, bool(median <= target))


def _count_within(rows: Sequence[Json], key: str, limit: float, above: bool = False) -> Rate:
    values = _collect_values(rows, key)
    return Rate(
        sum((value >= limit) if above else (value <= limit) for value in values), len(values)
    )


def _collect_values(rows: Sequence[Json], key: str) -> list[float]:
    return [float(row[key]) for row in rows if row.get(key) is not None]


def _make_parameter_metrics(rows: Sequence[Json]) -> list[StudyMetric]:
    """Return parameter errors and interval coverage at 1 % noise, for all forms and the library's.

    Where the simulated machine uses another form of an effect, other parameters fit best.
    """
    estimates = [estimate for row in rows for estimate in row.get("parameters", [])]
    return [
        *_make_recovery_metrics("all forms", estimates),
        *_make_recovery_metrics(
            "the library's form", [estimate for estimate in estimates if estimate["alike"]]
        ),
    ]


def make_coverage_metric(name: str, covered: Rate, low: float, high: float | None) -> StudyMetric:
    """Return the metric of intervals that should hold the truth in a share from low to high."""
    target = f"{100 * low:.0f} to {100 * high:.0f} %" if high else f">= {100 * low:.0f} %"
    is_covered = low <= covered.share <= (high or 1.0) if covered.count else None
    return StudyMetric(name, target, str(covered), is_covered, covered)


def _make_recovery_metrics(
    forms: str, estimates: Sequence[Json]
) -> tuple[StudyMetric, StudyMetric]:
    close = Rate(sum(estimate["error"] <= 0.05 for estimate in estimates), len(estimates))
    covered = compute_rate(estimates, "covered")
    errors = [estimate["error"] for estimate in estimates]
    middle = f"; median error {100 * float(np.median(errors)):.2g} %" if errors else ""
    all_close = close.share == 1.0 if close.count else None
    return (
        StudyMetric(
            f"parameters within 5 %, noise 1 %, {forms}",
            "all",
            f"{close}{middle}",
            all_close,
            close,
        ),
        make_coverage_metric(f"interval coverage, noise 1 %, {forms}", covered, 0.90, 0.98),
    )


def _make_calibration_metric(bins: list[tuple[float, Rate]]) -> StudyMetric:
    name, target = "stated confidence against hit rate", "within 8 points"
    count = sum(hit_rate.count for _, hit_rate in bins)
    if not count:
        return StudyMetric(name, target, "-", None)
    mean_error = (
        sum(hit_rate.count * abs(confidence - hit_rate.share) for confidence, hit_rate in bins)
        / count
    )
    summary = f"{100 * mean_error:.1f} points on average over bins ({count})"
    return StudyMetric(name, target, summary, mean_error <= 0.08)


def cross_tabulate(
    rows: Sequence[Json], key: str, row_of: Callable[[Json], str], column_of: Callable[[Json], str]
) -> tuple[list[str], list[str], dict[tuple[str, str], Rate]]:
    """Return (row names, column names, hit rate of each cell) of `key` over two groupings."""
    lines = list(dict.fromkeys(map(row_of, rows)))
    columns = list(dict.fromkeys(map(column_of, rows)))
    cells = {
        (line, column): compute_rate(
            [row for row in rows if (row_of(row), column_of(row)) == (line, column)], key
        )
        for line in lines
        for column in columns
    }
    return lines, columns, cells
