"""`guide`: build the user guide and open it in the browser."""

from pathlib import Path

import typer
from platformdirs import user_cache_path

from twin.guide.site import build_guide
from twin.system.files import open_in_browser
from twin.system.terminal import print_line


def open_guide(out: Path | None, app: typer.Typer) -> None:
    """Write the guide to `out`, or to the cache folder and open it in the browser."""
    index = build_guide(out or user_cache_path("shaketwin") / "guide", app)
    print_line(f"{index}")
    if out is None and not open_in_browser(index):
        print_line("no screen here: open this file in a browser")
