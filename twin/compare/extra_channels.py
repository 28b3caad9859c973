"""Prediction of the channels that a rig file declares, from what the twins predict.

A channel is predicted if it measures a quantity of PREDICTED_SUMS along the axis of the table. The
twins take the motion of the table from the canonical sensors, so a second sensor on the table is
compared with those. Sensor errors of the model apply to their own channel only.
"""

from collections.abc import Iterable, Mapping

from table_io.block import Float1D
from table_io.channels import LEFT_CELLS, RIGHT_CELLS, Channel

TABLE_INPUTS = ("table_disp_m", "table_acc_m_s2")  # measured
# Predicted channels, or inputs, of which a (quantity, body) is the sum; a force on a bumper is that
# of both its cells.
PREDICTED_SUMS: dict[tuple[str, str], tuple[str, ...]] = {
    ("displacement", "table"): ("table_disp_m",),
    ("acceleration", "table"): ("table_acc_m_s2",),
    ("displacement", "mass"): ("mass_disp_m",),
    ("relative_displacement", "mass"): ("rel_disp_m",),
    ("relative_velocity", "mass"): ("rel_vel_m_s",),
    ("acceleration", "mass"): ("mass_acc_m_s2",),
    ("force", "right_bumper"): RIGHT_CELLS,
    ("force", "left_bumper"): LEFT_CELLS,
}


def select_predicted(channels: Iterable[Channel]) -> tuple[Channel, ...]:
    """Select the channels that the model predicts."""
    return tuple(
        channel
        for channel in channels
        if channel.sign is not None and (channel.quantity, channel.body) in PREDICTED_SUMS
    )


def predict_channel(channel: Channel, sources: Mapping[str, Float1D]) -> Float1D:
    """Return the prediction of a channel of `select_predicted` in SI, (sample,).

    `sources` are the channels of one twin without sensor errors, and TABLE_INPUTS.
    """
    first, *others = (sources[name] for name in PREDICTED_SUMS[channel.quantity, channel.body])
    total: Float1D = (channel.sign or 0.0) * sum(others, first)
    return total
