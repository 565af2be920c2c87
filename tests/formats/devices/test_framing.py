"""COBS, CRC and what is found between delimiters."""

from __future__ import annotations

from binascii import crc_hqx
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from locatk.formats.devices.interface import Counts
from locatk.formats.devices.locatk_frames import framing
from locatk.formats.devices.locatk_frames.framing import (
    MAX_CONTENT_BYTES,
    MAX_WIRE_BYTES,
    Contents,
    Deframer,
    checksum,
    cobs_encode,
    encode_frame,
)

LENGTHS = [0, 1, 2, 253, 254, 255, 256, 507, 508, 509, 762, 1000]

pieces = st.lists(
    st.one_of(
        st.binary(max_size=20),
        st.tuples(st.sampled_from(LENGTHS), st.integers(0, 255)).map(
            lambda n: bytes([n[1]]) * n[0]
        ),
    ),
    max_size=8,
).map(b"".join)
"""Bytes with long runs, of zeros and of others."""

contents = pieces.map(lambda data: (data + bytes(8))[: max(8, min(len(data), MAX_CONTENT_BYTES))])


def cobs_decode(data: bytes) -> bytes | None:
    """COBS as the paper tells it, byte by byte."""
    out = bytearray()
    at = 0
    while at < len(data):
        code = data[at]
        if at + code > len(data):
            return None
        out += data[at + 1 : at + code]
        at += code
        if code < 255 and at < len(data):
            out.append(0)
    return bytes(out)


Found = list[tuple[bytes, int]]
"""Contents and the ends of their frames."""


def parse_byte_by_byte(wire: bytes) -> tuple[Found, Counts]:
    """What is right in ``wire``, and what is not, by the plainest code there is."""
    found: Found = []
    counts = Counts(bytes=len(wire))
    end = 0
    for piece in wire.split(b"\0")[:-1]:
        end += len(piece) + 1
        body = (cobs_decode(piece) if len(piece) <= MAX_WIRE_BYTES else None) or b""
        size = 2 if len(body) <= 258 else 4
        content = body[:-size]
        fits = len(content) >= 8 and (size == 2 or 256 < len(content) <= MAX_CONTENT_BYTES)
        if fits and body == content + checksum(content):
            found.append((content, end))
        elif found:
            counts.bad += len(piece) > 0
            counts.skipped += len(piece) + 1
    return found, counts


def listed(found: Contents) -> Found:
    places = zip(found.start.tolist(), found.size.tolist(), found.end.tolist(), strict=True)
    return [(found.data[start : start + size].tobytes(), end) for start, size, end in places]


def fed(wire: bytes, cuts: list[int]) -> tuple[Found, Counts]:
    counts = Counts()
    deframer = Deframer(counts)
    edges = sorted({0, len(wire), *(cut % (len(wire) + 1) for cut in cuts)})
    found = [each for a, b in pairwise(edges) for each in listed(deframer.feed(wire[a:b]))]
    deframer.drop()
    return found, counts


@pytest.mark.parametrize(
    ("plain", "encoded"),
    [
        # The packet of Cheshire and Baker 1999, figure 3, then runs about the longest block.
        (
            bytes.fromhex("45 00 00 2c 4c 79 00 00 40 06 4f 37"),
            bytes.fromhex("02 45 01 04 2c 4c 79 01 05 40 06 4f 37"),
        ),
        (b"", b"\x01"),
        (b"\x00", b"\x01\x01"),
        (b"\x00\x00", b"\x01\x01\x01"),
        (b"\x11\x22\x00\x33", b"\x03\x11\x22\x02\x33"),
        (b"\x11\x00\x00\x00", b"\x02\x11\x01\x01\x01"),
        (bytes(range(1, 255)), b"\xff" + bytes(range(1, 255))),
        (bytes(range(0, 255)), b"\x01\xff" + bytes(range(1, 255))),
        (bytes(range(1, 256)), b"\xff" + bytes(range(1, 255)) + b"\x02\xff"),
        (bytes(range(2, 256)) + b"\0", b"\xff" + bytes(range(2, 256)) + b"\x01\x01"),
        (bytes(range(3, 256)) + b"\0\x01", b"\xfe" + bytes(range(3, 256)) + b"\x02\x01"),
    ],
)
def test_cobs_of_known_bytes(plain: bytes, encoded: bytes) -> None:
    assert cobs_encode(plain) == encoded
    assert cobs_decode(encoded) == plain


