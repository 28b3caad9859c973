"""Measured motion from sensor fusion: displacement, velocity, forces, and their noise.

Each body, mass and table, has a laser (accurate at low frequency) and an accelerometer (accurate at
high frequency). Per frequency, with white noise s_x and s_a and angular frequency w, the
minimum-variance estimate and the sensor-consistency residual are
    X = (s_a^2 X_laser - w^2 s_x^2 A) / (s_a^2 + w^4 s_x^2),   V = i w X
    residual = (A + w^2 X_laser) / sqrt(s_a^2 + w^4 s_x^2)
so noise is neither differentiated nor integrated without bound, and there is no delay. The
residual is white with variance 1 for any force law; a deviation indicates a sensor error.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from table_io.block import Bool2D, Float1D, Int1D, Label


@dataclass(frozen=True, slots=True)
class MotionNoise:
    """Rms noise of one sample at the rate of the motion, SI; NaN without the channel."""

    u: float  # of the fused displacement
    v: float  # of the fused velocity
    acc: float  # total acceleration of the mass
    right: float
    left: float
    force: float  # of a directly measured damper force


@dataclass(frozen=True, slots=True, eq=False)
class ConsistencyResidual:
    """Sensor-consistency residual: disagreement of two redundant sensors over its noise, (sample,).

    Laser and accelerometer of a body ("mass", "table", "mass against table"), or the two load
    cells of a side ("right cells", "left cells").
    """

    body: str
    values: Float1D
    acc_sensitivity: float = 0.0  # change of `values` per m/s2 of constant accelerometer offset


@dataclass(frozen=True, eq=False)
class MeasuredMotion:
    """Fused motion and forces of a test at `rate_hz`, SI, right positive, (sample,) each.

    `right` = F_R >= 0 and `left` = -F_L >= 0; NaN if not measured. `damper` is the damper force if
    it was measured directly (component tests), else None. `good` is False near lost samples.
    """

    name: str
    rate_hz: float
    mass_kg: float
    gaps_m: tuple[float, float]
    time_s: Float1D
    u: Float1D
    v: Float1D
    acc: Float1D
    table_acc: Float1D
    table_disp: Float1D
    right: Float1D
    left: Float1D
    step: Int1D
    label: Int1D
    cycle: Int1D
    good: Bool2D
    noise: MotionNoise
    consistency_residuals: tuple[ConsistencyResidual, ...] = ()
    damper: Float1D | None = None

    @cached_property
    def has_load_cells(self) -> bool:
        """True if bumper forces were measured."""
        return bool(np.isfinite(self.right).any())

    @property
    def moving(self) -> Bool2D:
        """Samples with the drive in motion and all channels valid, (sample,)."""
        moving: Bool2D = self.good & (self.label != Label.REST)
        return moving

    def move(self, start: "MeasuredMotion", end: "MeasuredMotion") -> "MeasuredMotion":
        """Return the motion moved by the change from one motion of the test to another."""

        def add_change(own: Float1D, before: Float1D, after: Float1D) -> Float1D:
            return own + (after - before)

        residuals = zip(
            self.consistency_residuals, start.consistency_residuals, end.consistency_residuals,
            strict=True,
        )  # fmt: skip
        damper = self.damper
        if damper is not None and start.damper is not None and end.damper is not None:
            damper = add_change(damper, start.damper, end.damper)
        return replace(
            self, gaps_m=end.gaps_m, damper=damper,
            consistency_residuals=tuple(
                replace(own, values=add_change(own.values, before.values, after.values))
                for own, before, after in residuals
            ),
            u=add_change(self.u, start.u, end.u), v=add_change(self.v, start.v, end.v),
            acc=add_change(self.acc, start.acc, end.acc),
            table_acc=add_change(self.table_acc, start.table_acc, end.table_acc),
            table_disp=add_change(self.table_disp, start.table_disp, end.table_disp),
            right=add_change(self.right, start.right, end.right),
            left=add_change(self.left, start.left, end.left),
        )  # fmt: skip

    def select(self, samples: Int1D) -> "MeasuredMotion":
        """Return the motion at these samples alone, without its consistency residuals."""
        return replace(
            self, time_s=self.time_s[samples], u=self.u[samples], v=self.v[samples],
            acc=self.acc[samples], table_acc=self.table_acc[samples],
            table_disp=self.table_disp[samples], right=self.right[samples],
            left=self.left[samples], step=self.step[samples], label=self.label[samples],
            cycle=self.cycle[samples], good=self.good[samples], consistency_residuals=(),
            damper=None if self.damper is None else self.damper[samples],
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class RecordScale:
    """Largest values of the measured motion of all logs, SI.

    Bounds and trial values of a fit are multiples of them, never absolute numbers, so that a
    result does not depend on the size of the specimen.
    """

    u: float  # relative displacement
    v: float  # its rate
    acc: float  # total acceleration of the mass
    depth: float  # compression of a bumper; u without bumpers
    force: float  # of the damper if it was measured, else of inertia
    table_disp: float
    sample_s: float  # time between samples
    duration_s: float  # of the longest log
    readings: Mapping[str, float]  # by channel

    @property
    def time_s(self) -> float:
        """Displacement over velocity in s: one radian of the main motion."""
        return self.u / self.v


def measure_scale(motions: Sequence[MeasuredMotion], readings: Mapping[str, float]) -> RecordScale:
    """Return the scale of the motions of all logs; `readings` are the largest by channel, SI."""

    def largest(rows: Sequence[Float1D]) -> float:
        moving = [np.nan_to_num(row[m.moving]) for row, m in zip(rows, motions, strict=True)]
        return float(max(np.abs(row).max(initial=0.0) for row in moving)) or 1.0

    u = largest([m.u for m in motions])
    gaps = [gap for m in motions for gap in m.gaps_m if math.isfinite(gap)]
    forces = [-m.mass_kg * m.acc if m.damper is None else m.damper for m in motions]
    return RecordScale(
        u, largest([m.v for m in motions]), largest([m.acc for m in motions]),
        max(u - min(gaps), 1e-2 * u) if gaps else u, largest(forces),
        largest([m.table_disp for m in motions]), min(1.0 / m.rate_hz for m in motions),
        max(float(np.ptp(m.time_s)) for m in motions), readings,
    )  # fmt: skip
