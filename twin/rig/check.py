"""`check PROFILE`: the plan with its margins, and the predicted sensor peaks."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from table_io.adaptive.policy import describe_adaptive_test
from table_io.backends import open_backend
from table_io.block import Label
from table_io.clock import ManualClock
from table_io.config.excitation import history_acceleration
from table_io.config.excitation.continuation import Continuation
from table_io.config.excitation.record import RecordedHistory
from table_io.config.excitation.stepped_sine import Sweep
from table_io.config.excitation.swept_sine import SweptSine
from table_io.config.profile import Profile
from table_io.excitation.drive import Drive, HistorySegment
from table_io.safety.loop_check import find_friction_level, plan_targets
from table_io.safety.preflight import (
    CORRECTION_HEADROOM,
    RigLimit,
    StepDemand,
    list_limits,
)
from table_io.units import GRAVITY_M_S2
from twin.results.tracking import find_band, find_record_error
from twin.rig.predicted_ranges import PredictedPeak, format_clipping_warnings, predict_response
from twin.setup.disk import planned_bytes
from twin.setup.folders import make_output_folder
from twin.setup.run_config import RunConfig, list_test_warnings, make_run_id, read_run_config
from twin.system.terminal import console, print_line, print_table

MAX_FILTER_ERROR = 0.02  # rms, of a record by the filter of its profile, in the judged band
MAX_STEP_ROWS = 12  # frequencies in the table of steps


@dataclass(frozen=True, eq=False)
class CheckedTest:
    """Test that nothing prevents: its configuration, predicted peaks of its sensors, warnings.

    `config.margins` are the demands of each step on the rig.
    """

    config: RunConfig
    peaks: tuple[PredictedPeak, ...]
    warnings: tuple[str, ...]


def check_test(
    profile: str | Path, table: str | Path | None = None, model: str | Path | None = None
) -> CheckedTest:
    """Check a test before anything moves, as `run` does, on the rig of its profile or `table`.

    InputError for a faulty file, and if the test exceeds a limit of the rig.
    """
    names = (None if name is None else str(name) for name in (table, model))
    return check_config(read_run_config(Path(profile), *names))


def check_config(config: RunConfig) -> CheckedTest:
    """Predict the response of a test; return it with all that is doubtful about the test."""
    predicted = predict_response(config)
    warnings = (
        *list_test_warnings(config),
        *_list_filter_warnings(config.profile),
        *format_clipping_warnings(predicted.peaks, config.rig),
        *predicted.range_exits,
    )
    return CheckedTest(config, predicted.peaks, warnings)


def _list_filter_warnings(profile: Profile) -> list[str]:
    """Return a warning if the filter of a record reaches into the band in which it is judged."""
    excitation, rate_hz = profile.excitation, profile.acquisition.rate_hz
    if not isinstance(excitation, RecordedHistory) or excitation.applied_band_hz is None:
        return []
    record = excitation.record_acceleration(rate_hz)
    if record is None:
        return []
    target = history_acceleration(excitation.target(rate_hz), rate_hz)
    band_hz = profile.tracking.band_hz or find_band(target, rate_hz)
    error = find_record_error(record, target, target, rate_hz, band_hz)
    if not error > MAX_FILTER_ERROR:
        return []
    low_hz, high_hz = excitation.applied_band_hz
    return [
        f"the filter of the record, {low_hz:.3g} to {high_hz:.3g} Hz, changes it by "
        f"{100 * error:.2g} % rms in the band in which the table is judged, {band_hz[0]:.3g} to "
        f"{band_hz[1]:.3g} Hz: widen excitation.band_hz, or narrow tracking.band_hz"
    ]


def print_check(profile: Path, table: str | None, out: Path | None) -> None:
    """Check a test; print the plan and its margins; draw the drive if `out` is given."""
    checked = check_test(profile, table)
    print_plan(console, checked)
    if out is not None:
        folder = make_output_folder(out, make_run_id(checked.config.name))
        from twin.rig.drive_figure import draw_drive  # loads what draws

        print_line(f"drive drawn: {draw_drive(checked.config, folder / 'drive.png')}")


def print_plan(console: Console, checked: CheckedTest) -> None:
    """Print the plan of a test: steps, duration, buffer, and margins to the rig's limits."""
    config = checked.config
    console.print(config.profile.title, style="bold", highlight=False)
    for name, text in _plan_lines(config):
        console.print(f"  {name:<11}{text}", highlight=False, soft_wrap=True)
    print_table(console, _make_steps_table(config))
    print_table(console, _make_sensors_table(checked.peaks))
    for sentence in checked.warnings:
        console.print(f"warning: {sentence}", highlight=False, soft_wrap=True)
    console.print("ready: nothing exceeds the limits of the rig file", highlight=False)


