"""`simulate` with several models or gaps, and `map`: call the task, print its result."""

from table_io.errors import InputError
from twin.studies import DEFINITION_FILE
from twin.studies.maps.page import write_map_page
from twin.studies.maps.store import read_definition
from twin.studies.maps.task import MapOptions, compute_map, require_packages
from twin.studies.task import SweepOptions, simulate_sweeps
from twin.system.exit_codes import EXIT_INTERRUPTED
from twin.system.grid import watch_on_terminal
from twin.system.terminal import print_line


def simulate_all(options: SweepOptions) -> int:
    """Simulate every model at every gap; return the exit code."""
    with watch_on_terminal("stopping after the sweeps in progress") as watch:
        result = simulate_sweeps(options, watch)
    summary = result.summary
    seconds = f"{summary.run.seconds:.2g} s"
    print_line(f"{summary.verdict}: {summary.reason} in {seconds} -> {result.page}")
    return 0 if summary.verdict == "complete" else EXIT_INTERRUPTED


def run_study(options: MapOptions, show_only: bool) -> int:
    """Compute a map, or show one that has been stored; return the exit code."""
    path = options.study
    if show_only or ((path / DEFINITION_FILE).is_file() and not options.resume):
        if options != MapOptions(path, resume=options.resume):
            raise InputError(
                "a stored study is shown as it is",
                where=path,
                remedy="give its folder alone, or --resume to go on with it",
            )
        require_packages()
        read_definition(path)
        print_line(f"{write_map_page(path)}")
        return 0
    with watch_on_terminal("stopping after the chunks in progress") as watch:
        result = compute_map(options, watch)
    state = "complete"
    if not result.is_complete:
        state = f"stopped ({result.stop_reason}); continue with --resume"
    print_line(f"{result.stored} of {result.total} cases, {state} -> {result.page}")
    return 0 if result.is_complete else EXIT_INTERRUPTED
