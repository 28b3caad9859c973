"""Commands for files: verify, import, export; each imports its implementation when called."""

from pathlib import Path
from typing import Annotated

import typer

from twin.cli.run_path import LOG_HELP, parse_run_path

FILES_PANEL = "Recording files"
files_app = typer.Typer()


def require_view_extra(wanted: bool) -> bool:
    """Return the value of an option that needs Rerun; InputError if that is not installed."""
    if wanted:
        from twin.viewer.address import require_rerun

        require_rerun("a Rerun view")
    return wanted


StepsOption = Annotated[
    str | None,
    typer.Option(
        "--steps",
        metavar="FIRST:LAST",
        help="Step indices FIRST:LAST, from 0, both included; or one index.",
    ),
]


@files_app.command("verify", rich_help_panel=FILES_PANEL)
def verify_command(
    log: Annotated[
        list[Path],
        typer.Argument(
            metavar="LOG...",
            parser=parse_run_path,
            help="A log, the folder of a run, the parts of one log, or `last`.",
        ),
    ],
    json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
    repair: Annotated[
        Path | None,
        typer.Option("--repair", metavar="NEW", help="Write the recoverable data to this new log."),
    ] = None,
) -> None:
    """Verify that a recording is complete and can be replayed; list what is missing.

    Exit code 0: whole; 4: it has gaps, or the file is damaged or was altered; 2: no log.
    """
    from twin.replay.verify import verify_logs as command

    raise typer.Exit(command(log, json, repair))


@files_app.command("import", rich_help_panel=FILES_PANEL)
def import_command(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE...",
            help="Text, xlsx, Parquet, MAT, UFF 58, TDMS, HDF5 or npz; several runs alike.",
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "-o", "--out", metavar="LOG", help="New log, a .mcap file; of several files a folder."
        ),
    ] = None,
    profile: Annotated[
        Path | None, typer.Option("--profile", help="Test profile with specimen, gaps and sweep.")
    ] = None,
    rig: Annotated[
        str | None, typer.Option("--rig", help="Rig file or name, instead of the profile's.")
    ] = None,
    columns: Annotated[
        Path | None,
        typer.Option(
            "--columns",
            metavar="MAP",
            help="Column map (channel, unit, gain of each column), a .toml file.",
        ),
    ] = None,
    accept: Annotated[
        bool, typer.Option("--accept", help="Take the map that is proposed without -o.")
    ] = False,
    save_map: Annotated[
        Path | None,
        typer.Option("--save-map", metavar="MAP", help="Write the proposed map to this new file."),
    ] = None,
    mass: Annotated[
        float | None, typer.Option("--mass", metavar="KG", help="Moving mass, without a profile.")
    ] = None,
    rate: Annotated[
        float | None,
        typer.Option("--rate", metavar="HZ", help="Sampling rate of a file without times."),
    ] = None,
    from_s: Annotated[
        float | None, typer.Option("--from", metavar="S", help="Import from this time of the file.")
    ] = None,
    to_s: Annotated[
        float | None, typer.Option("--to", metavar="S", help="Import up to this time of the file.")
    ] = None,
    detrend: Annotated[
        str | None,
        typer.Option("--detrend", metavar="mean|line", help="Remove it from every channel."),
    ] = None,
    rest: Annotated[
        bool | None,
        typer.Option("--rest/--no-rest", help="Take still parts as rest at zero, or nothing."),
    ] = None,
    integrate: Annotated[
        str | None,
        typer.Option(
            "--integrate",
            metavar="LOW:HIGH",
            help="Integrate the relative displacement from accelerations, in this band in Hz.",
        ),
    ] = None,
    contents: Annotated[
        bool, typer.Option("--list", help="Only list the contents of the file.")
    ] = False,
) -> None:
    """Import tables of samples as logs; without -o, propose which column is which channel."""
    from table_io.config.folders import resolve_config
    from twin.exchange.command import list_contents, parse_band, run_import
    from twin.exchange.import_table import ImportOptions

    stated = {
        "mass_kg": mass, "rate_hz": rate, "from_s": from_s, "to_s": to_s, "detrend": detrend,
        "rest": rest, "integrate_hz": parse_band(integrate),
    }  # fmt: skip
    options = ImportOptions(
        profile=None if profile is None else resolve_config(profile, "tests"),
        rig=rig,
        columns=columns,
        accept=accept,
        settings={key: value for key, value in stated.items() if value is not None},
    )
    if contents:
        list_contents(files, out, options)
        return
    raise typer.Exit(run_import(files, out, save_map, options))


@files_app.command("export", rich_help_panel=FILES_PANEL)
def export_command(
    log: Annotated[Path, typer.Argument(metavar="LOG", parser=parse_run_path, help=LOG_HELP)],
    csv: Annotated[bool, typer.Option("--csv", help="CSV text without loss of precision.")] = False,
    parquet: Annotated[
        bool, typer.Option("--parquet", help="Parquet with units and profile.")
    ] = False,
    mat: Annotated[bool, typer.Option("--mat", help="MATLAB v5.")] = False,
    foxglove: Annotated[
        bool,
        typer.Option("--foxglove", help="Foxglove: MCAP with a message per sample, and a layout."),
    ] = False,
    rrd: Annotated[
        bool,
        typer.Option(
            "--rrd", callback=require_view_extra, help="Rerun, with the project's layout."
        ),
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", help="New file without ending; default: next to LOG."),
    ] = None,
    channel: Annotated[
        list[str] | None,
        typer.Option("--channel", help="Only this column with time_s and the labels; repeatable."),
    ] = None,
    steps: StepsOption = None,
) -> None:
    """Export measurement and twin of a log for other tools, in several formats at once."""
    from twin.exchange.command import run_export
    from twin.exchange.export import ExportOptions

    requested = {"csv": csv, "parquet": parquet, "mat": mat, "foxglove": foxglove, "rrd": rrd}
    formats = [kind for kind, wanted in requested.items() if wanted]
    step_span = None
    if steps is not None:
        from twin.recording.tabular import parse_step_range

        step_span = parse_step_range(steps)
    run_export(ExportOptions(log, tuple(formats), out, tuple(channel or ()), step_span))
