"""Whether displacement, acceleration and forces of one and the same body still fit together.

Nothing here knows a force law: what is compared holds for any motion, chaotic ones too.

Weak form: integral phi'' x dt = integral phi a dt, for phi that vanishes with its slope at both
ends of a window. phi = sin^4(pi t / T) exp(-i k (w t + theta)) at the drive's own frequency (k = 1,
2), so that no noise is differentiated and offsets of x drop out; with k = 0 an offset of a is left.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from table_io.block import Float1D, Float2D

ORDERS = (0, 1, 2)
SIGMAS = 6.0
CLEAR, CLEAR_SIZE = 20.0, 0.3  # an amplitude over its error, and of the motion, that tells
Complex1D = npt.NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class Weak:
    """What a displacement and an acceleration say of the same motion over one window, m/s2.

    At 0, 1 and 2 times the drive's frequency, (3,): amplitudes from either, what a constant of
    1 m/s2 leaves there, and the standard error of the difference of the amplitudes.
    """

    displacement: Complex1D
    acceleration: Complex1D
    constant: Complex1D
    sigma: Float1D

    @cached_property
    def size(self) -> float:
        """The largest of the amplitudes of the motion."""
        pair = self.displacement[1:], self.acceleration[1:]
        return float(max(np.abs(one).max() for one in pair))

    @cached_property
    def average(self) -> float:
        """The larger of the two averages: a wrong gain would have a share of it."""
        return float(max(abs(self.displacement[0].real), abs(self.acceleration[0].real)))

    @cached_property
    def apart(self) -> float:
        """The largest difference that noise cannot explain: beyond six standard errors."""
        return self._beyond_noise(self.acceleration - self.displacement)

    @cached_property
    def offset(self) -> float:
        """The constant that explains the differences best: what the acceleration has too much."""
        off = self.acceleration - self.displacement
        return float((self.constant.conj() @ off).real / self._weight)

    @property
    def sigma_offset(self) -> float:
        """Its standard error."""
        return float(np.linalg.norm(np.abs(self.constant) * self.sigma)) / self._weight

    @property
    def apart_but_offset(self) -> float:
        """What is left of `apart` when that constant is taken away."""
        off = self.acceleration - self.displacement
        return self._beyond_noise(off - self.offset * self.constant)

    @property
    def ratio(self) -> complex:
        """Acceleration over displacement at the drive's frequency; NaN where that tells little."""
        clear = max(CLEAR * float(self.sigma[1]), CLEAR_SIZE * self.size)
        known = abs(self.displacement[1]) > clear
        return complex(self.acceleration[1] / self.displacement[1]) if known else complex("nan")

    def changed(self, ratio: complex) -> float:
        """Difference at the drive's frequency, beyond noise, from sensors of this ratio."""
        off = abs(ratio * self.displacement[1] - self.acceleration[1])
        return float(max(off - SIGMAS * self.sigma[1], 0.0))

    def _beyond_noise(self, off: Complex1D) -> float:
        return float(max((np.abs(off) - SIGMAS * self.sigma)[1:].max(), 0.0))

    @property
    def _weight(self) -> float:
        return float(np.sum(np.abs(self.constant) ** 2))


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """phi and phi'' of one window for the orders 0, 1, 2: complex (order, sample)."""

    phi: npt.NDArray[np.complex128]
    curved: npt.NDArray[np.complex128]


def window(samples: int, turns: float, middle: float, rate_hz: float) -> Window:
    """The window over `samples`, in which the drive turns `turns` cycles, at phase `middle` in
    the middle of it. Scaled so that a tone of amplitude 1 gives amplitude 1.
    """
    t = (np.arange(samples) + 0.5) / samples
    length = samples / rate_hz
    sin, cos = np.sin(np.pi * t), np.cos(np.pi * t)
    bell = sin**4
    slope = 4 * math.pi / length * sin**3 * cos
    curve = (math.pi / length) ** 2 * (12 * sin**2 * cos**2 - 4 * sin**4)
    omega = 2 * math.pi * turns / length
    tone = np.exp(-2j * np.pi * (middle + turns * (t - 0.5)))
    total = float(bell.sum())
    phi = np.empty((len(ORDERS), samples), dtype=np.complex128)
    curved = np.empty_like(phi)
    wave = np.ones_like(tone)
    for k in ORDERS:
        scale = (2.0 if k else 1.0) / total
        phi[k] = scale * bell * wave
        curved[k] = scale * (curve - 2j * k * omega * slope - (k * omega) ** 2 * bell) * wave
        wave = wave * tone
    return Window(phi, curved)


def weak(one: Window, x: Float1D, a: Float1D, noise: tuple[float, float]) -> Weak:
    """Displacement x in m against acceleration a in m/s2, (sample,); `noise` is the rms of each."""
    errors = np.hypot(
        noise[0] * np.linalg.norm(one.curved, axis=1), noise[1] * np.linalg.norm(one.phi, axis=1)
    )
    return Weak(one.curved @ x, one.phi @ a, one.phi.sum(axis=1), errors)


@dataclass(frozen=True, slots=True)
class Shared:
    """How two cells share a force: `angle` in rad of the line on which their forces move (pi/4:
    equally, 0: the first alone, -pi/4: one is reversed), `swing`, the rms along it, and the `means`
    of both, N. `sigma_angle` and `sigma` are the standard errors of angle and means.
    """

    angle: float
    means: tuple[float, float]
    swing: float
    sigma_angle: float
    sigma: float


def shared(first: Float1D, second: Float1D, noise: float) -> Shared:
    """The principal axis of two cells' forces in N, (sample,); `noise` is the rms of either."""
    means = float(first.mean()), float(second.mean())
    a, b = first - means[0], second - means[1]
    aa, bb, ab = float(a @ a), float(b @ b), float(a @ b)
    angle = 0.5 * math.atan2(2 * ab, aa - bb)
    if angle < -math.pi / 4 - 1e-3:
        angle += math.pi
    swing = math.sqrt(0.5 * (aa + bb + math.hypot(aa - bb, 2 * ab)) / first.size)
    sigma = noise / math.sqrt(first.size)
    return Shared(angle, means, swing, sigma / swing if swing else math.inf, sigma)


def despiked(values: Float2D, limit: Float2D) -> Float2D:
    """Samples, (channel, sample), with those replaced that lie further than `limit`, (channel, 1),
    from the median with their neighbours.
    """
    left, middle, right = values[:, :-2], values[:, 1:-1], values[:, 2:]
    median = np.maximum(np.minimum(left, middle), np.minimum(np.maximum(left, middle), right))
    clean = values.copy()
    clean[:, 1:-1] = np.where(np.abs(middle - median) > limit, median, middle)
    return clean
