"""Damper relaxation: Maxwell branch (spring and dashpot in series) parallel to K and C.

    M u'' + C u' + K u + f + F_R + F_L = -M A,  f' = k1 u' - f / tau

Linear, so solved exactly. Passive: stored f^2 / (2 k1), loss f^2 / (k1 tau). Stiffness rises by k1
from low to high frequency, the loss peaks at 1 / (2 pi tau). Source: standard linear solid (Zener).
"""

from twin.laws.effect import Effect, EffectParameter, State

EFFECT = Effect(
    id="maxwell_damper",
    description=__doc__,
    term="k1 spring in series with a dashpot, parallel to K and C",
    force="f",
    states={"f": State("N", "k1 * v - f / tau")},
    compiled={"k1": "k1", "rate_1": "1 / tau"},
    is_linear=True,
    dissipates=True,
    parameters=(
        EffectParameter("k1", "N/m", 0.0, 1e12, 0.0, 8e3, "Stiffness that relaxes."),
        EffectParameter("tau", "s", 1e-4, 100.0, None, 0.05, "Relaxation time."),
    ),
    residual=(
        "Stiffness and loss that depend on frequency, not on amplitude; no harmonics; present in "
        "flight."
    ),
    confused_with=("bouc_wen", "mass_error"),
)
