"""What stands in the panels of the screen: each the lines of one subject, within width and height.

Pure: from the board, and from `About` what no record tells. Every number has its unit; what is not
known yet is a dash.
"""

import math
import textwrap
from collections import Counter
from dataclasses import dataclass

from rich.text import Text

from table_io.records import Agreement, Ahead, Cycle, Estimate, Extremes, Level, Quantities
from table_io.units import GRAVITY_M_S2
from twin.service.monitor.board import Board
from twin.service.monitor.margins import margins

DIM, GOOD, WARN, BAD = "grey62", "green3", "yellow1", "bold bright_red"
LEVELS = {"INFO": "", "WARN": WARN, "ERROR": BAD}
NEAR, NEARER = 0.7, 0.9  # of a limit
DRIFTED = 3.0  # standard deviations beyond which a drift is marked
NAMES = {
    "drive_disp_m": "drive", "table_disp_m": "table disp", "table_acc_m_s2": "table acc",
    "mass_disp_m": "mass disp", "mass_acc_m_s2": "mass acc", "rel_disp_m": "u rel",
    "force_r1_n": "force R1", "force_r2_n": "force R2",
    "force_l1_n": "force L1", "force_l2_n": "force L2", "damper_force_n": "damper",
    "stiffness": "stiffness", "damping": "damping", "gap_r": "gap R", "gap_l": "gap L",
    "bumper_stiffness_r": "bumper R", "bumper_stiffness_l": "bumper L",
}  # fmt: skip
PARAMETER_UNITS = {
    "stiffness": ("kN/m", 1e3), "damping": ("kNs/m", 1e3), "gap_r": ("mm", 1e-3),
    "gap_l": ("mm", 1e-3), "bumper_stiffness_r": ("kN/m", 1e3), "bumper_stiffness_l": ("kN/m", 1e3),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class About:
    """What no record tells: who is connected, since when nothing is heard, what a person asks."""

    components: frozenset[str] = frozenset()
    silent_s: float = 0.0
    commands: bool = False  # whether this person may give orders
    asked: str = ""  # an order that waits to be confirmed


def number(value: float | None) -> str:
    """At most six characters: a dash where it is not known."""
    if value is None or not math.isfinite(value):
        return "–"
    size = abs(value)
    if size >= 1e6:
        return f"{value:.0e}"
    return f"{value:.{0 if size >= 1000 else 1 if size >= 100 else 2 if size >= 10 else 3}f}"


def percent(share: float) -> str:
    """A share in percent, at most five characters and the sign."""
    size = 100.0 * share
    return f"{size:.{0 if abs(size) >= 9.95 else 1}f} %" if math.isfinite(size) else "–"


def channel(name: str) -> tuple[str, str, float]:
    """(name for people, unit, what it is in SI) of a channel."""
    short = NAMES.get(name, name[:10])
    for end, unit, size in (("_m_s2", "m/s²", 1.0), ("_m", "mm", 1e-3), ("_n", "N", 1.0)):
        if name.endswith(end):
            return short, unit, size
    return short, "", 1.0


def level(board: Board, width: int, height: int) -> list[Text]:
    """Level against demand: as it is now, and as it was last looked at for a correction."""
    step, look = board.step, board.last(Level)
    if step is None:
        return [Text("no step under way", DIM)]
    demanded = step.acceleration_m_s2
    now = board.recent.level(step.frequency_hz)
    lines = [Text(f"demanded  {demanded / GRAVITY_M_S2:8.4f} g"), Text("now       ")]
    if now is None:
        lines[1].append("       –  not held yet", DIM)
    else:
        off = now / demanded - 1.0
        tolerance = board.profile.control.tolerance if board.profile else 0.02
        lines[1].append(f"{now / GRAVITY_M_S2:8.4f} g")
        lines[1].append(f"  {100 * off:+.2f} %", GOOD if abs(off) <= tolerance else WARN)
    if look is not None and look.step == step.index:
        lines[0].append(f"  command × {look.correction:.3f}", DIM)
        thd = math.hypot(*look.harmonics_m_s2) / (look.measured_m_s2 or math.nan)
        done = "accepted" if look.accepted else "being tuned"
        lines.append(Text(f"{done}, corrected {look.update} ×, thd {percent(thd)}", DIM))
    return lines


def limits(board: Board, width: int, height: int) -> list[Text]:
    """Peaks of the last second as bars of what is allowed; the tightest where not all have room."""
    if board.rig is None or board.profile is None or board.start is None:
        return [Text("waits for the machine card", DIM)]
    rows = margins(board.rig, board.profile, board.start.tare, board.recent)
    tightest = sorted(rows, key=lambda row: -row.share if math.isfinite(row.share) else -math.inf)
    lines = []
    for row in (row for row in rows if row in tightest[:height]):
        known = math.isfinite(row.share)
        style = BAD if not known or row.share > NEARER else WARN if row.share > NEAR else GOOD
        peak, share = number(row.peak) if known else "lost", percent(row.share)
        text = f" {peak:>6}/{row.limit:<4.4g} {row.unit:<4} "
        wide = max(width - 11 - len(text) - max(len(share), 5), 1)
        line = Text(f"{NAMES.get(row.name, row.name[:10]):<10} ")
        line.append_text(bar(min(row.share, 1.0) if known else 0.0, wide, style)).append(text)
        lines.append(line.append(f"{share:>5}", style))
    return lines or [Text("waits for the first samples", DIM)]


def bar(share: float, width: int, style: str) -> Text:
    """A bar `width` cells long of which `share` is filled."""
    filled = round(share * width)
    return Text("━" * filled, style).append("─" * (width - filled), "grey35")


def twin(board: Board, width: int, height: int) -> list[Text]:
    """Measured against twin per channel: rms of a second, error of the restarted twin, its band."""
    errors, agreement = board.recent.errors(), board.last(Agreement)
    told: dict[str, tuple[float, float]] = {}
    if agreement is not None:
        told = {
            name: (agreement.error[k], agreement.band[k])
            for k, name in enumerate(agreement.channels)
        }
    wide = width >= 52
    head = f"{'':<10}{'rms':>7}{'error':>7}{'band':>7}"
    if wide:
        head += f"{'':>6}{'of band' if told else 'of rms':>9}{'free':>8}"
    lines = [Text(head, DIM)]
    for name in dict.fromkeys((*errors, *told)):
        short, unit, size = channel(name)
        rms, window, free = errors.get(name, (math.nan,) * 3)
        error, band = told.get(name, (window, math.nan))
        beyond = math.isfinite(band) and error > band
        line = Text(f"{short:<10}{number(rms / size):>7}")
        line.append(f"{number(error / size):>7}", BAD if beyond else "")
        line.append(f"{number(band / size):>7}", DIM).append(f" {unit:<4}", DIM)
        if wide:
            share = error / ((band if told else rms) or math.nan)
            line.append(f"{percent(share):>8}", DIM).append(f"{number(free / size):>8}", DIM)
        line.append(" ◀" if beyond else "  ", BAD)
        lines.append(line)
    return lines[:height] if len(lines) > 1 else [Text("nothing compared yet", DIM)]


def phases(board: Board, width: int, height: int) -> list[Text]:
    """Error of the restarted twin over the last cycle: in flight, in contact on either side."""
    agreement = board.last(Agreement)
    if agreement is None:
        return [Text("no cycle compared yet", DIM)]
    lines = [Text(f"{'':<10}{'flight':>8}{'right':>8}{'left':>8}", DIM)]
    for k, name in enumerate(agreement.channels):
        short, unit, size = channel(name)
        parts = (agreement.flight[k], agreement.right[k], agreement.left[k])
        numbers = "".join(f"{number(one / size):>8}" for one in parts)
        lines.append(Text(f"{short:<10}{numbers}").append(f" {unit}", DIM))
    return lines[:height]


def impacts(board: Board, width: int, height: int) -> list[Text]:
    """The last cycle and the last point, measured and twin."""
    cycle = board.last(Cycle)
    point = board.points[max(board.points)] if board.points else None
    lines = [Text(f"{'':<9}{'R':>3}{'L':>3}{'u peak':>10}{'η_d':>7}{'η_a':>7}", DIM)]
    for who in ("measured", "twin"):
        one: Extremes | None = getattr(cycle, who) if cycle else None
        eta: Quantities | None = getattr(point, who) if point else None
        right, left = (str(len(one.onsets_r)), str(len(one.onsets_l))) if one else ("–", "–")
        peak = number(1e3 * max(one.u_max, -one.u_min)) if one else "–"
        text = f"{who:<9}{right:>3}{left:>3}{peak:>7} mm"
        text += f"{number(eta.eta_d if eta else None):>7}{number(eta.eta_a if eta else None):>7}"
        lines.append(Text(text, "" if who == "measured" else DIM))
    return lines


def specimen(board: Board, width: int, height: int) -> list[Text]:
    """The next jump ahead, and the parameters as identified; what has drifted comes first."""
    found = board.last(Estimate)
    drifted: list[Text] = []
    steady = [_jump(board.last(Ahead))]
    for name, value, sd, drift, drift_sd in zip(
        *((found.names, found.values, found.sd, found.drift, found.drift_sd) if found else ()),
        strict=True,
    ):
        unit, size = PARAMETER_UNITS.get(name, ("", 1.0))
        line = Text(f"{NAMES.get(name, name[:9]):<9} ")
        line.append(f"{number(value / size):>6}±{number(sd / size):<5} {unit:<5}")
        off = abs(drift) > DRIFTED * drift_sd
        share, share_sd = (100.0 * one / (abs(value) or math.nan) for one in (drift, drift_sd))
        digits = 1 if abs(share) < 10 else 0
        if math.isfinite(drift_sd):  # only what a trend was looked for in has one
            line.append(f" {share:+.{digits}f}±{share_sd:.{digits}f} %", WARN if off else DIM)
        (drifted if off else steady).append(line)
    return [*drifted, *steady][:height]


def _jump(ahead: Ahead | None) -> Text:
    if ahead is None:
        return Text("no jump foreseen yet", DIM)
    if not ahead.kind:
        return Text("no jump ahead on this branch", DIM)
    near = ahead.low_hz <= ahead.frequency_hz <= ahead.high_hz
    text = (
        f"jump {ahead.kind} at {ahead.jump_hz:.3f} Hz ({ahead.low_hz:.2f} to {ahead.high_hz:.2f})"
    )
    return Text(text, WARN if near else "")


def news(board: Board, width: int, height: int) -> list[Text]:
    """Warnings and events, the newest first, each with its time; long ones go on below."""
    lines: list[Text] = []
    for one in sorted(reversed(board.news.values()), key=lambda one: -one.index):  # noqa: C414
        at = f"{clock(one.index / board.rate_hz):>7} "
        for number_of, part in enumerate(_folded(one.text, width - len(at))):
            lines.append(
                Text(" " * len(at) if number_of else at, DIM).append(part, LEVELS[one.level])
            )
        if len(lines) >= height:
            break
    return lines[:height] or [Text("nothing has happened yet", DIM)]


def _folded(text: str, width: int) -> list[str]:
    """The text in lines of at most `width` characters, broken between words where possible."""
    return textwrap.wrap(text, max(width, 1)) or [""]


def clock(seconds: float) -> str:
    """Hours, minutes and seconds, as 0:01:02."""
    whole = max(int(seconds), 0)
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"


def timing(board: Board, width: int, height: int) -> list[Text]:
    """How punctual each component is, and what is missing."""
    lines = [Text(f"{'':<9}{'p50':>7}{'p99':>8}{'max':>8}{'missed':>7}", DIM)]
    for one in sorted(board.timings.values(), key=lambda one: one.component):
        text = f"{one.component[:9]:<9}{number(one.p50_ms):>7}{number(one.p99_ms):>8}"
        line = Text(f"{text}{number(one.max_ms):>8}")
        lines.append(line.append(f"{one.missed:>7}", WARN if one.missed else ""))
    return lines[:height] if len(lines) > 1 else [Text("no component has told", DIM)]


def gaps(board: Board) -> Text:
    """What of the recording is no true measurement."""
    lost = sum(count for _, count in board.gaps.values())
    if not lost:
        return Text("0 gaps", GOOD)
    names = ", ".join(sorted({channel(name)[0] if name else "all" for name, _ in board.gaps}))
    return Text(f"gaps: {lost} samples, {names}", BAD)


def punctual(board: Board, width: int) -> Text:
    """The latencies in one line, p99 in ms: of each component, or the worst where that is long."""
    if not board.timings:
        return Text("no latencies told", DIM)
    told = sorted((one.component, one.p99_ms) for one in board.timings.values())
    missed = sum(one.missed for one in board.timings.values())
    words = "  ".join(f"{who} {p99:.1f}" for who, p99 in told)
    end = f" ms  {missed} missed"
    if len(words) + len(end) + 5 > width:
        words = f"{max(p99 for _, p99 in told):.1f}"
    return Text("p99  ", DIM).append(words, "default").append(end, WARN if missed else GOOD)


def connected(board: Board, about: About, width: int) -> Text:
    """Who is there, one word each, with how often where more than once."""
    names = Counter(shown(one, board.run) for one in about.components)
    words = [f"{name}×{count}" if count > 1 else name for name, count in sorted(names.items())]
    there = len(words)
    while there and len("  ".join(words[:there])) > width - 4:
        there -= 1
    more = f" +{len(words) - there}" if there < len(words) else ""
    return Text(("  ".join(words[:there]) or "nobody") + more)


def shown(component: str, run: str) -> str:
    """A component's name for people: a process of this run, or who watches it with what."""
    if component.startswith(f"{run}."):
        return component.removeprefix(f"{run}.")
    parts = component.split(".")
    if parts[0] != "observer" or len(parts) < 3:
        return component
    return f"{parts[-1].partition('-')[0]}:{'.'.join(parts[1:-1])}"
