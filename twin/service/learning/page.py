"""One HTML file that tells a discovery: what differs, what it is, how the gap shrank.

Numbers are those of verdict.json; the file refers to nothing outside itself.
"""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from twin.learn.discover import Discovery, Log
from twin.learn.guess import GAP
from twin.learn.search import LEAST_UNITS
from twin.service.learning.figures import draw_all
from twin.service.learning.figures_evidence import Shown, gates
from twin.service.learning.running_free import misfits, runs_of
from twin.service.learning.told import REFITTED, Json
from twin.service.page import inside, page, significant

LEAST_DIGITS, MOST_DIGITS = 4, 8  # of a number that was fitted
WORDS = {
    "none": "Model and measurement agree to within the noise.",
    "named": "The model lacks {names}.",
    "ambiguous": "The model lacks something, and these recordings cannot tell which: {names}.",
    "unexplained": "The model lacks something that no effect of the library explains.",
}
SECTIONS = {
    "where": "Where they disagree", "candidates": "What was tried", "gates": "The instruments",
    "forces": "The force beyond the model", "histories": "Before and after, on the measured motion",
    "twin": "Before and after, running free", "time": "Over the test",
}  # fmt: skip


def write_page(folder: Path, found: Discovery, logs: Sequence[Log], told: Json) -> Path:
    """Path of folder/report.html, with its figures in folder/figures."""
    shown = Shown(found, logs)
    runs = runs_of(shown)
    pictures = draw_all(shown, told, runs, folder / "figures")
    text = page(
        Path(__file__).with_name("page.html"),
        told=told,
        sentence=sentence(told),
        held_out=held_out(shown),
        rows=rows(told, [log.readings.name for log in logs]),
        logs=[_facts(log) for log in logs],
        sections=SECTIONS,
        whole=found.named.whole,
        gates=gates(shown),
        misfits=misfits(shown, runs),
        images={section: inside(some) for section, some in pictures.items()},
        model=(folder / "model.toml").read_text(encoding="utf-8"),
    )
    path = folder / "report.html"
    path.write_text(text, encoding="utf-8")
    return path


def titled(effect: Json) -> str:
    """What a person calls an effect of the verdict: its id, and the channel of a sensor's."""
    return f"{effect['id']} of {effect['channel']}" if effect.get("channel") else effect["id"]


def sentence(told: Json) -> str:
    """The verdict in one sentence."""
    names = " and ".join(titled(one) for one in told["effects"])
    if told["ambiguous"]:
        names = ", or ".join(" with ".join(some) for some in told["ambiguous"])
    if told["verdict"] == "named" and all(one.get("channel") for one in told["effects"]):
        return f"The model lacks nothing; a sensor errs: {names}."
    text = WORDS[told["verdict"]].format(names=names)
    if told["verdict"] == "none" and told["why"].endswith(REFITTED):
        text = "Nothing is missing, but the model agrees only with other parameters than it has."
    if told["verdict"] == "unexplained" and names:
        text += f" The nearest is {names}, and it is not enough."
    return text


def rows(told: Json, names: Sequence[str]) -> list[tuple[str, str, list[str], str]]:
    """(what, parameter, [value, low, high], unit) of all that was fitted, lengths in mm."""
    term = told["remainder"]["evidence"]
    groups = [(titled(one), one["parameters"]) for one in told["effects"]]
    groups += [(f"a term without a name, {term['term']}", term["parameters"])] if term else []
    base = {_gap(name, names): value for name, value in told["base"].items()}
    found = []
    for what, parameters in (*groups, ("the model's own, refitted", base)):
        for k, (name, value) in enumerate(parameters.items()):
            factor, unit = (1e3, "mm") if value["unit"] == "m" else (1.0, value["unit"] or "–")
            numbers = [factor * value[key] for key in ("value", "low", "high")]
            digits = telling(*numbers)
            shown = [rounded(one, digits) for one in numbers]
            found.append(("" if k else what, name, shown, unit))
    return found


def _gap(name: str, logs: Sequence[str]) -> str:
    number = name.removeprefix(GAP)
    return f"each gap wider, {logs[int(number)]}" if number.isdigit() else name


def telling(value: float, low: float, high: float) -> int:
    """Significant digits of a value that show two of its interval's half width."""
    half, most = 0.5 * (high - low), max(map(abs, (value, low, high)))
    if not (half > 0 and math.isfinite(half)):
        return LEAST_DIGITS
    digits = math.floor(math.log10(most)) - math.floor(math.log10(half)) + 2
    return min(max(digits, LEAST_DIGITS), MOST_DIGITS)


def rounded(value: float, digits: int = LEAST_DIGITS) -> str:
    """So many significant digits, thousands apart."""
    if math.isfinite(value) and abs(value) >= 1e4:
        decimals = max(0, digits - 1 - math.floor(math.log10(abs(value))))
        whole = float(f"{value:.{digits}g}")
        return f"{whole:,.{decimals}f}".replace(",", "\u2009").replace("-", "−")
    return significant(value, digits)


def held_out(shown: Shown) -> str:
    """How the fits were judged, in a sentence."""
    counts = [np.unique(one.readings.step[one.readings.step >= 0]).size for one in shown.sheets]
    what = "steps" if min(counts) >= LEAST_UNITS else "cycles or seconds"
    names = ", ".join(sheet.readings.name for sheet in shown.sheets)
    return (
        f"{names}: fitted on two thirds of the {what}, judged on the third that was left out, "
        "each third in turn. Parameters are those of a last fit on everything."
    )


def _facts(log: Log) -> Json:
    r = log.readings
    gaps = [f"{1e3 * gap:g}" for gap in r.gaps_m]
    return {
        "name": r.name, "seconds": float(r.time_s[-1] - r.time_s[0]), "steps": len(log.steps),
        "mass": r.mass_kg, "channels": r.channels,
        "gaps": "no bumpers" if gaps[0] == "inf" else f"gaps {gaps[0]} and {gaps[1]} mm",
    }  # fmt: skip
