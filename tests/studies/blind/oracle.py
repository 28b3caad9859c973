"""The oracle of the blind studies: a fit of exactly the effects that are hidden."""

from collections.abc import Sequence

from twin.discovery.candidates import Candidate
from twin.discovery.discover import PreparedLog, prepare_problem
from twin.discovery.least_squares import fit_parameters
from twin.discovery.selection import FittedSet
from twin.model.model import Model


def fit_known_effects(
    logs: Sequence[PreparedLog], model: Model, effects: Sequence[str]
) -> FittedSet | None:
    """Fit exactly these effects with the base (oracle result); None if one is not a candidate."""
    prepared = prepare_problem(logs, model)
    candidates = {candidate.name: candidate for candidate in prepared.problem.library}
    if not set(effects) <= candidates.keys():
        return None
    best = None
    effects_fitted: list[Candidate] = [candidates[name] for name in effects]
    for rung in range(max((len(candidate.shapes) for candidate in effects_fitted), default=1)):
        parameters = prepared.parameters
        for candidate in effects_fitted:
            shape = candidate.shapes[min(rung, len(candidate.shapes) - 1)]
            parameters = candidate.add_to(parameters, shape, _small_amplitude(candidate))
        fit = fit_parameters(prepared.problem.log_residuals, parameters)
        if best is None or fit.cost < best.cost:
            best = fit
    return prepared.problem.fit_effects(best.parameters, effects_fitted) if best else None


def _small_amplitude(candidate: Candidate) -> float:
    free = candidate.amplitude
    return min(max(candidate.vanishing + 1e-3 * free.scale, free.low), free.high)
