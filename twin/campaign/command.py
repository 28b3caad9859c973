"""`shaketwin campaign`: check everything, play the runs, report the outcome."""

import shlex
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from table_io.clock import local_datetime
from table_io.config.calibration import find_overdue_calibrations
from table_io.errors import InputError
from twin.campaign.config import list_campaign_warnings, read_plan
from twin.campaign.messages import print_gap_comparison
from twin.campaign.players import play_offline, play_realtime
from twin.campaign.report import write_campaign_report
from twin.campaign.result import CampaignSummary
from twin.campaign.state import (
    LOCK_FILE,
    ActiveCampaign,
    begin_campaign,
    hold_lock,
    resume_campaign,
)
from twin.security.credentials import Credentials
from twin.setup.disk import require_disk_space
from twin.setup.folders import RUNS_FOLDER, make_output_folder
from twin.setup.realtime import check_full_speed, check_realtime
from twin.setup.run_config import RunConfig, make_run_id
from twin.setup.warm_up import compile_kernels
from twin.system.exit_codes import EXIT_GAPS
from twin.system.terminal import print_line, show_status


@dataclass(frozen=True, slots=True)
class CampaignOptions:
    """Options of the command line."""

    path: Path
    out: Path | None
    resume: bool
    unpaced: bool
    model: str | None
    table: str | None
    unattended: bool
    listen: str
    keys: Credentials | None = None
    start_page: Callable[[str], AbstractContextManager[None]] | None = None  # of a rig's tests
    access_words: tuple[str, ...] = ()  # of the command line, for endpoint, keys and page

    def resume_command(self, folder: Path) -> str:
        """Return the command line that resumes the campaign of a folder."""
        words = ["shaketwin", "campaign", str(self.path), "--out", str(folder), "--resume"]
        for option, value in (("--model", self.model), ("--table", self.table)):
            words += [option, value] if value else []
        words += ["--speed", "max"] if self.unpaced else []
        words += ["--yes"] if self.unattended else []
        words += self.access_words
        return shlex.join(words)


def run_campaign(options: CampaignOptions) -> int:
    """Play all runs of a campaign that are not complete; return the exit code."""
    has_page = options.start_page is not None
    check_run = partial(_require_any_speed, has_page) if options.unpaced else check_realtime
    with show_status("checking the runs"):
        plan = read_plan(options.path, options.table, options.model, check_run)
    rig = plan.runs[0].bundle.rig
    compile_kernels(plan.runs[0].bundle, table=True)
    ask_operator = not (options.unpaced or options.unattended)
    if ask_operator and not sys.stdin.isatty():
        raise InputError(
            "no terminal to ask the operator between the runs",
            remedy="give --yes to run without confirmation",
        )
    if not options.resume:
        require_disk_space([run.bundle for run in plan.runs], options.out or RUNS_FOLDER)
    with nullcontext() if options.start_page is None else options.start_page(rig.name):
        folder = _prepare_folder(options)
        with hold_lock(folder / LOCK_FILE) as lock:
            if options.resume:
                print_line(f"reading the recordings in {folder}")
            active, warnings = (
                resume_campaign(folder, plan)
                if options.resume
                else (begin_campaign(folder, plan), [])
            )
            for warning in (
                *warnings,
                *list_campaign_warnings(plan),
                *find_overdue_calibrations(rig, local_datetime().date()),
            ):
                print_line(f"warning: {warning}")
            require_disk_space([run.bundle for run in active.pending_runs()], folder)
            _print_plan(active)
            try:
                code = (
                    play_offline(active, lock)
                    if options.unpaced
                    else play_realtime(active, ask_operator, options.listen, options.keys)
                )
            finally:
                page = write_campaign_report(folder)
    return _print_outcome(active, code, page, options)


def _require_any_speed(has_page: bool, bundle: RunConfig, _: Path) -> None:
    check_full_speed(bundle.rig, has_page)


def _prepare_folder(options: CampaignOptions) -> Path:
    """Return the campaign's folder: a new one, or with --resume the existing one."""
    if not options.resume:
        try:
            return make_output_folder(options.out, make_run_id(options.path.stem))
        except InputError as error:
            remedy = "give a new folder, or add --resume to continue the campaign in it"
            raise error.replace(remedy=remedy) from None
    if options.out is None:
        raise InputError(
            "the folder of the campaign is missing", key="--resume", remedy="give it with --out DIR"
        )
    if not options.out.is_dir():
        raise InputError(
            "no such folder",
            key="--out",
            value=str(options.out),
            remedy="omit --resume to start a campaign there",
        )
    return options.out


def _print_plan(campaign: ActiveCampaign) -> None:
    plan, pending = campaign.plan, campaign.pending_runs()
    print_line(
        f"{plan.config.title}: {len(plan.runs)} runs, {plan.seconds / 60:.0f} min of motion "
        f"-> {campaign.folder}"
    )
    if campaign.resumed:
        print_line(f"complete: {len(plan.runs) - len(pending)}, remaining: {len(pending)}")


def _print_outcome(
    campaign: ActiveCampaign, code: int, page: Path, options: CampaignOptions
) -> int:
    """Print the outcome and the command that resumes the campaign; return the exit code."""
    pending, runs = campaign.pending_runs(), campaign.state.runs
    summary = CampaignSummary.read(campaign.folder / "summary.json", "resume the campaign")
    if summary.gap_comparison is not None:
        print_gap_comparison(summary.gap_comparison)
    print_line(f"{len(runs) - len(pending)} of {len(runs)} runs complete -> {page}")
    if pending:
        print_line(f"remaining: {', '.join(run.label for run in pending)}; continue with")
        print_line(f"  {options.resume_command(campaign.folder)}")
    gaps = sum(part.gaps for run in runs for part in run.parts if run.status == "complete")
    return EXIT_GAPS if not code and gaps else code
