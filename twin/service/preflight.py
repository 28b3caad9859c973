"""What `check` prints: the plan with its margins, and what the sensors should see."""

import math
from dataclasses import replace

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from table_io.backends import open_backend
from table_io.block import Label
from table_io.clock import ManualClock, today
from table_io.drive import Drive
from table_io.due import overdue
from table_io.limits import ROOM, Limit, Margin, doubts, limits_of, warnings
from table_io.loop_check import aims
from table_io.policies import words_of
from table_io.units import GRAVITY_M_S2
from twin.service.bundle import Bundle
from twin.service.disk import planned_bytes
from twin.service.drive_figure import draw_drive
from twin.service.foreseen import Foreseen, clipped, foreseen
from twin.service.terminal import print_table

__all__ = ["draw_drive", "print_plan"]

ROWS = 12  # frequencies in the table of steps


def print_plan(console: Console, bundle: Bundle) -> None:
    """The plan of a test: steps, duration, buffer, and margins against the machine card."""
    console.print(f"[bold]{bundle.profile.title}[/bold]", highlight=False)
    for name, text in _plan(bundle):
        console.print(f"  {name:<11}{text}", highlight=False, soft_wrap=True)
    sensors = foreseen(bundle)
    print_table(console, _steps(bundle))
    print_table(console, _sensors(bundle, sensors))
    said = [
        *warnings(bundle.margins, bundle.rig),
        *doubts(bundle.profile, bundle.rig),
        *clipped(sensors, bundle.rig),
        *overdue(bundle.rig, today().date()),
    ]
    for sentence in said:
        console.print(f"warning: {sentence}", highlight=False, soft_wrap=True)
    console.print("ready: nothing exceeds the machine card", highlight=False)


def _plan(bundle: Bundle) -> list[tuple[str, str]]:
    """(name, text) of each line above the tables."""
    profile, rig = bundle.profile, bundle.rig
    sweep, rate = profile.sweep, bundle.drive.rate_hz
    right, left = (f"{gap * 1e3:g} mm" for gap in profile.specimen.gaps_m)
    bumpers = f"gap right {right}, left {left}" if "inf mm" not in (right, left) else "no bumpers"
    replace_after = 0  # of a controller that is only followed
    if rig.backend != "follow":
        replace_after = open_backend(rig, profile, ManualClock()).replace_after
    block = profile.acquisition.block_samples
    lead = replace_after + round(rig.output.lead_s * rate)
    check = "none"
    if profile.loop_check.enabled:
        motions = aims(profile, rig)
        levels = sorted({f"{aim.level_m_s2 / GRAVITY_M_S2:.3g}" for aim in motions})
        check = (
            f"{', '.join(f'{aim.frequency_hz:.3g}' for aim in motions)} Hz at "
            f"{' to '.join(levels)} g, then {profile.loop_check.rest_s:g} s of rest"
        )
    return [
        ("specimen", f"{profile.specimen.mass_kg:g} kg, {bumpers}"),
        (
            "sweep",
            f"{sweep.start_hz:g} to {sweep.stop_hz:g} Hz by {sweep.step_hz:g}, "
            f"{' then '.join(sweep.directions)}, {sweep.cycles} cycles a step, "
            f"the last {sweep.measured_cycles} measured",
        ),
        *([("then", words_of(profile))] if words_of(profile) else []),
        ("level", f"{sweep.acceleration_g:g} g peak table acceleration"),
        ("loop check", check),
        ("duration", _duration(bundle)),
        (
            "buffer",
            f"{lead / rate:g} s of command queued ahead, {lead / block:.3g} blocks of {block} "
            f"samples; {1e3 * replace_after / rate:g} ms of it can no longer be changed",
        ),
        ("sampling", f"{rate:g} Hz"),
        ("recording", f"at most {planned_bytes(bundle) / 1e6:.0f} MB"),
        ("table", rig.title),
    ]


def _duration(bundle: Bundle) -> str:
    """How long the test lasts if no level needs a second look, and what takes how much of it.

    A test that finds its way lasts longer: what follows its sweep only the test tells.
    """
    drive = bundle.drive
    parts = parts_s(drive)
    text = ", ".join(f"{name} {_time(seconds)}" for name, seconds in parts.items() if seconds)
    whole = _time(drive.planned_end / drive.rate_hz)
    least = "at least " if words_of(bundle.profile) else ""
    return f"{least}{whole} for {len(bundle.steps)} steps: {text}"


