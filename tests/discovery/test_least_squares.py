"""The search for parameters on problems whose answer is known in closed form."""

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import ClassVar, cast

import numpy as np
import pytest

from table_io.block import Bool1D, Float1D, Int1D
from twin.discovery.least_squares import FitResult, fit_parameters, fit_with_misfit
from twin.discovery.nuisances import MAX_SIZE
from twin.discovery.parameters import BaseKey, FreeParameter, NuisanceKey, ParameterSet
from twin.discovery.residuals import LogResiduals

COUNT, BLOCK = 600, 20
Left = Callable[[float, float], Float1D]


A, B, LAG = BaseKey("a"), BaseKey("b"), NuisanceKey(0, "lag", "force_r1_n")


class Toy:
    """What a fit asks of a sheet, for a residual of two numbers."""

    log_number, rows, entry_weight = 0, ("only",), np.ones(COUNT)

    def __init__(self, left: Left) -> None:
        self.left = left
        self.entry_row: Int1D = np.zeros(COUNT, dtype=np.int64)
        self.entry_contact_block: Int1D = np.arange(COUNT) // BLOCK

    def evaluate(self, parameters: ParameterSet) -> Float1D:
        return self.left(parameters.values[A], parameters.values[B])


def free(
    key: BaseKey, low: float = -math.inf, high: float = math.inf, vanishing: float | None = None
) -> FreeParameter:
    return FreeParameter(key, low, high, 1.0, "", vanishing=vanishing)


def fit_sheet(
    left: Left, a: FreeParameter, b: FreeParameter, folds: tuple[Int1D, ...] = ()
) -> FitResult:
    sheet = cast(LogResiduals, Toy(left))
    return fit_parameters([sheet], ParameterSet({A: 0.5, B: 0.5}, (a, b)), folds=folds)


def test_parameters_that_replace_each_other_have_no_interval() -> None:
    """Only their sum is known: rounding must not tell them apart."""
    draw = np.random.default_rng(2)
    first = draw.standard_normal(COUNT)
    y = 2.0 * first + 0.01 * draw.standard_normal(COUNT)
    fit = fit_sheet(lambda a, b: (a + b) * first - y, free(A), free(B))
    assert fit.values[A] + fit.values[B] == pytest.approx(2.0, abs=0.01)
    assert fit.std_errors[A] == fit.std_errors[B] == math.inf


@pytest.mark.parametrize("alike", [0.9, 0.999, 0.99999])
def test_beside_a_number_at_its_bound_the_others_are_found(alike: float) -> None:
    """a would go to 5 and may not: b is then what least squares says for a = 1."""
    draw = np.random.default_rng(1)
    first = draw.standard_normal(COUNT)
    other = alike * first + math.sqrt(1 - alike**2) * draw.standard_normal(COUNT)
    y = 5.0 * first - 3.0 * other + 0.01 * draw.standard_normal(COUNT)
    fit = fit_sheet(lambda a, b: a * first + b * other - y, free(A, high=1.0), free(B))
    assert fit.converged
    assert fit.at_bound == (A,)
    assert fit.values[A] == 1.0
    assert fit.values[B] == pytest.approx(float(other @ (y - first) / (other @ other)), rel=1e-6)


def test_what_is_left_out_is_judged_by_a_fit_and_not_by_a_leap() -> None:
    """Two numbers nearly alike, in a law that explodes: an undamped step goes far along both."""
    draw = np.random.default_rng(2)
    x, noise = np.linspace(1, 2, COUNT), draw.standard_normal(COUNT)
    fold = np.arange(COUNT) % 3

    def compute_residuals(a: float, b: float) -> Float1D:
        apart = np.expm1(np.clip(40 * (a - b), -300, 300)) - 40 * (a - b)
        return (a + b) * x + 1e-4 * (a - b) * x**2 + 1e-3 * apart - (2.0 * x + noise)

    (out,) = fit_sheet(compute_residuals, free(A), free(B), (fold,)).held_out
    assert 1.0 < float(out @ out) / float(noise @ noise) < 1.05


