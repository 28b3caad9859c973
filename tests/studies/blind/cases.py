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
from table_io.sim.imperfections import (
    IMPERFECTION_IDS,
    HiddenParameter,
    Imperfection,
)
from tests.builders.laboratories import draw_laboratory

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
# Have entered the library since the cells were numbered: their cells are in the third group.
FORMER_STRANGERS = frozenset({
    "stribeck_friction", "position_damping", "dead_band", "adhesion", "bumper_cubic", "appendage",
})  # fmt: skip
LAST_OF_FIRST = "appendage"  # the definitions after it have appended cells
# Shape parameters are drawn log-uniformly, within the motion and the time scales of this test.
SHAPE_RANGES: Mapping[tuple[str, str], tuple[float, float]] = {
    ("bouc_wen", "yield_displacement"): (5e-4, 3e-3),
    ("maxwell_damper", "tau"): (0.02, 0.2),
    ("bumper_maxwell", "tau"): (0.01, 0.1),
    ("stribeck_friction", "ratio"): (2.0, 4.0),
    ("stribeck_friction", "speed"): (0.01, 0.05),
    ("appendage", "frequency"): (5.0, 9.0),
    ("appendage", "damping_ratio"): (0.01, 0.04),
    ("exponential_stiffness", "length"): (1e-3, 3e-3),
    ("saturating_stiffness", "length"): (1e-3, 5e-3),
    ("slack_stiffness", "slack"): (1e-3, 4e-3),
    ("saturating_damping", "speed"): (0.015, 0.03),
    ("warming_friction", "time"): (8.0, 30.0),
    ("softening_bumper", "time"): (5e-3, 0.05),
    ("dahl_friction", "length"): (5e-4, 3e-3),
    ("cubic_maxwell", "dashpot"): (500.0, 2e3),
    ("two_branch_maxwell", "time"): (0.1, 1.0),
    ("elastoplastic", "length"): (1e-3, 5e-3),
    ("cubic_appendage", "cubic"): (1e8, 5e8),
    ("cubic_appendage", "damping"): (1.0, 5.0),
    ("table_resonator", "mass"): (20.0, 80.0),
    ("table_resonator", "frequency"): (3.0, 8.0),
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
    last = next(i for i, entry in enumerate(EFFECT_DEFINITIONS) if entry.id == LAST_OF_FIRST)
    first, appended = EFFECT_DEFINITIONS[: last + 1], EFFECT_DEFINITIONS[last + 1 :]
    known = [
        PlantableEffect(definition)
        for definition in first
        if definition.in_library
        and not definition.is_sensor_effect
        and definition.id not in FORMER_STRANGERS
    ]
    sensors = [
        PlantableEffect(definition, channel)
        for definition in first
        if definition.is_sensor_effect
        for channel in SENSOR_CHANNELS[definition.id]
    ]
    others = [
        PlantableEffect(definition)
        for definition in first
        if definition.id not in MONITORED_ONLY
        and (not definition.in_library or definition.id in FORMER_STRANGERS)
    ]
    cells = [Cell("none", 0.0, noise) for noise in NOISE_LEVELS]
    cells += _make_effect_cells([*known, *sensors, *others])
    cells += [
        Cell("pair", size, noise, tuple(known))
        for size in RESIDUAL_SIZES[1:]
        for noise in NOISE_LEVELS
    ]
    new = _make_effect_cells([PlantableEffect(definition) for definition in appended])
    return (*cells, *_make_laboratory_cells(cells), *new, *_repeat_in_laboratory(new))


def _make_effect_cells(effects: Sequence[PlantableEffect]) -> list[Cell]:
    """Return the cells of one planted effect each, of all sizes and noises."""
    return [
        Cell(_find_kind(effect.definition), size, noise, (effect,))
        for effect in effects
        for size in RESIDUAL_SIZES
        for noise in NOISE_LEVELS
    ]


def _find_kind(definition: EffectDefinition) -> str:
    if definition.is_sensor_effect:
        return "sensor"
    return "single" if definition.in_library else "unknown"


def _make_laboratory_cells(ideal: Sequence[Cell]) -> list[Cell]:
    """Return the cells with a laboratory: those of the ideal rig that its targets are about."""
    clean = [cell for cell in ideal if cell.kind == "none" and cell.noise in LABORATORY_NOISE]
    alone = [
        replace(cell, laboratory=level, imperfection=imperfection)
        for level in LABORATORY_LEVELS[1:]
        for imperfection in IMPERFECTION_IDS
        for cell in clean
    ]
    together = [replace(cell, laboratory="typical") for cell in clean]
    identified = [replace(cell, kind="identify", laboratory="typical") for cell in clean]
    return [*alone, *together, *_repeat_in_laboratory(ideal), *identified]


def _repeat_in_laboratory(ideal: Sequence[Cell]) -> list[Cell]:
    """Return cells of planted effects again with typical instruments, where targets are."""
    return [
        replace(cell, laboratory="typical")
        for cell in ideal
        if cell.size in LABORATORY_SIZES and cell.noise in LABORATORY_NOISE
    ]


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