@given(pieces)
def test_cobs_has_no_zero_and_little_more(data: bytes) -> None:
    encoded = cobs_encode(data)
    assert 0 not in encoded
    assert len(data) + 1 <= len(encoded) <= len(data) + max(1, -(-len(data) // 254))
    assert cobs_decode(encoded) == data


def test_checksums_of_known_bytes() -> None:
    assert crc_hqx(b"123456789", 0xFFFF) == 0x29B1
    assert checksum(b"123456789") == bytes.fromhex("b129")
    assert len(checksum(bytes(256))) == 2
    assert len(checksum(bytes(257))) == 4
    long = b"123456789" * 29
    reference = 0xFFFFFFFF
    for byte in long:
        reference ^= byte
        for _ in range(8):
            reference = reference >> 1 ^ (0xEDB88320 if reference & 1 else 0)
    assert checksum(long) == (reference ^ 0xFFFFFFFF).to_bytes(4, "little")


@pytest.mark.parametrize("size", [0, 7, MAX_CONTENT_BYTES + 1])
def test_no_frame_of_another_size(size: int) -> None:
    with pytest.raises(ValueError, match=f"{size} bytes"):
        encode_frame(bytes(size))


def test_the_longest_frame() -> None:
    content = bytes([7]) * MAX_CONTENT_BYTES
    wire = encode_frame(content)
    assert len(wire) == MAX_WIRE_BYTES + 1
    assert fed(wire, []) == ([(content, len(wire))], Counts(bytes=len(wire)))


@pytest.mark.slow
@given(st.lists(contents, min_size=1, max_size=6), st.lists(st.integers(0, 9999), max_size=5))
def test_what_was_sealed_is_found(sent: list[bytes], cuts: list[int]) -> None:
    wire = b"".join(map(encode_frame, sent))
    found, counts = fed(wire, cuts)
    assert [content for content, _ in found] == sent
    assert (found, counts) == parse_byte_by_byte(wire)
    assert (counts.bad, counts.skipped) == (0, 0)


@pytest.mark.parametrize("few", [0, framing.MAX_LOOP_FRAMES])
def test_many_at_once_as_one_by_one(monkeypatch: pytest.MonkeyPatch, few: int) -> None:
    # Arrays for all from the first, and for those that are many; lengths about all limits.
    monkeypatch.setattr(framing, "MAX_LOOP_FRAMES", few)
    random = np.random.default_rng(6)
    sent = []
    for n in range(1500):
        size = int(random.choice([8, 9, 60, 61, 253, 254, 255, 256, 257, 258, 300, 600]))
        content = random.integers(0, 256, size).astype(np.uint8)
        content[random.random(size) < (0, 0.1, 0.9)[n % 3]] = 0
        if n % 5 == 0:
            content[content == 0] = 1
        sent.append(content.tobytes())
    wire = b"".join(map(encode_frame, sent))
    found, counts = fed(wire, [100_000, 100_001, 200_000])
    assert [content for content, _ in found] == sent
    assert (found, counts) == parse_byte_by_byte(wire)
    assert (counts.bad, counts.skipped) == (0, 0)


@pytest.mark.slow
@pytest.mark.parametrize("few", [0, framing.MAX_LOOP_FRAMES])
def test_damage_as_one_by_one(monkeypatch: pytest.MonkeyPatch, few: int) -> None:
    monkeypatch.setattr(framing, "MAX_LOOP_FRAMES", few)
    random = np.random.default_rng(7)
    for _ in range(60):
        sizes = random.integers(8, 400, 40)
        sent = [random.integers(0, 256, n).astype(np.uint8).tobytes() for n in sizes]
        wire = bytearray(b"".join(map(encode_frame, sent)))
        faults = int(random.integers(1, 8))
        for _ in range(faults):
            place = int(random.integers(0, len(wire)))
            fault = int(random.integers(0, 3))
            if fault == 0:
                wire[place] ^= 1 << int(random.integers(0, 8))
            elif fault == 1:
                del wire[place]
            else:
                wire.insert(place, int(random.integers(0, 256)))
        whole = fed(bytes(wire), [])
        assert whole == parse_byte_by_byte(bytes(wire))
        assert {content for content, _ in whole[0]} <= set(sent)
        assert len(whole[0]) >= len(sent) - 2 * faults
        assert fed(bytes(wire), random.integers(0, len(wire), 30).tolist()) == whole


@given(st.binary(max_size=300), st.lists(st.integers(0, 300), max_size=4))
def test_garbage_before_the_first_frame_is_no_fault(data: bytes, cuts: list[int]) -> None:
    found, counts = fed(data + b"\0" + encode_frame(b"whatever it is"), cuts)
    assert [content for content, _ in found] == [b"whatever it is"]
    assert (counts.bad, counts.skipped) == (0, 0)


def test_every_byte_after_the_first_frame_is_counted() -> None:
    one, two = encode_frame(b"the first frame"), encode_frame(b"the second frame")
    garbage = b"abc\0\0defghijklmnopqrstuvwxyz\0"
    found, counts = fed(b"\x05junk\0" + one + garbage + two, [])
    assert len(found) == 2
    # An empty frame is no frame that is wrong, but its delimiter belongs to none.
    assert (counts.bad, counts.skipped) == (2, len(garbage))


@pytest.mark.parametrize("longest", [258, 259, 260, 261])
def test_a_short_content_has_no_long_checksum(longest: int) -> None:
    # 256 bytes with a CRC-32 and 257 with a CRC-16 are as long as no right body.
    body = bytes([1]) * (longest - 4)
    for content, crc in ((body, checksum(bytes(1) * 300)), (body + b"\1\1", b"\1\1")):
        wire = cobs_encode(content + crc) + b"\0"
        assert fed(wire, []) == parse_byte_by_byte(wire) == ([], Counts(bytes=len(wire)))


def test_memory_is_bounded() -> None:
    counts = Counts()
    deframer = Deframer(counts)
    first = encode_frame(b"a frame to begin")
    deframer.feed(first)
    for _ in range(100):
        deframer.feed(b"U" * 100_000)
        assert len(deframer._tail) <= MAX_WIRE_BYTES + 1
    found = deframer.feed(b"U\0" + first)
    assert len(found) == 1
    assert found.end[0] == counts.bytes == 10_000_002 + 2 * len(first)
    assert (counts.bad, counts.skipped) == (1, 10_000_002)


def test_what_is_half_received_is_dropped() -> None:
    counts = Counts()
    deframer = Deframer(counts)
    one = encode_frame(b"a frame to begin")
    deframer.feed(one + one[:5])
    deframer.restart()
    assert len(deframer.feed(one[5:])) == 0  # the rest of a frame nobody saw the start of
    assert len(deframer.feed(one)) == 1
    assert (counts.bad, counts.skipped) == (0, 0)
    deframer.feed(b"U" * (MAX_WIRE_BYTES + 9))
    deframer.drop()
    assert (counts.bad, counts.skipped) == (1, MAX_WIRE_BYTES + 9)
