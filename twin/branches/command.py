"""`branches`: call the task, print the bifurcations."""

from rich.table import Table

from twin.branches.page import list_bifurcations
from twin.branches.resonance_map import format_map_headline
from twin.branches.task import BranchOptions, follow_branches
from twin.drawing.branch_curves import BranchSet
from twin.system.terminal import announce_if_slow, console, print_line


def show_branches(options: BranchOptions) -> None:
    """Follow the branches, print their bifurcations and the page of the report."""
    followed = follow_branches(options, announce_if_slow)
    if followed.resonance is not None:
        print_line(f"{format_map_headline(followed.resonance)} -> {followed.page}")
    if followed.branches is not None:
        print_bifurcations(followed.branches)
        count = len(followed.branches.branches)
        print_line(f"{count} branch{'es' if count != 1 else ''} -> {followed.page}")


def print_bifurcations(branches: BranchSet) -> None:
    """Print a table of the bifurcations."""
    axis, rows = branches.axis, list_bifurcations(branches)
    if not rows:
        print_line("no bifurcation in this range")
        return
    table = Table(box=None, header_style="")
    for header in ("kind", axis.label, "u in mm", "period", "what happens"):
        right = header not in ("kind", "what happens")
        table.add_column(header, justify="right" if right else "left")
    for row in rows:
        table.add_row(row.kind, row.x, row.u, str(row.period), row.meaning)
    console.print(table)
