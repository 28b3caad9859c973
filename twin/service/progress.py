"""What the terminal shows while a run goes on: a line a step, and a bar on a terminal."""

from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from table_io.records import (
    Check,
    Comparison,
    Decided,
    Event,
    Fault,
    Gap,
    Point,
    Quantities,
    Timing,
    Trip,
)
from table_io.units import GRAVITY_M_S2
from table_io.words import printable, sentence
from twin.stream.wire import Item

HEAD = (
    f"{'step':>7}  {'direction':<9} {'f [Hz]':>7}  {'level [g]':>9}   "
    f"{'eta_d':>6} {'twin':>6}   {'impacts R/L':>11} {'twin':>7}   {'latency':>8}"
)


class RunProgress:
    """Shows the items of a run as they come; use as a context manager."""

    def __init__(self, console: Console, steps: int, samples: int) -> None:
        self._console = console
        self._steps = steps
        self._latency_ms: float | None = None
        self._bar = Progress(
            TextColumn("[bold]{task.description}"),
            BarColumn(bar_width=40),
            TextColumn("{task.percentage:3.0f} %"),
            TimeRemainingColumn(),
            console=console,
            disable=not console.is_terminal,
            transient=True,
        )
        self._task = self._bar.add_task("running", total=samples)
        self._shown = 0
        self._headed = False

    def __enter__(self) -> "RunProgress":
        self._bar.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._bar.stop()

    def __call__(self, item: Item) -> None:
        """Show one item, if it is of a kind that a person reads."""
        if isinstance(item, Comparison):
            if item.index - self._shown >= 400:
                self._shown = item.index
                self._bar.update(self._task, completed=item.index)
        elif isinstance(item, Timing) and item.component == "twin" and item.blocks:
            self._latency_ms = item.p99_ms
        elif isinstance(item, Point):
            self._point(item)
        elif isinstance(item, Decided):
            self._steps = max(self._steps, item.step + 1)
        elif isinstance(item, Event):
            self.say(f"{'':>7}  {item.kind}: {item.text}")
        elif isinstance(item, Gap):
            name = item.channel or "all channels"
            self.say(f"{'':>7}  gap: {item.count} samples of {name} {item.reason}")
        elif isinstance(item, Trip) or (isinstance(item, Check) and not item.passed):
            told = sentence(item, 1.0)
            self.say(f"{'':>7}  {told[1] if told else ''}")
        elif isinstance(item, Fault):
            self.say(
                f"{'':>7}  fault: {item.component} missing for samples {item.from_index} to "
                f"{item.to_index - 1}: {item.reason}"
            )

    def say(self, text: str) -> None:
        """One line, above the bar; of what a twin elsewhere has written, only what is printable."""
        text = printable(text)
        self._console.print(text, highlight=False, markup=False, soft_wrap=True)

    def _point(self, point: Point) -> None:
        if not self._headed:
            self.say(HEAD)
            self._headed = True
        latency = f"{self._latency_ms:5.2f} ms" if self._latency_ms is not None else "unpaced"
        self.say(
            f"{point.step + 1:>3}/{self._steps:<3}  {point.direction:<9} "
            f"{point.frequency_hz:7.3f}  {point.table_acc_fundamental_m_s2 / GRAVITY_M_S2:9.4f}   "
            f"{_eta(point.measured)} {_eta(point.twin)}   "
            f"{_impacts(point.measured):>11} {_impacts(point.twin):>7}   {latency:>8}"
        )


def _eta(values: Quantities | None) -> str:
    return f"{values.eta_d:6.3f}" if values else "     -"


def _impacts(values: Quantities | None) -> str:
    """Mean impacts per cycle, right/left."""
    if values is None or not values.impacts_right or not values.impacts_left:
        return "-"  # a side whose load cells are lost counts nothing
    right = sum(values.impacts_right) / len(values.impacts_right)
    left = sum(values.impacts_left) / len(values.impacts_left)
    return f"{right:.3g}/{left:.3g}"
