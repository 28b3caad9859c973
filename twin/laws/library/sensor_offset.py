"""Sensor offset: reading = value + offset.

Acts on one predicted channel, not on the motion. The restart from the measured state removes it
from that channel.
"""

from twin.laws.effect import Effect, EffectParameter

EFFECT = Effect(
    id="sensor_offset",
    description=__doc__,
    term="reading = value + offset, of one channel",
    parameters=(
        EffectParameter(
            "offset", "unit of the channel", -1e9, 1e9, 0.0, 1e-3, "Reading at a value of zero."
        ),
    ),
    place="sensor",
    residual="A constant in one channel, at rest too; no harmonics in the others.",
    confused_with=("gap_offset", "table_tilt"),
)
