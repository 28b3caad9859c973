"""Terminal messages of a campaign, and prompts for the operator."""

import getpass

from rich.table import Table

from table_io.clock import local_datetime
from twin.campaign.config import PlannedRun
from twin.campaign.gap_comparison import CRITERIA, format_best, format_gap
from twin.campaign.result import GapResult, Spread
from twin.campaign.state import ActiveCampaign, OperatorAnswer, Reply, read_part_summaries
from twin.campaign.summary import merge_summaries
from twin.results.summary import format_summary
from twin.system.terminal import console, print_line, print_table


def format_run_name(campaign: ActiveCampaign, run: PlannedRun) -> str:
    """Return the number of a run, the number of runs, and its label."""
    return f"{run.number:>2}/{len(campaign.plan.runs)} {run.label}"


def format_run_start(campaign: ActiveCampaign, run: PlannedRun) -> str:
    """Return one line that describes the run about to be played."""
    steps, first = run.bundle.steps, campaign.starting_step(run)
    text = f"{format_run_name(campaign, run)}: {run.bundle.profile.title}"
    if not campaign.run_state(run).parts:
        return f"{text}; {run.bundle.extent}"
    if not steps:
        return f"{text}; {run.bundle.extent}, again from the beginning"
    where = f"{steps[first].frequency_hz:g} Hz {steps[first].direction}"
    return f"{text}; continues from step {first + 1} of {len(steps)}, {where}"


def make_answer(asked: str, reply: Reply) -> OperatorAnswer:
    """Return an operator answer with user name and time."""
    try:
        who = getpass.getuser()
    except (KeyError, OSError):
        who = "unknown"
    return OperatorAnswer(
        asked=asked, answer=reply, who=who, at=local_datetime().isoformat(timespec="seconds")
    )


def format_run_end(campaign: ActiveCampaign, run: PlannedRun) -> str:
    """Return one line with the results of a run, merged over its recordings."""
    state = campaign.run_state(run)
    summaries = read_part_summaries(campaign.folder, state)
    merged = merge_summaries(state, run.bundle.profile, summaries)
    result = format_summary(merged, len(run.bundle.steps))
    text = f"{format_run_name(campaign, run)}: {result}"
    return f"{text}; from {len(summaries)} recordings" if len(summaries) > 1 else text


def unattended_answer(asked: str) -> OperatorAnswer:
    """Return the answer recorded when no operator is asked."""
    return make_answer(asked, "unattended" if asked else "not asked")


def ask_operator(
    campaign: ActiveCampaign, run: PlannedRun, confirmed: str | None
) -> OperatorAnswer | None:
    """Ask the operator to confirm the set-up of a run; return the answer, or None to stop.

    A run that needs the set-up `confirmed` last in this session asks only for a prompt of its own.
    """
    required = campaign.required_set_up(run)
    prompt = run.prompt if required == confirmed else required
    if not prompt:
        return make_answer("", "not asked")
    if run.notes:
        print_line(run.notes)
    print_line(f"SET-UP: {prompt}")
    while True:
        try:
            reply = console.input(
                "Press Enter when done, s to skip this run, q to stop the campaign: "
            )
        except (KeyboardInterrupt, EOFError):
            print_line("")
            return None
        match reply.strip().lower():
            case "":
                return make_answer(prompt, "done")
            case "s":
                return make_answer(prompt, "skipped")
            case "q":
                return None


def print_gap_comparison(comparison: GapResult) -> None:
    """Print a comparison of gaps: medians over the records, best gaps."""
    count, source = len(comparison.records), comparison.sources[0]
    title = (
        f"median (smallest to largest) over {count} records, {comparison.main_name}; "
        f"1 is {comparison.reference}, * is best"
    )
    headers = ("acceleration", "displacement", "compromise", "force / weight")
    table = Table("gap", *headers, title=title)
    best = comparison.best[source]
    for row in comparison.gaps:
        cells = []
        for name in CRITERIA:
            winner = best[name]
            is_best = winner is not None and winner.gap_mm == row.gap_mm
            cells.append(_format_spread(row.select(source)[name], is_best))
        table.add_row(format_gap(row.gap_mm), *cells)
    print_table(console, table)
    for name, meaning in CRITERIA.items():
        print_line(f"{meaning}: {format_best(best[name])}")
    if comparison.left_out:
        print_line(f"left out, for dropouts in the recording: {', '.join(comparison.left_out)}")


def _format_spread(spread: Spread, is_best: bool) -> str:
    if not spread.count:
        return "–"
    text = f"{spread.median:.2f} ({spread.smallest:.2f} to {spread.largest:.2f})"
    return f"{text} *" if is_best else text
