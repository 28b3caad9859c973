"""Terms of a law search as candidates: rows of `twin.laws.terms` on the scale of a record.

Each is an effect of an effect file: an amplitude and shapes, with reference values from the record.
A power of displacement or speed has a free exponent, which is rounded afterwards (see
`law_search`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product

from twin.discovery.candidates import Candidate
from twin.discovery.motion import RecordScale
from twin.discovery.parameters import (
    EffectKey,
    FreeParameter,
    ParameterKey,
    ParameterSet,
    list_effect_parameters,
)
from twin.laws.effect import Effect, EffectParameter, list_variables
from twin.laws.expression import format_dimension, parse_unit
from twin.laws.library import check_new_effect
from twin.laws.terms import (
    CONTACT,
    EXPRESSION,
    FAMILIES,
    POSITIVE_UNITS,
    REFERENCE_UNITS,
    SHAPE_UNITS,
    ForceTerm,
    write_power,
)

LAW_PREFIX = "law_"  # of the ids of proposed laws
MAX_EXPONENT, MIN_EXPONENT = 12.0, 0.1
ROUND_EXPONENTS = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0)
SHAPE_MARGIN = 4.0  # ratio of the bounds of a shape to the ends of its ladder
# A regularized friction steeper than this in speed cannot be integrated at the usual rates.
MIN_SLIP_SHARE = 0.004  # of the largest velocity


def find_law_class(candidate: Candidate) -> str:
    """Return the class of a term of a law; "" for an effect of the library."""
    if not candidate.name.startswith(LAW_PREFIX):
        return ""
    family = find_family(candidate)
    return EXPRESSION if family is None else family.law_class


def find_family(candidate: Candidate) -> ForceTerm | None:
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


def make_law_candidate(family: ForceTerm, scale: RecordScale) -> Candidate:
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
    low = 0.0 if unit in POSITIVE_UNITS else -100 * size
    parameters = [EffectParameter(amplitude, unit, low, 100 * size, 0.0, 0.1 * size, "Amplitude.")]
    for name, ladder in ladders.items():
        low, high = ladder[0] / SHAPE_MARGIN, ladder[-1] * SHAPE_MARGIN
        if name in ("p", "n"):
            low, high = (1.0 if name == "n" else MIN_EXPONENT), MAX_EXPONENT
        elif name == "s":
            low = max(low, MIN_SLIP_SHARE * scale.v)
        meaning = "Exponent." if name in ("p", "n") else "Shape."
        middle = ladder[len(ladder) // 2]
        parameters.append(
            EffectParameter(name, SHAPE_UNITS[name], low, high, None, middle, meaning)
        )
    law = Effect(
        id=f"{LAW_PREFIX}{family.name}",
        title=family.title,
        term=family.force,
        place=family.place,
        force=family.force,
        parameters=(*parameters, *describe_references(used)),
        states=family.states,
        valid_range=list_valid_range(family.place, scale),
        is_of_file=True,
    )
    candidate = make_candidate(law, used, ladders, scale)
    return replace(candidate, effect=replace(law, compiled=family.compiled))


def list_references(scale: RecordScale, texts: Sequence[str]) -> dict[str, float]:
    """Return the largest values of the record, SI, to which these expressions refer, by name."""
    references = {"u0": scale.u, "v0": scale.v, "d0": scale.depth, "y0": scale.table_disp,
                  "t0": scale.duration_s}  # fmt: skip
    return {name: own for name, own in references.items() if any(name in text for text in texts)}


def describe_references(references: Mapping[str, float]) -> list[EffectParameter]:
    """Return the parameters of a law for largest values of the record, SI."""
    meaning = "Reference: largest value in the recordings."
    return [
        EffectParameter(name, REFERENCE_UNITS[name], 0.5 * value, 2 * value, None, value, meaning)
        for name, value in references.items()
    ]


def list_valid_range(place: str, scale: RecordScale) -> tuple[tuple[str, float, float], ...]:
    """Return the range of each variable of a law at a place, SI, by the largest of the record."""
    ends = {"u": scale.u, "v": scale.v, "d": scale.depth, "a": scale.acc, "y": scale.table_disp}
    valid_range = {name: (name, -end, end) for name, end in ends.items()}
    valid_range["t"] = ("t", 0.0, scale.duration_s)
    return tuple(valid_range[name] for name in list_variables(place))


def make_candidate(
    effect: Effect,
    constants: Mapping[str, float],
    ladders: Mapping[str, Sequence[float]],
    scale: RecordScale,
) -> Candidate:
    """Return a law as a candidate, with values that stay fixed and trial values of its shapes.

    InputError if it is no law.
    """
    check_new_effect(effect)
    free = [
        _set_bounds(own, effect.parameter(own.key.name))
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


def _set_bounds(free: FreeParameter, parameter: EffectParameter) -> FreeParameter:
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
    law, (variable, is_odd) = term.effect, family.power
    reference = f"{variable}0"
    exponent = min(ROUND_EXPONENTS, key=lambda value: abs(value - parameters.values[key]))
    reference_value = parameters.values[EffectKey(term.name, reference)]
    amplitude = parameters.values[term.amplitude.key]
    kept = {own.name: own for own in law.parameters if own.name != "p"}
    power = write_power(variable, reference, is_odd)
    if exponent.is_integer():
        text = _write_power(variable, int(exponent), is_odd)
        amplitude /= reference_value**exponent
        ratio = reference_value**-exponent
        if reference not in law.force.replace(power, ""):
            del kept[reference]
        main = law.parameter(family.amplitude[0])
        kept[main.name] = replace(
            main,
            unit=_divide_unit(main.unit, REFERENCE_UNITS[reference], int(exponent)),
            low=main.low * ratio,
            high=main.high * ratio,
            typical=main.typical * ratio,
        )
    else:
        text = power.replace("**p", f"**{exponent:g}")
    force = law.force.replace(power, text)
    rounded = replace(law, term=force, force=force, parameters=tuple(kept.values()))
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
