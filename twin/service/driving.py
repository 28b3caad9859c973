"""`check` and `run`: a test before it moves anything, and the test itself."""

import math
from collections.abc import Callable
from pathlib import Path

from table_io.backends import answers
from table_io.card import BadInput
from table_io.clock import RealClock, today
from table_io.due import overdue
from table_io.following import planned
from table_io.limits import doubts, warnings
from twin.service.bundle import Bundle, read_bundle, run_id
from twin.service.disk import refuse_full
from twin.service.folders import RUNS, new_folder, new_run
from twin.service.kernels import ready
from twin.service.outcome import EXIT_ABORTED, EXIT_INTERRUPTED, close
from twin.service.progress import RunProgress
from twin.service.terminal import console, interruptible, say
from twin.stream.keys import Keys, folder_of
from twin.stream.rerun.address import VIEW_ADDRESS, live_view, next_free

SHORTEST_BLOCK_S, LONGEST_BLOCK_S = 0.002, 0.05  # protection looks once a block


def check(profile: Path, table: str | None, out: Path | None) -> None:
    """Prints the plan and the margins; draws the drive where `out` is given."""
    from twin.service.preflight import draw_drive, print_plan

    bundle = read_bundle(profile, table)
    print_plan(console, bundle)
    if out is not None:
        folder = new_folder(out, run_id(bundle.name))
        say(f"drive drawn: {draw_drive(bundle, folder / 'drive.png')}")


def run(
    profile: Path,
    out: Path | None,
    unpaced: bool,
    model: str | None,
    table: str | None,
    view: bool,
    listen: str,
    keys: Keys | None = None,
    router: str = "",
    remote_twin: bool = False,
) -> int:
    """A test on the table, live or as fast as it goes; the exit code."""
    bundle = read_bundle(profile, table, model)
    if unpaced and not bundle.rig.any_speed:
        raise BadInput(f"--speed max: {bundle.rig.name!r} keeps its own time; leave --speed away")
    if not unpaced:
        real_time(bundle, profile)
    ready(bundle, table=True)
    refuse_full([bundle], out or RUNS)
    folder, run_name = new_run(out, bundle.name)
    said = (*warnings(bundle.margins, bundle.rig), *doubts(bundle.profile, bundle.rig))
    for sentence in (*said, *overdue(bundle.rig, today().date())):
        say(f"warning: {sentence}")
    say(
        f"{bundle.profile.title}: {len(bundle.steps)} steps, "
        f"{bundle.drive.planned_end / bundle.drive.rate_hz:.0f} s on {bundle.rig.title} "
        f"-> {folder}"
    )
    with interruptible() as asked:
        if unpaced:
            _run_unpaced(bundle, run_name, folder, asked)
        else:
            outside = (listen, keys, router, remote_twin)
            began = _run_live(bundle, run_name, folder, asked, view, *outside)
            if not began:
                return EXIT_INTERRUPTED
    code = close(folder, bundle, view)
    return EXIT_INTERRUPTED if asked() and code == EXIT_ABORTED else code


def real_time(bundle: Bundle, profile: Path) -> None:
    """BadInput where a block is too short or too long, or no machine answers.

    Too short is what cannot be handled in time, too long what does not protect the table.
    """
    samples, rate = bundle.profile.acquisition.block_samples, bundle.drive.rate_hz
    least, most = math.ceil(rate * SHORTEST_BLOCK_S), math.floor(rate * LONGEST_BLOCK_S)
    if not least <= samples <= most:
        raise BadInput(
            f"{profile}: acquisition.block_samples = {samples}: in real time at {rate:g} Hz a "
            f"block may have {least} to {most} samples; change it, or use --speed max"
        )
    if bundle.rig.backend == "follow":
        planned(bundle.profile, bundle.rig)  # a test that cannot be given away says so now
    answers(bundle.rig)


def _run_unpaced(
    bundle: Bundle, run_name: str, folder: Path, asked: Callable[[], str | None]
) -> None:
    from twin.service.runs import play_unpaced

    with RunProgress(console, len(bundle.steps), bundle.drive.planned_end) as progress:
        play_unpaced(bundle, run_name, folder / "run.mcap", asked, progress)


def _run_live(
    bundle: Bundle,
    run_name: str,
    folder: Path,
    asked: Callable[[], str | None],
    view: bool,
    listen: str,
    keys: Keys | None,
    router: str,
    remote_twin: bool,
) -> bool:
    """True where the run began; a person may have stopped it before."""
    from twin.service.parts import gather
    from twin.service.spec import Spec
    from twin.service.supervisor import Supervisor

    spec = Spec(
        run_name,
        bundle.name,
        str(folder),
        listen,
        bundle.profile_toml,
        bundle.rig_toml,
        bundle.model_toml,
        serve_view=next_free(VIEW_ADDRESS) if view else "",
        keys=folder_of(keys),
        router=router,
        remote_twin=remote_twin,
    )
    with RunProgress(console, len(bundle.steps), bundle.drive.planned_end) as progress:
        supervisor = Supervisor(
            spec, bundle.profile.on_death, RealClock(), progress, asked, progress.say
        )
        if view:
            progress.say(live_view(spec.serve_view))
        began = supervisor.run()
    if began:
        gather(folder)
    return began
