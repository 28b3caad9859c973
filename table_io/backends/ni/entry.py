"""What can be known of a card before its device is claimed: wiring, driver, tied inputs."""

from typing import Any

from nidaqmx.errors import Error
from nidaqmx.system import System

from table_io.backends import MachineLost
from table_io.backends.ni.channel import reached
from table_io.backends.ni.codes import said
from table_io.backends.ni.lines import Lines
from table_io.card import BadInput
from table_io.rig import Rig
from table_io.wiring.ni import NiWiring


def answers(rig: Rig) -> None:
    """BadInput where no driver answers; claims nothing."""
    wiring = wired(rig)
    try:
        if wiring.endpoint:
            reached(rig, wiring.endpoint).close()
        else:
            System.local().driver_version  # noqa: B018
    except Error as error:
        raise BadInput(
            f"rig {rig.name}: no NI-DAQmx driver here ({said(error)}); install it, or give "
            "ni.endpoint of an NI gRPC Device Server"
        ) from None


def wired(rig: Rig) -> NiWiring:
    """The wiring of a card; BadInput where it does not fit the sensors."""
    if rig.ni is None:
        raise BadInput(f"rig {rig.name}: no [ni] table; add it, or name another backend")
    inputs = {one.channel for one in rig.ni.inputs}
    for names, what in (
        (set(rig.channels) - inputs, "ni.inputs lack"),
        (inputs - set(rig.channels), "ni.inputs name, and sensors do not,"),
    ):
        if names:
            raise BadInput(f"rig {rig.name}: {what} {', '.join(sorted(names))}; one input a sensor")
    return rig.ni


def unwell(wiring: NiWiring, channel: Any) -> str:
    """Which inputs that are high while all is well are not, and what to do; empty: all are."""
    if not wiring.well:
        return ""
    try:
        lines = Lines(wiring, wiring.well, channel)
        try:
            low = [name for name, high in lines.levels().items() if not high]
        finally:
            lines.close()
    except (BadInput, MachineLost) as error:
        return str(error)
    if not low:
        return ""
    return (
        f"ni.well: {', '.join(low)} not high; mend what is open there, and reset the latch at the "
        "table while `shaketwin check --table` beats"
    )
