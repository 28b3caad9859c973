"""What the view shows: the rig as boxes, axes with ticks, the trail of the phase plane, its words.

Plain arrays in, plain arrays out; `rerun_view` puts them on the screen. Drawn lengths are metres on
a rig about two metres wide; x is right, z is up. Motion is magnified, because millimetres on metres
cannot be seen: `Scene.table_factor` for the table, `Scene.factor` for everything on it, gaps too,
so a bumper is touched in the picture exactly when it is touched on the rig.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from table_io.block import Block, Float1D, Float2D, Label, join
from table_io.channels import contact_forces, rel_disp
from table_io.profile import Profile
from table_io.records import (
    Comparison,
    Cycle,
    Extremes,
    Point,
    Quantities,
    RunStart,
)

Float3D = npt.NDArray[np.float64]
Colours = npt.NDArray[np.uint8]

RED, BLUE = (255, 92, 87), (84, 160, 255)
WHITE, GREY, DIM = (245, 245, 245), (150, 156, 168), (58, 62, 70)
STEEL, MASS, RUBBER, CONTACT = (104, 110, 122), (66, 126, 148), (40, 42, 48), (255, 176, 46)
IDLE = (146, 150, 160)

# Legend name, colour and width of every line, in the order of the columns of an entity.
Rgb = tuple[int, int, int]
RESTARTED, FREE = "twin, restarted", "twin, free-running"
LINES: dict[str, tuple[tuple[str, Rgb, float], ...]] = {
    "u/measured": (("measured", RED, 3.5),),
    "u/twin": ((FREE, GREY, 1.5), (RESTARTED, WHITE, 1.3)),
    "a/measured": (("measured", RED, 3.5), ("table, measured", BLUE, 1.5)),
    "a/twin": ((FREE, GREY, 1.5), (RESTARTED, WHITE, 1.3)),
    "force/measured": (("right, measured", RED, 3.5), ("left, measured", BLUE, 3.5)),
    "force/twin": ((f"right, {RESTARTED}", WHITE, 1.5), (f"left, {RESTARTED}", WHITE, 1.5)),
    "error": ((f"u, {FREE}", GREY, 2.0), (f"u, {RESTARTED}", WHITE, 2.0)),
    "impacts": (
        ("right, measured", RED, 3.5),
        ("left, measured", BLUE, 3.5),
        ("right, twin", WHITE, 1.5),
        ("left, twin", GREY, 1.2),
    ),
}
PRC_COLOURS = {"measured": (RED, BLUE), "twin": (WHITE, GREY)}

HALF_MASS = np.array([0.36, 0.30, 0.20])
HALF_TABLE = np.array([1.00, 0.50, 0.05])
BEARING_HEIGHT, BEARING_LAYERS = 0.27, 9
BUMPER_LENGTH, BUMPER_LEAST = 0.20, 0.03
HALF_WALL = np.array([0.035, 0.30, 0.37])


def nice(value: float) -> float:
    """Smallest of 1, 1.5, 2, 3, 4, 5, 6, 8, 10 times a power of ten that is >= value > 0."""
    power = 10.0 ** math.floor(math.log10(value))
    steps = (1, 1.5, 2, 3, 4, 5, 6, 8, 10)
    return next((step * power for step in steps if step * power >= value * (1 - 1e-9)), 10 * power)


def nice_below(value: float) -> float:
    """Largest of 1, 2, 5 times a power of ten that is <= value > 0."""
    power = 10.0 ** math.floor(math.log10(value))
    return max(step * power for step in (1, 2, 5) if step * power <= value * (1 + 1e-9))


@dataclass(frozen=True, slots=True)
class Motion:
    """What one piece of a stream draws, SI, right positive; every array (sample,).

    NaN where there is no such channel. `force_l` <= 0.
    """

    index: npt.NDArray[np.int64]
    u: Float1D
    v: Float1D
    table: Float1D
    acc: Float1D
    table_acc: Float1D
    force_r: Float1D
    force_l: Float1D

    def known_every(self, stride: int) -> "Motion":
        """Every sample whose index is a multiple of `stride`, where the rig's place is known."""
        known = np.isfinite(self.u) & np.isfinite(self.table)
        at = np.flatnonzero((self.index % stride == 0) & known)
        return Motion(*(getattr(self, name)[at] for name in Motion.__slots__))


