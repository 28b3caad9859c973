"""Solver interface: a model prepared for one sampling rate; state in, state out."""

from dataclasses import dataclass
from typing import Protocol

from table_io.block import Float1D, Float2D

OUTPUT_COUNT = 7  # rows: u, v, a, F_R, F_L, u_r, u_l


@dataclass(frozen=True, slots=True)
class StateEstimate:
    """Measured state estimate at one sample, SI, right positive; u_r >= 0, u_l <= 0.

    `hidden`: a state of the same solver that supplies unmeasured states (branch forces,
    hysteresis); None or NaN: relaxed, zero.
    """

    index: int
    u: float
    v: float
    u_r: float = 0.0
    u_l: float = 0.0
    contact_r: bool = False
    contact_l: bool = False
    base_acc: float = 0.0
    table_disp: float = 0.0
    hidden: Float1D | None = None


class Solver(Protocol):
    """A model at one sampling rate. A state is a float64 array, advanced in place."""

    def rest_state(self, index: int = 0) -> Float1D:
        """Return the static equilibrium at a sample index, all memory relaxed."""
        ...

    def restart_state(self, start: StateEstimate) -> Float1D:
        """Return a consistent model state from a measured one; NaN if any of it is."""
        ...

    def set_clock(self, state: Float1D, samples: float) -> None:
        """Set the clock of a state to `samples` since sample 0, if the model depends on time."""
        ...

    def advance(self, state: Float1D, base_acc: Float1D, table_disp: Float1D, out: Float2D) -> None:
        """Advance `state` through n samples of A in m/s2 and table displacement in m, (n,).

        out (7, n): u in m, v in m/s, total acceleration in m/s2, F_R >= 0 and F_L <= 0 in N, u_R
        and u_L in m. The displacement is used only with table tilt.
        """
        ...
