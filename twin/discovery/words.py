"""Verdicts in words: the headline, the typeset law of each effect, the state of the sensors."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from twin.discovery.build_verdict import REFITTED_SUFFIX
from twin.discovery.result import (
    EffectResult,
    ExcludedSet,
    FittedNuisance,
    Interval,
    LawTerm,
    ProposedLaw,
    SensorCheckResult,
    Sensors,
    Verdict,
)
from twin.drawing.page import format_significant
from twin.laws.library import find_effect
from twin.laws.typesetting import typeset_law
from twin.results.quantities import format_quantity

MAX_EXCLUDED = 3  # rivals that the headline names
PROPER_NAMES = ("bouc_wen", "coulomb_friction", "hunt_crossley", "stribeck_friction")
VERDICT_SENTENCES = {
    "none": "Model and measurement agree to within the noise.",
    "named": "The model lacks {names}.",
    "ambiguous": "The model lacks an effect, but these recordings do not determine which: {names}.",
    "unexplained": "The model lacks an effect that is not in the library.",
}
KIND_LABELS = {
    "noise": "noise at rest, rms",
    "hum": "mains hum over noise",
    "one_over_f": "1/f noise up to",
    "resolution": "resolution over signal",
    "filter": "anti-alias filter",
    "gain": "gain error",
    "lag": "lag",
    "low_cut": "low cut",
    "resonance": "resonance of the mounting",
    "remainder": "disagreement left",
    "share": "share of the first cell less half",
    "plate": "mass in front of the cells",
    "gap": "true less stated gap",
    "offset": "offset",
    "slow_offset": "slow drift of the offset",
    "linearity": "linearity error",
    "share_slope": "change of the share with position",
    "cross": "table's acceleration in the channel",
}
CHANNEL_KINDS = ("noise", "hum", "one_over_f", "resolution", "filter")  # of a channel at rest
LEAST_SHOWN = 1e-12  # SI: a smaller value is that of a bound
LEAST_SHARE = 1e-3  # that is shown as a number
# Units in which quantities are read: factor and name, by kind or by unit in SI.
SHOWN_UNITS = {
    "s": (1e6, "\u00b5s"), "m": (1e6, "\u00b5m"), "gain": (100.0, "%"),
    "resolution": (100.0, "%"), "remainder": (100.0, "%"), "plate": (100.0, "%"),
    "share": (100.0, "%"), "linearity": (100.0, "%"), "share_slope": (100.0, "%"),
    "cross": (100.0, "%"),
}  # fmt: skip


@dataclass(frozen=True)
class EffectLaw:
    """Typeset law of an effect, its trace in the residual, and its fitted parameters."""

    law: str
    residual: str
    parameters: Mapping[str, Interval]


@dataclass(frozen=True)
class TypesetTerm:
    """Term of a proposed law for the page: equations, numbers, range and the file that has it."""

    title: str
    equations: Sequence[str]
    parameters: Mapping[str, Interval]
    range: str
    file: str


def format_effect(effect: EffectResult) -> str:
    """Return the display name of an effect: its id, with the channel of a sensor effect."""
    return f"{effect.id} of {effect.channel}" if effect.channel else effect.id


def name_effect(effect: str, channel: str | None = None) -> str:
    """Return an effect in words of physics, with the channel of a sensor effect."""
    words = find_effect(effect).summary
    words = words if words[1:2].isupper() else words[0].lower() + words[1:]
    words = words if effect not in PROPER_NAMES else words[0].upper() + words[1:]
    return f"{words} of {channel}" if channel else words


def format_verdict(verdict: Verdict) -> str:
    """Return the verdict as one sentence in words of physics."""
    names = " and ".join(name_effect(effect.id, effect.channel) for effect in verdict.effects)
    if verdict.ambiguous:
        names = ", or ".join(" with ".join(ids) for ids in verdict.ambiguous)
    if verdict.verdict == "named" and all(effect.channel for effect in verdict.effects):
        return f"No effect is missing; a sensor has an error: {names}."
    text = VERDICT_SENTENCES[verdict.verdict].format(names=names)
    if verdict.verdict == "none" and verdict.why.endswith(REFITTED_SUFFIX):
        text = "No effect is missing, but the model agrees only with other parameters than it has."
    if verdict.law:
        titles = " and ".join(term.title for term in verdict.law.terms)
        return f"{text} A law was found for it: {titles}."
    if verdict.verdict == "unexplained" and names:
        text += f" The closest is {names}, but it is not sufficient."
    return text


def describe_laws(verdict: Verdict) -> list[EffectLaw]:
    """Return the law, the trace in the residual and the numbers of each effect of the verdict."""
    definitions = [find_effect(effect.id) for effect in verdict.effects]
    return [
        EffectLaw(typeset_law(definition.term), definition.residual, effect.parameters)
        for definition, effect in zip(definitions, verdict.effects, strict=True)
    ]


def describe_excluded(verdict: Verdict) -> list[ExcludedSet]:
    """Return the rivals that are named next to the effects: those that fit best."""
    return verdict.excluded[:MAX_EXCLUDED]


def format_interval(value: Interval) -> str:
    """Format a fitted value with half its 95 % interval and its unit."""
    return format_quantity(value.value, value.unit, value.half_width)


def describe_proposal(law: ProposedLaw) -> list[str]:
    """Return a proposed law as lines: its equation, numbers, range and what it explains."""
    lines = []
    for term in law.terms:
        where = {"damper": "in the damper", "input": "on the table"}.get(term.place, "in contact")
        lines.append(f"proposed law, {term.title} {where}: {_symbol(term)} = {term.force}")
        lines += [f"  with d{name}/dt = {rate}" for name, rate in term.states.items()]
        lines += [f"  {name} = {format_interval(value)}" for name, value in term.parameters.items()]
        limits = [f"{name} {low:.3g} to {high:.3g}" for name, (low, high) in term.range.items()]
        if limits:
            lines.append(f"  fitted for {', '.join(limits)} (SI)")
    lines.append(
        f"  it closes {100 * law.closed_fraction:.0f} % of the misfit: "
        f"{law.held_out_before:.3g} -> {law.held_out_after:.3g} times the noise on held-out "
        f"steps (floor {law.noise_floor:.3g}); nearest effect of the library: "
        f"{law.nearest or 'none'}"
    )
    return lines


def typeset_proposal(law: ProposedLaw) -> list[TypesetTerm]:
    """Return the terms of a proposed law for the page: equation, numbers and range."""
    terms = []
    for term in law.terms:
        equations = [f"{_symbol(term)} = {term.force}"]
        equations += [f"{name}' = {rate}" for name, rate in term.states.items()]
        limits = [
            f"{name} from {low:.3g} to {high:.3g}" for name, (low, high) in term.range.items()
        ]
        typeset = [typeset_law(equation.replace("**", "^")) for equation in equations]
        terms.append(
            TypesetTerm(term.title, typeset, term.parameters, ", ".join(limits), f"{term.id}.toml")
        )
    return terms


def _symbol(term: LawTerm) -> str:
    """Return the symbol of what a term adds: an acceleration of the table, or a force."""
    return "A" if term.place == "input" else "F"


class CheckRow(NamedTuple):
    """Row of a table of checks; texts by column, and whether each is healthy."""

    log: str
    label: str
    cells: tuple[tuple[str, bool], ...]


def describe_sensors(sensors: Sensors) -> list[str]:
    """Return the verdict on the instruments in lines: one, and one for each error.

    What healthy sensors of a body disagree by beyond their noise, as of a mass that rocks, is
    stated too: it moves parameters by more than their intervals, which count the noise.
    """
    lines = [f"sensors: {sensors.state}"]
    for check in sensors.checks:
        if check.healthy and not (check.kind == "remainder" and check.limit):
            continue
        limit = _format_size(check, check.limit) if check.limit else ""
        side = "from" if check.kind in ("filter", "resonance") else "up to"
        if check.healthy:
            allowed = f", within the {limit} allowed; the intervals do not count it"
        else:
            allowed = f", allowed {side} {limit}" if limit else ""
        lines.append(
            f"  {KIND_LABELS.get(check.kind, check.kind)} of "
            f"{' against '.join(check.channels)}: {_format_size(check, check.value)}{allowed}"
        )
    return lines


def tabulate_channels(sensors: Sensors) -> list[CheckRow]:
    """Return a row per channel with what its readings at rest show, in CHANNEL_KINDS."""
    by_place: dict[tuple[str, str], dict[str, SensorCheckResult]] = {}
    for check in sensors.checks:
        if check.kind in CHANNEL_KINDS:
            by_place.setdefault((check.log, check.channels[0]), {})[check.kind] = check
    return [
        CheckRow(
            log, channel,
            tuple(
                (_format_size(checks[kind], checks[kind].value), checks[kind].healthy)
                if kind in checks else ("\u2013", True)
                for kind in CHANNEL_KINDS
            ),
        )
        for (log, channel), checks in by_place.items()
    ]  # fmt: skip


def tabulate_comparisons(sensors: Sensors) -> list[CheckRow]:
    """Return a row per other check: label and channels; value, interval and limit."""
    rows = []
    for check in sensors.checks:
        if check.kind in CHANNEL_KINDS:
            continue
        interval = "\u2013"
        if check.high > check.low:
            interval = f"{_format_size(check, check.low)} to {_format_size(check, check.high)}"
        limit = _format_size(check, check.limit) if check.limit else "\u2013"
        texts = (_format_size(check, check.value), interval, limit)
        label = f"{KIND_LABELS.get(check.kind, check.kind)}: {', '.join(check.channels)}"
        rows.append(CheckRow(check.log, label, tuple((t, check.healthy) for t in texts)))
    return rows


@dataclass(frozen=True)
class NuisanceRow:
    """Fitted error of an instrument or of the set-up: where, what, how large, over the typical."""

    log: str
    label: str
    size: str
    typical: float


def tabulate_nuisances(nuisances: Sequence[FittedNuisance]) -> list[NuisanceRow]:
    """Return a row per fitted error of an instrument or of the set-up."""
    return [
        NuisanceRow(
            each.log,
            ", ".join(filter(None, (KIND_LABELS[_generalize(each.kind)], each.place))),
            _format_size(each, each.value),
            each.typical,
        )
        for each in nuisances
    ]


def _generalize(kind: str) -> str:
    """Return the kind of an error without the number of its term."""
    if kind.startswith("chebyshev"):
        return "linearity"
    return "slow_offset" if kind.startswith("offset") and kind != "offset" else kind


def format_share(share: float) -> str:
    """Format a share or probability in percent, near 0 and 1 as a bound."""
    if 0.0 < share < LEAST_SHARE:
        return f"< {100 * LEAST_SHARE:g} %"
    if 1.0 - LEAST_SHARE < share < 1.0:
        return f"> {100 * (1.0 - LEAST_SHARE):g} %"
    return f"{format_significant(100 * share, 3)} %"


def _format_size(error: SensorCheckResult | FittedNuisance, value: float) -> str:
    """Format the size of an error of an instrument in the unit in which it is read."""
    unit = error.unit
    factor, name = SHOWN_UNITS.get(_generalize(error.kind), SHOWN_UNITS.get(unit, (1.0, unit)))
    shown = factor * value if abs(value) > LEAST_SHOWN else 0.0
    return f"{format_significant(shown)} {name}".strip()
