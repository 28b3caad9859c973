"""Task `export`: conversion of a log to files of other tools."""

import mimetypes
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from table_io.channels import TIME_COLUMN
from table_io.errors import InputError, require_package
from table_io.formats.text import write_csv
from twin.exchange.fmu import write_fmu
from twin.exchange.foxglove import build_layout, write_foxglove
from twin.exchange.uff58 import write_uff58
from twin.recording.reader import find_start_ns
from twin.recording.run_paths import resolve_log_path
from twin.recording.tabular import (
    TWIN_PREFIX,
    UNIX_TIME_COLUMN,
    Columns,
    LogTable,
    read_log_table,
)
from twin.results.contract import write_json
from twin.results.recordings import open_recording
from twin.results.rerun import restore_log
from twin.system.files import hash_file

# File suffix by format. The Foxglove layout is a second file.
SUFFIXES = {
    "csv": ".csv",
    "parquet": ".parquet",
    "mat": ".mat",
    "foxglove": ".foxglove.mcap",
    "rrd": ".rrd",
    "hdf5": ".h5",
    "uff": ".uff",
    "fmu": ".fmu",
}
WHOLE_FORMATS = ("rrd", "fmu")  # which take no choice of channels and steps
EXTRA_PACKAGES = {"parquet": "pyarrow", "hdf5": "h5py"}
LAYOUT_SUFFIX = ".layout.json"

CRATE_FILE = "ro-crate-metadata.json"
CRATE_VERSION = "https://w3id.org/ro/crate/1.1"
MEDIA_TYPES = {
    ".mcap": "application/octet-stream", ".parquet": "application/vnd.apache.parquet",
    ".h5": "application/x-hdf5", ".uff": "application/octet-stream",
    ".mat": "application/x-matlab-data", ".rrd": "application/octet-stream",
    ".fmu": "application/zip",
}  # fmt: skip


def write_crate(rows: LogTable, log: Path, files: Sequence[Path], path: Path) -> None:
    """Describe exported files and the log that they are from as an RO-Crate, in their folder."""
    start = rows.start
    used = [*files, *([log] if log.resolve().parent == path.resolve().parent else [])]
    root = {
        "@id": "./",
        "@type": "Dataset",
        "name": start.run,
        "description": f"Shaking-table test {start.name}, recorded by shaketwin on {start.host}, "
        f"{rows.size} samples at {start.rate_hz:g} Hz from {start.started_at} on",
        "datePublished": start.started_at,
        "license": "not stated",
        "hasPart": [{"@id": file.name} for file in used],
        "variableMeasured": [{"@id": f"#{name}"} for name in rows.units],
    }
    action = {
        "@id": "#export",
        "@type": "CreateAction",
        "name": "Export of a recording",
        "instrument": {"@id": "#shaketwin"},
        "object": {"@id": used[-1].name} if len(used) > len(files) else start.run,
        "result": [{"@id": file.name} for file in files],
    }
    version = start.versions.get("shaketwin", "unknown")
    graph = [
        {
            "@id": CRATE_FILE,
            "@type": "CreativeWork",
            "conformsTo": {"@id": CRATE_VERSION},
            "about": {"@id": "./"},
        },
        root,
        *(_describe_file(file) for file in used),
        *(
            {"@id": f"#{name}", "@type": "PropertyValue", "name": name, "unitText": unit or "1"}
            for name, unit in rows.units.items()
        ),
        {
            "@id": "#shaketwin",
            "@type": "SoftwareApplication",
            "name": "shaketwin",
            "softwareVersion": version,
        },
        action,
    ]
    write_json({"@context": f"{CRATE_VERSION}/context", "@graph": graph}, path)


def _describe_file(path: Path) -> dict[str, str]:
    guessed = mimetypes.guess_type(path.name)[0] or "application/octet-stream"
    return {
        "@id": path.name,
        "@type": "File",
        "name": path.name,
        "contentSize": str(path.stat().st_size),
        "encodingFormat": MEDIA_TYPES.get(path.suffix, guessed),
        "identifier": f"sha256:{hash_file(path)}",
    }


@dataclass(frozen=True)
class ExportOptions:
    """What is exported of a log, and in which formats (SUFFIXES).

    `out`: the new files without their suffix; next to the log by default. `channels` and `steps`
    (first and last index): all by default.
    """

    log: Path
    formats: tuple[str, ...]
    out: Path | None = None
    channels: tuple[str, ...] = ()
    steps: tuple[int, int] | None = None
    has_crate: bool = False  # with ro-crate-metadata.json, which describes the files
    model: str | None = None  # of an FMU, instead of the recorded one


@dataclass(frozen=True)
class Exported:
    """New files of an export, the size of its table, and whether the log was whole."""

    files: tuple[Path, ...]
    rows: int = 0
    columns: int = 0
    is_intact: bool = True


