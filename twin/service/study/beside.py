"""Lines of a study's page: rivals beside discovery on the same files, and the controls. Pure."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from statistics import median
from typing import Any

from twin.service.study.rates import Rate, latest, rate

Json = Mapping[str, Any]
OURS = "discovery"
SILENT = frozenset({"blackbox"})  # give an error and no name
WAYS = {
    "reversed": "time reversed: a confident name",
    "without": "truth not in the library: a confident name",
}


def compared(rows: Sequence[Json]) -> Iterator[str]:
    """Rivals and discovery, by effect: how often named first, and the held-out error (median)."""
    met = [one for one in rows if one.get("rivals") and one["kind"] in ("none", "single", "sensor")]
    rivals = list(dict.fromkeys(name for one in met for name in one["rivals"]))
    if not met:
        return
    names = [OURS, *(one for one in rivals if one not in SILENT)]
    yield "\n## Rivals on the same files\n"
    yield (
        "Right: one effect named first, or nothing where nothing is hidden. Held out: median of "
        "the rms over the noise on steps that were not fitted, over the same entries.\n"
    )
    heads = [f"right: {one}" for one in names] + [f"held out: {one}" for one in (OURS, *rivals)]
    yield f"| hidden | {' | '.join(heads)} |"
    yield "|---" * (len(heads) + 1) + "|"
    groups: dict[str, list[Json]] = {}
    for one in met:
        groups.setdefault((one["truth"] or ["(nothing)"])[0], []).append(one)
    for hidden, group in [*groups.items(), ("all", met)]:
        right = [str(rate([_of(one, who) for one in group], "right")) if hidden == "all"
                 else _counted([_of(one, who) for one in group]) for who in names]  # fmt: skip
        error = [_median([_of(one, who) for one in group]) for who in (OURS, *rivals)]
        yield f"| {hidden} | {' | '.join([*right, *error])} |"


def _of(row: Json, who: str) -> dict[str, Any]:
    found: dict[str, Any] = dict(row) if who == OURS else row["rivals"].get(who, {})
    return found


def _counted(rows: Sequence[dict[str, Any]]) -> str:
    found = rate(rows_with(rows, "right"), "right")
    return f"{found.hits}/{found.count}"


def rows_with(rows: Sequence[dict[str, Any]], key: str) -> list[dict[str, Any]]:
    """Those that say something about `key`."""
    return [one for one in rows if one.get(key) is not None]


def _median(rows: Sequence[dict[str, Any]]) -> str:
    known = [float(one["held_out"]) for one in rows_with(rows, "held_out")]
    return f"{median(known):.3f}" if known else "-"


def controlled(controls: Sequence[Json], rows: Sequence[Json]) -> Iterator[str]:
    """The controls that must fail: how often each fooled, what was said; and shuffled truths."""
    done = [one for one in latest(dict(one) for one in controls) if "right" in one]
    if not done:
        return
    yield "\n## Controls that must fail\n"
    yield "| control | fooled | said |"
    yield "|---|---|---|"
    for way, words in WAYS.items():
        told = [one[way] for one in done]
        fooled = Rate(sum(one["fooled"] for one in told), len(told))
        each = ", ".join(f"{w} {n}" for w, n in Counter(one["said"] for one in told).most_common())
        yield f"| {words} | {fooled} | {each} |"
    single = [one for one in rows if one["kind"] == "single"]
    if len(single) > 1:
        own, others, guess = (f"{100 * one:.1f} %" for one in shuffled(single))
        yield (
            f"| truths shuffled: hits | {others} | own truth {own}; the best fixed guess {guess} |"
        )


def shuffled(rows: Sequence[Json]) -> tuple[float, float, float]:
    """(hit rate on the own truth, on that of every other case, of the best fixed guess).

    Of rows of one effect each, as `score` makes them. Exact: the mean over all shuffles in which
    no case keeps its place.
    """
    told = [one["named"][0] if one["said"] == "named" and one["named"] else None for one in rows]
    truths = [one["truth"][0] for one in rows]
    own = sum(a == b for a, b in zip(told, truths, strict=True))
    counts = Counter(truths)
    every = sum(counts[name] for name in told)
    count = max(len(rows), 1)
    others = (every - own) / max(count * (count - 1), 1)
    return own / count, others, max(counts.values(), default=0) / count
