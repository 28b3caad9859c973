"""Stratification of the study: cells of similar cases, and the case of every number.

A case number is 1000 x the index of its cell + the index in the cell. The case is drawn from its
number alone, so that it can be repeated independently of the others. New cells are appended.

Cells with a laboratory repeat those of the ideal rig with instruments as every laboratory has them
("typical"), and without an effect with one of them in need of repair ("bad").
"""

import fnmatch
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Literal

import numpy as np

from table_io.errors import InputError
from table_io.sim.ground_truth import EFFECT_DEFINITIONS, EffectDefinition
from table_io.sim.hidden_entry import HiddenParameter
from table_io.sim.imperfections import IMPERFECTION_IDS, Imperfection, draw_laboratory

NUMBERS_PER_CELL = 1000  # case numbers reserved per cell
RESIDUAL_SIZES = (1.5, 3.0, 10.0)  # residual of the base model over the noise floor
SIZE_TOLERANCE = (0.75, 1.34)  # accepted ratio of reached to requested size
NOISE_LEVELS = (0.002, 0.01, 0.05)  # relative to each channel's rms in the nominal test
BASE_SCATTER = 0.05  # relative, of stiffness, damping, bumpers and gap in every case
LABORATORY_SIZES, LABORATORY_NOISE = RESIDUAL_SIZES[1:], NOISE_LEVELS[:2]
CASE_MULTIPLE = 5  # times as many cases in cells without an effect and of pairs
STUDY_SEED = 20160  # of the random draws
LaboratoryLevel = Literal["none", "typical", "bad"]
LABORATORY_LEVELS: tuple[LaboratoryLevel, ...] = ("none", "typical", "bad")

SENSOR_CHANNELS = {
    "sensor_gain": ("mass_acc_m_s2", "mass_disp_m", "table_acc_m_s2", "force_r1_n"),
    "sensor_lag": ("mass_acc_m_s2", "mass_disp_m", "table_acc_m_s2"),
    "sensor_offset": ("mass_acc_m_s2", "mass_disp_m", "force_l1_n"),
}
# Effects drawn with either sign; the others have the sign of their typical value.
EITHER_SIGN = frozenset({
    "bumper_asymmetry", "gap_offset", "gap_drift", "table_tilt", "mass_error", "sensor_gain",
    "sensor_offset", "even_stiffness",
})  # fmt: skip
MONITORED_ONLY = frozenset({"stiffness_drift"})  # evaluated in condition monitoring, not here
# Shape parameters are drawn log-uniformly, within the motion and the time scales of this test.
SHAPE_RANGES: Mapping[tuple[str, str], tuple[float, float]] = {
    ("bouc_wen", "yield_displacement"): (5e-4, 3e-3),
    ("maxwell_damper", "tau"): (0.02, 0.2),
    ("bumper_maxwell", "tau"): (0.01, 0.1),
    ("coulomb_friction", "stribeck_speed"): (0.01, 0.05),
    ("appendage", "frequency"): (5.0, 9.0),
}


@dataclass(frozen=True, slots=True)
class PlantableEffect:
    """An effect that can be planted: its definition, and for a sensor effect the channel."""

    definition: EffectDefinition
    channel: str = ""

    @property
    def name(self) -> str:
        """Name as in a verdict: id, with the channel for sensors; a second form with its name."""
        if self.channel:
            return f"{self.definition.id}.{self.channel}"
        first = next(entry for entry in EFFECT_DEFINITIONS if entry.id == self.definition.id)
        return (
            self.definition.id
            if self.definition == first
            else f"{self.definition.id}.{self.definition.form}"
        )

    @property
    def amplitudes(self) -> tuple[HiddenParameter, ...]:
        """Amplitude parameters: the effect vanishes with them, and they are scaled together."""
        return tuple(
            parameter for parameter in self.definition.parameters if parameter.vanishing is not None
        )


