"""Damping that grows with the displacement: rubber whose loss factor rises with strain.

    M u'' + (C + cu u^2) u' + K u + F_R + F_L = -M A

Passive: power cu u^2 u'^2. Source: van der Pol's damping without its negative part.
"""

from twin.laws.effect import Effect, EffectParameter

EFFECT = Effect(
    id="position_damping",
    description=__doc__,
    term="cu u^2 u'",
    force="cu * u * u * v",
    dissipates=True,
    parameters=(EffectParameter("cu", "N s/m3", 0.0, 1e14, 0.0, 3e6, "Damping per u squared."),),
    residual=(
        "Equivalent damping grows as amplitude^2, the same at every frequency; third harmonic in "
        "phase with u'; present in flight."
    ),
    confused_with=("quadratic_damping", "hunt_crossley"),
)
