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
from table_io.backends.udp.packets import (
    PIECES,
    RING,
    STATE,
    STATE_BYTES,
    VALUES,
    WORD,
    WORD_BYTES,
    Kind,
    Phase,
    Reason,
    State,
    Verdict,
    Word,
    decode_state,
    decode_word,
    encode_state,
    encode_word,
)
from table_io.backends.udp.transfer import DRIFT_S, RESEND_S, WINDOW, Arriving, Delivery, Offset

RATE = 2000.0
U32 = st.integers(0, 2**32 - 1)
U64 = st.integers(0, 2**64 - 1)
I64 = st.integers(-(2**63), 2**63 - 1)
VOLTS = st.lists(st.floats(width=64), max_size=VALUES).map(np.array)
WORDS = st.builds(
    Word, st.sampled_from(Kind), U64, U32, I64, U32, U32, U32, I64, I64, VOLTS
)  # fmt: skip
STATES = st.builds(
    State, st.sampled_from(Phase), st.sampled_from(Reason), U64, U32, I64, I64, I64, U32,
    st.sampled_from(Verdict), U32, U32, U32, U32, st.floats(allow_nan=False),
    st.binary(min_size=64, max_size=64), VOLTS,
)  # fmt: skip


def same(one: Word | State, other: Word | State | None) -> bool:
    """True where every field is the same, NaN included."""
    return other is not None and all(
        np.array_equal(getattr(one, f.name), getattr(other, f.name), equal_nan=True)
        if f.name == "values"
        else getattr(one, f.name) == getattr(other, f.name)
        for f in fields(one)
    )


@given(WORDS)
def test_a_word_comes_back_as_it_was(word: Word) -> None:
    packet = encode_word(word)
    assert len(packet) == WORD_BYTES == 1092
    assert same(word, decode_word(packet))
    assert decode_state(packet) is None


@given(STATES)
def test_a_state_comes_back_as_it_was(state: State) -> None:
    packet = encode_state(state)
    assert len(packet) == STATE_BYTES == 1172
    assert same(state, decode_state(packet))
    assert decode_word(packet) is None


@given(WORDS, STATES, st.data())
def test_a_packet_with_a_spoilt_byte_is_none(word: Word, state: State, data: st.DataObject) -> None:
    for packet, decode in ((encode_word(word), decode_word), (encode_state(state), decode_state)):
        at = data.draw(st.integers(0, len(packet) - 1))
        flipped = packet[at] ^ data.draw(st.integers(1, 255))
        assert decode(packet[:at] + bytes([flipped]) + packet[at + 1 :]) is None
        assert decode(packet[:-1]) is None
        assert decode(packet + b"\0") is None


def test_another_version_and_unknown_words_are_none() -> None:
    for at, value in ((4, 2), (6, 6), (20, VALUES + 1)):
        body = bytearray(encode_word(Word(Kind.BEAT)))[:-4]
        body[at] = value
        assert decode_word(bytes(body) + struct.pack("<I", zlib.crc32(body))) is None


def test_the_document_says_where_every_field_is() -> None:
    """PACKETS.md has a row `offset | type | name` for each field of the two headers, in order."""
    text = (Path(udp.__file__).parent / "PACKETS.md").read_text()
    sizes = {"u8": 1, "u16": 2, "u32": 4, "u64": 8, "i64": 8, "f64": 8}
    for title, layout, total in (
        ("## Rig to target", WORD, WORD_BYTES),
        ("## Target to rig", STATE, STATE_BYTES),
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
def test_samples_keep_their_place_in_whatever_order_they_come(cuts: list[int], chance) -> None:  # type: ignore[no-untyped-def]
    whole = np.arange(2.0 * sum(cuts)).reshape(-1, 2).T
    edges = np.cumsum([0, *cuts])
    pieces = [(int(a), whole[:, a:b]) for a, b in itertools.pairwise(edges)]
    pieces += chance.sample(pieces, len(pieces) // 2)  # some twice
    chance.shuffle(pieces)
    arriving, taken, there = Arriving(2), [], set[int]()
    for index, values in pieces:
        arriving.put(index, values)
        there |= set(range(index, index + values.shape[1]))
        missing = [i for i in range(max(there)) if i not in there]
        assert arriving.come == (missing[0] if missing else max(there) + 1)
        if missing:
            known = next(i for i in range(missing[0], max(there) + 1) if i in there)
            assert arriving.hole == (missing[0], known)
        taken.append(arriving.take((arriving.come - arriving.first) // 2))
    taken.append(arriving.take(sum(cuts) - arriving.first))
    np.testing.assert_array_equal(np.concatenate(taken, axis=1), whole)


def test_what_is_lost_for_good_is_nan() -> None:
    arriving = Arriving(1)
    arriving.put(0, np.zeros((1, 5)))
    arriving.put(8, np.zeros((1, 2)))
    arriving.give_up(8)
    arriving.put(5, np.ones((1, 3)))
    assert arriving.come == 10
    assert np.isnan(arriving.take(10)[0]).nonzero()[0].tolist() == [5, 6, 7]
    arriving.give_up(4)
    assert arriving.come == 10


def test_samples_far_beyond_any_sense_are_not_kept() -> None:
    arriving = Arriving(1)
    arriving.put(1 << 40, np.zeros((1, 5)))
    assert arriving.seen == 0


def test_a_command_goes_in_a_window_and_what_is_not_heard_of_goes_again() -> None:
    volts = np.arange(float(VALUES * 40 + 3))
    delivery = Delivery(volts)
    first = delivery.due(0.0)
    assert [piece for piece, _ in first] == list(range(WINDOW))
    assert delivery.due(0.5 * RESEND_S) == []
    there = np.zeros(PIECES, dtype=np.bool_)
    there[[0, 2, 3]] = True
    delivery.heard(there)
    assert [piece for piece, _ in delivery.due(0.6 * RESEND_S)] == [32, 33, 34]
    again = delivery.due(1.1 * RESEND_S)
    assert [piece for piece, _ in again][:3] == [1, 4, 5]
    for piece, values in first:
        np.testing.assert_array_equal(values, volts[VALUES * piece : VALUES * (piece + 1)])
    there[:40] = True
    delivery.heard(there)
    ((piece, values),) = delivery.due(9.0)
    assert (piece, values.tolist()) == (40, volts[-3:].tolist())
    assert Delivery(np.zeros(RING)).arrived.size == PIECES


@pytest.mark.parametrize("ppm", [-200.0, 0.0, 200.0])
def test_the_schedule_follows_the_clock_of_the_target(ppm: float) -> None:
    """An hour with 0.2 to 10 ms on the way: its schedule stays within a sample of the truth."""
    chance, pace = np.random.default_rng(1), 1.0 + ppm * 1e-6
    offset = Offset(0.01, 0.0)
    for now in np.arange(0.02, 60 * DRIFT_S, 0.005):
        newest = int(now * pace * RATE)
        offset.heard(newest, RATE, float(now + chance.uniform(2e-4, 1e-2)))
    true = now - newest / RATE
    assert abs(offset.epoch_s - true) < 2e-3
    assert abs(now * (pace - 1)) > 5e-3 or not ppm, "the clocks have truly drifted apart"
