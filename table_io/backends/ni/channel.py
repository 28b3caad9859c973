"""The way to NI's gRPC Device Server: a channel none of whose calls waits for ever."""

from collections.abc import Callable
from typing import Any

import grpc

from table_io.card import BadInput
from table_io.rig import Rig

ANSWER_S = 2.0  # that a call may take, with what it waits for samples
REACH_S = 2.0  # until somebody answers
MOST_BYTES = 64 << 20


class Bounded:
    """A channel whose calls end after a time: the client's own ask for none."""

    def __init__(self, channel: Any, seconds: float) -> None:
        self._channel = channel
        self._seconds = seconds

    def unary_unary(self, *args: Any, **named: Any) -> Callable[..., Any]:
        call = self._channel.unary_unary(*args, **named)
        seconds = self._seconds

        def bounded(request: Any, metadata: Any = None) -> Any:
            return call(request, timeout=seconds, metadata=metadata)

        return bounded

    def __getattr__(self, name: str) -> Any:
        return getattr(self._channel, name)


def channel_to(endpoint: str) -> Any:
    """An open way to HOST:PORT, none of whose calls waits for ever; nothing is sent yet."""
    options = (
        ("grpc.enable_http_proxy", 0),
        ("grpc.max_send_message_length", MOST_BYTES),
        ("grpc.max_receive_message_length", MOST_BYTES),
    )
    return Bounded(grpc.insecure_channel(endpoint, options=options), ANSWER_S)


def reached(rig: Rig, endpoint: str) -> Any:
    """A channel to a server that answers; BadInput says how to start one."""
    channel = channel_to(endpoint)
    try:
        grpc.channel_ready_future(channel).result(timeout=REACH_S)
    except grpc.FutureTimeoutError:
        channel.close()
        desk = f", in another terminal: shaketwin table --rig {rig.name}" if rig.simulated else ""
        raise BadInput(
            f"no NI gRPC Device Server answers at {endpoint}; start it there{desk}"
        ) from None
    return channel
