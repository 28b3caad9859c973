"""Table of all channels: name, unit, positive direction and meaning.

Right is positive everywhere. The names are also the column names of CSV and Parquet files.
"""

from dataclasses import dataclass

import numpy as np

from table_io.block import Block, Float1D


@dataclass(frozen=True, slots=True)
class Channel:
    """Measured quantity with its SI unit and sign convention."""

    name: str
    unit: str
    positive: str
    meaning: str


CHANNELS: tuple[Channel, ...] = (
    Channel("drive_disp_m", "m", "right", "Commanded table displacement, read back."),
    Channel("table_disp_m", "m", "right", "Table displacement in the laboratory frame."),
    Channel("table_acc_m_s2", "m/s2", "right", "Table acceleration in the laboratory frame."),
    Channel("mass_disp_m", "m", "right", "Total displacement of the mass, laboratory frame."),
    Channel("mass_acc_m_s2", "m/s2", "right", "Total acceleration of the mass, laboratory frame."),
    Channel("force_r1_n", "N", "compression", "First load cell on the right bumper."),
    Channel("force_r2_n", "N", "compression", "Second load cell on the right bumper."),
    Channel("force_l1_n", "N", "compression", "First load cell on the left bumper."),
    Channel("force_l2_n", "N", "compression", "Second load cell on the left bumper."),
    Channel("damper_force_n", "N", "resists motion to the right", "Damper force, component tests."),
    Channel("rel_disp_m", "m", "right", "Mass minus table, measured directly."),
)
CHANNEL_BY_NAME = {channel.name: channel for channel in CHANNELS}

RIGHT_CELLS = ("force_r1_n", "force_r2_n")
LEFT_CELLS = ("force_l1_n", "force_l2_n")


def relative_displacement(block: Block) -> Float1D:
    """Return u in m, right positive, (sample,): measured directly, else mass minus table.

    All NaN if the channels are missing, so that a lost sensor is not mistaken for zero.
    """
    if "rel_disp_m" in block.channels:
        return block.channel("rel_disp_m")
    if {"mass_disp_m", "table_disp_m"} <= set(block.channels):
        return block.channel("mass_disp_m") - block.channel("table_disp_m")
    return np.full(len(block), np.nan)


def contact_forces(block: Block) -> tuple[Float1D, Float1D]:
    """Return the contact forces (F_R, F_L) in N: F_R = r1 + r2 >= 0, F_L = -(l1 + l2) <= 0.

    Each is (sample,), and NaN if all load cells of its side are missing.
    """
    sides = []
    for cells, sign in ((RIGHT_CELLS, 1.0), (LEFT_CELLS, -1.0)):
        present = [block.channel(name) for name in cells if name in block.channels]
        total = present[0] if len(present) == 1 else sum(present, np.zeros(len(block)))
        sides.append(sign * total if present else np.full(len(block), np.nan))
    return sides[0], sides[1]
