"""The measured motion as one smooth whole: displacement, velocity, forces, and their noise.

Each body, mass and table, has a laser and an accelerometer; each knows what the other does not.
Per frequency, with white noise s_x and s_a and w the angular frequency, the estimate of least
variance and what is left over are
    X = (s_a^2 X_laser - w^2 s_x^2 A) / (s_a^2 + w^4 s_x^2),   V = i w X
    surprise = (A + w^2 X_laser) / sqrt(s_a^2 + w^4 s_x^2)
so noise is neither differentiated nor integrated without bound, and nothing is delayed. The
surprise is white with variance 1 whatever the force laws, unless a sensor errs: the kinematic gate.
"""

from dataclasses import dataclass

import numpy as np

from table_io.block import Bool2D, Float1D, Int1D, Label


@dataclass(frozen=True, slots=True)
class Noise:
    """rms of the noise of one sample, SI, at the motion's rate; NaN where there is no channel."""

    u: float  # of the fused displacement
    v: float  # of the fused velocity
    acc: float  # total acceleration of the mass
    right: float
    left: float
    force: float  # of a damper force that was measured itself


@dataclass(frozen=True, slots=True, eq=False)
class Surprise:
    """What two sensors of one thing do not agree on, over its noise; (sample,).

    Laser and accelerometer of a body ("mass", "table", "mass against table"), or the two load
    cells of a side ("right cells", "left cells").
    """

    body: str
    values: Float1D
    per_acc: float = 0.0  # by how much one m/s2 more of the accelerometer, all the time, moves it


@dataclass(frozen=True, eq=False)
class Motion:
    """Samples of a test at `rate_hz`, SI, right positive, (sample,) each.

    `right` = F_R >= 0 and `left` = -F_L >= 0; NaN where nobody measured. `damper` is the damper's
    force where it was measured itself (component tests), else None. `good` is False where a
    channel was lost.
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
    noise: Noise
    surprises: tuple[Surprise, ...] = ()
    damper: Float1D | None = None

    @property
    def cells(self) -> bool:
        """True where bumper forces were measured."""
        return bool(np.isfinite(self.right).any())

    @property
    def moving(self) -> Bool2D:
        """Samples at which the drive moved and every channel can be believed."""
        moved: Bool2D = self.good & (self.label != Label.REST)
        return moved