def export_log(options: ExportOptions) -> Exported:
    """Export a log to new files, one per format; all of them or, on an error, none."""
    if not options.formats:
        raise InputError(
            "no export format",
            where=options.log,
            remedy=f"give one or more of --{', --'.join(SUFFIXES)}",
        )
    log = resolve_log_path(options.log)
    if not log.is_file():
        raise InputError("no such log", where=log, remedy="give a run.mcap or the folder of a run")
    base = options.out or log.with_suffix("")
    paths = {kind: _output_path(kind, base) for kind in options.formats}
    layout = _layout_path(paths["foxglove"]) if "foxglove" in paths else None
    crate = base.with_name(CRATE_FILE) if options.has_crate else None
    # Check everything before the first file is written, so that a second attempt can succeed.
    _require_possible(options.formats, [*paths.values(), *filter(None, (layout, crate))])
    for kind in {*paths} & {*WHOLE_FORMATS} if options.channels or options.steps else ():
        raise InputError(
            "exports a whole run", where=f"--{kind}", remedy="omit --channel and --steps"
        )
    needs_twin = not options.channels or any(n.startswith(TWIN_PREFIX) for n in options.channels)
    folder = base.absolute().parent
    files = [*paths.values(), *filter(None, (layout,))]
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    # Written on the disk of their folder, which they enter when all of them are whole.
    with TemporaryDirectory(dir=existing, prefix=".export-") as scratch:
        new = Path(scratch)
        whole = restore_log(log, new) if needs_twin else log
        rows = _read_rows(whole, options) if {*paths} - {*WHOLE_FORMATS} or crate else None
        for kind, path in paths.items():
            if kind == "fmu":
                write_fmu(log, options.model, new / path.name)
            elif rows is None or kind == "rrd":
                _write_rrd(whole, new / path.name)
            else:
                _write_rows(kind, rows, new / path.name)
        if layout is not None and rows is not None:
            (new / layout.name).write_text(build_layout(rows), encoding="utf-8")
        _require_possible((), files)  # also not since the first look
        folder.mkdir(parents=True, exist_ok=True)
        for path in files:
            (new / path.name).rename(path)
        if crate is not None and rows is not None:
            write_crate(rows, log, files, crate)
            files.append(crate)
        size = (0, 0, True) if rows is None else (rows.size, len(rows.units), rows.is_intact)
    return Exported((*files,), *size)


def _require_possible(formats: Sequence[str], files: Iterable[Path]) -> None:
    """Raise InputError if a file exists, or if the package of a format is not installed."""
    for new in files:
        if new.exists():
            raise InputError("exists already", where=new, remedy="nothing is ever overwritten")
    for kind in formats:
        if kind in EXTRA_PACKAGES:
            require_package(EXTRA_PACKAGES[kind], "formats", f"--{kind}")


def _read_rows(path: Path, options: ExportOptions) -> LogTable:
    """Read the rows to export."""
    rows = read_log_table(path).select(options.channels, options.steps)
    if not rows.size:
        raise InputError("no measured samples to export", where=path)
    return rows


def _write_rows(kind: str, rows: LogTable, path: Path) -> None:
    """Write the rows to a new file; imports the library of the format."""
    if kind == "csv":
        with path.open("x", encoding="utf-8", newline="") as text:
            write_csv(*_add_absolute_time(rows), text)
        return
    if kind == "hdf5":
        from twin.exchange.nexus import write_hdf5  # imports h5py

        write_hdf5(rows, path)
        return
    if kind == "uff":
        write_uff58(rows, path)
        return
    start = rows.start
    facts = {**rows.toml_texts, "run": start.run, "started_at": start.started_at}
    with path.open("xb") as file:
        if kind == "parquet":
            from table_io.formats.parquet import write_parquet

            texts = facts | {"rate_hz": repr(start.rate_hz)}
            write_parquet(rows.units, rows.iter_windows(), texts, file)
        elif kind == "mat":
            from table_io.formats.mat import write_mat

            # one by one, to limit memory
            columns = (rows.read_columns(slice(None), name) for name in rows.units)
            write_mat(rows.units, columns, {**facts, "rate_hz": start.rate_hz}, file)
        else:
            write_foxglove(rows, file)


def _add_absolute_time(rows: LogTable) -> tuple[list[str], Iterable[Columns]]:
    """Return names and windows of the columns, with the time since 1970 where a start is stated."""
    started_ns = find_start_ns(rows.start)
    if not started_ns:
        return [*rows.units], rows.iter_windows()
    windows = (
        window | {UNIX_TIME_COLUMN: 1e-9 * started_ns + window[TIME_COLUMN]}
        for window in rows.iter_windows()
    )
    return [*rows.units, UNIX_TIME_COLUMN], windows


def _write_rrd(path: Path, output_path: Path) -> None:
    """Write a Rerun file."""
    from twin.viewer.view import write_rrd

    write_rrd(open_recording(path), output_path)


def _output_path(file_format: str, base: Path) -> Path:
    """Return the output path: `base` with the suffix of the format."""
    name = base.name
    for suffix in SUFFIXES.values():
        name = name.removesuffix(suffix)
    return base.with_name((name or base.name) + SUFFIXES[file_format])


def _layout_path(path: Path) -> Path:
    return path.with_name(path.name.removesuffix(".mcap") + LAYOUT_SUFFIX)
