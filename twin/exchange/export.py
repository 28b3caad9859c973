"""`shaketwin export`: conversion of a log to formats of other tools."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from table_io.errors import InputError, format_pip_line
from table_io.records import RunStart
from twin.recording.run_paths import resolve_log_path
from twin.recording.tabular import TWIN_PREFIX, LogTable, iter_batches, read_log_table
from twin.results.recordings import open_recording
from twin.results.rerun import restore_log
from twin.system.terminal import error_console, print_line

# File suffix by format. The Foxglove layout is a second file.
SUFFIXES = {
    "csv": ".csv",
    "parquet": ".parquet",
    "mat": ".mat",
    "foxglove": ".foxglove.mcap",
    "rrd": ".rrd",
}
LAYOUT_SUFFIX = ".layout.json"


def export_log(
    log: Path,
    formats: list[str],
    out: Path | None,
    channels: tuple[str, ...],
    steps: tuple[int, int] | None,
) -> int:
    """Export a log to new files, one per format; return the exit code."""
    if not formats:
        raise InputError(
            "no export format", where=log, remedy=f"give one or more of --{', --'.join(SUFFIXES)}"
        )
    path = resolve_log_path(log)
    if not path.is_file():
        raise InputError("no such log", where=path, remedy="give a run.mcap or the folder of a run")
    paths = {kind: _output_path(kind, out or path.with_suffix("")) for kind in formats}
    for file_format, output_path in paths.items():
        for new in (
            (output_path, _layout_path(output_path))
            if file_format == "foxglove"
            else (output_path,)
        ):
            if new.exists():
                raise InputError("exists already", where=new, remedy="nothing is ever overwritten")
    if "rrd" in paths and (channels or steps):
        raise InputError("exports a whole run", where="--rrd", remedy="omit --channel and --steps")
    # Check everything before the first file is written, so that a second attempt can succeed.
    writers = {kind: _load_writer(kind) for kind in paths if kind != "rrd"}
    needs_twin = not channels or any(name.startswith(TWIN_PREFIX) for name in channels)
    with TemporaryDirectory() as scratch, ExitStack() as cleanup:
        whole = restore_log(path, Path(scratch)) if needs_twin else path
        rows = _read_rows(whole, channels, steps) if writers else None
        _make_folder(paths[formats[0]].absolute().parent, cleanup)
        messages: list[str] = []
        if "rrd" in paths:
            _write_rrd(whole, paths["rrd"])
            cleanup.callback(paths["rrd"].unlink, missing_ok=True)
            messages.append(f"{paths['rrd']}")
        if rows is not None:
            for file_format, write in writers.items():
                messages += _write_format(file_format, write, rows, paths[file_format], cleanup)
        cleanup.pop_all()  # keep the files
    for line in messages:
        print_line(line)
    return 0


def _read_rows(path: Path, channels: tuple[str, ...], steps: tuple[int, int] | None) -> LogTable:
    """Read the rows to export; warn if the log is unfinished or has invalid items."""
    rows = read_log_table(path).select(channels, steps)
    if not rows.size:
        raise InputError("no measured samples to export", where=path)
    if not rows.is_intact:
        warning = (
            f"warning: {path} is unfinished or has invalid items; "
            f"`shaketwin verify {path}` lists what is missing"
        )
        error_console.print(warning, highlight=False, soft_wrap=True)
    return rows


def _make_folder(folder: Path, cleanup: ExitStack) -> None:
    """Create a folder with its parents; on failure, new ones that are empty are removed."""
    for new_folder in reversed(
        [new_folder for new_folder in (folder, *folder.parents) if not new_folder.exists()]
    ):
        new_folder.mkdir(exist_ok=True)
        cleanup.callback(_remove_if_empty, new_folder)


def _remove_if_empty(folder: Path) -> None:
    with suppress(OSError):
        folder.rmdir()


def _write_format(
    file_format: str,
    write: Callable[[LogTable, Any], None],
    rows: LogTable,
    path: Path,
    cleanup: ExitStack,
) -> list[str]:
    """Write the files of one format; return lines for the user."""
    text = {"encoding": "utf-8", "newline": ""}
    with _open_new(path, "x", **text) if file_format == "csv" else _open_new(path, "xb") as file:
        write(rows, file)
    cleanup.callback(path.unlink, missing_ok=True)
    messages = [f"{rows.size} rows of {len(rows.units)} columns -> {path}"]
    if file_format == "foxglove":
        from twin.exchange.foxglove import build_layout

        with _open_new(_layout_path(path), "x", encoding="utf-8") as file:
            file.write(build_layout(rows))
        cleanup.callback(_layout_path(path).unlink, missing_ok=True)
        messages.append(f"{_layout_path(path)}")
    return messages


def _load_writer(file_format: str) -> Callable[[LogTable, Any], None]:
    """Return the writer of a format; imports its library only when needed."""
    if file_format == "csv":
        from twin.exchange.formats.csv import write_csv

        return write_csv
    if file_format == "mat":
        from twin.exchange.formats.mat import write_mat

        return write_mat
    if file_format == "foxglove":
        from twin.exchange.foxglove import write_foxglove

        return write_foxglove
    try:
        from twin.exchange.formats.parquet import write_parquet
    except ModuleNotFoundError as error:
        raise InputError(
            f"{error.name} is not installed",
            where=f"--{file_format}",
            remedy=format_pip_line("formats"),
        ) from None
    return write_parquet


def _write_rrd(path: Path, output_path: Path) -> None:
    """Write a Rerun file in batches; a log that is out of order must fit into memory."""
    from twin.viewer.view import BATCH_ITEMS, RerunView, write_rrd

    try:
        batches = iter_batches(path, BATCH_ITEMS)
        first = next(batches, None) if batches is not None else None
        if batches is None or first is None or not isinstance(first[0], RunStart):
            write_rrd(open_recording(path), output_path)
            return
        view = RerunView(first[0], save=output_path)
        try:
            for items in chain([first], batches):
                view.feed(items)
        finally:
            view.close()
    except BaseException:
        output_path.unlink(missing_ok=True)
        raise


@contextmanager
def _open_new(path: Path, mode: str, **options: Any) -> Iterator[Any]:
    """Open a new file; remove it if writing fails."""
    try:
        with path.open(mode, **options) as file:
            yield file
    except FileExistsError:
        raise InputError(
            "exists already", where=path, remedy="nothing is ever overwritten"
        ) from None
    except BaseException:
        path.unlink(missing_ok=True)
        raise


def _output_path(file_format: str, base: Path) -> Path:
    """Return the output path: `base` with the suffix of the format."""
    name = base.name
    for suffix in SUFFIXES.values():
        name = name.removesuffix(suffix)
    return base.with_name((name or base.name) + SUFFIXES[file_format])


def _layout_path(path: Path) -> Path:
    return path.with_name(path.name.removesuffix(".mcap") + LAYOUT_SUFFIX)
