"""Simulated UDP target with the simulated table, and its socket; `target.c` is the target in C.

The target takes received packets and the time, and returns what to send. The consequences of a
lost or misbehaving rig are in `table_io/sim/machine/table.py`.
"""

import contextlib
import json
import math
import select
import socket
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from table_io.backends.machine import protocol
from table_io.backends.machine.protocol import MachineMessage, text_message, values_message
from table_io.backends.udp.packets import (
    MAX_PIECES,
    RIG_PACKET_BYTES,
    RING_SAMPLES,
    VALUES_PER_PACKET,
    PacketKind,
    Phase,
    QueueVerdict,
    Reason,
    RigPacket,
    TargetState,
    UdpWiring,
    decode_rig_packet,
    encode_target_state,
    rig_checksum,
    sequence_difference,
)
from table_io.block import Float1D, Float2D
from table_io.clock import Clock
from table_io.errors import InputError
from table_io.sim.machine.table import SimulatedMachine, TableService
from table_io.sim.simulated_table import MIN_REPLACE_AHEAD_S

Address = tuple[str, int]
STATE_PERIOD_S = 0.02  # between states while there are no samples to send
HISTORY_SAMPLES = 1 << 13  # samples that can be resent
MAX_RESENT_PACKETS = 16  # packets resent for one request


class _StagedQueue:
    """Reassembly of the newest command from its pieces."""

    def __init__(self) -> None:
        self.number = 0
        self.verdict = QueueVerdict.PLAYS
        self.arrived = np.zeros(MAX_PIECES, dtype=np.bool_)
        self.volts = np.zeros(0)

    def put(self, packet: RigPacket) -> bool:
        """Add a piece and return True if it completes the command; ignore an invalid piece."""
        pieces = math.ceil(packet.samples / VALUES_PER_PACKET)
        size = min(VALUES_PER_PACKET, packet.samples - VALUES_PER_PACKET * packet.piece)
        if packet.samples > RING_SAMPLES or size < 1 or packet.values.size != size:
            return False
        if packet.queue > self.number:
            self.number, self.verdict = packet.queue, QueueVerdict.ARRIVING
            self.arrived[:] = False
            self.volts = np.full(packet.samples, np.nan)
        if packet.queue < self.number or self.verdict is not QueueVerdict.ARRIVING:
            return False
        if packet.samples != self.volts.size:
            return False
        self.arrived[packet.piece] = True
        first = VALUES_PER_PACKET * packet.piece
        self.volts[first : first + size] = packet.values
        return bool(self.arrived[:pieces].all())


