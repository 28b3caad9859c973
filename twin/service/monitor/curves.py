"""The pseudo-resonance curves as they grow: measured and twin, both directions."""

import math
from collections.abc import Callable

from rich.text import Text

from table_io.records import Point, Quantities
from twin.service.monitor.board import Board
from twin.service.monitor.braille import Curve, plot
from twin.service.monitor.panels import DIM
from twin.stream.rerun.plots import nice

RED, BLUE, TWIN, NOW = "bright_red", "dodger_blue1", "white", "grey30"
Value = Callable[[Quantities], float]


def eta_d(one: Quantities) -> float:
    """Displacement ratio."""
    return one.eta_d


def eta_a(one: Quantities) -> float:
    """Acceleration ratio."""
    return one.eta_a


def impacts_a_cycle(one: Quantities) -> float:
    """Mean over the measured cycles, both sides; NaN where the load cells of a side are lost."""
    cycles = min(len(one.impacts_right), len(one.impacts_left))
    return (sum(one.impacts_right) + sum(one.impacts_left)) / cycles if cycles else math.nan


def curve(board: Board, width: int, height: int, value: Value = eta_d) -> list[Text]:
    """The PRC as far as it has grown: measured in colour, the twin in white, where the step is."""
    points = sorted(board.points.values(), key=lambda one: one.step)
    swept = [one.frequency_hz for one in points]
    if board.start is not None:
        swept += [one.frequency_hz for one in board.start.steps]
    if not swept:
        return [Text("waits for the plan of the test", DIM)]
    curves, highest = [], 0.0
    for who in ("twin", "measured"):
        for direction, style in (("forward", RED), ("backward", BLUE)):
            found = _values(points, who, direction, value)
            highest = max([highest, *(y for _, y in found if math.isfinite(y))])
            kept = TWIN if direction == "forward" else DIM
            curves.append(Curve(kept, found, "○") if who == "twin" else Curve(style, found))
    if points and (newest := points[-1].measured) is not None:
        style = RED if points[-1].direction == "forward" else BLUE
        curves.append(Curve(style, [(points[-1].frequency_hz, value(newest))], "●"))
    top = nice(highest or 1.0)
    if board.step is not None:
        f = board.step.frequency_hz
        curves.insert(0, Curve(NOW, [(f, 0.0), (f, top)]))
    ends = min(swept), max(swept)
    return plot(curves, ends, top, width, height, "Hz")


def _values(
    points: list[Point], who: str, direction: str, value: Value
) -> list[tuple[float, float]]:
    """(frequency in Hz, value) of measured or twin points of a direction, in order of frequency."""
    found = {}
    for one in points:
        values: Quantities | None = getattr(one, who)
        if one.direction == direction and values is not None:
            found[one.frequency_hz] = value(values)
    return sorted(found.items())
