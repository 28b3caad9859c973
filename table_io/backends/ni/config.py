"""Wiring of an NI-DAQmx device, and its output buffer."""

import ipaddress
import re
from typing import Annotated, Literal

from pydantic import Field, ValidationInfo, field_validator

from table_io.config.base import ConfigModel, NonNegative, Positive, list_duplicates
from table_io.config.rig import BackendConfig, RigConfig
from table_io.errors import InputError

HEARTBEAT_NAME = "heartbeat"  # name of the line that reads the heartbeat back
LINE_PATTERN = r"^([^/\s]+/port\d+/line\d+)?$"


class NiInput(ConfigModel):
    """Input of one channel; its range in V is that of the sensor."""

    channel: str = Field(description="A sensor of the rig file.")
    physical: str = Field(pattern=r"^[^/\s]+/ai\d+$", description="Physical channel: Dev1/ai0.")
    terminals: Literal["differential", "rse", "nrse", "pseudodifferential", "default"] = Field(
        "differential", description="Terminal configuration of the input."
    )


class NiFault(ConfigModel):
    """Injected error of the simulated device of `shaketwin table`; real devices ignore it."""

    call: Literal["read", "write", "start", "heartbeat", "output"] = Field(
        description="Call that fails; output: it stops by itself, and the next call reports it."
    )
    code: int = Field(lt=0, strict=True, description="Driver error code, e.g. -200279.")
    at_s: NonNegative = Field(0.0, description="Time from sample 0; unused for start.")


class NiWiring(BackendConfig):
    """Wiring of an NI-DAQmx device: endpoint, output, inputs, timing and digital lines."""

    endpoint: str = Field(
        "", description="HOST:PORT of NI's gRPC Device Server; empty: the local driver."
    )
    output: str = Field(pattern=r"^[^/\s]+/ao\d+$", description="Command output, e.g. Dev1/ao0.")
    heartbeat: str = Field(
        pattern=r"^[^/\s]+/port\d+/line\d+$",
        description="Line monitored by the machine's interlock, e.g. Dev1/port0/line0.",
    )
    held_by_device_ms: Positive = Field(
        le=5000.0, description="Output buffered in the device that can no longer be replaced."
    )
    start_trigger: str = Field("", description="Empty: /DEVICE/ai/StartTrigger of the inputs.")
    output_clock: str = Field(
        "", description="Empty: the device's own, from the time base that also clocks the inputs."
    )
    inputs: tuple[NiInput, ...] = Field(min_length=1)
    heartbeat_back: str = Field(
        "",
        pattern=LINE_PATTERN,
        description="Input line that reads back the heartbeat at the interlock.",
    )
    well: dict[str, Annotated[str, Field(pattern=LINE_PATTERN)]] = Field(
        {}, description="Name = input line that is high while all is well: limit switch, interlock."
    )
    faults: tuple[NiFault, ...] = ()

    @field_validator("endpoint")
    @classmethod
    def _check_endpoint(cls, endpoint: str) -> str:
        if not endpoint:
            return endpoint
        host, _, port = endpoint.rpartition(":")
        if not host or not port.isdecimal() or not 0 < int(port) <= 65535:
            raise InputError(
                f"{endpoint!r} is no address", remedy="give HOST:PORT, e.g. 127.0.0.1:31763"
            )
        try:
            public = ipaddress.ip_address(host.strip("[]")).is_global
        except ValueError:
            public = False  # a host name: trusted to the name server of this network
        if public:
            raise InputError(
                f"{endpoint!r} is a public address, and the connection is neither encrypted "
                "nor authenticated",
                allowed="this computer or a private network",
            )
        return endpoint

    @field_validator("inputs")
    @classmethod
    def _check_duplicates(cls, inputs: tuple[NiInput, ...]) -> tuple[NiInput, ...]:
        for names, kind in (
            ([wire.channel for wire in inputs], "channel"),
            ([wire.physical for wire in inputs], "physical channel"),
        ):
            duplicates = list_duplicates(names)
            if duplicates:
                raise InputError(
                    f"{kind} {', '.join(duplicates)} is wired twice", remedy="keep one wire"
                )
        return inputs

    @field_validator("start_trigger", "output_clock")
    @classmethod
    def _check_terminal(cls, terminal: str, info: ValidationInfo) -> str:
        if terminal and not re.fullmatch(r"/[^/\s]+(/[^/\s]+)+", terminal):
            raise InputError(
                f"{terminal!r} is no terminal", remedy="give e.g. /Dev1/ai/StartTrigger"
            )
        return terminal

    def find_address(self, rig: RigConfig) -> str:
        return self.endpoint

    @property
    def trigger(self) -> str:
        """Terminal that starts the output together with the inputs."""
        device = self.inputs[0].physical.split("/")[0]
        # cDAQ modules share the timing engines of their chassis
        chassis = re.sub(r"^(cDAQ.*)Mod\d+$", r"\1", device)
        return self.start_trigger or f"/{chassis}/ai/StartTrigger"

    def device_buffer_samples(self, rate_hz: float) -> int:
        """Return the samples of output that are buffered in the device."""
        return max(round(self.held_by_device_ms * 1e-3 * rate_hz), 2)

    @property
    def digital_inputs(self) -> dict[str, str]:
        """Name -> line of the digital inputs that `check --table` reads."""
        heartbeat = {HEARTBEAT_NAME: self.heartbeat_back} if self.heartbeat_back else {}
        return heartbeat | self.well

    @property
    def warnings(self) -> list[str]:
        """Warnings about allowed but less safe settings."""
        warnings = []
        if not self.endpoint:
            warnings.append(
                "ni.endpoint is empty: with the local driver the output stops if the process of "
                "the rig dies, its voltage freezes in motion, and only the interlock on the "
                "heartbeat line stops the table; run NI's gRPC Device Server, also on this computer"
            )
        if self.output_clock.endswith("/ai/SampleClock"):
            warnings.append(
                "ni.output_clock is that of the inputs: if they fail, the command freezes in "
                "motion; remove it if output and inputs share a device"
            )
        return warnings
