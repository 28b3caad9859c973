"""Terms of a law search, as rows: shapes of a force that the library lacks.

A row is a force at a place with an amplitude and shapes, relative to the record: u0, v0, d0 and y0
are its largest displacement, velocity, depth in a bumper and table displacement, w0 is the largest
displacement, t0 the duration. So a search does not depend on the size of the specimen.

Rows become effects of effect files, and laws of a model.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from twin.laws.effect import Place, State


@dataclass(frozen=True, slots=True)
class ForceTerm:
    """A shape of a force: expression, trial values of its shapes, states.

    `shapes` gives a ladder by name; a shape in m, m/s or s is relative to the record's largest
    displacement (depth in a bumper), velocity or the duration. `power` is (variable, is odd) of a
    power law; `amplitude` the name and unit of the parameter with which the law vanishes;
    `compiled` the solver's own form, as of an effect of the library, for a search: it is faster.
    """

    name: str
    law_class: str
    place: Place
    force: str
    shapes: Mapping[str, Sequence[float]] = field(default_factory=dict)
    power: tuple[str, bool] | None = None
    states: Mapping[str, State] = field(default_factory=dict)
    title: str = ""
    amplitude: tuple[str, str] = ("k", "N")
    compiled: Mapping[str, str] = field(default_factory=dict)


REFERENCE_UNITS = {"u0": "m", "v0": "m/s", "d0": "m", "y0": "m", "t0": "s"}
SHAPE_UNITS = {
    "p": "", "w": "m", "s": "m/s", "b": "m/s", "tau": "s", "n": "", "omega2": "1/s2",
    "decay": "1/s", "cubic": "1/m2 s2", "mass": "kg",
}  # fmt: skip
POSITIVE_UNITS = ("kg", "N/m")  # of amplitudes that are positive in every passive law
ODD_EXPONENTS, EVEN_EXPONENTS = (0.5, 1.5, 2.0, 3.0, 5.0, 8.0), (1.0, 2.0, 4.0)
LENGTHS = (0.03, 0.06, 0.12, 0.25, 0.5)
STOPS = (0.1, 0.3, 0.5, 0.7, 0.85)
YIELD_LENGTHS = (0.02, 0.06, 0.15, 0.4)
SPEEDS = (0.006, 0.015, 0.05, 0.15, 0.5)
TIMES = (0.1, 0.3, 1.0)
RELAXATIONS = (3e-4, 1e-3, 3e-3, 1e-2)  # of the duration; see `list_law_candidates`
CONTACT_TIMES = (1e-4, *RELAXATIONS)
# Squares of the frequencies of resonators over that of the main motion; a resonance is narrow. On
# the table it is that with the specimen held: spring and coupling together.
RESONANCES = tuple(float(ratio) ** 2 for ratio in np.geomspace(0.3, 12.0, 34))
RESONANCE_DECAYS = (0.15,)  # 2 z omega over the main angular frequency
CUBIC_RESONANCES = tuple(float(ratio) for ratio in np.geomspace(0.1, 1e3, 44))
MEMORYLESS, CONTACT, TABLE = "force in u and v", "bumper force", "force on the table's motion"
MEMORY, DRIFT, RESONATOR = "internal state", "drift in time", "attached resonator"
EXPRESSION = "free expression"  # of symbolic regression
HYSTERESIS = {"z": State("", "(v - abs(v) * z * abs(z)**(n - 1)) / w")}
TOUCH = "min(max(100 * d / d0, 0), 1)"  # 1 in contact, 0 where a face is free: it relaxes to d = 0


def write_power(variable: str, reference: str, odd: bool) -> str:
    return f"{f'sign({variable}) * ' if odd else ''}(abs({variable}) / {reference})**p"


def _bumper_power(side: str, place: Place, words: str) -> ForceTerm:
    return ForceTerm(
        f"{side}bumper_power", CONTACT, place, f"k * {write_power('d', 'd0', True)}",
        {"p": (0.5, 1.5, 2.0, 3.0, 5.0)}, ("d", True), title=f"{words} law",
    )  # fmt: skip


def _drifts(
    place: Place, name: str, shape: str, ladder: Mapping[str, Sequence[float]], words: str
) -> tuple[ForceTerm, ForceTerm]:
    """Return the families of a force that drifts, and of one that settles."""
    return (
        ForceTerm(
            f"drifting_{name}", DRIFT, place, f"k * t / t0 * {shape}", ladder,
            title=f"{words} that drifts",
        ),
        ForceTerm(
            f"settling_{name}", DRIFT, place, f"k * exp(-t / tau) * {shape}",
            {**ladder, "tau": TIMES}, title=f"{words} that settles",
        ),
    )  # fmt: skip


FAMILIES: tuple[ForceTerm, ...] = (
    ForceTerm("spring_power", MEMORYLESS, "damper", f"k * {write_power('u', 'u0', True)}",
               {"p": ODD_EXPONENTS}, ("u", True), title="nonlinear spring"),
    ForceTerm("constant_force", MEMORYLESS, "damper", "k", {},
               title="constant force, or offset of its sensor"),
    ForceTerm("even_spring", MEMORYLESS, "damper", f"k * {write_power('u', 'u0', False)}",
               {"p": EVEN_EXPONENTS}, ("u", False), title="spring that differs by direction"),
    ForceTerm("saturating_spring", MEMORYLESS, "damper", "k * tanh(u / w)",
               {"w": LENGTHS}, title="saturating spring"),
    ForceTerm("exponential_spring", MEMORYLESS, "damper", "k * sinh(u / w)",
               {"w": (0.15, 0.25, 0.5)}, title="exponentially hardening spring"),
    ForceTerm("stop_spring", MEMORYLESS, "damper", "k * sign(u) * max(abs(u) - w, 0) / u0",
               {"w": STOPS}, title="spring with a knee"),
    ForceTerm("right_stop_spring", MEMORYLESS, "damper", "k * max(u - w, 0) / u0",
               {"w": STOPS}, title="spring that acts beyond a clearance on the right"),
    ForceTerm("left_stop_spring", MEMORYLESS, "damper", "k * min(u + w, 0) / u0",
               {"w": STOPS}, title="spring that acts beyond a clearance on the left"),
    ForceTerm("damping_power", MEMORYLESS, "damper", f"k * {write_power('v', 'v0', True)}",
               {"p": (0.3, *ODD_EXPONENTS)}, ("v", True), title="nonlinear damping"),
    ForceTerm("even_damping", MEMORYLESS, "damper", f"k * {write_power('v', 'v0', False)}",
               {"p": EVEN_EXPONENTS}, ("v", False), title="damping that differs by direction"),
    ForceTerm("saturating_damping", MEMORYLESS, "damper", "k * tanh(v / s)",
               {"s": SPEEDS}, title="saturating damping"),
    ForceTerm("fading_friction", MEMORYLESS, "damper",
               "k * tanh(v / (0.1 * s)) * exp(-(v / s)**2)",
               {"s": (0.05, 0.15, 0.4)}, title="friction that fades with speed"),
    ForceTerm("one_way_damping", MEMORYLESS, "damper", "k * (max(v, 0) / v0)**p",
               {"p": (1.0, 2.0, 3.0)}, title="damping in one direction"),
    ForceTerm("position_damping", MEMORYLESS, "damper",
               f"k * v / v0 * {write_power('u', 'u0', False)}",
               {"p": (1.0, 2.0, 4.0)}, ("u", False), title="damping that depends on position"),
    ForceTerm("even_position_damping", MEMORYLESS, "damper",
               f"k * v / v0 * {write_power('u', 'u0', True)}",
               {"p": (1.0, 3.0)}, ("u", True), title="damping that depends on position"),
    ForceTerm("position_friction", MEMORYLESS, "damper",
               f"k * tanh(v / s) * {write_power('u', 'u0', False)}",
               {"p": (1.0, 2.0), "s": (0.006, 0.03)}, title="friction that depends on position"),
    ForceTerm("speed_stiffness", MEMORYLESS, "damper",
               f"k * u / u0 * {write_power('v', 'v0', False)}",
               {"p": (1.0, 2.0)}, ("v", False), title="stiffness that depends on speed"),
    _bumper_power("", "bumpers", "bumper"),
    _bumper_power("right_", "right_bumper", "right bumper"),
    _bumper_power("left_", "left_bumper", "left bumper"),
    ForceTerm("bumper_exponential", CONTACT, "bumpers", "k * sinh(d / w)",
               {"w": (0.15, 0.3, 0.6)}, title="exponentially hardening bumper"),
    ForceTerm("bumper_damping_power", CONTACT, "bumpers",
               f"k * v / v0 * {write_power('d', 'd0', False)}",
               {"p": (0.5, 1.0, 2.0, 3.0)}, ("d", False), title="damping that grows with depth"),
    ForceTerm("bumper_rate_power", CONTACT, "bumpers", f"k * {write_power('v', 'v0', True)}",
               {"p": (0.5, 2.0, 3.0)}, ("v", True), title="nonlinear bumper damping"),
    ForceTerm("compression_damping", CONTACT, "bumpers", "k * (max(v, 0) / v0)**p",
               {"p": (1.0, 2.0)}, title="bumper damping in compression"),
    ForceTerm("contact_softening", CONTACT, "bumpers", "k * h * d / d0", {"tau": CONTACT_TIMES},
               states={"h": State("", f"({TOUCH} - h) / tau")},
               title="bumper stiffness that changes with the time since touch"),
    ForceTerm("bumper_relaxation", CONTACT, "bumpers", "f", {"tau": RELAXATIONS},
               states={"f": State("N", "k * v / d0 - f / tau")},
               title="bumper that relaxes", compiled={"kb": "k / d0", "rate_b": "1 / tau"}),
    ForceTerm("table_power", TABLE, "input", f"g * {write_power('y', 'y0', True)}",
               {"p": (1.0, 2.0, 3.0)}, ("y", True), title="force of the table's position",
               amplitude=("g", "m/s2")),
    ForceTerm("even_table_power", TABLE, "input", f"g * {write_power('y', 'y0', False)}",
               {"p": (1.0, 2.0)}, ("y", False), title="force of the table's position",
               amplitude=("g", "m/s2")),
    ForceTerm("table_speed", TABLE, "damper", "k * w / v0", {"tau": (0.03, 0.3)},
               states={"w": State("m/s", "a - w / tau")},
               title="force of the table's velocity"),
    ForceTerm("resonator", RESONATOR, "damper", "mass * (-omega2 * s - decay * (y - v))",
               {"omega2": RESONANCES, "decay": RESONANCE_DECAYS},
               states={"s": State("m", "y - v"),
                       "y": State("m/s", "-a - omega2 * s - decay * (y - v)")},
               title="resonator on the specimen", amplitude=("mass", "kg")),
    ForceTerm("cubic_resonator", RESONATOR, "damper", "mass * (-cubic * s**3 - decay * (y - v))",
               {"cubic": CUBIC_RESONANCES, "decay": RESONANCE_DECAYS},
               states={"s": State("m", "y - v"),
                       "y": State("m/s", "-a - cubic * s**3 - decay * (y - v)")},
               title="resonator with a cubic spring", amplitude=("mass", "kg")),
    ForceTerm("table_resonator", RESONATOR, "damper", "k * (u - r)",
               {"omega2": RESONANCES, "decay": RESONANCE_DECAYS, "mass": (0.1,)},
               states={"r": State("m", "y"),
                       "y": State("m/s",
                                     "-a - omega2 * r - decay * y + k * u / mass")},
               title="resonator on the table, coupled by a spring", amplitude=("k", "N/m")),
    ForceTerm("hysteresis", MEMORY, "damper", "k * z",
               {"n": (1.0, 2.0, 4.0), "w": YIELD_LENGTHS},
               states=HYSTERESIS, title="hysteresis"),
    ForceTerm("slack_hysteresis", MEMORY, "damper", "k * sign(z) * abs(z)**p",
               {"p": (2.0, 4.0), "n": (1.0, 4.0), "w": YIELD_LENGTHS},
               states=HYSTERESIS, title="hysteresis behind slack"),
    ForceTerm("relaxation", MEMORY, "damper", "f", {"tau": RELAXATIONS},
               states={"f": State("N", "k * v / u0 - f / tau")}, title="relaxation",
               compiled={"k1": "k / u0", "rate_1": "1 / tau"}),
    ForceTerm("nonlinear_relaxation", MEMORY, "damper", "k * (e / u0)**3",
               {"b": (0.03, 0.1, 0.3, 1.0)},
               states={"e": State("m", "v - b * (e / u0)**3")},
               title="relaxation with a cubic spring"),
    *_drifts("damper", "spring", "u / u0", {}, "stiffness"),
    *_drifts("damper", "damping", "v / v0", {}, "damping"),
    *_drifts("damper", "friction", "tanh(v / s)", {"s": (0.006, 0.03)}, "friction"),
    *_drifts("bumpers", "bumper", "d / d0", {}, "bumper stiffness"),
)  # fmt: skip
