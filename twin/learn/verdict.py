"""The verdict: none, named, ambiguous or unexplained, and how sure it is.

Excess is the held-out mean square over the noise, less the floor.
    none         nothing is left that chance does not explain
    named        the effects close the gap, no others do as well, and no general term does better
    ambiguous    other effects do as well: the data cannot tell
    unexplained  something is left, or a general term explains it much better than any name
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from twin.learn.guess import ZERO, log_of
from twin.learn.naming import Bench, Explained, Named

AS_GOOD = 3.5  # standard errors by which others must be worse, else the data cannot tell
NEARLY = 0.8  # of what the best close: others that close less are not as good, however few the data
LEFT = 0.06  # of the gap's excess: more than this left and not all is explained
OUTSIDE = 0.012  # of the gap's excess: a general term in place of a name that closes more is better
IN_PLACE = 0.001  # of the gap's excess: the same for one of several names, the others kept
VISIBLE = 0.05  # excess in parts of the floor from which on there is a gap at all
APART = 1.6  # a factor: a base parameter so far off both start and null has given way to a name
ALIKE = 1.2  # a factor: start and null so near say the same, and the start is no second opinion
NEVER_AT_BOUND = ("stiffness", "damping", "bumper_stiffness")  # of a real specimen
PARTIAL = 0.5  # of the gap's excess: what closes less is no name


@dataclass(frozen=True, eq=False)
class Verdict:
    """The word, what stands for it, and the numbers behind it (mean squares over the noise)."""

    word: str
    best: Explained
    confidence: float
    others: tuple[Explained, ...]  # as good as the best, where the word is ambiguous
    general: Explained | None  # the general term that does better, or alone does something
    floor: float
    remainder: bool  # more is left than the floor and the form of the law explain
    why: str


def judge(
    bench: Bench,
    named: Named,
    floor: float,
    start: Mapping[str, float] | None = None,
    noise: float = 1.0,
) -> Verdict:
    """What the outcome of a selection is worth; `floor` is a mean square over the noise.

    `start` are the base's parameters of the model that was given: a second opinion on them.
    `noise` is what the sensors' noise alone would leave: below it there is nothing to name.
    """
    null, best = named.null, named.best
    gap = max(null.cost - floor, 1e-9)
    general = _better(bench, named, floor)
    beside = general is not None and _adds(named, general, gap)
    if null.cost < noise and null.cost < (1 + 2 * VISIBLE) * best.cost:
        why = "the model leaves less than the noise that the sensors have"
        return Verdict("none", null, 0.9, (), None, floor, False, why)
    if not best.effects:
        return _nothing_named(bench, named, floor, general)
    left = max(best.cost - floor, 0.0)
    rivals = _rivals(bench, named)
    as_good = [one for one, errors in rivals if one.cost <= best.cost or errors < AS_GOOD]
    if at_ease := [one for one in as_good if _strained(one) < _strained(best)]:
        better = min(at_ease, key=lambda one: one.cost)
        return judge(bench, replace(named, best=better), floor, start, noise)
    others = tuple({frozenset(one.names): one for one in reversed(as_good)}.values())
    remainder = left > LEFT * gap and left > VISIBLE * floor
    sure = _confidence(named, rivals, left / gap)
    if doubt := _doubt(named, None if beside else general, start or {}, remainder, gap):
        return Verdict("unexplained", best, min(sure, 0.3), (), general, floor, True, doubt)
    if others and (core := _core(bench, named, others, floor, start, noise)):
        return core
    if others:
        names = "; ".join(" + ".join(one.names) for one in others)
        why = f"as good as {' + '.join(best.names)}: {names}"
        share = sure / (1 + len(others))
        return Verdict("ambiguous", best, share, others, general, floor, remainder, why)
    why = "what is left is noise"
    if left > VISIBLE * floor:
        part = 100 * math.sqrt(left / gap)
        why = f"beyond noise {part:.2g} % of the gap is left, as the form of a law may leave"
    if general is not None:
        why = f"more is left, unexplained; it looks like {general.names[-1]}"
        sure, remainder = 0.8 * sure, True
    elif remainder:
        why = "more is left, unexplained"
    return Verdict("named", best, sure, (), general, floor, remainder, why)


def _core(
    bench: Bench,
    named: Named,
    others: Sequence[Explained],
    floor: float,
    start: Mapping[str, float] | None,
    noise: float,
) -> Verdict | None:
    """What every set that does as well has in common, where that is a name by itself."""
    sets = [set(one.names) for one in (named.best, *others)]
    common = set.intersection(*sets)
    alone = [one for one in named.tried if common and set(one.names) == common]
    if not alone:
        return None
    core = min(alone, key=lambda one: one.cost)
    # a term in the place of what they share says nothing of it
    terms = [one for one in named.outside if len(one.effects) == 1 or common < set(one.names)]
    of_core = replace(named, best=core, outside=tuple(terms))
    verdict = judge(bench, of_core, floor, start, noise)
    if verdict.word != "named":
        return None
    rest = " or ".join(dict.fromkeys(" + ".join(sorted(one - common)) for one in sets))
    why = f"more is left, of which {rest} would explain a part: the data cannot tell"
    return replace(verdict, remainder=True, why=why)


def _doubt(
    named: Named,
    general: Explained | None,
    start: Mapping[str, float],
    remainder: bool,
    gap: float,
) -> str:
    """Why the best effects are no names after all; empty where they are."""
    best = named.best
    names = " + ".join(best.names)
    if general is not None:
        return f"{general.names[-1]} explains what {names} cannot"
    if bent := _gave_way(named, start):
        return f"{names} would close the gap only if {bent}"
    if remainder and (named.null.cost - best.cost) < PARTIAL * gap:
        return "the best effects close less than half of the gap"
    stuck = [one.amplitude.name for one in best.effects if one.amplitude.name in best.fit.at_bound]
    return (
        f"{', '.join(stuck)} stands at its bound, and more is left" if remainder and stuck else ""
    )


def _nothing_named(bench: Bench, named: Named, floor: float, general: Explained | None) -> Verdict:
    null = named.null
    if general is not None and bench.worth(null, general):
        why = f"no effect of the library, but {general.names[-1]} explains something"
        return Verdict("unexplained", null, 0.9, (), general, floor, True, why)
    if null.cost > (1 + 2 * VISIBLE) * floor:
        why = "more is left than noise, and nothing explains it"
        return Verdict("unexplained", null, 0.8, (), None, floor, True, why)
    if stuck := [name for name in NEVER_AT_BOUND if name in null.fit.at_bound]:
        why = f"only with {', '.join(stuck)} at its bound is what is left noise: no such specimen"
        return Verdict("unexplained", null, 0.8, (), None, floor, True, why)
    return Verdict("none", null, 0.95, (), None, floor, False, "what is left is noise")


def _better(bench: Bench, named: Named, floor: float) -> Explained | None:
    """The set with a general term that does much better than the best one without."""
    best, gap = named.best, max(named.null.cost - floor, 1e-9)
    for one in sorted(named.outside, key=lambda one: one.cost):
        gain = best.cost - one.cost
        beside = len(one.effects) > len(best.effects) > 0
        if gain > (LEFT if beside else OUTSIDE) * gap and bench.gain(best, one)[2] > AS_GOOD:
            return one
        in_place = len(one.effects) == len(best.effects) > 1
        if in_place and gain > IN_PLACE * gap and bench.gain(best, one)[2] > AS_GOOD:
            return one
        if len(one.effects) < len(best.effects) and gain > -OUTSIDE * gap:
            return one  # one term does what several effects do
    return None


def _adds(named: Named, general: Explained, gap: float) -> bool:
    """True where the named effects are needed beside the general term: it alone does much worse."""
    if len(general.effects) <= len(named.best.effects):
        return False
    alone = [one.cost for one in named.outside if len(one.effects) == 1]
    return min(alone, default=math.inf) - general.cost > LEFT * gap


def _gave_way(named: Named, start: Mapping[str, float]) -> str:
    """The damper's spring or dashpot that had to become another one for the names to fit."""
    for name in ("stiffness", "damping"):
        was = start.get(name, 0.0)
        null, best = (one.fit.values.get(name, 0.0) for one in (named.null, named.best))
        if min(was, null) <= 0 or _factor(was, null) < ALIKE:
            continue
        if best <= 0 or min(_factor(best, was), _factor(best, null)) > APART:
            return f"the {name} were {best:.4g}, not {was:.4g} as the model says"
    return ""


