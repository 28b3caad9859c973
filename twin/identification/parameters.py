"""Parameter set: model parameters, assumed sensor errors, and gap and tare corrections per log.

It is a flat mapping of names to values; a fit varies the free ones.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from twin.identification.motion import MeasuredMotion
from twin.model.effects import find_effect
from twin.model.effects.effect import Effect
from twin.model.model import Model, SensorModel

GAP_PREFIX = "gap"  # + log number: m by which both gaps of that log exceed the stated ones
# + log number + "." + quantity: tare error of that quantity, SI
ZERO_PREFIX = "zero"
MAX_ZERO_SIGMA = 4.0  # bound on a tare error in standard deviations; more is a sensor offset
MIN_START_SHARE = 1e-6  # of the start value: lower bound of parameters that must not vanish
SENSOR_PREFIX = "sensor_"
SLIP_SPEED = "slip"  # m/s over which friction is regularized; used in fits, not part of a model
INPUT_GAIN = "sensor_gain.table_acc_m_s2.gain"
INPUT_OFFSET = "sensor_offset.table_acc_m_s2.offset"


@dataclass(frozen=True, eq=False)
class ParameterSet:
    """Parameter values by flat name.

    Names are those of the model, `effect.channel.parameter` for sensors, and e.g. `gap0` per log.
    """

    values: Mapping[str, float]

    @classmethod
    def from_model(cls, model: Model, logs: int) -> "ParameterSet":
        """Return the parameters of the model, with the gaps stated in the logs."""
        return cls(model.flatten() | {f"{GAP_PREFIX}{k}": 0.0 for k in range(logs)})

    def to_model(self) -> Model:
        """Return the model of the forces, without sensor errors and corrections per log."""
        model_values = {
            name: value
            for name, value in self.values.items()
            if not name.startswith((SENSOR_PREFIX, SLIP_SPEED, "general."))
            and parse_log_number(name) is None
        }
        return Model.from_flat(model_values)

    def assumed_sensors(self) -> tuple[SensorModel, ...]:
        """Return the assumed sensor models that differ from an ideal sensor."""
        sensors: dict[str, SensorModel] = {}
        for name, value in self.values.items():
            if name.startswith(SENSOR_PREFIX):
                _, channel, parameter = name.split(".")
                sensor = sensors.get(channel, SensorModel(channel))
                sensors[channel] = SensorModel(channel, **{**sensor.coefficients, parameter: value})
        return tuple(sensor for sensor in sensors.values() if sensor != SensorModel(sensor.channel))

    def model_for_log(self, log: int, motion: MeasuredMotion) -> Model:
        """Return the model with the mass and the gaps of one log."""
        model = self.to_model()
        correction = self.values[f"{GAP_PREFIX}{log}"]
        right, left = (gap + correction for gap in motion.gaps_m)
        base = replace(model.base, mass=motion.mass_kg, gap_r=right, gap_l=left)
        return Model(base, model.effects)

    def zero_error(self, log: int, quantity: str) -> float:
        """Return the tare error of u, acc, table, right or left of a log, SI."""
        return self.values.get(f"{ZERO_PREFIX}{log}.{quantity}", 0.0)

    def with_values(self, values: Mapping[str, float]) -> "ParameterSet":
        """Return a copy with values replaced or added."""
        return ParameterSet({**self.values, **values})

    def without_effect(self, prefix: str) -> "ParameterSet":
        """Return a copy without the parameters of an effect."""
        shape_keys = (SLIP_SPEED,) if prefix == "coulomb_friction" else ()
        kept = {
            k: v for k, v in self.values.items() if not k.startswith((f"{prefix}.", *shape_keys))
        }
        return ParameterSet(kept)


def parse_log_number(name: str) -> int | None:
    """Return the number of the log that a flat name belongs to; None if it applies to all logs."""
    for prefix in (GAP_PREFIX, ZERO_PREFIX):
        number = name[len(prefix) :].partition(".")[0]
        if name.startswith(prefix) and number.isdigit():
            return int(number)
    return None


@dataclass(frozen=True, slots=True)
class FreeParameter:
    """Free parameter with bounds, stored under each of `keys`; shapes are fitted as logarithms."""

    name: str
    keys: tuple[str, ...]
    low: float
    high: float
    scale: float
    unit: str
    logarithmic: bool = False
    vanishing: float | None = None  # value at which the effect vanishes; None for shapes

    def to_internal(self, value: float) -> float:
        """Return the internal (fitted) value: the logarithm if `logarithmic`."""
        return math.log(max(value, self.low, 1e-300)) if self.logarithmic else value

    def to_external(self, x: float) -> float:
        """Return the inverse of `to_internal`, clipped to the bounds."""
        return min(max(math.exp(x) if self.logarithmic else x, self.low), self.high)


BASE_PARAMETERS = (
    ("stiffness", ("stiffness",), "N/m"),
    ("damping", ("damping",), "N s/m"),
    ("bumper_stiffness", ("bumper_stiffness_r", "bumper_stiffness_l"), "N/m"),
    ("bumper_damping", ("bumper_damping_r", "bumper_damping_l"), "N s/m"),
)


def list_base_parameters(
    model: Model,
    has_contact: Sequence[bool],
    fit_input: bool = False,
    zero_sigmas: Sequence[Mapping[str, float]] = (),
) -> tuple[FreeParameter, ...]:
    """Return the free parameters of the SNM; bumpers and gaps only for logs with contact.

    `zero_sigmas`: standard deviations of the tares of each log, SI.
    `fit_input`: also fit gain and offset of the input, where no other channel can check them.
    """
    flat = model.flatten()
    free = []
    for name, keys, unit in BASE_PARAMETERS if any(has_contact) else BASE_PARAMETERS[:2]:
        scale = flat[keys[0]] or 1.0
        # some effects need a bumper dashpot: without it the bumper face does not relax
        low = 0.0 if name == "damping" else MIN_START_SHARE * scale
        free.append(FreeParameter(name, keys, low, math.inf, scale, unit))
    free += [
        FreeParameter(f"{GAP_PREFIX}{number}", (f"{GAP_PREFIX}{number}",), -0.05, 0.05, 1e-3, "m")
        for number, touches in enumerate(has_contact)
        if touches
    ]
    for number, sigmas in enumerate(zero_sigmas):
        for quantity, sigma in sigmas.items():
            name = f"{ZERO_PREFIX}{number}.{quantity}"
            unit = {"u": "m", "acc": "m/s2", "table": "m/s2"}.get(quantity, "N")
            free.append(
                FreeParameter(
                    name, (name,), -MAX_ZERO_SIGMA * sigma, MAX_ZERO_SIGMA * sigma, sigma, unit
                )
            )
    if fit_input:
        free.append(
            FreeParameter(INPUT_GAIN, (INPUT_GAIN,), 1e-12, 1e12, 1.0, "", logarithmic=True)
        )
        free.append(FreeParameter(INPUT_OFFSET, (INPUT_OFFSET,), -1e9, 1e9, 1.0, "m/s2"))
    return tuple(free)


def list_effect_parameters(effect: Effect, channel: str = "") -> tuple[FreeParameter, ...]:
    """Return the free parameters of an effect, on a channel if it acts on a sensor."""
    prefix = f"{effect.id}.{channel}." if channel else f"{effect.id}."
    return tuple(
        FreeParameter(
            prefix + parameter.name,
            (prefix + parameter.name,),
            parameter.low,
            parameter.high,
            abs(parameter.typical - (parameter.vanishing or 0.0)) or 1.0,
            parameter.unit,
            logarithmic=parameter.vanishing is None,
            vanishing=parameter.vanishing,
        )
        for parameter in effect.parameters
    )


def list_model_effect_parameters(model: Model) -> tuple[FreeParameter, ...]:
    """Return the free parameters of every effect of a model."""
    return tuple(
        free
        for model_effect in model.effects
        for free in list_effect_parameters(
            find_effect(model_effect.effect.id), model_effect.channel
        )
    )
