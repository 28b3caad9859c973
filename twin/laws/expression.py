"""Expressions of laws: a small grammar, checked for names and units, without `eval`.

An expression is arithmetic (+ - * / **), numbers, names and the functions of `FUNCTIONS`, written
as in Python. The parsed tree is checked node by node; anything else (attributes, subscripts,
strings, other calls) is refused. It is evaluated on arrays, and written as plain Python that numba
compiles, from the same tree.
"""

import ast
import copy
import math
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import FunctionType
from typing import Any

import numpy as np

from table_io.errors import InputError, suggest

MAX_TEXT_LENGTH = 1000  # characters
MAX_NODES, MAX_DEPTH = 100, 30  # of the tree of one expression
MAX_EXPONENT = 100  # of a power, as a number
MAX_UNIT_LENGTH = 40  # characters
BASE_UNITS: Mapping[str, tuple[float, float, float]] = {  # exponents of kg, m, s
    "N": (1, 1, -2), "m": (0, 1, 0), "s": (0, 0, 1), "kg": (1, 0, 0), "rad": (0, 0, 0),
    "Hz": (0, 0, -1), "1": (0, 0, 0),
}  # fmt: skip
Dimension = tuple[float, float, float]
DIMENSIONLESS: Dimension = (0.0, 0.0, 0.0)


# function -> (of one number, of an array, number of arguments)
FUNCTIONS: Mapping[str, tuple[Callable[..., float], Callable[..., Any], int]] = {
    "abs": (abs, np.abs, 1),
    # +1 or -1, at a zero that of the zero: a force law has a side at a reversal. Of one number it
    # is called with 1.0 before its argument, see `write_source`: numba knows no such sign.
    "sign": (math.copysign, lambda x: np.copysign(1.0, x), 1),
    "sqrt": (math.sqrt, np.sqrt, 1),
    "exp": (math.exp, np.exp, 1),
    "expm1": (math.expm1, np.expm1, 1),
    "log": (math.log, np.log, 1),
    "sin": (math.sin, np.sin, 1),
    "cos": (math.cos, np.cos, 1),
    "sinh": (math.sinh, np.sinh, 1),
    "tanh": (math.tanh, np.tanh, 1),
    "min": (min, np.minimum, 2),
    "max": (max, np.maximum, 2),
}
OPERATORS: Mapping[type[ast.operator], Callable[[Any, Any], Any]] = {
    ast.Add: np.add,
    ast.Sub: np.subtract,
    ast.Mult: np.multiply,
    ast.Div: np.divide,
    ast.Pow: np.power,
}
SIGNS: Mapping[type[ast.unaryop], Callable[[Any], Any]] = {
    ast.USub: np.negative,
    ast.UAdd: np.positive,
}
ALLOWED = f"numbers, names, + - * / **, brackets and {', '.join(FUNCTIONS)}"


@dataclass(frozen=True, eq=False)
class Expression:
    """A checked expression: its text, tree and names of variables."""

    text: str
    tree: ast.expr
    names: frozenset[str]

    def evaluate(self, values: Mapping[str, Any]) -> Any:
        """Return the value for numbers or arrays of the names."""
        with np.errstate(all="ignore"):
            return _evaluate(self.tree, values)

    def find_dimension(self, dimensions: Mapping[str, Dimension]) -> Dimension:
        """Return the exponents of kg, m and s, from those of the names; InputError if none."""
        return _DimensionCheck(dimensions, self.text).find(self.tree)

    def write_source(self, names: Mapping[str, str]) -> str:
        """Return plain Python for it, for numbers, with other names: "q" or "c[0]" for a name.

        "sign(v)" in `names` replaces the sign of v. `build_function` makes a function of such text.
        """
        return ast.unparse(_SourceWriter(names).visit(copy.deepcopy(self.tree)))


def parse_expression(text: str, known_names: Sequence[str]) -> Expression:
    """Return the checked expression of a text; InputError says what is outside the grammar."""
    if len(text) > MAX_TEXT_LENGTH:
        raise _refuse("too long", text[:40], allowed=f"at most {MAX_TEXT_LENGTH} characters")
    try:
        tree = ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise _refuse("not an expression", text) from None
    names: set[str] = set()
    node_count = _check_node(tree, text, known_names, names, 0)
    if node_count > MAX_NODES:
        raise _refuse(f"has {node_count} nodes", text, allowed=f"at most {MAX_NODES}")
    return Expression(text.strip(), tree, frozenset(names))


def _refuse(problem: str, text: str, allowed: str = ALLOWED, remedy: str = "") -> InputError:
    return InputError(f"{problem}", value=text, allowed=allowed, remedy=remedy)


