"""Closed-form solver of models whose effects change only the SNM's parameters or its input."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from table_io.block import Float1D, Float2D
from twin.model.closed_form import advance_state, discretized_params, rest_state, restart_state
from twin.model.parameters import Parameters
from twin.model.solver import GRAVITY_M_S2, StateEstimate

if TYPE_CHECKING:
    from twin.model.model import Model


@dataclass(frozen=True, slots=True, eq=False)
class ClosedFormSolver:
    """Closed-form solver of a model at one sampling rate.

    `tilt`: acceleration of the mass per table displacement, g x rad/m, in 1/s2; 0 = none.
    """

    parameters: Parameters
    params: Float1D
    tilt: float

    @classmethod
    def from_model(cls, model: "Model", rate_hz: float) -> "ClosedFormSolver":
        tilt = GRAVITY_M_S2 * (model.effect_parameter("table_tilt", "tilt") or 0.0)
        return cls(model.parameters, discretized_params(model.parameters, rate_hz), tilt)

    def rest_state(self, index: int = 0) -> Float1D:
        return rest_state(self.parameters)

    def restart_state(self, start: StateEstimate) -> Float1D:
        base = start.base_acc + (self.tilt * start.table_disp if self.tilt else 0.0)
        return restart_state(
            start.u, start.v, start.u_r, start.u_l, start.contact_r, start.contact_l, base,
            self.parameters,
        )  # fmt: skip

    def set_clock(self, state: Float1D, samples: float) -> None:
        pass

    def advance(self, state: Float1D, base_acc: Float1D, table_disp: Float1D, out: Float2D) -> None:
        if not self.tilt:
            advance_state(state, self.params, base_acc, out)
            return
        tilt_acc = self.tilt * table_disp
        advance_state(state, self.params, base_acc + tilt_acc, out)
        out[2] -= tilt_acc
