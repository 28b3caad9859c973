"""The bytes of the two packets, and what crosses the wire in pieces."""

import itertools
import re
import struct
import zlib
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from table_io.backends import udp
from table_io.backends.udp.backend import (
    CLOCK_WINDOW_S,
    RESEND_S,
    WINDOW_PIECES,
    ClockOffset,
    CommandTransfer,
    ReceiveBuffer,
)
from table_io.backends.udp.packets import (
    MAX_PIECES,
    RIG_HEADER,
    RIG_PACKET_BYTES,
    RING_SAMPLES,
    TARGET_HEADER,
    TARGET_PACKET_BYTES,
    VALUES_PER_PACKET,
    PacketKind,
    Phase,
    QueueVerdict,
    Reason,
    RigPacket,
    TargetState,
    decode_rig_packet,
    decode_target_state,
    encode_rig_packet,
    encode_target_state,
)

RATE_HZ = 2000.0
U32 = st.integers(0, 2**32 - 1)
U64 = st.integers(0, 2**64 - 1)
I64 = st.integers(-(2**63), 2**63 - 1)
VOLTS = st.lists(st.floats(width=64), max_size=VALUES_PER_PACKET).map(np.array)
WORDS = st.builds(
    RigPacket, st.sampled_from(PacketKind), U64, U32, I64, U32, U32, U32, I64, I64, VOLTS
)
STATES = st.builds(
    TargetState, st.sampled_from(Phase), st.sampled_from(Reason), U64, U32, I64, I64, I64, U32,
    st.sampled_from(QueueVerdict), U32, U32, U32, U32, st.floats(allow_nan=False),
    st.binary(min_size=64, max_size=64), VOLTS,
)  # fmt: skip


def same(packet: RigPacket | TargetState, other: RigPacket | TargetState | None) -> bool:
    """True where every field is the same, NaN included."""
    return other is not None and all(
        np.array_equal(getattr(packet, f.name), getattr(other, f.name), equal_nan=True)
        if f.name == "values"
        else getattr(packet, f.name) == getattr(other, f.name)
        for f in fields(packet)
    )


@given(WORDS)
def test_word_comes_back_as_it_was(word: RigPacket) -> None:
    packet = encode_rig_packet(word)
    assert len(packet) == RIG_PACKET_BYTES == 1092
    assert same(word, decode_rig_packet(packet))
    assert decode_target_state(packet) is None


@given(STATES)
def test_state_comes_back_as_it_was(state: TargetState) -> None:
    packet = encode_target_state(state)
    assert len(packet) == TARGET_PACKET_BYTES == 1172
    assert same(state, decode_target_state(packet))
    assert decode_rig_packet(packet) is None


@given(WORDS, STATES, st.data())
def test_packet_with_a_spoilt_byte_is_none(
    word: RigPacket, state: TargetState, data: st.DataObject
) -> None:
    for packet, decode in (
        (encode_rig_packet(word), decode_rig_packet),
        (encode_target_state(state), decode_target_state),
    ):
        at = data.draw(st.integers(0, len(packet) - 1))
        flipped = packet[at] ^ data.draw(st.integers(1, 255))
        assert decode(packet[:at] + bytes([flipped]) + packet[at + 1 :]) is None
        assert decode(packet[:-1]) is None
        assert decode(packet + b"\0") is None


def test_unknown_version_and_kind_are_ignored() -> None:
    for at, value in ((4, 2), (6, 6), (20, VALUES_PER_PACKET + 1)):
        body = bytearray(encode_rig_packet(RigPacket(PacketKind.BEAT)))[:-4]
        body[at] = value
        assert decode_rig_packet(bytes(body) + struct.pack("<I", zlib.crc32(body))) is None


def test_document_states_the_offset_of_every_field() -> None:
    """PACKETS.md has a row `offset | type | name` for each field of the two headers, in order."""
    text = (Path(udp.__file__).parent / "PACKETS.md").read_text()
    sizes = {"u8": 1, "u16": 2, "u32": 4, "u64": 8, "i64": 8, "f64": 8}
    for title, layout, total in (
        ("## Rig to target", RIG_HEADER, RIG_PACKET_BYTES),
        ("## Target to rig", TARGET_HEADER, TARGET_PACKET_BYTES),
    ):
        section = text.split(title)[1].split("\n## ")[0]
        rows = re.findall(r"^\| (\d+) \| ([a-z0-9]+)(?:\[(\d+)\])? \|", section, re.M)
        at = 0
        for offset, kind, count in rows:
            assert int(offset) == at
            at += sizes[kind] * int(count or 1)
        assert at == total
        assert str(layout.size) in [offset for offset, _, _ in rows], "where the values begin"


