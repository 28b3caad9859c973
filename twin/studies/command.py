"""`shaketwin simulate` with several models or gaps: parallel sweeps, CSV table, HTML report."""

import platform
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from pathlib import Path

from table_io.clock import RealClock, local_datetime
from table_io.errors import InputError
from table_io.units import GRAVITY_M_S2
from twin.model.valid_range import RangeKey
from twin.report.finalize import EXIT_INTERRUPTED
from twin.results.contract import Json, write_json
from twin.setup.folders import make_run_folder
from twin.setup.run_config import RunConfig, read_run_config
from twin.setup.warm_up import COMPILING_MESSAGE
from twin.studies import TABLE_FILE
from twin.studies.batch import Batch, CaseResult, read_batch, simulate_case
from twin.studies.cases import StudyCase, parse_gaps_mm, read_models
from twin.studies.page import write_study_page
from twin.studies.rows import BatchTable
from twin.system.process_pool import Workers, order_results, run_tasks
from twin.system.progress import make_task_bar
from twin.system.terminal import announce_if_slow, catch_interrupts, print_line
from twin.system.versions import LIBRARIES

MAX_ATTEMPTS = 3  # of a sweep whose worker dies
RETRY_REMEDY = "remove the cause and simulate again; the rows before it are kept"


def simulate_all(
    profile: Path,
    model_names: Sequence[str],
    gap_words: Sequence[str],
    workers: int | None,
    scheduler: str,
    out: Path | None,
) -> int:
    """Simulate every model at every gap under the ideal stepped sine; return the exit code."""
    places = Workers.from_options(workers, scheduler, in_threads=True)
    gaps = parse_gaps_mm(gap_words)
    run_config = read_run_config(profile, None, model_names[0] if model_names else None)
    models = read_models(model_names or [run_config.profile.model], profile)
    texts = tuple((label, text) for label, (_, text) in models.items())
    batch = Batch(str(profile), run_config.profile_toml, texts, tuple(gaps))
    with announce_if_slow(COMPILING_MESSAGE):
        _, cases = read_batch(batch)
    places.require()
    places = replace(places, count=min(places.count, len(cases)))
    folder, run = make_run_folder(out, f"{run_config.name}-batch")
    print_line(
        f"{run_config.profile.title}: {len(cases)} sweeps of "
        f"{len(run_config.profile.sweep.steps)} steps on {places} -> {folder}"
    )
    clock = RealClock()
    started_s = clock.now()
    with catch_interrupts("stopping after the sweeps in progress") as stop:
        entries = list(_run_cases(batch, cases, places, folder, stop))
        seconds, stop_reason = clock.now() - started_s, stop()
    summary = {
        "run": _run_entry(run_config, run, places, seconds),
        "verdict": "complete" if len(entries) == len(cases) else "stopped",
        "reason": f"{len(entries)} of {len(cases)} sweeps"
        + (f"; {stop_reason}" if stop_reason else ""),
        "models": {label: {"title": config.title, "toml": text} for label, (config, text)
                   in models.items()},
        "cases": entries,
    }  # fmt: skip
    write_json(summary, folder / "summary.json")
    page = write_study_page(folder)
    print_line(f"{summary['verdict']}: {summary['reason']} in {seconds:.2g} s -> {page}")
    return 0 if summary["verdict"] == "complete" else EXIT_INTERRUPTED


def _run_cases(
    batch: Batch,
    cases: Sequence[StudyCase],
    workers: Workers,
    folder: Path,
    stop: Callable[[], str | None],
) -> Iterator[Json]:
    """Yield the result of each finished sweep after its rows are written to the table."""
    results = run_tasks(
        partial(simulate_case, batch), range(len(cases)), workers, stop, attempts=MAX_ATTEMPTS
    )
    reported: set[tuple[str, RangeKey]] = set()  # label of a model, and its range
    with BatchTable(folder / TABLE_FILE) as table, make_task_bar() as bar:
        task = bar.add_task("sweeps", total=len(cases))
        for result in order_results(results):
            case = cases[result.number]
            if result.failure:
                raise InputError(f"failed: {result.failure}", where=case.name, remedy=RETRY_REMEDY)
            computed: CaseResult = result.value
            table.write(computed.rows)
            place = f"{result.number + 1:>4}/{len(cases):<4}"
            print_line(f"{place} {case.name}: {format_case(computed.entry)}")
            for range_exit in computed.range_exits:
                if (case.label, range_exit.key) not in reported:
                    reported.add((case.label, range_exit.key))
                    print_line(f"warning: {case.name}: {range_exit}")
            bar.advance(task)
            yield computed.entry


def format_case(entry: Json) -> str:
    """Format the result of a case in one line."""
    parts = []
    if entry["peak"]:
        peak = entry["peak"]
        location = f"{peak['frequency_hz']:g} Hz {peak['direction']}"
        parts.append(f"largest eta_d {peak['eta_d']:.3f} at {location}")
    parts += [f"{interval['kind']} hysteresis {interval['from_hz']:g} to {interval['to_hz']:g} Hz"
             for interval in entry["hysteresis"]] or ["no hysteresis"]  # fmt: skip
    parts += [
        f"jump {jump['kind']} {jump['from_hz']:g} -> {jump['to_hz']:g} Hz"
        for jump in entry["jumps"]
    ]
    if entry["unbounded_from"]:
        unbounded = entry["unbounded_from"]
        parts.append(f"UNBOUNDED from {unbounded['frequency_hz']:g} Hz {unbounded['direction']}")
    return "; ".join(parts)


def _run_entry(run_config: RunConfig, run: str, workers: Workers, seconds: float) -> Json:
    sweep = run_config.profile.sweep
    return {
        "id": run,
        "name": run_config.name,
        "title": run_config.profile.title,
        "source": "models",
        "started_at": local_datetime().isoformat(timespec="seconds"),
        "host": platform.node(),
        "versions": {name: version(name) for name in LIBRARIES},
        "drive": "ideal stepped sine: every step begins and ends at a zero of the table "
        "acceleration, without blends between steps, table dynamics or sensors",
        "acceleration_m_s2": sweep.one_level_g * GRAVITY_M_S2,
        "cycles": sweep.cycles,
        "measured_cycles": sweep.measured_cycles,
        "normalisation": "u* and a* are the maxima in free flight of each model's linear part, "
        "continuous in frequency",
        "profile_toml": run_config.profile_toml,
        "workers": str(workers),
        "seconds": seconds,
    }
