"""The candidates: every effect of the library, on every channel where it is a sensor's.

A candidate's amplitude enters the forces in proportion (or nearly), its shape does not: so each
stands here with a ladder of shapes, and what is between the rungs is left to the fit.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from table_io.channels import LEFT_CELLS, RIGHT_CELLS
from twin.learn.general import GENERAL, free_of, terms
from twin.learn.guess import SLIP, Free, Guess, effect_free
from twin.learn.sheet import Sheet
from twin.model.effects import EFFECTS, plugins
from twin.model.effects.effect import Effect

RUNGS = 9
SLIPS = (1e-5, 3e-4, 1e-3, 3e-3)  # m/s; every rig has its own way through a standstill
BUMPERS = frozenset({
    "bumper_hardening", "hunt_crossley", "bumper_maxwell", "bumper_asymmetry", "gap_offset",
    "gap_drift",
})  # fmt: skip
NEEDS = {"table_tilt": ("table_disp_m",)}  # channels without which an effect cannot be seen


@dataclass(frozen=True, slots=True)
class Candidate:
    """Something that may be missing, with a ladder of values for its shape.

    `effect` None: a general term, that stands for what is not in the library.
    """

    name: str
    free: tuple[Free, ...]
    amplitude: Free  # of `free`: the one with which it vanishes
    vanishing: float
    shapes: tuple[tuple[float, ...], ...]  # of the others, in their order
    effect: Effect | None = None
    channel: str = ""

    @classmethod
    def of(cls, effect: Effect, channel: str, shapes: tuple[tuple[float, ...], ...]) -> "Candidate":
        """An effect of the library; on a channel where it is a sensor's."""
        free = effect_free(effect, channel)
        index = next(i for i, p in enumerate(effect.parameters) if p.vanishing is not None)
        vanishing = float(effect.parameters[index].vanishing or 0.0)
        name = f"{effect.id}.{channel}" if channel else effect.id
        amplitude = free[index]
        if effect.id == "coulomb_friction":
            slip = Free(SLIP, (SLIP,), SLIPS[0], 3.0 * SLIPS[-1], SLIPS[0], "m/s", logarithmic=True)
            free, shapes = (*free, slip), tuple((speed,) for speed in SLIPS)
        return cls(name, free, amplitude, vanishing, shapes, effect, channel)

    def put(self, guess: Guess, shape: Sequence[float], amplitude: float | None = None) -> Guess:
        """The guess with this; without an amplitude, at its vanishing value."""
        others = [one for one in self.free if one is not self.amplitude]
        values = dict(zip((one.name for one in others), shape, strict=True))
        values[self.amplitude.name] = self.vanishing if amplitude is None else amplitude
        return guess.moved(values)


def general(touched: bool) -> tuple[Candidate, ...]:
    """The terms without a name."""
    found = []
    for name, ladder in terms(touched):
        free = free_of(name, ladder)
        shapes = tuple((width,) for width in ladder) or ((),)
        found.append(Candidate(f"{GENERAL}.{name}", free, free[0], 0.0, shapes))
    return tuple(found)


def candidates(
    sheets: Sequence[Sheet], known: Guess, without: Sequence[str] = ()
) -> tuple[tuple[Candidate, ...], dict[str, str]]:
    """(what may be missing from the guess, why the others fall away)."""
    touched = any((sheet.touched != 0).any() for sheet in sheets)
    channels = set.intersection(*(set(sheet.readings.channels) for sheet in sheets))
    found, away = [], {}
    for effect in (*EFFECTS, *plugins()):
        reason = _cannot(effect, touched, channels)
        if effect.id in without:
            reason = "left out of the library"
        if reason:
            away[effect.id] = reason
            continue
        for channel in sorted(_readable(channels)) if effect.acts == "sensor" else ("",):
            one = Candidate.of(effect, channel, _shapes(effect, sheets))
            taken = {free.name for free in one.free} & known.values.keys()
            if not taken and not _blind(one, channels) and not _idle(one, sheets):
                found.append(one)
    return tuple(found), away


def _cannot(effect: Effect, touched: bool, channels: set[str]) -> str:
    if effect.id in BUMPERS and not touched:
        return "no bumper was touched"
    missing = [name for name in NEEDS.get(effect.id, ()) if name not in channels]
    if missing:
        return f"needs {', '.join(missing)}"
    if effect.id == "mass_error":
        cells = channels & {*RIGHT_CELLS, *LEFT_CELLS}
        if "damper_force_n" in channels or not (cells and touched):
            return "needs a force that was measured beside the acceleration of the mass"
    return ""


def _readable(channels: set[str]) -> set[str]:
    """The channels whose sensor can be judged: not one that all else is measured by."""
    both = {"mass_disp_m", "table_disp_m"} <= channels
    return channels - ({"rel_disp_m"} if both else {"mass_disp_m", "table_disp_m"})


def _blind(one: Candidate, channels: set[str]) -> bool:
    """True for a gain or lag that nothing measured can contradict."""
    gain = one.name.startswith("sensor_gain.")
    if "damper_force_n" in channels and one.channel == "damper_force_n":
        return gain
    unchecked = "mass_acc_m_s2" not in channels
    return unchecked and gain and one.channel in ("table_acc_m_s2", "rel_disp_m")


def _idle(one: Candidate, sheets: Sequence[Sheet]) -> bool:
    """True for gain or lag of a load cell that bore nothing: it would only scale the noise."""
    sides = [side for side, cells in enumerate((RIGHT_CELLS, LEFT_CELLS)) if one.channel in cells]
    offset = one.name.startswith("sensor_offset.")
    return not offset and any(
        not any((sheet.touched[side] > 0).any() for sheet in sheets) for side in sides
    )


def _shapes(effect: Effect, sheets: Sequence[Sheet]) -> tuple[tuple[float, ...], ...]:
    """A ladder for one shape parameter by its unit; for several, their typical values."""
    amplitude = next(p for p in effect.parameters if p.vanishing is not None)
    shapes = [p for p in effect.parameters if p is not amplitude]
    if len(shapes) != 1:
        return (tuple(p.typical for p in shapes),)
    (p,) = shapes
    if p.unit == "m":
        far = max(float(np.abs(sheet.motion().u[sheet.used[0]]).max()) for sheet in sheets)
        low, high = 0.01 * far, 2.0 * far
    elif p.unit == "s":
        long = max(float(np.ptp(sheet.motion().time_s)) for sheet in sheets)
        low, high = 0.5 / sheets[0].motion().rate_hz, min(0.1 * long, 3.0)
    else:
        low, high = 0.1 * p.typical, 10.0 * p.typical
    low, high = max(low, p.low), min(high, p.high)
    ladder = np.exp(np.linspace(math.log(low), math.log(high), RUNGS))
    return tuple((min(max(float(rung), p.low), p.high),) for rung in ladder)
