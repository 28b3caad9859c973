"""Harmonics of a drive's own phase in what was measured: least squares over whole cycles.

x(t) = offset + sum over k of Im(c_k exp(2 pi i k phase)), so a real c_1 is in phase with the sine
that the drive calls its acceleration. The phase is the drive's closed form, sample by sample, so
nothing is estimated but amplitudes, and a cycle need not be a whole number of samples.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from table_io.block import Float1D

HARMONICS = 10
Complex1D = npt.NDArray[np.complex128]


@dataclass(frozen=True, slots=True, eq=False)
class Tracked:
    """Offset, c_1 .. c_n and the rms of what they leave, in the unit of the samples."""

    offset: float
    amplitudes: Complex1D
    residual_rms: float

    @property
    def fundamental(self) -> float:
        """Amplitude of the fundamental."""
        return float(abs(self.amplitudes[0]))

    @property
    def distortion(self) -> float:
        """Root sum of squares of the harmonics 2 to n over the fundamental (THD)."""
        return float(np.sqrt(np.sum(np.abs(self.amplitudes[1:]) ** 2)) / abs(self.amplitudes[0]))


NOTHING = Tracked(float("nan"), np.full(HARMONICS, complex("nan")), float("nan"))


def track(values: Float1D, phase: Float1D, harmonics: int = HARMONICS) -> Tracked:
    """Harmonics of `values`, (sample,), at the drive's `phase` in cycles, (sample,).

    Harmonics that fewer than four samples a cycle would have to tell are left out (zero). All NaN
    where samples are lost or too few.
    """
    return _solve(_basis(phase, harmonics), values, harmonics)


def track_all(values: Float1D, phase: Float1D, harmonics: int = HARMONICS) -> list[Tracked]:
    """`track` of several channels, (channel, sample), at one phase."""
    basis = _basis(phase, harmonics)
    return [_solve(basis, row, harmonics) for row in values]


def _basis(phase: Float1D, harmonics: int) -> Float1D:
    """Columns 1, sin, cos, sin 2, cos 2, ..., (sample, 2 orders + 1)."""
    cycles = float(np.ptp(phase)) if phase.size else 0.0
    told = int(phase.size / (4 * cycles)) if cycles > 0 else 0
    orders = min(harmonics, told)
    turn = np.exp(2j * np.pi * phase)
    basis = np.ones((phase.size, 2 * orders + 1))
    wave = np.ones_like(turn)
    for k in range(orders):
        wave = wave * turn
        basis[:, 2 * k + 1], basis[:, 2 * k + 2] = wave.imag, wave.real
    return basis


def _solve(basis: Float1D, values: Float1D, harmonics: int) -> Tracked:
    columns = basis.shape[1]
    if columns < 3 or values.size < 2 * columns or not np.isfinite(values).all():
        return NOTHING
    # Not by the matrix library: on a busy machine its threads wait seconds for one another.
    normal, right = np.einsum("ij,ik->jk", basis, basis), np.einsum("ij,i->j", basis, values)
    found = np.linalg.solve(normal, right)
    amplitudes = np.zeros(harmonics, dtype=np.complex128)
    # a sin + b cos = Im((a + i b) exp(i theta))
    amplitudes[: columns // 2] = found[1::2] + 1j * found[2::2]
    rms = float(np.sqrt(np.mean((values - np.einsum("ij,j->i", basis, found)) ** 2)))
    return Tracked(float(found[0]), amplitudes, rms)
