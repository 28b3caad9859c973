"""What the study asks: cells of like cases, and the case of every number, drawn from it alone.

A number is 1000 x the place of its cell + the place in the cell, so a case can be made by itself
and means the same whatever else is asked. New cells go to the end.
"""

import fnmatch
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np

from table_io.backends.truth import ALL, Kind, Quantity
from table_io.card import BadInput

PER_CELL = 1000  # numbers a cell has
SIZES = (1.5, 3.0, 10.0)  # of the baseline's residual, over the noise floor
REACHED = (0.75, 1.34)  # of the size asked for: what leaves more or less is not of the cell
NOISES = (0.002, 0.01, 0.05)  # of each channel's rms over the nominal test
SCATTER = 0.05  # of stiffness, damping, bumpers and gap, either way, in every case
CLEAN = 5  # times as many cases in a cell of nothing and of pairs
SEED = 20160  # of the study

CHANNELS = {
    "sensor_gain": ("mass_acc_m_s2", "mass_disp_m", "table_acc_m_s2", "force_r1_n"),
    "sensor_lag": ("mass_acc_m_s2", "mass_disp_m", "table_acc_m_s2"),
    "sensor_offset": ("mass_acc_m_s2", "mass_disp_m", "force_l1_n"),
}
# Effects that are as likely either way; the others have the sign of their typical value.
EITHER = frozenset({
    "bumper_asymmetry", "gap_offset", "gap_drift", "table_tilt", "mass_error", "sensor_gain",
    "sensor_offset", "even_stiffness",
})  # fmt: skip
LIVE = frozenset({"stiffness_drift"})  # what the watch of a running test is judged on, not this
# Shapes are drawn evenly in their logarithm: within the motion of this test, and its time scales.
SHAPES: Mapping[tuple[str, str], tuple[float, float]] = {
    ("bouc_wen", "yield_displacement"): (5e-4, 3e-3),
    ("maxwell_damper", "tau"): (0.02, 0.2),
    ("bumper_maxwell", "tau"): (0.01, 0.1),
    ("coulomb_friction", "stribeck_speed"): (0.01, 0.05),
    ("appendage", "frequency"): (5.0, 9.0),
}


@dataclass(frozen=True, slots=True)
class Hidden:
    """An effect to plant: a kind, on a channel where it is a sensor's."""

    kind: Kind
    channel: str = ""

    @property
    def name(self) -> str:
        """As a verdict says it: the id, for sensors with the channel; else with the form."""
        if self.channel:
            return f"{self.kind.id}.{self.channel}"
        first = next(one for one in ALL if one.id == self.kind.id)
        return self.kind.id if self.kind == first else f"{self.kind.id}.{self.kind.form}"

    @property
    def amplitudes(self) -> tuple[Quantity, ...]:
        """The parameters with which it vanishes; they grow together."""
        return tuple(one for one in self.kind.parameters if one.vanishing is not None)


@dataclass(frozen=True, slots=True)
class Cell:
    """Like cases: `kind` is single, sensor, none, pair or unknown (not in the library).

    `hidden` is what is planted; of pairs the choice from which each case draws two.
    """

    kind: str
    size: float
    noise: float
    hidden: tuple[Hidden, ...] = ()

    @property
    def name(self) -> str:
        what = self.hidden[0].name if self.kind in ("single", "sensor", "unknown") else ""
        size = f"{self.size:g}" if self.size else ""
        return "/".join(part for part in (self.kind, what, size, f"{100 * self.noise:g}%") if part)

    def takes(self, reached: float) -> bool:
        """Whether a case of this size belongs here; two effects together leave what they do."""
        if self.kind in ("none", "pair"):
            return True
        return REACHED[0] <= reached / self.size <= REACHED[1]

    def cases(self, seeds: int) -> int:
        """How many cases `seeds` makes here."""
        return seeds * (CLEAN if self.kind in ("none", "pair") else 1)