class UdpTarget:
    """State machine of the target, for one rig at a time."""

    def __init__(self, table: SimulatedMachine) -> None:
        self._table = table
        self._channels = len(table.rig.sensors)
        self._outbox: list[tuple[TargetState, Address]] = []
        self._sequence = 0
        self._ignored_count = 0
        self._ended_session = 0  # previous session; a late claim of it may still arrive
        self._free()

    def _free(self) -> None:
        """Reset to the state FREE."""
        self._session = 0
        self._address: Address = ("", 0)
        self._phase, self._reason = Phase.FREE, Reason.NONE
        self._rate_hz = 0.0
        self._last_sequence = self._missed_count = 0  # of the rig's packets
        self._staged_queue = _StagedQueue()
        self._answer_due = False  # a packet of the rig awaits a state
        self._last_sent_s = -math.inf
        self._rest_from_s = 0.0
        self._restart()

    def _restart(self) -> None:
        """Clear the sample history and count samples from 0."""
        self._history = np.full((HISTORY_SAMPLES, self._channels), np.nan)
        self._received = self._sent = 0  # samples
        self._taken = 0

    def handle_packet(self, data: bytes, address: Address, now_s: float) -> None:
        """Handle received bytes; an invalid packet is counted and ignored."""
        packet = decode_rig_packet(data)
        if packet is None:
            self._ignored_count += 1
            return
        free = self._session == 0 and packet.session not in (0, self._ended_session)
        if free and packet.kind is PacketKind.CLAIM:
            self._claim(packet, address, now_s)
        elif packet.session != self._session or address != self._address:
            self._ignored_count += packet.session != 0
            has_rig = self._phase in (Phase.CLAIMED, Phase.RUNNING)
            self._reply(address, Reason.BUSY if has_rig else self._reason)
        else:
            self._handle_command(packet, now_s)

    def _claim(self, packet: RigPacket, address: Address, now_s: float) -> None:
        """Grant or refuse a claim."""
        rig = self._table.rig
        if packet.values.size != 7:
            self._ignored_count += 1
            return
        rate_hz, channels, checksum, mass_kg, *gaps = packet.values.tolist()
        refusal = Reason.NONE
        if rate_hz not in rig.rates_hz:
            refusal = Reason.RATE
        elif channels != self._channels:
            refusal = Reason.CHANNELS
        elif checksum not in (0, rig_checksum(rig)):
            refusal = Reason.CARD
        names = ("gap_mm", "gap_right_mm", "gap_left_mm")
        gap_values = {
            name: None if math.isnan(gap) else gap for name, gap in zip(names, gaps, strict=True)
        }
        claim = {
            "rate_hz": rate_hz,
            "specimen": {"mass_kg": mass_kg, **gap_values},
            "output": rig.output.model_dump(mode="json"),
            "sensors": [sensor.model_dump(mode="json") for sensor in rig.sensors],
        }
        try:
            if refusal is Reason.NONE:
                answer = self._table.handle_message(
                    text_message(protocol.MessageKind.CLAIM, json.dumps(claim)), now_s
                )[0]
                refusal = (
                    Reason.NONE if answer.kind is protocol.MessageKind.GRANTED else Reason.BUSY
                )
        except protocol.ProtocolError:
            refusal = Reason.CARD
        if refusal is not Reason.NONE:
            self._reply(address, refusal)
            return
        self._free()
        self._session, self._address, self._phase = packet.session, address, Phase.CLAIMED
        self._rate_hz, self._rest_from_s, self._last_sequence = rate_hz, now_s, packet.sequence
        self._answer_due = True

    def _handle_command(self, packet: RigPacket, now_s: float) -> None:
        """Handle a packet of the connected rig."""
        if (lead := sequence_difference(packet.sequence, self._last_sequence)) > 0:
            self._missed_count = (self._missed_count + lead - 1) & 0xFFFFFFFF
            self._last_sequence = packet.sequence
            if self._phase is not Phase.ENDING:  # a repeated old packet is no sign of life
                self._forward(MachineMessage(protocol.MessageKind.BEAT), now_s)
        self._answer_due |= packet.want_to == 0
        if packet.kind is PacketKind.QUEUE and self._phase is not Phase.ENDING:
            if self._staged_queue.put(packet):
                self._staged_queue.verdict = self._judge_queue(
                    packet.index, self._staged_queue.volts, now_s
                )
        elif packet.kind is PacketKind.START and self._phase is Phase.CLAIMED:
            self._phase = Phase.RUNNING
            self._restart()
            self._forward(MachineMessage(protocol.MessageKind.START), now_s)
        elif packet.kind is PacketKind.RELEASE and self._phase is not Phase.ENDING:
            self._phase, self._reason = Phase.ENDING, Reason.RELEASED
            self._forward(MachineMessage(protocol.MessageKind.RELEASE), now_s)
        last = min(packet.want_to, self._received)
        self._send_samples(
            max(packet.want_from, self._received - HISTORY_SAMPLES, 0), last, MAX_RESENT_PACKETS
        )

    def _judge_queue(self, index: int, volts: Float1D, now_s: float) -> QueueVerdict:
        """Accept or refuse a complete command and return the verdict."""
        # Same limits as in target.c.
        max_end = self._taken + RING_SAMPLES - 4 if self._phase is Phase.RUNNING else RING_SAMPLES
        max_volts = self._table.rig.output.span_v * (1.0 + 1e-9)
        if not (np.abs(volts) <= max_volts).all() or not 0 <= index <= max_end - volts.size:
            return QueueVerdict.NONSENSE
        answer = self._forward(values_message(protocol.MessageKind.QUEUE, volts, index), now_s)
        return (
            QueueVerdict.PLAYS if answer.kind is protocol.MessageKind.QUEUED else QueueVerdict.LATE
        )

    def _forward(self, message: MachineMessage, now_s: float) -> MachineMessage:
        """Pass a message to the table and return its answer, or the message if there is none."""
        answers = self._table.handle_message(message, now_s)
        return answers[0] if answers else message

    def tick(self, now_s: float) -> list[tuple[bytes, Address]]:
        """Play up to `now_s` and return the packets to send with their addresses."""
        for message in self._table.tick(now_s):
            if message.kind is protocol.MessageKind.TAKEN:
                self._store_samples(message.values.reshape(-1, self._channels))
            elif message.kind is protocol.MessageKind.LOST:
                self._start_ending(Reason.SILENCE)
        if self._phase is Phase.CLAIMED:
            self._record_rest(now_s)
        elif self._phase is Phase.RUNNING:
            self._taken = self._table.session.taken if self._table.session else self._received
        if self._session:
            has_rig = self._phase in (Phase.CLAIMED, Phase.RUNNING)
            self._sent += self._send_samples(self._sent, self._received if has_rig else 0)
            if self._answer_due or now_s - self._last_sent_s >= STATE_PERIOD_S:
                self._reply(self._address, self._reason)
            self._answer_due = False
            if any(address == self._address for _, address in self._outbox):
                self._last_sent_s = now_s
            if not self._table.is_claimed:
                self._ended_session = self._session
                self._free()
        out, self._outbox = self._outbox, []
        return [(self._encode(state), address) for state, address in out]

    def switch_off(self, now_s: float) -> None:
        """Drop the rig; the machine comes to rest."""
        if self._phase in (Phase.CLAIMED, Phase.RUNNING):
            self._table.drop_controller("the table is being switched off", now_s)
            self._start_ending(Reason.SWITCHED_OFF)

    def _start_ending(self, reason: Reason) -> None:
        self._phase, self._reason, self._answer_due = Phase.ENDING, reason, True

    def _record_rest(self, now_s: float) -> None:
        """Take the samples at rest that are due since the claim."""
        due = math.floor((now_s - self._rest_from_s) * self._rate_hz) + 1 - self._received
        if due > 0 and self._table.session is not None:
            self._store_samples(self._table.session.plant.tare(due).T)
            self._taken = self._received

    def _store_samples(self, rows: Float2D) -> None:
        """Add samples, volts (sample, channel), to the history."""
        at = np.arange(self._received, self._received + len(rows)) % HISTORY_SAMPLES
        self._history[at] = rows
        self._received += len(rows)

    def _send_samples(self, first: int, last: int, max_packets: int = 1 << 16) -> int:
        """Send samples first .. last - 1 in at most `max_packets`; return how many were sent."""
        step = VALUES_PER_PACKET // self._channels
        last = min(last, first + max_packets * step)
        for start in range(first, last, step):
            at = np.arange(start, min(start + step, last)) % HISTORY_SAMPLES
            state = self._make_state(self._reason, index=start, values=self._history[at].ravel())
            self._outbox.append((state, self._address))
        return max(last - first, 0)

    def _reply(self, address: Address, reason: Reason) -> None:
        is_rig = address == self._address
        state = self._make_state(reason)
        self._outbox.append((state if is_rig else replace(state, session=0), address))

    def _make_state(
        self, reason: Reason, index: int = 0, values: Float1D | None = None
    ) -> TargetState:
        """Return the present state, with samples from `index` on, (sample * channel,)."""
        return TargetState(
            phase=self._phase,
            reason=reason,
            session=self._session,
            index=index,
            taken=self._taken,
            oldest=max(self._received - HISTORY_SAMPLES, 0),
            queue=self._staged_queue.number,
            verdict=self._staged_queue.verdict,
            channels=self._channels,
            least_ahead=round(MIN_REPLACE_AHEAD_S * (self._rate_hz or self._table.rig.rates_hz[0])),
            ignored=self._ignored_count & 0xFFFFFFFF,
            missed=self._missed_count,
            rate_hz=self._rate_hz,
            arrived=np.packbits(self._staged_queue.arrived, bitorder="little").tobytes(),
            values=np.empty(0) if values is None else values,
        )

    def _encode(self, state: TargetState) -> bytes:
        self._sequence = (self._sequence + 1) & 0xFFFFFFFF
        return encode_target_state(replace(state, sequence=self._sequence))