def _plan_lines(config: RunConfig) -> list[tuple[str, str]]:
    """Return (name, text) of each line above the tables."""
    profile, rig = config.profile, config.rig
    rate = config.drive.rate_hz
    right, left = (f"{gap * 1e3:g} mm" for gap in profile.specimen.gaps_m)
    bumpers = f"gap right {right}, left {left}" if "inf mm" not in (right, left) else "no bumpers"
    replace_after = 0  # with an external controller
    if not rig.under_external_control:
        replace_after = open_backend(rig, profile, ManualClock()).replace_after
    block = profile.acquisition.block_samples
    lead = rig.output.lead_samples(rate, replace_after)
    check = "none"
    if profile.loop_check.enabled:
        targets = plan_targets(profile, rig)
        levels = sorted({f"{target.level_m_s2 / GRAVITY_M_S2:.3g}" for target in targets})
        check = (
            f"{', '.join(f'{target.frequency_hz:.3g}' for target in targets)} Hz at "
            f"{' to '.join(levels)} g, then {profile.loop_check.rest_s:g} s of rest"
        )
        level = profile.plan.level_m_s2
        share = max(target.level_m_s2 for target in targets) / level
        if find_friction_level(profile, rig) > profile.loop_check.level * level:
            least_g = rig.table_response.least_level_g
            check += (
                f"; at {100 * share:.0f} % of the level, not a tenth: below "
                f"table_response.least_level_g = {least_g:g} friction shapes what this table plays"
            )
    return [
        ("specimen", f"{profile.specimen.mass_kg:g} kg, {bumpers}"),
        *_excitation_lines(config),
        *_limit_lines(profile),
        ("loop check", check),
        ("duration", _format_duration(config)),
        (
            "buffer",
            f"{lead / rate:g} s of command queued ahead, {lead / block:.3g} blocks of {block} "
            f"samples; {1e3 * replace_after / rate:g} ms of it can no longer be changed",
        ),
        ("sampling", f"{rate:g} Hz"),
        ("recording", f"at most {planned_bytes(config) / 1e6:.0f} MB"),
        ("table", rig.title),
    ]


def _excitation_lines(config: RunConfig) -> list[tuple[str, str]]:
    profile = config.profile
    if profile.continuation is not None:
        peak_m_s2 = max(row.acceleration_m_s2 for row in config.margins if row.step >= 0)
        max_correction = config.rig.table_response.max_correction
        return _orbit_lines(profile.continuation, peak_m_s2 / GRAVITY_M_S2, max_correction)
    if profile.swept_sine is not None:
        return _swept_sine_lines(profile, profile.swept_sine)
    return _sweep_lines(profile) if profile.steps else _history_lines(profile)


