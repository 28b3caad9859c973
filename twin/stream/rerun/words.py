"""What the view says: where the run is, a cycle and a PRC point in numbers."""

import math
from collections.abc import Iterator

import numpy as np

from table_io.block import Block, Float2D, Label
from table_io.records import (
    Agreement,
    Ahead,
    Comparison,
    Cycle,
    Estimate,
    Extremes,
    Point,
    Quantities,
    RunStart,
)
from table_io.units import GRAVITY_M_S2
from table_io.words import DOING
from twin.stream.rerun.looks import LINE_OF


class Progress:
    """Where in the sweep the run is."""

    def __init__(self) -> None:
        self._now: tuple[int, int] | None = None

    def add(self, block: Block) -> Iterator[tuple[int, int, int]]:
        """(sample index, step, label) at every sample at which step or label changes."""
        changed = (np.diff(block.step) != 0) | (np.diff(block.label) != 0)
        for at in (0, *(np.flatnonzero(changed) + 1).tolist()):
            now = (int(block.step[at]), int(block.label[at]))
            if now != self._now:
                self._now = now
                yield block.index + at, *now


class ErrorShare:
    """Twin error of u in % of the measured RMS, gathered over half a second."""

    def __init__(self, rate_hz: float) -> None:
        self._half = max(1, round(rate_hz / 2))
        self._sums = np.zeros(3)
        self._end = 0

    def add(self, one: Comparison) -> tuple[int, Float2D] | None:
        """(sample index, (1, 2) free-running and restarted) when half a second is whole."""
        end = one.index + one.count
        if end <= self._end:  # said twice
            return None
        self._end = end
        if "rel_disp_m" in one.channels:
            at = one.channels.index("rel_disp_m")
            self._sums += [one.measured_ss[at], one.free_error_ss[at], one.window_error_ss[at]]
        if end // self._half == one.index // self._half:
            return None
        (measured, *errors), self._sums = self._sums, np.zeros(3)
        share = 100 * np.sqrt(np.array(errors) / measured) if measured > 0 else [math.nan] * 2
        return end, np.array([share])


def impacts(cycle: Cycle) -> Float2D:
    """(1, 4) impacts of a cycle: measured right, left, twin right, left; NaN where unknown."""
    counts: list[float] = []
    for one in (cycle.measured, cycle.twin):
        counts += [math.nan] * 2 if one is None else [len(one.onsets_r), len(one.onsets_l)]
    return np.array([counts])


def status(start: RunStart, step: int, label: int) -> str:
    """Markdown: frequency, direction and step, and what the drive is doing."""
    doing = DOING[Label(label)] if label in set(Label) else "recorded without steps"
    if not 0 <= step < len(start.steps):
        return f"### {doing}\n{start.name}"
    one = start.steps[step]
    level = one.acceleration_m_s2 / GRAVITY_M_S2
    return (
        f"### {one.frequency_hz:g} Hz {one.direction}, {doing}\n"
        f"{start.name}: step {step + 1} of {len(start.steps)}, {level:g} g"
    )


def ahead_text(ahead: Ahead) -> str:
    """Markdown: the next jump by the model's branch, and how far it is."""
    if not ahead.kind:
        return f"none on the way {ahead.direction} from {ahead.frequency_hz:g} Hz"
    away = abs(ahead.jump_hz - ahead.frequency_hz)
    return (
        f"**{ahead.kind} at {ahead.jump_hz:.3g} Hz**, "
        f"{ahead.low_hz:.3g} to {ahead.high_hz:.3g} Hz\n\n"
        f"{away:.2g} Hz ahead, {ahead.direction}"
    )


def shares(one: Agreement) -> dict[str, float]:
    """Error over band by the name of a line: u, a, and the worse load cell of a side."""
    found: dict[str, float] = {}
    for name, error, band in zip(one.channels, one.error, one.band, strict=True):
        line = LINE_OF.get(name, name)
        if line and band > 0 and not error / band <= found.get(line, -1.0):
            found[line] = error / band
    return found


