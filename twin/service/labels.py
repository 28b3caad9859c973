"""The labels that a table brings itself: step, label, cycle and the step's plan of every sample."""

import numpy as np
from numpy.typing import NDArray

from table_io.block import Float1D, Int1D, Label
from table_io.card import BadInput
from table_io.records import Step
from twin.learn.steps import Found
from twin.service.columns import Samples
from twin.stream.rows import WAYS
from twin.stream.tables import Table

MOST = 10**6  # of steps, and of cycles in one
MOST_HELD = 1000  # cycles a step, that a profile may say


def found_labels(table: Table, taken: Samples) -> Found:
    """The labels that a table brings, of every sample of its grid; BadInput names the wrong row.

    Samples in a hole are at rest. Steps are numbered from 0 in their order.
    """
    columns = taken.labels
    step = _whole(table, columns, "step", -1, MOST)
    label = _whole(table, columns, "label", min(Label), max(Label))
    cycle = _whole(table, columns, "cycle", -1, MOST)
    way = _whole(table, columns, "direction", -1, 1)
    numbers, firsts, place = np.unique(step, return_index=True, return_inverse=True)
    said = ["steps, labels and cycles are the file's own"]
    steps: list[Step] = []
    for row in firsts[numbers >= 0].tolist():
        plan = {name: float(columns[name][row]) for name in ("frequency_hz", "level_m_s2")}
        if way[row] == 0 or not plan["frequency_hz"] > 0 or not plan["level_m_s2"] >= 0:
            raise BadInput(
                f"{_row(table, row)}: step {step[row]} lacks direction, frequency_hz or level_m_s2"
            )
        direction = {number: name for name, number in WAYS.items()}[int(way[row])]
        steps.append(Step(len(steps), direction, plan["frequency_hz"], plan["level_m_s2"]))
    for name in ("direction", "frequency_hz", "level_m_s2"):
        differs = (columns[name] != columns[name][firsts][place]) & (step >= 0)
        if differs.any():
            row = int(np.argmax(differs))
            raise BadInput(
                f"{_row(table, row)}: {name} is {columns[name][row]:.9g} inside step {step[row]}, "
                f"where it was {columns[name][firsts[place[row]]]:.9g}; allowed: one a step"
            )
    outside = int((numbers < 0).any())
    if numbers[outside:].tolist() != list(range(len(steps))):
        said.append(f"its steps {numbers[outside]} to {numbers[-1]} are numbered from 0")
    size = int(taken.index[-1]) + 1

    def on_grid(values: Int1D, elsewhere: int) -> Int1D:
        grid = np.full(size, elsewhere)
        grid[taken.index] = values
        return grid

    return Found(
        on_grid(place - outside, -1),
        on_grid(label, Label.REST),
        on_grid(cycle, -1),
        tuple(steps),
        tuple(said),
    )


def held_cycles(found: Found) -> tuple[int, int]:
    """(held, measured) cycles a step: those of most steps, as a profile of them would say.

    A step that was cut off, or held longer, is another; a curve needs the number of most.
    """
    measured = _most(found, found.label == Label.MEASURE) or 3
    return max(_most(found, found.cycle >= 0), measured, 2), measured


def _most(found: Found, among: NDArray[np.bool_]) -> int:
    """How many cycles most steps have among these samples; 0 where none has any."""
    inside = among & (found.step >= 0) & (found.cycle >= 0)
    pairs = np.unique(found.step[inside] * (MOST + 1) + found.cycle[inside])
    counts = np.bincount(np.unique(pairs // (MOST + 1), return_counts=True)[1], minlength=1)
    return min(int(counts.size - 1 - np.argmax(counts[::-1])), MOST_HELD) if pairs.size else 0


def _whole(table: Table, columns: dict[str, Float1D], name: str, low: int, high: int) -> Int1D:
    """A column of whole numbers from low to high."""
    values = columns[name]
    wrong = ~((values == np.rint(values)) & (values >= low) & (values <= high))
    if wrong.any():
        row = int(np.argmax(wrong))
        raise BadInput(
            f"{_row(table, row)}: {name} is {values[row]:.9g}; "
            f"allowed: whole numbers from {low} to {high}"
        )
    return values.astype(np.int64)


def _row(table: Table, row: int) -> str:
    return f"{table.path}: row {row + table.first_row}"
