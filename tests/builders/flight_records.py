"""Reader of the flight records that `shaketwin table --log` writes."""

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from table_io.backends.command_buffer import CommandBuffer
from table_io.backends.machine.protocol import (
    MachineMessage,
    MessageKind,
    MessageParser,
    ProtocolError,
)
from table_io.block import Float1D, Float2D
from table_io.errors import InputError
from table_io.sim.machine.flight_recorder import RECORDED_FIELDS


@dataclass
class RecordedSession:
    """Recording of one controller's connection, until rest."""

    rate_hz: float
    volts_per_m: float
    epoch_s: float = math.nan
    # (field, sample)
    samples: Float2D = field(default_factory=lambda: np.empty((len(RECORDED_FIELDS), 0)))
    notes: list[tuple[int, str]] = field(default_factory=list)
    missing: int = 0  # samples
    queued: CommandBuffer = field(default_factory=CommandBuffer)

    def row(self, name: str) -> Float1D:
        """Return one of RECORDED_FIELDS, (sample,)."""
        line: Float1D = self.samples[RECORDED_FIELDS.index(name)]
        return line

    @property
    def command_m(self) -> Float1D:
        """Command as accepted, before the converter, in m, (sample,)."""
        return self.queued.values(0, self.samples.shape[1]) / self.volts_per_m


def read_flight_record(path: Path) -> list[RecordedSession]:
    """Read the sessions of a flight record, also of a truncated one."""
    sessions: list[RecordedSession] = []
    session_chunks: list[list[Float2D]] = []
    for message in _parse_messages(path):
        if message.kind is MessageKind.SESSION:
            sessions.append(RecordedSession(**message.json))
            session_chunks.append([])
        elif message.kind is MessageKind.STARTED:
            sessions[-1].epoch_s = float(message.values[0])
        elif message.kind is MessageKind.QUEUE:
            sessions[-1].queued.replace_from(message.index, message.values)
        elif message.kind is MessageKind.NOTE:
            sessions[-1].notes.append((message.index, message.text))
        elif message.kind is MessageKind.PLAYED:
            chunk = message.values.reshape(-1, len(RECORDED_FIELDS)).T
            sessions[-1].missing += abs(
                message.index - sum(part.shape[1] for part in session_chunks[-1])
            )
            session_chunks[-1].append(chunk)
    for session, chunks in zip(sessions, session_chunks, strict=True):
        if chunks:
            session.samples = np.concatenate(chunks, axis=1)
    return sessions


def _parse_messages(path: Path) -> list[MachineMessage]:
    parser = MessageParser()
    try:
        return parser.feed(path.read_bytes())
    except ProtocolError:
        raise InputError(
            "not a flight record of a table",
            where=path,
            remedy="give a file written by shaketwin table --log",
        ) from None
