"""Errors of a sound accelerometer relative to a displacement of the same body.

    a = gain hp(x'') delayed,  hp = s / (s + w_c),  hp(x'') = x'' - w_c x' + w_c^2 hp(x)

so that for test functions phi, which vanish with their slope at both ends of a window,

    <phi, a> = gain <phi'', x> + gain w_c (<phi', x> + w_c <phi, hp(x)>) + delay <phi', a>

holds for any motion. Given w_c in the last bracket it is linear in gain, gain w_c and delay.
"""

import math
from dataclasses import dataclass, field

import numpy as np

from table_io.block import Float1D, Float2D
from table_io.compilation import jit_untyped_kernel

# Low cut and delay of sound sensors. IEPE accelerometers are down by 3 dB at 0.16 to 0.5 Hz; twice
# that is no longer a sensor for tests from 0.5 Hz on. A low-pass of fourth order at 100 Hz delays
# by 4.2 ms.
MAX_LOW_CUT_RAD_S = 2 * math.pi * 1.0
MAX_DELAY_S = 0.005
# Of gain, gain x low cut, delay.
LEAST_ERRORS = np.array([-math.inf, 0.0, -MAX_DELAY_S])
LARGEST_ERRORS = np.array([math.inf, MAX_LOW_CUT_RAD_S, MAX_DELAY_S])
# Standard deviations expected before anything is measured: gain, gain x low cut, delay. At one
# frequency low cut and delay are told apart by them only.
PRIOR_SD = (0.2, 2 * math.pi * 0.3, 0.001)
FIT_ERROR_RATIO = 0.01  # of the motion: errors of sensors that are none of the three
AVERAGING_CHECKS = 20  # over which a running estimate is averaged


@dataclass(frozen=True, slots=True)
class PairErrors:
    """Errors of an accelerometer relative to a displacement: gain, low cut in rad/s, delay in s."""

    gain: float = 1.0
    low_cut: float = 0.0
    delay_s: float = 0.0


PRIOR_MATRIX = np.diag(np.array(PRIOR_SD) ** -2.0)
PRIOR_RHS = PRIOR_MATRIX @ [1.0, 0.0, 0.0]


@dataclass(frozen=True, slots=True, eq=False)
class PairErrorEstimate:
    """Running estimate of the errors of a sensor pair over about AVERAGING_CHECKS comparisons.

    `matrix` (3, 3) and `rhs` (3,) are sums of normal equations, with those expected before.
    """

    errors: PairErrors = PairErrors()
    matrix: Float2D = field(default_factory=PRIOR_MATRIX.copy)
    rhs: Float1D = field(default_factory=PRIOR_RHS.copy)
    check_count: int = 0

    def update(self, equations: tuple[Float2D, Float1D], omega: float) -> "PairErrorEstimate":
        """Return the estimate with the normal equations of one more comparison at `omega` rad/s.

        They hold the low cut that was known when they were made, in hp(x). While it still moves,
        those made before are forgotten.
        """
        matrix = self._fade(equations[0])
        rhs = matrix @ np.linalg.solve(self.matrix, self.rhs) + equations[1]
        matrix += equations[0]
        errors = _solve_bounded(matrix, rhs)
        correction = abs(errors.low_cut - self.errors.low_cut)
        if errors.low_cut * correction > FIT_ERROR_RATIO * omega**2:
            matrix, rhs = PRIOR_MATRIX + equations[0], PRIOR_RHS + equations[1]
            return PairErrorEstimate(_solve_bounded(matrix, rhs), matrix, rhs)
        return PairErrorEstimate(errors, matrix, rhs, self.check_count + 1)

    def _fade(self, new: Float2D) -> Float2D:
        """Return `matrix` without a share of 1 / AVERAGING_CHECKS, or what new equations replace.

        So what only other frequencies or larger motions can show, as a low cut, is kept.
        """
        root = np.linalg.cholesky(self.matrix)
        half = np.linalg.solve(root, new)
        gained, vectors = np.linalg.eigh(np.linalg.solve(root, half.T))
        kept = 1.0 - np.clip(gained, 0.0, 1.0 / AVERAGING_CHECKS)
        turned = root @ vectors
        return np.asarray((turned * kept) @ turned.T)

    @property
    def low_cut_sd(self) -> float:
        """Standard deviation of the low cut, rad/s, at gain 1."""
        return float(math.sqrt(np.linalg.inv(self.matrix)[1, 1]))


def solve_errors(matrix: Float2D, rhs: Float1D, fixed_gain: bool = False) -> PairErrors:
    """Solve normal equations within the bounds of sound sensors, near their expected values.

    They are those of gain, gain x low cut and delay, (3, 3) and (3,).
    """
    return _solve_bounded(matrix + PRIOR_MATRIX, rhs + PRIOR_RHS, fixed_gain)


def _solve_bounded(matrix: Float2D, rhs: Float1D, fixed_gain: bool = False) -> PairErrors:
    """Solve normal equations that include the expected values within the bounds."""
    x, is_free = np.array([1.0, 0.0, 0.0]), np.array([not fixed_gain, True, True])
    while is_free.any():
        if is_free.all():
            x = np.linalg.solve(matrix, rhs)
        else:
            known = matrix[:, ~is_free] @ x[~is_free]
            x[is_free] = np.linalg.solve(matrix[np.ix_(is_free, is_free)], (rhs - known)[is_free])
        beyond = is_free & ((x < LEAST_ERRORS) | (x > LARGEST_ERRORS))
        if not beyond.any():
            break
        x = np.clip(x, LEAST_ERRORS, LARGEST_ERRORS)
        is_free &= ~beyond
    gain, scaled_low_cut, delay_s = x.tolist()
    # A gain far below 1 is that of no sound sensor.
    return PairErrors(gain, scaled_low_cut / max(gain, 1.0 - PRIOR_SD[0]), delay_s)


def highpass(
    x: Float1D, low_cut: float, rate_hz: float, last: tuple[float, float] | None = None
) -> Float1D:
    """Return a signal, (sample,), behind a first-order high-pass of `low_cut` rad/s.

    `last`: (input, output) at the sample before; None: at rest. Lost samples (NaN) repeat the one
    before. The result does not depend on the division into calls.
    """
    before, output = last or (math.nan, 0.0)
    joined = np.concatenate([[before], x])
    finite = np.flatnonzero(np.isfinite(joined))
    if not finite.size:
        return np.full(x.size, output)
    latest = np.searchsorted(finite, np.arange(joined.size), side="right") - 1
    steps = np.diff(joined[finite[np.maximum(latest, 0)]])
    half = 0.5 * low_cut / rate_hz  # trapezoidal rule
    pole = (1.0 - half) / (1.0 + half)
    return filter_first_order(steps, (1.0 / (1.0 + half), 0.0), pole, pole * output)[0]


def filter_first_order(
    x: Float1D, gains: tuple[float, float], pole: float, state: float
) -> tuple[Float1D, float]:
    """Return y_i = b0 x_i + z_i with z_(i+1) = b1 x_i + pole y_i, (sample,), and the last z.

    The numbers are those of `scipy.signal.lfilter`, whose import takes longer than the start of a
    command.
    """
    y = np.empty(x.size)
    last: float = _filter(np.ascontiguousarray(x), *gains, pole, state, y)
    return y, last


@jit_untyped_kernel
def _filter(x, b0, b1, pole, state, y):  # type: ignore[no-untyped-def]
    """Write the output into `y`, return the last state."""
    for i in range(x.size):
        y[i] = b0 * x[i] + state
        state = b1 * x[i] + pole * y[i]
    return state
