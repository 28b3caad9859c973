"""What a law must be, whoever wrote it: names, units, finite values, and a force that can act."""

import re
from functools import cache
from typing import Any

import numpy as np

from table_io.errors import InputError
from twin.laws.effect import (
    BASE_PARAMETERS,
    NATURAL_CONSTANTS,
    PLACES,
    USUAL_BASE,
    Effect,
    EffectParameter,
)
from twin.laws.expression import (
    Dimension,
    Expression,
    format_dimension,
    parse_expression,
    parse_unit,
)
from twin.laws.properties import (
    MAX_CONSTANTS,
    MAX_STATES,
    evaluate_law,
    is_linear_in_rate,
    list_probes,
)

ID_PATTERN = "^[a-z][a-z0-9_]{0,60}$"
MAX_JUMP_SHARE = 1e-9  # of the largest force: rounding
LEAST_SPEED_M_S = 1e-300  # on either side of a reversal
PROBE_SHARES = (-1.0, -0.3, 0.0, 0.3, 1.0)  # of the range, where a law must be finite
DEFAULT_RANGE = {"u": 0.03, "d": 0.003, "v": 0.3, "a": 5.0, "y": 0.03}  # SI
DEFAULT_DURATION_S = 600.0
Points = dict[str, Any]


@cache
def check_effect(effect: Effect) -> None:
    """Raise InputError with the key at fault unless the effect can be used.

    Cached: a fit looks its effects up for every set of parameters.
    """
    _check_names(effect)
    for parameter in effect.parameters:
        _check_parameter(parameter)
    if effect.place == "sensor":
        return
    _check_expressions(effect)
    _check_dimensions(effect)
    if effect.force:
        _check_values(effect)
        if effect.place in PLACES:
            _check_law(effect)


def _check_names(effect: Effect) -> None:
    if not re.fullmatch(ID_PATTERN, effect.id):
        raise InputError("not the name of an effect", key="id", value=effect.id, allowed=ID_PATTERN)
    parameters = [parameter.name for parameter in effect.parameters]
    names = [*effect.variables, *effect.states, *effect.constants, *parameters]
    if repeated := sorted({name for name in names if names.count(name) > 1}):
        raise InputError("a name with two meanings", key=repeated[0], remedy="rename it")
    ranges = {name for name, *_ in effect.valid_range}
    if unknown := sorted(ranges - effect.variables.keys()):
        raise InputError(
            "not a variable of this law", key=f"range.{unknown[0]}",
            allowed=", ".join(effect.variables),
        )  # fmt: skip
    for name, low, high in effect.valid_range:
        if not low < high:
            raise InputError(
                "not a range", key=f"range.{name}", value=[low, high], allowed="low < high"
            )
    if all(parameter.vanishing is None for parameter in effect.parameters):
        raise InputError(
            "no parameter makes the law vanish", key="parameters",
            remedy="give the amplitude `vanishing = 0.0`",
        )  # fmt: skip
    for key, own, largest in (
        ("parameters", effect.parameters, MAX_CONSTANTS), ("states", effect.states, MAX_STATES),
    ):  # fmt: skip
        if len(own) > largest:
            raise InputError(f"{len(own)} of them", key=key, allowed=f"at most {largest}")


def _check_parameter(parameter: EffectParameter) -> None:
    for key in ("typical", "vanishing"):
        value = getattr(parameter, key)
        if value is not None and not parameter.low <= value <= parameter.high:
            raise InputError(
                "not between low and high", key=f"parameters.{parameter.name}.{key}", value=value,
                allowed=f"{parameter.low:g} to {parameter.high:g}",
            )  # fmt: skip


def _check_expressions(effect: Effect) -> None:
    """Raise InputError unless the effect does something, by texts, at a place that allows it."""
    texts = [effect.force, effect.break_away, effect.pull_off, effect.gap_rate]
    texts += [*effect.changes.values(), *effect.constants.values(), *effect.compiled.values()]
    texts += [state.rate for state in effect.states.values()]
    for text in texts:
        if not isinstance(text, str):
            raise InputError(
                "not an expression", key="force", value=text,
                remedy="write the law as a text, such as 'k * u * abs(u)'",
            )  # fmt: skip
    if not any((effect.force, effect.break_away, effect.pull_off, effect.gap_rate, effect.changes)):
        raise InputError("does nothing", key="force", remedy="write the law as an expression")
    if effect.force and effect.place not in (*PLACES, "input"):
        raise InputError(
            "no place of a force", key="place", value=effect.place,
            allowed=", ".join((*PLACES, "input")),
        )  # fmt: skip
    for key, text, place in (
        ("break_away", effect.break_away, "damper"), ("pull_off", effect.pull_off, "bumpers"),
        ("gap_rate", effect.gap_rate, "bumpers"),
    ):  # fmt: skip
        if text and effect.place != place:
            raise InputError("at another place", key=key, value=effect.place, allowed=place)
    if effect.place == "input" and effect.states:
        raise InputError("a law on the input has no states", key="states", remedy="remove them")


