"""Rerun output: a new .rrd file, a server on the loopback interface, or both.

Data are sent in columns, few entities with many instances, on the timeline `time` computed from the
sample index, and on `date`, the absolute time, if the start is stated. Viewers connect to the
server, so that a hanging viewer cannot block the run.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr

from table_io.block import Float2D, Int1D
from table_io.errors import InputError
from table_io.records import RunStart
from twin.recording.reader import find_start_ns
from twin.viewer.address import parse_address
from twin.viewer.plots import DARK_GREY, GREY, LineStyle, PlotAxes, Rgb
from twin.viewer.scene import BoxFrames, Float3D

SERVER_MEMORY_LIMIT = "256MiB"  # history for late viewers; the oldest data are dropped first
MAX_FOOTER_S = 1200.0


class RerunSink:
    """Recording stream of Rerun; existing files are not overwritten."""

    def __init__(self, start: RunStart, save: Path | None, serve: str, blueprint: Any) -> None:
        address = parse_address(serve) if serve else None
        sinks: list[Any] = []
        if save is not None:
            _create_file(save)
            # The footer speeds up seeking but costs 0.2 MB of memory per second of a live run.
            short = start.planned_samples < MAX_FOOTER_S * start.rate_hz
            sinks.append(rr.FileSink(save, write_footer=short))
        if address:
            sinks.append(rr.GrpcServerSink(*address, server_memory_limit=SERVER_MEMORY_LIMIT))
        self._ns_per_sample = 1e9 / start.rate_hz
        self._started_ns = find_start_ns(start)
        self._recording = rr.RecordingStream("shaketwin")
        self._recording.set_sinks(*sinks, default_blueprint=blueprint)
        self._recording.send_recording_name(f"{start.name} {start.run}")

    def close(self) -> None:
        """Finish the file and stop serving."""
        self._recording.flush()
        self._recording.disconnect()

    def log_static(self, entity: str, *archetypes: Any) -> None:
        """Log the static properties of an entity: names, colors, widths."""
        rr.log(entity, *archetypes, static=True, recording=self._recording)

    def log_line_styles(self, entity: str, lines: Sequence[LineStyle]) -> None:
        """Log names, colors and widths of the lines of an entity."""
        names, colours, widths = zip(*lines, strict=True)
        policy = rr.components.AggregationPolicy.MinMax  # keeps peaks at every zoom
        series = rr.SeriesLines(
            names=names, colors=colours, widths=widths, aggregation_policy=policy
        )
        self.log_static(entity, series)

    def _send(self, entity: str, index: Sequence[int] | Int1D, *columns: Any) -> None:
        """Send rows of an entity at the times of their samples."""
        if not len(index):
            return
        ns = np.rint(np.asarray(index, dtype=np.float64) * self._ns_per_sample)
        times = [rr.TimeColumn("time", duration=ns.astype("timedelta64[ns]"))]
        if self._started_ns:
            dates = (self._started_ns + ns.astype(np.int64)).astype("datetime64[ns]")
            times.append(rr.TimeColumn("date", timestamp=dates))
        flat = [column for group in columns for column in group]
        rr.send_columns(entity, times, flat, recording=self._recording)

    def send_scalars(
        self, entity: str, index: Sequence[int] | Int1D, values: npt.ArrayLike
    ) -> None:
        """Send scalar values, (row, series)."""
        self._send(entity, index, rr.Scalars.columns(scalars=values))

    def send_boxes(self, entity: str, boxes: BoxFrames) -> None:
        """Send all frames of a set of boxes."""
        frames, count = boxes.centres.shape[:2]
        columns = rr.Boxes3D.columns(
            centers=boxes.centres.reshape(-1, 3),
            half_sizes=boxes.half_sizes.reshape(-1, 3),
            colors=boxes.colours.reshape(-1, 3),
        )
        self._send(entity, boxes.index, columns.partition([count] * frames))

    def send_centres(self, entity: str, index: Int1D, centres: Float2D) -> None:
        """Send the centers of a box of fixed size, (frame, 3)."""
        self._send(entity, index, rr.Boxes3D.columns(centers=centres))

    def send_caption_positions(self, entity: str, index: Int1D, positions: Float3D) -> None:
        """Send the positions of the captions, (frame, text, 3)."""
        frames, count = positions.shape[:2]
        columns = rr.Points3D.columns(positions=positions.reshape(-1, 3))
        self._send(entity, index, columns.partition([count] * frames))

    def send_trail(self, entity: str, ends: Sequence[int], strips: Sequence[Float2D]) -> None:
        """Send one strip per row."""
        self._send(entity, ends, rr.LineStrips2D.columns(strips=strips))

    def send_strips(self, entity: str, index: int, strips: Sequence[Float2D]) -> None:
        """Send several strips at one time; they replace the previous ones."""
        lines = rr.LineStrips2D.columns(strips=strips)
        self._send(entity, [index], lines.partition([len(strips)]))

    def send_coloured_strips(
        self, entity: str, index: int, strips: Sequence[tuple[Rgb, Float2D]]
    ) -> None:
        """Send several colored strips at one time; they replace the previous ones."""
        colours, lines = [colour for colour, _ in strips], [line for _, line in strips]
        columns = rr.LineStrips2D.columns(strips=lines, colors=colours)
        self._send(entity, [index], columns.partition([len(strips)]))

    def send_dotted_strips(
        self, entity: str, index: int, strips: Sequence[tuple[Rgb, Float2D]]
    ) -> None:
        """Send colored strips with a dot at every point."""
        self.send_coloured_strips(entity, index, strips)
        colours = [colour for colour, line in strips for _ in line]
        positions = np.concatenate([line for _, line in strips])
        dots = rr.Points2D.columns(positions=positions, colors=colours)
        self._send(entity, [index], dots.partition([len(positions)]))

    def send_axes(self, entity: str, index: int, axes: PlotAxes) -> None:
        """Send grid, labels and data-to-drawing transform of a plot, valid from sample `index`."""
        grid, (positions, texts) = axes.grid_lines(), axes.labels()
        colours = [GREY] + [DARK_GREY] * (len(grid) - 1)
        self.send_coloured_strips(f"{entity}/grid", index, list(zip(colours, grid, strict=True)))
        labels = rr.Points2D.columns(positions=positions, labels=texts)
        self._send(f"{entity}/numbers", [index], labels.partition([len(texts)]))
        scale, origin = [(*axes.scale, 1.0)], [(*axes.origin, 0.0)]
        transform = rr.Transform3D.columns(scale=scale, translation=origin)
        self._send(f"{entity}/data", [index], transform)

    def send_document(self, entity: str, index: int, text: str) -> None:
        """Send a Markdown document."""
        columns = rr.TextDocument.columns(text=[text], media_type=["text/markdown"])
        self._send(entity, [index], columns)

    def send_log(self, entity: str, index: int, level: str, text: str) -> None:
        """Send a log line; `level` is INFO, WARN or ERROR."""
        self._send(entity, [index], rr.TextLog.columns(text=[text], level=[level]))


def escape_path_part(name: str) -> str:
    """Escape a name for use as one part of an entity path."""
    return str(rr.escape_entity_path_part(name))


def _create_file(path: Path) -> None:
    """Create the file; raise InputError if it exists or cannot be written."""
    try:
        path.open("xb").close()
    except FileExistsError:
        raise InputError("exists already", where=path, remedy="choose another name") from None
    except OSError as error:
        raise InputError(f"cannot write here: {error.strerror}", where=path) from None
