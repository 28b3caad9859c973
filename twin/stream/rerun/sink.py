"""Where the view goes: a new .rrd file, a server on this machine's loopback, or both; in columns.

Few entities with many instances, on one timeline `time` computed from the sample index. Served,
never connected outwards: a viewer that hangs cannot hold us up.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import rerun as rr

from table_io.block import Float2D, Int1D
from table_io.card import BadInput
from table_io.records import RunStart
from twin.stream.rerun.address import checked
from twin.stream.rerun.looks import DIM, GREY, Line, Rgb
from twin.stream.rerun.plots import Axes
from twin.stream.rerun.scene import Boxes, Float3D

MEMORY = "256MiB"  # what a late viewer can still get; the oldest goes first
FOOTER_S = 1200.0


class Sink:
    """One recording stream of Rerun; nothing is ever overwritten."""

    def __init__(self, start: RunStart, save: Path | None, serve: str, blueprint: Any) -> None:
        address = checked(serve) if serve else None
        sinks: list[Any] = []
        if save is not None:
            _claim(save)
            # The footer speeds up seeking, and keeps 0.2 MB in memory per second of a live run.
            short = start.planned_samples < FOOTER_S * start.rate_hz
            sinks.append(rr.FileSink(save, write_footer=short))
        if address:
            sinks.append(rr.GrpcServerSink(*address, server_memory_limit=MEMORY))
        self._ns = 1e9 / start.rate_hz
        self._rec = rr.RecordingStream("shaketwin")
        self._rec.set_sinks(*sinks, default_blueprint=blueprint)
        self._rec.send_recording_name(f"{start.name} {start.run}")

    def close(self) -> None:
        """Finish the file and stop serving."""
        self._rec.flush()
        self._rec.disconnect()

    def fix(self, entity: str, *archetypes: Any) -> None:
        """What does not change of an entity: names, colours, widths."""
        rr.log(entity, *archetypes, static=True, recording=self._rec)

    def style(self, entity: str, lines: Sequence[Line]) -> None:
        """Names, colours and widths of the lines of an entity."""
        names, paint, widths = zip(*lines, strict=True)
        policy = rr.components.AggregationPolicy.MinMax  # peaks survive any zoom
        looks = rr.SeriesLines(names=names, colors=paint, widths=widths, aggregation_policy=policy)
        self.fix(entity, looks)

    def _send(self, entity: str, index: Sequence[int] | Int1D, *columns: Any) -> None:
        """All rows of an entity at once, at the true times of their samples."""
        if not len(index):
            return
        ns = np.rint(np.asarray(index, dtype=np.float64) * self._ns)
        times = rr.TimeColumn("time", duration=ns.astype("timedelta64[ns]"))
        flat = [one for many in columns for one in many]
        rr.send_columns(entity, [times], flat, recording=self._rec)

    def scalars(self, entity: str, index: Sequence[int] | Int1D, values: npt.ArrayLike) -> None:
        """Values (row, series)."""
        self._send(entity, index, rr.Scalars.columns(scalars=values))

    def boxes(self, entity: str, boxes: Boxes) -> None:
        """Every frame of a row of boxes."""
        frames, count = boxes.centres.shape[:2]
        columns = rr.Boxes3D.columns(
            centers=boxes.centres.reshape(-1, 3),
            half_sizes=boxes.halves.reshape(-1, 3),
            colors=boxes.colours.reshape(-1, 3),
        )
        self._send(entity, boxes.index, columns.partition([count] * frames))

    def centres(self, entity: str, index: Int1D, centres: Float2D) -> None:
        """Where a box of fixed size is, (frame, 3)."""
        self._send(entity, index, rr.Boxes3D.columns(centers=centres))

    def captions(self, entity: str, index: Int1D, places: Float3D) -> None:
        """Where texts stand in the rig, (frame, text, 3)."""
        frames, count = places.shape[:2]
        columns = rr.Points3D.columns(positions=places.reshape(-1, 3))
        self._send(entity, index, columns.partition([count] * frames))

    def trail(self, entity: str, ends: Sequence[int], strips: Sequence[Float2D]) -> None:
        """A strip a row."""
        self._send(entity, ends, rr.LineStrips2D.columns(strips=strips))

    def strips(self, entity: str, index: int, strips: Sequence[Float2D]) -> None:
        """Many strips at one time, in place of those before."""
        lines = rr.LineStrips2D.columns(strips=strips)
        self._send(entity, [index], lines.partition([len(strips)]))

    def painted(self, entity: str, index: int, strips: Sequence[tuple[Rgb, Float2D]]) -> None:
        """The same, each in its colour."""
        colours, lines = [colour for colour, _ in strips], [line for _, line in strips]
        columns = rr.LineStrips2D.columns(strips=lines, colors=colours)
        self._send(entity, [index], columns.partition([len(strips)]))

    def dotted(self, entity: str, index: int, strips: Sequence[tuple[Rgb, Float2D]]) -> None:
        """The same, with a dot at every point."""
        self.painted(entity, index, strips)
        paint = [colour for colour, line in strips for _ in line]
        places = np.concatenate([line for _, line in strips])
        dots = rr.Points2D.columns(positions=places, colors=paint)
        self._send(entity, [index], dots.partition([len(places)]))

    def axes(self, entity: str, index: int, axes: Axes) -> None:
        """Grid and numbers of a plot, and the map from data to drawing, from sample `index` on."""
        grid, (places, texts) = axes.grid(), axes.labels()
        paint = [GREY] + [DIM] * (len(grid) - 1)
        self.painted(f"{entity}/grid", index, list(zip(paint, grid, strict=True)))
        marks = rr.Points2D.columns(positions=places, labels=texts)
        self._send(f"{entity}/numbers", [index], marks.partition([len(texts)]))
        scale, origin = [(*axes.scale, 1.0)], [(*axes.origin, 0.0)]
        place = rr.Transform3D.columns(scale=scale, translation=origin)
        self._send(f"{entity}/data", [index], place)

    def document(self, entity: str, index: int, text: str) -> None:
        """Markdown."""
        columns = rr.TextDocument.columns(text=[text], media_type=["text/markdown"])
        self._send(entity, [index], columns)

    def log(self, entity: str, index: int, level: str, text: str) -> None:
        """A line of a log; `level` is INFO, WARN or ERROR."""
        self._send(entity, [index], rr.TextLog.columns(text=[text], level=[level]))


def part(name: str) -> str:
    """Any name as one part of an entity's path."""
    return str(rr.escape_entity_path_part(name))


def _claim(path: Path) -> None:
    """Make sure that the file is new and can be written."""
    try:
        path.open("xb").close()
    except FileExistsError:
        raise BadInput(f"{path}: exists already; nothing is ever overwritten") from None
    except OSError as error:
        raise BadInput(f"{path}: cannot write here: {error.strerror}") from None