def motion(block: Block) -> Motion:
    """What a block of measured or stripped predicted channels draws."""

    def of(name: str) -> Float1D:
        missing = np.full(len(block), np.nan)
        return block.channel(name) if name in block.channels else missing

    u = rel_disp(block)
    table = of("table_disp_m")
    if "table_disp_m" not in block.channels:
        table = of("mass_disp_m") - u
    return Motion(
        np.arange(block.index, block.end),
        u,
        of("rel_vel_m_s"),
        table,
        of("mass_acc_m_s2"),
        of("table_acc_m_s2"),
        *contact_forces(block),
    )


def track(block: Block, name: str) -> Block:
    """The channels `name/...` of a predicted block under their canonical names."""
    mark = f"{name}/"
    rows = [row for row, channel in enumerate(block.channels) if channel.startswith(mark)]
    names = tuple(block.channels[row].removeprefix(mark) for row in rows)
    labels = (block.step, block.label, block.cycle)
    return Block(block.stream, block.index, block.rate_hz, names, block.values[rows], *labels)


@dataclass(frozen=True, slots=True)
class Boxes:
    """Boxes over time, (frame, box, 3) each: centres and half sizes in drawn m, colours."""

    index: npt.NDArray[np.int64]
    centres: Float3D
    halves: Float3D
    colours: Colours


