"""The sealed truth of the simulated machine: what its rig has that its cards do not say.

    [base]                      # in SI, in place of what the machine card and the specimen say
    damper_stiffness_n_m = 36900.0
    [[effects]]
    id = "bouc_wen"
    form = "n"                  # may be left out: the first of the id
    parameters = { force = 150.0, yield_displacement = 3e-3 }
    [[effects]]
    id = "sensor_gain"
    channel = "mass_acc_m_s2"
    parameters = { gain = 1.05 }

The machine card names this file and its hash; only the simulated backend reads it. `KINDS` is the
table of what can be hidden. Signs and meanings are those of the same name everywhere; the forms are
this rig's own (`plant_hidden.py`), so that no model is the truth.
"""

import difflib
import hashlib
import math
from typing import NamedTuple

from pydantic import Field, ValidationInfo, field_validator

from table_io.card import BadInput, Card, Finite, NonNegative, Number, Positive, parse
from table_io.channels import BY_NAME


class Quantity(NamedTuple):
    """A parameter in SI. At `vanishing` the effect is absent; None: it shapes the effect only.

    `default` None: it must be given.
    """

    name: str
    unit: str
    low: float
    high: float
    vanishing: float | None
    typical: float
    default: float | None = None


class Kind(NamedTuple):
    """An effect in one form. `in_library`: a model has a term of this name that means this."""

    id: str
    form: str
    in_library: bool
    parameters: tuple[Quantity, ...]
    meaning: str

    @property
    def sensor(self) -> bool:
        """True where it needs a channel and leaves the motion as it is."""
        return self.id.startswith("sensor_")


