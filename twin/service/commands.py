"""What each command does, from input to exit code."""

import math
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console

from table_io.card import BadInput
from table_io.clock import ManualClock, RealClock
from table_io.limits import warnings
from table_io.records import Comparison
from twin.service import summary as summaries
from twin.service.bundle import Bundle, from_texts, read_bundle, read_model, run_id, warm
from twin.service.progress import RunProgress
from twin.stream.mcap_log import Recording, read

console = Console()
VIEW_ADDRESS = "127.0.0.1:9876"
SHORTEST_BLOCK_S, LONGEST_BLOCK_S = 0.002, 0.05  # protection looks once a block
EXIT_ABORTED, EXIT_GAPS, EXIT_NOT_IDENTICAL, EXIT_INTERRUPTED = 3, 4, 5, 130


def new_folder(out: Path | None, run: str) -> Path:
    """The folder for results, made; BadInput where it has content or cannot be made."""
    folder = out if out is not None else Path("runs") / run
    try:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise BadInput(
                f"--out {folder}: exists and has content; nothing recorded is ever overwritten. "
                "Give a new folder"
            )
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / ".probe"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise BadInput(f"--out {folder}: cannot write here: {error.strerror}") from None
    return folder


@contextmanager
def _interruptible() -> Iterator[Callable[[], str | None]]:
    """A question that answers why to stop once Ctrl-C or a termination was asked for."""
    asked: list[int] = []

    def ask(number: int, _: object) -> None:
        if not asked:
            console.print("stopping: the table decays to rest", highlight=False)
        asked.append(number)

    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, ask) for number in numbers]
    try:
        yield lambda: f"interrupted ({signal.Signals(asked[0]).name})" if asked else None
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


def _compile_once() -> None:
    """Compile the kernels where their cache is missing, and say so."""
    import table_io.backends
    import twin.model

    rooms = [Path(module.__file__ or "").parent for module in (table_io.backends, twin.model)]
    if all(any((room / "__pycache__").glob("*.nbi")) for room in rooms):
        return
    console.print("first run: compiling the simulated table and the twin (once)", highlight=False)
    warm("plant")
    warm("twin")


def check(profile: Path, table: str | None, out: Path | None) -> None:
    """Prints the plan and the margins; draws the drive where `out` is given."""
    from twin.service.preflight import draw_drive, print_plan

    bundle = read_bundle(profile, table)
    print_plan(console, bundle)
    if out is not None:
        folder = new_folder(out, bundle.name)
        console.print(f"drive drawn: {draw_drive(bundle, folder / 'drive.png')}", soft_wrap=True)


def run(
    profile: Path,
    out: Path | None,
    unpaced: bool,
    model: str | None,
    table: str | None,
    view: bool,
    listen: str,
) -> int:
    """A test on the table, live or as fast as it goes; the exit code."""
    bundle = read_bundle(profile, table, model)
    run_name = run_id(bundle.name)
    if unpaced and bundle.rig.simulated is None:
        raise BadInput(f"--speed max: {bundle.rig.name!r} is not simulated; leave --speed away")
    if not unpaced:
        _real_time(bundle, profile)
    folder = new_folder(out, run_name)
    for sentence in warnings(bundle.margins, bundle.rig):
        console.print(f"warning: {sentence}", highlight=False)
    console.print(
        f"{bundle.profile.title}: {len(bundle.steps)} steps, "
        f"{bundle.drive.planned_end / bundle.drive.rate_hz:.0f} s on {bundle.rig.title} "
        f"-> {folder}",
        highlight=False,
        soft_wrap=True,
    )
    _compile_once()
    with _interruptible() as asked:
        if unpaced:
            _run_unpaced(bundle, run_name, folder, asked)
        else:
            began = _run_live(bundle, run_name, folder, asked, view, listen)
            if not began:
                return EXIT_INTERRUPTED
    code = _close(folder, bundle, view)
    return EXIT_INTERRUPTED if asked() and code == EXIT_ABORTED else code


def _real_time(bundle: Bundle, profile: Path) -> None:
    """BadInput where a block is too short to be handled or too long to protect the table."""
    samples, rate = bundle.profile.acquisition.block_samples, bundle.drive.rate_hz
    least, most = math.ceil(rate * SHORTEST_BLOCK_S), math.floor(rate * LONGEST_BLOCK_S)
    if not least <= samples <= most:
        raise BadInput(
            f"{profile}: acquisition.block_samples = {samples}: in real time at {rate:g} Hz a "
            f"block may have {least} to {most} samples; change it, or use --speed max"
        )


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
) -> bool:
    """True where the run began; a person may have stopped it before."""
    from twin.service.processes import Spec
    from twin.service.supervisor import Supervisor, gather

    spec = Spec(
        run_name,
        bundle.name,
        str(folder),
        listen,
        bundle.profile_toml,
        bundle.rig_toml,
        bundle.model_toml,
        serve_view=VIEW_ADDRESS if view else "",
    )
    with RunProgress(console, len(bundle.steps), bundle.drive.planned_end) as progress:
        supervisor = Supervisor(
            spec, bundle.profile.on_death, RealClock(), progress, asked, progress.say
        )
        if view:
            progress.say(f"live view: rerun rerun+http://{VIEW_ADDRESS}/proxy")
        began = supervisor.run()
    if began:
        gather(folder)
    return began


def _close(folder: Path, bundle: Bundle, view: bool, extra: dict[str, object] | None = None) -> int:
    """Summary, report, view, and the one line that says what happened; the exit code."""
    recording = read(folder / "run.mcap")
    found = summaries.summarise(recording, bundle.parameters)
    found |= extra or {}
    summaries.write(found, folder / "summary.json")
    _report(folder, recording)
    if view:
        _write_view(folder, recording)
    what = f"{summaries.sentence(found)} -> {folder / 'report.html'}"
    console.print(what, highlight=False, soft_wrap=True)
    if found["verdict"] != "complete":
        return EXIT_ABORTED
    return EXIT_GAPS if found["gaps"] else 0


