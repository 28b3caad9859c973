"""The search for parameters on problems whose answer is known in closed form."""

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import cast

import numpy as np
import pytest

from table_io.block import Float1D, Int1D
from twin.identification.least_squares import FitResult, fit_parameters
from twin.identification.parameters import FreeParameter, ParameterSet
from twin.identification.residuals import LogResiduals

COUNT, BLOCK = 600, 20
Left = Callable[[float, float], Float1D]


class Toy:
    """What a fit asks of a sheet, for a residual of two numbers."""

    log_number, rows, weight = 0, ("only",), 1.0

    def __init__(self, left: Left) -> None:
        self.left = left
        self.entry_row: Int1D = np.zeros(COUNT, dtype=np.int64)
        self.entry_contact_block: Int1D = np.arange(COUNT) // BLOCK

    def evaluate(self, parameters: ParameterSet) -> Float1D:
        return self.left(parameters.values["a"], parameters.values["b"])


def free(
    name: str, low: float = -math.inf, high: float = math.inf, vanishing: float | None = None
) -> FreeParameter:
    return FreeParameter(name, (name,), low, high, 1.0, "", vanishing=vanishing)


def fitted(
    left: Left, a: FreeParameter, b: FreeParameter, folds: tuple[Int1D, ...] = ()
) -> FitResult:
    sheet = cast(LogResiduals, Toy(left))
    return fit_parameters([sheet], ParameterSet({"a": 0.5, "b": 0.5}), [a, b], folds=folds)


@pytest.mark.parametrize("alike", [0.9, 0.999, 0.99999])
def test_beside_a_number_at_its_bound_the_others_are_found(alike: float) -> None:
    """a would go to 5 and may not: b is then what least squares says for a = 1."""
    draw = np.random.default_rng(1)
    one = draw.standard_normal(COUNT)
    other = alike * one + math.sqrt(1 - alike**2) * draw.standard_normal(COUNT)
    y = 5.0 * one - 3.0 * other + 0.01 * draw.standard_normal(COUNT)
    found = fitted(lambda a, b: a * one + b * other - y, free("a", high=1.0), free("b"))
    assert found.converged
    assert found.at_bound == ("a",)
    assert found.values["a"] == 1.0
    assert found.values["b"] == pytest.approx(float(other @ (y - one) / (other @ other)), rel=1e-6)


def test_what_is_left_out_is_judged_by_a_fit_and_not_by_a_leap() -> None:
    """Two numbers nearly alike, in a law that explodes: an undamped step goes far along both."""
    draw = np.random.default_rng(2)
    x, noise = np.linspace(1, 2, COUNT), draw.standard_normal(COUNT)
    fold = np.arange(COUNT) % 3

    def left(a: float, b: float) -> Float1D:
        apart = np.expm1(np.clip(40 * (a - b), -300, 300)) - 40 * (a - b)
        return (a + b) * x + 1e-4 * (a - b) * x**2 + 1e-3 * apart - (2.0 * x + noise)

    (out,) = fitted(left, free("a"), free("b"), (fold,)).held_out
    assert 1.0 < float(out @ out) / float(noise @ noise) < 1.05


def test_an_amplitude_that_only_one_fold_says_gains_nothing_there() -> None:
    """Junk in the last fold alone: who saw it explains it, who did not must not."""
    draw = np.random.default_rng(4)
    x, noise = np.linspace(1, 2, COUNT), draw.standard_normal(COUNT)
    fold = np.arange(COUNT) * 3 // COUNT
    junk = np.where(fold == 2, 5.0 * np.sign(draw.standard_normal(COUNT)), 0.0)

    def out(amplitude: FreeParameter) -> Float1D:
        found = fitted(lambda a, b: a * x - b * junk - (2.0 * x + noise - junk), free("a"),
                       amplitude, (fold,))  # fmt: skip
        return found.held_out[0]

    mine = fold == 2
    nothing = fitted(lambda a, b: a * x - (2.0 * x + noise - junk), free("a"), free("b"), (fold,))
    assert float((out(free("b", vanishing=0.0))[mine] ** 2).mean()) > 20.0
    assert out(free("b", vanishing=0.0))[mine] == pytest.approx(nothing.held_out[0][mine], abs=0.05)
    # what is not an effect's stays as it is: whatever is compared has it
    assert float((out(free("b"))[mine] ** 2).mean()) < 2.0


def test_what_stands_at_its_bound_makes_the_others_no_less_sure() -> None:
    draw = np.random.default_rng(5)
    one = draw.standard_normal(COUNT)
    other = 0.99 * one + 0.14 * draw.standard_normal(COUNT)
    y = 5.0 * one - 3.0 * other + draw.standard_normal(COUNT)
    stuck = fitted(lambda a, b: a * one + b * other - y, free("a", high=1.0), free("b"))
    fixed = fitted(lambda a, b: one + b * other - y, free("a"), free("b"))
    assert stuck.std_errors["b"] == pytest.approx(fixed.std_errors["b"], rel=1e-3)
    assert stuck.std_errors["a"] == 0.0


def test_columns_taken_side_by_side_are_the_same() -> None:
    draw = np.random.default_rng(6)
    x, y = draw.standard_normal((2, COUNT)), draw.standard_normal(COUNT)
    sheet = cast(LogResiduals, Toy(lambda a, b: a * x[0] + np.tanh(b * x[1]) - y))
    free_ = [free("a"), free("b")]
    alone = fit_parameters([sheet], ParameterSet({"a": 0.5, "b": 0.5}), free_)
    with ThreadPoolExecutor(2) as pool:
        beside = fit_parameters([sheet], ParameterSet({"a": 0.5, "b": 0.5}), free_, mapper=pool.map)
    assert alone.values == beside.values
    assert alone.std_errors == beside.std_errors


def test_without_a_number_to_find_there_is_a_fit_too() -> None:
    sheet = cast(LogResiduals, Toy(lambda a, b: np.full(COUNT, 2.0)))
    assert fit_parameters([sheet], ParameterSet({"a": 0.5, "b": 0.5}), []).cost == 4.0


def test_a_fold_that_says_as_much_as_the_others_is_judged_as_least_squares_does() -> None:
    draw = np.random.default_rng(3)
    x, y = draw.standard_normal((2, COUNT)), draw.standard_normal(COUNT)
    fold = np.arange(COUNT) % 3
    (out,) = fitted(lambda a, b: a * x[0] + b * x[1] - y, free("a"), free("b"), (fold,)).held_out
    for k in range(3):
        mine = fold == k
        best = np.linalg.lstsq(x[:, ~mine].T, y[~mine], rcond=None)[0]
        assert out[mine] == pytest.approx(best @ x[:, mine] - y[mine], abs=1e-6)
