"""Symbolic regression of what no term family explains, as terms of laws (extra `laws`).

The forces that a fitted set leaves are regressed on the dimensionless motion of the damper and of
the bumpers by genetic programming (pyoperon: Burlacu, Kronberger and Kommenda 2020, Operon C++).
Each expression of the front of error against length becomes a term, which is refitted with the base
and judged on held-out steps as every other one: the search's own score decides nothing.
"""

import ast
import warnings
from collections.abc import Iterator, Mapping, Sequence
from importlib.util import find_spec
from typing import Any

import numpy as np

from table_io.block import Float1D, Float2D
from table_io.errors import InputError
from twin.discovery.candidates import Candidate
from twin.discovery.law_terms import (
    LAW_PREFIX,
    SHAPE_MARGIN,
    describe_references,
    list_references,
    list_valid_range,
    make_candidate,
)
from twin.discovery.motion import RecordScale
from twin.discovery.parameters import ParameterSet
from twin.discovery.residuals import LogResiduals
from twin.laws.effect import Effect, EffectParameter, Place
from twin.laws.expression import parse_expression
from twin.laws.library import check_new_effect

SYMBOLIC_PREFIX = f"{LAW_PREFIX}expression_"
MISSING_MESSAGE = (
    "no free expressions were tried: pyoperon is not installed; pip install 'shaketwin[laws]'"
)
MAX_LENGTH = 12  # nodes of an expression, its coefficients not counted
MIN_SAMPLES = 100  # of a place, to regress on
MAX_SAMPLES, POPULATION, GENERATIONS = 2000, 300, 40
SYMBOLS = "add,sub,mul,abs,tanh,square,constant,variable"
MIN_INDEPENDENT_SHARE = 0.02  # of a slope by a coefficient, else the others do as well


def is_available() -> bool:
    """Return whether pyoperon is installed."""
    return find_spec("pyoperon") is not None


def list_symbolic_candidates(
    log_residuals: Sequence[LogResiduals], parameters: ParameterSet
) -> tuple[Candidate, ...]:
    """Return expressions for what the parameters leave of the forces; none without pyoperon."""
    if not is_available():
        return ()
    scale = log_residuals[0].scale
    candidates: list[Candidate] = []
    for place, features, force in _list_problems(log_residuals, parameters, scale):
        for tree in evolve_expressions([*features.values()], force):
            texts = [f"({variable} / {reference})" for variable, reference in features]
            candidate = make_term(place, tree, texts, [*features.values()], scale, len(candidates))
            if candidate is not None:
                candidates.append(candidate)
    return tuple(candidates)


def _list_problems(
    log_residuals: Sequence[LogResiduals], parameters: ParameterSet, scale: RecordScale
) -> Iterator[tuple[Place, Mapping[tuple[str, str], Float1D], Float1D]]:
    """Yield (place, dimensionless motion by variable and reference, force left in N)."""
    damper, bumpers = [], []
    for residuals in log_residuals:
        m = residuals.motion(parameters.assumed_sensors())
        p = parameters.model_for_log(residuals.log_number, m).parameters
        errors = residuals.force_errors(parameters, m)
        used = residuals.row_mask
        damper.append(np.array([m.u, m.v, errors[0]])[:, used[0]])
        for side, sign, gap in ((1, 1.0, p.gap_r), (2, -1.0, p.gap_l)):
            rows = np.array([sign * m.u - gap, sign * m.v, errors[side]])
            bumpers.append(rows[:, used[side] & (rows[0] > 0.0)])
    for place, variable, length, parts in (
        ("damper", "u", scale.u, damper), ("bumpers", "d", scale.depth, bumpers),
    ):  # fmt: skip
        q, v, force = np.concatenate(parts, axis=1)
        if force.size > MIN_SAMPLES:
            features = {(variable, f"{variable}0"): q / length, ("v", "v0"): v / scale.v}
            yield place, features, force  # type: ignore[misc]


def evolve_expressions(features: Sequence[Float1D], target: Float1D) -> list[ast.expr]:
    """Return the expressions of the front of error and length, their features X1, X2 and so on.

    Without the offset and the scale that are fitted around them. The same for the same data.
    """
    regressor = fit_regressor(features, target / max(float(target.std()), 1e-300))
    texts = [regressor.get_model_string(entry["tree"], 8) for entry in regressor.pareto_front_]
    return [_strip_scale(ast.parse(text.replace("^", "**"), mode="eval").body) for text in texts]