@dataclass(frozen=True, slots=True)
class Cell:
    """Cell of similar cases: `kind` is single, sensor, none, pair or unknown (not in the library).

    `effects` are the planted ones; of pairs those from which each case draws two. The kind identify
    plants none, and identifies parameters in place of effects. `imperfection` is the only one of
    the laboratory; empty for all of them.
    """

    kind: str
    size: float
    noise: float
    effects: tuple[PlantableEffect, ...] = ()
    laboratory: LaboratoryLevel = "none"
    imperfection: str = ""

    @property
    def name(self) -> str:
        """Name, for example single/coulomb_friction/3/1% or typical/none/hum/1%."""
        level = "" if self.laboratory == "none" else self.laboratory
        return "/".join(part for part in (level, self.stratum) if part)

    @property
    def stratum(self) -> str:
        """Name without the laboratory."""
        effect_name = self.effects[0].name if self.kind in ("single", "sensor", "unknown") else ""
        size = f"{self.size:g}" if self.size else ""
        parts = (self.kind, effect_name, self.imperfection, size, f"{100 * self.noise:g}%")
        return "/".join(part for part in parts if part)

    def accepts(self, reached: float) -> bool:
        """Return whether a case of this size belongs to the cell; pairs may have any size."""
        if not self.size or self.kind == "pair":
            return True
        return SIZE_TOLERANCE[0] <= reached / self.size <= SIZE_TOLERANCE[1]

    def case_count(self, seeds: int) -> int:
        """Return the number of cases of the cell for `seeds`."""
        is_large = self.kind in ("none", "pair", "identify") and not self.imperfection
        return seeds * (CASE_MULTIPLE if is_large else 1)


@dataclass(frozen=True, slots=True)
class PlantedEffect:
    """Effect of a case: shapes and sign of the amplitudes; `amplitude_search` finds their size."""

    effect: PlantableEffect
    sign: float
    shapes: Mapping[str, float] = field(hash=False)


@dataclass(frozen=True, slots=True)
class Case:
    """One case without its amplitudes. `label` names its folders and reveals nothing."""

    number: int
    cell: Cell
    label: str
    base: Mapping[str, float] = field(hash=False)  # ratios of true to nominal values
    planted: tuple[PlantedEffect, ...]
    noise_seed: int
    salt: str  # in the sealed file, so that the truth cannot be found from its hash
    imperfections: tuple[Imperfection, ...] = field(default=(), hash=False)


def _make_cells() -> tuple[Cell, ...]:
    known = [
        PlantableEffect(definition)
        for definition in EFFECT_DEFINITIONS
        if definition.in_library and not definition.is_sensor_effect
    ]
    sensors = [
        PlantableEffect(definition, channel)
        for definition in EFFECT_DEFINITIONS
        if definition.is_sensor_effect
        for channel in SENSOR_CHANNELS[definition.id]
    ]
    unknown = [
        PlantableEffect(definition)
        for definition in EFFECT_DEFINITIONS
        if not definition.in_library and definition.id not in MONITORED_ONLY
    ]
    groups = (("single", known), ("sensor", sensors), ("unknown", unknown))
    cells = [Cell("none", 0.0, noise) for noise in NOISE_LEVELS]
    cells += [
        Cell(kind, size, noise, (effect,))
        for kind, group in groups
        for effect in group
        for size in RESIDUAL_SIZES
        for noise in NOISE_LEVELS
    ]
    cells += [
        Cell("pair", size, noise, tuple(known))
        for size in RESIDUAL_SIZES[1:]
        for noise in NOISE_LEVELS
    ]
    return (*cells, *_make_laboratory_cells(cells))


def _make_laboratory_cells(ideal: Sequence[Cell]) -> list[Cell]:
    """Return the cells with a laboratory: those of the ideal rig that its targets are about."""
    clean = [cell for cell in ideal if cell.kind == "none" and cell.noise in LABORATORY_NOISE]
    hidden = [
        cell for cell in ideal if cell.size in LABORATORY_SIZES and cell.noise in LABORATORY_NOISE
    ]
    alone = [
        replace(cell, laboratory=level, imperfection=imperfection)
        for level in LABORATORY_LEVELS[1:]
        for imperfection in IMPERFECTION_IDS
        for cell in clean
    ]
    together = [replace(cell, laboratory="typical") for cell in (*clean, *hidden)]
    identified = [replace(cell, kind="identify", laboratory="typical") for cell in clean]
    return [*alone, *together, *identified]


