"""Model of a DAQmx task: configuration, buffer, clock, errors."""

import math
from dataclasses import dataclass, field
from enum import IntEnum

from table_io.backends.command_buffer import CommandBuffer
from table_io.block import Float2D

DEFAULT_FIFO_SAMPLES = 8191
MIN_ONBOARD_S = 0.02  # smallest onboard buffer
WHEN_NOT_FULL, WHEN_EMPTY = 10242, 10235  # DAQmx: condition of a transfer to the device
FIRST_SAMPLE, CURRENT_POSITION = 10424, 10430  # DAQmx: reference of the write offset


class ErrorCode(IntEnum):
    """DAQmx codes of the errors that the model raises."""

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
    """Error of the driver, with its DAQmx code."""

    def __init__(self, code: int, details: str = "") -> None:
        super().__init__(f"driver error {code}")
        self.code = code
        self.details = details  # further lines of the message, as "Physical Channel Name: Dev1/ai0"


@dataclass(slots=True, eq=False)
class Task:
    """Task and its session; `kind` is ai, ao, di or do, empty while it has no channel."""

    name: str
    number: int
    kind: str = ""
    channels: list[str] = field(default_factory=list)
    rate_hz: float = 0.0
    buffer: int = 0
    trigger: str = ""
    clock: str = ""
    regenerates: bool = True
    relative_to: int = CURRENT_POSITION
    offset: int = 0
    transfer_condition: int = WHEN_NOT_FULL
    fifo_samples: int = DEFAULT_FIFO_SAMPLES
    reserved: bool = False
    running: bool = False
    armed: bool = False  # started, waiting for its trigger
    error: int = 0  # code of the error that ended it; 0: none
    since_s: float = 0.0  # time of sample 0
    volts: CommandBuffer = field(default_factory=CommandBuffer)  # output
    written: int = 0  # samples of output; an appended write begins here
    transferred: int = 0
    unread_blocks: list[Float2D] = field(default_factory=list)  # input not read, (channel, sample)
    unread: int = 0
    total: int = 0  # samples of input acquired

    @property
    def onboard_samples(self) -> int:
        """Samples of output that the device holds in advance."""
        min_samples = math.ceil(MIN_ONBOARD_S * self.rate_hz)
        max_samples = max(self.fifo_samples, min_samples)
        return min_samples if self.transfer_condition == WHEN_EMPTY else max_samples

    def due_samples(self, now_s: float) -> int:
        """Return the number of ticks of the sample clock up to `now_s`."""
        return math.floor((now_s - self.since_s) * self.rate_hz + 1e-6) + 1 if self.running else 0

    def generated_samples(self, now_s: float) -> int:
        return min(self.due_samples(now_s), self.transferred)
