"""`shaketwin import`: proposal of a map, and import of one file or of several runs alike."""

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.markup import escape
from rich.table import Table

from table_io.config.channel import read_channels
from table_io.config.profile import load_profile
from table_io.errors import InputError
from table_io.formats import read_table
from twin.exchange.columns import ImportColumns
from twin.exchange.import_table import ImportOptions, import_samples, read_rig_toml
from twin.exchange.proposal import MapProposal, propose_map
from twin.system.terminal import console, print_line, print_table


@dataclass(frozen=True)
class ImportRequest:
    """Files of one import and its options; `settings` are keys of a column map."""

    files: Sequence[Path]
    out: Path | None = None
    profile: Path | None = None
    rig: str | None = None
    columns: Path | None = None
    accept: bool = False
    save_map: Path | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)


def run_import(request: ImportRequest) -> int:
    """Import the files, or propose a map if no log is named; return the exit code."""
    if request.out is None and request.columns is None:
        propose_import(request)
        return 0
    if request.out is None:
        raise InputError(
            "the name of the new log is missing",
            where=request.files[0],
            remedy="add it, such as -o run.mcap",
        )
    if request.accept and request.columns is not None:
        raise InputError("--accept takes the proposed map, --columns another", remedy="omit one")
    if request.save_map is not None:
        raise InputError("--save-map writes a map, -o a log", remedy="omit one")
    if len(request.files) == 1:
        logs = {request.files[0]: request.out}
    else:
        logs = _name_logs(request.files, request.out)
    options = ImportOptions(request.accept, request.settings)
    codes = [
        import_samples(file, log, request.profile, request.rig, request.columns, options)
        for file, log in logs.items()
    ]
    return max(codes)


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


def propose_import(request: ImportRequest) -> None:
    """Print the proposed map of the first file, and the command that accepts it; or save it."""
    file = request.files[0]
    table = read_table(file)
    rig_toml = read_rig_toml(table, request.profile, request.rig)
    if request.profile is not None:
        load_profile(request.profile)
    proposal = propose_map(table, ImportColumns(read_channels(rig_toml)), request.settings)
    if request.save_map is not None:
        _save_map(proposal, request.save_map)
        print_line(f"{request.save_map}: edit it, then")
        print_line(f"  {_format_command(request, ['--columns', str(request.save_map)])}")
        return
    print_proposal(file, proposal)
    if proposal.questions:
        map_path = file.with_suffix(".map.toml").name
        print_line("answer the open questions in a map:")
        print_line(f"  shaketwin import {shlex.quote(str(file))} --save-map {map_path}")
    else:
        print_line("accept this map (or save it by --save-map MAP to change it):")
        print_line(f"  {_format_command(request, ['--accept'])}")


def print_proposal(file: Path, proposal: MapProposal) -> None:
    """Print a proposed map with its reasons, open questions and what is missing."""
    print_line(f"{file}: proposed map, nothing is imported yet")
    table = Table(box=None, padding=(0, 2, 0, 0))
    for title in ("channel", "column", "unit", "because"):
        table.add_column(title, no_wrap=True)
    for item in proposal.columns:
        cells = (item.channel, item.column, item.unit or "-", item.reason)
        table.add_row(*map(escape, cells))
    print_table(console, table)
    if proposal.rate_hz is not None:
        print_line(f"sampling rate: {proposal.rate_hz:.9g} Hz")
    elif proposal.file_rate_hz is not None:
        print_line(f"sampling rate: {proposal.file_rate_hz:.9g} Hz, stated in the file")
    mass = "not stated" if proposal.mass_kg is None else f"{proposal.mass_kg:g} kg"
    print_line(f"mass: {mass}")
    for text in (*proposal.left_out, *proposal.dropped):
        print_line(f"left out: {text}")
    for text in proposal.missing:
        print_line(f"missing: {text}")
    for text in proposal.questions:
        print_line(f"open: {text}")


def _save_map(proposal: MapProposal, path: Path) -> None:
    if path.exists():
        raise InputError("exists; files are never overwritten", where=path, remedy="another name")
    path.write_text(proposal.to_toml(), encoding="utf-8")


def _format_command(request: ImportRequest, more: Sequence[str]) -> str:
    """Return the command that imports the files as proposed."""
    files = [str(file) for file in request.files]
    out = request.files[0].with_suffix(".mcap").name if len(files) == 1 else "logs"
    words = ["shaketwin", "import", *files, "-o", out, *more]
    if request.profile is not None:
        words += ["--profile", str(request.profile)]
    if request.rig is not None:
        words += ["--rig", request.rig]
    return shlex.join([*words, *format_settings(request.settings)])


def format_settings(settings: Mapping[str, Any]) -> list[str]:
    """Return the command-line options of settings of a map."""
    words: list[str] = []
    for key, option in (
        ("rate_hz", "--rate"), ("mass_kg", "--mass"), ("from_s", "--from"), ("to_s", "--to"),
        ("detrend", "--detrend"),
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
