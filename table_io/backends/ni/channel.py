"""gRPC channel to NI's Device Server, with a deadline on every call."""

from collections.abc import Callable
from typing import Any

import grpc

from table_io.config.rig import RigConfig
from table_io.errors import InputError

CALL_TIMEOUT_S = 2.0  # of a call, including its wait for samples
CONNECT_TIMEOUT_S = 2.0
MAX_MESSAGE_BYTES = 64 << 20


class DeadlineChannel:
    """Channel that adds a deadline to every call: NI's client sets none."""

    def __init__(self, channel: Any, timeout_s: float) -> None:
        self._channel = channel
        self._timeout_s = timeout_s

    def unary_unary(self, *args: Any, **named: Any) -> Callable[..., Any]:
        call = self._channel.unary_unary(*args, **named)
        timeout_s = self._timeout_s

        def call_with_deadline(request: Any, metadata: Any = None) -> Any:
            return call(request, timeout=timeout_s, metadata=metadata)

        return call_with_deadline

    def __getattr__(self, name: str) -> Any:
        return getattr(self._channel, name)


def open_channel(endpoint: str) -> Any:
    """Return a channel to HOST:PORT with a deadline on every call; nothing is sent yet."""
    options = (
        ("grpc.enable_http_proxy", 0),
        ("grpc.max_send_message_length", MAX_MESSAGE_BYTES),
        ("grpc.max_receive_message_length", MAX_MESSAGE_BYTES),
    )
    return DeadlineChannel(grpc.insecure_channel(endpoint, options=options), CALL_TIMEOUT_S)


def connect_server(rig: RigConfig, endpoint: str) -> Any:
    """Return a channel to a server that answers; InputError with the remedy if none does."""
    channel = open_channel(endpoint)
    try:
        grpc.channel_ready_future(channel).result(timeout=CONNECT_TIMEOUT_S)
    except grpc.FutureTimeoutError:
        channel.close()
        hint = (
            f", in another terminal: shaketwin table --rig {rig.name}" if rig.is_simulated else ""
        )
        raise InputError(
            f"no NI gRPC Device Server answers at {endpoint}", remedy=f"start it there{hint}"
        ) from None
    return channel
