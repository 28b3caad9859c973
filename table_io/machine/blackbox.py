"""The machine's black box: what it was told, what it played, what the plant did, sample by sample.

A file of wire messages, written as they happen and never held back, so it outlives any process:
LIFE opens a life, STARTED tells its time, QUEUE is every accepted command, PLAYED the samples,
NOTE what else happened.
"""

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from table_io.backends.plant import SIGNALS
from table_io.block import Float1D, Float2D
from table_io.card import BadInput
from table_io.machine.queued import Queued
from table_io.machine.wire import Garbage, Kind, Message, Parser, carry, encode, say

FIELDS = ("command_m", *SIGNALS)  # of a sample, SI: as the converter played it, and the plant


class BlackBox:
    """Writes a new file; BadInput where it exists or cannot be made.

    Where it cannot go on it says so and is silent: the machine must not stop for it.
    """

    def __init__(self, path: Path, tell: Callable[[str], None]) -> None:
        self._path = path
        self._tell = tell
        try:
            self._file = path.open("xb", buffering=0)
        except FileExistsError:
            raise BadInput(f"--log {path}: exists; nothing is overwritten, name another") from None
        except OSError as error:
            raise BadInput(f"--log {path}: cannot write it: {error.strerror}") from None

    def life(self, rate_hz: float, volts_per_m: float) -> None:
        """A controller has the machine, at this sample rate and with this scale of the command."""
        told = {"rate_hz": rate_hz, "volts_per_m": volts_per_m}
        self._write(say(Kind.LIFE, json.dumps(told)))

    def started(self, epoch_s: float) -> None:
        """Time of sample 0 on the monotonic clock."""
        self._write(carry(Kind.STARTED, np.array([epoch_s])))

    def queued(self, index: int, volts: Float1D) -> None:
        """A command that was accepted, in V, (sample,)."""
        self._write(carry(Kind.QUEUE, volts, index))

    def played(self, index: int, command_m: Float1D, signals: Float2D) -> None:
        """Samples that were played: command, (sample,), and SIGNALS, (6, sample)."""
        self._write(carry(Kind.PLAYED, np.vstack([command_m, signals]).T, index))

    def note(self, index: int, text: str) -> None:
        """Something that happened."""
        self._write(say(Kind.NOTE, text, index))

    def close(self) -> None:
        self._file.close()

    def _write(self, message: Message) -> None:
        if self._file.closed:
            return
        try:
            self._file.write(encode(message))
        except OSError as error:
            self._file.close()
            self._tell(f"--log {self._path}: the black box ends here: {error.strerror}")


@dataclass
class Life:
    """One controller's life on the machine, until rest."""

    rate_hz: float
    volts_per_m: float
    epoch_s: float = math.nan
    samples: Float2D = field(default_factory=lambda: np.empty((len(FIELDS), 0)))  # (field, sample)
    notes: list[tuple[int, str]] = field(default_factory=list)
    missing: int = 0  # samples that should be there and are not
    queued: Queued = field(default_factory=Queued)

    def row(self, name: str) -> Float1D:
        """One of FIELDS, (sample,)."""
        line: Float1D = self.samples[FIELDS.index(name)]
        return line

    @property
    def command_m(self) -> Float1D:
        """The command as it was accepted, before the converter, m, (sample,)."""
        return self.queued.take(0, self.samples.shape[1]) / self.volts_per_m


def read_box(path: Path) -> list[Life]:
    """Every life in a black box, also in one that is cut off."""
    lives: list[Life] = []
    pieces: list[list[Float2D]] = []
    for message in _messages(path):
        if message.kind is Kind.LIFE:
            lives.append(Life(**message.json))
            pieces.append([])
        elif message.kind is Kind.STARTED:
            lives[-1].epoch_s = float(message.values[0])
        elif message.kind is Kind.QUEUE:
            lives[-1].queued.put(message.index, message.values)
        elif message.kind is Kind.NOTE:
            lives[-1].notes.append((message.index, message.text))
        elif message.kind is Kind.PLAYED:
            piece = message.values.reshape(-1, len(FIELDS)).T
            lives[-1].missing += abs(message.index - sum(p.shape[1] for p in pieces[-1]))
            pieces[-1].append(piece)
    for life, parts in zip(lives, pieces, strict=True):
        if parts:
            life.samples = np.concatenate(parts, axis=1)
    return lives


def _messages(path: Path) -> list[Message]:
    parser = Parser()
    try:
        return parser.feed(path.read_bytes())
    except Garbage:
        raise BadInput(f"{path}: no black box of a table; give the file of --log") from None
