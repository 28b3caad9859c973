"""`Model`: base parameters and the effects that stand on them; it hands out its solver."""

import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

from table_io.card import BadInput
from twin.model.effects import find_effect
from twin.model.effects.effect import Effect
from twin.model.parameters import Parameters
from twin.model.solver import Solver

CHANNELS = (
    "rel_disp_m", "rel_vel_m_s", "mass_disp_m", "mass_acc_m_s2",
    "force_r1_n", "force_r2_n", "force_l1_n", "force_l2_n",
)  # fmt: skip
SAMPLES_PER_CONTACT = 10  # least, in half a period of the fastest phase


@dataclass(frozen=True, slots=True)
class Active:
    """An effect with its values in SI; `channel` where it is a sensor's."""

    effect: Effect
    values: Mapping[str, float] = field(hash=False)
    channel: str = ""

    @classmethod
    def of(cls, effect: Effect, values: Mapping[str, float], channel: str = "") -> "Active":
        """Checked: BadInput names what is unknown, missing, out of bounds."""
        if effect.acts == "sensor" and channel not in CHANNELS:
            near = difflib.get_close_matches(channel, CHANNELS, 1, 0.4)
            hint = f"did you mean {near[0]!r}?" if near else f"allowed: {', '.join(CHANNELS)}"
            raise BadInput(f"effect {effect.id!r}: channel {channel!r} is not predicted; {hint}")
        if effect.acts != "sensor" and channel:
            raise BadInput(f"effect {effect.id!r} has no channel; remove {channel!r}")
        effect.check(values)
        return cls(effect, dict(values), channel)

    @property
    def name(self) -> str:
        """The id, for sensors with the channel: what a model has at most one of."""
        return f"{self.effect.id}.{self.channel}" if self.channel else self.effect.id

    @property
    def absent(self) -> bool:
        return self.effect.absent(self.values)


@dataclass(frozen=True, slots=True)
class Sensor:
    """How a predicted channel is read: gain x value(t - lag) + offset; lag in s."""

    channel: str
    gain: float = 1.0
    lag: float = 0.0
    offset: float = 0.0

    @property
    def numbers(self) -> dict[str, float]:
        return {"gain": self.gain, "lag": self.lag, "offset": self.offset}


@dataclass(frozen=True)
class Model:
    """The SNM with `base` parameters and effects; one at its vanishing value is exactly absent."""

    base: Parameters
    effects: tuple[Active, ...] = ()

    def __post_init__(self) -> None:
        present = {one.effect.id for one in self.present}
        p = self.parameters
        if {"hunt_crossley", "bumper_maxwell"} <= present and not (
            p.bumper_damping_r > 0 and p.bumper_damping_l > 0
        ):
            raise BadInput(
                "hunt_crossley and bumper_maxwell together need a bumper damping above 0 N s/m: "
                "with none at touch nothing tells how fast the relaxing face moves; give one"
            )

    @cached_property
    def present(self) -> tuple[Active, ...]:
        """The effects that are not at their vanishing values."""
        return tuple(one for one in self.effects if not one.absent)

    @cached_property
    def parameters(self) -> Parameters:
        """The base as the effects that act on parameters leave it."""
        result = self.base
        for one in self.present:
            result = one.effect.apply(result, one.values)
        return result

    @property
    def sensors(self) -> tuple[Sensor, ...]:
        """The channels that are not read as they are."""
        found: dict[str, Sensor] = {}
        for one in self.present:
            if one.effect.acts == "sensor":
                before = found.get(one.channel, Sensor(one.channel))
                found[one.channel] = Sensor(one.channel, **{**before.numbers, **one.values})
        return tuple(found.values())

    def value(self, effect: str, parameter: str) -> float | None:
        """A present effect's parameter; None where the effect is absent."""
        for one in self.present:
            if one.effect.id == effect:
                return one.values[parameter]
        return None

    def opened(self, time_s: float) -> float:
        """m by which each gap has drifted open, time_s after sample 0."""
        return (self.value("gap_drift", "rate") or 0.0) * time_s

    def with_effect(self, effect: str, channel: str = "", **values: float) -> "Model":
        """This model with one effect more, or with other values of one that it has."""
        new = Active.of(find_effect(effect), values, channel)
        kept = tuple(one for one in self.effects if one.name != new.name)
        return Model(self.base, (*kept, new))

    def flat(self) -> dict[str, float]:
        """Every number under a flat name: the base's, and `effect.parameter` or
        `effect.channel.parameter`."""
        values = self.base.as_dict()
        for one in self.effects:
            values |= {f"{one.name}.{name}": value for name, value in one.values.items()}
        return values

    @classmethod
    def from_flat(cls, values: Mapping[str, float]) -> "Model":
        """The inverse of `flat`; BadInput names what is missing or unknown."""
        base = {name: value for name, value in values.items() if "." not in name}
        effects: dict[tuple[str, str], dict[str, float]] = {}
        for name, value in values.items():
            if "." in name:
                effect, *channel, parameter = name.split(".")
                effects.setdefault((effect, ".".join(channel)), {})[parameter] = value
        return cls(
            Parameters.from_dict(base),
            tuple(
                Active.of(find_effect(effect), own, channel)
                for (effect, channel), own in effects.items()
            ),
        )

    def prepare(self, rate_hz: float) -> Solver:
        """The solver at this sampling rate; the path is chosen by what the effects leave linear.

        Compiles what that path needs where it is not cached. BadInput as in `fits`.
        """
        self.fits(rate_hz)
        if any(one.effect.acts in ("force", "linear") for one in self.present):
            from twin.model.integrated import IntegratedSolver

            return IntegratedSolver.of(self, rate_hz)
        from twin.model.closed import ClosedSolver

        return ClosedSolver.of(self, rate_hz)

    def fits(self, rate_hz: float) -> None:
        """BadInput where this sampling rate is too low to follow a contact."""
        if not (math.isfinite(rate_hz) and rate_hz > 0):
            raise BadInput(f"rate_hz = {rate_hz:g}: allowed: above 0 Hz, finite")
        least = self.least_rate_hz
        if rate_hz < least:
            lasts = SAMPLES_PER_CONTACT / least
            raise BadInput(
                f"rate_hz {rate_hz:g}: too low for the bumper: a contact of this model lasts "
                f"{1e3 * lasts:.3g} ms; allowed: {least:.4g} Hz or more; raise rate_hz"
            )

    @property
    def least_rate_hz(self) -> float:
        """The sampling rate that has `SAMPLES_PER_CONTACT` in half a period of any phase."""
        return SAMPLES_PER_CONTACT * self._fastest() / math.pi

    def _fastest(self) -> float:
        """The highest angular frequency of any phase in 1/s, without nonlinear terms."""
        p, kb = self.parameters, self.value("bumper_maxwell", "kb") or 0.0
        sides = [
            stiffness + kb
            for stiffness, gap in (
                (p.bumper_stiffness_r, p.gap_r),
                (p.bumper_stiffness_l, p.gap_l),
            )
            if math.isfinite(gap)
        ]
        both = p.gap_r + p.gap_l <= 0
        contact = sum(sides) if both else max(sides, default=0.0)
        k = p.stiffness + (self.value("maxwell_damper", "k1") or 0.0) + contact
        return math.sqrt(k / p.mass)
