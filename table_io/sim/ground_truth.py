"""Ground truth of the simulated table: hidden parameters and effects.

In the rig file, for everybody to read: tables `[simulated.hidden.base]`,
`[[simulated.hidden.effects]]`, `[[simulated.hidden.imperfections]]`; or sealed, in a file of its
own, whose path and hash the rig file states:

    [base]                      # in SI, overrides rig file and specimen
    damper_stiffness_n_m = 36900.0
    [[effects]]
    id = "bouc_wen"
    form = "n"                  # default: first form of the id
    parameters = { force = 150.0, yield_displacement = 3e-3 }
    [[effects]]
    id = "sensor_gain"
    channel = "mass_acc_m_s2"
    parameters = { gain = 1.05 }
    [[imperfections]]           # of instruments and set-up, see `imperfections.py`
    id = "channel_skew"
    parameters = { skew = 20e-6 }

Only the simulated backend reads it, never the twin.
`DEFINITION_BY_ID` lists the effects that can be hidden. Signs and meanings are those of the effects
of the same name in the model library; the functional forms differ (`plant.py`), so that no
model can reproduce the truth exactly.
"""

import hashlib
import math
from collections.abc import Mapping
from typing import Any, NamedTuple, TypeVar

from pydantic import Field, ValidationInfo, field_validator

from table_io.config.base import (
    ConfigModel,
    Finite,
    NonNegative,
    Number,
    Positive,
    list_duplicates,
    parse_toml,
)
from table_io.errors import InputError
from table_io.sim.imperfections import HiddenEntry, HiddenParameter, Imperfection


class EffectDefinition(NamedTuple):
    """Definition of an effect in one form; `in_library`: the model library has this effect."""

    id: str
    form: str
    in_library: bool
    parameters: tuple[HiddenParameter, ...]
    meaning: str

    @property
    def is_sensor_effect(self) -> bool:
        """True if it acts on a channel and leaves the motion unchanged."""
        return self.id.startswith("sensor_")


