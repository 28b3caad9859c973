"""Command `guide`."""

from pathlib import Path
from typing import Annotated

import typer
from platformdirs import user_cache_path
from typer.core import TyperGroup

from twin.system.files import open_in_browser
from twin.system.terminal import print_line


def open_guide(
    context: typer.Context,
    out: Annotated[
        Path | None, typer.Option("--out", help="Write the pages to this folder; open nothing.")
    ] = None,
) -> None:
    """Open the user guide in the browser; it needs no network."""
    from twin.guide.site import build_guide

    program = context.find_root().command
    assert isinstance(program, TyperGroup)
    index = build_guide(out or user_cache_path("shaketwin") / "guide", program)
    print_line(f"{index}")
    if out is None and not open_in_browser(index):
        print_line("no screen here: open this file in a browser")
