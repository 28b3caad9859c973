"""Sensor lag, of the sensor, its filter or its wiring: reading(t) = value(t - lag).

Acts on one predicted channel, not on the motion; values between samples come from a cubic through
four of them. Until the first prediction is as old as the lag the reading is unknown (NaN).
"""

from twin.laws.effect import Effect, EffectParameter

EFFECT = Effect(
    id="sensor_lag",
    description=__doc__,
    term="reading(t) = value(t - lag), of one channel",
    parameters=(EffectParameter("lag", "s", 0.0, 0.05, 0.0, 1e-3, "Delay of the reading."),),
    place="sensor",
    residual=(
        "In proportion to the rate of change of the channel, so it grows with frequency; the "
        "motion channels become inconsistent with each other."
    ),
    confused_with=("maxwell_damper", "quadratic_damping"),
)
