"""HDLC frames, against published ones and against what can happen to them."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from locatk.formats.devices.dotbot_gateway import (
    ESCAPE,
    FLAG,
    MAX_FRAME_BYTES,
    HdlcDecoder,
    decode_hdlc,
    encode_hdlc,
)
from locatk.formats.devices.interface import Counts

VECTORS = [
    (b"test", b"~test\x88\x07~"),
    (b"", b"~\x00\x00~"),
    (b"~test}", b"~}^test}]\x06\x94~"),
]
"""PyDotBot ``test_hdlc_handler.py``."""

payloads = st.lists(st.binary(max_size=60) | st.text("}~^]", max_size=9).map(str.encode))


def decode(*pieces: bytes) -> tuple[list[tuple[int, bytes]], Counts]:
    counts = Counts()
    decoder = HdlcDecoder(counts)
    return [found for piece in pieces for found in decoder.feed(piece)], counts


def slow_fcs(payload: bytes) -> int:
    """Bit by bit, as RFC 1662 has it."""
    fcs = 0xFFFF
    for byte in payload:
        fcs ^= byte
        for _ in range(8):
            fcs = fcs >> 1 ^ (0x8408 if fcs & 1 else 0)
    return fcs ^ 0xFFFF


@pytest.mark.parametrize(("payload", "frame"), VECTORS)
def test_published_frames(payload: bytes, frame: bytes) -> None:
    assert encode_hdlc(payload) == frame
    assert decode(frame)[0] == [(len(frame), payload)]


def test_check_value_of_the_catalogue() -> None:
    assert slow_fcs(b"123456789") == 0x906E
    assert encode_hdlc(b"123456789")[-3:-1] == b"\x6e\x90"


@given(st.binary(max_size=300))
def test_there_and_back(payload: bytes) -> None:
    frame = encode_hdlc(payload)
    assert frame.count(FLAG) == 2
    assert decode_hdlc(frame[1:-1]) == payload
    fcs = slow_fcs(payload).to_bytes(2, "little")
    assert frame[1:-1].replace(b"}^", b"~").replace(b"}]", b"}") == payload + fcs


@pytest.mark.slow
@given(payloads, st.booleans(), st.lists(st.integers(0, 500)))
def test_pieces_do_not_matter(sent: list[bytes], shared: bool, cuts: list[int]) -> None:
    frames = [encode_hdlc(payload) for payload in sent]
    stream = b"\x01}" + b"".join(frames)
    if shared:
        stream = stream.replace(FLAG * 2, FLAG)
    edges = [0, *sorted(min(cut, len(stream)) for cut in cuts), len(stream)]
    found, counts = decode(*(stream[a:b] for a, b in pairwise(edges)))
    assert [payload for _, payload in found] == sent
    assert (counts.frames, counts.bad, counts.skipped) == (len(sent), 0, 0)
    for end, payload in found:
        assert stream[:end].endswith(encode_hdlc(payload)[1:])


@pytest.mark.slow
@given(payloads, st.binary(max_size=40), st.data())
def test_faults_make_no_wrong_frame(sent: list[bytes], noise: bytes, draw: st.DataObject) -> None:
    good = (
        [encode_hdlc(b"first")]
        + [encode_hdlc(payload) for payload in sent]
        + [encode_hdlc(b"last")]
    )
    which = draw.draw(st.integers(1, len(good) - 1))
    frame = bytearray(good[which])
    fault = draw.draw(st.sampled_from(["flip", "drop", "add"]))
    place = draw.draw(st.integers(0, len(frame) - 1))
    if fault == "flip":
        frame[place] ^= 1 << draw.draw(st.integers(0, 7))
    elif fault == "drop":
        del frame[place]
    else:
        frame[place:place] = noise
    good[which] = bytes(frame)
    found, _ = decode(*good, encode_hdlc(b"end"))
    payloads = [payload for _, payload in found]
    expected = [b"first", *sent, b"last", b"end"]
    # An FCS sees every single flip; of others it lets through one in 65536.
    assert payloads[0] == b"first"
    assert payloads[-1] == b"end"
    if fault == "flip":
        assert all(payload in expected for payload in payloads)
        assert len(payloads) >= len(expected) - 2


def test_what_is_wrong_is_counted() -> None:
    good = encode_hdlc(b"good")
    found, counts = decode(b"~nothing heard yet~", good, b"~bad frame~", good, good[:-1] + b"x~")
    assert len(found) == 2
    assert (counts.frames, counts.bad) == (2, 2)
    assert counts.skipped == len(b"bad frame") + len(good[1:-1] + b"x")


@pytest.mark.parametrize("body", [b"", b"a", b"}", b"}}^\x00", b"a}", b"}A\x00\x00"])
def test_what_is_no_frame(body: bytes) -> None:
    assert decode_hdlc(body) is None


def test_escape_before_the_flag_gives_up_the_frame() -> None:
    found, counts = decode(
        encode_hdlc(b"one"), encode_hdlc(b"two")[:-1] + ESCAPE + FLAG, encode_hdlc(b"three")
    )
    assert [payload for _, payload in found] == [b"one", b"three"]
    assert counts.bad == 1


@pytest.mark.parametrize("size", [MAX_FRAME_BYTES - 2, MAX_FRAME_BYTES - 1, 5 * MAX_FRAME_BYTES])
@pytest.mark.parametrize("step", [7, MAX_FRAME_BYTES, 10**6])
def test_longest_frame(size: int, step: int) -> None:
    stream = encode_hdlc(b"one") + encode_hdlc(bytes(size)) + encode_hdlc(b"two")
    decoder = HdlcDecoder(counts := Counts())
    found = []
    for k in range(0, len(stream), step):
        found += decoder.feed(stream[k : k + step])
        assert len(decoder._rest) <= MAX_FRAME_BYTES
    fits = size + 2 <= MAX_FRAME_BYTES
    assert [len(payload) for _, payload in found] == [3, *[size] * fits, 3]
    assert found[-1][0] == len(stream)
    assert (counts.frames, counts.bad) == (2 + fits, 1 - fits)
    assert counts.skipped == (0 if fits else size + 2)


def test_connection_lost_and_there_again() -> None:
    decoder = HdlcDecoder(counts := Counts())
    one = encode_hdlc(b"one")
    assert decoder.feed(one + b"half a fr") == [(len(one), b"one")]
    decoder.restart()
    found = decoder.feed(b"ame~" + encode_hdlc(b"two"))
    assert found == [(len(one) + 9 + 4 + len(encode_hdlc(b"two")), b"two")]
    assert (counts.frames, counts.bad, counts.skipped) == (2, 0, 0)
