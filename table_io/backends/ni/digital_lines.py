"""Digital inputs of an NI rig in a DAQmx task of their own, read on demand."""

import contextlib
import os
from typing import Any

import numpy as np
from nidaqmx import GrpcSessionOptions, Task
from nidaqmx.constants import LineGrouping
from nidaqmx.errors import Error
from nidaqmx.stream_readers import DigitalMultiChannelReader

from table_io.backends import MachineLost
from table_io.backends.ni.channel import open_channel
from table_io.backends.ni.config import NiWiring
from table_io.errors import InputError

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