def _check_dimensions(effect: Effect) -> None:
    """Raise InputError unless every expression has the unit of what it is for."""
    own: dict[str, Dimension] = {}
    for parameter in effect.parameters:
        own[parameter.name] = _parse_unit(parameter.unit, f"parameters.{parameter.name}.unit")
    known = {name: parse_unit(unit) for name, (unit, _) in NATURAL_CONSTANTS.items()}
    known |= {name: parse_unit(unit) for name, (unit, _) in BASE_PARAMETERS.items()} | own
    for name, text in effect.constants.items():
        dimension = _find_dimension(f"constants.{name}", _read(text, known, name), known)
        known[name] = own[name] = dimension
    wanted = [
        ("break_away", effect.break_away, "N"), ("pull_off", effect.pull_off, "N"),
        ("gap_rate", effect.gap_rate, "m/s"),
    ]  # fmt: skip
    for name, text in effect.changes.items():
        if name not in BASE_PARAMETERS:
            raise InputError(
                "no base parameter", key=f"changes.{name}", allowed=", ".join(BASE_PARAMETERS)
            )
        wanted.append((f"changes.{name}", text, BASE_PARAMETERS[name][0]))
    for key, text, unit in wanted:
        if text:
            _require_unit(key, _read(text, known, key), unit, known)
    units = {**effect.variables, **{name: state.unit for name, state in effect.states.items()}}
    dimensions = {name: _parse_unit(unit, f"states.{name}.unit") for name, unit in units.items()}
    if effect.force:
        unit = "m/s2" if effect.place == "input" else "N"
        _require_unit("force", effect.parsed_force, unit, dimensions | own)
    for name, rate in effect.parsed_rates.items():
        unit = effect.states[name].unit
        per_second = f"{unit} s" if "/" in unit else f"{unit or '1'}/s"
        _require_unit(f"states.{name}.rate", rate, per_second, dimensions | own)


def _read(text: str, known: dict[str, Dimension], key: str) -> Expression:
    try:
        return parse_expression(text, [*known])
    except InputError as error:
        raise error.replace(key=key) from None


def _parse_unit(unit: str, key: str) -> Dimension:
    try:
        return parse_unit(unit)
    except InputError as error:
        raise error.replace(key=key) from None


def _find_dimension(key: str, expression: Expression, known: dict[str, Dimension]) -> Dimension:
    try:
        return expression.find_dimension(known)
    except InputError as error:
        raise error.replace(key=key) from None


def _require_unit(key: str, expression: Expression, unit: str, known: dict[str, Dimension]) -> None:
    dimension = _find_dimension(key, expression, known)
    if dimension != parse_unit(unit):
        raise InputError(
            f"its unit is {format_dimension(dimension) or 'a pure number'}",
            key=key, value=expression.text, allowed=format_dimension(parse_unit(unit)),
            remedy="correct the expression or the units of its parameters",
        )  # fmt: skip


def _check_values(effect: Effect) -> None:
    """Raise InputError where the law is not finite, jumps, does not vanish, or feeds energy."""
    ranges = {name: (-size, size) for name, size in DEFAULT_RANGE.items()}
    ranges |= {"t": (0.0, DEFAULT_DURATION_S)}
    ranges |= {name: (low, high) for name, low, high in effect.valid_range}
    names = [*effect.variables]
    grids = [
        [0.5 * (low + high) + 0.5 * (high - low) * share for share in PROBE_SHARES]
        for low, high in (ranges[name] for name in names)
    ]
    points: Points = dict(zip(names, map(np.ravel, np.meshgrid(*grids)), strict=True))
    typical = effect.work_out_constants(USUAL_BASE, effect.typical_values)
    given: Points = {**points, **typical, **dict.fromkeys(effect.states, 0.0)}
    for key, expression in (
        ("force", effect.parsed_force),
        *((f"states.{name}.rate", rate) for name, rate in effect.parsed_rates.items()),
    ):
        finite = np.isfinite(expression.evaluate(given))
        if not finite.all():
            index = int(np.argmin(finite))
            where = ", ".join(f"{name} = {points[name][index]:g}" for name in names)
            raise InputError(
                f"not finite at {where}", key=key, value=expression.text,
                remedy="divide by no variable, and give sqrt and log positive arguments",
            )  # fmt: skip
    _check_vanishing(effect, given)
    if "v" in points:
        _check_rates(effect, given)


