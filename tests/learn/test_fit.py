"""The search for parameters on problems whose answer is known in closed form."""

import math
from collections.abc import Callable
from typing import cast

import numpy as np
import pytest

from table_io.block import Float1D, Int1D
from twin.learn.fit import Fit, fit
from twin.learn.guess import Free, Guess
from twin.learn.sheet import Sheet

COUNT, BLOCK = 600, 20
Left = Callable[[float, float], Float1D]


class Toy:
    """What a fit asks of a sheet, for a residual of two numbers."""

    number, rows, weight = 0, ("only",), 1.0

    def __init__(self, left: Left) -> None:
        self.left = left
        self.row_of: Int1D = np.zeros(COUNT, dtype=np.int64)
        self.whole_contacts: Int1D = np.arange(COUNT) // BLOCK

    def residual(self, guess: Guess) -> Float1D:
        return self.left(guess.values["a"], guess.values["b"])


def free(name: str, low: float = -math.inf, high: float = math.inf) -> Free:
    return Free(name, (name,), low, high, 1.0, "")


def fitted(left: Left, a: Free, b: Free, folds: tuple[Int1D, ...] = ()) -> Fit:
    sheet = cast(Sheet, Toy(left))
    return fit([sheet], Guess({"a": 0.5, "b": 0.5}), [a, b], folds=folds)


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
    """b is told by the last fold; without it next to nothing says it, and far off it explodes."""
    draw = np.random.default_rng(2)
    x, noise = np.linspace(1, 2, COUNT), draw.standard_normal(COUNT)
    fold = np.arange(COUNT) * 3 // COUNT
    size = np.where(fold == 2, 10.0, 1e-7)

    def left(a: float, b: float) -> Float1D:
        return a * x + size * np.expm1(np.clip(b, -300, 300)) - (2.0 * x + noise)

    found = fitted(left, free("a"), free("b"), (fold,))
    assert found.cost == pytest.approx(1.0, abs=0.1)
    (out,) = found.left
    assert 1.0 < float(out @ out) / COUNT / found.cost < 1.5


def test_a_fold_that_says_as_much_as_the_others_is_judged_as_least_squares_does() -> None:
    draw = np.random.default_rng(3)
    x, y = draw.standard_normal((2, COUNT)), draw.standard_normal(COUNT)
    fold = np.arange(COUNT) % 3
    (out,) = fitted(lambda a, b: a * x[0] + b * x[1] - y, free("a"), free("b"), (fold,)).left
    for k in range(3):
        mine = fold == k
        best = np.linalg.lstsq(x[:, ~mine].T, y[~mine], rcond=None)[0]
        assert out[mine] == pytest.approx(best @ x[:, mine] - y[mine], abs=1e-6)
