"""Progress of a run on the terminal: one line per step, and a progress bar."""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from types import TracebackType

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TextColumn,
    TimeRemainingColumn,
)

from table_io.block import Block
from table_io.errors import replace_nonprintable
from table_io.records import (
    Check,
    Comparison,
    Event,
    Fault,
    NormalizedResponse,
    OrbitPoint,
    PrcPoint,
    Record,
    SampleGap,
    StepAdded,
    SweepLevel,
    Timing,
    Trip,
    format_kind,
    format_record,
)
from table_io.units import GRAVITY_M_S2
from twin.system.terminal import console

TABLE_HEADER = (
    f"{'step':>7}  {'direction':<9} {'f [Hz]':>7}  {'level [g]':>9} {'peak':>7}   "
    f"{'eta_d':>6} {'twin':>6}   {'impacts R/L':>11} {'twin':>7}   {'latency':>8}"
)
# 10 s at 2 kHz: a channel that is off its range is so in every cycle, also of a slow motion.
GAP_SERIES_SAMPLES = 20_000

# Of a task: it enters the context while a stage is computed that the sentence describes.
OpenStage = Callable[[str], AbstractContextManager[None]]


def open_silently(_: str) -> AbstractContextManager[None]:
    """Announce no stage."""
    return nullcontext()


def make_task_bar(*columns: ProgressColumn) -> Progress:
    """Return the bar of a study, shown on a terminal only, with further columns."""
    return Progress(
        TextColumn("[bold]{task.description}"), BarColumn(bar_width=40), MofNCompleteColumn(),
        *columns, TimeRemainingColumn(), console=console, disable=not console.is_terminal,
        transient=True,
    )  # fmt: skip


class RunProgress:
    """Display of a run's items as they arrive; use as a context manager."""

    def __init__(self, console: Console, steps: int, samples: int) -> None:
        self._console = console
        self._steps = steps
        self._orbits = 0  # accepted so far
        self._sweep_part = -1  # of a swept sine, printed last
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
        self._shown_index = 0
        self._header_printed = False
        self._gap_series: dict[tuple[str, str], tuple[int, int]] = {}  # number in it, end of last

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

    def __call__(self, item: Block | Record) -> None:
        """Show one item if its kind is displayed."""
        if isinstance(item, Comparison):
            if item.index - self._shown_index >= 400:
                self._shown_index = item.index
                self._bar.update(self._task, completed=item.index)
        elif isinstance(item, Timing) and item.component == "twin" and item.blocks:
            self._latency_ms = item.p99_ms
        elif isinstance(item, PrcPoint):
            self._print_point(item)
        elif isinstance(item, OrbitPoint):
            self._print_orbit(item)
        elif isinstance(item, SweepLevel):
            if item.step != self._sweep_part:  # the first level of each part
                self.print_line(f"{item.step:>7}  {(format_record(item, 1.0) or ('', ''))[1]}")
            self._sweep_part = item.step
        elif isinstance(item, StepAdded):
            self._steps = max(self._steps, item.step + 1)
        elif isinstance(item, Event):
            self.print_line(f"{'':>7}  {format_kind(item.kind)}: {item.text}")
        elif isinstance(item, SampleGap):
            self._print_gap(item)
        elif isinstance(item, Trip) or (isinstance(item, Check) and not item.passed):
            message = format_record(item, 1.0)
            self.print_line(f"{'':>7}  {message[1] if message else ''}")
        elif isinstance(item, Fault):
            self.print_line(
                f"{'':>7}  fault: {item.component} missing for samples {item.from_index} to "
                f"{item.to_index - 1}: {item.reason}"
            )

    def print_line(self, text: str) -> None:
        """Print one line above the bar, without nonprintable characters (a remote twin's text)."""
        text = replace_nonprintable(text)
        self._console.print(text, highlight=False, soft_wrap=True)

    def _print_gap(self, gap: SampleGap) -> None:
        """Print the first gap of a series, and once that more follow: a block may bring each."""
        name, key = gap.channel or "all channels", (gap.channel, gap.reason)
        number, end = self._gap_series.get(key, (0, 0))
        number = number + 1 if number and gap.index - end < GAP_SERIES_SAMPLES else 1
        self._gap_series[key] = number, gap.end
        if number == 1:
            self.print_line(f"{'':>7}  gap: {gap.count} samples of {name} {gap.reason}")
        elif number == 2:
            self.print_line(
                f"{'':>7}  gap: more samples of {name} {gap.reason}; the next are shown after "
                f"{GAP_SERIES_SAMPLES} valid samples"
            )

    def _print_orbit(self, orbit: OrbitPoint) -> None:
        """Print how many of the planned orbits are measured, and the newest."""
        self._orbits += orbit.accepted
        message = format_record(orbit, 1.0)
        self.print_line(f"{self._orbits:>3}/{self._steps:<3}  {message[1] if message else ''}")

    def _print_point(self, point: PrcPoint) -> None:
        if not self._header_printed:
            self.print_line(TABLE_HEADER)
            self._header_printed = True
        latency = f"{self._latency_ms:5.2f} ms" if self._latency_ms is not None else "unpaced"
        self.print_line(
            f"{point.step + 1:>3}/{self._steps:<3}  {point.direction:<9} "
            f"{point.frequency_hz:7.3f}  {point.table_acc_fundamental_m_s2 / GRAVITY_M_S2:9.4f} "
            f"{point.table_acc_peak_m_s2 / GRAVITY_M_S2:7.4f}   "
            f"{_format_eta(point.measured)} {_format_eta(point.twin)}   "
            f"{_format_impacts(point.measured):>11} {_format_impacts(point.twin):>7}   {latency:>8}"
        )


def _format_eta(values: NormalizedResponse | None) -> str:
    return f"{values.eta_d:6.3f}" if values else "     -"


def _format_impacts(values: NormalizedResponse | None) -> str:
    """Format the mean impacts per cycle, right/left."""
    if values is None or not values.impacts_right or not values.impacts_left:
        return "-"  # a side without load cell data has no counts
    right = sum(values.impacts_right) / len(values.impacts_right)
    left = sum(values.impacts_left) / len(values.impacts_left)
    return f"{right:.3g}/{left:.3g}"