def _check_vanishing(effect: Effect, given: Points) -> None:
    """Raise InputError unless the law vanishes with its amplitudes.

    Where it has no value there, as a clearance of zero, it must vanish elsewhere.
    """
    values = {
        parameter.name: parameter.typical if parameter.vanishing is None else parameter.vanishing
        for parameter in effect.parameters
    }
    absent = given | effect.work_out_constants(USUAL_BASE, values)
    force, rates = effect.parsed_force, effect.parsed_rates.values()

    def remains(expression: Expression, points: Points) -> bool:
        return bool(np.any(np.nan_to_num(expression.evaluate(points))))

    has_force = remains(force, absent)
    if not has_force and remains(force, absent | dict.fromkeys(effect.states, 1.0)):
        # the states still have an effect, but they may never leave zero
        has_force = any(remains(rate, absent) for rate in rates)
    if has_force:
        raise InputError(
            "does not vanish with its parameters", key="force", value=effect.force,
            remedy="multiply all of it by parameters with a vanishing value",
        )  # fmt: skip


def _check_rates(effect: Effect, given: Points) -> None:
    """Raise InputError if the force jumps at a reversal, or feeds energy though it dissipates.

    What sticks says so by `break_away`: any other jump would switch for ever.
    """
    forward, back, still, moving = (
        effect.parsed_force.evaluate(given | {"v": v})
        for v in (LEAST_SPEED_M_S, -LEAST_SPEED_M_S, 0.0, given["v"])
    )
    if np.any(np.abs(forward - back) > MAX_JUMP_SHARE * np.abs(moving).max()):
        raise InputError(
            "jumps where the velocity changes its sign", key="force", value=effect.force,
            remedy="write tanh(v / s) with a small speed s, or add coulomb_friction",
        )  # fmt: skip
    power = (moving - still) * given["v"]
    if effect.break_away:
        coefficients = effect.work_out_coefficients(USUAL_BASE, effect.typical_values)
        power = power + coefficients["fc"] * np.abs(given["v"])
    if effect.dissipates and np.any(power < -MAX_JUMP_SHARE * np.abs(moving * given["v"])):
        raise InputError(
            "feeds energy in, though it dissipates", key="dissipates", value=True,
            remedy="change the sign, or set dissipates = false",
        )  # fmt: skip


def _check_law(effect: Effect) -> None:
    """Raise InputError unless the solver can integrate the law, called as plain Python."""
    try:
        problem = _find_law_problem(effect)
    except ArithmeticError as error:
        problem = f"its law cannot be evaluated: {type(error).__name__}: {error}"
    if problem:
        raise InputError(problem, where=f"effect {effect.id!r}", key="force", value=effect.force)


def _find_law_problem(effect: Effect) -> str:
    """Return what is wrong with the values of a law, "" if nothing."""
    constants = effect.list_constants(USUAL_BASE, effect.typical_values)
    force, rates = evaluate_law(effect, constants)
    relaxed = (0.0,) * len(effect.states)
    in_bumper = effect.place != "damper"
    for q, w, a, t in list_probes(effect):
        push, slow = force(q, w, a, t, relaxed), force(q, 0.0, a, t, relaxed)
        if not np.isfinite((push, *rates(q, w, a, t, relaxed))).all():
            return f"its law is not finite at deformation {q:g} m, rate {w:g} m/s"
        if in_bumper and not is_linear_in_rate(effect, constants) and (push - slow) * w < 0.0:
            return (
                "in a bumper a force that is not linear in the rate must oppose it: its zero in "
                "flight gives the recovery of the face"
            )
    drives = {(a, t) for *_, a, t in list_probes(effect)}
    if in_bumper and any(force(0.0, 0.0, a, t, relaxed) != 0.0 for a, t in drives):
        return "in a bumper the force must be zero at deformation 0, rate 0, states relaxed"
    return ""
