"""Play a campaign in real time: one run after another, with set-up changes by the operator."""

from dataclasses import replace
from pathlib import Path

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
from twin.live.supervisor import Supervisor
from twin.recording.merge import merge_run_parts
from twin.report.finalize import EXIT_ABORTED, EXIT_INTERRUPTED
from twin.security.credentials import Credentials, credentials_folder
from twin.system.progress import RunProgress
from twin.system.terminal import catch_interrupts, console, print_line


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
