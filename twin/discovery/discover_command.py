"""`shaketwin discover`: files, progress and console output of `twin.discovery.discover`."""

import contextlib
import math
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from table_io.clock import RealClock
from table_io.errors import InputError
from twin.discovery.decide_command import (
    DecideOptions,
    JudgedLogs,
    add_proposal,
    read_recorded_test,
)
from twin.discovery.decisive_test import TestProposal
from twin.discovery.discover import (
    Discovery,
    PreparedLog,
    discover_effects,
)
from twin.discovery.headline import (
    describe_excluded,
    describe_proposal,
    format_interval,
    format_verdict,
)
from twin.discovery.law_search import LawProposal, is_explained, propose_law
from twin.discovery.least_squares import MapFunction
from twin.discovery.loading import load_logs
from twin.discovery.page import write_discovery_page
from twin.discovery.selection import Cancelled, ProgressCallback, SelectionProgress
from twin.discovery.sensor_section import describe_sensors
from twin.discovery.serialize import (
    Json,
    list_effect_files,
    model_to_toml,
    verdict_to_json,
)
from twin.discovery.symbolic_regression import MISSING_MESSAGE, is_available
from twin.laws.library import find_effect
from twin.model.config import ModelConfig
from twin.report.finalize import EXIT_INTERRUPTED
from twin.results.contracts import Verdict
from twin.results.quantities import format_quantity
from twin.results.summary import dump_contract
from twin.setup.folders import make_run_folder
from twin.setup.run_config import read_model_template
from twin.system.terminal import catch_interrupts, console, print_line

MIN_THREADED_SAMPLES = 120_000  # of all logs; with fewer, threads do not pay
MAX_THREADS = 4  # limits memory: each thread holds its own motion


def judge_logs(
    paths: Sequence[Path],
    model: str,
    out: Path | None,
    without: Sequence[str] = (),
    held_out: Sequence[Path] = (),
    decide: DecideOptions | None = None,
) -> JudgedLogs:
    """Run a discovery, write its results to a new folder and print them; return the verdict.

    With `decide` also propose the test that would decide.
    """
    clock = RealClock()
    start_s = clock.now()
    start, config = read_model_template(model)
    for name in without:
        find_effect(name)
    # before the search: it must not be lost
    recorded_test = None if decide is None else read_recorded_test(paths, decide)
    folder, _ = make_run_folder(out, "discover")
    try:
        with (
            catch_interrupts("stopping: the best result so far is kept") as is_stopping,
            show_progress() as show,
        ):

            def report(progress: SelectionProgress) -> None:
                if is_stopping():
                    raise Cancelled
                show(progress)

            logs, notes = load_logs(paths)
            held_out_logs = load_logs(held_out)[0] if held_out else ()
            with open_mapper(logs) as mapper:
                discovery = discover_effects(logs, start, report, without, mapper)
                law = None
                if discovery.selection.complete:
                    with contextlib.suppress(Cancelled):  # the discovery is kept
                        discovery, law = propose_law(discovery, report)
    except (InputError, Cancelled) as error:
        folder.rmdir()  # leave no empty folder after a failure
        if isinstance(error, InputError):
            raise
        print_line("interrupted before any result; nothing is written")
        return JudgedLogs(folder, {}, (), False, EXIT_INTERRUPTED)
    if not ((law and law.is_sufficient) or is_explained(discovery) or is_available()):
        notes = (*notes, MISSING_MESSAGE)
    seconds = clock.now() - start_s
    verdict = verdict_to_json(discovery, seconds, notes, held_out_logs, start, law)
    proposals: Sequence[TestProposal] = ()
    if decide and recorded_test and discovery.selection.complete:
        proposals = add_proposal(verdict, discovery, law, *recorded_test, folder, decide)
    write_results(folder, discovery, config, logs, verdict, law)
    print_verdict(verdict)
    print_line(f"{folder}")
    code = 0 if discovery.selection.complete else EXIT_INTERRUPTED
    is_decided = discovery.verdict.is_decided or (law is not None and law.is_sufficient)
    return JudgedLogs(folder, verdict, proposals, is_decided, code)


@contextlib.contextmanager
def open_mapper(logs: Sequence[PreparedLog]) -> Iterator[MapFunction]:
    """Yield a threaded map for long logs, else `map`; kernels and array sums release the GIL."""
    if sum(log.signals.time_s.size for log in logs) < MIN_THREADED_SAMPLES:
        yield map
        return
    with ThreadPoolExecutor(min(os.cpu_count() or 1, MAX_THREADS)) as pool:
        yield pool.map


