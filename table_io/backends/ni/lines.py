"""The digital inputs of an NI card, read one by one on demand: a task of their own."""

import contextlib
import os
from typing import Any

import numpy as np
from nidaqmx import GrpcSessionOptions, Task
from nidaqmx.constants import LineGrouping
from nidaqmx.errors import Error
from nidaqmx.stream_readers import DigitalMultiChannelReader

from table_io.backends import MachineLost
from table_io.backends.ni.channel import channel_to
from table_io.card import BadInput
from table_io.wiring.ni import NiWiring

READ_S = 1.0


class Lines:
    """The inputs that the card watches, or `some`; BadInput where the driver has not one of them.

    `channel` is a way to the server that is open already, and stays open.
    """

    def __init__(
        self, wiring: NiWiring, some: dict[str, str] | None = None, channel: Any = None
    ) -> None:
        watched = wiring.watched if some is None else some
        self._names = tuple(watched)
        self._own: Any = None  # a way to the server that ends with this
        if channel is None and wiring.endpoint:
            channel = self._own = channel_to(wiring.endpoint)
        self._task: Task | None = None
        name = f"shaketwin_{'watched' if some is None else 'well'}_{os.getpid()}"
        try:
            options = None if channel is None else GrpcSessionOptions(channel, name)
            self._task = Task(name, grpc_options=options)
            for line in watched.values():
                self._task.di_channels.add_di_chan(line, line_grouping=LineGrouping.CHAN_PER_LINE)
            self._reader = DigitalMultiChannelReader(self._task.in_stream)
            self._reader.verify_array_shape = False
            self.levels()
        except (Error, MachineLost) as error:
            self.close()
            raise BadInput(
                f"ni: cannot read {', '.join(watched.values())}: {_first(error)}; mend "
                "heartbeat_back and well in the machine card"
            ) from None

    def levels(self) -> dict[str, bool]:
        """Name -> level now; MachineLost where the driver does not say."""
        found = np.zeros(len(self._names), dtype=np.bool_)
        try:
            self._reader.read_one_sample_one_line(found, timeout=READ_S)
        except Error as error:
            raise MachineLost(f"the digital inputs are lost: {_first(error)}") from None
        return dict(zip(self._names, found.tolist(), strict=True))

    def close(self) -> None:
        """Let them go; safe to call twice."""
        task, self._task = self._task, None
        if task is not None:
            with contextlib.suppress(Error):
                task.close()
        if self._own is not None:
            self._own.close()
            self._own = None


def _first(error: Exception) -> str:
    """The driver's words in one line."""
    return next(iter(str(error).strip().splitlines()), type(error).__name__)
