"""An NI-DAQmx device: what is wired where, and what the device holds."""

import ipaddress
import re
from typing import Annotated, Literal

from pydantic import Field, ValidationInfo, field_validator

from table_io.card import Card, NonNegative, Positive

HEARTBEAT = "heartbeat"  # what the line that is wired back is called
LINE = r"^([^/\s]+/port\d+/line\d+)?$"


class NiInput(Card):
    """A channel's way to the converter; its range in V is that of its sensor."""

    channel: str = Field(description="A sensor of the card.")
    physical: str = Field(pattern=r"^[^/\s]+/ai\d+$", description="Physical channel, as Dev1/ai0.")
    terminals: Literal["differential", "rse", "nrse", "pseudodifferential", "default"] = (
        "differential"
    )


class NiFault(Card):
    """An error that the device of `shaketwin table` reports; real devices have their own."""

    call: Literal["read", "write", "start", "heartbeat", "output"] = Field(
        description="That reports it; output: it ends by itself, and the next call learns of it."
    )
    code: int = Field(lt=0, strict=True, description="Of the driver, as -200279.")
    at_s: NonNegative = Field(0.0, description="From sample 0; start: not used.")


class NiWiring(Card):
    """What is wired where."""

    endpoint: str = Field(
        "", description="HOST:PORT of NI's gRPC Device Server; empty: the local driver."
    )
    output: str = Field(pattern=r"^[^/\s]+/ao\d+$", description="The command, as Dev1/ao0.")
    heartbeat: str = Field(
        pattern=r"^[^/\s]+/port\d+/line\d+$",
        description="A line that the machine's interlock watches, as Dev1/port0/line0.",
    )
    held_by_device_ms: Positive = Field(
        le=5000.0, description="Output that lies in the device and cannot be replaced any more."
    )
    start_trigger: str = Field("", description="Empty: /DEVICE/ai/StartTrigger of the inputs.")
    output_clock: str = Field(
        "", description="Empty: the device's own, of the time base that clocks the inputs too."
    )
    inputs: tuple[NiInput, ...] = Field(min_length=1)
    heartbeat_back: str = Field(
        "", pattern=LINE, description="The heartbeat as it arrives at the interlock, wired back."
    )
    well: dict[str, Annotated[str, Field(pattern=LINE)]] = Field(
        {}, description="Name = an input that is high while all is well: limit switch, interlock."
    )
    faults: tuple[NiFault, ...] = ()

    @field_validator("endpoint")
    @classmethod
    def _near(cls, endpoint: str) -> str:
        if not endpoint:
            return endpoint
        host, _, port = endpoint.rpartition(":")
        if not host or not port.isdecimal() or not 0 < int(port) <= 65535:
            raise ValueError(f"{endpoint!r} is no address; give HOST:PORT, as 127.0.0.1:31763")
        try:
            public = ipaddress.ip_address(host.strip("[]")).is_global
        except ValueError:
            public = False  # a name: whoever keeps the names of this network has given it
        if public:
            raise ValueError(
                f"{endpoint!r} is reached from everywhere, and what is said there is neither "
                "hidden nor guarded; allowed: this computer or a private network"
            )
        return endpoint

    @field_validator("inputs")
    @classmethod
    def _once(cls, inputs: tuple[NiInput, ...]) -> tuple[NiInput, ...]:
        for names, what in (
            ([one.channel for one in inputs], "channel"),
            ([one.physical for one in inputs], "physical channel"),
        ):
            twice = sorted({name for name in names if names.count(name) > 1})
            if twice:
                raise ValueError(f"{what} {', '.join(twice)} stands there more than once")
        return inputs

    @field_validator("start_trigger", "output_clock")
    @classmethod
    def _is_a_terminal(cls, terminal: str, info: ValidationInfo) -> str:
        if terminal and not re.fullmatch(r"/[^/\s]+(/[^/\s]+)+", terminal):
            raise ValueError(f"{terminal!r} is no terminal; give one as /Dev1/ai/StartTrigger")
        return terminal

    @property
    def trigger(self) -> str:
        """The terminal that starts the output with the inputs."""
        device = self.inputs[0].physical.split("/")[0]
        chassis = re.sub(r"^(cDAQ.*)Mod\d+$", r"\1", device)  # its modules share its engines
        return self.start_trigger or f"/{chassis}/ai/StartTrigger"

    def held(self, rate_hz: float) -> int:
        """Samples of the output that lie in the device."""
        return max(round(self.held_by_device_ms * 1e-3 * rate_hz), 2)

    @property
    def watched(self) -> dict[str, str]:
        """Name -> line of the digital inputs that `check --table` looks at."""
        back = {HEARTBEAT: self.heartbeat_back} if self.heartbeat_back else {}
        return back | self.well

    @property
    def doubts(self) -> list[str]:
        """Sentences about what is allowed, and not as safe as it could be."""
        said = []
        if not self.endpoint:
            said.append(
                "ni.endpoint is empty: with the local driver the output dies with the rig's "
                "process and its voltage freezes in motion, so that only the interlock at the "
                "heartbeat line stops the table; run NI's gRPC Device Server, also on this computer"
            )
        if self.output_clock.endswith("/ai/SampleClock"):
            said.append(
                "ni.output_clock is that of the inputs: where they fail, the command freezes in "
                "motion; leave it out where output and inputs share a device"
            )
        return said
