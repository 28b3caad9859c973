"""Gallery of the effects: law, loop without and with it, residual, what it is confused with."""

import re
from textwrap import dedent

from typer.core import TyperGroup

from twin.guide.loops import (
    LEVEL_G,
    draw_loops,
    drive_frequency_hz,
    figure_values,
    find_channel,
    find_loops,
    shows_in_contact,
)
from twin.guide.reference import format_table
from twin.laws.effect import Effect
from twin.laws.library import EFFECTS, load_plugins
from twin.laws.typesetting import typeset_law

ACTIONS = {
    "parameters": "changes parameters; closed form",
    "input": "adds to the acceleration that drives the mass; closed form",
    "linear": "adds a linear state, or moves the gaps; exact linear propagation",
    "force": "adds a force law; integrated with located events",
    "sensor": "changes a channel, not the motion",
}


def write_gallery(_: TyperGroup) -> str:
    """Return the page of all effects, built in and of plug-ins."""
    library = (*EFFECTS, *load_plugins())
    overview = format_table(
        ("effect", "law", "place"),
        (
            (
                f"[`{effect.id}`](#{effect.id})",
                typeset_law(effect.term),
                effect.place.replace("_", " "),
            )
            for effect in library
        ),
    )
    return "\n\n".join(
        [
            "# Effects",
            "Physical effects that a model may have and that `discover` looks for. A model file "
            "adds one by an `[[effects]]` table, and every solver, fit and report then takes it. "
            "Each figure shows the inertia force −M a over the relative displacement u in one "
            "steady cycle, computed by the model: "
            '<span class="key before">without</span> and <span class="key after">with</span> '
            "the effect at its typical values.",
            overview,
            *map(_describe_effect, library),
        ]
    )


def _describe_effect(effect: Effect) -> str:
    """Return the section of an effect."""
    description = effect.description or effect.title or f"{effect.term}."
    title, _, text = description.partition("\n")
    condition = "total gap 4 mm" if shows_in_contact(effect) else "free flight"
    units = {parameter.name: parameter.unit for parameter in effect.parameters}
    values = ", ".join(
        f"{name} = {value:g} {units[name]}".rstrip()
        for name, value in figure_values(effect).items()
    )
    if find_channel(effect):
        values += f" on {find_channel(effect)}"
    parameters = format_table(
        ("parameter", "unit", "bounds", "absent at", "meaning"),
        (
            (
                f"`{parameter.name}`",
                parameter.unit,
                f"{parameter.low:g} to {parameter.high:g}",
                "–" if parameter.vanishing is None else f"{parameter.vanishing:g}",
                parameter.meaning,
            )
            for parameter in effect.parameters
        ),
    )
    confused = ", ".join(f"[`{name}`](#{name})" for name in effect.confused_with)
    toml = ", ".join(f"{parameter.name} = {parameter.typical:g}" for parameter in effect.parameters)
    channel = f'channel = "{find_channel(effect)}", ' if find_channel(effect) else ""
    return "\n\n".join(
        [
            f"## {effect.id}",
            f"**{title}**",
            _typeset_equations(text.strip("\n")),
            f"<figure>{draw_loops(find_loops(effect))}<figcaption>Sine of "
            f"{drive_frequency_hz(effect):g} Hz, {LEVEL_G:g} g, {condition}; {values}."
            "</figcaption></figure>",
            f"**What its absence leaves in the residual.** {effect.residual}",
            f"**Confused with** {confused}." if confused else "",
            f"**How it acts.** {ACTIONS[effect.acts].capitalize()}.",
            parameters,
            f'```toml\n[[effects]]\nid = "{effect.id}"\nparameters = {{ {channel}{toml} }}\n```',
        ]
    )


def _typeset_equations(text: str) -> str:
    """Return the text with its indented blocks, the equations, as typeset HTML."""
    return re.sub(
        r"(?:^    .+\n?)+",
        lambda block: f'<pre class="law">{typeset_law(dedent(block[0]).rstrip())}</pre>\n',
        text,
        flags=re.MULTILINE,
    )
