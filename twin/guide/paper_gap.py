"""Page on the departures of the seed paper's model from its own experiment.

The numbers are those of `shaketwin discover --features paper`, whose features.json is shipped as
paper_features.json, because the search takes minutes.
"""

from collections.abc import Iterable
from pathlib import Path

from typer.core import TyperGroup

from twin.discovery.result import FeatureVerdict, Interval, label_feature, name_fit
from twin.guide.reference import format_table
from twin.results.quantities import format_quantity

RESULT_FILE = Path(__file__).with_name("paper_features.json")
MAX_FITS = 8  # of the ranking


def write_paper_gap(_: TyperGroup) -> str:
    """Return the page: features as given, refitted and with the best effect, price, next run."""
    content = FeatureVerdict.model_validate_json(RESULT_FILE.read_text(encoding="utf-8"))
    best = content.best_fit or content.refitted
    name = name_fit(content.best)
    return "\n\n".join(
        [
            "# The paper's own gap",
            f"The model of the seed paper departs from the paper's own experiment. `shaketwin "
            f"discover --features paper` takes {len(content.features)} features that were "
            "published, each with its place in the text and a tolerance, and asks which effect "
            "explains them better than the same model with other parameters. This page is its "
            "result; how it works is in [Identification and discovery](discovery.md).",
            f"**{content.verdict.capitalize()}**: {content.why}.",
            "## Models",
            _format_models(content),
            "Gained and lost are counted against the refitted base: what an effect loses is its "
            "price.",
            "\n".join(f"* {note}" for note in content.notes),
            f"## The best model: {name}",
            format_table(
                ("parameter", "value, with half of its 95 % interval"),
                ((key, _format_value(value)) for key, value in best.parameters.items()),
            ),
            "A tolerance is read as two standard deviations; without an interval the features do "
            "not bound the value. `paper_hysteresis` in `profiles/models` is its model file, "
            "the rig `paper_like` has a hysteresis of this size in another form.",
            "## What stays unexplained",
            _list_features(content, content.unexplained),
            "## The price",
            _list_features(content, best.lost),
            "## The run that would decide",
            f"{content.next_run[0].upper()}{content.next_run[1:]}.",
            "## Features",
            _format_features(content, name),
        ]
    )


def _format_models(content: FeatureVerdict) -> str:
    count = len(content.features)
    fits = [("as given", content.given), ("base refitted", content.refitted)]
    fits += [(name_fit(fit.effects), fit) for fit in content.fits[:MAX_FITS]]
    rows = (
        (
            name,
            f"{fit.explained} of {count}",
            str(len(fit.gained)),
            str(len(fit.lost)),
            f"{fit.misfit:.1f}",
        )
        for name, fit in fits
    )
    return format_table(("model", "explained", "gained", "lost", "misfit"), rows)


def _format_features(content: FeatureVerdict, best_name: str) -> str:
    rows = (
        (
            f"{label_feature(entry)} ({entry.place})",
            *(f"{model.text}{'' if model.explained else ' ✗'}"
              for model in (entry.given, entry.refitted, entry.best)),
        )
        for entry in content.features
    )  # fmt: skip
    table = format_table(("published", "as given", "refitted", best_name), rows)
    return f"{table}\n\n✗: more than the tolerance off."


def _list_features(content: FeatureVerdict, numbers: Iterable[int]) -> str:
    entries = [content.features[number] for number in numbers]
    lines = [f"* {label_feature(entry)}; predicted: {entry.best.text}" for entry in entries]
    return "\n".join(lines) or "Nothing."


def _format_value(value: Interval) -> str:
    return format_quantity(value.value, value.unit, value.half_width)
