"""Files of figures."""

from collections.abc import Iterator
from pathlib import Path

from matplotlib.figure import Figure

from twin.drawing.panels import CaptionedFigure
from twin.drawing.pictures import save_figures


def draw_line() -> Iterator[CaptionedFigure]:
    figure = Figure()
    axes = figure.subplots()
    axes.plot([0.0, 1.0, 2.0], [0.0, 3.0, 1.0])
    axes.set_xlim(0.5, 1.5)  # the line is clipped
    yield CaptionedFigure("line", "title", "caption", figure)


def test_equal_figures_are_equal_bytes_as_svg(tmp_path: Path) -> None:
    for name in ("first", "second"):
        save_figures(draw_line(), tmp_path / name, more_formats=("svg",))
    first, second = ((tmp_path / name / "line.svg").read_bytes() for name in ("first", "second"))
    assert first == second
    assert b"clip" in first
    assert b"<dc:date>" not in first
