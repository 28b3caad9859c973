"""`run`: run a test on the table, in real time or at full speed."""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

from table_io.clock import RealClock
from twin.log import Log, open_log
from twin.recording.merge import merge_run_parts
from twin.report.finalize import print_outcome, write_results
from twin.security.credentials import Credentials, credentials_folder
from twin.setup.disk import require_disk_space
from twin.setup.folders import RUNS_FOLDER, make_run_folder
from twin.setup.realtime import check_full_speed, check_realtime
from twin.setup.run_config import RunConfig, list_test_warnings, read_run_config
from twin.setup.unpaced import play_unpaced
from twin.setup.warm_up import compile_kernels
from twin.system.exit_codes import EXIT_ABORTED, EXIT_INTERRUPTED
from twin.system.progress import RunProgress
from twin.system.terminal import catch_interrupts, console, print_line, show_status
from twin.transport.endpoint import check_endpoint
from twin.viewer.address import VIEW_ADDRESS, find_free_address, format_live_view


def run_test(
    profile: Path,
    out: Path | None,
    unpaced: bool,
    model: str | None,
    table: str | None,
    view: bool,
    listen: str,
    keys: Credentials | None = None,
    router: str = "",
    remote_twin: bool = False,
    start_page: Callable[[str], AbstractContextManager[None]] | None = None,
) -> int:
    """Run a test on the table, in real time or at full speed; return the exit code.

    `start_page` serves the page of the tests of a rig while its context lasts.
    """
    with show_status("checking the test"):
        config = read_run_config(profile, table, model)
    if unpaced:
        check_full_speed(config.rig, has_page=start_page is not None)
    else:
        check_endpoint(config.rig.name, listen, has_keys=keys is not None)
        check_realtime(config, profile)
    compile_kernels(config, table=True)
    require_disk_space([config], out or RUNS_FOLDER)
    folder, run_id = make_run_folder(out, config.name)
    for sentence in list_test_warnings(config):
        print_line(f"warning: {sentence}")
    print_line(
        f"{config.profile.title}: {config.extent}, "
        f"{config.expected_s:.0f} s on {config.rig.title} "
        f"-> {folder}"
    )
    with nullcontext() if start_page is None else start_page(config.rig.name):
        with catch_interrupts() as poll_interrupt:
            if unpaced:
                _run_unpaced(config, run_id, folder, poll_interrupt)
            else:
                connection = (listen, keys, router, remote_twin)
                began = _run_live(config, run_id, folder, poll_interrupt, view, *connection)
                if not began:
                    return EXIT_INTERRUPTED
        summary = write_results(folder, config, view)
        code = print_outcome(summary, folder, len(config.steps))
    return EXIT_INTERRUPTED if poll_interrupt() and code == EXIT_ABORTED else code


def run_simulated(
    profile: str | Path,
    out: str | Path | None = None,
    model: str | Path | None = None,
    table: str | Path | None = None,
) -> Log:
    """Run a test on a simulated table as fast as possible; return its log in folder `out`.

    The table has sensors with noise, a servo, and what its rig file `table` hides; `model` is that
    of the twin. Writes summary and report, as `run --speed max` does. InputError if the test
    exceeds the limits of the table, or the table is real.
    """
    names = (None if name is None else str(name) for name in (table, model))
    config = read_run_config(Path(profile), *names)
    check_full_speed(config.rig)
    compile_kernels(config, table=True)
    folder, run = make_run_folder(None if out is None else Path(out), config.name)
    play_unpaced(config, run, folder / "run.mcap", lambda: None, lambda _: None)
    write_results(folder, config)
    return open_log(folder)


def _run_unpaced(
    config: RunConfig, run: str, folder: Path, poll_interrupt: Callable[[], str | None]
) -> None:
    with RunProgress(console, len(config.steps), config.drive.planned_end) as progress:
        play_unpaced(config, run, folder / "run.mcap", poll_interrupt, progress)


def _run_live(
    config: RunConfig,
    run: str,
    folder: Path,
    poll_interrupt: Callable[[], str | None],
    view: bool,
    listen: str,
    keys: Credentials | None,
    router: str,
    remote_twin: bool,
) -> bool:
    """Run a test in real time; return False if it was interrupted before it began."""
    from twin.live.process_config import ProcessConfig
    from twin.live.supervisor import Supervisor

    process_config = ProcessConfig(
        run,
        config.name,
        str(folder),
        listen,
        config.profile_toml,
        config.rig_toml,
        config.model_toml,
        serve_view=find_free_address(VIEW_ADDRESS) if view else "",
        keys=credentials_folder(keys),
        router=router,
        remote_twin=remote_twin,
    )
    with RunProgress(console, len(config.steps), config.drive.planned_end) as progress:
        supervisor = Supervisor(
            process_config,
            config.profile.on_death,
            RealClock(),
            progress,
            poll_interrupt,
            progress.print_line,
        )
        if view:
            progress.print_line(format_live_view(process_config.serve_view))
        began = supervisor.run()
    if began:
        merge_run_parts(folder)
    return began
