"""A controller that plays by itself; we follow it."""

from typing import Literal

from pydantic import Field

from table_io.card import Card, Number


class FollowWiring(Card):
    """Who acquires, and where the controller's command is seen."""

    source: Literal["opendaq"] = Field("opendaq", description="The table that wires the inputs.")
    command: Literal["drive_disp_m", "table_disp_m"] = Field(
        "drive_disp_m", description="table_disp_m where no command is wired: less exact."
    )
    wait_s: Number = Field(
        300.0, ge=5.0, le=86400.0, description="For the controller to be started, then give up."
    )
