"""What every model is solved through: prepared for a rate, state in, state out."""

from dataclasses import dataclass
from typing import Protocol

from table_io.block import Float1D, Float2D

OUTPUTS = 7  # rows: u, v, a, F_R, F_L, u_r, u_l
GRAVITY_M_S2 = 9.80665


@dataclass(frozen=True, slots=True)
class Start:
    """A measured estimate at one sample, SI, right positive; u_r >= 0, u_l <= 0.

    `hidden`: a state of the same solver, from which comes what no sensor sees (branch forces,
    hysteresis); None or NaN: relaxed, zero.
    """

    index: int
    u: float
    v: float
    u_r: float = 0.0
    u_l: float = 0.0
    touch_r: bool = False
    touch_l: bool = False
    base_acc: float = 0.0
    table_disp: float = 0.0
    hidden: Float1D | None = None


class Solver(Protocol):
    """One model at one sampling rate. A state is a float64 array, moved on in place."""

    def rest(self, index: int = 0) -> Float1D:
        """Static equilibrium at a sample index, all memory relaxed."""
        ...

    def restart(self, start: Start) -> Float1D:
        """A state that the model allows, from a measured one; NaN where anything in it is."""
        ...

    def retime(self, state: Float1D, samples: float) -> None:
        """Sets the clock of a state to `samples` since sample 0, where the model looks at time."""
        ...

    def advance(self, state: Float1D, base_acc: Float1D, table_disp: Float1D, out: Float2D) -> None:
        """Moves `state` through the next n samples of A in m/s2 and table displacement in m, (n,).

        out (7, n): u in m, v in m/s, total acceleration in m/s2, F_R >= 0 and F_L <= 0 in N, u_R
        and u_L in m. The displacement is read where the table tilts, else not looked at.
        """
        ...
