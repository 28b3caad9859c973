"""The runs of a campaign in real time, one after another, the operator between them."""

from dataclasses import replace
from pathlib import Path

from table_io.card import BadInput
from table_io.clock import RealClock
from twin.service.campaign.book import Book
from twin.service.campaign.card import Planned
from twin.service.campaign.parts import finish
from twin.service.campaign.report import write_whole
from twin.service.campaign.state import Answer
from twin.service.campaign.words import ask, ended, head, name, unattended
from twin.service.outcome import EXIT_ABORTED, EXIT_INTERRUPTED
from twin.service.parts import gather
from twin.service.progress import RunProgress
from twin.service.supervisor import Supervisor
from twin.service.terminal import console, interruptible, say
from twin.stream.keys import Keys, folder_of


def paced(book: Book, asks: bool, listen: str, keys: Keys | None) -> int:
    """Play what is left; the exit code. After a run that did not end as planned none begins."""
    for place, run in enumerate(book.pending()):
        say(head(book, run))
        said = ask(book, run, place == 0) if asks else unattended(run.prompt)
        if said is None:
            return EXIT_INTERRUPTED
        if said.answer == "skipped":
            book.skipped(run, said)
            continue
        code = _play(book, run, said, listen, keys)
        if code:
            return code
        write_whole(book.folder)
    return 0


def _play(book: Book, run: Planned, said: Answer, listen: str, keys: Keys | None) -> int:
    """A run on the table; 0 where it is complete."""
    spec = replace(book.begin(run, said, listen), keys=folder_of(keys))
    bundle = spec.bundle()
    progress = RunProgress(console, len(bundle.steps), bundle.drive.planned_end)
    with interruptible() as asked, progress:
        supervisor = Supervisor(
            spec, bundle.profile.on_death, RealClock(), progress, asked, progress.say
        )
        try:
            began = supervisor.run()
        except BadInput:
            book.never_began(run)
            raise
    if not began:
        book.never_began(run)
        return EXIT_INTERRUPTED
    try:
        gather(Path(spec.folder))
        finish(Path(spec.folder))
    except BadInput as error:
        book.lost(run, str(error))
        say(f"{name(book, run)}: {error}")
        return EXIT_ABORTED
    whole = book.ended(run)
    say(f"{ended(book, run)} -> {spec.folder}/report.html")
    if asked():
        return EXIT_INTERRUPTED
    return 0 if whole else EXIT_ABORTED
