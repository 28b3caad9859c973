"""A task of a DAQmx driver as a model: what it is told, its buffer, its clock, its errors."""

import math
from dataclasses import dataclass, field
from enum import IntEnum

from table_io.block import Float2D
from table_io.machine.queued import Queued

ONBOARD, LEAST_S = 8191, 0.02  # samples of a FIFO, and what it cannot be brought below
FULL, EMPTY = 10242, 10235  # DAQmx: conditions of a transfer to the device
FIRST_SAMPLE, CURRENT = 10424, 10430  # DAQmx: what a write is relative to


class Code(IntEnum):
    """What the driver calls the errors that the model has by itself."""

    RESERVED = -50103
    INVALID_VALUE = -200077
    INVALID_TASK = -200088
    NO_SUCH_CHANNEL = -200170
    NO_LONGER_AVAILABLE = -200279
    NOT_YET_AVAILABLE = -200284
    NEGATIVE_WRITE = -200287
    NO_LONGER_WRITEABLE = -200289
    STOPPED_TO_PREVENT_REGENERATION = -200290
    NOT_YET_WRITEABLE = -200292
    NO_MORE_SPACE = -200293
    NOT_ENOUGH_WRITTEN = -200294
    NOT_SUPPORTED = -200452
    NO_CHANNELS = -200478


class DriverError(Exception):
    """An error of the driver, by its code."""

    def __init__(self, code: int, about: str = "") -> None:
        super().__init__(f"driver error {code}")
        self.code = code
        self.about = about  # lines of the driver's words, as "Physical Channel Name: Dev1/ai0"


@dataclass(slots=True, eq=False)
class Task:
    """A task and its session; `kind` is ai, ao or do, or empty while it has no channel."""

    name: str
    number: int
    kind: str = ""
    channels: list[str] = field(default_factory=list)
    rate_hz: float = 0.0
    buffer: int = 0
    trigger: str = ""
    clock: str = ""
    regenerates: bool = True
    relative_to: int = CURRENT
    offset: int = 0
    condition: int = FULL
    onboard: int = ONBOARD
    reserved: bool = False
    running: bool = False
    armed: bool = False  # started, and waits for its trigger
    error: int = 0  # that ended it
    since_s: float = 0.0  # time of its sample 0
    volts: Queued = field(default_factory=Queued)  # output
    written: int = 0  # samples of output: where the next write begins that is not placed
    transferred: int = 0
    come: list[Float2D] = field(default_factory=list)  # input that was not read
    unread: int = 0
    total: int = 0  # samples of input that have come

    @property
    def held(self) -> int:
        """Samples of output that the device takes in advance."""
        least = math.ceil(LEAST_S * self.rate_hz)
        most = max(self.onboard, least)
        return least if self.condition == EMPTY else most

    def due(self, now: float) -> int:
        """Samples that its clock has ticked by now."""
        return math.floor((now - self.since_s) * self.rate_hz + 1e-6) + 1 if self.running else 0

    def generated(self, now: float) -> int:
        return min(self.due(now), self.transferred)
