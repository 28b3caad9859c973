"""`fleet`: call the task, print what came of it."""

from twin.archive.fleet import TABLE_FILE, FleetOptions, run_fleet
from twin.system.exit_codes import EXIT_GAPS, EXIT_INTERRUPTED
from twin.system.grid import watch_on_terminal
from twin.system.terminal import print_line

MAX_LISTED = 20  # failures, and changes; all of them are in the tables


def print_fleet(options: FleetOptions) -> int:
    """Run a fleet, print its table, failures and changes; return the exit code."""
    with watch_on_terminal("stopping after the logs in progress") as watch:
        fleet = run_fleet(options, watch)
    for failed in fleet.failures[:MAX_LISTED]:
        print_line(f"failed: {failed.log}: {failed.failure}")
    for change in fleet.changes[:MAX_LISTED]:
        print_line(f"changed: {change.log}: {change.column} {change.before} -> {change.after}")
    state = "complete"
    if not fleet.is_complete:
        state = f"stopped ({fleet.stop_reason}); continue with --resume"
    changes = "" if options.since is None else f", {len(fleet.changes)} values changed"
    print_line(
        f"{len(fleet.results)} of {fleet.total} logs, {len(fleet.failures)} failed{changes}, "
        f"{state} -> {fleet.folder / TABLE_FILE}"
    )
    if not fleet.is_complete:
        return EXIT_INTERRUPTED
    return EXIT_GAPS if fleet.failures else 0
