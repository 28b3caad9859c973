"""Digital inputs of a rig: the heartbeat wired back, limit switches, interlock.

Only the wiring check reads them, next to the backend; no run depends on them.
"""

from typing import Protocol

from table_io.config.rig import RigConfig


class DigitalInputs(Protocol):
    """Digital inputs, open until `close`."""

    def read_levels(self) -> dict[str, bool]:
        """Return the present level of each input, by name."""

    def close(self) -> None:
        """Release the inputs."""


def open_digital_inputs(rig: RigConfig) -> DigitalInputs | None:
    """Open the digital inputs of a rig, None if it has none; InputError if unreadable."""
    if rig.ni is None or not rig.ni.digital_inputs:
        return None
    from table_io.backends.ni.digital_lines import NiDigitalInputs

    return NiDigitalInputs(rig.ni)