@dataclass(frozen=True, slots=True)
class Planted:
    """An effect of a case: its shapes, and which way its amplitudes go. Not how far: see sizing."""

    hidden: Hidden
    way: float
    shapes: Mapping[str, float] = field(hash=False)


@dataclass(frozen=True, slots=True)
class Case:
    """One case, all of it but the amplitudes. `label` names its folders and says nothing."""

    number: int
    cell: Cell
    label: str
    base: Mapping[str, float] = field(hash=False)  # true over nominal
    planted: tuple[Planted, ...]
    noise_seed: int
    salt: str  # in the sealed file, so that its hash cannot be guessed


def _cells() -> tuple[Cell, ...]:
    known = [Hidden(one) for one in ALL if one.in_library and not one.sensor]
    sensors = [Hidden(one, channel) for one in ALL if one.sensor for channel in CHANNELS[one.id]]
    unknown = [Hidden(one) for one in ALL if not one.in_library and one.id not in LIVE]
    groups = (("single", known), ("sensor", sensors), ("unknown", unknown))
    found = [Cell("none", 0.0, noise) for noise in NOISES]
    found += [
        Cell(kind, size, noise, (one,))
        for kind, group in groups
        for one in group
        for size in SIZES
        for noise in NOISES
    ]
    found += [Cell("pair", size, noise, tuple(known)) for size in SIZES[1:] for noise in NOISES]
    return tuple(found)


CELLS = _cells()


def case_of(number: int) -> Case:
    """The case of a number; BadInput where no cell has it."""
    if not 0 <= number < PER_CELL * len(CELLS):
        raise BadInput(f"case {number}: allowed: 0 to {PER_CELL * len(CELLS) - 1}")
    cell = CELLS[number // PER_CELL]
    draw = np.random.default_rng(np.random.SeedSequence([SEED, number]))
    names = ("damper_stiffness", "damper_damping", "bumper_stiffness", "bumper_damping", "gap")
    base = {name: 1.0 + float(draw.uniform(-SCATTER, SCATTER)) for name in names}
    chosen = cell.hidden
    if cell.kind == "pair":
        pairs = list(combinations(cell.hidden, 2))
        chosen = pairs[int(draw.integers(len(pairs)))]
    planted = tuple(_planted(one, draw) for one in chosen)
    noise_seed, salt = int(draw.integers(2**31)), draw.bytes(16).hex()
    label = hashlib.blake2s(f"{SEED} {number}".encode(), digest_size=5).hexdigest()
    return Case(number, cell, label, base, planted, noise_seed, salt)


def _planted(hidden: Hidden, draw: np.random.Generator) -> Planted:
    either = draw.random() < 0.5
    way = -1.0 if either and hidden.kind.id in EITHER else 1.0
    shapes = {
        name: float(np.exp(draw.uniform(*np.log(between))))
        for (effect, name), between in SHAPES.items()
        if effect == hidden.kind.id and name in {one.name for one in hidden.kind.parameters}
    }
    return Planted(hidden, way, shapes)


def cases(seeds: int, patterns: Sequence[str] = ()) -> list[int]:
    """The numbers of `seeds` cases a cell, of the cells that a pattern fits (none: of all).

    One of each cell first, so that a study which is broken off has looked everywhere.
    BadInput where a pattern fits no cell.
    """
    most = PER_CELL // CLEAN
    if not 1 <= seeds <= most:
        raise BadInput(f"--seeds {seeds}: allowed: 1 to {most}")
    chosen = set(range(len(CELLS))) if not patterns else set()
    for pattern in patterns:
        fits = {k for k, cell in enumerate(CELLS) if fnmatch.fnmatchcase(cell.name, pattern)}
        if not fits:
            some = ", ".join(CELLS[k].name for k in (0, 3, 4, len(CELLS) - 1))
            raise BadInput(f"--cells {pattern}: fits no cell; they are named like {some}; * is any")
        chosen |= fits
    found = [
        (place, PER_CELL * cell + place)
        for cell in sorted(chosen)
        for place in range(CELLS[cell].cases(seeds))
    ]
    return [number for _, number in sorted(found)]