CELLS = _make_cells()


def draw_case(number: int) -> Case:
    """Draw the case of a number; InputError if no cell has it."""
    if not 0 <= number < NUMBERS_PER_CELL * len(CELLS):
        raise InputError(
            "no such case",
            key="case",
            value=number,
            allowed=f"0 to {NUMBERS_PER_CELL * len(CELLS) - 1}",
        )
    cell = CELLS[number // NUMBERS_PER_CELL]
    generator = np.random.default_rng(np.random.SeedSequence([STUDY_SEED, number]))
    keys = ("damper_stiffness", "damper_damping", "bumper_stiffness", "bumper_damping", "gap")
    base = {name: 1.0 + float(generator.uniform(-BASE_SCATTER, BASE_SCATTER)) for name in keys}
    effects = cell.effects
    if cell.kind == "pair":
        pairs = list(combinations(cell.effects, 2))
        effects = pairs[int(generator.integers(len(pairs)))]
    planted = tuple(_draw_effect(effect, generator) for effect in effects)
    noise_seed, salt = int(generator.integers(2**31)), generator.bytes(16).hex()
    label = hashlib.blake2s(f"{STUDY_SEED} {number}".encode(), digest_size=5).hexdigest()
    imperfections: Sequence[Imperfection] = ()
    if cell.laboratory != "none":
        imperfections = draw_laboratory(cell.laboratory, generator, cell.imperfection or None)
    return Case(number, cell, label, base, planted, noise_seed, salt, tuple(imperfections))


def _draw_effect(effect: PlantableEffect, generator: np.random.Generator) -> PlantedEffect:
    is_negative = generator.random() < 0.5
    sign = -1.0 if is_negative and effect.definition.id in EITHER_SIGN else 1.0
    shapes = {
        name: float(np.exp(generator.uniform(*np.log(bounds))))
        for (effect_id, name), bounds in SHAPE_RANGES.items()
        if effect_id == effect.definition.id
        and name in {parameter.name for parameter in effect.definition.parameters}
    }
    return PlantedEffect(effect, sign, shapes)


def list_case_numbers(
    seeds: int, patterns: Sequence[str] = (), laboratory: LaboratoryLevel = "none"
) -> list[int]:
    """Return the numbers of `seeds` cases per cell of a laboratory that matches (default: all).

    The first case of every cell comes first, so that an interrupted study covers all cells.
    InputError if a pattern matches no cell; patterns are of names without the laboratory.
    """
    strata = {k: cell.stratum for k, cell in enumerate(CELLS) if cell.laboratory == laboratory}
    max_seeds = NUMBERS_PER_CELL // CASE_MULTIPLE
    if not 1 <= seeds <= max_seeds:
        raise InputError(
            "invalid number of cases per cell",
            key="--seeds",
            value=seeds,
            allowed=f"1 to {max_seeds}",
        )
    chosen = set() if patterns else {*strata}
    for pattern in patterns:
        matches = {k for k, name in strata.items() if fnmatch.fnmatchcase(name, pattern)}
        if not matches:
            names = [*strata.values()]
            examples = ", ".join(names[k] for k in (0, 3, 4, len(names) - 1))
            raise InputError(
                "no cell matches",
                key="--cells",
                value=pattern,
                allowed=f"names such as {examples}, with * for any text",
            )
        chosen |= matches
    numbered = [
        (place, NUMBERS_PER_CELL * cell + place)
        for cell in sorted(chosen)
        for place in range(CELLS[cell].case_count(seeds))
    ]
    return [number for _, number in sorted(numbered)]
