"""Dead band: the damper's spring has clearance, so that it resists only beyond +-width.

    M u'' + C u' + K u - K u / (1 + (u / width)^4)^(1/4) + F_R + F_L = -M A

Close to u = 0 the spring does nothing, far from it K (|u| - width) is left. The fourth power rounds
the corner at +-width, as surfaces that meet do. Conservative: stored K u^2 / 2 less a potential
that is never larger. Source: clearance nonlinearity, e.g. Nayfeh and Mook 1979, Nonlinear
Oscillations; the smooth form is ours.
"""

from twin.laws.effect import Effect, EffectParameter

EFFECT = Effect(
    id="dead_band",
    description=__doc__,
    term="-K u / (1 + (u / width)^4)^(1/4)",
    constants={"k": "stiffness"},
    force="-k * u / (1 + (u / width) ** 4) ** 0.25",
    parameters=(
        EffectParameter("width", "m", 0.0, 10.0, 0.0, 1e-3, "Clearance on each side of u = 0."),
    ),
    residual=(
        "A force against the spring's that keeps its size and changes sign with u: softer at small "
        "amplitude, no loss, odd harmonics in phase with u; present in flight."
    ),
    confused_with=("coulomb_friction", "cubic_stiffness"),
)
