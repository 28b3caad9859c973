"""What is said, and what happens, where the driver reports an error: by where it happens.

| where | the voltage | the heartbeat | then |
|---|---|---|---|
| input | plays what is queued, to rest | goes on until then | the tasks are cleared at rest |
| output | unknown: it may stand still in motion | stops at once | the interlock acts |
| heartbeat | plays what is queued, to rest | has failed | the interlock may act before |
| start | has not moved | stops | the tasks are cleared |
| counter | plays what is queued, to rest | stops | the interlock may act before |
| server, connection | plays what is queued, if the driver lives | stops | the interlock acts |

It is the same for every code: no driver promises which of them leave a task running.
"""

from typing import Literal

from nidaqmx.error_codes import DAQmxErrors
from nidaqmx.errors import DaqError

Where = Literal["input", "output", "heartbeat", "start", "counter", "server"]

HAPPENS: dict[Where, str] = {
    "input": "what is queued plays to rest",
    "output": "its voltage may stand still in motion; the heartbeat has stopped, so the machine's "
    "interlock brings the table to rest",
    "heartbeat": "what is queued plays to rest, unless the machine's interlock acts before",
    "start": "nothing has moved",
    "counter": "what is queued plays to rest, unless the machine's interlock acts before",
    "server": "what is queued in the driver plays to rest, and the machine's interlock acts",
}
REMEDY = {
    -200279: "the input was not read in time: free the processor, or lower the sample rate",
    -200278: "the input has ended: see that its clock is still there",
    -200284: "no samples came: see that clock and trigger are connected",
    -200290: "the output was not fed in time: free the processor",
    -200621: "the device ran out of output: raise ni.held_by_device_ms",
    -200361: "the device's memory ran over: free the bus, or lower the sample rate",
    -201003: "the device cannot be reached: look after its power and its cable",
    -88709: "the device was taken away or reset: look after its power and its cable",
    -50103: "somebody else has the device: end the other program, or restart the server",
}


ABOUT = ("Physical Channel", "Channel Name", "Property", "Requested Value")


def name_of(code: int) -> str:
    """What the driver calls an error."""
    try:
        return DAQmxErrors(code).name
    except ValueError:
        return "UNKNOWN"


def said(error: Exception) -> str:
    """An error in one line: its code and name and what it is about, or its own first words."""
    if isinstance(error, DaqError):
        about = [one.strip() for one in str(error).splitlines() if one.strip().startswith(ABOUT)]
        return f"error {error.error_code} ({'; '.join([name_of(error.error_code), *about])})"
    return str(error).splitlines()[0] if str(error) else type(error).__name__


def lost(where: Where, error: Exception, moved: bool = True) -> str:
    """Which error, what the table does now, what to do; not `moved`: nothing was started yet."""
    place = "the connection to the device" if where == "server" else f"the {where} of the device"
    code = error.error_code if isinstance(error, DaqError) else 0
    remedy = REMEDY.get(code, "look after the machine and the device")
    happens = _begun(HAPPENS[where if moved else "start"])
    return f"{place} failed: {said(error)}. {happens}. {_begun(remedy)}, then start anew"


def _begun(sentence: str) -> str:
    return sentence[0].upper() + sentence[1:]