def parts_s(drive: Drive) -> dict[str, float]:
    """Seconds of a drive: loop check, held cycles, tuning, blends, rest."""
    parts = dict.fromkeys(("loop check", "held cycles", "tuning", "blends"), 0.0)
    for segment in drive.segments:
        if segment.step < 0:
            part = "loop check"
        elif segment.cycles:
            part = "held cycles"
        else:
            part = "blends" if segment.label == Label.BLEND else "tuning"
        parts[part] += segment.count / drive.rate_hz
    return parts | {"rest": drive.planned_end / drive.rate_hz - sum(parts.values())}


def _time(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes else f"{seconds:.1f} s"


def _steps(bundle: Bundle) -> Table:
    """What the drive asks of the table at the loop check and at chosen frequencies.

    "used" is the largest share of any limit, the last column that of the stroke after a correction.
    """
    limits = limits_of(bundle.rig)
    every = by_frequency([row for row in bundle.margins if row.step >= 0])
    rows = chosen(every, limits)
    title = "peaks of the drive, blends included"
    if len(rows) < len(every):
        title += f": {len(rows)} of {len(every)} frequencies"
    table = Table(title=title, box=SIMPLE_HEAD, title_justify="left")
    heads = (
        "Hz",
        *(limit.unit for limit in limits),
        "DAC steps",
        "used",
        f"+{100 * (ROOM - 1):.0f} %",
    )
    for head in heads:
        table.add_column(head, justify="right", no_wrap=True)
    check = [row for row in bundle.margins if row.step < 0]
    for row in (*check, *rows):
        used = [limit.used(row) / limit.allowed for limit in limits]
        table.add_row(
            f"check {row.frequency_hz:.3g}" if row.step < 0 else f"{row.frequency_hz:g}",
            *(f"{limit.used(row):.4g}" for limit in limits),
            f"{row.lsb:.0f}",
            _percent(max(used)),
            _percent(ROOM * used[0]),
            end_section=bool(check) and row is check[-1],
        )
    table.add_section()
    card = bundle.rig.output
    table.add_row("allowed", *(f"{limit.allowed:g}" for limit in limits), f">= {card.least_lsb}")
    most = [max(map(limit.used, every)) / limit.allowed for limit in limits]
    table.add_row("used", *map(_percent, most), "", _percent(max(most)), _percent(ROOM * most[0]))
    return table


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"


def by_frequency(rows: list[Margin]) -> list[Margin]:
    """One row a frequency, upwards: the most that any of its steps asks."""
    worst: dict[float, Margin] = {}
    for row in rows:
        other = worst.get(row.frequency_hz)
        worst[row.frequency_hz] = row if other is None else _larger(row, other)
    return [worst[f] for f in sorted(worst)]


def _larger(one: Margin, other: Margin) -> Margin:
    """The larger of each demand of two rows."""
    names = ("displacement_m", "velocity_m_s", "acceleration_m_s2", "force_n")
    return replace(one, **{name: max(getattr(one, name), getattr(other, name)) for name in names})


def chosen(rows: list[Margin], limits: tuple[Limit, ...]) -> list[Margin]:
    """At most ROWS and a few: the ends, the worst of each limit, and some in equal ratios."""
    if len(rows) <= ROWS:
        return rows
    first, last = rows[0].frequency_hz, rows[-1].frequency_hz
    wanted = [first * (last / first) ** (k / (ROWS - 1)) for k in range(ROWS)]
    near = [min(rows, key=lambda row: abs(math.log(row.frequency_hz / f))) for f in wanted]
    worst = [max(rows, key=limit.used) for limit in limits]
    keep = {row.frequency_hz for row in (*near, *worst)}
    return [row for row in rows if row.frequency_hz in keep]


def _sensors(bundle: Bundle, rows: tuple[Foreseen, ...]) -> Table:
    """What every sensor should see, by the model."""
    title = "sensors, as the model foresees them"
    table = Table(title=title, box=SIMPLE_HEAD, title_justify="left")
    for head in ("sensor", "most", "at", "range", "used"):
        table.add_column(head, justify="left" if head in ("sensor", "at") else "right")
    for row in rows:
        table.add_row(
            row.sensor.channel,
            f"{row.peak:.4g} {row.sensor.unit}",
            f"{row.frequency_hz:g} Hz {row.direction}" if row.peak else "",
            f"{row.sensor.range:g} {row.sensor.unit}",
            _percent(row.used),
        )
    return table
