"""Closed-form solver of models whose effects change only the SNM's parameters or its input."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from table_io.block import Float1D, Float2D
from twin.model.closed_form import advance_state, discretized_params, rest_state, restart_state
from twin.model.parameters import Parameters
from twin.model.solver import StateEstimate

if TYPE_CHECKING:
    from twin.model.model import Model


@dataclass(frozen=True, slots=True, eq=False)
class ClosedFormSolver:
    """Closed-form solver of a model at one sampling rate."""

    model: "Model"
    parameters: Parameters
    params: Float1D

    @classmethod
    def from_model(cls, model: "Model", rate_hz: float) -> "ClosedFormSolver":
        return cls(model, model.parameters, discretized_params(model.parameters, rate_hz))

    def rest_state(self, index: int = 0) -> Float1D:
        return rest_state(self.parameters)

    def restart_state(self, start: StateEstimate) -> Float1D:
        added = self.model.added_acceleration(start.table_disp)
        return restart_state(
            start.u, start.v, start.u_r, start.u_l, start.contact_r, start.contact_l,
            start.base_acc + (0.0 if added is None else added), self.parameters,
        )  # fmt: skip

    def set_clock(self, state: Float1D, samples: float) -> None:
        pass

    def advance(self, state: Float1D, base_acc: Float1D, table_disp: Float1D, out: Float2D) -> None:
        added = self.model.added_acceleration(table_disp)
        if added is None:
            advance_state(state, self.params, base_acc, out)
            return
        advance_state(state, self.params, base_acc + added, out)
        out[2] -= added