Q = Quantity
BEFORE_SLIP = Q("slip_speed", "m/s", 1e-4, 0.01, None, 1e-3, 1e-3)
ALL: tuple[Kind, ...] = (
    Kind("cubic_stiffness", "stretched", True, (Q("k3", "N/m3", -3e7, 1e10, 0.0, 1e7),),
         "k3 u^3 / sqrt(1 + (u / 0.15 m)^2)"),
    Kind("quadratic_damping", "rounded", True, (Q("c2", "N s2/m2", 0.0, 1e6, 0.0, 2e3),),
         "c2 u' sqrt(u'^2 + (1 mm/s)^2)"),
    Kind("coulomb_friction", "tanh", True, (Q("fc", "N", 0.0, 5e3, 0.0, 50.0), BEFORE_SLIP),
         "fc tanh(u' / slip_speed)"),
    Kind("coulomb_friction", "stribeck", False,
         (Q("fc", "N", 0.0, 5e3, 0.0, 40.0), Q("fs", "N", 0.0, 1e4, 0.0, 120.0),
          Q("stribeck_speed", "m/s", 1e-3, 1.0, None, 0.02), BEFORE_SLIP),
         "(fc + (fs - fc) exp(-(u' / stribeck_speed)^2)) tanh(u' / slip_speed)"),
    Kind("bouc_wen", "n", True,
         (Q("force", "N", 0.0, 1e4, 0.0, 150.0),
          Q("yield_displacement", "m", 1e-5, 0.1, None, 3e-3),
          Q("exponent", "", 1.0, 10.0, None, 1.5, 1.5), Q("beta", "", 0.0, 1.0, None, 0.6, 0.6)),
         "force z; yield_displacement z' = u' - |z|^exponent (beta |u'| sign(z) + (1 - beta) u')"),
    Kind("maxwell_damper", "ode", True,
         (Q("k1", "N/m", 0.0, 1e6, 0.0, 8e3), Q("tau", "s", 1e-4, 100.0, None, 0.05)),
         "f' = k1 u' - f / tau beside K and C"),
    Kind("bumper_hardening", "exponential", True, (Q("k2", "N/m2", 0.0, 1e10, 0.0, 1e8),),
         "2 k2 l^2 (exp(d / l) - 1 - d / l) in each bumper, l = 0.1 m"),
    Kind("hunt_crossley", "saturating", True, (Q("ch", "N s/m2", 0.0, 1e9, 0.0, 5e5),),
         "ch l tanh(d / l) d' in each bumper, l = 0.03 m"),
    Kind("bumper_maxwell", "ode", True,
         (Q("kb", "N/m", 0.0, 1e7, 0.0, 2e5), Q("tau", "s", 1e-4, 100.0, None, 0.05)),
         "b_j' = kb d_j' - b_j / tau in each bumper"),
    Kind("bumper_asymmetry", "stiffness", True, (Q("ratio", "", 0.2, 5.0, 1.0, 1.2),),
         "K_R / K_L = ratio, their mean and the damping kept"),
    Kind("gap_offset", "shift", True, (Q("offset", "m", -0.015, 0.015, 0.0, 3e-4),),
         "right gap + offset, left gap - offset"),
    Kind("gap_drift", "linear", True, (Q("rate", "m/s", -1e-4, 1e-4, 0.0, 5e-6),),
         "both gaps + rate t, t from sample 0"),
    Kind("table_tilt", "sine", True, (Q("tilt", "rad/m", -10.0, 10.0, 0.0, 0.1),),
         "-M g sin(tilt y) on the mass, y the table displacement"),
    Kind("mass_error", "mass", True, (Q("ratio", "", 0.5, 2.0, 1.0, 1.05),),
         "true mass = believed mass / ratio"),
    Kind("sensor_gain", "gain", True, (Q("gain", "", 0.2, 5.0, 1.0, 1.05),),
         "reading = gain x value"),
    Kind("sensor_lag", "delay", True, (Q("lag", "s", 0.0, 0.05, 0.0, 1e-3),),
         "reading(t) = value(t - lag)"),
    Kind("sensor_offset", "after_tare", True,
         (Q("offset", "unit of the channel", -1e4, 1e4, 0.0, 1e-3),),
         "reading = value + offset, come after the tare"),
    Kind("quintic_stiffness", "u5", False, (Q("k5", "N/m5", -1e15, 1e15, 0.0, 3e10),), "k5 u^5"),
    Kind("even_stiffness", "u2", False, (Q("ke", "N/m2", -1e7, 1e7, 0.0, 3e5),), "ke u^2"),
    Kind("cubic_damping", "v3", False, (Q("c3", "N s3/m3", 0.0, 1e7, 0.0, 2e4),), "c3 u'^3"),
    Kind("position_damping", "u2v", False, (Q("cu", "N s/m3", 0.0, 1e9, 0.0, 3e6),), "cu u^2 u'"),
    Kind("stiffness_drift", "linear", False, (Q("rate", "1/s", -1e-2, 1e-2, 0.0, 1e-4),),
         "the damper's spring K (1 + rate t), t from sample 0"),
    Kind("dead_band", "tanh", False, (Q("width", "m", 0.0, 0.02, 0.0, 1e-3),),
         "the damper's spring K is missing within +-width: -K width tanh(u / width)"),
    Kind("adhesion", "pull", False, (Q("force", "N", 0.0, 1e4, 0.0, 100.0),),
         "contact ends where the bumper pulls with this force"),
    Kind("bumper_cubic", "d3", False, (Q("kc", "N/m3", 0.0, 1e13, 0.0, 4e10),),
         "kc d^3 in each bumper"),
    Kind("appendage", "sprung", False,
         (Q("mass", "kg", 0.0, 200.0, 0.0, 20.0), Q("frequency", "Hz", 0.1, 50.0, None, 6.0),
          Q("damping_ratio", "", 0.0, 1.0, None, 0.02, 0.02)),
         "a second mass on a spring and a dashpot on the specimen"),
)  # fmt: skip
# By (id, form); the first form of an id is the one that is meant where none is said.
KINDS: dict[tuple[str, str], Kind] = {(kind.id, kind.form): kind for kind in ALL}


def _near(name: str, known: list[str]) -> str:
    near = difflib.get_close_matches(name, known, 1, 0.4)
    return f"did you mean {near[0]!r}?" if near else f"known: {', '.join(known)}"


