"""Hit rates with Wilson intervals, and the metrics of the study of discovery with their targets."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

Json = dict[str, Any]
Key = str | Callable[[Json], bool | None]
NORMAL_QUANTILE = 1.959963984540054  # two-sided 95 % quantile of the normal distribution
CONFIDENCE_BINS = 10  # number of bins of stated confidence
MIN_NAMEABLE_SIZE = 3.0  # effects of this size or more should be named
MAX_LOW_NOISE = 0.011  # relative to the rms of each channel: levels of up to 1 %
# Factor on the held-out error above which each of two effects is identifiable.
MIN_DISTINCT_MARK = 1.05
SET_UP_EFFECTS = frozenset({"gap_offset", "mass_error"})  # not of the specimen
MAX_PARAMETER_ERROR = 0.01  # of an identified parameter
# Residual of the refitted base model over the noise from which an imperfection can be seen.
MIN_VISIBLE_SIZE = 1.5


@dataclass(frozen=True, slots=True)
class Rate:
    """Hit rate: `hits` of `count`, with the 95 % interval of Wilson (1927)."""

    hits: int
    count: int

    @classmethod
    def of(cls, rows: Iterable[Json], key: Key) -> "Rate":
        """Return how often `key` is true in the rows that have a value of it."""
        values = [row.get(key) if isinstance(key, str) else key(row) for row in rows]
        known = [bool(value) for value in values if value is not None]
        return cls(sum(known), len(known))

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
    """Metric of a study: name, target and value as text, and whether the target is reached."""

    name: str
    target: str
    value: str
    is_reached: bool | None  # None: no target, or no cases
    rate: Rate | None = None

    @classmethod
    def of_rate(
        cls, name: str, rate: Rate, low: float | None = None, high: float | None = None
    ) -> "StudyMetric":
        """Return the metric of a rate that should lie between two bounds."""
        bounds = [f"{100 * bound:.0f}" for bound in (low, high) if bound is not None]
        sign = "" if len(bounds) != 1 else ">= " if high is None else "<= "
        target = f"{sign}{' to '.join(bounds)} %" if bounds else ""
        is_within = (low or 0.0) <= rate.share <= (1.0 if high is None else high)
        return cls(name, target, str(rate), is_within if bounds and rate.count else None, rate)

    @classmethod
    def of_median(cls, name: str, rows: Sequence[Json], key: str, target: float) -> "StudyMetric":
        """Return the metric of a quantity whose median should be at most the target."""
        values = [float(row[key]) for row in rows if row.get(key) is not None]
        text = f"median <= {target:g}"
        if not values:
            return cls(name, text, "-", None)
        median, percentile_90 = np.percentile(values, [50, 90])
        summary = f"median {median:.3g}, 90 % below {percentile_90:.3g} ({len(values)})"
        return cls(name, text, summary, bool(median <= target))


def select_latest(rows: Iterable[Json]) -> list[Json]:
    """Return the last row of each case number, sorted by number."""
    return [row for _, row in sorted({entry["number"]: entry for entry in rows}.items())]


def select_usable(rows: Iterable[Json]) -> list[Json]:
    """Return the last row of each case number whose effect has the size of its cell.

    A case without a verdict counts as a miss; one that could not be generated is excluded.
    """
    return [row for row in select_latest(rows) if row.get("sized")]


def select_kind(rows: Sequence[Json], *kinds: str) -> list[Json]:
    """Return the rows of some kinds of cells."""
    return [row for row in rows if row["kind"] in kinds]


def compute_calibration(rows: Iterable[Json]) -> list[tuple[float, Rate]]:
    """Return (mean stated confidence, hit rate) of verdicts with a name, by confidence bin."""
    bins: list[list[Json]] = [[] for _ in range(CONFIDENCE_BINS)]
    for row in rows:
        if row["confidence"] is not None:
            bins[min(int(row["confidence"] * CONFIDENCE_BINS), CONFIDENCE_BINS - 1)].append(row)
    return [
        (
            float(np.mean([row["confidence"] for row in members])),
            Rate.of(members, lambda row: row["named"][0] in row["truth"]),
        )
        for members in bins
        if members
    ]


def compute_metrics(rows: Sequence[Json]) -> list[StudyMetric]:
    """Return every metric of the cases on the ideal rig, in the order of its page."""
    usable = [row for row in select_usable(rows) if not row.get("laboratory")]
    single, pairs = select_kind(usable, "single", "sensor"), select_kind(usable, "pair")
    unknown, nothing = select_kind(usable, "unknown"), select_kind(usable, "none")
    quiet = [row for row in single if row["noise"] <= MAX_LOW_NOISE]
    noisy = [row for row in single if row["noise"] > MAX_LOW_NOISE]
    large = [row for row in quiet if _is_large(row)]
    small = [row for row in quiet if not _is_large(row)]
    distinct = [row for row in pairs if (row.get("mark") or 0.0) >= MIN_DISTINCT_MARK]
    named = [row for row in usable if row["said"] == "named" and row["right"]]
    large_named = [row for row in single if _is_large(row) and row["right"]]
    rate, median = _make_rate_metric, StudyMetric.of_median
    return [
        rate("top-1, size >= 3, noise <= 1 %", large, "top1", 0.95),
        rate("set of two, size >= 3, noise <= 1 %", large, "two", 0.98),
        rate("named alone, size >= 3, noise <= 1 %", large, "exact"),
        rate("top-1, noise 5 %", noisy, "top1", 0.75),
        rate("top-1, size 1.5, noise <= 1 %", small, "top1"),
        rate("nothing hidden: false alarm", nothing, "false_alarm", high=0.02),
        rate("not in the library: unexplained", unknown, "unexplained", 0.90),
        rate("not in the library: wrong name", unknown, "wrong_name", high=0.05),
        rate("not in the library: region correct", unknown, "region", 0.85),
        rate("one effect: region correct", select_kind(usable, "single"), "region"),
        rate("two effects: both", pairs, "both", 0.80),
        rate("two effects: at least one", pairs, "one", 0.97),
        rate("two effects, both identifiable: both", distinct, "both"),
        rate("two effects, both identifiable: at least one", distinct, "one"),
        _make_calibration_metric(compute_calibration(usable)),
        median("held-out after / floor, named correctly", named, "after_floor", 1.10),
        rate("held-out after <= 1.05 oracle, named correctly", named,
             _compare("after_oracle", high=1.05), 0.90),
        rate("gap closed >= 0.95, size >= 3", large_named, _compare("closed", low=0.95)),
        *_make_parameter_metrics([row for row in single if abs(row["noise"] - 0.01) < 1e-9]),
        median("CPU time per case in s", usable, "seconds", 10.0),
    ]  # fmt: skip


def _is_large(row: Json) -> bool:
    """Return whether the hidden effect is large enough to be named."""
    return bool(row["size"] >= MIN_NAMEABLE_SIZE)


def _make_rate_metric(
    name: str, rows: Sequence[Json], key: Key, low: float | None = None, high: float | None = None
) -> StudyMetric:
    return StudyMetric.of_rate(name, Rate.of(rows, key), low, high)


def _compare(key: str, low: float = -math.inf, high: float = math.inf) -> Key:
    """Return whether a quantity of a row lies between two bounds, None where it is unknown."""
    return lambda row: None if row.get(key) is None else low <= row[key] <= high


def _make_calibration_metric(bins: Sequence[tuple[float, Rate]]) -> StudyMetric:
    name, target = "stated confidence against hit rate", "within 8 points"
    count = sum(hit_rate.count for _, hit_rate in bins)
    if not count:
        return StudyMetric(name, target, "-", None)
    errors = [hit_rate.count * abs(stated - hit_rate.share) for stated, hit_rate in bins]
    mean_error = sum(errors) / count
    summary = f"{100 * mean_error:.1f} points on average over bins ({count})"
    return StudyMetric(name, target, summary, mean_error <= 0.08)


def _make_parameter_metrics(rows: Sequence[Json]) -> list[StudyMetric]:
    """Return parameter errors and interval coverage at 1 % noise, for all forms and the library's.

    Where the simulated machine uses another form of an effect, other parameters fit best.
    """
    every = [estimate for row in rows for estimate in row.get("parameters", [])]
    alike = [estimate for estimate in every if estimate["alike"]]
    metrics = []
    for forms, estimates in (("all forms", every), ("the library's form", alike)):
        close = Rate.of(estimates, _compare("error", high=0.05))
        errors = [estimate["error"] for estimate in estimates]
        middle = f"; median error {100 * float(np.median(errors)):.2g} %" if errors else ""
        name = f"parameters within 5 %, noise 1 %, {forms}"
        is_reached = close.share == 1.0 if close.count else None
        metrics += [
            StudyMetric(name, "all", f"{close}{middle}", is_reached, close),
            _make_rate_metric(
                f"interval coverage, noise 1 %, {forms}", estimates, "covered", 0.90, 0.98
            ),
        ]
    return metrics


def compute_laboratory_metrics(rows: Sequence[Json]) -> list[StudyMetric]:
    """Return every metric of the cases in a laboratory, in the order of its page."""
    usable = [row for row in select_usable(rows) if row.get("laboratory")]
    typical = [row for row in usable if row["laboratory"] == "typical"]
    bad = [row for row in usable if row["laboratory"] == "bad"]
    visible = [row for row in bad if (row.get("imperfection_size") or 0.0) >= MIN_VISIBLE_SIZE]
    clean, pairs = select_kind(typical, "none"), select_kind(typical, "pair")
    unknown, identified = select_kind(typical, "unknown"), select_kind(typical, "identify")
    single = select_kind(typical, "single", "sensor")
    specimen = [row for row in single if not _is_set_up(row)]
    alone = [row for row in clean if row["imperfection"]]
    together = [row for row in clean if not row["imperfection"]]
    calm = [e for row in clean if row["said"] == "none" for e in row["base"]]
    named = [e for row in specimen if row["right"] for e in row["base"]]
    effects = [e for row in specimen for e in row["parameters"] if e["alike"]]
    estimates = [e for row in identified for e in row.get("estimates", [])]
    rate, absent = _make_rate_metric, "not in the library, in a laboratory"
    is_close = _compare("error", high=MAX_PARAMETER_ERROR)
    metrics = [
        rate("typical, clean: none or true instrument", clean, "healthy", 0.98),
        rate("typical, clean, one imperfection", alone, "healthy", 0.98),
        rate("typical, clean, all together", together, "healthy", 0.98),
        rate("typical, clean: a physical effect named", clean, "physics", high=0.02),
        rate("bad, clean: named as the instrument's", bad, "on_channel", 0.90),
        rate("bad, clean: named with kind and size", bad, "instrument"),
        rate("bad, clean, visible: named as the instrument's", visible, "on_channel", 0.90),
        rate("bad, clean: a physical effect named", bad, "physics", high=0.02),
        rate("one effect: named", specimen, "hit", 0.95),
        rate("one effect: wrong name", specimen, "wrong_name", high=0.02),
        rate("one planted error of a sensor or the set-up: named",
             [row for row in single if _is_set_up(row)], "hit"),
        rate("two effects in a laboratory: both", pairs, "both", 0.75),
        rate("two effects in a laboratory: at least one", pairs, "one", 0.95),
        rate("two effects in a laboratory: wrong name", pairs, "wrong_name", high=0.02),
        rate(f"{absent}: unexplained", unknown, "unexplained", 0.90),
        rate(f"{absent}: wrong name", unknown, "wrong_name", high=0.05),
        rate("intervals in a laboratory: base, clean", calm, "covered", 0.90, 0.98),
        rate("intervals in a laboratory: base, with an effect", named, "covered", 0.90, 0.98),
        rate("intervals in a laboratory: effect, the library's form", effects, "covered",
             0.90, 0.98),
        rate("identify: K, C, K_j, C_j, gaps within 1 %", estimates, is_close, 1.0),
        rate("identify: intervals hold", estimates, "covered", 0.93),
    ]  # fmt: skip
    for name in dict.fromkeys(estimate["name"] for estimate in estimates):
        some = [estimate for estimate in estimates if estimate["name"] == name]
        metrics.append(rate(f"identify: {name} within 1 %", some, is_close))
        metrics.append(rate(f"identify: {name}, interval holds", some, "covered"))
    median = StudyMetric.of_median("laboratory: CPU time per case in s", usable, "seconds", 60.0)
    return [*metrics, median]


def _is_set_up(row: Json) -> bool:
    """Return whether what is hidden is an error of a sensor or of the set-up."""
    return row["kind"] == "sensor" or row["truth"][0] in SET_UP_EFFECTS