def _factor(a: float, b: float) -> float:
    return max(a / b, b / a)


def _rivals(bench: Bench, named: Named) -> list[tuple[Explained, float]]:
    """(a set of other effects, as many, that closes nearly as much; standard errors by which it is
    worse)."""
    best = named.best
    return [
        (one, bench.gain(one, best)[2])
        for one in named.tried
        if len(one.effects) == len(best.effects)
        and frozenset(one.names) != frozenset(best.names)
        and named.null.cost - one.cost >= NEARLY * (named.null.cost - best.cost)
        and not _limit(one, best)
        and not _strained(one) - _strained(best)
    ]


def _strained(one: Explained) -> set[str]:
    """The tares that a fit needs further off than a tare can be: that alone speaks against it."""
    return {name for name in one.fit.at_bound if name.startswith(ZERO) and log_of(name) is not None}


def _limit(one: Explained, best: Explained) -> bool:
    """True where one has a hysteresis that yields at once in the place of a friction: the same."""
    swapped = {*one.names} ^ {*best.names} == {"bouc_wen", "coulomb_friction"}
    return swapped and "coulomb_friction" in best.names


def _confidence(named: Named, rivals: Sequence[tuple[Explained, float]], left: float) -> float:
    """Between 0 and 1: how much better than the next, and how little is left."""
    best = named.best
    margin = min((errors for _, errors in rivals), default=10.0)
    apart = 1.0 / (1.0 + math.exp(-(margin - 2.0)))
    # in parts of the gap's rms: the form of a law may leave a sixth, half is another law
    whole = 0.4 + 0.6 / (1.0 + math.exp((math.sqrt(max(left, 0.0)) - 0.27) / 0.04))
    held = 1.0 if best.fit.converged and not best.fit.at_bound else 0.6
    return 0.98 * apart * whole * held


