"""Commands import, export and drive: call their tasks, print what came of them."""

import shlex
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.table import Table

from table_io.config.folders import resolve_config
from table_io.errors import InputError
from table_io.formats import read_table
from table_io.records import RunStart
from twin.exchange.drive_file import RPC_PEAK, DriveOptions, export_drive
from twin.exchange.export import ExportOptions, export_log
from twin.exchange.import_table import ImportOptions, import_table, propose_import
from twin.exchange.proposal import MapProposal
from twin.recording.tabular import parse_step_range
from twin.system.exit_codes import EXIT_GAPS
from twin.system.progress import RunProgress
from twin.system.terminal import console, error_console, print_line, print_table
from twin.transport.codec import Item


def run_import(
    files: Sequence[Path], out: Path | None, save_map: Path | None, options: ImportOptions
) -> int:
    """Import the files, or propose a map if no log is named; return the exit code."""
    if options.profile is not None:
        options = replace(options, profile=resolve_config(options.profile, "tests"))
    if out is None and options.columns is None:
        _propose(files, save_map, options)
        return 0
    if out is None:
        raise InputError(
            "the name of the new log is missing",
            where=files[0],
            remedy="add it, such as -o run.mcap",
        )
    if options.accept and options.columns is not None:
        raise InputError("--accept takes the proposed map, --columns another", remedy="omit one")
    if save_map is not None:
        raise InputError("--save-map writes a map, -o a log", remedy="omit one")
    gaps = 0
    for file, log in ({files[0]: out} if len(files) == 1 else _name_logs(files, out)).items():
        with ExitStack() as stack:
            imported = import_table(file, log, options, _ItemPrinter(stack))
        gaps += imported.gaps
        print_line(
            f"{imported.samples} samples of {len(imported.channels)} channels, {imported.gaps} "
            f"gaps -> {log}"
        )
    return EXIT_GAPS if gaps else 0


class _ItemPrinter:
    """Display of the items of a log that is written, from its start."""

    def __init__(self, stack: ExitStack) -> None:
        self._stack = stack
        self._show: Callable[[Item], None] = lambda _: None

    def __call__(self, item: Item) -> None:
        if isinstance(item, RunStart):
            progress = RunProgress(console, len(item.steps), item.planned_samples)
            self._show = self._stack.enter_context(progress)
        self._show(item)


def list_contents(files: Sequence[Path], out: Path | None, options: ImportOptions) -> None:
    """Print the contents of files, one line per column."""
    if out is not None:
        raise InputError(
            f"--list writes no log, it only prints the contents of {files[0]}",
            where=f"-o {out}",
            remedy="omit -o or --list",
        )
    column_map = options.read_map()
    for file in files:
        table = read_table(file, column_map.group if column_map is not None else "")
        for line in table.contents:
            print_line(line)


def run_export(
    log: Path,
    formats: Sequence[str],
    out: Path | None,
    channels: Sequence[str],
    steps: str | None,
    has_crate: bool,
    model: str | None,
) -> None:
    """Export a log and print the new files."""
    span = None if steps is None else parse_step_range(steps)
    options = ExportOptions(log, tuple(formats), out, tuple(channels), span, has_crate, model)
    exported = export_log(options)
    if not exported.is_intact:
        warning = (
            f"warning: {options.log} is unfinished or has invalid items; "
            f"`shaketwin verify {options.log}` lists what is missing"
        )
        error_console.print(warning, highlight=False, soft_wrap=True)
    for path in exported.files:
        has_rows = path.suffix not in (".rrd", ".json", ".fmu")
        size = f"{exported.rows} rows of {exported.columns} columns -> " if has_rows else ""
        print_line(f"{size}{path}")


def run_drive(profile: Path, out: Path, table: str | None, file_format: str) -> None:
    """Export the drive of a test, and print what the file holds."""
    exported = export_drive(DriveOptions(profile, out, table, file_format))
    drive = exported.drive
    size = drive.values_m.size
    print_line(
        f"{exported.path} ({exported.file_format}): {size} values at {drive.rate_hz:g} Hz, "
        f"{size / drive.rate_hz:.1f} s, largest {exported.peak_m * 1e3:.4g} mm, sha256 "
        f"{drive.sha256}"
    )
    if exported.file_format == "rpc":
        step_um = exported.peak_m * 1e6 / RPC_PEAK
        print_line(f"resolution of rpc: {step_um:.3g} um; the other formats are finer")
    print_line("play it once, from rest, unscaled, without a ramp or filter of the controller")