def _swept_sine_lines(profile: Profile, config: SweptSine) -> list[tuple[str, str]]:
    crossover = config.crossover_hz
    level = f"{profile.plan.level_m_s2 / GRAVITY_M_S2:.4g} g peak"
    if crossover is not None:
        level += (
            f", {config.scale * (config.displacement_mm or 0.0):g} mm amplitude below the "
            f"crossover at {crossover:.3g} Hz"
        )
    measured = f"the {config.strategy} of " if len(config.control_channels) > 1 else ""
    dwell = (
        f", then {config.dwell_s:g} s at each resonance of {config.response_channel} above "
        f"{config.min_amplification:g} times the level"
        if config.dwell_s
        else ""
    )
    protection = profile.protection
    return [
        (
            "swept sine",
            f"{config.start_hz:g} to {config.stop_hz:g} Hz, {config.octaves_per_min:g} octaves a "
            f"minute, {config.passes} passes ({' then '.join(config.directions)}){dwell}",
        ),
        (
            "level",
            f"{level}, on {measured}{', '.join(config.control_channels)}; alarm at "
            f"+-{100 * protection.alarm:g} %, stop at +-{protection.abort_db:g} dB",
        ),
    ]


def _limit_lines(profile: Profile) -> list[tuple[str, str]]:
    """Return a line with the limits of the test on its channels, if it has some."""
    texts = [
        f"{entry.channel} at {entry.limit:g} {entry.unit or 'SI'}: {entry.action}"
        for entry in profile.limits
    ]
    return [("limits", "; ".join(texts))] if texts else []


def _orbit_lines(
    config: Continuation, peak_g: float, max_correction: float
) -> list[tuple[str, str]]:
    plan = config.orbit_plan
    orbits = plan.points
    unstable = [orbit for orbit in orbits if not orbit.stable]
    place = "in phase resonance" if plan.condition == "phase" else "along one branch"
    levels_g = [orbit.acceleration_m_s2 / GRAVITY_M_S2 for orbit in orbits]
    extent = f"{min(levels_g):.4g} to " if min(levels_g) < max(levels_g) else ""
    return [
        (
            "orbits",
            f"{len(orbits)} {place}, {len(unstable)} of them unstable, "
            f"{min(orbit.frequency_hz for orbit in orbits):.5g} to "
            f"{max(orbit.frequency_hz for orbit in orbits):.5g} Hz, each held by feedback",
        ),
        (
            "feedback",
            f"at most {100 * config.max_feedback:g} % of the amplitude of the command, which "
            f"stays below {peak_g / max(levels_g):.4g} of its largest level with it, stops "
            f"included: {peak_g:.4g} g for a table with a gain of 1, "
            f"{peak_g * max_correction:.4g} g with the largest correction of its gain, "
            f"{max_correction:.3g}; planned for a latency of "
            f"{1e3 * plan.latency_s:.3g} ms and {1e3 * plan.jitter_s:.3g} ms of jitter",
        ),
        ("level", f"{extent}{max(levels_g):.4g} g peak table acceleration"),
    ]


def _sweep_lines(profile: Profile) -> list[tuple[str, str]]:
    sweep = profile.sweep
    then = describe_adaptive_test(profile)
    return [
        (
            "sweep",
            f"{sweep.start_hz:g} to {sweep.stop_hz:g} Hz by {sweep.step_hz:g}, "
            f"{' then '.join(sweep.directions)}, {sweep.cycles} cycles a step, "
            f"the last {sweep.measured_cycles} measured",
        ),
        *([("then", then)] if then else []),
        ("level", _describe_level(sweep)),
    ]


def _describe_level(sweep: Sweep) -> str:
    text = f"{sweep.acceleration_g:g} g peak table acceleration"
    if sweep.level_points:
        points = ", ".join(f"{level:g} g at {f:g} Hz" for f, level in sweep.level_points)
        text = f"peak table acceleration {points}"
    if sweep.schedule_db:
        text += f"; whole sweeps at {', '.join(f'{level:g}' for level in sweep.schedule_db)} dB"
    return text


