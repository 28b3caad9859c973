"""The view: what every Block and record puts on the screen.

What is drawn depends on the samples only, never on how they were cut into blocks or batches.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from table_io.block import Block, Float1D, Int1D
from table_io.card import parse
from table_io.channels import BY_NAME
from table_io.profile import Profile
from table_io.records import (
    Agreement,
    Ahead,
    Comparison,
    Cycle,
    Estimate,
    Level,
    Point,
    Record,
    RunStart,
    Timing,
)
from table_io.words import sentence
from twin.stream.recording import Recording
from twin.stream.rerun.address import url
from twin.stream.rerun.blueprint import blueprint, fix
from twin.stream.rerun.levels import Levels
from twin.stream.rerun.looks import Line, drift_lines, share_line
from twin.stream.rerun.moving import Motion, motion, pieces, track
from twin.stream.rerun.plane import LOOP, PHASE, Plane
from twin.stream.rerun.plots import Curves, foreseen
from twin.stream.rerun.scene import Scene
from twin.stream.rerun.sink import Sink, part
from twin.stream.rerun.words import (
    ErrorShare,
    Progress,
    agreement_table,
    ahead_text,
    cycle_table,
    drifts,
    impacts,
    is_length,
    point_table,
    shares,
    status,
)

BATCH = 1000  # items of a log fed at once


class RerunView:
    """Feeds one run to a new file, to viewers on this machine ("127.0.0.1:PORT"), or to both."""

    def __init__(self, start: RunStart, *, save: Path | None = None, serve: str = "") -> None:
        if save is None and not serve:
            raise ValueError("a view needs a file to save to, an address to serve at, or both")
        profile = parse(start.profile_toml, Profile, f"profile of run {start.run}")
        self._start = start
        self._scene = Scene.of(profile)
        self._mass_kg = profile.specimen.mass_kg
        self._frame = max(1, round(start.rate_hz / 100))
        self._next: dict[str, int] = {}
        self._styled: set[str] = set()
        self._told: set[tuple[int, str, str]] = set()
        self._progress = Progress()
        self._curves = Curves(profile.sweep.start_hz, profile.sweep.stop_hz)
        self._errors = ErrorShare(start.rate_hz)
        self._sink = Sink(start, save, serve, blueprint(start, self._scene, bool(serve)))
        self.url = url(serve) if serve else ""
        fix(self._sink, self._scene, self._mass_kg)
        self._levels = Levels(self._sink, self._scene, start.rate_hz)
        self._phase = Plane(self._sink, PHASE, start.rate_hz, self._scene.gaps_m)
        component = "damper_force_n" in start.channels
        self._loop = (
            Plane(self._sink, LOOP, start.rate_hz, self._scene.gaps_m) if component else None
        )
        self._sink.axes("prc", 0, self._curves.axes)
        for entity in ("ahead", "warning"):
            self._sink.document(entity, 0, "none so far")

    def feed(self, items: Sequence[Block | Record]) -> None:
        """Put a batch of whatever arrived on the screen; about every 100 ms is right."""
        for stream, draw in (("meas", self._measured), ("pred", self._predicted)):
            blocks = [one for one in items if isinstance(one, Block) and one.stream == stream]
            for piece in pieces(self._new(blocks)):
                draw(piece)
        for item in items:
            if not isinstance(item, Block):
                self._record(item)

    def _new(self, blocks: Sequence[Block]) -> Iterator[Block]:
        """The blocks that come after those already drawn: what a bus says twice is drawn once."""
        for block in blocks:
            if block.index >= self._next.get(block.stream, 0):
                self._next[block.stream] = block.end
                yield block

    def close(self) -> None:
        """Finish the file and stop serving."""
        self._sink.close()

    def _lines(self, entity: str, index: Int1D, *columns: Float1D) -> None:
        """The lines of an entity, (sample,) each; a NaN at the first lost sample lifts the pen."""
        values = np.stack(columns, axis=1)
        due = self._next.get(entity, int(index[0]))
        self._next[entity] = int(index[-1]) + 1
        if due < index[0]:
            index = np.concatenate([[due], index])
            values = np.concatenate([np.full((1, len(columns)), np.nan), values])
        self._sink.scalars(entity, index, values)

    def _measured(self, block: Block) -> None:
        moves = motion(block)
        self._lines("u/measured", moves.index, 1e3 * moves.u)
        self._lines("a/measured", moves.index, moves.acc, moves.table_acc)
        self._lines("force/measured", moves.index, 1e-3 * moves.force_r, 1e-3 * moves.force_l)
        for name in block.channels:
            if name not in BY_NAME:
                self._lines(f"other/{part(name)}", moves.index, block.channel(name))
        frames = moves.known_every(self._frame)
        self._sink.boxes("rig/bodies", self._scene.bodies(frames))
        self._sink.boxes("rig/frame", self._scene.frame(frames))
        frames = moves.known_every(5 * self._frame)
        self._sink.captions("rig/names", frames.index, self._scene.names(frames))
        self._damper("measured", moves, moves.damper)
        self._phase.add("measured", moves)
        self._levels.add(moves)
        for index, step, label in self._progress.add(block):
            self._sink.document("status", index, status(self._start, step, label))
            now = self._start.steps[step : step + 1] if step >= 0 else ()
            marks = self._curves.axes.uprights(one.frequency_hz for one in now)
            self._sink.strips("prc/now", index, marks)

    def _predicted(self, block: Block) -> None:
        free, window = motion(track(block, "free")), motion(track(block, "window"))
        self._lines("u/twin", window.index, 1e3 * free.u, 1e3 * window.u)
        self._lines("a/twin", window.index, free.acc, window.acc)
        self._lines("force/twin", window.index, 1e-3 * window.force_r, 1e-3 * window.force_l)
        frames = free.known_every(self._frame)
        self._sink.centres("rig/twin", frames.index, self._scene.mass(frames))
        forces = [-self._mass_kg * one.acc - one.force_r - one.force_l for one in (free, window)]
        self._damper("twin", window, *forces[::-1])
        self._phase.add("twin", window)

    def _damper(self, who: str, moves: Motion, force_n: Float1D, *free_n: Float1D) -> None:
        """The damper's force over time and over u, where the rig measures it."""
        if self._loop is not None:
            self._lines(f"damper/{who}", moves.index, *(1e-3 * one for one in (*free_n, force_n)))
            self._loop.add(who, replace(moves, v=1e-6 * force_n))

    def _record(self, item: Record) -> None:
        match item:
            case Point():
                self._point(item)
            case Cycle():
                self._sink.scalars("impacts", [item.index], impacts(item))
                self._sink.document("cycle", item.index, cycle_table(item))
            case Comparison():
                if (share := self._errors.add(item)) is not None:
                    self._sink.scalars("error", [share[0]], share[1])
            case Timing():
                values = [[item.p50_ms, item.p99_ms, item.max_ms]]
                self._sink.scalars(f"latency/{part(item.component)}", [item.index], values)
            case Agreement():
                self._sink.scalars("disagreement/band", [item.index], [1.0])
                for name, ratio in shares(item).items():
                    self._styled_scalars("disagreement", name, share_line, item.index, [ratio])
                self._sink.document("agreement", item.index, agreement_table(item))
            case Estimate():
                for name, change in drifts(item):
                    room = "gaps" if is_length(name) else "drift"
                    self._styled_scalars(room, name, drift_lines, item.index, change)
            case Ahead():
                marks = foreseen(self._curves.axes, item)
                self._sink.painted("prc/ahead", item.index, marks)
                self._sink.document("ahead", item.index, ahead_text(item))
            case RunStart():
                pass
            case _:
                self._say(item)

    def _styled_scalars(
        self,
        room: str,
        name: str,
        looks: Callable[[str], Sequence[Line]],
        index: int,
        values: npt.ArrayLike,
    ) -> None:
        """A row of lines that are known only once they come."""
        entity = f"{room}/{part(name)}"
        if entity not in self._styled:
            self._styled.add(entity)
            self._sink.style(entity, looks(name))
        self._sink.scalars(entity, [index], values)

    def _say(self, item: Record) -> None:
        """A line in the list of events; what warns is marked where model and rig part, too."""
        if not (told := sentence(item, self._start.rate_hz)):
            return
        if (item.index, *told) in self._told:
            return
        self._told.add((item.index, *told))
        level, text = told
        at = f"{item.index / self._start.rate_hz:.1f} s"
        self._sink.log("events", item.index, level, f"{at:>9}  {text}")
        if level != "INFO" and not isinstance(item, Level):  # a level takes its few updates
            self._sink.document("warning", item.index, f"**{at}** {text}")
            self._sink.scalars("disagreement/warnings", [item.index], [1.0])

    def _point(self, point: Point) -> None:
        """The PRC so far, and the numbers of its newest point."""
        self._curves.add(point)
        self._sink.axes("prc", point.index, self._curves.axes)  # again, for who comes late
        for who in ("measured", "twin"):
            if found := self._curves.of(who):
                self._sink.dotted(f"prc/data/{who}", point.index, found)
        self._sink.document("point", point.index, point_table(point))


def write_rrd(recording: Recording, out: Path) -> None:
    """A whole log as a new .rrd file, every sample at its true time."""
    view = RerunView(recording.start, save=out)
    for first in range(0, len(recording.items), BATCH):
        view.feed(recording.items[first : first + BATCH])
    view.close()