def _name_logs(files: Sequence[Path], folder: Path) -> dict[Path, Path]:
    """Return the log of each of several files, in one folder."""
    if folder.suffix == ".mcap":
        raise InputError(
            f"{len(files)} files do not fit one log",
            where=f"-o {folder}",
            allowed="the name of a folder; each file becomes a log in it",
        )
    logs = {file: folder / f"{file.stem}.mcap" for file in files}
    if len({*logs.values()}) < len(files):
        raise InputError("two files have the same name", where=folder, remedy="rename one")
    for log in logs.values():
        if log.exists():
            raise InputError("exists already", where=log, remedy="nothing is ever overwritten")
    return logs


def _propose(files: Sequence[Path], save_map: Path | None, options: ImportOptions) -> None:
    """Print the proposed map of the first file, and the command that accepts it; or save it."""
    file = files[0]
    proposal = propose_import(file, options)
    if save_map is not None:
        _save_map(proposal, save_map)
        print_line(f"{save_map}: edit it, then")
        print_line(f"  {_format_command(files, options, ['--columns', str(save_map)])}")
        return
    _print_proposal(file, proposal)
    if proposal.questions:
        map_path = file.with_suffix(".map.toml").name
        print_line("answer the open questions in a map:")
        print_line(f"  shaketwin import {shlex.quote(str(file))} --save-map {map_path}")
    else:
        print_line("accept this map (or save it by --save-map MAP to change it):")
        print_line(f"  {_format_command(files, options, ['--accept'])}")


def _print_proposal(file: Path, proposal: MapProposal) -> None:
    """Print a proposed map with its reasons, open questions and what is missing."""
    print_line(f"{file}: proposed map, nothing is imported yet")
    table = Table(box=None, padding=(0, 2, 0, 0))
    for title in ("channel", "column", "unit", "because"):
        table.add_column(title, no_wrap=True)
    for item in proposal.columns:
        cells = (item.channel, item.column, item.unit or "-", item.reason)
        table.add_row(*cells)
    print_table(console, table)
    if proposal.rate_hz is not None:
        print_line(f"sampling rate: {proposal.rate_hz:.9g} Hz")
    elif proposal.file_rate_hz is not None:
        print_line(f"sampling rate: {proposal.file_rate_hz:.9g} Hz, stated in the file")
    mass = "not stated" if proposal.mass_kg is None else f"{proposal.mass_kg:g} kg"
    print_line(f"mass: {mass}")
    for text in (*proposal.left_out, *proposal.dropped):
        print_line(f"left out: {text}")
    for text in proposal.findings:
        print_line(text)
    for text in proposal.missing:
        print_line(f"missing: {text}")
    for text in proposal.questions:
        print_line(f"open: {text}")


def _save_map(proposal: MapProposal, path: Path) -> None:
    if path.exists():
        raise InputError("exists; files are never overwritten", where=path, remedy="another name")
    path.write_text(proposal.to_toml(), encoding="utf-8")


def _format_command(files: Sequence[Path], options: ImportOptions, more: Sequence[str]) -> str:
    """Return the command that imports the files as proposed."""
    out = files[0].with_suffix(".mcap").name if len(files) == 1 else "logs"
    words = ["shaketwin", "import", *map(str, files), "-o", out, *more]
    if options.profile is not None:
        words += ["--profile", str(options.profile)]
    if options.rig is not None:
        words += ["--table", options.rig]
    return shlex.join([*words, *_format_settings(options.settings)])


def _format_settings(settings: Mapping[str, Any]) -> list[str]:
    """Return the command-line options of settings of a map."""
    words: list[str] = []
    for key, option in (
        ("rate_hz", "--rate"), ("mass_kg", "--mass"), ("gap_mm", "--gap"), ("from_s", "--from"),
        ("to_s", "--to"), ("detrend", "--detrend"),
    ):  # fmt: skip
        if key in settings:
            value = settings[key]
            words += [option, value if isinstance(value, str) else f"{value:g}"]
    if "integrate_hz" in settings:
        low, high = settings["integrate_hz"]
        words += ["--integrate", f"{low:g}:{high:g}"]
    if "rest" in settings:
        words.append("--rest" if settings["rest"] else "--no-rest")
    return words


def parse_band(text: str | None) -> tuple[float, float] | None:
    """Parse LOW:HIGH in Hz; None without the option."""
    if text is None:
        return None
    try:
        low, high = (float(part) for part in text.split(":"))
    except ValueError:
        raise InputError(
            "not a band", where="--integrate", value=text, allowed="LOW:HIGH in Hz, such as 0.3:20"
        ) from None
    return low, high
