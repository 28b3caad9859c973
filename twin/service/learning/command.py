"""`shaketwin discover`: the shell round `twin.learn.discover`."""

from collections.abc import Sequence
from pathlib import Path

from table_io.card import parse
from table_io.clock import RealClock
from table_io.profile import Specimen
from twin.learn.discover import Discovery, Log, discover
from twin.model.card import ModelCard
from twin.model.model import Model
from twin.service.bundle import read_model
from twin.service.folders import new_run
from twin.service.learning.logs import logs_of
from twin.service.learning.page import write_page
from twin.service.learning.told import Json, model_toml, verdict_json
from twin.service.summary import dumps
from twin.service.terminal import console, say


def model_of(name: str) -> tuple[Model, ModelCard]:
    """(the model of a card, the card): mass and gaps come with each log."""
    card, text = read_model(name)
    card = parse(text, ModelCard, name)
    return card.model(Specimen(mass_kg=1.0, gap_mm=float("inf"))), card


def discover_command(
    paths: Sequence[Path], model: str, out: Path | None, without: Sequence[str]
) -> int:
    """Find, name, add, show; the exit code."""
    clock = RealClock()
    began = clock.now()
    start, card = model_of(model)
    logs, notes = logs_of(paths)
    folder, _ = new_run(out, "discover")
    with console.status("the model as it is") as status:
        found = discover(logs, start, lambda text: status.update(f"trying {text}"), without)
    told = verdict_json(found, clock.now() - began, notes)
    leave(folder, found, card, logs, told)
    say_verdict(told)
    say(f"{folder}")
    return 0


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
    say(
        f"  gap {gap['held_out_before']:.3g} -> {gap['held_out_after']:.3g}, noise "
        f"{gap['noise_floor']:.3g}: {100 * gap['closed_fraction']:.0f} % closed (held out)"
    )
    for one in told["effects"]:
        for name, value in one["parameters"].items():
            half = 0.5 * (value["high"] - value["low"])
            say(f"  {one['id']} {name} = {value['value']:.5g} +- {half:.2g} {value['unit']}")
    for note in told["notes"]:
        say(f"  note: {note}")
    say(f"  next: {told['next_run']}")
