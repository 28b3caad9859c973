"""Checks of an NI rig that claim nothing: wiring, driver, interlock inputs."""

from typing import Any

from nidaqmx.errors import Error
from nidaqmx.system import System

from table_io.backends import MachineLost
from table_io.backends.ni.channel import connect_server
from table_io.backends.ni.config import NiWiring
from table_io.backends.ni.digital_lines import NiDigitalInputs
from table_io.backends.ni.errors import describe_error
from table_io.config.rig import RigConfig
from table_io.errors import InputError


def check_reachable(rig: RigConfig) -> None:
    """Raise InputError if no driver answers; claim nothing."""
    wiring = require_ni_wiring(rig)
    try:
        if wiring.endpoint:
            connect_server(rig, wiring.endpoint).close()
        else:
            System.local().driver_version  # noqa: B018
    except Error as error:
        raise InputError(
            f"no NI-DAQmx driver on this computer ({describe_error(error)})",
            where=f"rig {rig.name}",
            remedy="install it, or set ni.endpoint to the address of an NI gRPC Device Server",
        ) from None


def require_ni_wiring(rig: RigConfig) -> NiWiring:
    """Return the [ni] wiring of a rig; InputError if it does not match the sensors."""
    wiring = rig.require_section("ni", NiWiring)
    inputs = {analog_input.channel for analog_input in wiring.inputs}
    for names, problem in (
        (set(rig.channels) - inputs, "no input for sensor"),
        (inputs - set(rig.channels), "no sensor for input"),
    ):
        if names:
            raise InputError(
                f"{problem} {', '.join(sorted(names))}",
                where=f"rig {rig.name}",
                key="ni.inputs",
                allowed="exactly one input for each sensor",
            )
    return wiring


def describe_interlock_fault(wiring: NiWiring, channel: Any) -> str:
    """Return which inputs of `ni.well` are low, with the remedy; empty if all are high."""
    if not wiring.well:
        return ""
    try:
        lines = NiDigitalInputs(wiring, wiring.well, channel)
        try:
            low = [name for name, high in lines.read_levels().items() if not high]
        finally:
            lines.close()
    except (InputError, MachineLost) as error:
        return str(error)
    if not low:
        return ""
    return (
        f"ni.well: {', '.join(low)} not high; close the open contact, then reset the latch at the "
        "table while `shaketwin check --table` sends the heartbeat"
    )