def _check_node(
    node: ast.expr, text: str, known_names: Sequence[str], names: set[str], depth: int
) -> int:
    """Return the number of nodes below and with this one; InputError if one is not allowed."""
    if depth > MAX_DEPTH:
        raise _refuse("nested too deeply", text, allowed=f"at most {MAX_DEPTH} levels")
    match node:
        case ast.Constant(value=float() | int() as value) if not isinstance(value, bool):
            if not abs(value) <= sys.float_info.max:
                raise _refuse("has a number that is not finite", text)
            return 1
        case ast.Name(id=name):
            if name not in known_names:
                raise _refuse(
                    f"{name!r} is unknown", text, allowed=", ".join(known_names),
                    remedy=suggest(name, [*known_names, *FUNCTIONS]),
                )  # fmt: skip
            names.add(name)
            return 1
        case ast.UnaryOp(op=op, operand=operand) if type(op) in SIGNS:
            parts = [operand]
        case ast.BinOp(left=left, op=op, right=right) if type(op) in OPERATORS:
            parts = [left, right]
            if isinstance(op, ast.Pow) and abs(_find_constant(right) or 0.0) > MAX_EXPONENT:
                raise _refuse("has a large exponent", text, f"at most {MAX_EXPONENT}")
        case ast.Call(func=ast.Name(id=function), args=parts, keywords=[]):
            if function not in FUNCTIONS:
                raise _refuse(
                    f"function {function!r} is unknown", text, remedy=suggest(function, FUNCTIONS)
                )
            if len(parts) != FUNCTIONS[function][2]:
                raise _refuse(
                    f"{function} has {len(parts)} arguments", text,
                    allowed=f"{FUNCTIONS[function][2]}",
                )  # fmt: skip
        case _:
            raise _refuse(f"{type(node).__name__} is outside the grammar", text)
    return 1 + sum(_check_node(part, text, known_names, names, depth + 1) for part in parts)


def _find_constant(node: ast.expr) -> float | None:
    """Return the value of a part without names; None if it has names or no finite value."""
    if any(isinstance(part, ast.Name | ast.Call) for part in ast.walk(node)):
        return None
    try:
        with np.errstate(all="ignore"):
            return float(_evaluate(node, {}))
    except (OverflowError, KeyError, AssertionError, ValueError):
        return None


def _evaluate(node: ast.expr, values: Mapping[str, Any]) -> Any:
    match node:
        case ast.Constant(value=value):
            return float(value)  # type: ignore[arg-type]
        case ast.Name(id=name):
            return values[name]
        case ast.UnaryOp(op=op, operand=operand):
            return SIGNS[type(op)](_evaluate(operand, values))
        case ast.BinOp(left=left, op=op, right=right):
            return OPERATORS[type(op)](_evaluate(left, values), _evaluate(right, values))
        case ast.Call(func=ast.Name(id=function), args=parts):
            return FUNCTIONS[function][1](*(_evaluate(part, values) for part in parts))
    raise AssertionError(ast.dump(node))  # checked when it was parsed


def parse_unit(unit: str) -> Dimension:
    """Return the exponents of kg, m and s of a unit such as "N s2/m2"; InputError if unknown."""
    if len(unit) > MAX_UNIT_LENGTH:
        raise InputError("too long", value=unit[:20], allowed=f"{MAX_UNIT_LENGTH} characters")
    total = DIMENSIONLESS
    for name, power in split_unit(unit):
        total = _combine(total, BASE_UNITS[name], power)
    return total


def split_unit(unit: str) -> Iterator[tuple[str, int]]:
    """Yield (name, power) of each factor of a unit such as "N s2/m2"; InputError if unknown."""
    numerator, _, denominator = unit.partition("/")
    for factors, direction in ((numerator, 1), (denominator, -1)):
        for factor in factors.split():
            matched = re.fullmatch(r"([A-Za-z]+|1)(\d{0,2})", factor)
            if matched is None or matched[1] not in BASE_UNITS:
                raise InputError(
                    f"unit {factor!r} is unknown",
                    value=unit,
                    allowed=f"products of {', '.join(BASE_UNITS)} with powers, as in N s2/m2",
                )
            yield matched[1], direction * int(matched[2] or 1)


def format_dimension(dimension: Dimension) -> str:
    """Return a unit with this dimension, in N, m and s."""
    kg, m, s = dimension
    powers = {"N": kg, "m": m - kg, "s": s + 2 * kg}

    def write(direction: float) -> str:
        return " ".join(
            name if abs(power) == 1 else f"{name}{abs(power):g}"
            for name, power in powers.items()
            if power * direction > 0
        )

    above, below = write(1.0), write(-1.0)
    return f"{above or '1'}/{below}" if below else above


