"""`replay`: rerun the twin on recordings; one with a report, or several in a table."""

import csv
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass
from functools import partial
from itertools import product
from pathlib import Path

from rich.table import Table

from table_io.block import Block
from table_io.clock import RealClock
from table_io.errors import InputError
from table_io.records import RESPONSE_RATIOS
from twin.recording.reader import read_recording
from twin.recording.run_paths import resolve_log_path
from twin.recording.tabular import parse_step_range
from twin.replay.pipeline_replay import (
    RecordedRun,
    ReplayComparison,
    SampleRange,
    describe_deviation,
    replay_recording,
)
from twin.replay.task import (
    RECORDED,
    describe_replay,
    load_replay_config,
    open_replay_log,
    replay,
    require_drive_channel,
    select_span,
)
from twin.report.finalize import print_outcome, show_progress
from twin.results import summary as summaries
from twin.results.contract import write_json
from twin.results.contracts import Jump, ReplayResult, Response, RunSummary
from twin.security.credentials import Credentials
from twin.setup.folders import make_run_folder
from twin.setup.unpaced import ItemHandler, ShownRun
from twin.system.exit_codes import EXIT_GAPS, EXIT_INTERRUPTED, EXIT_NOT_IDENTICAL
from twin.system.terminal import console, print_line, print_table
from twin.system.versions import format_version_changes
from twin.transport.codec import TOPIC_TYPES, Item
from twin.transport.endpoint import MEAS_TOPIC, PRED_TOPIC

