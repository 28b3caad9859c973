"""NI's driver, local or at a gRPC Device Server: connection, digital inputs, discovery, errors.

What an error means depends on the task that reports it:

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

import contextlib
import os
from collections.abc import Callable, Iterable
from typing import Any, Literal

import grpc
import numpy as np
from nidaqmx import GrpcSessionOptions, Task
from nidaqmx.constants import LineGrouping
from nidaqmx.error_codes import DAQmxErrors
from nidaqmx.errors import DaqError, Error
from nidaqmx.stream_readers import DigitalMultiChannelReader
from nidaqmx.system import System

from table_io.backends import ChannelGroup, DiscoveredDevice, MachineLost
from table_io.backends.ni.config import NiWiring
from table_io.config.rig import RigConfig
from table_io.errors import InputError

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


CALL_TIMEOUT_S = 2.0  # of a call, including its wait for samples
CONNECT_TIMEOUT_S = 2.0
MAX_MESSAGE_BYTES = 64 << 20


class DeadlineChannel:
    """Channel that adds a deadline to every call: NI's client sets none."""

    def __init__(self, channel: Any, timeout_s: float) -> None:
        self._channel = channel
        self._timeout_s = timeout_s

    def unary_unary(self, *args: Any, **named: Any) -> Callable[..., Any]:
        call = self._channel.unary_unary(*args, **named)
        timeout_s = self._timeout_s

        def call_with_deadline(request: Any, metadata: Any = None) -> Any:
            return call(request, timeout=timeout_s, metadata=metadata)

        return call_with_deadline

    def __getattr__(self, name: str) -> Any:
        return getattr(self._channel, name)


def open_channel(endpoint: str) -> Any:
    """Return a channel to HOST:PORT with a deadline on every call; nothing is sent yet."""
    options = (
        ("grpc.enable_http_proxy", 0),
        ("grpc.max_send_message_length", MAX_MESSAGE_BYTES),
        ("grpc.max_receive_message_length", MAX_MESSAGE_BYTES),
    )
    return DeadlineChannel(grpc.insecure_channel(endpoint, options=options), CALL_TIMEOUT_S)


def connect_server(rig: RigConfig, endpoint: str) -> Any:
    """Return a channel to a server that answers; InputError with the remedy if none does."""
    channel = open_channel(endpoint)
    try:
        grpc.channel_ready_future(channel).result(timeout=CONNECT_TIMEOUT_S)
    except grpc.FutureTimeoutError:
        channel.close()
        hint = (
            f", in another terminal: shaketwin table --table {rig.name}" if rig.is_simulated else ""
        )
        raise InputError(
            f"no NI gRPC Device Server answers at {endpoint}", remedy=f"start it there{hint}"
        ) from None
    return channel


READ_TIMEOUT_S = 1.0


class NiDigitalInputs:
    """Digital inputs of the rig file, or `lines`; InputError if the driver cannot read one.

    `channel`, if given, is an open channel to the server; it stays open.
    """

    def __init__(
        self, wiring: NiWiring, lines: dict[str, str] | None = None, channel: Any = None
    ) -> None:
        inputs = wiring.digital_inputs if lines is None else lines
        self._names = tuple(inputs)
        self._own_channel: Any = None  # channel that is closed with this object
        if channel is None and wiring.endpoint:
            channel = self._own_channel = open_channel(wiring.endpoint)
        self._task: Task | None = None
        name = f"shaketwin_{'watched' if lines is None else 'well'}_{os.getpid()}"
        try:
            options = None if channel is None else GrpcSessionOptions(channel, name)
            self._task = Task(name, grpc_options=options)
            for line in inputs.values():
                self._task.di_channels.add_di_chan(line, line_grouping=LineGrouping.CHAN_PER_LINE)
            self._reader = DigitalMultiChannelReader(self._task.in_stream)
            self._reader.verify_array_shape = False
            self.read_levels()
        except (Error, MachineLost) as error:
            self.close()
            raise InputError(
                f"cannot be read: {_first_line(error)}",
                where="ni",
                key=", ".join(inputs.values()),
                remedy="correct heartbeat_back and well in the [ni] table of the rig file",
            ) from None

    def read_levels(self) -> dict[str, bool]:
        """Return the present level of each line, by name; MachineLost if the read fails."""
        levels = np.zeros(len(self._names), dtype=np.bool_)
        try:
            self._reader.read_one_sample_one_line(levels, timeout=READ_TIMEOUT_S)
        except Error as error:
            raise MachineLost(f"the digital inputs cannot be read: {_first_line(error)}") from None
        return dict(zip(self._names, levels.tolist(), strict=True))

    def close(self) -> None:
        """Release the lines; safe to call twice."""
        task, self._task = self._task, None
        if task is not None:
            with contextlib.suppress(Error):
                task.close()
        if self._own_channel is not None:
            self._own_channel.close()
            self._own_channel = None