def _history_lines(profile: Profile) -> list[tuple[str, str]]:
    plan = profile.plan
    rate_hz = profile.acquisition.rate_hz
    seconds = plan.target_m.size / rate_hz
    displacement_mm = 1e3 * float(np.abs(plan.target_m).max())
    velocity_mm_s = 1e3 * float(np.abs(np.diff(plan.target_m)).max()) * rate_hz
    source = profile.excitation
    return [
        *(_record_lines(source) if isinstance(source, RecordedHistory) else ()),
        (
            profile.excitation.kind,
            f"a displacement history of {seconds:.1f} s, {plan.low_hz:.3g} to {plan.high_hz:.3g} "
            f"Hz, results in {plan.windows} windows of {seconds / plan.windows:.3g} s",
        ),
        (
            "level",
            f"{plan.level_m_s2 / GRAVITY_M_S2:.3g} g peak table acceleration, open loop: no "
            "amplitude is tuned, only the checks of every sample protect it",
        ),
        (
            "target",
            f"peak {plan.level_m_s2 / GRAVITY_M_S2:.4g} g, {velocity_mm_s:.4g} mm/s, "
            f"{displacement_mm:.4g} mm",
        ),
    ]


def _record_lines(record: RecordedHistory) -> list[tuple[str, str]]:
    """Return the lines that identify a record: its file, peak and checksum, and its scaling."""
    series = record.series
    peak = float(np.abs(series.values).max())
    amount = (
        f"{peak / GRAVITY_M_S2:.4g} g"
        if series.quantity == "acceleration"
        else f"{1e3 * peak:.4g} mm"
    )
    similitude = (
        f", length {record.length_ratio:g}, acceleration {record.acceleration_ratio:g}, "
        f"time {record.time_ratio:.4g}"
        if (record.length_ratio, record.acceleration_ratio) != (1.0, 1.0)
        else ""
    )
    band_hz = record.applied_band_hz
    band = "" if band_hz is None else f", band {band_hz[0]:g} to {band_hz[1]:g} Hz"
    return [
        (
            "file",
            f"{record.file}: {series.quantity}, {series.values.size} samples at "
            f"{series.rate_hz:.6g} Hz, peak {amount}",
        ),
        ("SHA-256", record.checksum),
        ("scale", f"{record.scale:g}{similitude}{band}"),
    ]


def _format_duration(config: RunConfig) -> str:
    """Format the duration, in total and by part, if no level needs a second correction.

    For an adaptive test it is a lower bound: what follows the sweep is decided during the test.
    """
    drive = config.drive
    parts = sum_durations_s(drive)
    text = ", ".join(
        f"{name} {_format_time(seconds)}" for name, seconds in parts.items() if seconds
    )
    total = _format_time(config.expected_s)
    prefix = "at least " if describe_adaptive_test(config.profile) else ""
    return f"{prefix}{total} for {config.extent}: {text}"


def sum_durations_s(drive: Drive) -> dict[str, float]:
    """Return the duration in s of each part: loop check, held cycles, ..., rest."""
    parts = dict.fromkeys(("loop check", "held cycles", "tuning", "blends"), 0.0)
    for segment in drive.segments:
        if isinstance(segment, HistorySegment):
            part = "history"
        elif segment.step < 0:
            part = "loop check"
        elif segment.cycles:
            part = "held cycles"
        elif segment.label == Label.MEASURE:
            part = "sweep"
        else:
            part = "blends" if segment.label == Label.BLEND else "tuning"
        parts[part] = parts.get(part, 0.0) + segment.count / drive.rate_hz
    return parts | {"rest": drive.planned_end / drive.rate_hz - sum(parts.values())}


