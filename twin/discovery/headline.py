"""Headline of a discovery in words of physics, with the typeset law of each effect."""

from twin.discovery.serialize import REFITTED_SUFFIX, Json
from twin.laws.library import find_effect
from twin.laws.typesetting import typeset_law
from twin.results.quantities import format_quantity

MAX_EXCLUDED = 3  # rivals that the headline names
VERDICT_SENTENCES = {
    "none": "Model and measurement agree to within the noise.",
    "named": "The model lacks {names}.",
    "ambiguous": "The model lacks an effect, but these recordings do not determine which: {names}.",
    "unexplained": "The model lacks an effect that is not in the library.",
}


def format_effect(effect: Json) -> str:
    """Return the display name of an effect: its id, with the channel of a sensor effect."""
    return f"{effect['id']} of {effect['channel']}" if effect.get("channel") else effect["id"]


def name_effect(effect: Json) -> str:
    """Return an effect in words of physics, with the channel of a sensor effect."""
    words = find_effect(effect["id"]).summary
    words = words if words[1:2].isupper() else words[0].lower() + words[1:]
    words = words if effect["id"] not in PROPER_NAMES else words[0].upper() + words[1:]
    return f"{words} of {effect['channel']}" if effect.get("channel") else words


PROPER_NAMES = ("bouc_wen", "coulomb_friction", "hunt_crossley", "stribeck_friction")


def format_verdict(verdict: Json) -> str:
    """Return the verdict as one sentence in words of physics."""
    names = " and ".join(name_effect(effect) for effect in verdict["effects"])
    if verdict["ambiguous"]:
        names = ", or ".join(" with ".join(ids) for ids in verdict["ambiguous"])
    if verdict["verdict"] == "named" and all(
        effect.get("channel") for effect in verdict["effects"]
    ):
        return f"No effect is missing; a sensor has an error: {names}."
    text = VERDICT_SENTENCES[verdict["verdict"]].format(names=names)
    if verdict["verdict"] == "none" and verdict["why"].endswith(REFITTED_SUFFIX):
        text = "No effect is missing, but the model agrees only with other parameters than it has."
    if law := verdict.get("law"):
        titles = " and ".join(term["title"] for term in law["terms"])
        return f"{text} A law was found for it: {titles}."
    if verdict["verdict"] == "unexplained":
        if term := verdict["remainder"]["evidence"]:
            text += f" A general law would fit: {term['term']}."
        if names:
            text += f" The closest is {names}, but it is not sufficient."
    return text


def describe_laws(verdict: Json) -> list[Json]:
    """Return the law, the trace in the residual and the numbers of each effect of the verdict."""
    laws = []
    for effect in verdict["effects"]:
        definition = find_effect(effect["id"])
        laws.append(
            {
                "id": format_effect(effect),
                "law": typeset_law(definition.term),
                "residual": definition.residual,
                "parameters": effect["parameters"],
            }
        )
    return laws


def describe_excluded(verdict: Json) -> list[Json]:
    """Return the rivals that are named next to the effects: those that fit best."""
    return list((verdict.get("excluded") or [])[:MAX_EXCLUDED])


def format_interval(value: Json) -> str:
    """Format a fitted value with half its 95 % interval and its unit."""
    return format_quantity(value["value"], value["unit"], 0.5 * (value["high"] - value["low"]))


def describe_proposal(law: Json) -> list[str]:
    """Return a proposed law as lines: its equation, numbers, range and what it explains."""
    lines = []
    for term in law["terms"]:
        symbol = "A" if term["place"] == "input" else "F"
        where = {"damper": "in the damper", "input": "on the table"}.get(
            term["place"], "in contact"
        )
        lines.append(f"proposed law, {term['title']} {where}: {symbol} = {term['force']}")
        lines += [f"  with d{name}/dt = {rate}" for name, rate in term["states"].items()]
        lines += [
            f"  {name} = {format_interval(value)}" for name, value in term["parameters"].items()
        ]
        limits = [f"{name} {low:.3g} to {high:.3g}" for name, (low, high) in term["range"].items()]
        if limits:
            lines.append(f"  fitted for {', '.join(limits)} (SI)")
    lines.append(
        f"  it closes {100 * law['closed_fraction']:.0f} % of the misfit: "
        f"{law['held_out_before']:.3g} -> {law['held_out_after']:.3g} times the noise on held-out "
        f"steps (floor {law['noise_floor']:.3g}); nearest effect of the library: "
        f"{law['nearest'] or 'none'}"
    )
    return lines


def typeset_proposal(law: Json | None) -> list[Json]:
    """Return the terms of a proposed law for the page: equation, numbers and range."""
    if law is None:
        return []
    terms = []
    for term in law["terms"]:
        symbol = "A" if term["place"] == "input" else "F"
        equations = [f"{symbol} = {term['force']}"]
        equations += [f"{name}' = {rate}" for name, rate in term["states"].items()]
        limits = [
            f"{name} from {low:.3g} to {high:.3g}" for name, (low, high) in term["range"].items()
        ]
        terms.append(
            {
                "title": term["title"],
                "equations": [typeset_law(equation.replace("**", "^")) for equation in equations],
                "parameters": term["parameters"],
                "range": ", ".join(limits),
                "file": f"{term['id']}.toml",
            }
        )
    return terms