def closed_fraction(before: float, after: float, floor: float) -> float:
    """(before - after) / (before - floor) of the roots of mean squares."""
    b, a, f = (math.sqrt(max(x, 0.0)) for x in (before, after, floor))
    return (b - a) / (b - f) if b > f else 0.0


def next_run(word: str, best: Sequence[str], others: Sequence[Sequence[str]]) -> str:
    """The test that would decide or confirm."""
    names = {one.split(".")[0] for some in (best, *others) for one in some}
    if word == "none":
        return "none is needed; a sweep at another amplitude would confirm"
    if names & {"bouc_wen", "maxwell_damper", "coulomb_friction", "quadratic_damping"}:
        return (
            "the same sweep at half and at twice the amplitude: hysteresis and friction change "
            "with amplitude, relaxation only with frequency"
        )
    if any(one.startswith("sensor_") for one in names):
        return "a calibration of the channels named, and the same sweep after it"
    if names & {"gap_offset", "gap_drift", "bumper_asymmetry"}:
        return "the same sweep once more without touching the set-up, then with another gap"
    if names & {"bumper_hardening", "hunt_crossley", "bumper_maxwell"}:
        return "a sweep at twice the amplitude: deeper contact, faster touch"
    return "the same sweep at another amplitude and, where there are bumpers, another gap"
