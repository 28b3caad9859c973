"""Labels of an imported table: step, label, cycle and the planned step of every sample."""

import numpy as np
from numpy.typing import NDArray

from table_io.block import Float1D, Int1D, Label
from table_io.errors import InputError
from table_io.formats.table import ForeignTable
from table_io.records import Step
from twin.compare.step_detection import DetectedSteps
from twin.exchange.columns import ImportedSamples
from twin.recording.tabular import DIRECTION_SIGNS

MAX_COUNT = 10**6  # of steps, and of cycles in a step
MAX_CYCLES_PER_STEP = 1000  # allowed in a profile


def read_labels(table: ForeignTable, samples: ImportedSamples) -> DetectedSteps:
    """Return the table's labels on the time grid; raise InputError that names an invalid row.

    Samples in a hole are at rest. Steps, or windows of a displacement history, are renumbered from
    0 in order.
    """
    columns = samples.labels
    step = _read_integers(table, columns, "step", -1, MAX_COUNT)
    label = _read_integers(table, columns, "label", min(Label), max(Label))
    cycle = _read_integers(table, columns, "cycle", -1, MAX_COUNT)
    sign = _read_integers(table, columns, "direction", -1, 1)
    numbers, firsts, place = np.unique(step, return_index=True, return_inverse=True)
    notes = ["steps, labels and cycles are taken from the file"]
    steps: list[Step] = []
    # Windows of a displacement history have neither direction nor frequency nor level.
    is_history = not sign.any() and not np.isfinite(columns["frequency_hz"]).any()
    for row in firsts[numbers >= 0].tolist() if not is_history else ():
        plan = {name: float(columns[name][row]) for name in ("frequency_hz", "level_m_s2")}
        if sign[row] == 0 or not plan["frequency_hz"] > 0 or not plan["level_m_s2"] >= 0:
            raise InputError(
                f"step {step[row]} lacks direction, frequency_hz or level_m_s2",
                where=table.describe_row(row),
                remedy="fill in all three for every step",
            )
        direction = {number: name for name, number in DIRECTION_SIGNS.items()}[int(sign[row])]
        steps.append(Step(len(steps), direction, plan["frequency_hz"], plan["level_m_s2"]))
    for name in ("direction", "frequency_hz", "level_m_s2") if not is_history else ():
        differs = (columns[name] != columns[name][firsts][place]) & (step >= 0)
        if differs.any():
            row = int(np.argmax(differs))
            raise InputError(
                f"{name} is {columns[name][row]:.9g} in step {step[row]}, "
                f"but {columns[name][firsts[place[row]]]:.9g} in an earlier row of it",
                where=table.describe_row(row),
                allowed="one value per step",
            )
    outside = int((numbers < 0).any())
    if numbers[outside:].tolist() != list(range(numbers.size - outside)):
        notes.append(f"steps {numbers[outside]} to {numbers[-1]} of the file are numbered from 0")
    size = int(samples.index[-1]) + 1

    def to_grid(values: Int1D, fill: int) -> Int1D:
        grid = np.full(size, fill)
        grid[samples.index] = values
        return grid

    return DetectedSteps(
        to_grid(place - outside, -1),
        to_grid(label, Label.REST),
        to_grid(cycle, -1),
        tuple(steps),
        tuple(notes),
    )


def typical_cycles(detected: DetectedSteps) -> tuple[int, int]:
    """Return (held, measured) cycles per step: the mode over the steps, for a profile.

    The mode ignores steps that were cut off or held longer.
    """
    measured = _typical_cycle_count(detected, detected.label == Label.MEASURE) or 3
    return max(_typical_cycle_count(detected, detected.cycle >= 0), measured, 2), measured


def _typical_cycle_count(detected: DetectedSteps, is_counted: NDArray[np.bool_]) -> int:
    """Return the mode of the number of counted cycles per step, 0 if there are none."""
    is_selected = is_counted & (detected.step >= 0) & (detected.cycle >= 0)
    pairs = np.unique(detected.step[is_selected] * (MAX_COUNT + 1) + detected.cycle[is_selected])
    counts = np.bincount(np.unique(pairs // (MAX_COUNT + 1), return_counts=True)[1], minlength=1)
    return (
        min(int(counts.size - 1 - np.argmax(counts[::-1])), MAX_CYCLES_PER_STEP)
        if pairs.size
        else 0
    )


def _read_integers(
    table: ForeignTable, columns: dict[str, Float1D], name: str, low: int, high: int
) -> Int1D:
    """Return a column as integers; raise InputError unless all are whole and in [low, high]."""
    values = columns[name]
    is_wrong = ~((values == np.rint(values)) & (values >= low) & (values <= high))
    if is_wrong.any():
        row = int(np.argmax(is_wrong))
        raise InputError(
            f"{name} is {values[row]:.9g}",
            where=table.describe_row(row),
            allowed=f"whole numbers from {low} to {high}",
        )
    return values.astype(np.int64)
