"""Task: sweep every model at every gap under the stepped sine of a test."""

import platform
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path

from table_io.clock import RealClock, local_datetime
from table_io.errors import InputError
from table_io.units import GRAVITY_M_S2
from twin.model.valid_range import RangeKey
from twin.setup.folders import make_run_folder
from twin.setup.run_config import read_run_config
from twin.setup.warm_up import COMPILING_MESSAGE
from twin.studies import TABLE_FILE
from twin.studies.batch import (
    Batch,
    CaseResult,
    StudyCase,
    parse_gaps_mm,
    read_batch,
    read_models,
    simulate_case,
)
from twin.studies.figures import write_study_page
from twin.studies.result import BatchTable, CaseSummary, ModelText, SweepRun, SweepSummary
from twin.system.grid import Watch, run_grid
from twin.system.process_pool import Workers
from twin.system.terminal import announce_if_slow
from twin.system.versions import LIBRARIES

DRIVE = (
    "ideal stepped sine: every step begins and ends at a zero of the table "
    "acceleration, without blends between steps, table dynamics or sensors"
)
NORMALISATION = (
    "u* and a* are the maxima in free flight of each model's linear part, continuous in frequency"
)


@dataclass(frozen=True, slots=True)
class SweepOptions:
    """A test and the models under its sweep, by default its own.

    `gaps`: total gaps in mm as words, "4", "inf" for no bumpers, "0:30:2" for a range; without any
    that of the test. Without `scheduler`, the address of a Dask cluster, on `workers` threads.
    """

    profile: Path
    models: Sequence[str] = ()
    gaps: Sequence[str] = ()
    workers: int | None = None
    scheduler: str = ""
    out: Path | None = None


@dataclass(frozen=True, slots=True)
class SimulatedSweeps:
    """What is in the folder of simulated sweeps."""

    folder: Path
    page: Path
    summary: SweepSummary


def simulate_sweeps(options: SweepOptions, watch: Watch | None = None) -> SimulatedSweeps:
    """Simulate every model at every gap under the ideal stepped sine of a test, each from rest.

    Writes summary.json, batch.csv, figures and report.html. InputError for a faulty file, gap or
    model, and if a sweep cannot be computed.
    """
    watch = watch or Watch()
    workers = Workers.from_options(options.workers, options.scheduler, in_threads=True)
    gaps = parse_gaps_mm(options.gaps)
    config = read_run_config(options.profile, None, options.models[0] if options.models else None)
    models = read_models(options.models or [config.profile.model], options.profile)
    texts = tuple((label, text) for label, (_, text) in models.items())
    batch = Batch(str(options.profile), config.profile_toml, texts, tuple(gaps))
    with announce_if_slow(COMPILING_MESSAGE):
        _, cases = read_batch(batch)
    workers.require()
    workers = replace(workers, count=min(workers.count, len(cases)))
    folder, run = make_run_folder(options.out, f"{config.name}-batch")
    sweep = config.profile.sweep
    watch.tell(
        f"{config.profile.title}: {len(cases)} sweeps of {len(sweep.steps)} steps on {workers} "
        f"-> {folder}"
    )
    clock = RealClock()
    started_s = clock.now()
    entries = _run_cases(batch, cases, workers, folder, watch)
    is_complete, reason = len(entries) == len(cases), watch.find_stop()
    summary = SweepSummary(
        run=SweepRun(
            id=run,
            name=config.name,
            title=config.profile.title,
            source="models",
            started_at=local_datetime().isoformat(timespec="seconds"),
            host=platform.node(),
            versions={name: version(name) for name in LIBRARIES},
            drive=DRIVE,
            acceleration_m_s2=sweep.one_level_g * GRAVITY_M_S2,
            cycles=sweep.cycles,
            measured_cycles=sweep.measured_cycles,
            normalisation=NORMALISATION,
            profile_toml=config.profile_toml,
            workers=str(workers),
            seconds=clock.now() - started_s,
        ),
        verdict="complete" if is_complete else "stopped",
        reason=f"{len(entries)} of {len(cases)} sweeps" + (f"; {reason}" if reason else ""),
        models={
            label: ModelText(title=model.title, toml=text)
            for label, (model, text) in models.items()
        },
        cases=entries,
    )
    summary.write(folder / "summary.json")
    return SimulatedSweeps(folder, write_study_page(folder), summary)


def _run_cases(
    batch: Batch, cases: Sequence[StudyCase], workers: Workers, folder: Path, watch: Watch
) -> list[CaseSummary]:
    """Return the entries of the finished sweeps, whose rows are in the table of the folder."""
    entries: list[CaseSummary] = []
    reported: set[tuple[str, RangeKey]] = set()  # label of a model, and its range

    def keep(number: int, result: CaseResult) -> int:
        case = cases[number]
        table.write(result.rows)
        entries.append(result.entry)
        watch.tell(f"{number + 1:>4}/{len(cases):<4} {case.name}: {result.entry}")
        for range_exit in result.range_exits:
            if (case.label, range_exit.key) not in reported:
                reported.add((case.label, range_exit.key))
                watch.tell(f"warning: {case.name}: {range_exit}")
        return 1

    def describe_failure(number: int, reason: str) -> InputError:
        remedy = "remove the cause and simulate again; the rows before it are kept"
        return InputError(f"failed: {reason}", where=cases[number].name, remedy=remedy)

    with BatchTable(folder / TABLE_FILE) as table:
        run_grid(
            partial(simulate_case, batch), range(len(cases)), workers, keep, watch,
            unit="sweeps", total=len(cases), describe_failure=describe_failure, is_ordered=True,
        )  # fmt: skip
    return entries