def _format_time(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes else f"{seconds:.1f} s"


def _make_steps_table(config: RunConfig) -> Table:
    """Make the table of demands on the rig, at the loop check and at selected frequencies.

    "used" is the largest share of any limit, the last column that of the stroke after a correction.
    """
    limits = list_limits(config.rig)
    all_rows = [row for row in config.margins if row.step >= 0]
    all_rows = find_worst_rows(all_rows) if config.steps else all_rows
    rows = select_rows(all_rows, limits) if config.steps else all_rows
    title = "peaks of the drive, blends included"
    if len(rows) < len(all_rows):
        title += f": {len(rows)} of {len(all_rows)} frequencies"
    table = Table(title=title, box=SIMPLE_HEAD, title_justify="left")
    headers = (
        "Hz" if config.steps else "",
        *(limit.unit for limit in limits),
        "DAC steps",
        "used",
        f"+{100 * (CORRECTION_HEADROOM - 1):.0f} %",
    )
    for header in headers:
        table.add_column(header, justify="right", no_wrap=True)
    check_rows = [row for row in config.margins if row.step < 0]
    for row in (*check_rows, *rows):
        used = [limit.demand(row) / limit.allowed for limit in limits]
        table.add_row(
            _format_row_name(row),
            *(f"{limit.demand(row):.4g}" for limit in limits),
            f"{row.amplitude_lsb:.0f}",
            _format_percent(max(used)),
            _format_percent(CORRECTION_HEADROOM * used[0]),
            end_section=bool(check_rows) and row is check_rows[-1],
        )
    table.add_section()
    output = config.rig.output
    table.add_row("allowed", *(f"{limit.allowed:g}" for limit in limits), f">= {output.least_lsb}")
    max_shares = [max(map(limit.demand, all_rows)) / limit.allowed for limit in limits]
    table.add_row(
        "used",
        *map(_format_percent, max_shares),
        "",
        _format_percent(max(max_shares)),
        _format_percent(CORRECTION_HEADROOM * max_shares[0]),
    )
    return table


def _format_row_name(row: StepDemand) -> str:
    if row.step < 0:
        return f"check {row.frequency_hz:.3g}"
    return row.direction if math.isnan(row.frequency_hz) else f"{row.frequency_hz:g}"


def _format_percent(share: float) -> str:
    return f"{100 * share:.0f} %"


def find_worst_rows(rows: list[StepDemand]) -> list[StepDemand]:
    """Return one row per frequency, ascending: the largest demands of its steps."""
    worst: dict[float, StepDemand] = {}
    for row in rows:
        other = worst.get(row.frequency_hz)
        worst[row.frequency_hz] = row if other is None else _max_demands(row, other)
    return [worst[f] for f in sorted(worst)]


def _max_demands(row: StepDemand, other: StepDemand) -> StepDemand:
    """Return a row with the larger of each demand of two rows."""
    names = ("displacement_m", "velocity_m_s", "acceleration_m_s2", "force_n")
    return replace(row, **{name: max(getattr(row, name), getattr(other, name)) for name in names})


def select_rows(rows: list[StepDemand], limits: tuple[RigLimit, ...]) -> list[StepDemand]:
    """Select about `MAX_STEP_ROWS` rows, logarithmically spaced, with the worst of each limit."""
    if len(rows) <= MAX_STEP_ROWS:
        return rows
    first, last = rows[0].frequency_hz, rows[-1].frequency_hz
    targets_hz = [first * (last / first) ** (k / (MAX_STEP_ROWS - 1)) for k in range(MAX_STEP_ROWS)]
    nearest = [min(rows, key=lambda row: abs(math.log(row.frequency_hz / f))) for f in targets_hz]
    worst = [max(rows, key=limit.demand) for limit in limits]
    kept_hz = {row.frequency_hz for row in (*nearest, *worst)}
    return [row for row in rows if row.frequency_hz in kept_hz]


def _make_sensors_table(rows: tuple[PredictedPeak, ...]) -> Table:
    """Make the table of the peaks that the model predicts for each sensor."""
    title = "sensors, as the model foresees them"
    table = Table(title=title, box=SIMPLE_HEAD, title_justify="left")
    for header in ("sensor", "most", "at", "range", "used"):
        table.add_column(header, justify="left" if header in ("sensor", "at") else "right")
    for row in rows:
        table.add_row(
            row.sensor.channel,
            f"{row.peak:.4g} {row.sensor.unit}",
            row.place if row.peak else "",
            f"{row.sensor.range:g} {row.sensor.unit}",
            _format_percent(row.range_share),
        )
    return table