def test_an_amplitude_that_only_one_fold_says_gains_nothing_there() -> None:
    """Junk in the last fold alone: who saw it explains it, who did not must not."""
    draw = np.random.default_rng(4)
    x, noise = np.linspace(1, 2, COUNT), draw.standard_normal(COUNT)
    fold = np.arange(COUNT) * 3 // COUNT
    junk = np.where(fold == 2, 5.0 * np.sign(draw.standard_normal(COUNT)), 0.0)

    def out(amplitude: FreeParameter) -> Float1D:
        fit = fit_sheet(lambda a, b: a * x - b * junk - (2.0 * x + noise - junk), free(A),
                       amplitude, (fold,))  # fmt: skip
        return fit.held_out[0]

    mine = fold == 2
    nothing = fit_sheet(lambda a, b: a * x - (2.0 * x + noise - junk), free(A), free(B), (fold,))
    assert float((out(free(B, vanishing=0.0))[mine] ** 2).mean()) > 20.0
    assert out(free(B, vanishing=0.0))[mine] == pytest.approx(nothing.held_out[0][mine], abs=0.05)
    # what is not an effect's stays as it is: whatever is compared has it
    assert float((out(free(B))[mine] ** 2).mean()) < 2.0


def test_what_stands_at_its_bound_makes_the_others_no_less_sure() -> None:
    draw = np.random.default_rng(5)
    first = draw.standard_normal(COUNT)
    other = 0.99 * first + 0.14 * draw.standard_normal(COUNT)
    y = 5.0 * first - 3.0 * other + draw.standard_normal(COUNT)
    stuck = fit_sheet(lambda a, b: a * first + b * other - y, free(A, high=1.0), free(B))
    fixed = fit_sheet(lambda a, b: first + b * other - y, free(A), free(B))
    assert stuck.std_errors[B] == pytest.approx(fixed.std_errors[B], rel=1e-3)
    assert stuck.std_errors[A] == 0.0


def test_columns_taken_side_by_side_are_the_same() -> None:
    draw = np.random.default_rng(6)
    x, y = draw.standard_normal((2, COUNT)), draw.standard_normal(COUNT)
    sheet = cast(LogResiduals, Toy(lambda a, b: a * x[0] + np.tanh(b * x[1]) - y))
    start = ParameterSet({A: 0.5, B: 0.5}, (free(A), free(B)))
    alone = fit_parameters([sheet], start)
    with ThreadPoolExecutor(2) as pool:
        beside = fit_parameters([sheet], start, mapper=pool.map)
    assert alone.values == beside.values
    assert alone.std_errors == beside.std_errors


def test_without_a_number_to_find_there_is_a_fit_too() -> None:
    sheet = cast(LogResiduals, Toy(lambda a, b: np.full(COUNT, 2.0)))
    assert fit_parameters([sheet], ParameterSet({A: 0.5, B: 0.5})).cost == 4.0


def test_a_fold_that_says_as_much_as_the_others_is_judged_as_least_squares_does() -> None:
    draw = np.random.default_rng(3)
    x, y = draw.standard_normal((2, COUNT)), draw.standard_normal(COUNT)
    fold = np.arange(COUNT) % 3
    (out,) = fit_sheet(lambda a, b: a * x[0] + b * x[1] - y, free(A), free(B), (fold,)).held_out
    for k in range(3):
        mine = fold == k
        best = np.linalg.lstsq(x[:, ~mine].T, y[~mine], rcond=None)[0]
        assert out[mine] == pytest.approx(best @ x[:, mine] - y[mine], abs=1e-6)


