"""Flight recorder of the machine: accepted commands, played command and plant, every sample.

The file consists of wire messages, written unbuffered so that it survives any process: SESSION
begins a session, STARTED is its time of sample 0, QUEUE an accepted command, PLAYED the samples,
NOTE any other event.
"""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from table_io.backends.machine.protocol import (
    MachineMessage,
    MessageKind,
    encode_message,
    text_message,
    values_message,
)
from table_io.block import Float1D, Float2D
from table_io.errors import InputError
from table_io.sim.plant import RECORDED_SIGNALS

# Of each sample, SI: the command as the converter played it, and the plant.
RECORDED_FIELDS = ("command_m", *RECORDED_SIGNALS)


class FlightRecorder:
    """Writer of a new file; InputError if it exists or cannot be created.

    A later write error is reported once and ends the recording, but does not stop the machine.
    """

    def __init__(self, path: Path, notify: Callable[[str], None]) -> None:
        self._path = path
        self._notify = notify
        try:
            self._file = path.open("xb", buffering=0)
        except FileExistsError:
            raise InputError(
                "the file exists and will not be overwritten",
                where=f"--log {path}",
                remedy="give the name of a new file",
            ) from None
        except OSError as error:
            raise InputError(f"cannot write: {error.strerror}", where=f"--log {path}") from None

    def begin_session(self, rate_hz: float, volts_per_m: float) -> None:
        """Record that a controller has claimed the machine, with sample rate and command scale."""
        header = {"rate_hz": rate_hz, "volts_per_m": volts_per_m}
        self._write(text_message(MessageKind.SESSION, json.dumps(header)))

    def record_start(self, epoch_s: float) -> None:
        """Record the time of sample 0 on the monotonic clock, in s."""
        self._write(values_message(MessageKind.STARTED, np.array([epoch_s])))

    def record_command(self, index: int, volts: Float1D) -> None:
        """Record an accepted command in V, (sample,)."""
        self._write(values_message(MessageKind.QUEUE, volts, index))

    def record_samples(self, index: int, command_m: Float1D, signals: Float2D) -> None:
        """Record played samples: command in m, (sample,), and RECORDED_SIGNALS, (6, sample)."""
        self._write(values_message(MessageKind.PLAYED, np.vstack([command_m, signals]).T, index))

    def note(self, index: int, text: str) -> None:
        """Record an event at sample `index`."""
        self._write(text_message(MessageKind.NOTE, text, index))

    def close(self) -> None:
        self._file.close()

    def _write(self, message: MachineMessage) -> None:
        if self._file.closed:
            return
        try:
            self._file.write(encode_message(message))
        except OSError as error:
            self._file.close()
            self._notify(f"--log {self._path}: the flight recording ends here: {error.strerror}")
