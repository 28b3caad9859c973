"""`shaketwin campaign`: what is checked before it, the runs, and how it ends."""

import shlex
import sys
from dataclasses import dataclass
from pathlib import Path

from table_io.card import BadInput
from table_io.clock import today
from table_io.due import overdue
from twin.service.bundle import Bundle, run_id
from twin.service.campaign.book import Book, begun, reopened
from twin.service.campaign.card import doubts, read_plan
from twin.service.campaign.paced import paced
from twin.service.campaign.report import write_whole
from twin.service.campaign.state import LOCK, locked
from twin.service.campaign.unpaced import unpaced
from twin.service.disk import refuse_full
from twin.service.driving import real_time
from twin.service.folders import RUNS, new_folder
from twin.service.kernels import ready
from twin.service.outcome import EXIT_GAPS
from twin.service.terminal import say
from twin.stream.keys import Keys


@dataclass(frozen=True, slots=True)
class Asked:
    """The command line of a campaign."""

    path: Path
    out: Path | None
    resume: bool
    unpaced: bool
    model: str | None
    table: str | None
    unattended: bool
    listen: str
    keys: Keys | None = None

    def again(self, folder: Path) -> str:
        """The command that goes on with the campaign in a folder."""
        words = ["shaketwin", "campaign", str(self.path), "--out", str(folder), "--resume"]
        for option, value in (("--model", self.model), ("--table", self.table)):
            words += [option, value] if value else []
        words += ["--speed", "max"] if self.unpaced else []
        words += ["--yes"] if self.unattended else []
        return shlex.join(words)


def campaign(asked: Asked) -> int:
    """A whole campaign, or what is left of it; the exit code."""
    allowed = _any_speed if asked.unpaced else real_time
    plan = read_plan(asked.path, asked.table, asked.model, allowed)
    ready(plan.runs[0].bundle, table=True)
    asks = not (asked.unpaced or asked.unattended)
    if asks and not sys.stdin.isatty():
        raise BadInput("no terminal to ask the operator between the runs; give --yes")
    if not asked.resume:
        refuse_full([run.bundle for run in plan.runs], asked.out or RUNS)
    folder = _folder(asked)
    with locked(folder / LOCK) as lock:
        if asked.resume:
            say(f"reading what is recorded in {folder}")
        book, found = reopened(folder, plan) if asked.resume else (begun(folder, plan), [])
        for one in (*found, *doubts(plan), *overdue(plan.runs[0].bundle.rig, today().date())):
            say(f"warning: {one}")
        refuse_full([run.bundle for run in book.pending()], folder)
        _announce(book)
        try:
            code = (
                unpaced(book, lock)
                if asked.unpaced
                else paced(book, asks, asked.listen, asked.keys)
            )
        finally:
            page = write_whole(folder)
    return _conclude(book, code, page, asked)


def _any_speed(bundle: Bundle, _: Path) -> None:
    if not bundle.rig.any_speed:
        raise BadInput(f"--speed max: {bundle.rig.name!r} keeps its own time; leave --speed away")


def _folder(asked: Asked) -> Path:
    """The campaign's folder: a new one, or the one to go on in."""
    if not asked.resume:
        try:
            return new_folder(asked.out, run_id(asked.path.stem))
        except BadInput as error:
            raise BadInput(f"{error}, or go on with the campaign in it by --resume") from None
    if asked.out is None:
        raise BadInput("--resume: say with --out DIR which campaign goes on")
    if not asked.out.is_dir():
        raise BadInput(f"--out {asked.out}: no such folder; leave --resume away to begin there")
    return asked.out


def _announce(book: Book) -> None:
    plan, left = book.plan, book.pending()
    say(
        f"{plan.card.title}: {len(plan.runs)} runs, {plan.seconds / 60:.0f} min of motion "
        f"-> {book.folder}"
    )
    if book.resumed:
        say(f"complete and sound: {len(plan.runs) - len(left)}, left: {len(left)}")


def _conclude(book: Book, code: int, page: Path, asked: Asked) -> int:
    """Say what was done and how to go on; the exit code."""
    left, runs = book.pending(), book.state.runs
    say(f"{len(runs) - len(left)} of {len(runs)} runs complete -> {page}")
    if left:
        say(f"left: {', '.join(run.label for run in left)}; go on with")
        say(f"  {asked.again(book.folder)}")
    gaps = sum(part.gaps for run in runs for part in run.parts if run.status == "complete")
    return EXIT_GAPS if not code and gaps else code