Q = HiddenParameter
SLIP_SPEED = Q("slip_speed", "m/s", 1e-4, 0.01, None, 1e-3, 1e-3)
EFFECT_DEFINITIONS: tuple[EffectDefinition, ...] = (
    EffectDefinition("cubic_stiffness", "stretched", True, (Q("k3", "N/m3", -3e7, 1e10, 0.0, 1e7),),
         "k3 u^3 / sqrt(1 + (u / 0.15 m)^2)"),
    EffectDefinition("quadratic_damping", "rounded", True,
         (Q("c2", "N s2/m2", 0.0, 1e6, 0.0, 2e3),),
         "c2 u' sqrt(u'^2 + (1 mm/s)^2)"),
    EffectDefinition("coulomb_friction", "tanh", True,
         (Q("fc", "N", 0.0, 5e3, 0.0, 50.0), SLIP_SPEED),
         "fc tanh(u' / slip_speed)"),
    EffectDefinition("stribeck_friction", "tanh", True,
         (Q("fc", "N", 0.0, 5e3, 0.0, 40.0), Q("ratio", "", 1.0, 20.0, None, 3.0),
          Q("speed", "m/s", 1e-3, 1.0, None, 0.02), SLIP_SPEED),
         "fc (1 + (ratio - 1) exp(-(u' / speed)^2)) tanh(u' / slip_speed)"),
    EffectDefinition("bouc_wen", "n", True,
         (Q("force", "N", 0.0, 1e4, 0.0, 150.0),
          Q("yield_displacement", "m", 1e-5, 0.1, None, 3e-3),
          Q("exponent", "", 1.0, 10.0, None, 1.5, 1.5), Q("beta", "", 0.0, 1.0, None, 0.6, 0.6)),
         "force z; yield_displacement z' = u' - |z|^exponent (beta |u'| sign(z) + (1 - beta) u')"),
    EffectDefinition("maxwell_damper", "ode", True,
         (Q("k1", "N/m", 0.0, 1e6, 0.0, 8e3), Q("tau", "s", 1e-4, 100.0, None, 0.05)),
         "f' = k1 u' - f / tau, in parallel with K and C"),
    EffectDefinition("bumper_hardening", "exponential", True,
         (Q("k2", "N/m2", 0.0, 1e10, 0.0, 1e8),),
         "2 k2 l^2 (exp(d / l) - 1 - d / l) in each bumper, l = 0.1 m"),
    EffectDefinition("hunt_crossley", "saturating", True, (Q("ch", "N s/m2", 0.0, 1e9, 0.0, 5e5),),
         "ch l tanh(d / l) d' in each bumper, l = 0.03 m"),
    EffectDefinition("bumper_maxwell", "ode", True,
         (Q("kb", "N/m", 0.0, 1e7, 0.0, 2e5), Q("tau", "s", 1e-4, 100.0, None, 0.05)),
         "b_j' = kb d_j' - b_j / tau in each bumper"),
    EffectDefinition("bumper_asymmetry", "stiffness", True, (Q("ratio", "", 0.2, 5.0, 1.0, 1.2),),
         "K_R / K_L = ratio, their mean and the damping kept"),
    EffectDefinition("gap_offset", "shift", True, (Q("offset", "m", -0.015, 0.015, 0.0, 3e-4),),
         "right gap + offset, left gap - offset"),
    EffectDefinition("gap_drift", "linear", True, (Q("rate", "m/s", -1e-4, 1e-4, 0.0, 5e-6),),
         "both gaps + rate t, t from sample 0"),
    EffectDefinition("table_tilt", "sine", True, (Q("tilt", "rad/m", -10.0, 10.0, 0.0, 0.1),),
         "-M g sin(tilt y) on the mass, y the table displacement"),
    EffectDefinition("mass_error", "mass", True, (Q("ratio", "", 0.5, 2.0, 1.0, 1.05),),
         "true mass = assumed mass / ratio"),
    EffectDefinition("sensor_gain", "gain", True, (Q("gain", "", 0.2, 5.0, 1.0, 1.05),),
         "reading = gain x value"),
    EffectDefinition("sensor_lag", "delay", True, (Q("lag", "s", 0.0, 0.05, 0.0, 1e-3),),
         "reading(t) = value(t - lag)"),
    EffectDefinition("sensor_offset", "after_tare", True,
         (Q("offset", "unit of the channel", -1e4, 1e4, 0.0, 1e-3),),
         "reading = value + offset, which arises after the tare"),
    EffectDefinition("quintic_stiffness", "u5", False,
         (Q("k5", "N/m5", -1e15, 1e15, 0.0, 3e10),), "k5 u^5"),
    EffectDefinition("even_stiffness", "u2", False,
         (Q("ke", "N/m2", -1e7, 1e7, 0.0, 3e5),), "ke u^2"),
    EffectDefinition("cubic_damping", "v3", False,
         (Q("c3", "N s3/m3", 0.0, 1e7, 0.0, 2e4),), "c3 u'^3"),
    EffectDefinition("position_damping", "u2v", True,
         (Q("cu", "N s/m3", 0.0, 1e9, 0.0, 3e6),), "cu u^2 u'"),
    EffectDefinition("stiffness_drift", "linear", False,
         (Q("rate", "1/s", -1e-2, 1e-2, 0.0, 1e-4),),
         "the damper's spring K (1 + rate t), t from sample 0"),
    EffectDefinition("dead_band", "tanh", True, (Q("width", "m", 0.0, 0.02, 0.0, 1e-3),),
         "dead band of +-width of the damper's spring K: -K width tanh(u / width)"),
    EffectDefinition("adhesion", "pull", True, (Q("force", "N", 0.0, 1e4, 0.0, 100.0),),
         "contact ends when the bumper pulls with this force"),
    EffectDefinition("bumper_cubic", "d3", True, (Q("kc", "N/m3", 0.0, 1e13, 0.0, 4e10),),
         "kc d^3 in each bumper"),
    EffectDefinition("appendage", "sprung", True,
         (Q("mass", "kg", 0.0, 200.0, 0.0, 20.0), Q("frequency", "Hz", 0.1, 50.0, None, 6.0),
          Q("damping_ratio", "", 1e-3, 1.0, None, 0.02)),
         "a second mass on a spring and a dashpot on the specimen"),
    EffectDefinition("exponential_stiffness", "exp", False,
         (Q("stiffness", "N/m", 0.0, 1e7, 0.0, 1e4), Q("length", "m", 1e-3, 1.0, None, 0.01)),
         "stiffness length (exp(|u| / length) - 1 - |u| / length) sign(u)"),
    EffectDefinition("saturating_stiffness", "tanh", False,
         (Q("stiffness", "N/m", 0.0, 1e7, 0.0, 1e4), Q("length", "m", 1e-4, 1.0, None, 3e-3)),
         "stiffness length tanh(u / length)"),
    EffectDefinition("slack_stiffness", "one_sided", False,
         (Q("stiffness", "N/m", 0.0, 1e7, 0.0, 1e4), Q("slack", "m", 0.0, 0.1, None, 2e-3)),
         "stiffness (u - slack) where u > slack, its corner rounded over 0.1 mm"),
    EffectDefinition("root_friction", "v05", False,
         (Q("coefficient", "N s0.5/m0.5", 0.0, 1e5, 0.0, 200.0),),
         "coefficient sqrt(|u'|) sign(u')"),
    EffectDefinition("cross_damping", "uv2", False,
         (Q("coefficient", "N s2/m3", 0.0, 1e9, 0.0, 1e5),), "coefficient u u'^2"),
    EffectDefinition("one_sided_damping", "v2", False,
         (Q("coefficient", "N s2/m2", 0.0, 1e7, 0.0, 4e3),), "coefficient u'^2 where u' > 0"),
    EffectDefinition("position_friction", "u", False,
         (Q("coefficient", "N/m", 0.0, 1e6, 0.0, 5e3),), "coefficient |u| sign(u')"),
    EffectDefinition("square_position_friction", "u2", False,
         (Q("coefficient", "N/m2", 0.0, 1e9, 0.0, 5e5),), "coefficient u^2 sign(u')"),
    EffectDefinition("saturating_damping", "tanh", False,
         (Q("force", "N", 0.0, 1e5, 0.0, 100.0), Q("speed", "m/s", 1e-3, 10.0, None, 0.05)),
         "force tanh(u' / speed)"),
    EffectDefinition("damping_drift", "linear", False,
         (Q("rate", "1/s", -1e-1, 1e-1, 0.0, 5e-3),),
         "the damper's dashpot C (1 + rate t), t from sample 0"),
    EffectDefinition("warming_friction", "exponential", False,
         (Q("force", "N", 0.0, 5e3, 0.0, 60.0), Q("time", "s", 1.0, 1e4, None, 15.0)),
         "force exp(-t / time) sign(u'), t from sample 0"),
    EffectDefinition("cable_drag", "table", False,
         (Q("coefficient", "N s/m", -1e6, 1e6, 0.0, 500.0),),
         "coefficient times the velocity of the table"),
    EffectDefinition("cable_stiffness", "table_cubed", False,
         (Q("coefficient", "N/m3", -1e9, 1e9, 0.0, 1e6),),
         "coefficient times the displacement of the table cubed"),
    EffectDefinition("hertz_bumper", "d1.5", False,
         (Q("coefficient", "N/m1.5", 0.0, 1e12, 0.0, 5e6),), "coefficient d^1.5 in each bumper"),
    EffectDefinition("quintic_bumper", "d5", False,
         (Q("coefficient", "N/m5", 0.0, 1e20, 0.0, 1e15),), "coefficient d^5 in each bumper"),
    EffectDefinition("one_sided_cubic", "d3", False,
         (Q("coefficient", "N/m3", 0.0, 1e13, 0.0, 8e10),), "coefficient d^3 in the right bumper"),
    EffectDefinition("compression_dashpot", "loading", False,
         (Q("coefficient", "N s/m", 0.0, 1e6, 0.0, 1e3),),
         "coefficient d' in each bumper while d' > 0, nothing in rebound"),
    EffectDefinition("cubic_bumper_damping", "v3", False,
         (Q("coefficient", "N s3/m3", 0.0, 1e8, 0.0, 1e5),), "coefficient d'^3 in each bumper"),
    EffectDefinition("softening_bumper", "contact_time", False,
         # below the stiffness of usual bumpers, or their total stiffness would be negative
         (Q("stiffness", "N/m", 0.0, 4e5, 0.0, 1e5), Q("time", "s", 1e-3, 100.0, None, 0.02)),
         "-stiffness h d in each bumper, h' = (1 in contact, else 0, minus h) / time"),
    EffectDefinition("dahl_friction", "n1", False,
         (Q("force", "N", 0.0, 1e4, 0.0, 100.0), Q("length", "m", 1e-5, 0.1, None, 2e-3)),
         "force z, length z' = u' (1 - z sign(u'))"),
    EffectDefinition("cubic_maxwell", "x3", False,
         (Q("stiffness", "N/m3", 0.0, 1e12, 0.0, 1e9), Q("dashpot", "N s/m", 1.0, 1e6, None, 1e3)),
         "f = stiffness x^3, x' = u' - f / dashpot"),
    EffectDefinition("two_branch_maxwell", "decade", False,
         (Q("stiffness", "N/m", 0.0, 1e6, 0.0, 8e3), Q("time", "s", 1e-3, 100.0, None, 0.3)),
         "two Maxwell branches of this stiffness, relaxing in time and time / 10"),
    EffectDefinition("elastoplastic", "sharp", False,
         (Q("force", "N", 0.0, 1e4, 0.0, 100.0), Q("length", "m", 1e-4, 0.1, None, 5e-3)),
         "force z, length z' = u' (1 - z^20 while z u' > 0): elastic, then plastic"),
    EffectDefinition("cubic_appendage", "x3", False,
         (Q("mass", "kg", 0.0, 200.0, 0.0, 20.0), Q("cubic", "1/m2 s2", 0.0, 1e9, None, 2e6),
          Q("damping", "1/s", 0.0, 1e3, None, 2.0)),
         "a second mass on a cubic spring and a dashpot, over its mass, on the specimen"),
    EffectDefinition("table_resonator", "coupled", False,
         (Q("coupling", "N/m", 0.0, 1e6, 0.0, 5e3), Q("mass", "kg", 1.0, 1e4, None, 50.0),
          Q("frequency", "Hz", 0.1, 50.0, None, 4.0)),
         "a second mass on the table, 2 % damped, coupled to the specimen by a spring"),
)  # fmt: skip
# By (id, form); the first form of an id is its default.
DEFINITION_BY_ID: dict[tuple[str, str], EffectDefinition] = {
    (definition.id, definition.form): definition for definition in EFFECT_DEFINITIONS
}


