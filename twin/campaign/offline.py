"""Play a campaign offline: simulated runs at maximum speed, several in parallel."""

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn

from twin.campaign.config import PlannedRun
from twin.campaign.messages import (
    format_run_end,
    format_run_name,
    format_run_start,
    unattended_answer,
)
from twin.campaign.state import ActiveCampaign
from twin.campaign.worker_pool import WorkerPool
from twin.reports.finalize import EXIT_ABORTED, EXIT_INTERRUPTED
from twin.run.terminal import catch_interrupts, console, print_line


def play_offline(campaign: ActiveCampaign, lock: int) -> int:
    """Play the pending runs; return the exit code. No run starts after one that is incomplete."""
    progress = Progress(
        TextColumn("{task.description}"), BarColumn(bar_width=40), MofNCompleteColumn(),
        console=console, disable=not console.is_terminal, transient=True,
    )  # fmt: skip
    tasks: dict[str, TaskID] = {}
    runs = {run.name: run for run in campaign.plan.runs}
    queue, code = campaign.pending_runs(), 0
    with catch_interrupts() as stop_requested, progress, WorkerPool(lock) as pool:
        while queue or pool.busy:
            while queue and pool.free:
                run = queue.pop(0)
                print_line(format_run_start(campaign, run))
                pool.submit(
                    run.name, campaign.begin_recording(run, unattended_answer(run.prompt), "")
                )
                tasks[run.name] = progress.add_task(run.label, total=len(run.bundle.steps))
            for run_name, message in pool.messages(0.2):
                if "step" in message:
                    progress.update(tasks[run_name], completed=message["step"] + 1)
                if "reported" in message or "failed" in message:
                    progress.remove_task(tasks[run_name])
                    if not _finish_run(campaign, runs[run_name], message):
                        queue, code = [], code or EXIT_ABORTED
            if stop_requested() and code != EXIT_INTERRUPTED:
                queue, code = [], EXIT_INTERRUPTED
                pool.stop()
    return code


def _finish_run(campaign: ActiveCampaign, run: PlannedRun, message: dict[str, str]) -> bool:
    """Update the state of a run that ended; return whether it is complete."""
    if "failed" in message:
        campaign.mark_unreadable(run, message["failed"])
        print_line(f"{format_run_name(campaign, run)}: {message['failed']}")
        return False
    is_complete = campaign.finish_recording(run)
    print_line(format_run_end(campaign, run))
    return is_complete
