"""Pseudo-resonance curves of the points so far: measured and twin, both directions."""

import math
from collections.abc import Callable

from rich.text import Text

from table_io.records import NormalizedResponse, PrcPoint
from twin.monitor.braille import PlotCurve, plot_curves
from twin.monitor.panels import DIM_STYLE
from twin.monitor.run_state import LiveRunState
from twin.viewer.plots import nice_ceil

FORWARD_COLOUR, BACKWARD_COLOUR, TWIN_COLOUR, STEP_COLOUR = (
    "bright_red",
    "dodger_blue1",
    "white",
    "grey30",
)
ResponseQuantity = Callable[[NormalizedResponse], float]


def eta_d(quantities: NormalizedResponse) -> float:
    """Return the displacement ratio."""
    return quantities.eta_d


def eta_a(quantities: NormalizedResponse) -> float:
    """Return the acceleration ratio."""
    return quantities.eta_a


def impacts_per_cycle(quantities: NormalizedResponse) -> float:
    """Return mean impacts per measured cycle, both sides; NaN if the cells of a side are lost."""
    cycles = min(len(quantities.impacts_right), len(quantities.impacts_left))
    return (
        (sum(quantities.impacts_right) + sum(quantities.impacts_left)) / cycles
        if cycles
        else math.nan
    )


def draw_prc(
    run_state: LiveRunState, width: int, height: int, value: ResponseQuantity = eta_d
) -> list[Text]:
    """Plot the PRC so far, measured in color, twin in white, with the frequency of the step."""
    points = sorted(run_state.points.values(), key=lambda point: point.step)
    frequencies_hz = [point.frequency_hz for point in points]
    if run_state.start is not None:
        frequencies_hz += [step.frequency_hz for step in run_state.start.steps]
    if not frequencies_hz:
        return [Text("waiting for the test plan", DIM_STYLE)]
    curves, max_value = [], 0.0
    for source in ("twin", "measured"):
        for direction, style in (("forward", FORWARD_COLOUR), ("backward", BACKWARD_COLOUR)):
            samples = _select_values(points, source, direction, value)
            max_value = max([max_value, *(y for _, y in samples if math.isfinite(y))])
            twin_style = TWIN_COLOUR if direction == "forward" else DIM_STYLE
            curves.append(
                PlotCurve(twin_style, samples, "○")
                if source == "twin"
                else PlotCurve(style, samples)
            )
    if points and (newest := points[-1].measured) is not None:
        style = FORWARD_COLOUR if points[-1].direction == "forward" else BACKWARD_COLOUR
        curves.append(PlotCurve(style, [(points[-1].frequency_hz, value(newest))], "●"))
    y_max = nice_ceil(max_value or 1.0)
    if run_state.step is not None:
        frequency_hz = run_state.step.frequency_hz
        curves.insert(0, PlotCurve(STEP_COLOUR, [(frequency_hz, 0.0), (frequency_hz, y_max)]))
    x_range = min(frequencies_hz), max(frequencies_hz)
    return plot_curves(curves, x_range, y_max, width, height, "Hz")


def _select_values(
    points: list[PrcPoint], source: str, direction: str, value: ResponseQuantity
) -> list[tuple[float, float]]:
    """Return (frequency in Hz, value) of measured or twin points of a direction, by frequency."""
    samples = {}
    for point in points:
        quantities: NormalizedResponse | None = getattr(point, source)
        if point.direction == direction and quantities is not None:
            samples[point.frequency_hz] = value(quantities)
    return sorted(samples.items())