@dataclass(frozen=True, slots=True)
class Scene:
    """The rig to be drawn: gaps in m (right, left), contact threshold in N, magnifications."""

    gaps_m: tuple[float, float]
    contact_n: float
    table_factor: float
    factor: float

    @classmethod
    def of(cls, profile: Profile) -> "Scene":
        """The scene whose largest expected motions are drawn about a quarter of a metre long.

        Expected: the commanded table amplitude, and the gap plus what the free mass adds to it.
        """
        slowest = min(profile.sweep.steps, key=lambda step: step.frequency_hz)
        table = slowest.acceleration_m_s2 / (2 * math.pi * slowest.frequency_hz) ** 2
        level = profile.sweep.acceleration_g / 0.05
        u = min(max(*profile.specimen.gaps_m, 0.0) + 5e-3 * level, 30e-3 * level)
        gaps = profile.specimen.gaps_m
        return cls(
            gaps, profile.comparison.contact_n, nice_below(0.3 / table), nice_below(0.25 / u)
        )

    @property
    def walls(self) -> bool:
        return all(math.isfinite(gap) for gap in self.gaps_m)

    def mass(self, moves: Motion) -> Float2D:
        """Centre of the mass in drawn m, (frame, 3)."""
        x = self.table_factor * moves.table + self.factor * moves.u
        height = BEARING_HEIGHT + HALF_MASS[2]
        return np.stack([x, np.zeros_like(x), np.full_like(x, height)], axis=1)

    def bodies(self, moves: Motion) -> Boxes:
        """Table, mass and, where there are gaps, right and left bumper; lit while in contact."""
        x = self.table_factor * moves.table
        table = np.stack([x, np.zeros_like(x), np.full_like(x, -HALF_TABLE[2])], axis=1)
        centres = [table, self.mass(moves)]
        halves = [np.broadcast_to(size, table.shape) for size in (HALF_TABLE, HALF_MASS)]
        colours = [np.broadcast_to(np.array(one, np.uint8), table.shape) for one in (STEEL, MASS)]
        if self.walls:
            lit, idle = np.array(CONTACT, np.uint8), np.array(IDLE, np.uint8)
            for sign, gap, force in (
                (1.0, self.gaps_m[0], moves.force_r),
                (-1.0, self.gaps_m[1], -moves.force_l),
            ):
                centre, half = self._bumper(x, sign, gap, sign * moves.u)
                touches = np.where(np.isnan(force), sign * moves.u > gap, force > self.contact_n)
                centres.append(centre)
                halves.append(half)
                colours.append(np.where(touches[:, None], lit, idle))
        stacks = (np.stack(one, axis=1) for one in (centres, halves, colours))
        return Boxes(moves.index, *stacks)

    def _bumper(self, x: Float1D, sign: float, gap: float, u: Float1D) -> tuple[Float2D, Float2D]:
        """Centre and half size of a bumper; its tip rests at the gap or on the mass, (frame, 3)."""
        squeezed = self.factor * np.maximum(u - gap, 0)
        length = np.maximum(BUMPER_LENGTH - squeezed, BUMPER_LEAST)
        base = HALF_MASS[0] + self.factor * gap + BUMPER_LENGTH
        zero = np.zeros_like(x)
        height = zero + BEARING_HEIGHT + HALF_MASS[2]
        centre = np.stack([x + sign * (base - length / 2), zero, height], axis=1)
        return centre, np.stack([length / 2, zero + 0.11, zero + 0.09], axis=1)

    def frame(self, moves: Motion) -> Boxes:
        """The layers of the sheared bearing and, where there are gaps, the walls."""
        x = self.table_factor * moves.table
        zero = np.zeros_like(x)
        thick = BEARING_HEIGHT / BEARING_LAYERS
        up = (np.arange(BEARING_LAYERS) + 0.5) / BEARING_LAYERS
        places = [(x + self.factor * moves.u * part, BEARING_HEIGHT * part) for part in up]
        sizes = [np.array([0.19, 0.19, 0.46 * thick])] * BEARING_LAYERS
        paint = [(RUBBER, STEEL)[layer % 2] for layer in range(BEARING_LAYERS)]
        if self.walls:
            for sign, gap in zip((1.0, -1.0), self.gaps_m, strict=True):
                away = HALF_MASS[0] + self.factor * gap + BUMPER_LENGTH + HALF_WALL[0]
                places.append((x + sign * away, HALF_WALL[2]))
                sizes.append(HALF_WALL)
                paint.append(STEEL)
        centres = np.stack([np.stack([at, zero, zero + z], axis=1) for at, z in places], axis=1)
        halves = np.broadcast_to(np.array(sizes), centres.shape)
        return Boxes(
            moves.index, centres, halves, np.broadcast_to(np.array(paint, np.uint8), centres.shape)
        )


@dataclass(frozen=True, slots=True)
class Axes:
    """A plot drawn WIDTH by HEIGHT, y downward as 2D views have it; x and y in data units."""

    x: tuple[float, float]
    y: tuple[float, float]
    x_label: str
    y_label: str

    WIDTH: ClassVar = 2.2
    HEIGHT: ClassVar = 1.0

    @property
    def scale(self) -> tuple[float, float]:
        """Drawn length of one data unit; y negative, because up is up in a plot."""
        return self.WIDTH / (self.x[1] - self.x[0]), -self.HEIGHT / (self.y[1] - self.y[0])

    @property
    def origin(self) -> tuple[float, float]:
        """Where data (0, 0) is drawn."""
        return -self.x[0] * self.scale[0], self.HEIGHT - self.y[0] * self.scale[1]

    @staticmethod
    def ticks(low: float, high: float) -> Float1D:
        """Four to ten round numbers within low .. high."""
        step = nice_below((high - low) / 4)
        first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
        return np.arange(first, last + 1, dtype=np.float64) * step

    def grid(self) -> list[Float2D]:
        """The frame and a line at every tick, drawn units, each (point, 2)."""
        (sx, sy), (ox, oy), w, h = self.scale, self.origin, self.WIDTH, self.HEIGHT
        lines = [np.array([[0, 0], [w, 0], [w, h], [0, h], [0, 0]], dtype=np.float64)]
        lines += [np.array([[ox + sx * x, 0], [ox + sx * x, h]]) for x in self.ticks(*self.x)]
        lines += [np.array([[0, oy + sy * y], [w, oy + sy * y]]) for y in self.ticks(*self.y)]
        return lines

    def uprights(self, values: Iterable[float]) -> list[Float2D]:
        """A vertical line at each value of x within the axes, drawn units, each (2, 2)."""
        places = [self.origin[0] + self.scale[0] * x for x in values if self.x[0] <= x <= self.x[1]]
        return [np.array([[x, 0.0], [x, self.HEIGHT]]) for x in places]

    def labels(self) -> tuple[Float2D, list[str]]:
        """Where the numbers and names stand, drawn units (label, 2), and what they say."""
        (sx, sy), (ox, oy), w, h = self.scale, self.origin, self.WIDTH, self.HEIGHT
        places = [(ox + sx * x, h + 0.005) for x in self.ticks(*self.x)]
        places += [(-0.055, oy + sy * y - 0.035) for y in self.ticks(*self.y)]
        texts = [f"{tick:.6g}" for tick in (*self.ticks(*self.x), *self.ticks(*self.y))]
        names = [((w / 2, h + 0.08), self.x_label), ((0.12, -0.11), self.y_label)]
        return (
            np.array([*places, *(place for place, _ in names)]),
            [*texts, *(text for _, text in names)],
        )


