"""Digital inputs that a machine card names: the heartbeat wired back, limit switches, interlock.

They are looked at where the wiring is checked, beside the backend; no run depends on them.
"""

from typing import Protocol

from table_io.rig import Rig


class DigitalInputs(Protocol):
    """Some inputs, open until they are closed."""

    def levels(self) -> dict[str, bool]:
        """Name -> level now."""

    def close(self) -> None:
        """Let them go."""


def digital_inputs(rig: Rig) -> DigitalInputs | None:
    """Those of a card; None where it names none. BadInput where they cannot be read."""
    if rig.ni is None or not rig.ni.watched:
        return None
    from table_io.backends.ni.lines import Lines

    return Lines(rig.ni)