def _first_line(error: Exception) -> str:
    """Return the first line of the driver's message."""
    return next(iter(str(error).strip().splitlines()), type(error).__name__)


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


DISCOVERY_TIMEOUT_S = 1.5
UNUSED_SESSION = "0"  # required by the client; no session of this name is created
CHANNEL_KINDS: tuple[tuple[Literal["AI", "AO", "DI", "DO"], str, str, str], ...] = (
    ("AI", "ai_physical_chans", "ai_voltage_rngs", "ai_max_single_chan_rate"),
    ("AO", "ao_physical_chans", "ao_voltage_rngs", "ao_max_rate"),
    ("DI", "di_lines", "", ""),
    ("DO", "do_lines", "", ""),
)


def discover_devices(server: str | None) -> tuple[DiscoveredDevice, ...]:
    """Return the devices at `server`, HOST:PORT, or the local driver; InputError if unreachable."""
    if server is None:
        try:
            return tuple(_device(device, "local driver") for device in System.local().devices)
        except Error as error:
            raise InputError(_first_line(error)) from None
    with contextlib.closing(open_channel(server)) as channel:
        try:
            grpc.channel_ready_future(channel).result(DISCOVERY_TIMEOUT_S)
            system = System.remote(GrpcSessionOptions(channel, UNUSED_SESSION))
            return tuple(_device(device, server) for device in system.devices)
        except grpc.FutureTimeoutError:
            raise InputError(
                "no gRPC Device Server answers there",
                where=server,
                remedy="start it there, and check that it listens at this address and port",
            ) from None
        except Error as error:
            raise InputError(
                f"cannot list its devices: {_first_line(error)}", where=server
            ) from None


def _device(device: Any, where: str) -> DiscoveredDevice:
    """Convert a device of the NI client."""
    ports = []
    for kind, channels, ranges, rate in CHANNEL_KINDS:
        names = tuple(str(channel.name) for channel in _read_attribute(device, channels) or ())
        if names:
            flat = [float(volts) for volts in _read_attribute(device, ranges) or ()]
            pairs = tuple(zip(flat[::2], flat[1::2], strict=True))
            ports.append(ChannelGroup(kind, names, pairs, _read_attribute(device, rate)))
    serial = _read_attribute(device, "serial_num")
    return DiscoveredDevice(
        "ni",
        str(device.name),
        where,
        str(_read_attribute(device, "product_type") or ""),
        f"{serial:X}" if serial else "",  # hexadecimal, as printed on the device
        bool(_read_attribute(device, "is_simulated")),
        tuple(ports),
    )


def _read_attribute(device: Any, name: str) -> Any:
    """Read an attribute of a device; None if the device does not have it."""
    try:
        value = getattr(device, name) if name else None
        return list(value) if isinstance(value, Iterable) and not isinstance(value, str) else value
    except Error:
        return None
