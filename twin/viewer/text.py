"""Texts and derived values of the view: status, forecast, agreement, cycle and PRC point."""

import math
from collections.abc import Iterable, Iterator

import numpy as np

from table_io.block import Block, Float2D, Label
from table_io.records import (
    LABEL_TEXTS,
    Comparison,
    CycleExtremes,
    Extremes,
    JumpForecast,
    NormalizedResponse,
    PrcPoint,
    RunStart,
)
from table_io.units import GRAVITY_M_S2
from twin.viewer.model_branches import FoldAhead
from twin.viewer.style import CHANNEL_LINES
from twin.viewer.view_model import ParameterRow, TwinRow


class SweepPosition:
    """Current position in the sweep (step and label)."""

    def __init__(self) -> None:
        self._position: tuple[int, int] | None = None

    def add(self, block: Block) -> Iterator[tuple[int, int, int]]:
        """Yield (sample index, step, label) at every change of step or label."""
        changed = (np.diff(block.step) != 0) | (np.diff(block.label) != 0)
        for sample in (0, *(np.flatnonzero(changed) + 1).tolist()):
            position = (int(block.step[sample]), int(block.label[sample]))
            if position != self._position:
                self._position = position
                yield block.index + sample, *position


class RelativeError:
    """Twin error of u in % of the measured RMS, over windows of 0.5 s."""

    def __init__(self, rate_hz: float) -> None:
        self._window = max(1, round(rate_hz / 2))
        self._sums = np.zeros(3)
        self._end = 0

    def add(self, comparison: Comparison) -> tuple[int, Float2D] | None:
        """Return (sample index, (1, 2) free-running and restarted) at the end of each window."""
        end = comparison.index + comparison.count
        if end <= self._end:  # repeated
            return None
        self._end = end
        if "rel_disp_m" in comparison.channels:
            channel = comparison.channels.index("rel_disp_m")
            self._sums += [
                comparison.measured_ss[channel],
                comparison.free_error_ss[channel],
                comparison.window_error_ss[channel],
            ]
        if end // self._window == comparison.index // self._window:
            return None
        (measured, *errors), self._sums = self._sums, np.zeros(3)
        share = 100 * np.sqrt(np.array(errors) / measured) if measured > 0 else [math.nan] * 2
        return end, np.array([share])


def impact_counts(cycle: CycleExtremes) -> Float2D:
    """Return impacts of a cycle (1, 4): measured right, left, twin right, left; NaN if unknown."""
    counts: list[float] = []
    for extremes in (cycle.measured, cycle.twin):
        counts += (
            [math.nan] * 2 if extremes is None else [len(extremes.onsets_r), len(extremes.onsets_l)]
        )
    return np.array([counts])


def format_status(start: RunStart, step: int, label: int) -> str:
    """Format frequency, direction, step and activity of the drive as Markdown."""
    activity = LABEL_TEXTS[Label(label)] if label in set(Label) else "recorded without steps"
    if not 0 <= step < len(start.steps):
        return f"### {activity}\n{start.name}"
    planned = start.steps[step]
    level = planned.acceleration_m_s2 / GRAVITY_M_S2
    return (
        f"### {planned.frequency_hz:g} Hz {planned.direction}, {activity}\n"
        f"{start.name}: step {step + 1} of {len(start.steps)}, {level:g} g"
    )


def format_forecast(forecast: JumpForecast, fold: FoldAhead | None = None) -> str:
    """Format the forecast of the next jump, its distance and the fold behind it as Markdown."""
    return f"{_format_jump(forecast)}{_format_fold(fold)}"


def _format_fold(fold: FoldAhead | None) -> str:
    """Format the distance to a fold of the model, and the share of starts that come back."""
    if fold is None:
        return ""
    starts = f"±{1e3 * fold.u_limit:.2g} mm and ±{1e3 * fold.v_limit:.2g} mm/s"
    return (
        f"\n\nfold at **{fold.fold_hz:.4g} Hz**, {fold.distance_hz:.2g} Hz ahead; "
        f"{100 * fold.basin_share:.0f} % of the starts within {starts} lead to this motion"
    )


def _format_jump(forecast: JumpForecast) -> str:
    if not forecast.kind:
        return f"none {forecast.direction} from {forecast.frequency_hz:g} Hz"
    distance_hz = abs(forecast.jump_hz - forecast.frequency_hz)
    return (
        f"**{forecast.kind} at {forecast.jump_hz:.3g} Hz**, "
        f"{forecast.low_hz:.3g} to {forecast.high_hz:.3g} Hz\n\n"
        f"{distance_hz:.2g} Hz ahead, {forecast.direction}"
    )