TICK_S = 0.004  # of real time, between two updates of the plant
IDLE_TICK_S = 0.1  # the same while no rig has claimed the machine
MAX_PACKETS_PER_TICK = 256  # received between two updates
BUFFER_BYTES = 1 << 20


def bind_socket(address: Address) -> socket.socket:
    """Return a socket bound to this address only; InputError if that fails."""
    server_socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        server_socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
        server_socket.setblocking(False)
        server_socket.bind(address)
    except OSError as error:
        server_socket.close()
        raise InputError(
            f"cannot listen there: {error.strerror or error}",
            key="udp.target",
            value=f"{address[0]}:{address[1]}",
            remedy="end another target that listens there, or give an address of this computer "
            "and a free port",
        ) from None
    return server_socket


def serve_udp_table(service: TableService) -> None:
    """Serve the target of a rig file."""
    wiring = service.rig.require_section("udp", UdpWiring)
    with contextlib.closing(bind_socket(wiring.address)) as server_socket:
        machine = service.make_machine()
        service.begin(wiring.target)
        serve_udp_target(server_socket, machine, service.clock, service.keep_running)


def serve_udp_target(
    server_socket: socket.socket,
    table: SimulatedMachine,
    clock: Clock,
    keep_running: Callable[[], bool],
) -> None:
    """Serve the target while `keep_running()`, and until the table is at rest."""
    target = UdpTarget(table)
    while (running := keep_running()) or table.moving:
        if not running:
            target.switch_off(clock.now())
        select.select([server_socket], [], [], TICK_S if table.is_claimed else IDLE_TICK_S)
        with contextlib.suppress(BlockingIOError):
            for _ in range(MAX_PACKETS_PER_TICK):
                data, address = server_socket.recvfrom(RIG_PACKET_BYTES + 1)
                target.handle_packet(data, address, clock.now())
        for data, address in target.tick(clock.now()):
            with contextlib.suppress(OSError):  # treated as a lost packet
                server_socket.sendto(data, address)
