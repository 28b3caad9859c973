"""Content of features.json and of the model file of a search by features, and their words."""

import math
from collections.abc import Sequence

from twin.discovery.feature_labels import name_fit
from twin.discovery.features.decide import DecidingTest, describe_test
from twin.discovery.features.fit import FeatureFit
from twin.discovery.features.prediction import PredictedFeature, describe_feature
from twin.discovery.features.search import FeatureDiscovery
from twin.discovery.serialize import format_model_toml
from twin.results.summary import Json

MIN_LEAD = 2  # features: a lead of one can be an accident of its tolerance


def discovery_to_json(
    discovery: FeatureDiscovery,
    test: DecidingTest | None,
    model_title: str,
    notes: Sequence[str],
    seconds: float,
) -> Json:
    """Return the content of features.json, see `twin.results.contracts.FeatureVerdict`."""
    features, best, base = discovery.problem.features, discovery.best, discovery.base
    verdict, why = judge_discovery(discovery)
    rival = discovery.runner_up
    return {
        "verdict": verdict,
        "why": why,
        "title": features.title,
        "citation": features.citation,
        "model": model_title,
        "features": [
            {
                "kind": feature.kind,
                "gap_m": _to_si(feature.gap_mm),
                "published": describe_feature(feature),
                "place": feature.place,
                "given": _prediction_to_json(base.given.predicted[number]),
                "refitted": _prediction_to_json(base.refitted.predicted[number]),
                "best": _prediction_to_json(best.predicted[number]),
            }
            for number, feature in enumerate(features.features)
        ],
        "given": _fit_to_json(base.given, base.refitted),
        "refitted": _fit_to_json(base.refitted, base.refitted),
        "fits": [_fit_to_json(fit, base.refitted) for fit in discovery.ranked],
        "best": list(best.names),
        "unexplained": [n for n, p in enumerate(best.predicted) if not p.is_explained],
        "next_run": describe_test(test, name_fit(best.names), name_fit(rival.names))
        if test and rival
        else "none of the tests tried tells the models apart",
        "fell_away": discovery.excluded,
        "notes": list(notes),
        "seconds": seconds,
    }


def judge_discovery(discovery: FeatureDiscovery) -> tuple[str, str]:
    """Return (verdict, reason): whether one set of effects clearly explains the most features."""
    refitted, best = discovery.base.refitted, discovery.best
    count = len(best.predicted)
    if not best.names:
        return "none needed", (
            f"no effect or pair explains more than the {refitted.score} of {count} features "
            "that the base explains with other parameters"
        )
    gain = (
        f"{name_fit(best.names)} explains {best.score} of {count} features, the refitted base "
        f"{refitted.score}"
    )
    if best.score - refitted.score < MIN_LEAD:
        return "ambiguous", f"{gain}: too small a lead"
    rivals = [
        fit for fit in discovery.ranked
        if best.score - fit.score < MIN_LEAD and not set(best.names) & set(fit.names)
    ]  # fmt: skip
    if rivals:
        names = ", ".join(f"{name_fit(fit.names)} {fit.score}" for fit in rivals)
        return "ambiguous", f"{gain}, but {names}"
    return "named", gain


def _to_si(gap_mm: float | None) -> float | None:
    return None if gap_mm is None or math.isinf(gap_mm) else 1e-3 * gap_mm


def _prediction_to_json(predicted: PredictedFeature) -> Json:
    return {
        "text": predicted.text,
        "distance": predicted.distance,
        "explained": predicted.is_explained,
        "method": predicted.method,
    }


def _fit_to_json(fit: FeatureFit, reference: FeatureFit) -> Json:
    pairs = list(enumerate(zip(fit.predicted, reference.predicted, strict=True)))
    return {
        "effects": list(fit.names),
        "explained": fit.score,
        "gained": [n for n, (own, before) in pairs if own.is_explained and not before.is_explained],
        "lost": [n for n, (own, before) in pairs if before.is_explained and not own.is_explained],
        "misfit": fit.misfit,
        "parameters": {
            free.name: {
                "value": fit.parameters.values[free.keys[0]],
                "low": fit.intervals.get(free.key, (math.nan, math.nan))[0],
                "high": fit.intervals.get(free.key, (math.nan, math.nan))[1],
                "unit": free.unit,
            }
            for free in fit.parameters.free
        },
    }


def feature_model_to_toml(discovery: FeatureDiscovery, model_title: str) -> str:
    """Return the model file of the best model, provisional: no recording confirms it."""
    best, features = discovery.best, discovery.problem.features
    count = len(features.features)
    lost = sum(
        before.is_explained and not own.is_explained
        for own, before in zip(best.predicted, discovery.base.refitted.predicted, strict=True)
    )
    provisional = (
        f"fitted to {count} published features, not to recordings: it explains {best.score} of "
        f"them (model as given {discovery.base.given.score}, refitted base "
        f"{discovery.base.refitted.score}) and loses {lost} that the refitted base explains; "
        "for planning the test that would decide, not for design"
    )
    texts = {
        "title": f"{model_title}; {' + '.join(best.names) or 'refitted to features'}",
        "citation": features.citation,
        "fitted_on": f"Features: {features.title}",
        "provisional": provisional,
    }
    model = best.model
    effects = {(each.effect.id, each.channel): each.values for each in model.effects}
    intervals = {str(key): interval for key, interval in best.intervals.items()}
    return format_model_toml(texts, model.base, effects, intervals)