@contextlib.contextmanager
def show_progress() -> Iterator[ProgressCallback]:
    """Yield a progress callback: a progress bar on a terminal, plain lines elsewhere."""
    if not console.is_terminal:
        yield (
            lambda progress: (
                print_line(f"  {_format_progress(progress)}")
                if progress.index or not progress.best
                else None
            )
        )
        return
    bar = Progress(
        TextColumn("{task.description}"), BarColumn(bar_width=16), MofNCompleteColumn(),
        TextColumn("[green]{task.fields[best]}"), TimeElapsedColumn(), console=console,
        transient=True,
    )  # fmt: skip
    task = bar.add_task("reading", total=None, best="")

    def show(progress: SelectionProgress) -> None:
        bar.tasks[0].total = None  # update() takes None for no change
        bar.update(
            task, description=escape(" + ".join(progress.names) or progress.stage),
            total=progress.count or None, completed=max(progress.index - 1, 0),
            best=escape(_format_best(progress)),
        )  # fmt: skip

    with bar:
        yield show


def _format_progress(progress: SelectionProgress) -> str:
    if not progress.index:
        return f"fitting {progress.stage}"
    place = f"{progress.index} of {progress.count}"
    return f"fitting {' + '.join(progress.names)} ({place}); {_format_best(progress)}"


def _format_best(progress: SelectionProgress) -> str:
    if progress.best is None:
        return ""
    names = " + ".join(progress.best.names) or "nothing added"
    return f"best so far {names}: {math.sqrt(progress.best.cost):.3g} times the noise"


def write_results(
    folder: Path,
    discovery: Discovery,
    config: ModelConfig,
    logs: Sequence[PreparedLog],
    verdict: Json,
    proposal: LawProposal | None = None,
) -> None:
    """Write verdict.json, model.toml, effect files, figures and report.html to the folder."""
    names = ", ".join(log.signals.name for log in logs)
    best = proposal.fitted if proposal else discovery.verdict.best
    added = " + ".join(best.names) or "nothing added"
    title = f"{config.title}; {added}"
    provisional = verdict["why"] if verdict["verdict"] in ("ambiguous", "unexplained") else ""
    if proposal:
        provisional = "the law was found in these recordings and holds in its range alone"
    text, omitted = model_to_toml(best.fit, title, config.citation, names, provisional, best.names)
    laws = proposal.laws if proposal else ()
    for name, law_text in list_effect_files(best.fit, laws).items():
        (folder / name).write_text(law_text, encoding="utf-8")
    verdict["notes"] += omitted
    (folder / "model.toml").write_text(text, encoding="utf-8")
    (folder / "verdict.json").write_text(dump_contract(Verdict, verdict), encoding="utf-8")
    write_discovery_page(folder, discovery, logs, verdict, proposal)


def print_verdict(verdict: Json) -> None:
    """Print the verdict, the misfit, the fitted parameters and the notes."""
    print_line(f"{verdict['verdict']}: {format_verdict(verdict)}")
    print_line(f"  {verdict['why']}")
    misfit = verdict["gap"]
    columns = " | ".join(
        f"{label} {value:.3g}"
        for label, value in (
            ("as given", misfit["given"]),
            ("refitted", misfit["held_out_before"]),
            *([("with the effects", misfit["held_out_after"])] if verdict["effects"] else []),
            ("noise floor", misfit["noise_floor"]),
        )
    )
    print_line(f"  misfit in multiples of the noise: {columns}")
    for line in describe_proposal(verdict["law"]) if verdict["law"] else ():
        print_line(f"  {line}")
    for effect in verdict["effects"]:
        for name, value in effect["parameters"].items():
            print_line(f"  {effect['id']} {name} = {format_interval(value)}")
    for effect in verdict["effects"]:
        for name, value in effect["parameters"].items():
            half = (verdict["form_errors"] or {}).get(f"{effect['id']}.{name}")
            if half is not None:
                text = format_quantity(value["value"], value["unit"], half)
                print_line(f"  {effect['id']} {name} if its law has another form: {text}")
    for rival in describe_excluded(verdict) if verdict["verdict"] == "named" else ():
        print_line(f"  excluded: {rival['id']}, worse by {rival['sigma']:.2g} standard errors")
    for line in describe_sensors(verdict["sensors"]):
        print_line(f"  {line}")
    for log in verdict["held_out_logs"]:
        print_line(
            f"  {log['log']}, held out entirely: NRMSE of the damper force "
            f"{log['nrmse_before']:.3g} -> {log['nrmse_after']:.3g} (model as given "
            f"{log['nrmse_given']:.3g}, noise {log['noise_floor']:.2g})"
        )
    for note in verdict["notes"]:
        print_line(f"  note: {note}")
    print_line(f"  suggested next test: {verdict['next_run']}")