class Trail:
    """Cuts u and u' into short strips, each ending where the next begins; the same for any blocks.

    Where no velocity is given it is the slope of u over `2 * margin` samples, centred.
    """

    def __init__(self, length: int, stride: int, margin: int) -> None:
        self._length, self._stride, self._margin = length, stride, margin
        self._first = 0
        self._u = np.empty(0)
        self._v = np.empty(0)

    def add(self, moves: Motion, rate_hz: float) -> Iterator[tuple[int, Float2D]]:
        """(sample index of its end, strip (point, 2) in mm and mm/s) of every strip now whole."""
        first = int(moves.index[0])
        if first != self._first + self._u.size:
            self._first, self._u, self._v = first, np.empty(0), np.empty(0)
        self._u = np.concatenate([self._u, moves.u])
        self._v = np.concatenate([self._v, moves.v])
        margin, length = self._margin, self._length
        start = -(-(self._first + margin) // length) * length
        while start + length + margin < self._first + self._u.size:
            at = np.arange(start, start + length + 1, self._stride) - self._first
            rise = self._u[at + margin] - self._u[at - margin]
            v = rise * (rate_hz / (2 * margin)) if margin else self._v[at]
            strip = 1e3 * np.stack([self._u[at], v], axis=1)
            strip = strip[np.isfinite(strip).all(axis=1)]
            start += length
            if len(strip) > 1:
                yield start, strip
        drop = max(start - margin - self._first, 0)
        self._first += drop
        self._u, self._v = self._u[drop:], self._v[drop:]


class Reach:
    """The half range of an axis: grows at once, shrinks when `hold` peaks fill less than 40 %."""

    def __init__(self, least: float, hold: int) -> None:
        self.value = least
        self._least = least
        self._peaks = np.zeros(hold)
        self._at = 0

    def see(self, peak: float) -> bool:
        """True if the range changed with this peak."""
        self._peaks[self._at % self._peaks.size] = peak
        self._at += 1
        highest = max(float(self._peaks.max()), self._least / 1.05)
        if 0.4 * self.value <= highest <= self.value:
            return False
        before, self.value = self.value, nice(1.05 * highest)
        return self.value != before


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


class Curves:
    """The PRC as it grows: eta_d over frequency."""

    def __init__(self, low_hz: float, high_hz: float) -> None:
        room = max(0.03 * (high_hz - low_hz), 0.05)
        self._range = (low_hz - room, high_hz + room)
        self._points: list[Point] = []
        self._top = 0.1

    @property
    def axes(self) -> Axes:
        return Axes(self._range, (0.0, self._top), "f [Hz]", "η_d [-]")

    def add(self, point: Point) -> bool:
        """True if the axes had to grow for this point."""
        self._points.append(point)
        etas = [who.eta_d for who in (point.measured, point.twin) if who is not None]
        highest = max((eta for eta in etas if math.isfinite(eta)), default=0.0)
        if highest <= self._top:
            return False
        self._top = nice(1.1 * highest)
        return True

    def of(self, who: str) -> list[tuple[Rgb, Float2D]]:
        """(colour, (point, 2) Hz and eta_d) of each direction that has points."""
        found = []
        for way, colour in zip(("forward", "backward"), PRC_COLOURS[who], strict=True):
            rows = [
                (point.frequency_hz, quantities.eta_d)
                for point in self._points
                if point.direction == way and (quantities := getattr(point, who)) is not None
            ]
            curve = np.array(rows, dtype=np.float64).reshape(-1, 2)
            curve = curve[np.isfinite(curve).all(axis=1)]
            if len(curve):
                found.append((colour, curve))
        return found


class ErrorShare:
    """Twin error of u in % of the measured RMS, gathered over half a second."""

    def __init__(self, rate_hz: float) -> None:
        self._half = max(1, round(rate_hz / 2))
        self._sums = np.zeros(3)

    def add(self, one: Comparison) -> tuple[int, Float2D] | None:
        """(sample index, (1, 2) free-running and restarted) when half a second is whole."""
        if "rel_disp_m" in one.channels:
            at = one.channels.index("rel_disp_m")
            self._sums += [one.measured_ss[at], one.free_error_ss[at], one.window_error_ss[at]]
        end = one.index + one.count
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


def pieces(blocks: Sequence[Block]) -> list[Block]:
    """The blocks joined where they follow each other with the same channels."""
    runs: list[list[Block]] = []
    for block in blocks:
        last = runs[-1][-1] if runs else None
        if last and last.end == block.index and last.channels == block.channels:
            runs[-1].append(block)
        else:
            runs.append([block])
    return [join(run) for run in runs]


DOING = {
    Label.REST: "at rest",
    Label.BLEND: "blending",
    Label.SETTLE: "settling",
    Label.MEASURE: "measuring",
    Label.STOP: "decaying to rest",
}


def status(start: RunStart, step: int, label: int) -> str:
    """Markdown: frequency, direction and step, and what the drive is doing."""
    doing = DOING.get(Label(label), "") if label in set(Label) else f"label {label}"
    if not 0 <= step < len(start.steps):
        return f"## {doing}\n{start.name}"
    one = start.steps[step]
    return (
        f"## {one.frequency_hz:g} Hz {one.direction}, {doing}\n"
        f"{start.name}, step {step + 1} of {len(start.steps)}"
    )


def point_table(point: Point) -> str:
    """Markdown: the numbers of a PRC point, measured beside twin."""
    ratios = (("eta_d", "η_d"), ("eta_a", "η_a"), ("eta_r", "η_R"), ("eta_l", "η_L"),
              ("r_r", "r_R"), ("r_l", "r_L"), ("drift", "drift of η_d"))  # fmt: skip
    counts = (("impacts_right", "impacts right"), ("impacts_left", "impacts left"))

    def cell(who: Quantities | None, name: str) -> str:
        value = getattr(who, name, None)
        if isinstance(value, tuple):
            return " ".join(str(one) for one in value) or "-"
        return "-" if value is None or math.isnan(value) else f"{value:.3f}"

    rows = [
        f"| {text} | {cell(point.measured, name)} | {cell(point.twin, name)} |"
        for name, text in (*ratios, *counts)
    ]
    head = f"### {point.frequency_hz:g} Hz {point.direction}\n"
    drive = f"table {point.table_acc_peak_m_s2:.3f} m/s², THD {100 * point.thd:.1f} %\n\n"
    return head + drive + "| | measured | twin |\n|---|---|---|\n" + "\n".join(rows)


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
    return "| | measured | twin |\n|---|---|---|\n" + "\n".join(lines)
