"""Play the runs of a campaign: in real time one after another, or simulated ones in parallel.

In real time the operator changes the set-up between the runs; simulated ones play at maximum speed.
"""

import json
import os
import select
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn

from table_io.clock import RealClock
from table_io.errors import InputError
from twin.campaign.config import PlannedRun
from twin.campaign.messages import (
    ask_operator,
    format_run_end,
    format_run_name,
    format_run_start,
    unattended_answer,
)
from twin.campaign.report import write_campaign_report
from twin.campaign.state import ActiveCampaign, OperatorAnswer, write_summary_and_report
from twin.live.process_config import ProcessConfig
from twin.live.supervisor import Supervisor
from twin.recording.merge import merge_run_parts
from twin.security.credentials import Credentials, credentials_folder
from twin.system.exit_codes import EXIT_ABORTED, EXIT_INTERRUPTED
from twin.system.files import count_cores
from twin.system.progress import RunProgress
from twin.system.terminal import catch_interrupts, console, print_line

MAX_WORKERS = 2  # each holds a whole recording in memory while it writes the report


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


@dataclass(slots=True)
class RunWorker:
    """A process and the run that it plays; `partial_line` is its last, unfinished output line."""

    process: subprocess.Popen[bytes]
    run: str = ""
    partial_line: bytes = b""

    @property
    def pipe(self) -> int:
        """File descriptor of its standard output."""
        assert self.process.stdout is not None
        return self.process.stdout.fileno()

    def close(self) -> int:
        """Wait until the process has ended; close its pipes and return its exit code."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.close()
        code = self.process.wait()
        self.process.stdout.close()
        return code


class WorkerPool:
    """Worker processes that play runs; use as a context manager."""

    def __init__(self, lock: int) -> None:
        self._lock = lock
        self._workers: list[RunWorker] = []

    def __enter__(self) -> "WorkerPool":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Stop all workers; the table of a run in progress comes to rest."""
        self.stop()
        for worker in self._workers:
            worker.close()

    @property
    def free(self) -> bool:
        """Whether another run can be submitted."""
        limit = min(MAX_WORKERS, count_cores())
        return sum(bool(worker.run) for worker in self._workers) < limit

    @property
    def busy(self) -> bool:
        """Whether a run is in progress."""
        return any(worker.run for worker in self._workers)

    def submit(self, run: str, spec: ProcessConfig) -> None:
        """Start a run on an idle worker, or on a new one."""
        idle = (
            worker for worker in self._workers if not worker.run and worker.process.poll() is None
        )
        worker = next(idle, None) or self._start_worker()
        worker.run = run
        assert worker.process.stdin is not None
        worker.process.stdin.write(json.dumps(asdict(spec)).encode() + b"\n")
        worker.process.stdin.flush()

    def stop(self) -> None:
        """Bring every table to rest; a worker that is writing its report finishes it."""
        for worker in self._workers:
            if worker.run and worker.process.poll() is None:
                worker.process.send_signal(signal.SIGTERM)

    def messages(self, seconds: float) -> Iterator[tuple[str, dict[str, Any]]]:
        """Yield (run, message) of each message received; wait for at most `seconds`."""
        by_pipe = {worker.pipe: worker for worker in self._workers if worker.run}
        for pipe in select.select(list(by_pipe), [], [], seconds)[0]:
            worker = by_pipe[pipe]
            new = os.read(pipe, 65536)
            *lines, worker.partial_line = (worker.partial_line + new).split(b"\n")
            for line in lines:
                message = json.loads(line)
                run = worker.run
                if "reported" in message or "failed" in message:
                    worker.run = ""
                yield run, message
            if not new:
                run, code = worker.run, worker.close()
                self._workers.remove(worker)
                outcome = signal.Signals(-code).name if code < 0 else f"exit {code}"
                yield run, {"failed": f"its worker process died ({outcome})"}

    def _start_worker(self) -> RunWorker:
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", "twin.campaign.worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            pass_fds=(self._lock,),
            start_new_session=True,
        )
        self._workers.append(RunWorker(process))
        return self._workers[-1]


def play_realtime(
    campaign: ActiveCampaign, asks: bool, listen: str, keys: Credentials | None
) -> int:
    """Play the pending runs; return the exit code. No run starts after one that is incomplete."""
    confirmed = None if campaign.resumed else ""  # the set-up; None: unknown
    for run in campaign.pending_runs():
        print_line(format_run_start(campaign, run))
        answer = ask_operator(campaign, run, confirmed) if asks else unattended_answer(run.prompt)
        if answer is None:
            return EXIT_INTERRUPTED
        if answer.answer == "skipped":
            confirmed = None  # the change may have been begun
            campaign.skip_run(run, answer)
            continue
        if answer.answer == "done":
            confirmed = answer.asked
        code = _play_run(campaign, run, answer, listen, keys)
        if code:
            return code
        write_campaign_report(campaign.folder)
    return 0


def _play_run(
    campaign: ActiveCampaign,
    run: PlannedRun,
    answer: OperatorAnswer,
    listen: str,
    keys: Credentials | None,
) -> int:
    """Play a run on the table; return exit code 0 if it is complete."""
    config = replace(campaign.begin_recording(run, answer, listen), keys=credentials_folder(keys))
    bundle = config.make_run_config()
    progress = RunProgress(console, len(bundle.steps), bundle.drive.planned_end)
    with catch_interrupts() as stop_requested, progress:
        supervisor = Supervisor(
            config,
            bundle.profile.on_death,
            RealClock(),
            progress,
            stop_requested,
            progress.print_line,
        )
        try:
            began = supervisor.run()
        except InputError:
            campaign.discard_recording(run)
            raise
    if not began:
        campaign.discard_recording(run)
        return EXIT_INTERRUPTED
    try:
        merge_run_parts(Path(config.folder))
        write_summary_and_report(Path(config.folder))
    except InputError as error:
        campaign.mark_unreadable(run, str(error))
        print_line(f"{format_run_name(campaign, run)}: {error}")
        return EXIT_ABORTED
    is_complete = campaign.finish_recording(run)
    print_line(f"{format_run_end(campaign, run)} -> {config.folder}/report.html")
    if stop_requested():
        return EXIT_INTERRUPTED
    return 0 if is_complete else EXIT_ABORTED
