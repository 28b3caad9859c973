"""Selection of the solver of a model."""

from twin.model.closed_form import ClosedFormSolver
from twin.model.event_integrator import EventDrivenSolver
from twin.model.model import Model
from twin.model.solver import Solver


def prepare_solver(model: Model, rate_hz: float) -> Solver:
    """Return the solver at this sampling rate: closed form if effects allow, else event-driven.

    Compiles its kernels if they are not cached. InputError as in `Model.check_rate`.
    """
    model.check_rate(rate_hz)
    if any(instance.effect.acts in ("force", "linear") for instance in model.present_effects):
        return EventDrivenSolver.from_model(model, rate_hz)
    return ClosedFormSolver.from_model(model, rate_hz)