def _faults(kind: Kind, given: dict[str, float]) -> list[str]:
    """What is wrong with the numbers of an effect, a sentence each."""
    known = [one.name for one in kind.parameters]
    found = [f"no parameter {name!r}; {_near(name, known)}" for name in given if name not in known]
    for one in kind.parameters:
        value = given.get(one.name, one.default)
        allowed = f"allowed: {one.low:g} to {one.high:g} {one.unit}".rstrip()
        if value is None:
            found.append(f"lacks {one.name!r}; add it, {allowed}")
        elif not one.low <= value <= one.high:
            found.append(f"{one.name} = {value:g}; {allowed}")
    return found


class HiddenEffect(Card):
    """One entry of [[effects]]; in `parameters` defaults stand for those that are not given."""

    id: str
    form: str = Field("", validate_default=True, description="Empty: the first of the id.")
    channel: str | None = None
    parameters: dict[str, Finite] = Field(description="Last: judged by the others.")

    @field_validator("id")
    @classmethod
    def _known(cls, name: str) -> str:
        ids = list(dict.fromkeys(kind.id for kind in ALL))
        if name not in ids:
            raise ValueError(f"effect {name!r} is unknown; {_near(name, ids)}")
        return name

    @field_validator("form")
    @classmethod
    def _of_the_id(cls, form: str, info: ValidationInfo) -> str:
        forms = [kind.form for kind in ALL if kind.id == info.data.get("id")]
        if not forms:
            return form
        if form and form not in forms:
            raise ValueError(f"{info.data['id']} has no form {form!r}; {_near(form, forms)}")
        return form or forms[0]

    @field_validator("parameters")
    @classmethod
    def _complete(cls, given: dict[str, float], info: ValidationInfo) -> dict[str, float]:
        kind = KINDS.get((info.data.get("id", ""), info.data.get("form", "")))
        if kind is None:
            return given
        found, channel = _faults(kind, given), info.data.get("channel")
        if not kind.sensor and channel is not None:
            found.append("has no channel; leave it out")
        elif kind.sensor and channel not in BY_NAME:
            found.append(f"needs a channel; {_near(str(channel), list(BY_NAME))}")
        if found:
            raise ValueError(f"{kind.id}: " + "; ".join(found))
        return {one.name: given.get(one.name, one.default or 0.0) for one in kind.parameters}

    @property
    def kind(self) -> Kind:
        return KINDS[self.id, self.form]


class Base(Card):
    """What is true in place of the cards; what is left out is as they say. SI."""

    mass_kg: Positive | None = None
    damper_stiffness_n_m: Positive | None = None
    damper_damping_n_s_m: NonNegative | None = None
    bumper_stiffness_n_m: Positive | None = None
    bumper_damping_n_s_m: Positive | None = None
    gap_right_m: Number | None = None
    gap_left_m: Number | None = None

    @field_validator("gap_right_m", "gap_left_m")
    @classmethod
    def _is_a_gap(cls, gap: float | None, info: ValidationInfo) -> float | None:
        if gap is not None and (math.isnan(gap) or gap == -math.inf):
            raise ValueError(f"{info.field_name} is {gap}; allowed: m, or inf for no bumper")
        return gap


class Truth(Card):
    """The whole file: numbers of the rig as it is, and the effects that it has."""

    base: Base = Base()
    effects: tuple[HiddenEffect, ...] = ()

    @field_validator("effects")
    @classmethod
    def _each_once(cls, effects: tuple[HiddenEffect, ...]) -> tuple[HiddenEffect, ...]:
        names = [(one.id, one.channel or "") for one in effects]
        twice = sorted({" ".join(name).strip() for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"{', '.join(twice)} more than once; keep one of each")
        return effects


def unsealed(raw: bytes, sha256: str, where: str) -> Truth:
    """The truth from the bytes of its file; BadInput where they are not those of the hash."""
    found = hashlib.sha256(raw).hexdigest()
    if found != sha256.lower():
        raise BadInput(
            f"{where}: its SHA-256 is {found}, the machine card says {sha256}; give the file that "
            "the card was made for, or its hash as truth_sha256"
        )
    return parse(raw.decode(errors="replace"), Truth, where)
