"""Command `paper`."""

from pathlib import Path
from typing import Annotated

import typer

from twin.options import ModelOption, OutOption


def paper_command(
    model: ModelOption = None,
    out: OutOption = None,
    campaign: Annotated[
        list[Path] | None,
        typer.Option("--campaign", help="A recording or a folder of recordings; repeatable."),
    ] = None,
) -> None:
    """Reproduce the paper's figures and list where the model agrees or departs."""
    from twin.paper.command import compare_with_paper

    compare_with_paper(out, campaign or [], model)
