"""A guess: a model, what is believed of the sensors, and by how much each log's gaps are off.

Flat, it is a dict of numbers under names, which a fit moves.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from twin.learn.motion import Motion
from twin.model.effects import find_effect
from twin.model.effects.effect import Effect
from twin.model.model import Model, Sensor

GAP = "gap"  # + number of the log: m by which both gaps of that log are wider than it says
ZERO = "zero"  # + number of the log + what: SI that it reads at rest, as far as a tare can err
DOUBT = 4.0  # deviations that a tare may be off; more is an error of a sensor
LEAST_SHARE = 1e-6  # of a parameter's start: what may not vanish
SENSOR = "sensor_"
SLIP = "slip"  # m/s below which friction is less than whole: its form, which no model holds
INPUT_GAIN = "sensor_gain.table_acc_m_s2.gain"
INPUT_OFFSET = "sensor_offset.table_acc_m_s2.offset"


@dataclass(frozen=True, eq=False)
class Guess:
    """`values` are flat: the model's own names, `effect.channel.parameter` of sensors, `gap0`."""

    values: Mapping[str, float]

    @classmethod
    def of(cls, model: Model, logs: int) -> "Guess":
        """The model as it stands, with the gaps that the logs say."""
        return cls(model.flat() | {f"{GAP}{k}": 0.0 for k in range(logs)})

    def model(self) -> Model:
        """Without sensors and gaps of logs: what makes forces."""
        own = {
            name: value
            for name, value in self.values.items()
            if not name.startswith((SENSOR, SLIP, "general.")) and log_of(name) is None
        }
        return Model.from_flat(own)

    def sensors(self) -> tuple[Sensor, ...]:
        """The sensors that are not believed as they are."""
        found: dict[str, Sensor] = {}
        for name, value in self.values.items():
            if name.startswith(SENSOR):
                _, channel, parameter = name.split(".")
                before = found.get(channel, Sensor(channel))
                found[channel] = Sensor(channel, **{**before.numbers, parameter: value})
        return tuple(one for one in found.values() if one != Sensor(one.channel))

    def local(self, log: int, motion: Motion) -> Model:
        """The model with mass and gaps of one log."""
        model = self.model()
        wider = self.values[f"{GAP}{log}"]
        right, left = (gap + wider for gap in motion.gaps_m)
        base = replace(model.base, mass=motion.mass_kg, gap_r=right, gap_l=left)
        return Model(base, model.effects)

    def zero(self, log: int, what: str) -> float:
        """By how much the tare of u, acc, table, right or left of a log is off, SI."""
        return self.values.get(f"{ZERO}{log}.{what}", 0.0)

    def moved(self, values: Mapping[str, float]) -> "Guess":
        """With other numbers, or with more of them."""
        return Guess({**self.values, **values})

    def without(self, prefix: str) -> "Guess":
        """Less every number of an effect."""
        forms = (SLIP,) if prefix == "coulomb_friction" else ()
        kept = {k: v for k, v in self.values.items() if not k.startswith((f"{prefix}.", *forms))}
        return Guess(kept)


def log_of(name: str) -> int | None:
    """The log that a flat name belongs to; None where it belongs to all."""
    for prefix in (GAP, ZERO):
        number = name[len(prefix) :].partition(".")[0]
        if name.startswith(prefix) and number.isdigit():
            return int(number)
    return None


@dataclass(frozen=True, slots=True)
class Free:
    """A number that a fit may move, under each of `keys`; a shape moves by its logarithm."""

    name: str
    keys: tuple[str, ...]
    low: float
    high: float
    scale: float
    unit: str
    logarithmic: bool = False
    vanishing: float | None = None  # where what it is of is not there

    def inside(self, value: float) -> float:
        """The value as the fit moves it."""
        return math.log(max(value, self.low, 1e-300)) if self.logarithmic else value

    def outside(self, x: float) -> float:
        """The inverse of `inside`, within the bounds whatever the rounding."""
        return min(max(math.exp(x) if self.logarithmic else x, self.low), self.high)


BASE = (
    ("stiffness", ("stiffness",), "N/m"),
    ("damping", ("damping",), "N s/m"),
    ("bumper_stiffness", ("bumper_stiffness_r", "bumper_stiffness_l"), "N/m"),
    ("bumper_damping", ("bumper_damping_r", "bumper_damping_l"), "N s/m"),
)


def base_free(
    model: Model,
    touched: Sequence[bool],
    own_input: bool = False,
    doubts: Sequence[Mapping[str, float]] = (),
) -> tuple[Free, ...]:
    """The parameters of the SNM; those of the bumpers, and the gap, only of logs that touch.

    `doubts`: of each log, the deviations of its zeros, SI.
    `own_input`: gain and offset of the input too, where no other channel can check them.
    """
    flat = model.flat()
    free = []
    for name, keys, unit in BASE if any(touched) else BASE[:2]:
        scale = flat[keys[0]] or 1.0
        # a bumper without any dashpot has no face that relaxes, which some effects need
        least = 0.0 if name == "damping" else LEAST_SHARE * scale
        free.append(Free(name, keys, least, math.inf, scale, unit))
    free += [
        Free(f"{GAP}{k}", (f"{GAP}{k}",), -0.05, 0.05, 1e-3, "m")
        for k, one in enumerate(touched)
        if one
    ]
    for k, log in enumerate(doubts):
        for what, sd in log.items():
            name = f"{ZERO}{k}.{what}"
            unit = {"u": "m", "acc": "m/s2", "table": "m/s2"}.get(what, "N")
            free.append(Free(name, (name,), -DOUBT * sd, DOUBT * sd, sd, unit))
    if own_input:
        free.append(Free(INPUT_GAIN, (INPUT_GAIN,), 1e-12, 1e12, 1.0, "", logarithmic=True))
        free.append(Free(INPUT_OFFSET, (INPUT_OFFSET,), -1e9, 1e9, 1.0, "m/s2"))
    return tuple(free)


def effect_free(effect: Effect, channel: str = "") -> tuple[Free, ...]:
    """The parameters of an effect."""
    prefix = f"{effect.id}.{channel}." if channel else f"{effect.id}."
    return tuple(
        Free(
            prefix + p.name,
            (prefix + p.name,),
            p.low,
            p.high,
            abs(p.typical - (p.vanishing or 0.0)) or 1.0,
            p.unit,
            logarithmic=p.vanishing is None,
            vanishing=p.vanishing,
        )
        for p in effect.parameters
    )


def effects_of(model: Model) -> tuple[Free, ...]:
    """The parameters of every effect that a model has."""
    return tuple(
        free
        for one in model.effects
        for free in effect_free(find_effect(one.effect.id), one.channel)
    )
