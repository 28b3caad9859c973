"""The solver of models whose phases keep their closed form: the SNM and changes of its numbers."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from table_io.block import Float1D, Float2D
from twin.model.exact import advance, constants, rest, restart
from twin.model.parameters import Parameters
from twin.model.solver import GRAVITY_M_S2, Start

if TYPE_CHECKING:
    from twin.model.model import Model


@dataclass(frozen=True, slots=True, eq=False)
class ClosedSolver:
    """`tilt`: acceleration of the mass per table displacement, g x rad/m, in 1/s2; 0 = none."""

    parameters: Parameters
    constants: Float1D
    tilt: float

    @classmethod
    def of(cls, model: "Model", rate_hz: float) -> "ClosedSolver":
        tilt = GRAVITY_M_S2 * (model.value("table_tilt", "tilt") or 0.0)
        return cls(model.parameters, constants(model.parameters, rate_hz), tilt)

    def rest(self, index: int = 0) -> Float1D:
        return rest(self.parameters)

    def restart(self, start: Start) -> Float1D:
        base = start.base_acc + (self.tilt * start.table_disp if self.tilt else 0.0)
        return restart(
            start.u, start.v, start.u_r, start.u_l, start.touch_r, start.touch_l, base,
            self.parameters,
        )  # fmt: skip

    def retime(self, state: Float1D, samples: float) -> None:
        pass

    def advance(self, state: Float1D, base_acc: Float1D, table_disp: Float1D, out: Float2D) -> None:
        if not self.tilt:
            advance(state, self.constants, base_acc, out)
            return
        push = self.tilt * table_disp
        advance(state, self.constants, base_acc + push, out)
        out[2] -= push
