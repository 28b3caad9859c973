"""`export`: a log in the formats of other people's tools."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import Any

from rich.console import Console

from table_io.card import BadInput
from table_io.records import RunStart
from twin.service.recordings import log_path, open_log
from twin.service.terminal import say
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
            new.absolute().parent.mkdir(parents=True, exist_ok=True)
    if "rrd" in places:
        if channels or steps:
            raise BadInput("--rrd shows a whole run; leave --channel and --steps out")
        _view(path, places.pop("rrd"))
    if places:
        rows = gather(path).chosen(channels, steps)
        if not rows.size:
            raise BadInput(f"{path}: no measured samples in it; there is nothing to export")
        if not rows.whole:
            told = f"warning: {path} has no end; `shaketwin verify` says what is missing"
            Console(stderr=True).print(told, highlight=False, soft_wrap=True)
        for kind, place in places.items():
            _write(kind, rows, place)
    return 0


def _write(kind: str, rows: Rows, place: Path) -> None:
    """One file; a heavy library is looked for here."""
    if kind == "csv":
        from twin.stream.tables.csv import write as write_csv

        with _new(place, "x", encoding="utf-8", newline="") as text:
            write_csv(rows, text)
    else:
        write = _writer(kind)
        with _new(place, "xb") as file:
            write(rows, file)
    if kind == "foxglove":
        from twin.stream.foxglove import layout

        with _new(_layout(place), "x", encoding="utf-8") as text:
            text.write(layout(rows))
        say(f"{_layout(place)}")
    say(f"{rows.size} rows of {len(rows.units)} columns -> {place}")


def _writer(kind: str) -> Callable[[Rows, Any], None]:
    """What writes a binary format."""
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
    from twin.stream.rerun_view import BATCH, RerunView, write_rrd

    fed = batches(path, BATCH)
    first = next(fed, None) if fed is not None else None
    if fed is None or first is None or not isinstance(first[0], RunStart):
        write_rrd(open_log(path), place)
    else:
        view = RerunView(first[0], save=place)
        try:
            for items in chain([first], fed):
                view.feed(items)
        except BaseException:
            place.unlink(missing_ok=True)
            raise
        finally:
            view.close()
    say(f"{place}")


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
