"""What the machine is made of: messages, the queue, landings, endpoints."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from table_io.backends.command_buffer import CommandBuffer, can_hold, plan_stop
from table_io.backends.machine.protocol import (
    HEADER,
    MAX_PAYLOAD_BYTES,
    MachineMessage,
    MessageKind,
    MessageParser,
    ProtocolError,
    encode_message,
    parse_endpoint,
)
from tests.input_errors import raises_input_error

RATE_HZ = 2000.0


@given(st.lists(st.binary(max_size=40), max_size=5), st.integers(1, 30))
def test_messages_survive_any_cut(payloads: list[bytes], cut: int) -> None:
    sent = [MachineMessage(MessageKind.NOTE, k - 2, payload) for k, payload in enumerate(payloads)]
    stream = b"".join(encode_message(message) for message in sent)
    parser = MessageParser()
    pieces = [stream[i : i + cut] for i in range(0, len(stream), cut)]
    assert [message for piece in pieces for message in parser.feed(piece)] == sent


@pytest.mark.parametrize(
    "data",
    [
        b"GET / HTTP/1.1\r\nHost: table\r\n\r\n",
        HEADER.pack(b"STM1", 99, 0, 0),
        HEADER.pack(b"STM1", MessageKind.QUEUE, MAX_PAYLOAD_BYTES + 1, 0),
        b"\0" * 20,
        HEADER.pack(b"STM2", MessageKind.BEAT, 0, 0),
    ],
)
def test_invalid_message_is_refused_at_once(data: bytes) -> None:
    with pytest.raises(ProtocolError):
        MessageParser().feed(data)


@given(
    st.lists(
        st.tuples(st.integers(0, 60), st.lists(st.floats(-9, 9), min_size=1, max_size=20)),
        max_size=6,
    )
)
def test_buffer_holds_the_last_command(puts: list[tuple[int, list[float]]]) -> None:
    queued, plain = CommandBuffer(), np.zeros(200)
    for index, values in puts:
        queued.replace_from(index, np.array(values))
        plain[index:] = [*values, *[values[-1]] * 200][: 200 - index]
        before = plain[max(index - 1, 0)] if index else 0.0
        assert queued.values(index - 1, index)[0] == before
        assert queued.end == index + len(values)
    np.testing.assert_array_equal(queued.values(-5, 200), np.pad(plain, (5, 0)))
    queued.discard_before(50)
    np.testing.assert_array_equal(queued.values(50, 200), plain[50:])


@pytest.mark.parametrize("f", [0.5, 1.3, 4.0, 10.0])
@pytest.mark.parametrize("turn", np.arange(8) / 8)
def test_landing_goes_on_smoothly_and_ends_at_rest(f: float, turn: float) -> None:
    a = 0.4903
    t = turn / f + np.arange(-400, 1) / RATE_HZ
    motion = a / (2 * np.pi * f) ** 2 * np.sin(2 * np.pi * f * t)
    landed = plan_stop(motion[-3:], RATE_HZ)
    whole = np.concatenate([motion, landed, np.zeros(3)])
    assert np.abs(np.diff(whole, 2)).max() * RATE_HZ**2 <= 1.06 * max(a, 0.5)
    jerk = np.abs(np.diff(whole, 3)).max() * RATE_HZ**3
    assert jerk <= 60 * a * max(f, 1.0)  # no jump: one of 1 % of a would be 10 A a millisecond
    assert can_hold(whole[-5:-3], RATE_HZ)
    assert np.abs(whole).max() <= 1.6 * a / (2 * np.pi * f) ** 2 + 0.05 * a


SPAN_M = 0.06


@pytest.mark.parametrize(
    ("size_m", "f", "most"),  # times the acceleration of the motion, or 0.5 m/s2
    [(0.05, 0.8, 1.1), (0.05, 1.0, 1.1), (0.05, 1.5, 1.1), (0.012, 4.0, 1.1), (0.0599, 0.5, 1.2)],
)
def test_landing_from_a_large_motion_stays_within_the_span(
    size_m: float, f: float, most: float
) -> None:
    for turn in np.arange(32) / 32:
        t = turn / f + np.arange(-3, 1) / RATE_HZ
        motion = size_m * np.sin(2 * np.pi * f * t)
        whole = np.concatenate([motion, plan_stop(motion[-3:], RATE_HZ, SPAN_M), np.zeros(3)])
        assert np.abs(whole).max() <= SPAN_M
        own = max(size_m * (2 * np.pi * f) ** 2, 0.5)
        assert np.abs(np.diff(whole, 2)).max() * RATE_HZ**2 <= most * own


@pytest.mark.parametrize("x", [0.0599, 0.06, 0.07, -0.06])
@pytest.mark.parametrize("v", [0.1, 3.0, -0.4])
def test_landing_beyond_the_span_stops_dead(x: float, v: float) -> None:
    landed = plan_stop(x + v / RATE_HZ * np.array([-2.0, -1.0, 0.0]), RATE_HZ, SPAN_M)
    assert np.abs(landed).max() <= max(abs(x), SPAN_M)
    assert landed[-1] == 0.0
    if x * v > 0:
        assert np.abs(np.diff(landed, 2)).max() * RATE_HZ**2 <= 0.5


@pytest.mark.parametrize("x", [1e100, 20.0])
def test_landing_ends_for_any_number(x: float) -> None:
    landed = plan_stop(np.array([0.0, 0.0, x]), RATE_HZ, SPAN_M)
    assert np.abs(landed).max() <= x
    assert landed[-1] == 0.0


@pytest.mark.parametrize(
    "text",
    [
        "tcp/0.0.0.0:7450",
        "tcp/192.168.1.5:7450",
        "tcp/:7450",
        "tcp/127.0.0.1",
        "tcp/127.0.0.1:99999",
        "udp/127.0.0.1:1",
        "unix/",
    ],
)
def test_endpoint_stays_on_this_computer(text: str) -> None:
    with raises_input_error(key="endpoint", value=text, allowed="tcp/127.0.0.1:PORT"):
        parse_endpoint(text)
