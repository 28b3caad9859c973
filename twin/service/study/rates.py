"""Shares with Wilson intervals, and the figures of the study beside their targets: pure."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

Json = dict[str, Any]
Z = 1.959963984540054  # two-sided 95 %
BINS = 10  # of stated confidence
MATTERS = 3.0  # sizes from here on are to be named
MARKED = 1.05  # a factor of the held-out error that either of two effects makes beside the other


@dataclass(frozen=True, slots=True)
class Rate:
    """`hits` of `count`, with the 95 % interval of Wilson (1927)."""

    hits: int
    count: int

    @property
    def share(self) -> float:
        return self.hits / self.count if self.count else math.nan

    @property
    def interval(self) -> tuple[float, float]:
        """(low, high); 0 to 1 where nothing was counted."""
        n = self.count
        if not n:
            return 0.0, 1.0
        p, z2 = self.share, Z * Z
        middle = (p + z2 / (2 * n)) / (1 + z2 / n)
        half = Z / (1 + z2 / n) * math.sqrt(p * (1 - p) / n + z2 / (4 * n * n))
        return max(middle - half, 0.0), min(middle + half, 1.0)

    def __str__(self) -> str:
        if not self.count:
            return "-"
        low, high = (100 * one for one in self.interval)
        return f"{100 * self.share:.1f} % ({self.hits}/{self.count}; {low:.1f} to {high:.1f})"


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure of the study: what, its target in words, what was found, whether it is reached."""

    what: str
    target: str
    found: str
    reached: bool | None  # None: nothing was counted


def rate(rows: Iterable[Json], key: str) -> Rate:
    """How often `key` is true where it says anything."""
    said = [row[key] for row in rows if row.get(key) is not None]
    return Rate(sum(map(bool, said)), len(said))


def usable(rows: Iterable[Json]) -> list[Json]:
    """The last row of each number whose effect has the size of its cell.

    A case without a verdict is a miss and counts; one that could not be made does not.
    """
    return [one for one in latest(rows) if one.get("sized")]


def latest(rows: Iterable[Json]) -> list[Json]:
    """The last row of each number, by number."""
    return [row for _, row in sorted({one["number"]: one for one in rows}.items())]


def calibration(rows: Iterable[Json]) -> list[tuple[float, Rate]]:
    """(mean stated confidence, hit rate) of the verdicts that name, in bins of confidence."""
    bins: list[list[Json]] = [[] for _ in range(BINS)]
    for row in rows:
        if row["confidence"] is not None:
            bins[min(int(row["confidence"] * BINS), BINS - 1)].append(row)
    return [
        (float(np.mean([one["confidence"] for one in part])), _hits(part)) for part in bins if part
    ]


def _hits(rows: Sequence[Json]) -> Rate:
    """How often the effect that is named first is there."""
    return Rate(sum(one["named"][0] in one["truth"] for one in rows), len(rows))


def figures(rows: Sequence[Json]) -> list[Figure]:
    """Every figure of `discovery.md` that a study can give."""
    good = usable(rows)
    of = {kind: [one for one in good if one["kind"] == kind] for kind in
          ("single", "sensor", "none", "unknown", "pair")}  # fmt: skip
    single = [*of["single"], *of["sensor"]]
    large = [one for one in single if one["size"] >= MATTERS]
    quiet = [one for one in large if one["noise"] <= 0.011]
    loud = [one for one in single if one["noise"] > 0.011]
    marked = [one for one in of["pair"] if (one.get("mark") or 0.0) >= MARKED]
    named = [one for one in good if one["said"] == "named" and one["right"]]
    found = [
        _least("top-1, size >= 3, noise <= 1 %", rate(quiet, "top1"), 0.95),
        _least("set of two, size >= 3, noise <= 1 %", rate(quiet, "two"), 0.98),
        _least("nothing beside it, size >= 3, noise <= 1 %", rate(quiet, "exact"), None),
        _least("top-1, noise 5 %", rate(loud, "top1"), 0.75),
        _least("top-1, size 1.5, noise <= 1 %",
               rate([one for one in single if one["size"] < MATTERS and one["noise"] <= 0.011],
                    "top1"), None),
        _most("nothing hidden: false alarm", rate(of["none"], "false_alarm"), 0.02),
        _least("not in the library: unexplained", rate(of["unknown"], "unexplained"), 0.90),
        _most("not in the library: a wrong name", rate(of["unknown"], "wrong_name"), 0.05),
        _least("not in the library: region right", rate(of["unknown"], "region"), 0.85),
        _least("one effect: region right", rate(of["single"], "region"), None),
        _least("two effects: both", rate(of["pair"], "both"), 0.80),
        _least("two effects: one at least", rate(of["pair"], "one"), 0.97),
        _least("two effects, each with a mark of its own: both", rate(marked, "both"), None),
        _least("two effects, each with a mark of its own: one", rate(marked, "one"), None),
        _calibrated(calibration(good)),
        _median("held-out after / floor, named right", named, "after_floor", 1.10),
        _least("held-out after <= 1.05 oracle, named right",
               _within(named, "after_oracle", 1.05), 0.90),
        _least("gap closed >= 0.95, size >= 3",
               _within([one for one in large if one["right"]], "closed", 0.95, above=True), None),
        *_parameters([one for one in single if abs(one["noise"] - 0.01) < 1e-9]),
        _median("seconds of processor time a case", good, "seconds", 10.0),
    ]  # fmt: skip
    return found


