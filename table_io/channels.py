"""Registry of channels: name, unit, positive direction, meaning, quantity and body.

Right is positive everywhere. The names are also the column names of CSV and Parquet files. A rig
file declares further channels (`table_io/config/channel.py`); `RigConfig.channel_by_name` holds
both.
"""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from table_io.block import Block, Float1D

TIME_COLUMN = "time_s"  # of samples in a table, next to the channels
DIRECTION_SIGNS = {"right": 1.0, "compression": 1.0, "left": -1.0, "tension": -1.0}


@dataclass(frozen=True, slots=True)
class Channel:
    """Measured quantity of a body with its SI unit and sign convention."""

    name: str
    unit: str
    positive: str
    meaning: str
    quantity: str
    body: str

    @property
    def sign(self) -> float | None:
        """Factor to the project's convention, right and compression positive; None: other axis."""
        return DIRECTION_SIGNS.get(self.positive)


CHANNELS: tuple[Channel, ...] = (
    Channel("drive_disp_m", "m", "right", "Commanded table displacement, read back.",
            "displacement", "command"),
    Channel("table_disp_m", "m", "right", "Table displacement in the laboratory frame.",
            "displacement", "table"),
    Channel("table_acc_m_s2", "m/s2", "right", "Table acceleration in the laboratory frame.",
            "acceleration", "table"),
    Channel("mass_disp_m", "m", "right", "Total displacement of the mass, laboratory frame.",
            "displacement", "mass"),
    Channel("mass_acc_m_s2", "m/s2", "right", "Total acceleration of the mass, laboratory frame.",
            "acceleration", "mass"),
    Channel("force_r1_n", "N", "compression", "First load cell on the right bumper.",
            "force", "right_bumper"),
    Channel("force_r2_n", "N", "compression", "Second load cell on the right bumper.",
            "force", "right_bumper"),
    Channel("force_l1_n", "N", "compression", "First load cell on the left bumper.",
            "force", "left_bumper"),
    Channel("force_l2_n", "N", "compression", "Second load cell on the left bumper.",
            "force", "left_bumper"),
    Channel("damper_force_n", "N", "resists motion to the right", "Damper force, component tests.",
            "force", "damper"),
    Channel("rel_disp_m", "m", "right", "Mass minus table, measured directly.",
            "relative_displacement", "mass"),
)  # fmt: skip
CHANNEL_BY_NAME = {channel.name: channel for channel in CHANNELS}

RIGHT_CELLS = ("force_r1_n", "force_r2_n")
LEFT_CELLS = ("force_l1_n", "force_l2_n")
CONTROL_CHANNELS = ("drive_disp_m", "table_disp_m", "table_acc_m_s2")  # needed by the controller
RELATIVE_DISP = "rel_disp_m"
RELATIVE_DISP_SOURCES = ("mass_disp_m", "table_disp_m")  # their difference, unless it is measured


def list_derived_channels(channels: Collection[str]) -> tuple[str, ...]:
    """Return the channels that follow from these: `rel_disp_m` from both displacements, or none."""
    is_derived = RELATIVE_DISP not in channels and {*RELATIVE_DISP_SOURCES} <= {*channels}
    return (RELATIVE_DISP,) if is_derived else ()


def measure_mass(block: Block) -> Float1D:
    """Return the displacement of the mass in the laboratory frame in m, (sample,)."""
    if "mass_disp_m" in block.channels:
        return block.channel("mass_disp_m")
    return block.channel("rel_disp_m") + block.channel("table_disp_m")


def relative_displacement(block: Block) -> Float1D:
    """Return u in m, right positive, (sample,): measured directly, else mass minus table.

    All NaN if the channels are missing, so that a lost sensor is not mistaken for zero.
    """
    if RELATIVE_DISP in block.channels:
        return block.channel(RELATIVE_DISP)
    if list_derived_channels(block.channels):
        mass_disp, table_disp = map(block.channel, RELATIVE_DISP_SOURCES)
        return mass_disp - table_disp
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
