"""Digital inputs of a rig: the heartbeat wired back, limit switches, interlock.

Only the wiring check reads them, next to the backend; no run depends on them.
"""

from typing import Protocol


class DigitalInputs(Protocol):
    """Digital inputs, open until `close`."""

    def read_levels(self) -> dict[str, bool]:
        """Return the present level of each input, by name."""

    def close(self) -> None:
        """Release the inputs."""
