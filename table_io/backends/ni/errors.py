"""Consequences of driver errors and their messages, by the task that reports the error.

| source | output voltage | heartbeat | afterwards |
|---|---|---|---|
| input | plays the queued command to rest | continues until then | tasks cleared at rest |
| output | unknown: may freeze in motion | stops at once | the interlock stops the table |
| heartbeat | plays the queued command to rest | has failed | the interlock may act first |
| start | has not moved | stops | tasks cleared |
| counter | plays the queued command to rest | stops | the interlock may act first |
| server, connection | plays on if the driver survives | stops | the interlock stops the table |

The consequence does not depend on the error code: the driver does not specify which codes leave a
task running.
"""

from typing import Literal

from nidaqmx.error_codes import DAQmxErrors
from nidaqmx.errors import DaqError

ErrorSource = Literal["input", "output", "heartbeat", "start", "counter", "server"]

CONSEQUENCES: dict[ErrorSource, str] = {
    "input": "the queued command plays to rest",
    "output": "its voltage may be frozen in motion; the heartbeat has stopped, so the machine's "
    "interlock stops the table",
    "heartbeat": "the queued command plays to rest, unless the machine's interlock acts first",
    "start": "nothing has moved",
    "counter": "the queued command plays to rest, unless the machine's interlock acts first",
    "server": "the command queued in the driver plays on, and the machine's interlock stops the "
    "table",
}
REMEDIES = {
    -200279: "the inputs were not read in time: reduce the load of the computer or the sample rate",
    -200278: "the input task has ended: check its sample clock",
    -200284: "no samples arrived: check that clock and trigger are connected",
    -200290: "output underrun: reduce the load of the computer",
    -200621: "underrun in the device's memory: raise ni.held_by_device_ms",
    -200361: "overflow of the device's memory: reduce the load of the bus or the sample rate",
    -201003: "the device cannot be reached: check its power and its cable",
    -88709: "the device was removed or reset: check its power and its cable",
    -50103: "another program has reserved the device: end the other program, or restart the server",
}


DETAIL_PREFIXES = ("Physical Channel", "Channel Name", "Property", "Requested Value")


def error_name(code: int) -> str:
    """Return the driver's name of an error code, UNKNOWN if it has none."""
    try:
        return DAQmxErrors(code).name
    except ValueError:
        return "UNKNOWN"


def describe_error(error: Exception) -> str:
    """Format an error in one line: code, name and details, or the first line of its message."""
    if isinstance(error, DaqError):
        details = [
            line.strip()
            for line in str(error).splitlines()
            if line.strip().startswith(DETAIL_PREFIXES)
        ]
        return f"error {error.error_code} ({'; '.join([error_name(error.error_code), *details])})"
    return str(error).splitlines()[0] if str(error) else type(error).__name__


def describe_loss(source: ErrorSource, error: Exception, moved: bool = True) -> str:
    """Compose the message of a loss: error, consequence (none if not `moved`), remedy."""
    location = (
        "the connection to the device" if source == "server" else f"the {source} of the device"
    )
    code = error.error_code if isinstance(error, DaqError) else 0
    remedy = REMEDIES.get(code, "check the machine and the device")
    consequence = _capitalize(CONSEQUENCES[source if moved else "start"])
    return (
        f"{location} failed: {describe_error(error)}. {consequence}. "
        f"{_capitalize(remedy)}, then start again"
    )


def _capitalize(sentence: str) -> str:
    return sentence[0].upper() + sentence[1:]
