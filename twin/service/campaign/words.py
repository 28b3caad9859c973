"""What a campaign says on the terminal, and what it asks the operator."""

import getpass
from typing import Literal

from table_io.clock import today
from twin.service.campaign.book import Book
from twin.service.campaign.card import Planned
from twin.service.campaign.joined import joined, read_summary
from twin.service.campaign.state import Answer
from twin.service.summary import sentence
from twin.service.terminal import console, say

Reply = Literal["done", "skipped", "unattended", "not asked"]


def name(book: Book, run: Planned) -> str:
    """Which run of how many, and its label."""
    return f"{run.number:>2}/{len(book.plan.runs)} {run.label}"


def head(book: Book, run: Planned) -> str:
    """What is about to be played, in a line."""
    steps, first = run.bundle.profile.sweep.steps, book.from_step(run)
    text = f"{name(book, run)}: {run.bundle.profile.title}"
    if not book.of(run).parts:
        return f"{text}; {len(steps)} steps"
    where = f"{steps[first].frequency_hz:g} Hz {steps[first].direction}"
    return f"{text}; again from step {first + 1} of {len(steps)} on, {where}"


def answer(asked: str, reply: Reply) -> Answer:
    """An answer with who gave it and when."""
    try:
        who = getpass.getuser()
    except (KeyError, OSError):
        who = "unknown"
    return Answer(asked=asked, answer=reply, who=who, at=today().isoformat(timespec="seconds"))


def ended(book: Book, run: Planned) -> str:
    """What a run found, in a line: of all its recordings, where it has several."""
    state, folder = book.of(run), book.folder
    found = [read_summary(folder / part.folder) for part in state.parts]
    said = f"{name(book, run)}: {sentence(joined(state, run.bundle.profile, found))}"
    return f"{said}; from {len(found)} recordings" if len(found) > 1 else said


def unattended(asked: str) -> Answer:
    """The answer where nobody is asked."""
    return answer(asked, "unattended" if asked else "not asked")


def ask(book: Book, run: Planned, first: bool) -> Answer | None:
    """What the operator answers before a run; None where the campaign ends here.

    The first run after a resume asks for its set-up even where the run before it left it so.
    """
    asked = book.set_up(run) if first and book.resumed else run.prompt
    if not asked:
        return answer("", "not asked")
    if run.notes:
        say(run.notes)
    say(f"SET-UP: {asked}")
    while True:
        try:
            reply = console.input("Enter when it is done, s to skip this run, q to stop here: ")
        except (KeyboardInterrupt, EOFError):
            say("")
            return None
        match reply.strip().lower():
            case "":
                return answer(asked, "done")
            case "s":
                return answer(asked, "skipped")
            case "q":
                return None
