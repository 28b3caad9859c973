"""Dead band: the damper's spring has clearance, so that it resists only beyond +-width.

    M u'' + C u' + K u - K u / (1 + (u / width)^4)^(1/4) + F_R + F_L = -M A

Close to u = 0 the spring does nothing, far from it K (|u| - width) is left. The fourth power rounds
the corner at +-width, as surfaces that meet do. Conservative: stored K u^2 / 2 less a potential
that is never larger. Source: clearance nonlinearity, e.g. Nayfeh and Mook 1979, Nonlinear
Oscillations; the smooth form is ours.
"""

from collections.abc import Mapping

from twin.model.effects.effect import Effect, EffectParameter
from twin.model.parameters import Parameters


def force(q: float, c: tuple[float, ...]) -> float:
    """Return the spring force in N that the clearance takes away, < 0 for q > 0; c = (K, width)."""
    ratio = q / c[1]
    square = ratio * ratio
    return -c[0] * q / (1.0 + square * square) ** 0.25


def _constants(parameters: Parameters, values: Mapping[str, float]) -> tuple[float, ...]:
    """Return (stiffness of the damper in N/m, half the clearance in m)."""
    return parameters.stiffness, values["width"]


DEAD_BAND = Effect(
    id="dead_band",
    term="-K u / (1 + (u / width)^4)^(1/4)",
    parameters=(
        EffectParameter("width", "m", 0.0, 10.0, 0.0, 1e-3, "Clearance on each side of u = 0."),
    ),
    acts="force",
    residual=(
        "A force against the spring's that keeps its size and changes sign with u: softer at small "
        "amplitude, no loss, odd harmonics in phase with u; present in flight."
    ),
    confused_with=("coulomb_friction", "cubic_stiffness"),
    force=force,
    constants=_constants,
)
