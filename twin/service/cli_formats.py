"""The commands that exchange data with other people's tools; heavy imports stand inside them."""

from pathlib import Path
from typing import Annotated

import typer

from twin.service.cli_files import FILES

formats = typer.Typer()


@formats.command("import", rich_help_panel=FILES)
def import_(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="CSV, Parquet, MAT, UFF 58, TDMS, HDF5 or npz.")
    ],
    out: Annotated[
        Path | None, typer.Option("-o", "--out", metavar="LOG", help="New log, a .mcap file.")
    ] = None,
    profile: Annotated[
        Path | None, typer.Option("--profile", help="Specimen, gaps and sweep, a .toml file.")
    ] = None,
    rig: Annotated[str | None, typer.Option("--rig", help="Machine card.")] = None,
    columns: Annotated[
        Path | None,
        typer.Option("--columns", metavar="MAP", help="Which columns are which, a .toml file."),
    ] = None,
    contents: Annotated[bool, typer.Option("--list", help="Only say what the file holds.")] = False,
) -> None:
    """A table of samples as a log; its steps are its own labels, or found in its motion."""
    from twin.service import importing

    if contents:
        importing.contents(file, columns)
        return
    if out is None:
        from table_io.card import BadInput

        raise BadInput(f"{file}: no -o LOG; say where the new log goes, as -o run.mcap")
    raise typer.Exit(importing.take_in(file, out, profile, rig, columns))


@formats.command(rich_help_panel=FILES)
def export(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="A run.mcap, or the folder of a run.")],
    csv: Annotated[bool, typer.Option("--csv", help="Text, every bit of every number.")] = False,
    parquet: Annotated[bool, typer.Option("--parquet", help="With units and profile.")] = False,
    mat: Annotated[bool, typer.Option("--mat", help="MATLAB, v5.")] = False,
    foxglove: Annotated[
        bool, typer.Option("--foxglove", help="MCAP by the sample, and a layout.")
    ] = False,
    rrd: Annotated[bool, typer.Option("--rrd", help="Rerun, with the project's layout.")] = False,
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", help="New file; its ending is added. Else beside LOG."),
    ] = None,
    channel: Annotated[
        list[str] | None, typer.Option("--channel", help="Only this column; may be repeated.")
    ] = None,
    steps: Annotated[
        str | None, typer.Option("--steps", metavar="FIRST:LAST", help="Only these steps.")
    ] = None,
) -> None:
    """A log, measurement and twin, as files for other tools; several formats at once."""
    from twin.service.exporting import give_out

    asked = {"csv": csv, "parquet": parquet, "mat": mat, "foxglove": foxglove, "rrd": rrd}
    kinds = [kind for kind, wanted in asked.items() if wanted]
    span = None
    if steps is not None:
        from twin.service.replay import step_range

        span = step_range(steps)
    raise typer.Exit(give_out(log, kinds, out, tuple(channel or ()), span))
