"""Commands `drive`, `import` and `export`: files of other programs."""

from pathlib import Path
from typing import Annotated

import typer

from twin.options import (
    LogArgument,
    ModelOption,
    ProfileArgument,
    StepsOption,
    TableOption,
    require_view_extra,
)


def drive_command(
    profile: ProfileArgument,
    out: Annotated[Path, typer.Option("-o", "--out", metavar="FILE", help="New file.")],
    table: TableOption = None,
    format: Annotated[
        str,
        typer.Option(
            "--format", help="csv, txt, rpc, uff, mat or wav; default: the ending of FILE."
        ),
    ] = "",
) -> None:
    """Export the planned drive for an external controller, which `run --table` then follows."""
    from twin.exchange.command import run_drive

    run_drive(profile, out, table, format)


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
    table: Annotated[
        str | None, typer.Option("--table", help="Rig file or name, instead of the profile's.")
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
    gap: Annotated[
        float | None,
        typer.Option("--gap", metavar="MM", help="Gap, right plus left, without a profile."),
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
    from twin.exchange.command import list_contents, parse_band, run_import
    from twin.exchange.import_table import ImportOptions

    stated = {
        "mass_kg": mass, "gap_mm": gap, "rate_hz": rate, "from_s": from_s, "to_s": to_s,
        "detrend": detrend, "rest": rest, "integrate_hz": parse_band(integrate),
    }  # fmt: skip
    options = ImportOptions(
        profile=profile,
        rig=table,
        columns=columns,
        accept=accept,
        settings={key: value for key, value in stated.items() if value is not None},
    )
    if contents:
        list_contents(files, out, options)
        return
    raise typer.Exit(run_import(files, out, save_map, options))


def export_command(
    log: LogArgument,
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
    hdf5: Annotated[bool, typer.Option("--hdf5", help="HDF5 in the layout of NeXus.")] = False,
    uff: Annotated[
        bool, typer.Option("--uff", help="UFF 58: histories and frequency responses.")
    ] = False,
    fmu: Annotated[
        bool, typer.Option("--fmu", help="The model as an FMI 3.0 co-simulation unit.")
    ] = False,
    model: ModelOption = None,
    crate: Annotated[
        bool, typer.Option("--crate", help="Also describe the new files as an RO-Crate.")
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

    requested = {
        "csv": csv, "parquet": parquet, "mat": mat, "foxglove": foxglove, "rrd": rrd,
        "hdf5": hdf5, "uff": uff, "fmu": fmu,
    }  # fmt: skip
    formats = [kind for kind, wanted in requested.items() if wanted]
    run_export(log, formats, out, channel or [], steps, crate, model)