def disagreement_ratios(rows: Iterable[TwinRow]) -> dict[str, float]:
    """Return error / band by line name: u, a, and the worse load cell of each side."""
    ratios: dict[str, float] = {}
    for row in rows:
        line = CHANNEL_LINES.get(row.channel, row.channel)
        if line and row.band > 0 and not row.share_of_band <= ratios.get(line, -1.0):
            ratios[line] = row.share_of_band
    return ratios


def format_agreement(rows: Iterable[TwinRow]) -> str:
    """Format error, band and regime of the largest error per channel as Markdown, worst first."""
    phases = ("in flight", "contact right", "contact left")
    lines: list[tuple[float, str]] = []
    for row in rows:
        known = [part for part in zip(row.phases, phases, strict=True) if math.isfinite(part[0])]
        worst_phase = max(known)[1] if known else "-"
        share = row.share_of_band
        line = f"| {row.channel} | {row.error:.3g} | {row.band:.3g} | {share:.2f} | {worst_phase} |"
        lines.append((-share if math.isfinite(share) else math.inf, line))
    head = "| SI, rms | error | band | error / band | largest |\n|---|---|---|---|---|\n"
    return head + "\n".join(line for _, line in sorted(lines))


def drift_interval(row: ParameterRow) -> Float2D:
    """Return the drift since the start and its bounds at plus and minus 2 sd, (1, 3).

    Of a gap in mm, of other parameters in % of their first value.
    """
    scale = 1e3 if row.is_length else 100 / row.drift_size
    bounds = row.drift + 2 * row.drift_sd, row.drift - 2 * row.drift_sd
    return scale * np.array([[row.drift, *bounds]])


RATIO_SYMBOLS = (("eta_d", "η_d"), ("eta_a", "η_a"), ("eta_r", "η_R"), ("eta_l", "η_L"),
          ("r_r", "r_R"), ("r_l", "r_L"))  # fmt: skip


def format_point(point: PrcPoint) -> str:
    """Format a PRC point as a Markdown table with one row each for measurement and twin."""
    drive = f"table {point.table_acc_peak_m_s2:.3f} m/s², THD {100 * point.thd:.1f} %"
    head = f"**{point.frequency_hz:g} Hz {point.direction}**, {drive}\n\n"
    names = "".join(f" {text} |" for _, text in RATIO_SYMBOLS)
    rows = [f"| |{names}", "|---|" + "---|" * len(RATIO_SYMBOLS)]
    impacts = []
    for label, values in (("measured", point.measured), ("twin, free", point.twin)):
        rows.append(
            f"| {label} |"
            + "".join(f" {_format_ratio(values, name)} |" for name, _ in RATIO_SYMBOLS)
        )
        if values is not None:
            sides = (("right", values.impacts_right), ("left", values.impacts_left))
            counts = ", ".join(f"{name} {' '.join(map(str, side))}" for name, side in sides)
            impacts.append(f"{label} impacts {counts}, drift of η_d {values.drift:.3f}")
    return head + "\n".join(rows) + "\n\n" + "\n\n".join(impacts)


def _format_ratio(values: NormalizedResponse | None, name: str) -> str:
    value = math.nan if values is None else getattr(values, name)
    return "-" if math.isnan(value) else f"{value:.3f}"


def format_cycle(cycle: CycleExtremes) -> str:
    """Format minima and maxima of a forcing cycle, measured and twin, as a Markdown table."""

    def cells(extremes: Extremes | None) -> tuple[str, ...]:
        if extremes is None:
            return ("-",) * 4
        return (
            f"{1e3 * extremes.u_min:.2f} … {1e3 * extremes.u_max:.2f}",
            f"{extremes.a_min:.2f} … {extremes.a_max:.2f}",
            f"{-1e-3 * extremes.force_l:.2f} … {1e-3 * extremes.force_r:.2f}",
            f"{len(extremes.onsets_l)}, {len(extremes.onsets_r)}",
        )

    names = ("u [mm]", "a [m/s²]", "F [kN]", "impacts L, R")
    rows = zip(names, cells(cycle.measured), cells(cycle.twin), strict=True)
    lines = (f"| {name} | {measured} | {twin} |" for name, measured, twin in rows)
    return "| | measured | twin, free |\n|---|---|---|\n" + "\n".join(lines)
