"""The commands about files, ours and other people's; heavy imports stand inside them."""

from pathlib import Path
from typing import Annotated

import typer

FILES = "Keep and pass on what was recorded"
files = typer.Typer()

Steps = Annotated[
    str | None,
    typer.Option(
        "--steps",
        metavar="FIRST:LAST",
        help="FIRST:LAST by index, from 0, both ends included; or one.",
    ),
]


@files.command(rich_help_panel=FILES)
def verify(
    log: Annotated[
        list[Path],
        typer.Argument(metavar="LOG...", help="A log, a run's folder, or the parts of one log."),
    ],
    json: Annotated[bool, typer.Option("--json", help="As JSON on standard output.")] = False,
    repair: Annotated[
        Path | None, typer.Option("--repair", metavar="NEW", help="Write what is left, whole.")
    ] = None,
) -> None:
    """Whether a recording is whole, what is missing and where, whether it can be replayed.

    Exit code 0: whole; 4: it has gaps, or the file is damaged or was altered; 2: no log.
    """
    from twin.service.verifying import verify as command

    raise typer.Exit(command(log, json, repair))


@files.command("import", rich_help_panel=FILES)
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
        if out is not None:
            from table_io.card import BadInput

            raise BadInput(f"{out}: --list only says what {file} holds; leave -o out, or --list")
        importing.contents(file, columns)
        return
    if out is None:
        from table_io.card import BadInput

        raise BadInput(f"{file}: no -o LOG; say where the new log goes, as -o run.mcap")
    raise typer.Exit(importing.take_in(file, out, profile, rig, columns))


@files.command(rich_help_panel=FILES)
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
        list[str] | None,
        typer.Option(
            "--channel", help="Only this column, beside time_s and the labels; may be repeated."
        ),
    ] = None,
    steps: Steps = None,
) -> None:
    """A log, measurement and twin, as files for other tools; several formats at once."""
    from twin.service.exporting import give_out

    asked = {"csv": csv, "parquet": parquet, "mat": mat, "foxglove": foxglove, "rrd": rrd}
    kinds = [kind for kind, wanted in asked.items() if wanted]
    span = None
    if steps is not None:
        from twin.service.step_range import step_range

        span = step_range(steps)
    raise typer.Exit(give_out(log, kinds, out, tuple(channel or ()), span))
