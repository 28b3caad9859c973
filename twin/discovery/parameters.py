"""Parameter set: model parameters, assumed sensor errors, and gap and tare corrections per log.

Each parameter has a key: `BaseKey`, `EffectKey`, `SlipKey`, `GapKey`, `TareKey` or `NuisanceKey`.
The text of a key is the name of the parameter in files and messages.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from table_io.block import Float1D
from table_io.channels import CHANNEL_BY_NAME
from table_io.errors import InputError
from twin.discovery.motion import MeasuredMotion, RecordScale
from twin.laws.effect import Effect, EffectParameter
from twin.laws.expression import split_unit
from twin.laws.library import find_effect
from twin.model.model import EffectInstance, Model, SensorModel
from twin.model.parameters import Parameters

# of the names of the corrections per log
GAP_PREFIX, TARE_PREFIX, NUISANCE_PREFIX = "gap", "zero", "nuisance"
MAX_TARE_SIGMA = 4.0  # bound on a tare error in standard deviations; more is a sensor offset
# Bounds of a fit, as multiples of what the record can contain (see `measure_size`):
MIN_SHARE = 1e-6  # lower bound of base parameters that must not vanish
MAX_RATIO = 10.0  # of amplitudes
SHAPE_RATIOS = {"m": (5e-4, 5.0)}  # of shapes, by unit
OTHER_SHAPE_RATIOS = (1e-3, 1e3)
SMALL_LENGTH_SHARE = 0.1  # of the largest displacement: size of an error of a gap
MAX_INPUT_GAIN_RATIO = 1e3  # of the gain of the input to its estimate


@dataclass(frozen=True, slots=True)
class BaseKey:
    """Parameter of the SNM: a field of `Parameters`; without side, that of both bumpers."""

    name: str

    def __str__(self) -> str:
        return self.name


@dataclass(frozen=True, slots=True)
class EffectKey:
    """Parameter of an effect; `channel` is that of a sensor effect."""

    effect: str
    name: str
    channel: str = ""

    def __str__(self) -> str:
        return ".".join(filter(None, (self.effect, self.channel, self.name)))


@dataclass(frozen=True, slots=True)
class SlipKey:
    """Speed in m/s over which friction is regularized; used in fits, not part of a model."""

    def __str__(self) -> str:
        return "slip"


@dataclass(frozen=True, slots=True)
class GapKey:
    """Correction of a log: m by which both gaps exceed the stated ones."""

    log: int

    def __str__(self) -> str:
        return f"{GAP_PREFIX}{self.log}"


@dataclass(frozen=True, slots=True)
class TareKey:
    """Tare error of a quantity of a log: u, acc, table, right or left, SI."""

    log: int
    quantity: str

    def __str__(self) -> str:
        return f"{TARE_PREFIX}{self.log}.{self.quantity}"


@dataclass(frozen=True, slots=True)
class NuisanceKey:
    """Nuisance of a log, in typical sizes: its kind and its place, see `nuisances`."""

    log: int
    kind: str
    place: str = ""

    def __str__(self) -> str:
        return ".".join(filter(None, (f"{NUISANCE_PREFIX}{self.log}", self.kind, self.place)))


ParameterKey = BaseKey | EffectKey | SlipKey | GapKey | TareKey | NuisanceKey

STIFFNESS, DAMPING = BaseKey("stiffness"), BaseKey("damping")
BUMPER_STIFFNESS, BUMPER_DAMPING = BaseKey("bumper_stiffness"), BaseKey("bumper_damping")
SLIP_SPEED = SlipKey()
INPUT_GAIN = EffectKey("sensor_gain", "gain", "table_acc_m_s2")
INPUT_OFFSET = EffectKey("sensor_offset", "offset", "table_acc_m_s2")


@dataclass(frozen=True, slots=True)
class FreeParameter:
    """Free parameter with bounds; shapes are fitted as logarithms.

    `tied` are the keys of the values that are equal in the fit, if not that of `key` alone.
    """

    key: ParameterKey
    low: float
    high: float
    scale: float
    unit: str
    logarithmic: bool = False
    vanishing: float | None = None  # value at which the effect vanishes; None for shapes
    tied: tuple[ParameterKey, ...] = ()

    @property
    def name(self) -> str:
        """Name in files and messages."""
        return str(self.key)

    @property
    def keys(self) -> tuple[ParameterKey, ...]:
        """Keys of the values that the parameter sets."""
        return self.tied or (self.key,)

    def to_internal(self, value: float) -> float:
        """Return the internal (fitted) value: the logarithm if `logarithmic`."""
        return math.log(max(value, self.low, 1e-300)) if self.logarithmic else value

    def to_external(self, x: float) -> float:
        """Return the inverse of `to_internal`, clipped to the bounds."""
        return min(max(math.exp(x) if self.logarithmic else x, self.low), self.high)


@dataclass(frozen=True, eq=False)
class ParameterSet:
    """Parameter values by key, in order; those not in `free` are fixed in a fit."""

    values: Mapping[ParameterKey, float]
    free: tuple[FreeParameter, ...] = ()
    effects: Mapping[str, Effect] = field(default_factory=dict)  # those that are in no library

    @classmethod
    def from_model(cls, model: Model, logs: int) -> "ParameterSet":
        """Return the parameters of the model, all fixed, with the gaps stated in the logs."""
        values: dict[ParameterKey, float] = {
            BaseKey(name): value for name, value in model.base.as_dict().items()
        }
        for instance in model.effects:
            for name, value in instance.values.items():
                values[EffectKey(instance.effect.id, name, instance.channel)] = value
        effects = {instance.effect.id: instance.effect for instance in model.effects}
        return cls(values | {GapKey(log): 0.0 for log in range(logs)}, (), effects)

    def to_model(self) -> Model:
        """Return the model of the forces, without sensor errors and corrections per log."""
        base: dict[str, float] = {}
        effects: dict[str, dict[str, float]] = {}
        for key, value in self.values.items():
            match key:
                case BaseKey(name):
                    base[name] = value
                case EffectKey(effect, name, ""):
                    effects.setdefault(effect, {})[name] = value
        return Model(
            Parameters.from_dict(base),
            # not `create`: a fit has bounds of its own, from the record
            tuple(
                EffectInstance(self.get_effect(effect), values)
                for effect, values in effects.items()
            ),
        )

    def assumed_sensors(self) -> tuple[SensorModel, ...]:
        """Return the assumed sensor models that differ from an ideal sensor."""
        sensors: dict[str, SensorModel] = {}
        for key, value in self.values.items():
            match key:
                case EffectKey(_, name, channel) if channel:
                    sensor = sensors.get(channel, SensorModel(channel))
                    sensors[channel] = SensorModel(channel, **{**sensor.coefficients, name: value})
        return tuple(sensor for sensor in sensors.values() if sensor != SensorModel(sensor.channel))

    def model_for_log(self, log: int, motion: MeasuredMotion) -> Model:
        """Return the model with the mass and the gaps of one log."""
        model = self.to_model()
        correction = self.values[GapKey(log)]
        right, left = (gap + correction for gap in motion.gaps_m)
        base = replace(model.base, mass=motion.mass_kg, gap_r=right, gap_l=left)
        return Model(base, model.effects)

    def tare_error(self, log: int, quantity: str) -> float:
        """Return the tare error of u, acc, table, right or left of a log, SI."""
        return self.values.get(TareKey(log, quantity), 0.0)

    def to_vector(self) -> Float1D:
        """Return the internal values of the free parameters, (free,)."""
        return np.array([free.to_internal(self.values[free.keys[0]]) for free in self.free])

    def with_vector(self, x: Float1D) -> "ParameterSet":
        """Return a copy with the free parameters at these internal values, (free,)."""
        values = dict(self.values)
        for free, value in zip(self.free, x, strict=True):
            values |= dict.fromkeys(free.keys, free.to_external(float(value)))
        return replace(self, values=values)

    def with_values(self, values: Mapping[ParameterKey, float]) -> "ParameterSet":
        """Return a copy with values replaced or added."""
        return replace(self, values={**self.values, **values})

    def get_effect(self, name: str) -> Effect:
        """Return the effect of this id; InputError if it is unknown."""
        return self.effects.get(name) or find_effect(name)

    def with_effect(self, effect: Effect) -> "ParameterSet":
        """Return a copy that knows this effect; its values are set apart from it."""
        return replace(self, effects={**self.effects, effect.id: effect})

    def with_free(self, free: Iterable[FreeParameter]) -> "ParameterSet":
        """Return a copy in which exactly these parameters are free."""
        return replace(self, free=tuple(free))

    def without(self, removed: Sequence[FreeParameter]) -> "ParameterSet":
        """Return a copy without these parameters."""
        keys = {key for parameter in removed for key in parameter.keys}
        return replace(
            self,
            values={key: value for key, value in self.values.items() if key not in keys},
            free=tuple(free for free in self.free if keys.isdisjoint(free.keys)),
        )


def is_sensor_error(key: ParameterKey) -> bool:
    """Return True for a parameter of a sensor effect."""
    return isinstance(key, EffectKey) and key.channel != ""


def is_correction(key: ParameterKey) -> bool:
    """Return True for an error of instruments or set-up in one log that is no result itself."""
    return isinstance(key, TareKey | NuisanceKey)


def get_log(key: ParameterKey) -> int | None:
    """Return the number of the log that a parameter belongs to; None if it applies to all logs."""
    return key.log if isinstance(key, GapKey | TareKey | NuisanceKey) else None


BASE_PARAMETERS: tuple[tuple[BaseKey, str, tuple[BaseKey, ...]], ...] = (
    (STIFFNESS, "N/m", ()),
    (DAMPING, "N s/m", ()),
    (BUMPER_STIFFNESS, "N/m", (BaseKey("bumper_stiffness_r"), BaseKey("bumper_stiffness_l"))),
    (BUMPER_DAMPING, "N s/m", (BaseKey("bumper_damping_r"), BaseKey("bumper_damping_l"))),
)


def list_base_parameters(
    has_contact: Sequence[bool],
    input_gain: float | None,
    tare_sigmas: Mapping[TareKey, float],
    scale: RecordScale,
) -> tuple[FreeParameter, ...]:
    """Return the free parameters of the SNM; bumpers and gaps only for logs with contact.

    `tare_sigmas`: standard deviations of the tares, SI. `input_gain`: an estimate of the gain of
    the input, which is fitted with its offset where no other channel can check it; else None.
    """
    free = []
    sizes = {
        STIFFNESS: scale.force / scale.u, DAMPING: scale.force / scale.v,
        BUMPER_STIFFNESS: scale.force / scale.depth, BUMPER_DAMPING: scale.force / scale.v,
    }  # fmt: skip
    for key, unit, tied in BASE_PARAMETERS if any(has_contact) else BASE_PARAMETERS[:2]:
        # some effects need a bumper dashpot: without it the bumper face does not relax
        low = 0.0 if key == DAMPING else MIN_SHARE * sizes[key]
        free.append(FreeParameter(key, low, math.inf, sizes[key], unit, tied=tied))
    free += [
        FreeParameter(GapKey(log), -scale.u, scale.u, SMALL_LENGTH_SHARE * scale.u, "m")
        for log, touches in enumerate(has_contact)
        if touches
    ]
    for tare, sigma in tare_sigmas.items():
        unit = {"u": "m", "acc": "m/s2", "table": "m/s2"}.get(tare.quantity, "N")
        free.append(
            FreeParameter(tare, -MAX_TARE_SIGMA * sigma, MAX_TARE_SIGMA * sigma, sigma, unit)
        )
    if input_gain is not None:
        low, high = input_gain / MAX_INPUT_GAIN_RATIO, input_gain * MAX_INPUT_GAIN_RATIO
        free.append(FreeParameter(INPUT_GAIN, low, high, input_gain, "", logarithmic=True))
        reading = scale.readings[INPUT_OFFSET.channel]
        largest = MAX_RATIO * reading
        free.append(FreeParameter(INPUT_OFFSET, -largest, largest, reading, "m/s2"))
    return tuple(free)


def measure_size(
    parameter: EffectParameter, effect: Effect, channel: str, scale: RecordScale
) -> float | None:
    """Return the size of a parameter at which its effect is as large as the record itself, SI.

    It follows from the unit, with the largest force, displacement (depth in a bumper) and time of
    the record. None without one: a pure number or a time does not scale with the specimen.
    """
    if effect.acts == "sensor":
        return scale.readings.get(channel) if parameter.name == "offset" else None
    if effect.place == "input":
        force = effect.evaluate_force(effect.typical_values, {"y": scale.table_disp})
        largest = abs(float(force))
        return abs(parameter.typical) * scale.acc / largest if largest else None
    if parameter.unit == "m" and parameter.vanishing is not None:
        return SMALL_LENGTH_SHARE * scale.u
    if parameter.unit == "m/s" and parameter.vanishing is not None:  # a drift over the test
        return SMALL_LENGTH_SHARE * scale.u / scale.duration_s
    length = scale.depth if effect.is_in_bumpers else scale.u
    return size_of_unit(parameter.unit, scale.force, length, length / scale.v)


def size_of_unit(unit: str, force: float, length: float, time: float) -> float | None:
    """Return the product of these sizes in a unit such as "N s2/m2"; None for s and pure numbers.

    None too for a unit that is written otherwise, or has a part without a size.
    """
    sizes = {"N": force, "m": length, "s": time, "kg": force * time**2 / length, "rad": 1.0}
    if unit in ("", "s"):
        return None
    try:
        return math.prod((sizes[name] ** power for name, power in split_unit(unit)), start=1.0)
    except (InputError, KeyError):
        return None


def list_effect_parameters(
    effect: Effect, scale: RecordScale, channel: str = ""
) -> tuple[FreeParameter, ...]:
    """Return the free parameters of an effect, on a channel if it acts on a sensor.

    Their bounds come from the record, the library's guard only model files; pure numbers and
    delays, which do not scale with the specimen, keep those of the library.
    """
    free = []
    for parameter in effect.parameters:
        low, high = _find_bounds(parameter, effect, channel, scale)
        vanishing = parameter.vanishing
        size = measure_size(parameter, effect, channel, scale)
        typical = abs(parameter.typical - (vanishing or 0.0)) or 1.0
        unit = parameter.unit
        if effect.acts == "sensor" and parameter.name == "offset" and channel in CHANNEL_BY_NAME:
            unit = CHANNEL_BY_NAME[channel].unit
        free.append(
            FreeParameter(
                EffectKey(effect.id, parameter.name, channel), low, high, size or typical,
                unit, logarithmic=vanishing is None, vanishing=vanishing,
            )
        )  # fmt: skip
    return tuple(free)


def _find_bounds(
    parameter: EffectParameter, effect: Effect, channel: str, scale: RecordScale
) -> tuple[float, float]:
    """Return the bounds of a parameter in a fit, SI."""
    size, vanishing = measure_size(parameter, effect, channel, scale), parameter.vanishing
    if vanishing is None and parameter.unit == "s":
        return 0.02 * scale.sample_s, scale.duration_s
    if vanishing is None and parameter.unit == "Hz":  # of the record: a cycle, and Nyquist
        return 1.0 / scale.duration_s, 0.5 / scale.sample_s
    if not size:
        return parameter.low, parameter.high
    if vanishing is None:
        low, high = SHAPE_RATIOS.get(parameter.unit, OTHER_SHAPE_RATIOS)
        return low * size, high * size
    # a sign that the library forbids, because it would feed energy in, stays forbidden
    low = vanishing if parameter.low >= vanishing else vanishing - MAX_RATIO * size
    high = vanishing if parameter.high <= vanishing else vanishing + MAX_RATIO * size
    return low, high


def list_model_effect_parameters(model: Model, scale: RecordScale) -> tuple[FreeParameter, ...]:
    """Return the free parameters of every effect of a model."""
    return tuple(
        free
        for instance in model.effects
        for free in list_effect_parameters(instance.effect, scale, instance.channel)
    )
