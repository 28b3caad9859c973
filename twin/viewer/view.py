"""Rerun view of a run: draws every block and record.

The drawing depends on the samples only, not on their division into blocks or batches.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from table_io.block import Block, Float1D, Int1D, join_contiguous
from table_io.channels import CHANNEL_BY_NAME
from table_io.config.base import parse_toml
from table_io.config.profile import Profile
from table_io.records import (
    Agreement,
    Comparison,
    CycleExtremes,
    Estimate,
    JumpForecast,
    Level,
    OrbitPoint,
    PrcPoint,
    Record,
    RunStart,
    Timing,
    format_record,
)
from twin.recording.reader import Recording
from twin.viewer.address import viewer_url
from twin.viewer.blueprint import log_static, make_blueprint
from twin.viewer.model_branches import FoldAhead, ModelBranches
from twin.viewer.motion import BlockMotion, extract_motion, extract_track
from twin.viewer.plots import FrequencyCurves, forecast_lines
from twin.viewer.scaled_plots import DAMPER_LOOP, PHASE_PLANE, PlanePlot, ReferenceLevels
from twin.viewer.scene import Scene
from twin.viewer.sink import RerunSink, escape_path_part
from twin.viewer.style import LineStyle, disagreement_style, drift_styles
from twin.viewer.text import (
    RelativeError,
    SweepPosition,
    disagreement_ratios,
    drift_interval,
    format_agreement,
    format_cycle,
    format_forecast,
    format_point,
    format_status,
    impact_counts,
)
from twin.viewer.view_model import list_drift_rows, list_twin_rows

BATCH_ITEMS = 1000  # items of a log per call of `feed`
LINE_RATE_HZ = 500  # of the lines over time, at most; all samples would be 25 MB a minute at 2 kHz
FRAME_RATE_HZ = 50  # of the moving rig


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
        free, window = (
            extract_motion(extract_track(block, "free")),
            extract_motion(extract_track(block, "window")),
        )
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
    view.close()
