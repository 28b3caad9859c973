"""Every run of a campaign on the simulated table as fast as it goes, as many at a time as fit."""

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn

from twin.service.campaign.book import Book
from twin.service.campaign.card import Planned
from twin.service.campaign.crew import Crew
from twin.service.campaign.words import ended, head, name, unattended
from twin.service.outcome import EXIT_ABORTED, EXIT_INTERRUPTED
from twin.service.terminal import console, interruptible, say


def unpaced(book: Book, lock: int) -> int:
    """Play what is left; the exit code. After a run that did not end as planned none begins."""
    bars = Progress(
        TextColumn("{task.description}"), BarColumn(bar_width=40), MofNCompleteColumn(),
        console=console, disable=not console.is_terminal, transient=True,
    )  # fmt: skip
    tasks: dict[str, TaskID] = {}
    runs = {run.name: run for run in book.plan.runs}
    queue, code = book.pending(), 0
    with interruptible() as asked, bars, Crew(lock) as crew:
        while queue or crew.busy:
            while queue and crew.free:
                run = queue.pop(0)
                say(head(book, run))
                crew.give(run.name, book.begin(run, unattended(run.prompt), ""))
                tasks[run.name] = bars.add_task(run.label, total=len(run.bundle.steps))
            for which, words in crew.listen(0.2):
                if "step" in words:
                    bars.update(tasks[which], completed=words["step"] + 1)
                if "reported" in words or "failed" in words:
                    bars.remove_task(tasks[which])
                    if not _took(book, runs[which], words):
                        queue, code = [], code or EXIT_ABORTED
            if asked() and code != EXIT_INTERRUPTED:
                queue, code = [], EXIT_INTERRUPTED
                crew.stop()
    return code


def _took(book: Book, run: Planned, words: dict[str, str]) -> bool:
    """Take in how a run ended; True where it is complete."""
    if "failed" in words:
        book.lost(run, words["failed"])
        say(f"{name(book, run)}: {words['failed']}")
        return False
    whole = book.ended(run)
    say(ended(book, run))
    return whole