def fit_regressor(features: Sequence[Float1D], target: Float1D) -> Any:
    """Return pyoperon's regressor, fitted to `MAX_SAMPLES` of the samples at most."""
    from pyoperon.sklearn import SymbolicRegressor

    kept = np.linspace(0, target.size - 1, min(target.size, MAX_SAMPLES)).astype(np.int64)
    regressor = SymbolicRegressor(
        allowed_symbols=SYMBOLS, max_length=MAX_LENGTH, population_size=POPULATION,
        pool_size=POPULATION, generations=GENERATIONS, optimizer_iterations=5, n_threads=1,
        objectives=["r2", "length"], epsilon=1e-4, random_state=1,
    )  # fmt: skip
    with warnings.catch_warnings():
        # of the shortest expression of the front, a constant
        warnings.filterwarnings("ignore", "Model contains no variables", UserWarning)
        return regressor.fit(np.stack([values[kept] for values in features], axis=1), target[kept])


def _strip_scale(tree: ast.expr) -> ast.expr:
    """Return the expression in `offset + scale * expression`."""
    match tree:
        case ast.BinOp(op=ast.Add(), left=offset, right=ast.BinOp(op=ast.Mult(), right=inner)) if (
            not any(isinstance(node, ast.Name) for node in ast.walk(offset))
        ):
            return inner
    return tree


class _ConstantParameters(ast.NodeTransformer):
    """Replaces features by texts, numbers by parameters c1, c2 and so on, squares by powers."""

    def __init__(self, features: Sequence[str]) -> None:
        self.features, self.values = features, list[float]()

    def visit_Name(self, node: ast.Name) -> ast.expr:
        if node.id.startswith("X") and node.id[1:].isdecimal():
            return ast.parse(self.features[int(node.id[1:]) - 1], mode="eval").body
        return node

    def visit_Constant(self, node: ast.Constant) -> ast.expr:
        self.values.append(float(node.value))  # type: ignore[arg-type]
        return ast.Name(f"c{len(self.values)}", ast.Load())

    def visit_Call(self, node: ast.Call) -> ast.expr:
        argument = self.visit(node.args[0])
        if isinstance(node.func, ast.Name) and node.func.id == "square":
            return ast.BinOp(argument, ast.Pow(), ast.Constant(2))
        return ast.Call(node.func, [argument], [])

    def visit_BinOp(self, node: ast.BinOp) -> ast.expr:
        if isinstance(node.op, ast.Pow):
            return ast.BinOp(self.visit(node.left), node.op, node.right)
        return ast.BinOp(self.visit(node.left), node.op, self.visit(node.right))


def make_term(
    place: Place, tree: ast.expr, features: Sequence[str], motion: Sequence[Float1D],
    scale: RecordScale, number: int,
) -> Candidate | None:  # fmt: skip
    """Return an expression as a candidate; None if it is no law, as one that pulls at touch."""
    transformer = _ConstantParameters(features)
    shape = ast.unparse(ast.fix_missing_locations(transformer.visit(tree)))
    values = {f"c{k}": value for k, value in enumerate(transformer.values, 1) if value > 0.0}
    references = list_references(scale, [shape])
    size = scale.force
    parameters = [
        EffectParameter("k", "N", -100 * size, 100 * size, 0.0, 0.1 * size, "Amplitude."),
        *(
            EffectParameter(
                name, "", value / SHAPE_MARGIN, value * SHAPE_MARGIN, None, value, "Coefficient."
            )
            for name, value in values.items()
        ),
        *describe_references(references),
    ]
    force = f"k * ({shape})"
    law = Effect(
        id=f"{SYMBOLIC_PREFIX}{number + 1}",
        title="expression of symbolic regression",
        term=force,
        place=place,
        force=force,
        parameters=tuple(parameters),
        valid_range=list_valid_range(place, scale),
        is_of_file=True,
    )
    try:
        check_new_effect(law)
    except InputError:
        return None
    free = _select_independent(shape, values, features, motion, references)
    fixed = {name: value for name, value in values.items() if name not in free}
    return make_candidate(
        law, {**references, **fixed}, {name: [values[name]] for name in free}, scale
    )


def _select_independent(
    shape: str, values: Mapping[str, float], features: Sequence[str], motion: Sequence[Float1D],
    references: Mapping[str, float],
) -> list[str]:  # fmt: skip
    """Return the coefficients whose change is not that of the amplitude or of earlier ones."""
    variables = [feature.strip("()").split(" / ")[0] for feature in features]
    # the motion is dimensionless here
    given = dict(zip(variables, motion, strict=True)) | dict.fromkeys(references, 1.0)
    expression = parse_expression(shape, [*given, *values])

    def evaluate(changed: Mapping[str, float]) -> Float1D:
        return np.broadcast_to(expression.evaluate({**given, **values, **changed}), motion[0].shape)

    base = evaluate({})
    basis: Float2D = base[None] / max(float(np.linalg.norm(base)), 1e-300)
    free = []
    for name, value in values.items():
        slope = evaluate({name: 1.01 * value}) - base
        rest = slope - (basis @ slope) @ basis
        if np.linalg.norm(rest) > MIN_INDEPENDENT_SHARE * np.linalg.norm(slope) > 0.0:
            free.append(name)
            basis = np.vstack([basis, rest / np.linalg.norm(rest)])
    return free