def _report(folder: Path, recording: Recording) -> None:
    from twin.service.report import write_report

    write_report(folder, recording)


def _write_view(folder: Path, recording: Recording) -> None:
    from twin.stream.rerun_view import write_rrd

    write_rrd(recording, folder / "view.rrd")


def simulate(profile: Path, model: str | None, out: Path | None, view: bool) -> int:
    """The model alone; the exit code."""
    from twin.service.runs import simulate as play

    bundle = read_bundle(profile, None, model)
    run_name = run_id(f"{bundle.name}-model")
    folder = new_folder(out, run_name)
    _compile_once()
    with RunProgress(console, len(bundle.steps), bundle.drive.planned_end) as progress:
        play(bundle, run_name, folder / "run.mcap", progress)
    return _close(folder, bundle, view)


def log_path(log: Path) -> Path:
    """The log itself, of a log or of a run's folder."""
    return log / "run.mcap" if log.is_dir() else log


def open_log(log: Path) -> Recording:
    """The recording in a log or a run's folder; says so where the file is not whole."""
    recording = read(log_path(log))
    if not recording.whole:
        end = recording.pieces("meas")[-1].end if recording.pieces("meas") else 0
        Console(stderr=True).print(
            f"warning: {recording.path} is cut off or damaged; it is readable to sample {end}",
            highlight=False,
            soft_wrap=True,
        )
    return recording


def recorded_bundle(recording: Recording, model: str | None = None) -> Bundle:
    """The bundle that a recording was made with, or with another model in it."""
    start = recording.start
    model_toml = read_model(model)[1] if model else start.model_toml
    return from_texts(
        start.name, start.profile_toml, start.rig_toml, model_toml, str(recording.path)
    )


def replay(log: Path, model: str | None, out: Path | None, speed: str, view: bool) -> int:
    """The pipeline on a recording; the exit code."""
    from twin.service.runs import replay as play

    recording = open_log(log)
    bundle = recorded_bundle(recording, model)
    clock = RealClock() if speed != "max" else ManualClock()
    factor = _factor(speed)
    run_name = run_id(f"{bundle.name}-replay")
    folder = new_folder(out, run_name)
    _compile_once()
    began = clock.now()
    with RunProgress(console, len(bundle.steps), bundle.drive.planned_end) as progress:

        def watch(item: object) -> None:
            if factor is not None:
                clock.wait_until(began + item.index / recording.start.rate_hz / factor)  # type: ignore[attr-defined]
            progress(item)  # type: ignore[arg-type]

        identity = play(recording, bundle, folder / "run.mcap", run_name, watch)
    same_model = bundle.model_toml == recording.start.model_toml
    before = summaries.nrmse(recording.of(Comparison), bundle.parameters)
    code = _close(
        folder,
        bundle,
        view,
        {
            "replay": {
                "of": str(recording.path),
                "run": recording.run,
                "model": "recorded" if same_model else model,
                "identical": identity.identical,
                "comparisons": identity.recorded,
                "compared": identity.compared,
                "differing": identity.differing,
                "missing": identity.missing,
                "unrecorded": identity.unrecorded,
                "first_difference_index": identity.first_difference,
                "largest_difference_of_error_sums": identity.largest,
                "recorded_comparison": before,
            }
        },
    )
    if identity.identical:
        console.print(f"{identity.compared} comparisons, identical to the bit", highlight=False)
    else:
        console.print(
            f"{identity.differing} of {identity.recorded} comparisons differ, "
            f"{identity.missing} missing, {identity.unrecorded} never recorded; see summary.json, "
            "replay",
            highlight=False,
        )
    return EXIT_NOT_IDENTICAL if same_model and not identity.identical else code


def _factor(speed: str) -> float | None:
    if speed == "max":
        return None
    try:
        factor = float(speed)
    except ValueError:
        factor = 0.0
    if not 0 < factor < 1e6:
        raise BadInput(f"--speed {speed}: allowed: max, or a number above 0 (times real time)")
    return factor


def prc(log: Path, as_json: bool) -> None:
    """The PRC of a recording, as a table or as JSON."""
    from twin.service.preflight import print_prc

    recording = open_log(log)
    found = summaries.summarise(recording, recorded_bundle(recording).parameters)
    if as_json:
        keys = ("run", "u_star_m", "a_star_m_s2", "steps", "jumps", "hysteresis")
        print(summaries.dumps({key: found[key] for key in keys}))
    else:
        print_prc(console, found)


def report(folder: Path) -> None:
    """Writes DIR/report.html anew from what was recorded."""
    if not folder.is_dir():
        raise BadInput(f"{folder}: no such folder; give the folder of a run")
    from twin.service.supervisor import PARTS, gather

    if (folder / PARTS).is_dir():
        gather(folder)
    recording = open_log(folder)
    if not (folder / "summary.json").exists():
        found = summaries.summarise(recording, recorded_bundle(recording).parameters)
        summaries.write(found, folder / "summary.json")
    _report(folder, recording)
    console.print(f"{folder / 'report.html'}", soft_wrap=True)


def view(log: Path | None, save: Path | None, picture: Path | None, connect: str, rig: str) -> None:
    """Rerun on a recording or on a running test."""
    from twin.service.viewing import view_live, view_log

    if log is None:
        view_live(connect, rig, VIEW_ADDRESS, console)
    else:
        view_log(log_path(log), save, picture, console)
