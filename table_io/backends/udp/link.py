"""UDP socket of a rig: numbers the packets it sends and validates those it receives."""

import contextlib
import secrets
import select
import socket
import zlib
from dataclasses import replace

from pydantic import Field, field_validator

from table_io.backends.udp.packets import (
    TARGET_PACKET_BYTES,
    PacketKind,
    Reason,
    RigPacket,
    TargetState,
    decode_target_state,
    encode_rig_packet,
)
from table_io.clock import Clock, RealClock
from table_io.config.base import Positive
from table_io.config.rig import BackendConfig, RigConfig
from table_io.errors import InputError


class UdpWiring(BackendConfig):
    """Address and timing of the target; the wiring of its converters is configured there."""

    target: str = Field(description="HOST:PORT of the target.")
    rig_port: int = Field(0, ge=0, le=65535, strict=True, description="Port of the rig; 0: any.")
    replace_after_ms: Positive = Field(
        40.0, le=1000.0, description="From a decision to the first sample it can change."
    )

    @field_validator("target")
    @classmethod
    def _check_target(cls, target: str) -> str:
        host, _, port = target.rpartition(":")
        if not host or not port.isdecimal() or not 0 < int(port) <= 65535:
            raise InputError(
                f"{target!r} is not an address",
                remedy="give HOST:PORT with a port of 1 to 65535, e.g. 192.168.7.5:7460",
            )
        return target

    def find_address(self, rig: RigConfig) -> str:
        return self.target

    @property
    def address(self) -> tuple[str, int]:
        """(host, port) of the target."""
        host, _, port = self.target.rpartition(":")
        return host, int(port)


ANSWER_TIMEOUT_S = 1.0  # of a request
BUFFER_BYTES = 1 << 20

REASON_TEXTS = {
    Reason.NONE: "no reason given",
    Reason.BUSY: "it has a rig already; end that one first",
    Reason.RATE: "it does not support this sample rate; change acquisition.rate_hz",
    Reason.CHANNELS: "its number of channels is not that of the [[sensors]] in the rig file; make "
    "them equal",
    Reason.SILENCE: "it received no packet from this rig for too long and continues alone",
    Reason.RELEASED: "its rig released it",
    Reason.SWITCHED_OFF: "it is being switched off",
    Reason.CARD: "it was started with another rig file; start it with the rig file of this run",
}


def rig_checksum(rig: RigConfig) -> int:
    """Return a CRC-32 over [output] and [[sensors]] of the rig config; never 0."""
    canonical = rig.model_dump_json(include={"output", "sensors"})
    return zlib.crc32(canonical.encode()) or 1


class UdpLink:
    """Packets of one connection to the target; InputError if the address cannot be used."""

    def __init__(self, wiring: UdpWiring, clock: Clock, port: int | None = None) -> None:
        self.session = secrets.randbits(63) + 1
        self.last_sent_s = clock.now()
        self._clock = clock
        self._sequence = 0
        port = wiring.rig_port if port is None else port
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
            self._socket.setblocking(False)
            self._socket.bind(("", port))
            self._socket.connect(wiring.address)  # packets from other senders are dropped
        except OSError as error:
            self._socket.close()
            raise InputError(
                f"{error.strerror or error} (udp.rig_port = {wiring.rig_port})",
                key="udp.target",
                value=wiring.target,
                remedy="give an address that this computer can reach, and a free port (0: any)",
            ) from None

    def send(self, packet: RigPacket) -> None:
        """Send a packet; only the state of the target confirms that it arrived."""
        self._sequence = (self._sequence + 1) & 0xFFFFFFFF
        self.last_sent_s = self._clock.now()
        data = encode_rig_packet(replace(packet, session=self.session, sequence=self._sequence))
        with contextlib.suppress(OSError):
            self._socket.send(data)

    def receive(self, timeout_s: float) -> list[TargetState]:
        """Return the waiting states, or the first within `timeout_s`; discard invalid packets."""
        states: list[TargetState] = []
        if not select.select([self._socket], [], [], timeout_s)[0]:
            return states
        with contextlib.suppress(OSError):  # no more packets, or nothing listens there
            while True:
                state = decode_target_state(self._socket.recv(TARGET_PACKET_BYTES + 1))
                if state is not None:
                    states.append(state)
        return states

    def close(self) -> None:
        self._socket.close()


def query_target(
    wiring: UdpWiring, clock: Clock, timeout_s: float = ANSWER_TIMEOUT_S
) -> TargetState:
    """Return the state of a target without claiming it; InputError if it does not answer.

    The query is sent from any free port first, as another rig may use rig_port, then from rig_port,
    as some targets answer only that one.
    """
    for port in dict.fromkeys((0, wiring.rig_port)):
        state = _poll_target(UdpLink(wiring, clock, port), clock, timeout_s)
        if state is not None:
            return state
    raise InputError(
        f"no UDP target answers at {wiring.target}",
        remedy="start it, and check that it uses the address and port of the rig file (for the "
        "simulated target: shaketwin table --table udp_simulated)",
    )


def _poll_target(link: UdpLink, clock: Clock, timeout_s: float) -> TargetState | None:
    """Return the state of a target, None if it does not answer."""
    try:
        deadline_s = clock.now() + timeout_s
        while clock.now() < deadline_s:
            link.send(RigPacket(PacketKind.BEAT))
            states = link.receive(timeout_s / 20)
            if states:
                return states[-1]
            clock.wait_until(min(clock.now() + timeout_s / 100, deadline_s))
    finally:
        link.close()
    return None


def check_reachable(rig: RigConfig) -> None:
    """Raise InputError if the target of the rig file does not answer; claim nothing."""
    wiring = rig.get_section(UdpWiring)
    if wiring is not None:
        query_target(wiring, RealClock())
