"""A vendor's controller in this process: it plays a file on the simulated table."""

import numpy as np

from table_io.block import Float1D
from table_io.clock import Clock
from table_io.config.profile import Specimen
from table_io.config.rig import RigConfig
from table_io.sim.opendaq import DrivePlayback
from table_io.sim.simulated_table import SimulatedBackend


class Bystander(SimulatedBackend):
    """A Source whose table is moved by somebody else: file value 0 leaves at sample `begins`."""

    clock_description = "the simulated table's clock"

    def __init__(
        self,
        rig: RigConfig,
        specimen: Specimen,
        rate_hz: float,
        clock: Clock,
        file_m: Float1D,
        begins: float = 4000.37,
        ppm: float = 0.0,
    ) -> None:
        super().__init__(rig, specimen, rate_hz, clock)
        self.file = DrivePlayback(file_m, rate_hz, rate_hz, begins, ppm)

    def start(self) -> None:
        if self._is_open and self._epoch is None:
            played = self.file.command(0, self.file.end)
            super().queue(0, played * self._rig.output.volts_per_m)
        super().start()


def whole(drive: object, rest: int = 2000) -> Float1D:
    """The file of a drive, m, (sample,)."""
    values: Float1D = drive.command(0, drive.rest_start + rest)  # type: ignore[attr-defined]
    return np.ascontiguousarray(values)