TABLE_COLUMNS = {
    "u": "nrmse rel_disp_m", "a": "nrmse mass_acc_m_s2", "F_R": "nrmse force_r1_n",
    "F_L": "nrmse force_l1_n", "u free": "free_nrmse rel_disp_m", "PRC eta_d": "prc eta_d",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class ReplayRow:
    """Comparison of one replay; errors as ratios by name, None if not comparable."""

    log: str
    model: str | None
    same_model: bool
    identical: bool | None
    gaps: int
    errors: dict[str, float | None]
    steps: int
    steps_with_the_same_impacts: int
    jumps: str
    twin_jumps: str

    def list_cells(self) -> Mapping[str, object]:
        """Return the cells of comparison.csv by column, one for each error."""
        cells: dict[str, object] = {}
        for name, value in asdict(self).items():
            cells |= value if name == "errors" else {name: value}
        return cells


@dataclass(frozen=True, slots=True)
class ReplayRequest:
    """Options of the command; `publish` is an endpoint, `steps` a text for `parse_step_range`."""

    logs: list[Path]
    models: list[str]
    out: Path | None = None
    speed: str = "max"
    view: bool = False
    publish: str | None = None
    steps: str | None = None
    keys: Credentials | None = None


def replay_logs(request: ReplayRequest) -> int:
    """Replay one or several logs; return the exit code."""
    parse_speed(request.speed)
    if request.steps is not None:
        parse_step_range(request.steps)
    is_single = len(request.logs) * max(len(request.models), 1) == 1
    if not is_single and (request.view or request.publish):
        raise InputError(
            "shows one replay",
            where="--view" if request.view else "--publish",
            remedy="give one log and one model",
        )
    try:
        return _replay_one(request) if is_single else replay_all(request)
    except KeyboardInterrupt:
        print_line("interrupted; what was replayed until then is kept")
        return EXIT_INTERRUPTED


def _replay_one(request: ReplayRequest) -> int:
    speed = parse_speed(request.speed)
    replayed = replay(
        request.logs[0],
        request.out,
        request.models[0] if request.models else None,
        request.steps,
        request.view,
        partial(_observe, request, speed),
        in_blocks=speed is not None or request.publish is not None,
    )
    code = print_outcome(replayed.summary, replayed.path.parent, len(replayed.start.steps))
    print_line(format_identity(replayed.identity, replayed.result))
    is_same = replayed.result.model == RECORDED
    return EXIT_NOT_IDENTICAL if is_same and replayed.identity.differs else code


@contextmanager
def _observe(request: ReplayRequest, speed: float | None, run: ShownRun) -> Iterator[ItemHandler]:
    """Show the progress of a replay, at a multiple of real time if `speed`; publish if asked."""
    from twin.live.replay_publishing import open_publisher  # slow to import

    publishing = (
        open_publisher(run.config, request.publish, request.keys)
        if request.publish
        else nullcontext()
    )
    clock, rate_hz = RealClock(), run.config.drive.rate_hz
    with publishing as publisher, show_progress(run) as progress:
        if publisher is not None:
            publisher.start(run.run, at_once=speed is not None)
        began_s = clock.now()

        def on_item(item: Item) -> None:
            if speed is not None:
                offset = (item.end if isinstance(item, Block) else item.index) - run.first
                clock.wait_until(began_s + offset / rate_hz / speed)
            if publisher is not None:
                publisher.publish(item)
            progress(item)

        yield on_item


def format_identity(identity: ReplayComparison, entry: ReplayResult) -> str:
    """Format in one line whether a replay is identical, or the differences and their cause."""
    if identity.is_identical:
        lost = identity.lost_with_twin
        suffix = f"; {lost} more died with the twin before they were recorded" if lost else ""
        hashes = f" and {identity.hashes} hashes of predictions" if identity.hashes else ""
        return f"{identity.compared} comparisons{hashes}, identical to the bit{suffix}"
    if not identity.recorded:
        return f"no comparisons were recorded; {identity.made} are made"
    parts = [f"its beginning is in {identity.beginning}"] if identity.beginning else []
    parts += [
        f"{identity.differing} of {identity.recorded} comparisons differ, "
        f"{identity.missing} missing, {identity.unrecorded} never recorded"
    ]
    if identity.hashes_differing or identity.hashes_compared < identity.hashes:
        parts.append(
            f"of {identity.hashes} hashes of predictions {identity.hashes_differing} differ, "
            f"{identity.hashes - identity.hashes_compared} missing"
        )
    if entry.relative_difference:
        parts.append(describe_deviation(entry.relative_difference))
    if entry.model == RECORDED:
        version_changes = format_version_changes(
            {name: dict(pair) for name, pair in entry.versions_differing.items()}
        )
        parts.append(f"versions: {version_changes or 'all that were recorded are the same'}")
    return "; ".join([*parts, "see summary.json, replay"])


def parse_speed(speed: str) -> float | None:
    """Parse a speed as a multiple of real time; None for max."""
    if speed == "max":
        return None
    try:
        multiple = float(speed)
    except ValueError:
        multiple = 0.0
    if not 0 < multiple < 1e6:
        raise InputError(
            "not a speed",
            where=f"--speed {speed}",
            allowed="max, or a number above 0 (times real time)",
        )
    return multiple


def replay_all(request: ReplayRequest) -> int:
    """Replay every log with every model; return the exit code.

    Each replay has a folder; comparison.json and comparison.csv are written next to them.
    """
    if parse_speed(request.speed) is not None:
        raise InputError(
            "several replays run at full speed only",
            where=f"--speed {request.speed}",
            remedy="omit it",
        )
    models, names = request.models or [RECORDED], _name_logs(request.logs)
    _check_replays(request, models, names)
    folder, _ = make_run_folder(request.out, "replays")
    rows: list[ReplayRow] = []
    for log, name in zip(request.logs, names, strict=True):
        recorded = open_replay_log(log)
        span = select_span(recorded.recording, request.steps)
        for model in models:
            replay_folder = folder / _folder_name(name, model)
            row, result = tabulate_replay(recorded, name, model, replay_folder, span)
            print_line(f"{replay_folder.name}: {result}")
            rows.append(row)
    _write_comparison(folder, rows)
    print_table(console, _make_table(rows))
    print_line(f"{folder / 'comparison.csv'}, {folder / 'comparison.json'}; a page of one: "
        f"shaketwin report {folder / '<log>-<model>'}")  # fmt: skip
    if any(row.same_model and row.identical is False for row in rows):
        return EXIT_NOT_IDENTICAL
    return EXIT_GAPS if any(row.gaps for row in rows) else 0


def tabulate_replay(
    recorded: RecordedRun, name: str, model: str, folder: Path, span: SampleRange
) -> tuple[ReplayRow, str]:
    """Replay samples of a log into a new folder, without a report.

    Return the row of the comparison, with `name` as its log, and whether it is identical in words.
    """
    config = load_replay_config(recorded.recording, model)
    folder.mkdir()
    new_log = folder / "run.mcap"
    identity = replay_recording(recorded, config, new_log, folder.name, lambda _: None, span)
    entry = describe_replay(recorded, config, model, identity, new_log)
    summary = summaries.summarise(
        read_recording(new_log, TOPIC_TYPES.keys() - {PRED_TOPIC}), config.parameters
    )
    summary.replay = entry
    summary.write(folder / "summary.json")
    return _make_row(name, model, summary, entry), format_identity(identity, entry)


def _check_replays(request: ReplayRequest, models: list[str], names: list[str]) -> None:
    """Raise InputError if any replay is impossible, before the first: all may take hours."""
    model_of_folder: dict[str, str] = {}
    for model, name in product(models, names):
        folder_name = _folder_name(name, model)
        if folder_name in model_of_folder:
            raise InputError(
                f"its results would be {folder_name}, as those of {model_of_folder[folder_name]}",
                where=f"--model {model}",
                remedy="give each model once, and two of one name under other names",
            )
        model_of_folder[folder_name] = model
    for log in request.logs:
        # Read only what the checks need; each whole recording is read for its replay.
        recording = read_recording(
            resolve_log_path(log), () if request.steps is None else (MEAS_TOPIC,)
        )
        require_drive_channel(recording)
        select_span(recording, request.steps)
        for model in models:
            load_replay_config(recording, model)


def _folder_name(name: str, model: str) -> str:
    """Return the folder name of a replay."""
    return f"{name}-{Path(model).stem}"


def _name_logs(logs: list[Path]) -> list[str]:
    """Return a name for each log: of its folder or file, numbered if not unique."""
    names: list[str] = []
    for log in logs:
        path = resolve_log_path(log).absolute()
        name = path.parent.name if path.name == "run.mcap" else path.stem
        taken_count = sum(other == name or other.startswith(f"{name}-") for other in names)
        names.append(f"{name}-{taken_count + 1}" if name in names else name)
    return names


def _make_row(log: str, model: str | None, summary: RunSummary, entry: ReplayResult) -> ReplayRow:
    """Return the comparison of the replay of a log with a model."""
    nrmse = {
        f"{kind} {channel}": getattr(error, kind)
        for channel, error in summary.comparison.items()
        for kind in ("nrmse", "free_nrmse")
    }
    pairs = [(step.measured, step.twin) for step in summary.steps if step.measured and step.twin]
    return ReplayRow(
        log,
        model,
        same_model=entry.model == RECORDED,
        identical=entry.identical,
        gaps=summary.gaps,
        errors=nrmse | {f"prc {name}": _prc_error(pairs, name) for name in RESPONSE_RATIOS},
        steps=len(pairs),
        steps_with_the_same_impacts=sum(
            _count_impacts(rig) == _count_impacts(twin) for rig, twin in pairs
        ),
        jumps=_format_jumps(summary.jumps),
        twin_jumps=_format_jumps(summary.twin_jumps),
    )


def _prc_error(pairs: list[tuple[Response, Response]], name: str) -> float | None:
    """Return the relative error of a PRC quantity: rms of twin minus measured over rms measured."""
    values = [(getattr(rig, name), getattr(twin, name)) for rig, twin in pairs]
    known = [(rig, twin) for rig, twin in values if math.isfinite(rig) and math.isfinite(twin)]
    signal = sum(rig**2 for rig, _ in known)
    return math.sqrt(sum((twin - rig) ** 2 for rig, twin in known) / signal) if signal else None


def _count_impacts(response: Response) -> tuple[int, int]:
    """Return the impacts of a whole step, right and left.

    Twin and rig cut cycles at different samples, so that counts per cycle may differ.
    """
    return sum(response.impacts_right), sum(response.impacts_left)


def _format_jumps(jumps: list[Jump]) -> str:
    return ", ".join(f"{jump.kind} {jump.from_hz:g}-{jump.to_hz:g} Hz" for jump in jumps)


def _write_comparison(folder: Path, rows: list[ReplayRow]) -> None:
    tables = [row.list_cells() for row in rows]
    write_json({"replays": tables}, folder / "comparison.json")
    names = list(dict.fromkeys(name for cells in tables for name in cells))
    with (folder / "comparison.csv").open("x", newline="") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(tables)


def _make_table(rows: list[ReplayRow]) -> Table:
    """Make the table of NRMSE by channel (u also free-running), PRC error, impacts and jumps."""
    table = Table(title="Replays: error of the twin over the signal, in per cent")
    heads = ("log", "model", *TABLE_COLUMNS, "same impacts", "jumps", "twin's jumps", "bits")
    for head in heads:
        table.add_column(head, justify="right" if head in TABLE_COLUMNS else "left")
    for row in rows:
        shares = [row.errors.get(key) for key in TABLE_COLUMNS.values()]
        cells = ["-" if share is None else f"{100 * share:.3g}" for share in shares]
        same = f"{row.steps_with_the_same_impacts} of {row.steps} steps"
        bits = {True: "identical", False: "differ", None: "-"}[row.identical]
        table.add_row(row.log, f"{row.model}", *cells, same, row.jumps, row.twin_jumps, bits)
    return table