class HiddenEffect(HiddenEntry):
    """One entry of [[effects]]; `parameters` is completed with defaults."""

    noun = "effect"
    definitions = DEFINITION_BY_ID

    parameters: dict[str, Finite] = Field(description="Parameters of the effect, in SI.")

    @classmethod
    def find_faults(
        cls, definition: EffectDefinition, given: Mapping[str, float], place: Mapping[str, Any]
    ) -> list[str]:
        has_channel = place.get("channel") is not None
        if not definition.is_sensor_effect and has_channel:
            return ["has no channel; leave it out"]
        if definition.is_sensor_effect and not has_channel:
            return ["needs a channel, one of the rig's sensors; add it"]
        return []

    @property
    def definition(self) -> EffectDefinition:
        return DEFINITION_BY_ID[self.id, self.form]

    @property
    def place(self) -> str | None:
        """Channel on which it acts; None if on the motion."""
        return self.channel


class BaseOverrides(ConfigModel):
    """True values that override rig file and specimen, SI; omitted: no override."""

    mass_kg: Positive | None = Field(None, description="True mass.")
    damper_stiffness_n_m: Positive | None = Field(None, description="True stiffness of the damper.")
    damper_damping_n_s_m: NonNegative | None = Field(
        None, description="True damping of the damper."
    )
    bumper_stiffness_n_m: Positive | None = Field(
        None, description="True stiffness of each bumper."
    )
    bumper_damping_n_s_m: Positive | None = Field(None, description="True damping of each bumper.")
    gap_right_m: Number | None = Field(None, description="True right gap.")
    gap_left_m: Number | None = Field(None, description="True left gap.")

    @field_validator("gap_right_m", "gap_left_m")
    @classmethod
    def _check_gap(cls, gap: float | None, info: ValidationInfo) -> float | None:
        if gap is not None and (math.isnan(gap) or gap == -math.inf):
            raise InputError(
                f"{info.field_name} is {gap}", allowed="m, or inf without a bumper on this side"
            )
        return gap


