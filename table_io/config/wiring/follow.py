"""Wiring of a table under an external controller that plays the drive by itself."""

from typing import Literal

from pydantic import Field

from table_io.config.base import ConfigModel, Number


class FollowWiring(ConfigModel):
    """Source of the samples, and the channel in which the controller's command is measured."""

    source: Literal["opendaq"] = Field("opendaq", description="Table that wires the inputs.")
    command: Literal["drive_disp_m", "table_disp_m"] = Field(
        "drive_disp_m", description="table_disp_m if no command is wired: less exact."
    )
    wait_s: Number = Field(
        300.0, ge=5.0, le=86400.0, description="Longest wait for the controller to start."
    )