def _least(what: str, found: Rate, target: float | None) -> Figure:
    said = f">= {100 * target:.0f} %" if target is not None else ""
    done = found.share >= target if target is not None and found.count else None
    return Figure(what, said, str(found), done)


def _most(what: str, found: Rate, target: float) -> Figure:
    done = found.share <= target if found.count else None
    return Figure(what, f"<= {100 * target:.0f} %", str(found), done)


def _median(what: str, rows: Sequence[Json], key: str, target: float) -> Figure:
    values = _values(rows, key)
    if not values:
        return Figure(what, f"median <= {target:g}", "-", None)
    middle, high = np.percentile(values, [50, 90])
    found = f"median {middle:.3g}, 90 % below {high:.3g} ({len(values)})"
    return Figure(what, f"median <= {target:g}", found, bool(middle <= target))


def _within(rows: Sequence[Json], key: str, limit: float, above: bool = False) -> Rate:
    values = _values(rows, key)
    return Rate(sum((one >= limit) if above else (one <= limit) for one in values), len(values))


def _values(rows: Sequence[Json], key: str) -> list[float]:
    return [float(one[key]) for one in rows if one.get(key) is not None]


def _parameters(rows: Sequence[Json]) -> list[Figure]:
    """Errors and coverage at 1 % noise of effects that were named: all, and those whose law the
    simulated machine has in the library's own form; another form has other best parameters."""
    told = [each for one in rows for each in one.get("parameters", [])]
    return [
        *_recovered("all forms", told),
        *_recovered("the library's form", [one for one in told if one["alike"]]),
    ]


def _recovered(which: str, told: Sequence[Json]) -> tuple[Figure, Figure]:
    close = Rate(sum(one["error"] <= 0.05 for one in told), len(told))
    covered = rate(told, "covered")
    inside = 0.90 <= covered.share <= 0.98 if covered.count else None
    errors = [one["error"] for one in told]
    middle = f"; median error {100 * float(np.median(errors)):.2g} %" if errors else ""
    every = close.share == 1.0 if close.count else None
    return (
        Figure(f"parameters within 5 %, noise 1 %, {which}", "all", f"{close}{middle}", every),
        Figure(f"intervals cover, noise 1 %, {which}", "90 to 98 %", str(covered), inside),
    )


def _calibrated(bins: list[tuple[float, Rate]]) -> Figure:
    what, target = "stated confidence against hit rate", "within 8 points"
    count = sum(each.count for _, each in bins)
    if not count:
        return Figure(what, target, "-", None)
    off = sum(each.count * abs(stated - each.share) for stated, each in bins) / count
    found = f"{100 * off:.1f} points on average over bins ({count})"
    return Figure(what, target, found, off <= 0.08)


def table(
    rows: Sequence[Json], key: str, row_of: Callable[[Json], str], column_of: Callable[[Json], str]
) -> tuple[list[str], list[str], dict[tuple[str, str], Rate]]:
    """(row names, column names, rate in each) of a figure over two groupings."""
    lines = list(dict.fromkeys(map(row_of, rows)))
    columns = list(dict.fromkeys(map(column_of, rows)))
    cells = {
        (line, column): rate(
            [one for one in rows if (row_of(one), column_of(one)) == (line, column)], key
        )
        for line in lines
        for column in columns
    }
    return lines, columns, cells
