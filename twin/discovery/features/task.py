"""Search for the effects that explain published features, as `discover --features` does."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

from table_io.clock import RealClock
from table_io.config.base import load_config
from table_io.config.folders import find_config
from table_io.config.profile import Specimen
from twin.discovery.features.config import FeatureSet
from twin.discovery.features.decide import DecidingTest, choose_deciding_test, describe_test
from twin.discovery.features.fit import FeatureFit, FeatureProblem
from twin.discovery.features.prediction import PredictedFeature, describe_feature
from twin.discovery.features.search import (
    FeatureDiscovery,
    choose_pairs,
    list_feature_effects,
    rank_fits,
    refit_base,
    run_base_job,
    run_effect_job,
    run_pair_job,
)
from twin.discovery.model_file import format_model_toml
from twin.discovery.result import (
    FeatureFitResult,
    FeatureResult,
    FeatureVerdict,
    Interval,
    PredictedFeatureResult,
    name_fit,
)
from twin.discovery.task import ModelResult, PathLike
from twin.laws.library import find_effect
from twin.setup.run_config import read_model
from twin.system.process_pool import Task, Workers, run_tasks

MIN_LEAD = 2  # features: a lead of one can be an accident of its tolerance


@dataclass(frozen=True)
class FeatureProgress:
    """Progress of a search: a sentence, "" for none; fits of a stage done, of how many."""

    text: str
    stage: str = ""
    done: int = 0
    count: int = 0


@dataclass(frozen=True, eq=False)
class FeatureModel(ModelResult):
    """Verdict on published features, with the same fields as features.json, and the best model."""

    verdict: FeatureVerdict
    discovery: FeatureDiscovery
    is_complete: bool

    def write(self, folder: Path) -> None:
        """Write features.json and model.toml to a folder."""
        self.save_model(folder / "model.toml")
        (folder / "features.json").write_text(self.verdict.to_json(), encoding="utf-8")


def discover_features(
    features: PathLike,
    model: PathLike = "snm",
    without: Sequence[str] = (),
    report: Callable[[FeatureProgress], None] = lambda progress: None,
    is_stopping: Callable[[], object] = lambda: False,
) -> FeatureModel:
    """Search the effects that explain a features file, in processes; return the best model.

    `features` is a name or a file; `without` excludes effects of the library. The fits so far are
    kept once `is_stopping` returns true. InputError for a faulty file or an unknown effect.
    """
    clock = RealClock()
    start_s = clock.now()
    path = find_config(str(features), "features", option="--features")
    feature_set, _ = load_config(path, FeatureSet, "features file")
    config, _ = read_model(str(model), option="--model")
    for name in without:
        find_effect(name)
    specimen = Specimen(mass_kg=feature_set.specimen.mass_kg, gap_mm=0.0)
    problem = FeatureProblem.create(feature_set, config.build_model(specimen))
    search = _FeatureSearch(problem, report, is_stopping)
    discovery = search.run(without)
    best, rival = discovery.best, discovery.runner_up
    test = choose_deciding_test(feature_set, best.model, rival.model) if rival else None
    seconds = clock.now() - start_s
    verdict = _build_verdict(discovery, test, config.title, search.notes, seconds)
    toml = _format_model(discovery, config.title)
    return FeatureModel(toml, verdict, discovery, not is_stopping())


class _FeatureSearch:
    """Search in processes, stage by stage; `notes` collects what failed."""

    def __init__(
        self,
        problem: FeatureProblem,
        report: Callable[[FeatureProgress], None],
        is_stopping: Callable[[], object],
    ) -> None:
        self._problem = problem
        self._report = report
        self._is_stopping = is_stopping
        self._workers = Workers.from_options(None)
        self.notes: list[str] = []

    def run(self, without: Sequence[str]) -> FeatureDiscovery:
        problem = self._problem
        effects, excluded = list_feature_effects(problem, without)
        self._report(FeatureProgress("fitting the base model"))
        base = run_base_job(problem)
        fits = self._run_stage("effects", partial(run_effect_job, problem, base, effects), effects)
        base = refit_base(problem, base, fits)
        pairs = choose_pairs(fits)
        pair_names = [" + ".join(a.names + b.names) for a, b in pairs]
        fits += self._run_stage("pairs", partial(run_pair_job, problem, base, pairs), pair_names)
        if self._is_stopping():
            self.notes.append("stopped early: not every effect and pair was fitted")
        self._report(FeatureProgress("refitting the base model from the winners"))
        base = refit_base(problem, base, fits)
        return rank_fits(problem, base, fits, excluded)

    def _run_stage(self, stage: str, task: Task, names: Sequence[str]) -> list[FeatureFit]:
        """Return the fits of a stage in the order of the names."""
        if not names:
            return []
        count = len(names)
        begin = f"fitting {count} {stage} in {self._workers}"
        self._report(FeatureProgress(begin, stage, 0, count))
        fits: dict[int, FeatureFit] = {}
        results = run_tasks(task, range(count), self._workers, self._is_stopping)
        for done, result in enumerate(results, 1):
            name, text = names[result.number], ""
            if result.failure:
                self.notes.append(f"{name}: not fitted: {result.failure}")
            else:
                fits[result.number] = result.value
                text = f"  {name}: {result.value.score} features explained"
            self._report(FeatureProgress(text, stage, done, count))
        return [fits[number] for number in sorted(fits)]


def _build_verdict(
    discovery: FeatureDiscovery,
    test: DecidingTest | None,
    model_title: str,
    notes: Sequence[str],
    seconds: float,
) -> FeatureVerdict:
    """Return the content of features.json."""
    features, best, base = discovery.problem.features, discovery.best, discovery.base
    verdict, why = judge_discovery(discovery)
    rival = discovery.runner_up
    return FeatureVerdict(
        verdict=verdict,
        why=why,
        title=features.title,
        citation=features.citation,
        model=model_title,
        features=[
            FeatureResult(
                kind=feature.kind,
                gap_m=_to_si(feature.gap_mm),
                published=describe_feature(feature),
                place=feature.place,
                given=_build_prediction(base.given.predicted[number]),
                refitted=_build_prediction(base.refitted.predicted[number]),
                best=_build_prediction(best.predicted[number]),
            )
            for number, feature in enumerate(features.features)
        ],
        given=_build_fit(base.given, base.refitted),
        refitted=_build_fit(base.refitted, base.refitted),
        fits=[_build_fit(fit, base.refitted) for fit in discovery.ranked],
        best=list(best.names),
        unexplained=[n for n, p in enumerate(best.predicted) if not p.is_explained],
        next_run=describe_test(test, name_fit(best.names), name_fit(rival.names))
        if test and rival
        else "none of the tests tried tells the models apart",
        fell_away=discovery.excluded,
        notes=list(notes),
        seconds=seconds,
    )


def judge_discovery(
    discovery: FeatureDiscovery,
) -> tuple[Literal["none needed", "named", "ambiguous"], str]:
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


def _build_prediction(predicted: PredictedFeature) -> PredictedFeatureResult:
    return PredictedFeatureResult(
        text=predicted.text,
        distance=predicted.distance,
        explained=predicted.is_explained,
        method=predicted.method,
    )


def _build_fit(fit: FeatureFit, reference: FeatureFit) -> FeatureFitResult:
    pairs = list(enumerate(zip(fit.predicted, reference.predicted, strict=True)))
    parameters = {}
    for free in fit.parameters.free:
        low, high = fit.intervals.get(free.key, (None, None))
        value = fit.parameters.values[free.keys[0]]
        parameters[free.name] = Interval(value=value, low=low, high=high, unit=free.unit)
    return FeatureFitResult(
        effects=list(fit.names),
        explained=fit.score,
        gained=[n for n, (own, before) in pairs if own.is_explained and not before.is_explained],
        lost=[n for n, (own, before) in pairs if before.is_explained and not own.is_explained],
        misfit=fit.misfit,
        parameters=parameters,
    )


def _format_model(discovery: FeatureDiscovery, model_title: str) -> str:
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
