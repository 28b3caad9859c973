"""`Model`: base parameters and the effects added to them."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, overload

from table_io.block import Float1D
from table_io.errors import InputError, suggest
from twin.laws.effect import Effect
from twin.laws.library import find_effect
from twin.model.parameters import Parameters

SENSOR_CHANNELS = (
    "rel_disp_m", "rel_vel_m_s", "mass_disp_m", "mass_acc_m_s2",
    "force_r1_n", "force_r2_n", "force_l1_n", "force_l2_n",
)  # fmt: skip
MIN_SAMPLES_PER_CONTACT = 10  # in half a period of the fastest mode


@dataclass(frozen=True, slots=True)
class EffectInstance:
    """An effect with its values in SI; `channel` is set for sensor effects."""

    effect: Effect
    values: Mapping[str, float] = field(hash=False)
    channel: str = ""

    @classmethod
    def create(
        cls, effect: Effect, values: Mapping[str, float], channel: str = ""
    ) -> "EffectInstance":
        """Create a validated instance; InputError names unknown, missing, out-of-bounds values."""
        if effect.acts == "sensor" and channel not in SENSOR_CHANNELS:
            raise InputError(
                "the model does not predict this channel",
                where=f"effect {effect.id!r}",
                key="channel",
                value=channel,
                remedy=suggest(channel, SENSOR_CHANNELS),
            )
        if effect.acts != "sensor" and channel:
            raise InputError(
                "this effect has no channel",
                where=f"effect {effect.id!r}",
                key="channel",
                value=channel,
                remedy="omit it",
            )
        effect.validate(values)
        return cls(effect, dict(values), channel)

    @property
    def name(self) -> str:
        """Effect id, with the channel for sensor effects; unique in a model."""
        return f"{self.effect.id}.{self.channel}" if self.channel else self.effect.id

    @property
    def is_absent(self) -> bool:
        return self.effect.is_absent(self.values)


@dataclass(frozen=True, slots=True)
class SensorModel:
    """Reading of a predicted channel: gain x value(t - lag) + offset; lag in s."""

    channel: str
    gain: float = 1.0
    lag: float = 0.0
    offset: float = 0.0

    @property
    def coefficients(self) -> dict[str, float]:
        return {"gain": self.gain, "lag": self.lag, "offset": self.offset}


@dataclass(frozen=True)
class Model:
    """The SNM with `base` parameters and effects; one at its vanishing value is exactly absent."""

    base: Parameters
    effects: tuple[EffectInstance, ...] = ()

    def __post_init__(self) -> None:
        p = self.parameters
        has_dashpots = p.bumper_damping_r > 0 and p.bumper_damping_l > 0
        for effect, _ in self.added_laws:
            if effect.is_in_bumpers and effect.states and not has_dashpots:
                raise InputError(
                    "a bumper law with memory needs bumper damping: without it the speed of a free "
                    "face is undefined",
                    where=f"effect {effect.id!r}",
                    allowed="bumper damping above 0 N s/m",
                    remedy="set a bumper damping or remove the effect",
                )
        if {"ch", "kb"} <= self.coefficients.keys() and not has_dashpots:
            raise InputError(
                "hunt_crossley and bumper_maxwell together need bumper damping: without it the "
                "speed of the relaxing face at touch is undefined",
                allowed="bumper damping above 0 N s/m",
                remedy="set a bumper damping or remove one of the effects",
            )

    @cached_property
    def present_effects(self) -> tuple[EffectInstance, ...]:
        """Effects that are not at their vanishing values."""
        return tuple(instance for instance in self.effects if not instance.is_absent)

    @cached_property
    def changes_only_parameters(self) -> bool:
        """True if all effects act on parameters or sensors: under a sine it has a closed form."""
        return all(
            instance.effect.acts in ("parameters", "sensor") for instance in self.present_effects
        )

    @cached_property
    def parameters(self) -> Parameters:
        """Base parameters as changed by the effects that act on parameters."""
        result = self.base
        for instance in self.present_effects:
            if instance.effect.changes:
                changed = instance.effect.change_base(result.as_dict(), instance.values)
                result = replace(result, **changed)
        return result

    @property
    def sensors(self) -> tuple[SensorModel, ...]:
        """Sensor models of the channels that sensor effects change."""
        sensors: dict[str, SensorModel] = {}
        for instance in self.present_effects:
            if instance.effect.acts == "sensor":
                previous = sensors.get(instance.channel, SensorModel(instance.channel))
                sensors[instance.channel] = SensorModel(
                    instance.channel, **{**previous.coefficients, **instance.values}
                )
        return tuple(sensors.values())

    @cached_property
    def coefficients(self) -> dict[str, float]:
        """What the solver knows of the present effects by coefficients, SI, by name; summed."""
        total: dict[str, float] = {}
        base = self.parameters.as_dict()
        for instance in self.present_effects:
            own = instance.effect.work_out_coefficients(base, instance.values)
            for name, value in own.items():
                total[name] = total.get(name, 0.0) + value
        return total

    @cached_property
    def added_laws(self) -> tuple[tuple[Effect, tuple[float, ...]], ...]:
        """Present effects whose force is compiled as written, each with its constants."""
        base = self.parameters.as_dict()
        return tuple(
            (instance.effect, instance.effect.list_constants(base, instance.values))
            for instance in self.present_effects
            if instance.effect.is_added_law
        )

    @property
    def break_away_force_n(self) -> float:
        """Force in N up to which dry friction holds the mass."""
        return self.coefficients.get("fc", 0.0)

    @cached_property
    def _input_effects(self) -> tuple[EffectInstance, ...]:
        return tuple(i for i in self.present_effects if i.effect.place == "input")

    @property
    def uses_table_displacement(self) -> bool:
        """Return whether the motion depends on the displacement of the table."""
        return bool(self._input_effects)

    @overload
    def added_acceleration(self, table_disp: float) -> float | None: ...
    @overload
    def added_acceleration(self, table_disp: Float1D) -> Float1D | None: ...
    def added_acceleration(self, table_disp: Any) -> Any:
        """Return what input effects add to the table acceleration in m/s2; None without any.

        It acts on the mass only: a sensor on the table does not measure it.
        """
        added = None
        for instance in self._input_effects:
            own = instance.effect.evaluate_force(instance.values, {"y": table_disp})
            added = own if added is None else added + own
        return added

    def gap_opening_m(self, time_s: float) -> float:
        """Return by how many m each gap has drifted open, `time_s` after sample 0."""
        return self.coefficients.get("drift", 0.0) * time_s

    def require_steady_state(self) -> None:
        """Raise InputError if an effect changes with time: no motion repeats itself then."""
        for instance in self.present_effects:
            if instance.effect.changes_with_time:
                raise InputError(
                    "a model that changes with time has no periodic motion",
                    where=f"effect {instance.name!r}",
                    remedy="remove the effect, or vary what it changes as a parameter",
                )

    def with_effect(self, effect: str, channel: str = "", **values: float) -> "Model":
        """Return this model with an added effect, or with new values of one that it has."""
        new = EffectInstance.create(find_effect(effect), values, channel)
        remaining = tuple(instance for instance in self.effects if instance.name != new.name)
        return Model(self.base, (*remaining, new))

    def flatten(self) -> dict[str, float]:
        """Return every number under a flat name: base names and `effect.parameter`.

        Sensor effects: `effect.channel.parameter`.
        """
        values = self.base.as_dict()
        for instance in self.effects:
            values |= {f"{instance.name}.{name}": value for name, value in instance.values.items()}
        return values

    def with_flat(self, values: Mapping[str, float]) -> "Model":
        """Return a model of the values of `flatten`, which may have effects of effect files."""
        return Model.from_flat(values, tuple(instance.effect for instance in self.effects))

    @classmethod
    def from_flat(cls, values: Mapping[str, float], known: Sequence[Effect] = ()) -> "Model":
        """Build a model from the values of `flatten`; InputError names missing or unknown ones.

        `known` are effects that are not in the library.
        """
        own_effects = {effect.id: effect for effect in known}
        base = {name: value for name, value in values.items() if "." not in name}
        effects: dict[tuple[str, str], dict[str, float]] = {}
        for name, value in values.items():
            if "." in name:
                effect, *channel, parameter = name.split(".")
                effects.setdefault((effect, ".".join(channel)), {})[parameter] = value
        return cls(
            Parameters.from_dict(base),
            tuple(
                EffectInstance.create(own_effects.get(effect) or find_effect(effect), own, channel)
                for (effect, channel), own in effects.items()
            ),
        )

    def check_rate(self, rate_hz: float) -> None:
        """Raise InputError if this sampling rate is too low to resolve a contact."""
        if not (math.isfinite(rate_hz) and rate_hz > 0):
            raise InputError(
                "not a rate", key="rate_hz", value=float(rate_hz), allowed="above 0 Hz, finite"
            )
        min_rate_hz = self.min_rate_hz
        if rate_hz < min_rate_hz:
            contact_s = MIN_SAMPLES_PER_CONTACT / min_rate_hz
            raise InputError(
                f"too low for the bumper: a contact of this model lasts {1e3 * contact_s:.3g} ms",
                key="rate_hz",
                value=float(rate_hz),
                allowed=f"{min_rate_hz:.4g} Hz or more",
                remedy="raise rate_hz",
            )

    @property
    def min_rate_hz(self) -> float:
        """Sampling rate in Hz with `MIN_SAMPLES_PER_CONTACT` in half a period of any mode."""
        return MIN_SAMPLES_PER_CONTACT * self._max_angular_frequency() / math.pi

    def _max_angular_frequency(self) -> float:
        """Return the highest angular frequency of any mode in 1/s, without nonlinear terms."""
        p, kb = self.parameters, self.coefficients.get("kb", 0.0)
        sides = [
            stiffness + kb
            for stiffness, gap in (
                (p.bumper_stiffness_r, p.gap_r),
                (p.bumper_stiffness_l, p.gap_l),
            )
            if math.isfinite(gap)
        ]
        both_contacts = p.gap_r + p.gap_l <= 0
        contact = sum(sides) if both_contacts else max(sides, default=0.0)
        k = p.stiffness + self.coefficients.get("k1", 0.0) + contact
        return math.sqrt(k / p.mass)