class ToyReading(Toy):
    """A line whose x is a reading: with its noise, and in a copy with the noise once more."""

    def __init__(self, true: Float1D, y: Float1D, noise: float, copies: int = 1) -> None:
        draws = [np.random.default_rng([8, k]).standard_normal(COUNT) for k in range(copies)]
        self.true, self.y, self.noise, self.copies = true, y, noise, copies
        x = true + noise * np.sum(draws, axis=0)
        super().__init__(lambda a, b: a * x + b - y)

    @property
    def noise_copy(self) -> "ToyReading":
        return ToyReading(self.true, self.y, self.noise, self.copies + 1)


@pytest.mark.parametrize(("without_noise", "slope"), [(False, 1.6), (True, 2.0)])
def test_a_slope_is_attenuated_by_the_noise_of_its_reading_unless_it_is_taken_off(
    without_noise: bool, slope: float
) -> None:
    draw = np.random.default_rng(9)
    true = draw.standard_normal(COUNT)
    y = 2.0 * true + 0.1 * draw.standard_normal(COUNT)
    sheet = cast(LogResiduals, ToyReading(true, y, 0.5))
    fit = fit_parameters(
        [sheet], ParameterSet({A: 0.5, B: 0.5}, (free(A), free(B))), folds=(np.arange(COUNT) % 3,),
        without_noise=without_noise,
    )  # fmt: skip
    assert fit.values[A] == pytest.approx(slope, rel=0.05)
    # a held-out third is judged by the same estimator
    left = fit.values[A] * 0.5
    expected = math.hypot(left, 0.1, (2.0 - slope) * 1.0)
    assert float(fit.held_out[0].std()) == pytest.approx(expected, rel=0.1)


@dataclass(frozen=True)
class Misread:
    """What a fit asks of a sheet with one nuisance: readings y over their noise, a law a x."""

    x: Float1D
    y: Float1D
    weights: dict[str, float] = field(default_factory=dict)
    log_number, rows, noise_copy = 0, ("damper",), property(lambda self: self)
    expected_squares: ClassVar[dict[str, float]] = {}
    signals: ClassVar[SimpleNamespace] = SimpleNamespace(step=np.array([-1]))

    @property
    def entry_row(self) -> Int1D:
        return np.append(np.zeros(self.x.size, dtype=np.int64), 1)

    @property
    def entry_weight(self) -> Float1D:
        return np.where(self.entry_row == 0, self.weights.get("damper", 1.0), 1.0)

    @property
    def sample_block(self) -> Int1D:
        return np.arange(self.x.size) // BLOCK

    @property
    def entry_contact_block(self) -> Int1D:
        return np.append(self.sample_block, 0)

    @property
    def row_mask(self) -> list[Bool1D]:
        return [np.ones(self.x.size, dtype=bool)]

    def evaluate(self, parameters: ParameterSet) -> Float1D:
        z = parameters.values[LAG]
        read = self.y - parameters.values[A] * self.x - z * np.abs(self.x)
        return np.append(read, z) / self.entry_weight

    def nuisance_slope(self, key: NuisanceKey) -> Float1D:
        return np.append(-np.abs(self.x), 1.0) / self.entry_weight


@pytest.mark.parametrize(("lacking", "z"), [(0.0, 2.0), (400.0, 0.0)])
def test_a_nuisance_explains_what_its_prior_allows_and_no_law_that_is_lacking(
    lacking: float, z: float
) -> None:
    """Half of such a law has the form of the nuisance, which would run to 200 typical sizes."""
    draw = np.random.default_rng(3)
    x = draw.uniform(-1.0, 1.0, COUNT)
    y = 5.0 * x + 2.0 * (lacking == 0) * np.abs(x) + draw.standard_normal(COUNT)
    sheet = Misread(x, y + lacking * np.maximum(x - 0.2, 0.0))
    start = ParameterSet(
        {A: 1.0, LAG: 0.0}, (free(A), FreeParameter(LAG, -math.inf, math.inf, 1.0, ""))
    )
    fit = fit_with_misfit([cast(LogResiduals, sheet)], start)
    assert fit.values[LAG] == pytest.approx(z, abs=MAX_SIZE if lacking else 0.3)
