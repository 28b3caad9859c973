"""A sensor reads too much or too little: reading = gain x value.

Acts on one predicted channel and not on the motion. The restart from the measured state takes it
back out of that channel.
"""

from twin.model.effects.effect import Effect, EffectParameter

SENSOR_GAIN = Effect(
    id="sensor_gain",
    term="reading = gain x value, of one channel",
    parameters=(EffectParameter("gain", "", 0.2, 5.0, 1.0, 1.05, "Reading over true value."),),
    acts="sensor",
    residual=(
        "In proportion to the channel itself, in every phase; the motion channels no longer fit "
        "each other, which no force law can do."
    ),
    confused_with=("mass_error", "table_tilt"),
)