@dataclass(frozen=True)
class _DimensionCheck:
    """Finds the dimension of each part of an expression from those of the names."""

    known: Mapping[str, Dimension]
    text: str

    def find(self, node: ast.expr) -> Dimension:
        match node:
            case ast.Constant():
                return DIMENSIONLESS
            case ast.Name(id=name):
                return self.known[name]
            case ast.UnaryOp(operand=operand):
                return self.find(operand)
            case ast.BinOp(left=left, op=op, right=right):
                return self._find_of_operator(op, left, right)
            case ast.Call(func=ast.Name(id=function), args=parts):
                return self._find_of_call(function, parts)
        raise AssertionError(ast.dump(node))  # checked when it was parsed

    def _find_of_operator(self, op: ast.operator, left: ast.expr, right: ast.expr) -> Dimension:
        match op:
            case ast.Mult():
                return _combine(self.find(left), self.find(right), 1.0)
            case ast.Div():
                return _combine(self.find(left), self.find(right), -1.0)
            case ast.Pow():
                return self._find_of_power(left, right)
        return self._find_common(left, right)

    def _find_of_power(self, base: ast.expr, exponent: ast.expr) -> Dimension:
        self._require_number(exponent)
        dimension = self.find(base)
        if dimension == DIMENSIONLESS:
            return dimension
        power = _find_constant(exponent)
        if power is None:
            raise self._refuse(base, dimension, "a pure number below a variable exponent")
        return _combine(DIMENSIONLESS, dimension, power)

    def _find_of_call(self, function: str, parts: Sequence[ast.expr]) -> Dimension:
        match function:
            case "abs":
                return self.find(parts[0])
            case "sign":
                return DIMENSIONLESS
            case "sqrt":
                return _combine(DIMENSIONLESS, self.find(parts[0]), 0.5)
            case "min" | "max":
                return self._find_common(*parts)
        for part in parts:
            self._require_number(part)
        return DIMENSIONLESS

    def _find_common(self, first: ast.expr, second: ast.expr) -> Dimension:
        """Return the dimension of two terms, which must agree; a zero has any."""
        dimensions = [
            self.find(part)
            for part in (first, second)
            if not (isinstance(part, ast.Constant) and part.value == 0)
        ]
        if len({*dimensions}) > 1:
            raise self._refuse(second, dimensions[1], format_dimension(dimensions[0]))
        return dimensions[0] if dimensions else DIMENSIONLESS

    def _require_number(self, part: ast.expr) -> None:
        if self.find(part) != DIMENSIONLESS:
            raise self._refuse(part, self.find(part), "a pure number")

    def _refuse(self, part: ast.expr, dimension: Dimension, expected: str) -> InputError:
        unit = format_dimension(dimension) or "a pure number"
        return InputError(
            f"the unit of {ast.unparse(part)!r} is {unit}",
            value=self.text,
            allowed=expected or "a pure number",
            remedy="correct the expression or the units of its parameters",
        )


def _combine(first: Dimension, second: Dimension, power: float) -> Dimension:
    a, b, c = (x + power * y for x, y in zip(first, second, strict=True))
    return (a, b, c)


class _SourceWriter(ast.NodeTransformer):
    """Renames names; numbers become floats, but integer exponents integers: products, compiled."""

    def __init__(self, names: Mapping[str, str]) -> None:
        self.names = names

    def visit_Name(self, node: ast.Name) -> ast.expr:
        return ast.Name(self.names.get(node.id, node.id), ast.Load())

    def visit_BinOp(self, node: ast.BinOp) -> ast.expr:
        left, right = self.visit(node.left), self.visit(node.right)
        exponent = _find_constant(node.right) if isinstance(node.op, ast.Pow) else None
        if exponent is not None and exponent.is_integer():
            right = ast.Constant(int(exponent))
        return ast.BinOp(left, node.op, right)

    def visit_Constant(self, node: ast.Constant) -> ast.expr:
        return ast.Constant(float(node.value))  # type: ignore[arg-type]

    def visit_Call(self, node: ast.Call) -> ast.expr:
        if replacement := self.names.get(ast.unparse(node)):
            return ast.Name(replacement, ast.Load())
        arguments = [self.visit(part) for part in node.args]
        if isinstance(node.func, ast.Name) and node.func.id == "sign":
            arguments.insert(0, ast.Constant(1.0))
        return ast.Call(node.func, arguments, [])


def build_function(text: str) -> FunctionType:
    """Return the function of a definition in plain Python that is made of checked expressions."""
    # The name of a module: a kernel's fingerprint leaves out functions of none.
    namespace: dict[str, Any] = {"__name__": __name__}
    namespace |= {function: entry[0] for function, entry in FUNCTIONS.items()}
    exec(text, namespace)
    built: FunctionType = next(
        item for item in namespace.values() if isinstance(item, FunctionType)
    )
    return built
