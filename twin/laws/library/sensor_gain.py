"""Sensor gain error: reading = gain x value.

Acts on one predicted channel, not on the motion. The restart from the measured state removes it
from that channel.
"""

from twin.laws.effect import Effect, EffectParameter

EFFECT = Effect(
    id="sensor_gain",
    description=__doc__,
    term="reading = gain x value, of one channel",
    parameters=(EffectParameter("gain", "", 0.2, 5.0, 1.0, 1.05, "Reading over true value."),),
    place="sensor",
    residual=(
        "In proportion to the channel itself, in flight and in contact; the motion channels become "
        "inconsistent with each other, which no force law can cause."
    ),
    confused_with=("mass_error", "table_tilt"),
)
