"""HTML report of a search by features; the numbers are those of features.json."""

from pathlib import Path

from twin.discovery.feature_labels import label_feature, name_fit
from twin.discovery.features.search import FeatureDiscovery, describe_effects
from twin.discovery.features_figures import draw_feature_pairs
from twin.discovery.headline import name_effect
from twin.drawing.page import embed_images, render_page
from twin.laws.library import find_effect
from twin.laws.typesetting import typeset_law
from twin.results.quantities import format_quantity
from twin.results.summary import Json

HEADLINES = {
    "none needed": "No effect is needed: other parameters explain as much.",
    "named": "The model lacks {names}.",
    "ambiguous": "The features do not determine what is missing; {names} explains the most.",
}


def write_features_page(
    folder: Path, discovery: FeatureDiscovery, content: Json, model_toml: str
) -> Path:
    """Write folder/report.html and its figures to folder/figures; return the path of the page."""
    pairs = draw_feature_pairs(discovery, content, folder / "figures")
    light, dark = (embed_images(pair[side] for pair in pairs) for side in (0, 1))
    best = next((fit for fit in content["fits"] if fit["effects"] == content["best"]), None)
    text = render_page(
        Path(__file__).with_name("features_page.html"),
        content=content,
        headline=format_features_headline(content),
        best=best or content["refitted"],
        name=name_fit,
        label=label_feature,
        quantity=format_parameter,
        laws=[(typeset_law(find_effect(id).term), find_effect(id).residual)
              for id in content["best"]],
        terms=describe_effects,
        pictures=list(zip(light, dark, strict=True)),
        model=model_toml,
    )  # fmt: skip
    path = folder / "report.html"
    path.write_text(text, encoding="utf-8")
    return path


def format_features_headline(content: Json) -> str:
    """Return the result of a search by features as one sentence."""
    names = " and ".join(name_effect({"id": effect}) for effect in content["best"])
    return HEADLINES[content["verdict"]].format(names=names)


def format_parameter(value: Json) -> str:
    """Format a fitted value with half its 95 % interval, where the features bound it."""
    half = None
    if value["low"] == value["low"]:
        half = 0.5 * (value["high"] - value["low"])
    return format_quantity(value["value"], value["unit"], half)
