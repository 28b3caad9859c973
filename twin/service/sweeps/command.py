"""`simulate` with several models or gaps: all of them on all cores, a table, a page."""

import math
import os
import platform
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from table_io.card import BadInput
from table_io.clock import RealClock, today
from table_io.records import Point
from twin.compare.curves import branches
from twin.model.parameters import resonance
from twin.service import ideal_points
from twin.service.batch import one_by_one
from twin.service.bundle import Bundle, read_bundle
from twin.service.folders import new_run
from twin.service.kernels import COMPILING
from twin.service.outcome import EXIT_INTERRUPTED
from twin.service.summary import Json, write
from twin.service.sweeps import TABLE
from twin.service.sweeps.cases import Case, cases, gaps_mm, models
from twin.service.sweeps.page import write_page
from twin.service.sweeps.rows import Table, rows
from twin.service.terminal import console, interruptible, said_if_long, say
from twin.service.versions import LIBRARIES


def simulate_all(
    profile: Path,
    model_names: Sequence[str],
    gap_words: Sequence[str],
    workers: int | None,
    out: Path | None,
) -> int:
    """Every model at every gap on the ideal stepped sine of a test; the exit code."""
    if workers is not None and workers < 1:
        raise BadInput(f"--workers {workers}: allowed: 1 or more; without it all cores")
    gaps = gaps_mm(gap_words)
    bundle = read_bundle(profile, None, model_names[0] if model_names else None)
    cards = models(model_names or [bundle.profile.model], profile)
    with said_if_long(COMPILING):
        asked = cases(bundle.profile, cards, gaps, str(profile))
    cores = min(workers or len(os.sched_getaffinity(0)), len(asked))
    folder, run = new_run(out, f"{bundle.name}-batch")
    say(
        f"{bundle.profile.title}: {len(asked)} sweeps of {len(bundle.profile.sweep.steps)} steps "
        f"on {cores} cores -> {folder}"
    )
    clock = RealClock()
    began = clock.now()
    with interruptible("stopping: the sweeps under way are finished first") as stop:
        done = list(_played(bundle, asked, cores, folder, stop))
        seconds, why = clock.now() - began, stop()
    told = {
        "run": _run(bundle, run, cores, seconds),
        "verdict": "complete" if len(done) == len(asked) else "stopped",
        "reason": f"{len(done)} of {len(asked)} sweeps" + (f"; {why}" if why else ""),
        "models": {label: {"title": card.title, "toml": text} for label, (card, text)
                   in cards.items()},
        "cases": done,
    }  # fmt: skip
    write(told, folder / "summary.json")
    page = write_page(folder)
    say(f"{told['verdict']}: {told['reason']} in {seconds:.2g} s -> {page}")
    return 0 if told["verdict"] == "complete" else EXIT_INTERRUPTED


def _played(
    bundle: Bundle, asked: list[Case], cores: int, folder: Path, stop: Callable[[], str | None]
) -> Iterator[Json]:
    """What each finished sweep found; its rows are in the table by then."""
    sweep, steps = bundle.profile.sweep, bundle.profile.sweep.steps
    sweeps = one_by_one(
        [case.model for case in asked], [step.frequency_hz for step in steps],
        steps[0].acceleration_m_s2, sweep.cycles, cores, stop,
    )  # fmt: skip
    with Table(folder / TABLE) as table, _bar() as bar:
        task = bar.add_task("sweeps", total=len(asked))
        for place, played in sweeps:
            case = asked[place]
            points = ideal_points.points(case.model, steps, played, sweep.measured_cycles)
            table.put(rows(case, points))
            found = _found(case, points, steps[0].acceleration_m_s2)
            say(f"{place + 1:>4}/{len(asked):<4} {case.name}: {sentence(found)}")
            bar.advance(task)
            yield found


def _bar() -> Progress:
    return Progress(
        TextColumn("[bold]{task.description}"), BarColumn(bar_width=40), MofNCompleteColumn(),
        TimeRemainingColumn(), console=console, disable=not console.is_terminal, transient=True,
    )  # fmt: skip


def _found(case: Case, points: tuple[Point, ...], acceleration: float) -> Json:
    """A case of summary.json. No bumpers: a gap of "inf", which JSON has no number for."""
    u_star, a_star, peak_hz = resonance(case.model.parameters, acceleration)
    jumps, intervals = branches(points, "twin")
    bounded = [one for one in points if one.twin and math.isfinite(one.twin.eta_d)]
    best = max(bounded, key=lambda one: one.twin.eta_d if one.twin else 0.0, default=None)
    lost = next((one for one in points if one not in bounded), None)
    return {
        "model": case.label,
        "gap_mm": case.gap_mm if math.isfinite(case.gap_mm) else "inf",
        "u_star_m": u_star,
        "a_star_m_s2": a_star,
        "free_flight_hz": peak_hz,
        "peak": _place(best) | {"eta_d": best.twin.eta_d} if best and best.twin else None,
        "jumps": [asdict(one) for one in jumps],
        "hysteresis": [asdict(one) for one in intervals],
        "unbounded_from": _place(lost) if lost else None,
    }


def _place(point: Point) -> Json:
    return {"frequency_hz": point.frequency_hz, "direction": point.direction}


def sentence(found: Json) -> str:
    """What a case found, in one line."""
    said = []
    if found["peak"]:
        peak = found["peak"]
        where = f"{peak['frequency_hz']:g} Hz {peak['direction']}"
        said.append(f"largest eta_d {peak['eta_d']:.3f} at {where}")
    said += [f"{one['kind']} hysteresis {one['from_hz']:g} to {one['to_hz']:g} Hz"
             for one in found["hysteresis"]] or ["no hysteresis"]  # fmt: skip
    said += [
        f"jump {one['kind']} {one['from_hz']:g} -> {one['to_hz']:g} Hz" for one in found["jumps"]
    ]
    if found["unbounded_from"]:
        lost = found["unbounded_from"]
        said.append(f"UNBOUNDED from {lost['frequency_hz']:g} Hz {lost['direction']} on")
    return "; ".join(said)


def _run(bundle: Bundle, run: str, cores: int, seconds: float) -> Json:
    sweep = bundle.profile.sweep
    return {
        "id": run,
        "name": bundle.name,
        "title": bundle.profile.title,
        "source": "models",
        "started_at": today().isoformat(timespec="seconds"),
        "host": platform.node(),
        "versions": {name: version(name) for name in LIBRARIES},
        "drive": "ideal stepped sine: every step begins and ends at a zero of the table's "
        "acceleration, no blends between steps, no table; what sensors do is left out",
        "acceleration_m_s2": bundle.profile.sweep.steps[0].acceleration_m_s2,
        "cycles": sweep.cycles,
        "measured_cycles": sweep.measured_cycles,
        "normalisation": "u* and a* are the maxima in free flight of each model's linear part, "
        "continuous in frequency",
        "profile_toml": bundle.profile_toml,
        "cores": cores,
        "seconds": seconds,
    }