EntryT = TypeVar("EntryT", HiddenEffect, Imperfection)


class GroundTruth(ConfigModel):
    """Ground truth of a rig: overridden parameters, hidden effects and imperfections of the rig."""

    base: BaseOverrides = BaseOverrides()
    effects: tuple[HiddenEffect, ...] = ()
    imperfections: tuple[Imperfection, ...] = ()

    @field_validator("effects", "imperfections")
    @classmethod
    def _check_unique(cls, entries: tuple[EntryT, ...]) -> tuple[EntryT, ...]:
        duplicates = list_duplicates(
            [f"{entry.id} {entry.place or ''}".strip() for entry in entries]
        )
        if duplicates:
            raise InputError(f"{', '.join(duplicates)} more than once", remedy="keep one of each")
        return entries


def parse_ground_truth(raw: bytes, sha256: str, source: str) -> GroundTruth:
    """Parse the bytes of a ground-truth file; InputError if they do not match the hash."""
    digest = hashlib.sha256(raw).hexdigest()
    if digest != sha256.lower():
        raise InputError(
            f"the SHA-256 of this ground-truth file is {digest}",
            where=source,
            key="truth_sha256",
            value=sha256,
            remedy="use the file that the rig file was written for, or enter its hash as "
            "truth_sha256 in the rig file",
        )
    return parse_toml(raw.decode(errors="replace"), GroundTruth, source)