def agreement_table(one: Agreement) -> str:
    """Markdown: error, band and where the error is largest of every channel, the worst first."""
    phases = ("in flight", "contact right", "contact left")
    lines: list[tuple[float, str]] = []
    for name, error, band, *parts in zip(
        one.channels, one.error, one.band, one.flight, one.right, one.left, strict=True
    ):
        known = [part for part in zip(parts, phases, strict=True) if math.isfinite(part[0])]
        where = max(known)[1] if known else "-"
        share = error / band if band > 0 else math.nan
        line = f"| {name} | {error:.3g} | {band:.3g} | {share:.2f} | {where} |"
        lines.append((-share if math.isfinite(share) else math.inf, line))
    head = "| SI, rms | error | band | error / band | most |\n|---|---|---|---|---|\n"
    return head + "\n".join(line for _, line in sorted(lines))


def drifts(one: Estimate) -> Iterator[tuple[str, Float2D]]:
    """(parameter, (1, 3)) change since the start, and that plus and minus two sd.

    Lengths (gaps) in mm, everything else in % of its first value.
    """
    rows = zip(one.names, one.values, one.drift, one.drift_sd, strict=True)
    for name, value, drift, sd in rows:
        first = abs(value - drift)
        scale = 1e3 if is_length(name) else 100 / first if first > 0 else math.nan
        yield name, scale * np.array([[drift, drift + 2 * sd, drift - 2 * sd]])


def is_length(parameter: str) -> bool:
    """True for the gaps, whose first value may be 0."""
    return parameter.startswith("gap")


RATIOS = (("eta_d", "η_d"), ("eta_a", "η_a"), ("eta_r", "η_R"), ("eta_l", "η_L"),
          ("r_r", "r_R"), ("r_l", "r_L"))  # fmt: skip


def point_table(point: Point) -> str:
    """Markdown: the numbers of a PRC point, a row for what was measured, one for the twin."""
    drive = f"table {point.table_acc_peak_m_s2:.3f} m/s², THD {100 * point.thd:.1f} %"
    head = f"**{point.frequency_hz:g} Hz {point.direction}**, {drive}\n\n"
    names = "".join(f" {text} |" for _, text in RATIOS)
    rows = [f"| |{names}", "|---|" + "---|" * len(RATIOS)]
    impacts = []
    for who, one in (("measured", point.measured), ("twin, free", point.twin)):
        rows.append(f"| {who} |" + "".join(f" {_ratio(one, name)} |" for name, _ in RATIOS))
        if one is not None:
            sides = (("right", one.impacts_right), ("left", one.impacts_left))
            counts = ", ".join(f"{name} {' '.join(map(str, side))}" for name, side in sides)
            impacts.append(f"{who} impacts {counts}, drift of η_d {one.drift:.3f}")
    return head + "\n".join(rows) + "\n\n" + "\n\n".join(impacts)


def _ratio(one: Quantities | None, name: str) -> str:
    value = math.nan if one is None else getattr(one, name)
    return "-" if math.isnan(value) else f"{value:.3f}"


def cycle_table(cycle: Cycle) -> str:
    """Markdown: least and greatest values of a forcing cycle, measured beside twin."""

    def cells(one: Extremes | None) -> tuple[str, ...]:
        if one is None:
            return ("-",) * 4
        return (
            f"{1e3 * one.u_min:.2f} … {1e3 * one.u_max:.2f}",
            f"{one.a_min:.2f} … {one.a_max:.2f}",
            f"{-1e-3 * one.force_l:.2f} … {1e-3 * one.force_r:.2f}",
            f"{len(one.onsets_l)}, {len(one.onsets_r)}",
        )

    names = ("u [mm]", "a [m/s²]", "F [kN]", "impacts L, R")
    rows = zip(names, cells(cycle.measured), cells(cycle.twin), strict=True)
    lines = (f"| {name} | {measured} | {twin} |" for name, measured, twin in rows)
    return "| | measured | twin, free |\n|---|---|---|\n" + "\n".join(lines)
