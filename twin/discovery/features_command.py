"""`shaketwin discover --features`: files, progress and console output of a search by features."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from rich.progress import Progress

from table_io.clock import RealClock
from table_io.config.base import load_config
from table_io.config.folders import find_config
from table_io.config.profile import Specimen
from table_io.errors import InputError
from twin.discovery.feature_labels import describe_fit, label_feature
from twin.discovery.features.config import FeatureSet
from twin.discovery.features.decide import choose_deciding_test
from twin.discovery.features.fit import FeatureFit, FeatureProblem
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
from twin.discovery.features_page import write_features_page
from twin.discovery.features_summary import discovery_to_json, feature_model_to_toml
from twin.laws.library import find_effect
from twin.report.finalize import EXIT_INTERRUPTED
from twin.results.contracts import FeatureVerdict
from twin.results.summary import Json, dump_contract
from twin.setup.folders import make_run_folder
from twin.setup.run_config import read_model
from twin.system.process_pool import Task, Workers, run_tasks
from twin.system.progress import make_task_bar
from twin.system.terminal import catch_interrupts, print_line

SHOWN_FITS = 8  # effects and pairs printed; the page has all


def discover_by_features(
    features_name: str, model_name: str, out: Path | None, without: Sequence[str] = ()
) -> int:
    """Search the effects that explain a features file; write a new folder; return the exit code."""
    clock = RealClock()
    start_s = clock.now()
    path = find_config(features_name, "features", option="--features")
    features, _ = load_config(path, FeatureSet, "features file")
    config, _ = read_model(model_name, option="--model")
    for name in without:
        find_effect(name)
    specimen = Specimen(mass_kg=features.specimen.mass_kg, gap_mm=0.0)
    problem = FeatureProblem.create(features, config.build_model(specimen))
    folder, _ = make_run_folder(out, "features")
    search = _FeatureSearch(problem)
    with catch_interrupts("stopping: the fits so far are kept") as is_stopping:
        discovery = search.run(without, is_stopping)
    best, rival = discovery.best, discovery.runner_up
    test = choose_deciding_test(features, best.model, rival.model) if rival else None
    content = discovery_to_json(discovery, test, config.title, search.notes, clock.now() - start_s)
    toml = feature_model_to_toml(discovery, config.title)
    (folder / "model.toml").write_text(toml, encoding="utf-8")
    text = dump_contract(FeatureVerdict, content)
    (folder / "features.json").write_text(text, encoding="utf-8")
    write_features_page(folder, discovery, content, toml)
    print_features(discovery, content)
    print_line(f"{folder}")
    return EXIT_INTERRUPTED if is_stopping() else 0


class _FeatureSearch:
    """Search in processes, stage by stage; `notes` collects what failed."""

    def __init__(self, problem: FeatureProblem) -> None:
        self._problem, self._workers = problem, Workers.from_options(None)
        self.notes: list[str] = []

    def run(self, without: Sequence[str], is_stopping: Any) -> FeatureDiscovery:
        problem = self._problem
        effects, excluded = list_feature_effects(problem, without)
        with make_task_bar() as bar:
            print_line("fitting the base model")
            base = run_base_job(problem)
            fits = self._run_stage(
                bar, "effects", partial(run_effect_job, problem, base, effects), effects,
                is_stopping,
            )  # fmt: skip
            base = refit_base(problem, base, fits)
            pairs = choose_pairs(fits)
            fits += self._run_stage(
                bar, "pairs", partial(run_pair_job, problem, base, pairs),
                [" + ".join(a.names + b.names) for a, b in pairs], is_stopping,
            )  # fmt: skip
        if is_stopping():
            self.notes.append("stopped early: not every effect and pair was fitted")
        print_line("refitting the base model from the winners")
        base = refit_base(problem, base, fits)
        return rank_fits(problem, base, fits, excluded)

    def _run_stage(
        self, bar: Progress, title: str, task: Task, names: Sequence[str], is_stopping: Any
    ) -> list[FeatureFit]:
        """Return the fits of a stage in the order of the names."""
        if not names:
            return []
        print_line(f"fitting {len(names)} {title} in {self._workers}")
        place = bar.add_task(title, total=len(names))
        fits: dict[int, FeatureFit] = {}
        for result in run_tasks(task, range(len(names)), self._workers, is_stopping):
            bar.advance(place)
            if result.failure:
                self.notes.append(f"{names[result.number]}: not fitted: {result.failure}")
                continue
            fits[result.number] = result.value
            print_line(f"  {names[result.number]}: {result.value.score} features explained")
        return [fits[number] for number in sorted(fits)]


def print_features(discovery: FeatureDiscovery, content: Json) -> None:
    """Print the counts, the ranking, what stays unexplained, the price and the deciding test."""
    count = len(content["features"])
    print_line(f"{content['verdict']}: {content['why']}")
    print_line(f"  model as given: {content['given']['explained']} of {count} features explained")
    print_line(f"  base refitted: {content['refitted']['explained']} of {count}")
    for entry in content["fits"][:SHOWN_FITS]:
        print_line(f"  {describe_fit(entry, count)}")
    for number in content["unexplained"]:
        print_line(f"  unexplained: {_describe_entry(content['features'][number])}")
    best = next((f for f in content["fits"] if f["effects"] == content["best"]), None)
    for number in best["lost"] if best else ():
        print_line(f"  the price: {_describe_entry(content['features'][number])}")
    for note in content["notes"]:
        print_line(f"  note: {note}")
    print_line(f"  suggested next test: {content['next_run']}")


def _describe_entry(entry: Json) -> str:
    return f"{label_feature(entry)}; predicted: {entry['best']['text']}"


def require_no_logs(logs: Sequence[Path], held_out: Sequence[Path]) -> None:
    """Raise InputError if logs are given beside a features file."""
    if logs or held_out:
        raise InputError(
            "features take the place of recordings", key="--features",
            remedy="omit LOG and --held-out, or omit --features",
        )  # fmt: skip
