"""Cubic (Duffing) stiffness: the damper's spring hardens (k3 > 0) or softens (k3 < 0).

    M u'' + C u' + K u + k3 u^3 + F_R + F_L = -M A

Odd in u, conservative, stored energy k3 u^4 / 4. With k3 < 0 the spring pulls back only up to
|u| = sqrt(-K/k3); beyond it the mass escapes. Source: Duffing.
"""

from twin.laws.effect import Effect, EffectParameter

EFFECT = Effect(
    id="cubic_stiffness",
    description=__doc__,
    term="k3 u^3 in the damper",
    force="k3 * u * u * u",
    compiled={"k3": "k3"},
    parameters=(
        EffectParameter("k3", "N/m3", -1e15, 1e15, 0.0, 1e7, "Cubic coefficient of the damper."),
    ),
    residual=(
        "The resonance moves with the square of the amplitude; a third harmonic in phase with u; "
        "no change of loss; present in flight."
    ),
    confused_with=("bumper_hardening", "bouc_wen"),
)
