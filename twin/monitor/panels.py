"""Panels of the screen: each returns the lines of one subject within a width and height.

Pure functions of `LiveRunState` and `SessionStatus`. Every number has its unit; unknown values
are dashes.
"""

import math
import textwrap
from collections import Counter
from dataclasses import dataclass

from rich.text import Text

from table_io.records import (
    Agreement,
    CycleExtremes,
    Estimate,
    Extremes,
    JumpForecast,
    Level,
    NormalizedResponse,
)
from table_io.units import GRAVITY_M_S2
from twin.monitor.margins import compute_live_margins
from twin.monitor.run_state import LiveRunState

DIM_STYLE, GOOD_STYLE, WARN_STYLE, BAD_STYLE = "grey62", "green3", "yellow1", "bold bright_red"
LEVEL_STYLES = {"INFO": "", "WARN": WARN_STYLE, "ERROR": BAD_STYLE}
WARN_SHARE, ALARM_SHARE = 0.7, 0.9  # of a limit
MIN_DRIFT_SIGMA = 3.0  # standard deviations beyond which a drift is marked
DISPLAY_NAMES = {
    "drive_disp_m": "drive", "table_disp_m": "table disp", "table_acc_m_s2": "table acc",
    "mass_disp_m": "mass disp", "mass_acc_m_s2": "mass acc", "rel_disp_m": "u rel",
    "force_r1_n": "force R1", "force_r2_n": "force R2",
    "force_l1_n": "force L1", "force_l2_n": "force L2", "damper_force_n": "damper",
    "stiffness": "stiffness", "damping": "damping", "gap_r": "gap R", "gap_l": "gap L",
    "bumper_stiffness_r": "bumper R", "bumper_stiffness_l": "bumper L",
}  # fmt: skip
# By the end of a channel's name; the last one is that of all other names.
DISPLAY_UNITS = (
    ("_m_s2", "m/s²", 1.0), ("_m_s", "mm/s", 1e-3), ("_m", "mm", 1e-3), ("_n", "N", 1.0),
    ("_degc", "°C", 1.0), ("_pa", "kPa", 1e3), ("", "", 1.0),
)  # fmt: skip
PARAMETER_UNITS = {
    "stiffness": ("kN/m", 1e3), "damping": ("kNs/m", 1e3), "gap_r": ("mm", 1e-3),
    "gap_l": ("mm", 1e-3), "bumper_stiffness_r": ("kN/m", 1e3), "bumper_stiffness_l": ("kN/m", 1e3),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class SessionStatus:
    """Session status: connected components, time without data, rights and command of the user."""

    components: frozenset[str] = frozenset()
    silent_s: float = 0.0
    may_command: bool = False  # the user may send commands
    pending_command: str = ""  # awaits confirmation


def format_number(value: float | None) -> str:
    """Format a number in at most six characters; a dash if unknown."""
    if value is None or not math.isfinite(value):
        return "–"
    size = abs(value)
    if size >= 1e6:
        return f"{value:.0e}"
    return f"{value:.{0 if size >= 1000 else 1 if size >= 100 else 2 if size >= 10 else 3}f}"


def format_percent(share: float) -> str:
    """Format a share in percent in at most five characters plus sign."""
    size = 100.0 * share
    return f"{size:.{0 if abs(size) >= 9.95 else 1}f} %" if math.isfinite(size) else "–"


def describe_channel(name: str) -> tuple[str, str, float]:
    """Return (display name, unit, SI value of the unit) of a channel."""
    suffix, unit, size = next(entry for entry in DISPLAY_UNITS if name.endswith(entry[0]))
    label = name.removesuffix(suffix).replace("_", " ")
    return DISPLAY_NAMES.get(name, label)[:10], unit, size


def draw_level(run_state: LiveRunState, width: int, height: int) -> list[Text]:
    """Draw the table level against demand: the current value and the last amplitude correction."""
    step, level = run_state.step, run_state.get_latest(Level)
    if step is None:
        return [Text("no step in progress", DIM_STYLE)]
    demanded = step.acceleration_m_s2
    current = run_state.recent.table_level(step.frequency_hz)
    lines = [Text(f"demanded  {demanded / GRAVITY_M_S2:8.4f} g"), Text("now       ")]
    if current is None:
        lines[1].append("       –  not steady yet", DIM_STYLE)
    else:
        deviation = current / demanded - 1.0
        tolerance = run_state.profile.control.tolerance if run_state.profile else 0.02
        lines[1].append(f"{current / GRAVITY_M_S2:8.4f} g")
        lines[1].append(
            f"  {100 * deviation:+.2f} %", GOOD_STYLE if abs(deviation) <= tolerance else WARN_STYLE
        )
    if level is not None and level.step == step.index:
        lines[0].append(f"  command × {level.correction:.3f}", DIM_STYLE)
        thd = math.hypot(*level.harmonics_m_s2) / (level.measured_m_s2 or math.nan)
        outcome = "accepted" if level.accepted else "being tuned"
        lines.append(
            Text(f"{outcome}, corrected {level.update} ×, thd {format_percent(thd)}", DIM_STYLE)
        )
    return lines


def draw_limits(run_state: LiveRunState, width: int, height: int) -> list[Text]:
    """Draw peaks of the last second as bars relative to their limits, the tightest that fit."""
    if run_state.rig is None or run_state.profile is None or run_state.start is None:
        return [Text("waiting for the rig file", DIM_STYLE)]
    rows = compute_live_margins(
        run_state.rig, run_state.profile, run_state.start.tare, run_state.recent
    )
    tightest = sorted(rows, key=lambda row: -row.share if math.isfinite(row.share) else -math.inf)
    lines = []
    for row in (row for row in rows if row in tightest[:height]):
        is_known = math.isfinite(row.share)
        style = (
            BAD_STYLE
            if not is_known or row.share > ALARM_SHARE
            else WARN_STYLE
            if row.share > WARN_SHARE
            else GOOD_STYLE
        )
        peak, share = format_number(row.peak) if is_known else "lost", format_percent(row.share)
        text = f" {peak:>6}/{row.limit:<4.4g} {row.unit:<4} "
        bar_width = max(width - 11 - len(text) - max(len(share), 5), 1)
        line = Text(f"{describe_channel(row.name)[0]:<10} ")
        line.append_text(
            draw_bar(min(row.share, 1.0) if is_known else 0.0, bar_width, style)
        ).append(text)
        lines.append(line.append(f"{share:>5}", style))
    return lines or [Text("waiting for the first samples", DIM_STYLE)]


def draw_bar(share: float, width: int, style: str) -> Text:
    """Draw a bar of `width` cells with `share` of it filled."""
    filled = round(share * width)
    return Text("━" * filled, style).append("─" * (width - filled), "grey35")


def draw_twin(run_state: LiveRunState, width: int, height: int) -> list[Text]:
    """Draw RMS over one second, error of the restarted twin and its band, per channel."""
    errors, agreement = run_state.recent.twin_errors(), run_state.get_latest(Agreement)
    agreements: dict[str, tuple[float, float]] = {}
    if agreement is not None:
        agreements = {
            name: (agreement.error[k], agreement.band[k])
            for k, name in enumerate(agreement.channels)
        }
    is_wide = width >= 52
    head = f"{'':<10}{'rms':>7}{'error':>7}{'band':>7}"
    if is_wide:
        head += f"{'':>6}{'of band' if agreements else 'of rms':>9}{'free':>8}"
    lines = [Text(head, DIM_STYLE)]
    for name in dict.fromkeys((*errors, *agreements)):
        label, unit, size = describe_channel(name)
        rms, window, free = errors.get(name, (math.nan,) * 3)
        error, band = agreements.get(name, (window, math.nan))
        exceeds_band = math.isfinite(band) and error > band
        line = Text(f"{label:<10}{format_number(rms / size):>7}")
        line.append(f"{format_number(error / size):>7}", BAD_STYLE if exceeds_band else "")
        line.append(f"{format_number(band / size):>7}", DIM_STYLE).append(f" {unit:<4}", DIM_STYLE)
        if is_wide:
            share = error / ((band if agreements else rms) or math.nan)
            line.append(f"{format_percent(share):>8}", DIM_STYLE).append(
                f"{format_number(free / size):>8}", DIM_STYLE
            )
        line.append(" ◀" if exceeds_band else "  ", BAD_STYLE)
        lines.append(line)
    return lines[:height] if len(lines) > 1 else [Text("nothing compared yet", DIM_STYLE)]


def draw_phases(run_state: LiveRunState, width: int, height: int) -> list[Text]:
    """Draw the error of the restarted twin over the last cycle by contact regime."""
    agreement = run_state.get_latest(Agreement)
    if agreement is None:
        return [Text("no cycle compared yet", DIM_STYLE)]
    lines = [Text(f"{'':<10}{'flight':>8}{'right':>8}{'left':>8}", DIM_STYLE)]
    for k, name in enumerate(agreement.channels):
        label, unit, size = describe_channel(name)
        parts = (agreement.flight[k], agreement.right[k], agreement.left[k])
        numbers = "".join(f"{format_number(error / size):>8}" for error in parts)
        lines.append(Text(f"{label:<10}{numbers}").append(f" {unit}", DIM_STYLE))
    return lines[:height]


def draw_impacts(run_state: LiveRunState, width: int, height: int) -> list[Text]:
    """Draw impacts and peak of the last cycle and the last PRC point, measured and twin."""
    cycle = run_state.get_latest(CycleExtremes)
    point = run_state.points[max(run_state.points)] if run_state.points else None
    lines = [Text(f"{'':<9}{'R':>3}{'L':>3}{'u peak':>10}{'η_d':>7}{'η_a':>7}", DIM_STYLE)]
    for source in ("measured", "twin"):
        extremes: Extremes | None = getattr(cycle, source) if cycle else None
        eta: NormalizedResponse | None = getattr(point, source) if point else None
        right, left = (
            (str(len(extremes.onsets_r)), str(len(extremes.onsets_l))) if extremes else ("–", "–")
        )
        peak = format_number(1e3 * max(extremes.u_max, -extremes.u_min)) if extremes else "–"
        text = f"{source:<9}{right:>3}{left:>3}{peak:>7} mm"
        text += f"{format_number(eta.eta_d if eta else None):>7}"
        text += f"{format_number(eta.eta_a if eta else None):>7}"
        lines.append(Text(text, "" if source == "measured" else DIM_STYLE))
    return lines


def draw_specimen(run_state: LiveRunState, width: int, height: int) -> list[Text]:
    """Draw the jump forecast and the identified parameters, drifted parameters first."""
    estimate = run_state.get_latest(Estimate)
    drift_lines: list[Text] = []
    steady_lines = [_format_forecast(run_state.get_latest(JumpForecast))]
    for name, value, sd, drift, drift_sd in zip(
        *(
            (estimate.names, estimate.values, estimate.sd, estimate.drift, estimate.drift_sd)
            if estimate
            else ()
        ),
        strict=True,
    ):
        unit, size = PARAMETER_UNITS.get(name, ("", 1.0))
        line = Text(f"{DISPLAY_NAMES.get(name, name[:9]):<9} ")
        line.append(f"{format_number(value / size):>6}±{format_number(sd / size):<5} {unit:<5}")
        has_drifted = abs(drift) > MIN_DRIFT_SIGMA * drift_sd
        share, share_sd = (
            100.0 * change / (abs(value) or math.nan) for change in (drift, drift_sd)
        )
        digits = 1 if abs(share) < 10 else 0
        if math.isfinite(drift_sd):  # no trend is fitted for some parameters
            line.append(
                f" {share:+.{digits}f}±{share_sd:.{digits}f} %",
                WARN_STYLE if has_drifted else DIM_STYLE,
            )
        (drift_lines if has_drifted else steady_lines).append(line)
    return [*drift_lines, *steady_lines][:height]


def _format_forecast(forecast: JumpForecast | None) -> Text:
    if forecast is None:
        return Text("no jump forecast yet", DIM_STYLE)
    if not forecast.kind:
        return Text("no jump ahead on this branch", DIM_STYLE)
    is_near = forecast.low_hz <= forecast.frequency_hz <= forecast.high_hz
    text = (
        f"jump {forecast.kind} at {forecast.jump_hz:.3f} Hz "
        f"({forecast.low_hz:.2f} to {forecast.high_hz:.2f})"
    )
    return Text(text, WARN_STYLE if is_near else "")


def draw_events(run_state: LiveRunState, width: int, height: int) -> list[Text]:
    """Draw warnings and events with their times, newest first, with line wrapping."""
    lines: list[Text] = []
    for event in sorted(reversed(run_state.events.values()), key=lambda event: -event.index):  # noqa: C414
        time_text = f"{format_duration(event.index / run_state.rate_hz):>7} "
        for row, part in enumerate(_wrap_text(event.text, width - len(time_text))):
            lines.append(
                Text(" " * len(time_text) if row else time_text, DIM_STYLE).append(
                    part, LEVEL_STYLES[event.level]
                )
            )
        if len(lines) >= height:
            break
    return lines[:height] or [Text("no events yet", DIM_STYLE)]


def _wrap_text(text: str, width: int) -> list[str]:
    """Wrap text to lines of at most `width` characters, between words where possible."""
    return textwrap.wrap(text, max(width, 1)) or [""]


def format_duration(seconds: float) -> str:
    """Format a duration as hours, minutes and seconds, as in 0:01:02."""
    total_s = max(int(seconds), 0)
    return f"{total_s // 3600}:{total_s // 60 % 60:02d}:{total_s % 60:02d}"


def draw_timing(run_state: LiveRunState, width: int, height: int) -> list[Text]:
    """Draw latency percentiles and missed deadlines of each component."""
    lines = [Text(f"{'':<9}{'p50':>7}{'p99':>8}{'max':>8}{'missed':>7}", DIM_STYLE)]
    for timing in sorted(run_state.timings.values(), key=lambda timing: timing.component):
        text = f"{timing.component[:9]:<9}{format_number(timing.p50_ms):>7}"
        text += f"{format_number(timing.p99_ms):>8}"
        line = Text(f"{text}{format_number(timing.max_ms):>8}")
        lines.append(line.append(f"{timing.missed:>7}", WARN_STYLE if timing.missed else ""))
    return lines[:height] if len(lines) > 1 else [Text("no latencies yet", DIM_STYLE)]


def format_gaps(run_state: LiveRunState) -> Text:
    """Format the number of invalid samples and their channels."""
    lost_samples = sum(count for _, count in run_state.gaps.values())
    if not lost_samples:
        return Text("0 dropouts", GOOD_STYLE)
    names = ", ".join(
        sorted({describe_channel(name)[0] if name else "all" for name, _ in run_state.gaps})
    )
    return Text(f"dropouts: {lost_samples} samples, {names}", BAD_STYLE)


def format_latency(run_state: LiveRunState, width: int) -> Text:
    """Format p99 latencies in ms in one line: of each component, or the worst if too long."""
    if not run_state.timings:
        return Text("no latencies yet", DIM_STYLE)
    latencies = sorted((timing.component, timing.p99_ms) for timing in run_state.timings.values())
    missed = sum(timing.missed for timing in run_state.timings.values())
    text = "  ".join(f"{component} {p99:.1f}" for component, p99 in latencies)
    suffix = f" ms  {missed} missed"
    if len(text) + len(suffix) + 5 > width:
        text = f"{max(p99 for _, p99 in latencies):.1f}"
    return (
        Text("p99  ", DIM_STYLE)
        .append(text, "default")
        .append(suffix, WARN_STYLE if missed else GOOD_STYLE)
    )


def format_components(run_state: LiveRunState, status: SessionStatus, width: int) -> Text:
    """Format the connected components, one word each, with counts."""
    names = Counter(component_label(component, run_state.run) for component in status.components)
    words = [f"{name}×{count}" if count > 1 else name for name, count in sorted(names.items())]
    shown_count = len(words)
    while shown_count and len("  ".join(words[:shown_count])) > width - 4:
        shown_count -= 1
    suffix = f" +{len(words) - shown_count}" if shown_count < len(words) else ""
    return Text(("  ".join(words[:shown_count]) or "none") + suffix)


def component_label(component: str, run: str) -> str:
    """Return the display name of a component: a process of this run, or an observer's program."""
    if component.startswith(f"{run}."):
        return component.removeprefix(f"{run}.")
    parts = component.split(".")
    if parts[0] != "observer" or len(parts) < 3:
        return component
    return f"{parts[-1].partition('-')[0]}:{'.'.join(parts[1:-1])}"
