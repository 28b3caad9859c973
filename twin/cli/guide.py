"""`guide`: build the user guide and open it in the browser."""

import webbrowser
from pathlib import Path
from tempfile import mkdtemp

import typer

from table_io.errors import InputError
from twin.guide.site import build_guide
from twin.run.terminal import print_line


def open_guide(out: Path | None, app: typer.Typer) -> None:
    """Write the guide to `out`, or to a new temporary folder and open it in the browser."""
    if out is not None and out.exists() and not out.is_dir():
        raise InputError("not a folder", where=f"--out {out}", remedy="give a folder")
    index = build_guide(out or Path(mkdtemp(prefix="shaketwin-guide-")), app)
    print_line(f"{index}")
    if out is None and not webbrowser.open(index.resolve().as_uri()):
        print_line("no browser responds; open this file in a browser")
