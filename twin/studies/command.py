"""`shaketwin simulate` with several models or gaps: parallel sweeps, CSV table, HTML report."""

import math
import platform
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from importlib.metadata import version
from itertools import chain
from pathlib import Path

from table_io.clock import RealClock, local_datetime
from table_io.records import PrcPoint
from table_io.units import GRAVITY_M_S2
from twin.compare.curves import detect_hysteresis
from twin.model.parameters import free_flight_resonance
from twin.model.valid_range import RangeExit, RangeKey, select_first_exits
from twin.reports import ideal_points
from twin.reports.finalize import EXIT_INTERRUPTED
from twin.reports.summary import Json, write_json
from twin.run.folders import make_run_folder
from twin.run.progress import make_task_bar
from twin.run.run_config import RunConfig, read_run_config
from twin.run.tasks import Workers
from twin.run.terminal import announce_if_slow, catch_interrupts, print_line
from twin.run.versions import LIBRARIES
from twin.run.warm_up import COMPILING_MESSAGE
from twin.studies import TABLE_FILE
from twin.studies.batch import iterate_sweeps
from twin.studies.cases import StudyCase, build_cases, parse_gaps_mm, read_models
from twin.studies.page import write_study_page
from twin.studies.rows import BatchTable, make_rows


def simulate_all(
    profile: Path,
    model_names: Sequence[str],
    gap_words: Sequence[str],
    workers: int | None,
    out: Path | None,
) -> int:
    """Simulate every model at every gap under the ideal stepped sine; return the exit code."""
    cores = Workers.from_options(workers).count
    gaps = parse_gaps_mm(gap_words)
    run_config = read_run_config(profile, None, model_names[0] if model_names else None)
    configs = read_models(model_names or [run_config.profile.model], profile)
    with announce_if_slow(COMPILING_MESSAGE):
        cases = build_cases(run_config.profile, configs, gaps, str(profile))
    cores = min(cores, len(cases))
    folder, run = make_run_folder(out, f"{run_config.name}-batch")
    print_line(
        f"{run_config.profile.title}: {len(cases)} sweeps of "
        f"{len(run_config.profile.sweep.steps)} steps on {cores} cores -> {folder}"
    )
    clock = RealClock()
    started_s = clock.now()
    with catch_interrupts("stopping after the sweeps in progress") as stop:
        entries = list(_run_cases(run_config, cases, cores, folder, stop))
        seconds, stop_reason = clock.now() - started_s, stop()
    summary = {
        "run": _run_entry(run_config, run, cores, seconds),
        "verdict": "complete" if len(entries) == len(cases) else "stopped",
        "reason": f"{len(entries)} of {len(cases)} sweeps"
        + (f"; {stop_reason}" if stop_reason else ""),
        "models": {label: {"title": config.title, "toml": text} for label, (config, text)
                   in configs.items()},
        "cases": entries,
    }  # fmt: skip
    write_json(summary, folder / "summary.json")
    page = write_study_page(folder)
    print_line(f"{summary['verdict']}: {summary['reason']} in {seconds:.2g} s -> {page}")
    return 0 if summary["verdict"] == "complete" else EXIT_INTERRUPTED


def _run_cases(
    run_config: RunConfig,
    cases: list[StudyCase],
    cores: int,
    folder: Path,
    stop: Callable[[], str | None],
) -> Iterator[Json]:
    """Yield the result of each finished sweep after its rows are written to the table."""
    sweep, steps = run_config.profile.sweep, run_config.profile.sweep.steps
    sweeps = iterate_sweeps(
        [case.model for case in cases], [step.frequency_hz for step in steps],
        sweep.one_level_g * GRAVITY_M_S2, sweep.cycles, cores, stop,
    )  # fmt: skip
    reported: set[tuple[str, RangeKey]] = set()  # label of a model, and its range
    with BatchTable(folder / TABLE_FILE) as table, make_task_bar() as bar:
        task = bar.add_task("sweeps", total=len(cases))
        for index, response in sweeps:
            case = cases[index]
            points = ideal_points.compute_prc_points(
                case.model, steps, response, sweep.cycles, sweep.measured_cycles
            )
            table.write(make_rows(case, points))
            exits = select_first_exits(chain.from_iterable(response.range_exits))
            entry = _case_entry(case, points, sweep.one_level_g * GRAVITY_M_S2, exits)
            print_line(f"{index + 1:>4}/{len(cases):<4} {case.name}: {format_case(entry)}")
            for range_exit in exits:
                if (case.label, range_exit.key) not in reported:
                    reported.add((case.label, range_exit.key))
                    print_line(f"warning: {case.name}: {range_exit}")
            bar.advance(task)
            yield entry


def _case_entry(
    case: StudyCase,
    points: tuple[PrcPoint, ...],
    acceleration: float,
    range_exits: Sequence[RangeExit],
) -> Json:
    """Build a case of summary.json; the gap without bumpers is "inf", as JSON has no infinity."""
    u_star, a_star, peak_hz = free_flight_resonance(case.model.parameters, acceleration)
    jumps, intervals = detect_hysteresis(points, "twin")
    bounded = [point for point in points if point.twin and math.isfinite(point.twin.eta_d)]
    peak_point = max(
        bounded, key=lambda point: point.twin.eta_d if point.twin else 0.0, default=None
    )
    unbounded_point = next((point for point in points if point not in bounded), None)
    return {
        "model": case.label,
        "gap_mm": case.gap_mm if math.isfinite(case.gap_mm) else "inf",
        "u_star_m": u_star,
        "a_star_m_s2": a_star,
        "free_flight_hz": peak_hz,
        "peak": _location_entry(peak_point) | {"eta_d": peak_point.twin.eta_d}
        if peak_point and peak_point.twin
        else None,
        "jumps": [asdict(jump) for jump in jumps],
        "hysteresis": [asdict(interval) for interval in intervals],
        "unbounded_from": _location_entry(unbounded_point) if unbounded_point else None,
        "warnings": [str(range_exit) for range_exit in range_exits],
    }


def _location_entry(point: PrcPoint) -> Json:
    return {"frequency_hz": point.frequency_hz, "direction": point.direction}


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


def _run_entry(run_config: RunConfig, run: str, cores: int, seconds: float) -> Json:
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
        "cores": cores,
        "seconds": seconds,
    }
