"""`export`: a log in the formats of other people's tools."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from itertools import chain
from pathlib import Path
from typing import Any

from rich.console import Console

from table_io.card import BadInput
from table_io.records import RunStart
from twin.service.recordings import recording_of
from twin.service.terminal import say
from twin.stream.folder import log_path
from twin.stream.rows import Rows, batches, gather

# Format, and how its file's name ends. Foxglove's layout stands beside its file.
SUFFIXES = {
    "csv": ".csv",
    "parquet": ".parquet",
    "mat": ".mat",
    "foxglove": ".foxglove.mcap",
    "rrd": ".rrd",
}
LAYOUT = ".layout.json"


def give_out(
    log: Path,
    kinds: list[str],
    out: Path | None,
    channels: tuple[str, ...],
    steps: tuple[int, int] | None,
) -> int:
    """The log in each of these formats, as new files; the exit code."""
    if not kinds:
        raise BadInput(f"{log}: no format; give one or more of --{', --'.join(SUFFIXES)}")
    path = log_path(log)
    if not path.is_file():
        raise BadInput(f"{path}: no such log; give a run.mcap or the folder of a run")
    places = {kind: _place(kind, out or path.with_suffix("")) for kind in kinds}
    for kind, place in places.items():
        for new in (place, _layout(place)) if kind == "foxglove" else (place,):
            if new.exists():
                raise BadInput(f"{new}: exists already; nothing is ever overwritten")
    if "rrd" in places and (channels or steps):
        raise BadInput("--rrd shows a whole run; leave --channel and --steps out")
    # What can be refused is refused before the first file: a second call would find that one there.
    writers = {kind: _writer(kind) for kind in places if kind != "rrd"}
    rows = _rows(path, channels, steps) if writers else None
    with ExitStack() as undo:
        _make_folder(places[kinds[0]].absolute().parent, undo)
        told: list[str] = []
        if "rrd" in places:
            _view(path, places["rrd"])
            undo.callback(places["rrd"].unlink, missing_ok=True)
            told.append(f"{places['rrd']}")
        if rows is not None:
            for kind, write in writers.items():
                told += _write(kind, write, rows, places[kind], undo)
        undo.pop_all()  # all is there
    for line in told:
        say(line)
    return 0


def _rows(path: Path, channels: tuple[str, ...], steps: tuple[int, int] | None) -> Rows:
    """The rows that go out; a log that is cut off is said to be so."""
    rows = gather(path).chosen(channels, steps)
    if not rows.size:
        raise BadInput(f"{path}: no measured samples in it; there is nothing to export")
    if not rows.whole:
        told = (
            f"warning: {path} has no end, or holds what is not of its run; "
            f"`shaketwin verify {path}` says what is missing"
        )
        Console(stderr=True).print(told, highlight=False, soft_wrap=True)
    return rows


def _make_folder(folder: Path, undo: ExitStack) -> None:
    """The folder and what is above it; what is new of them goes again if it is empty."""
    for one in reversed([one for one in (folder, *folder.parents) if not one.exists()]):
        one.mkdir(exist_ok=True)
        undo.callback(_unless_used, one)


def _unless_used(folder: Path) -> None:
    with suppress(OSError):
        folder.rmdir()


def _write(
    kind: str, write: Callable[[Rows, Any], None], rows: Rows, place: Path, undo: ExitStack
) -> list[str]:
    """The files of one format; what is to be said of them."""
    text = {"encoding": "utf-8", "newline": ""}
    with _new(place, "x", **text) if kind == "csv" else _new(place, "xb") as file:
        write(rows, file)
    undo.callback(place.unlink, missing_ok=True)
    told = [f"{rows.size} rows of {len(rows.units)} columns -> {place}"]
    if kind == "foxglove":
        from twin.stream.foxglove import layout

        with _new(_layout(place), "x", encoding="utf-8") as file:
            file.write(layout(rows))
        undo.callback(_layout(place).unlink, missing_ok=True)
        told.append(f"{_layout(place)}")
    return told


def _writer(kind: str) -> Callable[[Rows, Any], None]:
    """What writes a format; a heavy library is looked for here."""
    if kind == "csv":
        from twin.stream.tables.csv import write as write_csv

        return write_csv
    if kind == "mat":
        from twin.stream.tables.mat import write as write_mat

        return write_mat
    if kind == "foxglove":
        from twin.stream.foxglove import write as write_foxglove

        return write_foxglove
    try:
        from twin.stream.tables.parquet import write as write_parquet
    except ModuleNotFoundError as error:
        raise BadInput(
            f"--{kind}: {error.name} is not installed; pip install shaketwin[formats]"
        ) from None
    return write_parquet


def _view(path: Path, place: Path) -> None:
    """Rerun's file, fed batch by batch; a log out of order has to fit into memory."""
    from twin.stream.rerun.view import BATCH, RerunView, write_rrd

    try:
        fed = batches(path, BATCH)
        first = next(fed, None) if fed is not None else None
        if fed is None or first is None or not isinstance(first[0], RunStart):
            write_rrd(recording_of(path), place)
            return
        view = RerunView(first[0], save=place)
        try:
            for items in chain([first], fed):
                view.feed(items)
        finally:
            view.close()
    except BaseException:
        place.unlink(missing_ok=True)
        raise


@contextmanager
def _new(place: Path, mode: str, **options: Any) -> Iterator[Any]:
    """A new file; half a one is taken away again."""
    try:
        with place.open(mode, **options) as file:
            yield file
    except FileExistsError:
        raise BadInput(f"{place}: exists already; nothing is ever overwritten") from None
    except BaseException:
        place.unlink(missing_ok=True)
        raise


def _place(kind: str, base: Path) -> Path:
    """Where a format goes: the name that was given, with the format's ending."""
    name = base.name
    for suffix in SUFFIXES.values():
        name = name.removesuffix(suffix)
    return base.with_name((name or base.name) + SUFFIXES[kind])


def _layout(place: Path) -> Path:
    return place.with_name(place.name.removesuffix(".mcap") + LAYOUT)
