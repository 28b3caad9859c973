"""`shaketwin discover`: the shell round `twin.learn.discover`."""

import contextlib
import math
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from table_io.card import BadInput
from table_io.clock import RealClock
from table_io.profile import Specimen
from twin.learn.discover import Discovery, Log, discover, transferred
from twin.learn.fit import Mapped
from twin.learn.naming import Enough, Tell, Trying
from twin.model.card import ModelCard
from twin.model.effects import find_effect
from twin.model.model import Model
from twin.service.bundle import read_model
from twin.service.folders import new_run
from twin.service.learning.logs import logs_of
from twin.service.learning.page import write_page
from twin.service.learning.told import Json, model_toml, verdict_json
from twin.service.outcome import EXIT_INTERRUPTED
from twin.service.summary import dumps
from twin.service.terminal import console, interruptible, say

LONG = 120_000  # samples of all logs: with fewer, threads cost more than they give
MOST_THREADS = 4  # each holds a motion of its own


def model_of(name: str) -> tuple[Model, ModelCard]:
    """(the model of a card, the card): mass and gaps come with each log."""
    card, _ = read_model(name)
    return card.model(Specimen(mass_kg=1.0, gap_mm=float("inf"))), card


def discover_command(
    paths: Sequence[Path],
    model: str,
    out: Path | None,
    without: Sequence[str] = (),
    held_out: Sequence[Path] = (),
) -> int:
    """Find, name, add, show; the exit code."""
    clock = RealClock()
    began = clock.now()
    start, card = model_of(model)
    for name in without:
        find_effect(name)
    folder, _ = new_run(out, "discover")
    try:
        with interruptible("stopping: what was found is kept") as stop, searching() as show:

            def tell(now: Trying) -> None:
                if stop():
                    raise Enough
                show(now)

            logs, notes = logs_of(paths)
            apart = logs_of(held_out)[0] if held_out else ()
            with side_by_side(logs) as each:
                found = discover(logs, start, tell, without, each, fitted=bool(card.fitted_on))
    except (BadInput, Enough) as error:
        folder.rmdir()  # nothing is left of a failure
        if isinstance(error, BadInput):
            raise
        say("interrupted before anything was found")
        return EXIT_INTERRUPTED
    told = verdict_json(found, clock.now() - began, notes)
    told["held_out_logs"] = [
        {
            "log": log.readings.name,
            "nrmse_before": transferred(log, found.named.null),
            "nrmse_after": transferred(log, found.verdict.best),
        }
        for log in apart
    ]
    leave(folder, found, card, logs, told)
    say_verdict(told)
    say(f"{folder}")
    return 0 if found.named.whole else EXIT_INTERRUPTED


@contextlib.contextmanager
def side_by_side(logs: Sequence[Log]) -> Iterator[Mapped]:
    """A map on all cores where the logs are long; kernels and array sums leave Python's lock."""
    if sum(log.readings.time_s.size for log in logs) < LONG:
        yield map
        return
    with ThreadPoolExecutor(min(os.cpu_count() or 1, MOST_THREADS)) as pool:
        yield pool.map


@contextlib.contextmanager
def searching() -> Iterator[Tell]:
    """What is being tried and the best so far: a bar on a terminal, plain lines elsewhere."""
    if not console.is_terminal:
        yield lambda now: say(f"  {_plain(now)}") if now.place or not now.best else None
        return
    bar = Progress(
        TextColumn("{task.description}"), BarColumn(bar_width=16), MofNCompleteColumn(),
        TextColumn("[green]{task.fields[best]}"), TimeElapsedColumn(), console=console,
        transient=True,
    )  # fmt: skip
    task = bar.add_task("reading", total=None, best="")

    def show(now: Trying) -> None:
        bar.tasks[0].total = None  # update() takes None for no change
        bar.update(
            task, description=escape(" + ".join(now.names) or now.stage),
            total=now.of or None, completed=max(now.place - 1, 0), best=escape(_best(now)),
        )  # fmt: skip

    with bar:
        yield show


def _plain(now: Trying) -> str:
    if not now.place:
        return f"trying {now.stage}"
    return f"trying {' + '.join(now.names)} ({now.place} of {now.of}); {_best(now)}"


def _best(now: Trying) -> str:
    if now.best is None:
        return ""
    what = " + ".join(now.best.names) or "nothing added"
    return f"best so far {what}: {math.sqrt(now.best.cost):.3g} of noise"


def leave(folder: Path, found: Discovery, card: ModelCard, logs: Sequence[Log], told: Json) -> None:
    """verdict.json, model.toml, figures and report.html in the folder."""
    names = ", ".join(log.readings.name for log in logs)
    added = " + ".join(found.verdict.best.names) or "nothing added"
    title = f"{card.title}; {added}"
    text, left_out = model_toml(found.verdict.best.fit, title, card.citation, names)
    told["notes"] += left_out
    (folder / "model.toml").write_text(text, encoding="utf-8")
    (folder / "verdict.json").write_text(dumps(told), encoding="utf-8")
    write_page(folder, found, logs, told)


def say_verdict(told: Json) -> None:
    """The outcome in a few lines."""
    names = " + ".join(
        ".".join(filter(None, (one["id"], one.get("channel")))) for one in told["effects"]
    )
    gap = told["gap"]
    say(f"{told['verdict']}: {names}" if names else told["verdict"])
    say(f"  {told['why']}")
    closed = f": {100 * gap['closed_fraction']:.0f} % closed" if told["effects"] else ""
    say(
        f"  gap {gap['held_out_before']:.3g} -> {gap['held_out_after']:.3g}, noise "
        f"{gap['noise_floor']:.3g}{closed} (held out)"
    )
    for one in told["effects"]:
        for name, value in one["parameters"].items():
            half = 0.5 * (value["high"] - value["low"])
            say(f"  {one['id']} {name} = {value['value']:.5g} +- {half:.2g} {value['unit']}")
    for one in told.get("held_out_logs", []):
        say(
            f"  {one['log']}, not fitted on: NRMSE of the damper force "
            f"{one['nrmse_before']:.3g} -> {one['nrmse_after']:.3g}"
        )
    for note in told["notes"]:
        say(f"  note: {note}")
    say(f"  next: {told['next_run']}")
