"""Backend for a table under an external controller that plays the drive by itself.

The inputs come from another backend, which only acquires.
"""

from typing import Literal

from pydantic import Field

from table_io.backends import AcquisitionSource, BackendDescriptor, get_descriptor
from table_io.clock import Clock
from table_io.config.base import Number
from table_io.config.plugins import list_entry_points
from table_io.config.rig import BACKEND_GROUP, BackendConfig, RigConfig, load_backend


class FollowWiring(BackendConfig):
    """Source of the samples, and the channel in which the controller's command is measured."""

    source: str = Field("opendaq", description="Backend of the inputs; it only acquires.")
    command: Literal["drive_disp_m", "table_disp_m"] = Field(
        "drive_disp_m", description="table_disp_m if no command is wired: less exact."
    )
    wait_s: Number = Field(
        300.0, ge=5.0, le=86400.0, description="Longest wait for the controller to start."
    )

    @property
    def max_start_wait_s(self) -> float:
        return self.wait_s

    def find_address(self, rig: RigConfig) -> str:
        section = rig.sections.get(self.source)
        return section.find_address(rig) if section is not None else ""

    def list_faults(self, rig: RigConfig) -> list[str]:
        """List a source that is missing or drives the table, and a command that is not wired."""
        if rig.backend_section is not self:
            return []
        faults = []
        source = load_backend(self.source)
        if source is not None and (source.drives or source is BACKEND):
            names = ", ".join(filter(_only_acquires, list_entry_points(BACKEND_GROUP)))
            faults.append(f"source {self.source!r} does not only acquire; allowed: {names}")
        elif self.source not in (rig.model_extra or {}):
            faults.append(f"source {self.source!r} needs a [{self.source}] table with its wiring")
        if self.command not in rig.channels:
            faults.append(
                f"command {self.command!r} is not a sensor of the rig; allowed: a sensor, "
                "table_disp_m if no command is wired"
            )
        return faults


def _only_acquires(name: str) -> bool:
    backend = load_backend(name)
    return backend is not None and not backend.drives and backend is not BACKEND


def _find_source(rig: RigConfig) -> BackendDescriptor:
    """Return the descriptor of the source; InputError if it is not installed."""
    wiring = rig.get_section(FollowWiring) or FollowWiring()
    return get_descriptor(wiring.source, f"rig {rig.name}", "follow.source")


def _open_source(rig: RigConfig, rate_hz: float, clock: Clock) -> AcquisitionSource:
    open_source = _find_source(rig).open_source
    assert open_source is not None  # checked when the rig file was read
    return open_source(rig, rate_hz, clock)


def _check_reachable(rig: RigConfig) -> None:
    check = _find_source(rig).check_reachable
    if check is not None:
        check(rig)


BACKEND = BackendDescriptor(
    config=FollowWiring,
    open_source=_open_source,
    external_control=True,
    check_reachable=_check_reachable,
)
