"""Rerun view of a run: draws every block and record.

The drawing depends on the samples only, not on their division into blocks or batches.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from table_io.block import Block, Float1D, Float2D, Int1D, Label, join_contiguous
from table_io.channels import CHANNEL_BY_NAME
from table_io.config.base import parse_toml
from table_io.config.profile import Profile
from table_io.records import (
    LABEL_TEXTS,
    Agreement,
    Comparison,
    CycleExtremes,
    Estimate,
    Extremes,
    JumpForecast,
    Level,
    NormalizedResponse,
    OrbitPoint,
    PrcPoint,
    Record,
    RunStart,
    Timing,
    format_record,
)
from table_io.units import GRAVITY_M_S2
from twin.recording.reader import Recording
from twin.viewer.address import viewer_url
from twin.viewer.blueprint import log_static, make_blueprint
from twin.viewer.model_branches import FoldAhead, ModelBranches
from twin.viewer.motion import BlockMotion, extract_motion, extract_track
from twin.viewer.plots import (
    CHANNEL_LINES,
    FrequencyCurves,
    LineStyle,
    disagreement_style,
    drift_styles,
    forecast_lines,
)
from twin.viewer.scaled_plots import DAMPER_LOOP, PHASE_PLANE, PlanePlot, ReferenceLevels
from twin.viewer.scene import Scene
from twin.viewer.sink import RerunSink, escape_path_part
from twin.viewer.view_model import ParameterRow, TwinRow, list_drift_rows, list_twin_rows

BATCH_ITEMS = 1000  # items of a log per call of `feed`
LINE_RATE_HZ = 500  # of the lines over time, at most; all samples would be 25 MB a minute at 2 kHz
FRAME_RATE_HZ = 50  # of the moving rig
RATIO_SYMBOLS = (("eta_d", "η_d"), ("eta_a", "η_a"), ("eta_r", "η_R"), ("eta_l", "η_L"),
          ("r_r", "r_R"), ("r_l", "r_L"))  # fmt: skip


class RerunView:
    """View of one run, written to a new file, served at "127.0.0.1:PORT", or both."""

    def __init__(self, start: RunStart, *, save: Path | None = None, serve: str = "") -> None:
        if save is None and not serve:
            raise ValueError("a view needs a file to save to, an address to serve at, or both")
        profile = parse_toml(start.profile_toml, Profile, f"profile of run {start.run}")
        self._start = start
        self._scene = Scene.from_profile(profile)
        self._mass_kg = profile.specimen.mass_kg
        self._frame_stride = max(1, round(start.rate_hz / FRAME_RATE_HZ))
        self._line_stride = math.ceil(start.rate_hz / LINE_RATE_HZ)
        self._next_index: dict[str, int] = {}
        self._styled: set[str] = set()
        self._logged: set[tuple[int, str, str]] = set()
        self._sweep_position = SweepPosition()
        orbit_plan = profile.continuation.orbit_plan if profile.continuation else None
        self._curves = FrequencyCurves(profile.plan.low_hz, profile.plan.high_hz, orbit_plan)
        self._errors = RelativeError(start.rate_hz)
        self._sink = RerunSink(start, save, serve, make_blueprint(start, self._scene, bool(serve)))
        self.url = viewer_url(serve) if serve else ""
        log_static(self._sink, self._scene, self._mass_kg)
        self._levels = ReferenceLevels(self._sink, self._scene, start.rate_hz)
        self._phase = PlanePlot(self._sink, PHASE_PLANE, start.rate_hz, self._scene.gaps_m)
        has_damper = "damper_force_n" in start.channels
        self._loop = (
            PlanePlot(self._sink, DAMPER_LOOP, start.rate_hz, self._scene.gaps_m)
            if has_damper
            else None
        )
        self._draw_curves(0)
        self._branches = ModelBranches.from_start(start)
        if self._branches is not None:
            self._sink.send_coloured_strips("prc/data/branches", 0, self._branches.draw())
        self._fold: FoldAhead | None = None
        for entity in ("ahead", "warning"):
            self._sink.send_document(entity, 0, "none so far")

    def feed(self, items: Sequence[Block | Record]) -> None:
        """Draw a batch of items; call about every 100 ms in a live run."""
        for stream, draw in (("meas", self._draw_measured), ("pred", self._draw_predicted)):
            blocks = [item for item in items if isinstance(item, Block) and item.stream == stream]
            for block in join_contiguous(self._select_new(blocks)):
                draw(block)
        for item in items:
            if not isinstance(item, Block):
                self._draw_record(item)

    def _select_new(self, blocks: Sequence[Block]) -> Iterator[Block]:
        """Yield the blocks that are not drawn yet; blocks repeated by the bus are skipped."""
        for block in blocks:
            if block.index >= self._next_index.get(block.stream, 0):
                self._next_index[block.stream] = block.end
                yield block

    def close(self) -> None:
        """Finish the file and stop serving."""
        self._sink.close()

    def _send_lines(self, entity: str, index: Int1D, *columns: Float1D) -> None:
        """Send the lines of an entity, (sample,) each; a NaN at a lost sample interrupts them.

        Of `_line_stride` samples the first is drawn, as NaN if one of them is lost.
        """
        expected_index = self._next_index.get(entity, int(index[0]))
        is_interrupted = expected_index < index[0]
        self._next_index[entity] = int(index[-1]) + 1
        samples, drawn = np.stack(columns, axis=1), np.flatnonzero(index % self._line_stride == 0)
        values, index = samples[drawn], index[drawn]
        if drawn.size:
            values[np.logical_or.reduceat(np.isnan(samples), drawn)] = np.nan
        if is_interrupted:
            index = np.concatenate([[expected_index], index])
            values = np.concatenate([np.full((1, len(columns)), np.nan), values])
        self._sink.send_scalars(entity, index, values)

    def _draw_measured(self, block: Block) -> None:
        motion = extract_motion(block)
        self._send_lines("u/measured", motion.index, 1e3 * motion.u)
        self._send_lines("a/measured", motion.index, motion.acc, motion.table_acc)
        self._send_lines(
            "force/measured", motion.index, 1e-3 * motion.force_r, 1e-3 * motion.force_l
        )
        for name in block.channels:
            if name not in CHANNEL_BY_NAME:
                self._send_lines(
                    f"other/{escape_path_part(name)}", motion.index, block.channel(name)
                )
        frames = motion.select_frames(self._frame_stride)
        self._sink.send_boxes("rig/bodies", self._scene.body_boxes(frames))
        self._sink.send_boxes("rig/frame", self._scene.frame_boxes(frames))
        frames = motion.select_frames(5 * self._frame_stride)
        self._sink.send_caption_positions(
            "rig/names", frames.index, self._scene.caption_positions(frames)
        )
        self._draw_damper("measured", motion, motion.damper_force)
        self._phase.add("measured", motion)
        self._levels.add(motion)
        for index, step, label in self._sweep_position.add(block):
            self._sink.send_document("status", index, format_status(self._start, step, label))
            current_steps = self._start.steps[step : step + 1] if step >= 0 else ()
            marks = self._curves.axes.vertical_lines(
                current.frequency_hz for current in current_steps
            )
            self._sink.send_strips("prc/now", index, marks)

    def _draw_predicted(self, block: Block) -> None:
        free = extract_motion(extract_track(block, "free"))
        window = extract_motion(extract_track(block, "window"))
        self._send_lines("u/twin", window.index, 1e3 * free.u, 1e3 * window.u)
        self._send_lines("a/twin", window.index, free.acc, window.acc)
        self._send_lines("force/twin", window.index, 1e-3 * window.force_r, 1e-3 * window.force_l)
        frames = free.select_frames(self._frame_stride)
        self._sink.send_centres("rig/twin", frames.index, self._scene.mass_centres(frames))
        forces = [
            -self._mass_kg * motion.acc - motion.force_r - motion.force_l
            for motion in (free, window)
        ]
        self._draw_damper("twin", window, *forces[::-1])
        self._phase.add("twin", window)

    def _draw_damper(
        self, source: str, motion: BlockMotion, force_n: Float1D, *free_n: Float1D
    ) -> None:
        """Draw the damper force over time and over u if the rig measures it."""
        if self._loop is not None:
            self._send_lines(
                f"damper/{source}", motion.index, *(1e-3 * force for force in (*free_n, force_n))
            )
            self._loop.add(source, replace(motion, v=1e-6 * force_n))

    def _draw_record(self, item: Record) -> None:
        match item:
            case PrcPoint() | OrbitPoint():
                self._draw_point(item)
            case CycleExtremes():
                self._sink.send_scalars("impacts", [item.index], impact_counts(item))
                self._sink.send_document("cycle", item.index, format_cycle(item))
            case Comparison():
                if (share := self._errors.add(item)) is not None:
                    self._sink.send_scalars("error", [share[0]], share[1])
            case Timing():
                values = [[item.p50_ms, item.p99_ms, item.max_ms]]
                self._sink.send_scalars(
                    f"latency/{escape_path_part(item.component)}", [item.index], values
                )
            case Agreement():
                self._sink.send_scalars("disagreement/band", [item.index], [1.0])
                rows = list_twin_rows(item)
                for name, ratio in disagreement_ratios(rows).items():
                    self._styled_scalars(
                        "disagreement", name, disagreement_style, item.index, [ratio]
                    )
                self._sink.send_document("agreement", item.index, format_agreement(rows))
            case Estimate():
                for row in list_drift_rows(item):
                    entity = "gaps" if row.is_length else "drift"
                    self._styled_scalars(
                        entity, row.name, drift_styles, item.index, drift_interval(row)
                    )
            case JumpForecast():
                marks = forecast_lines(self._curves.axes, item)
                self._sink.send_coloured_strips("prc/ahead", item.index, marks)
                self._sink.send_document("ahead", item.index, format_forecast(item, self._fold))
            case RunStart():
                pass
            case _:
                self._log_event(item)

    def _styled_scalars(
        self,
        group: str,
        name: str,
        make_styles: Callable[[str], Sequence[LineStyle]],
        index: int,
        values: npt.ArrayLike,
    ) -> None:
        """Send a row of lines whose styles are logged at their first appearance."""
        entity = f"{group}/{escape_path_part(name)}"
        if entity not in self._styled:
            self._styled.add(entity)
            self._sink.log_line_styles(entity, make_styles(name))
        self._sink.send_scalars(entity, [index], values)

    def _log_event(self, item: Record) -> None:
        """Add a line to the event list; mark warnings in the disagreement plot."""
        if not (entry := format_record(item, self._start.rate_hz)):
            return
        if (item.index, *entry) in self._logged:
            return
        self._logged.add((item.index, *entry))
        level, text = entry
        time_text = f"{item.index / self._start.rate_hz:.1f} s"
        self._sink.send_log("events", item.index, level, f"{time_text:>9}  {text}")
        if level != "INFO" and not isinstance(item, Level):  # level updates are routine
            self._sink.send_document("warning", item.index, f"**{time_text}** {text}")
            self._sink.send_scalars("disagreement/warnings", [item.index], [1.0])

    def _draw_point(self, point: PrcPoint | OrbitPoint) -> None:
        """Draw the PRC so far, or the orbits over the planned ones, and the newest point."""
        self._curves.add(point)
        if isinstance(point, PrcPoint):
            self._sink.send_document("point", point.index, format_point(point))
            if self._branches is not None:
                self._fold = self._branches.find_fold(point)
        else:
            self._log_event(point)
        self._draw_curves(point.index)

    def _draw_curves(self, index: int) -> None:
        """Draw the curves over frequency so far, with their axes again for late viewers."""
        self._sink.send_axes("prc", index, self._curves.axes)
        for source in ("measured", "twin"):
            if curves := self._curves.get_curves(source):
                self._sink.send_dotted_strips(f"prc/data/{source}", index, curves)


def write_rrd(recording: Recording, out: Path) -> None:
    """Write a whole recording to a new .rrd file, with lines of LINE_RATE_HZ at most."""
    view = RerunView(recording.start, save=out)
    for first in range(0, len(recording.items), BATCH_ITEMS):
        view.feed(recording.items[first : first + BATCH_ITEMS])
        recording.items.release()
    view.close()


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
