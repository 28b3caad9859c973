"""Terms of force laws that the library lacks, by class: the physical basis of a law search.

Each term is an effect of an effect file: an amplitude `k` in N and shapes, with reference values
from the record, so that a search does not depend on the size of the specimen. A power of
displacement or speed has a free exponent, which is rounded afterwards (see `law_search`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product

import numpy as np

from twin.discovery.candidates import Candidate
from twin.discovery.motion import RecordScale
from twin.discovery.parameters import (
    EffectKey,
    FreeParameter,
    ParameterKey,
    ParameterSet,
    list_effect_parameters,
)
from twin.model.effects.effect_file import (
    EffectFile,
    LawParameter,
    LawPlace,
    LawState,
    WrittenEffect,
    list_variables,
)
from twin.model.effects.expression import format_dimension, parse_unit

LAW_PREFIX = "law_"  # of the ids of proposed laws
MAX_EXPONENT, MIN_EXPONENT = 12.0, 0.1
ROUND_EXPONENTS = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0)
SHAPE_MARGIN = 4.0  # ratio of the bounds of a shape to the ends of its ladder
# A regularized friction steeper than this in speed cannot be integrated at the usual rates.
MIN_SLIP_SHARE = 0.004  # of the largest velocity


@dataclass(frozen=True, slots=True)
class TermFamily:
    """Family of force laws: expression, ladders of its shapes, references, states.

    `shapes` gives trial values by name; `units` the unit of each shape and reference. A shape in
    m, m/s or s is relative to the record's largest displacement (depth in a bumper), velocity or
    the duration, as are the references: those named u0, v0, d0 and y0 are the largest values, w0
    is the largest displacement and t0 the duration. `power` is (variable, is odd) of a power law;
    `amplitude` the name and unit of the parameter with which the law vanishes.
    """

    name: str
    law_class: str
    place: LawPlace
    force: str
    shapes: Mapping[str, Sequence[float]]
    power: tuple[str, bool] | None = None
    states: Mapping[str, LawState] = field(default_factory=dict)
    title: str = ""
    amplitude: tuple[str, str] = ("k", "N")


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
HYSTERESIS = {"z": LawState(unit="", rate="(v - abs(v) * z * abs(z)**(n - 1)) / w")}
TOUCH = "min(max(100 * d / d0, 0), 1)"  # 1 in contact, 0 where a face is free: it relaxes to d = 0


def _power(variable: str, reference: str, odd: bool) -> str:
    return f"{f'sign({variable}) * ' if odd else ''}(abs({variable}) / {reference})**p"


def _bumper_power(side: str, place: LawPlace, words: str) -> TermFamily:
    return TermFamily(
        f"{side}bumper_power", CONTACT, place, f"k * {_power('d', 'd0', True)}",
        {"p": (0.5, 1.5, 2.0, 3.0, 5.0)}, ("d", True), title=f"{words} law",
    )  # fmt: skip


def _drifts(
    place: LawPlace, name: str, shape: str, ladder: Mapping[str, Sequence[float]], words: str
) -> tuple[TermFamily, TermFamily]:
    """Return the families of a force that drifts, and of one that settles."""
    return (
        TermFamily(
            f"drifting_{name}", DRIFT, place, f"k * t / t0 * {shape}", ladder,
            title=f"{words} that drifts",
        ),
        TermFamily(
            f"settling_{name}", DRIFT, place, f"k * exp(-t / tau) * {shape}",
            {**ladder, "tau": TIMES}, title=f"{words} that settles",
        ),
    )  # fmt: skip


FAMILIES: tuple[TermFamily, ...] = (
    TermFamily("spring_power", MEMORYLESS, "damper", f"k * {_power('u', 'u0', True)}",
               {"p": ODD_EXPONENTS}, ("u", True), title="nonlinear spring"),
    TermFamily("constant_force", MEMORYLESS, "damper", "k", {},
               title="constant force, or offset of its sensor"),
    TermFamily("even_spring", MEMORYLESS, "damper", f"k * {_power('u', 'u0', False)}",
               {"p": EVEN_EXPONENTS}, ("u", False), title="spring that differs by direction"),
    TermFamily("saturating_spring", MEMORYLESS, "damper", "k * tanh(u / w)",
               {"w": LENGTHS}, title="saturating spring"),
    TermFamily("exponential_spring", MEMORYLESS, "damper", "k * sinh(u / w)",
               {"w": (0.15, 0.25, 0.5)}, title="exponentially hardening spring"),
    TermFamily("stop_spring", MEMORYLESS, "damper", "k * sign(u) * max(abs(u) - w, 0) / u0",
               {"w": STOPS}, title="spring with a knee"),
    TermFamily("right_stop_spring", MEMORYLESS, "damper", "k * max(u - w, 0) / u0",
               {"w": STOPS}, title="spring that acts beyond a clearance on the right"),
    TermFamily("left_stop_spring", MEMORYLESS, "damper", "k * min(u + w, 0) / u0",
               {"w": STOPS}, title="spring that acts beyond a clearance on the left"),
    TermFamily("damping_power", MEMORYLESS, "damper", f"k * {_power('v', 'v0', True)}",
               {"p": (0.3, *ODD_EXPONENTS)}, ("v", True), title="nonlinear damping"),
    TermFamily("even_damping", MEMORYLESS, "damper", f"k * {_power('v', 'v0', False)}",
               {"p": EVEN_EXPONENTS}, ("v", False), title="damping that differs by direction"),
    TermFamily("saturating_damping", MEMORYLESS, "damper", "k * tanh(v / s)",
               {"s": SPEEDS}, title="saturating damping"),
    TermFamily("fading_friction", MEMORYLESS, "damper",
               "k * tanh(v / (0.1 * s)) * exp(-(v / s)**2)",
               {"s": (0.05, 0.15, 0.4)}, title="friction that fades with speed"),
    TermFamily("one_way_damping", MEMORYLESS, "damper", "k * (max(v, 0) / v0)**p",
               {"p": (1.0, 2.0, 3.0)}, title="damping in one direction"),
    TermFamily("position_damping", MEMORYLESS, "damper",
               f"k * v / v0 * {_power('u', 'u0', False)}",
               {"p": (1.0, 2.0, 4.0)}, ("u", False), title="damping that depends on position"),
    TermFamily("even_position_damping", MEMORYLESS, "damper",
               f"k * v / v0 * {_power('u', 'u0', True)}",
               {"p": (1.0, 3.0)}, ("u", True), title="damping that depends on position"),
    TermFamily("position_friction", MEMORYLESS, "damper",
               f"k * tanh(v / s) * {_power('u', 'u0', False)}",
               {"p": (1.0, 2.0), "s": (0.006, 0.03)}, title="friction that depends on position"),
    TermFamily("speed_stiffness", MEMORYLESS, "damper",
               f"k * u / u0 * {_power('v', 'v0', False)}",
               {"p": (1.0, 2.0)}, ("v", False), title="stiffness that depends on speed"),
    _bumper_power("", "bumpers", "bumper"),
    _bumper_power("right_", "right_bumper", "right bumper"),
    _bumper_power("left_", "left_bumper", "left bumper"),
    TermFamily("bumper_exponential", CONTACT, "bumpers", "k * sinh(d / w)",
               {"w": (0.15, 0.3, 0.6)}, title="exponentially hardening bumper"),
    TermFamily("bumper_damping_power", CONTACT, "bumpers",
               f"k * v / v0 * {_power('d', 'd0', False)}",
               {"p": (0.5, 1.0, 2.0, 3.0)}, ("d", False), title="damping that grows with depth"),
    TermFamily("bumper_rate_power", CONTACT, "bumpers", f"k * {_power('v', 'v0', True)}",
               {"p": (0.5, 2.0, 3.0)}, ("v", True), title="nonlinear bumper damping"),
    TermFamily("compression_damping", CONTACT, "bumpers", "k * (max(v, 0) / v0)**p",
               {"p": (1.0, 2.0)}, title="bumper damping in compression"),
    TermFamily("contact_softening", CONTACT, "bumpers", "k * h * d / d0", {"tau": CONTACT_TIMES},
               states={"h": LawState(unit="", rate=f"({TOUCH} - h) / tau")},
               title="bumper stiffness that changes with the time since touch"),
    TermFamily("bumper_relaxation", CONTACT, "bumpers", "f", {"tau": RELAXATIONS},
               states={"f": LawState(unit="N", rate="k * v / d0 - f / tau")},
               title="bumper that relaxes"),
    TermFamily("table_power", TABLE, "input", f"g * {_power('y', 'y0', True)}",
               {"p": (1.0, 2.0, 3.0)}, ("y", True), title="force of the table's position",
               amplitude=("g", "m/s2")),
    TermFamily("even_table_power", TABLE, "input", f"g * {_power('y', 'y0', False)}",
               {"p": (1.0, 2.0)}, ("y", False), title="force of the table's position",
               amplitude=("g", "m/s2")),
    TermFamily("table_speed", TABLE, "damper", "k * w / v0", {"tau": (0.03, 0.3)},
               states={"w": LawState(unit="m/s", rate="a - w / tau")},
               title="force of the table's velocity"),
    TermFamily("resonator", RESONATOR, "damper", "mass * (-omega2 * s - decay * (y - v))",
               {"omega2": RESONANCES, "decay": RESONANCE_DECAYS},
               states={"s": LawState(unit="m", rate="y - v"),
                       "y": LawState(unit="m/s", rate="-a - omega2 * s - decay * (y - v)")},
               title="resonator on the specimen", amplitude=("mass", "kg")),
    TermFamily("cubic_resonator", RESONATOR, "damper", "mass * (-cubic * s**3 - decay * (y - v))",
               {"cubic": CUBIC_RESONANCES, "decay": RESONANCE_DECAYS},
               states={"s": LawState(unit="m", rate="y - v"),
                       "y": LawState(unit="m/s", rate="-a - cubic * s**3 - decay * (y - v)")},
               title="resonator with a cubic spring", amplitude=("mass", "kg")),
    TermFamily("table_resonator", RESONATOR, "damper", "k * (u - r)",
               {"omega2": RESONANCES, "decay": RESONANCE_DECAYS, "mass": (0.1,)},
               states={"r": LawState(unit="m", rate="y"),
                       "y": LawState(unit="m/s",
                                     rate="-a - omega2 * r - decay * y + k * u / mass")},
               title="resonator on the table, coupled by a spring", amplitude=("k", "N/m")),
    TermFamily("hysteresis", MEMORY, "damper", "k * z",
               {"n": (1.0, 2.0, 4.0), "w": YIELD_LENGTHS},
               states=HYSTERESIS, title="hysteresis"),
    TermFamily("slack_hysteresis", MEMORY, "damper", "k * sign(z) * abs(z)**p",
               {"p": (2.0, 4.0), "n": (1.0, 4.0), "w": YIELD_LENGTHS},
               states=HYSTERESIS, title="hysteresis behind slack"),
    TermFamily("relaxation", MEMORY, "damper", "f", {"tau": RELAXATIONS},
               states={"f": LawState(unit="N", rate="k * v / u0 - f / tau")}, title="relaxation"),
    TermFamily("nonlinear_relaxation", MEMORY, "damper", "k * (e / u0)**3",
               {"b": (0.03, 0.1, 0.3, 1.0)},
               states={"e": LawState(unit="m", rate="v - b * (e / u0)**3")},
               title="relaxation with a cubic spring"),
    *_drifts("damper", "spring", "u / u0", {}, "stiffness"),
    *_drifts("damper", "damping", "v / v0", {}, "damping"),
    *_drifts("damper", "friction", "tanh(v / s)", {"s": (0.006, 0.03)}, "friction"),
    *_drifts("bumpers", "bumper", "d / d0", {}, "bumper stiffness"),
)  # fmt: skip


def find_law_class(candidate: Candidate) -> str:
    """Return the class of a term of a law; "" for an effect of the library."""
    if not candidate.name.startswith(LAW_PREFIX):
        return ""
    family = find_family(candidate)
    return EXPRESSION if family is None else family.law_class


def find_family(candidate: Candidate) -> TermFamily | None:
    """Return the family of a term; None for an effect of the library or a free expression."""
    return next(
        (family for family in FAMILIES if candidate.name == f"{LAW_PREFIX}{family.name}"), None
    )


def list_law_candidates(scale: RecordScale, has_contact: bool) -> tuple[Candidate, ...]:
    """Return every term family as a candidate on the scale of the records."""
    return tuple(
        make_law_candidate(family, scale)
        for family in FAMILIES
        if has_contact or (family.law_class != CONTACT and family.place != "bumpers")
    )


def make_law_candidate(family: TermFamily, scale: RecordScale) -> Candidate:
    """Return a term family as a candidate, its references at the largest values of the record."""
    in_bumper = family.place not in ("damper", "input")
    length = scale.depth if in_bumper else scale.u
    rate, mass = 1.0 / scale.time_s, scale.force / scale.acc
    sizes = {
        "m": length, "m/s": scale.v, "s": scale.duration_s, "": 1.0, "1/s2": rate**2, "1/s": rate,
        "1/m2 s2": (rate / scale.u) ** 2, "N": scale.force, "m/s2": scale.acc, "kg": mass,
        "N/m": scale.force / scale.u,
    }  # fmt: skip
    used = list_references(scale, [family.force, *(state.rate for state in family.states.values())])
    amplitude, unit = family.amplitude
    size = sizes[unit]
    ladders = {
        name: [value * sizes[SHAPE_UNITS[name]] for value in ladder]
        for name, ladder in family.shapes.items()
    }
    parameters = {
        amplitude: LawParameter(
            unit=unit, low=0.0 if unit in POSITIVE_UNITS else -100 * size, high=100 * size,
            vanishing=0.0, typical=0.1 * size, meaning="Amplitude.",
        )
    }  # fmt: skip
    for name, ladder in ladders.items():
        low, high = ladder[0] / SHAPE_MARGIN, ladder[-1] * SHAPE_MARGIN
        if name in ("p", "n"):
            low, high = (1.0 if name == "n" else MIN_EXPONENT), MAX_EXPONENT
        elif name == "s":
            low = max(low, MIN_SLIP_SHARE * scale.v)
        parameters[name] = LawParameter(
            unit=SHAPE_UNITS[name], low=low, high=high, typical=ladder[len(ladder) // 2],
            meaning="Exponent." if name in ("p", "n") else "Shape.",
        )  # fmt: skip
    parameters |= describe_references(used)
    law = EffectFile(
        id=f"{LAW_PREFIX}{family.name}", title=family.title, place=family.place, force=family.force,
        parameters=parameters, states=dict(family.states),
        range=list_valid_range(family.place, scale),
    )  # fmt: skip
    return make_candidate(law, used, ladders, scale)


def list_references(scale: RecordScale, texts: Sequence[str]) -> dict[str, float]:
    """Return the largest values of the record, SI, to which these expressions refer, by name."""
    references = {"u0": scale.u, "v0": scale.v, "d0": scale.depth, "y0": scale.table_disp,
                  "t0": scale.duration_s}  # fmt: skip
    return {name: own for name, own in references.items() if any(name in text for text in texts)}


def describe_references(references: Mapping[str, float]) -> dict[str, LawParameter]:
    """Return the parameters of a law for largest values of the record, SI, by name."""
    return {
        name: LawParameter(
            unit=REFERENCE_UNITS[name], low=0.5 * value, high=2 * value, typical=value,
            meaning="Reference: largest value in the recordings.",
        )
        for name, value in references.items()
    }  # fmt: skip


def list_valid_range(place: LawPlace, scale: RecordScale) -> dict[str, tuple[float, float]]:
    """Return the range of each variable of a law at a place, SI, by the largest of the record."""
    ends = {"u": scale.u, "v": scale.v, "d": scale.depth, "a": scale.acc, "y": scale.table_disp}
    valid_range = {name: (-end, end) for name, end in ends.items()} | {"t": (0.0, scale.duration_s)}
    return {name: valid_range[name] for name in list_variables(place)}


def make_candidate(
    law: EffectFile,
    constants: Mapping[str, float],
    ladders: Mapping[str, Sequence[float]],
    scale: RecordScale,
) -> Candidate:
    """Return a law as a candidate, with values that stay fixed and trial values of its shapes."""
    effect = law.build_effect()
    free = [
        _set_bounds(own, law.parameters[own.key.name])
        for own in list_effect_parameters(effect, scale)
        if isinstance(own.key, EffectKey) and own.key.name not in constants
    ]
    amplitude = next(own for own in free if own.vanishing is not None)
    names = [
        own.key.name for own in free if own is not amplitude and isinstance(own.key, EffectKey)
    ]
    shapes = tuple(product(*(ladders[name] for name in names)))
    fixed: dict[ParameterKey, float] = {
        EffectKey(effect.id, name): value for name, value in constants.items()
    }
    return Candidate(effect.id, tuple(free), amplitude, 0.0, shapes, effect, constants=fixed)


def _set_bounds(free: FreeParameter, parameter: LawParameter) -> FreeParameter:
    """Return a free parameter with the bounds of the law, which come from the record already."""
    scale = parameter.high / 100 if parameter.vanishing is not None else parameter.typical
    return FreeParameter(
        free.key, parameter.low, parameter.high, scale, free.unit, free.logarithmic,
        free.vanishing,
    )  # fmt: skip


def round_exponent(
    term: Candidate, parameters: ParameterSet, scale: RecordScale
) -> tuple[Candidate, float] | None:
    """Return a power law with the nearest round exponent, and its amplitude; None if it has none.

    An integer exponent is written as a product, with the amplitude in N over powers of the unit.
    """
    family, key = find_family(term), EffectKey(term.name, "p")
    if family is None or family.power is None or key not in parameters.values:
        return None
    assert isinstance(term.effect, WrittenEffect)
    law, (variable, is_odd) = term.effect.law, family.power
    reference = f"{variable}0"
    exponent = min(ROUND_EXPONENTS, key=lambda value: abs(value - parameters.values[key]))
    reference_value = parameters.values[EffectKey(term.name, reference)]
    amplitude = parameters.values[term.amplitude.key]
    kept = {name: own for name, own in law.parameters.items() if name != "p"}
    if exponent.is_integer():
        text = _write_power(variable, int(exponent), is_odd)
        amplitude /= reference_value**exponent
        ratio = reference_value**-exponent
        if reference not in law.force.replace(_power(variable, reference, is_odd), ""):
            del kept[reference]
        main = law.parameters[term.amplitude.key.name]  # type: ignore[union-attr]
        unit = _divide_unit(main.unit, REFERENCE_UNITS[reference], int(exponent))
        kept[term.amplitude.key.name] = main.model_copy(  # type: ignore[union-attr]
            update={
                "unit": unit, "low": main.low * ratio, "high": main.high * ratio,
                "typical": main.typical * ratio,
            }
        )  # fmt: skip
    else:
        text = _power(variable, reference, is_odd).replace("**p", f"**{exponent:g}")
    force = law.force.replace(_power(variable, reference, is_odd), text)
    rounded = law.model_copy(update={"force": force, "parameters": kept})
    values = {name: parameters.values[EffectKey(term.name, name)] for name in kept}
    constants = {name: values[name] for name in kept if name in REFERENCE_UNITS}
    ladders = {
        name: [values[name]]
        for name in kept
        if name not in constants and kept[name].vanishing is None
    }
    return make_candidate(rounded, constants, ladders, scale), amplitude


def _write_power(variable: str, exponent: int, is_odd: bool) -> str:
    """Return the power of a variable as a product, odd or even in it."""
    is_plain = is_odd == bool(exponent % 2)
    power = exponent if is_plain or not is_odd else exponent - 1
    base = variable if is_plain or is_odd else f"abs({variable})"
    text = base if power == 1 else f"{base}**{power}"
    return text if is_plain or not is_odd else f"{text} * abs({variable})"


def _divide_unit(unit: str, reference: str, exponent: int) -> str:
    """Return a unit over a power of m, m/s or s, as in N s2/m2."""
    dimension = [
        own - exponent * other
        for own, other in zip(parse_unit(unit), parse_unit(reference), strict=True)
    ]
    return format_dimension((dimension[0], dimension[1], dimension[2]))