@given(st.lists(st.integers(1, 20), min_size=1, max_size=30), st.randoms(use_true_random=False))
def test_samples_in_any_order_keep_their_place(cuts: list[int], chance) -> None:
    whole = np.arange(2.0 * sum(cuts)).reshape(-1, 2).T
    edges = np.cumsum([0, *cuts])
    pieces = [(int(a), whole[:, a:b]) for a, b in itertools.pairwise(edges)]
    pieces += chance.sample(pieces, len(pieces) // 2)  # some twice
    chance.shuffle(pieces)
    arriving, taken, arrived = ReceiveBuffer(2), [], set[int]()
    for index, values in pieces:
        arriving.put(index, values)
        arrived |= set(range(index, index + values.shape[1]))
        missing = [i for i in range(max(arrived)) if i not in arrived]
        assert arriving.complete == (missing[0] if missing else max(arrived) + 1)
        if missing:
            known = next(i for i in range(missing[0], max(arrived) + 1) if i in arrived)
            assert arriving.missing == (missing[0], known)
        taken.append(arriving.take((arriving.complete - arriving.first) // 2))
    taken.append(arriving.take(sum(cuts) - arriving.first))
    np.testing.assert_array_equal(np.concatenate(taken, axis=1), whole)


def test_samples_given_up_are_nan() -> None:
    arriving = ReceiveBuffer(1)
    arriving.put(0, np.zeros((1, 5)))
    arriving.put(8, np.zeros((1, 2)))
    arriving.give_up(8)
    arriving.put(5, np.ones((1, 3)))
    assert arriving.complete == 10
    assert np.isnan(arriving.take(10)[0]).nonzero()[0].tolist() == [5, 6, 7]
    arriving.give_up(4)
    assert arriving.complete == 10


def test_samples_far_beyond_any_sense_are_not_kept() -> None:
    arriving = ReceiveBuffer(1)
    arriving.put(1 << 40, np.zeros((1, 5)))
    assert arriving.end == 0


def test_command_transfer_resends_within_a_window() -> None:
    volts = np.arange(float(VALUES_PER_PACKET * 40 + 3))
    delivery = CommandTransfer(volts)
    first = delivery.pop_due(0.0)
    assert [piece for piece, _ in first] == list(range(WINDOW_PIECES))
    assert delivery.pop_due(0.5 * RESEND_S) == []
    confirmed = np.zeros(MAX_PIECES, dtype=np.bool_)
    confirmed[[0, 2, 3]] = True
    delivery.confirm(confirmed)
    assert [piece for piece, _ in delivery.pop_due(0.6 * RESEND_S)] == [32, 33, 34]
    again = delivery.pop_due(1.1 * RESEND_S)
    assert [piece for piece, _ in again][:3] == [1, 4, 5]
    for piece, values in first:
        np.testing.assert_array_equal(
            values, volts[VALUES_PER_PACKET * piece : VALUES_PER_PACKET * (piece + 1)]
        )
    confirmed[:40] = True
    delivery.confirm(confirmed)
    ((piece, values),) = delivery.pop_due(9.0)
    assert (piece, values.tolist()) == (40, volts[-3:].tolist())
    assert CommandTransfer(np.zeros(RING_SAMPLES)).arrived.size == MAX_PIECES


@pytest.mark.parametrize("ppm", [-200.0, 0.0, 200.0])
def test_schedule_follows_the_clock_of_the_target(ppm: float) -> None:
    """An hour with 0.2 to 10 ms on the way: its schedule stays within a sample of the truth."""
    chance, pace = np.random.default_rng(1), 1.0 + ppm * 1e-6
    offset = ClockOffset(0.01, 0.0)
    for now_s in np.arange(0.02, 60 * CLOCK_WINDOW_S, 0.005):
        newest = int(now_s * pace * RATE_HZ)
        offset.update(newest, RATE_HZ, float(now_s + chance.uniform(2e-4, 1e-2)))
    true = now_s - newest / RATE_HZ
    assert abs(offset.epoch_s - true) < 2e-3
    assert abs(now_s * (pace - 1)) > 5e-3 or not ppm, "the clocks have truly drifted apart"
