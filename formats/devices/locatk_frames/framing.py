"""Frames of the locatk protocol: COBS, a delimiter, and a CRC of the content.

A frame is ``COBS(content, CRC)`` and a byte 0, which occurs nowhere else: after any fault the
next 0 starts a new frame. Contents are parsed in :mod:`.payloads`; docs/firmware/README.md
specifies all bytes.
"""

from __future__ import annotations

import zlib
from binascii import crc_hqx
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from locatk.formats.devices.interface import Counts

Bytes = NDArray[np.uint8]
Index = NDArray[np.int64]

MAX_CRC16_BYTES = 256
"""Longest content with a CRC-16; longer ones have a CRC-32."""

MAX_BODY_BYTES = 4096
"""Largest size of content and CRC."""

MAX_CONTENT_BYTES = MAX_BODY_BYTES - 4

MIN_CONTENT_BYTES = 8
"""Size of a header."""

COBS_BLOCK_BYTES = 254
"""Bytes other than 0 after one code byte."""

MAX_WIRE_BYTES = MAX_BODY_BYTES + -(-MAX_BODY_BYTES // COBS_BLOCK_BYTES)
"""Largest size of a frame without its delimiter."""

MAX_LOOP_FRAMES = 128
"""Number of frames up to which a loop is faster than array operations."""


def cobs_encode(data: bytes) -> bytes:
    """Return ``data`` without bytes 0, longer by one byte plus one for each 254.

    Cheshire and Baker, Consistent Overhead Byte Stuffing, IEEE/ACM Transactions on
    Networking 7(2), 1999. A full block at the end of the data is not followed by an empty one.
    """
    out = bytearray()
    *pieces, last = data.split(b"\0")
    for piece in pieces:
        out += _blocks(piece, COBS_BLOCK_BYTES)
    return bytes(out + _blocks(last, COBS_BLOCK_BYTES + 1))


def _blocks(piece: bytes, max_bytes: int) -> bytes:
    """Return the blocks of the bytes before a 0; a full block does not imply a 0."""
    out = b""
    while len(piece) >= max_bytes:
        out += b"\xff" + piece[:COBS_BLOCK_BYTES]
        piece = piece[COBS_BLOCK_BYTES:]
    return out + bytes([len(piece) + 1]) + piece


def checksum(content: bytes | memoryview) -> bytes:
    """Return the CRC of a content, little-endian: CRC-16/CCITT-FALSE, or CRC-32 of a long one."""
    if len(content) <= MAX_CRC16_BYTES:
        return crc_hqx(content, 0xFFFF).to_bytes(2, "little")
    return zlib.crc32(content).to_bytes(4, "little")


def encode_frame(content: bytes) -> bytes:
    """Return the frame of a content with its delimiter.

    Raises
    ------
    ValueError
        The content is shorter than a header or too long for a frame.
    """
    if not MIN_CONTENT_BYTES <= len(content) <= MAX_CONTENT_BYTES:
        raise ValueError(f"a content of {len(content)} bytes is not in the range of a frame")
    return cobs_encode(content + checksum(content)) + b"\0"


@dataclass(frozen=True)
class Contents:
    """Contents of the valid frames in a piece of a byte stream, in their order.

    Attributes
    ----------
    data : (m,) uint8 ndarray
        Buffer.
    start, size : (n,) int64 ndarray
        Position of each content in it, without its CRC.
    end : (n,) int64 ndarray
        Number of bytes fed up to and including each frame's delimiter.
    wire : (n,) int64 ndarray
        Size of each frame on the wire, with its delimiter.
    """

    data: Bytes
    start: Index
    size: Index
    end: Index
    wire: Index

    def __len__(self) -> int:
        return len(self.start)

    def rows(self, which: Index, start: int, stop: int) -> Bytes:
        """Return bytes ``start`` to ``stop`` of several contents, one row each.

        The contents must have at least ``stop`` bytes.
        """
        width = stop - start
        if not width or not len(which):
            return np.zeros((len(which), width), np.uint8)
        positions = len(self.data) - width + 1
        windows = np.ndarray((positions,), f"V{width}", self.data, strides=(1,))
        found: Bytes = windows[self.start[which] + start].view(np.uint8)
        return found.reshape(len(which), width)


class Deframer:
    """Extracts the contents of valid frames from a byte stream, and counts the other bytes.

    A frame without delimiter is cut at the largest size, so that memory is bounded.

    Parameters
    ----------
    counts : Counts
        Its ``bytes``, ``bad`` and ``skipped`` are updated.
    """

    def __init__(self, counts: Counts) -> None:
        self._counts = counts
        self._tail = b""
        self._dropped = 0
        self._has_frame = False

    def feed(self, data: bytes) -> Contents:
        """Return the contents of the frames that these bytes complete."""
        before = self._counts.bytes - len(self._tail)
        self._counts.bytes += len(data)
        last = data.rfind(b"\0") + 1
        if not last:
            self._keep(self._tail + data)
            none = np.zeros(0, np.int64)
            return Contents(np.zeros(0, np.uint8), none, none, none, none)
        raw = self._tail + data[:last]
        buffer = np.frombuffer(raw, np.uint8)
        end = np.flatnonzero(buffer == 0)
        start = np.append(0, end[:-1] + 1)
        wire = end - start + 1
        whole = np.flatnonzero((wire > MIN_CONTENT_BYTES + 3) & (wire <= MAX_WIRE_BYTES + 1))
        body, at, size, kept = _decode_cobs(raw, start[whole], end[whole])
        size, valid = _check_crcs(body, at, size)
        good = whole[kept[valid]]
        wire[0] += self._dropped
        self._count(wire, good)
        self._tail, self._dropped = b"", 0
        self._keep(data[last:])
        return Contents(body, at[valid], size[valid], before + end[good] + 1, wire[good])

    def drop(self) -> None:
        """Discard a partial frame.

        It is not counted as bad, because reception rarely stops between two frames, unless it is
        longer than any frame.
        """
        if self._dropped and self._has_frame:
            self._counts.bad += 1
            self._counts.skipped += len(self._tail) + self._dropped
        self._tail, self._dropped = b"", 0

    def restart(self) -> None:
        """Discard a partial frame after a reconnect; the next bytes may begin within a frame."""
        self.drop()
        self._has_frame = False

    def _keep(self, tail: bytes) -> None:
        self._tail = tail[: MAX_WIRE_BYTES + 1]
        self._dropped += len(tail) - len(self._tail)

    def _count(self, wire: Index, good: Index) -> None:
        """Count invalid frames, and bytes outside of valid frames, since the first valid one."""
        first = 0 if self._has_frame else int(good[0]) if len(good) else len(wire)
        self._has_frame |= len(good) > 0
        self._counts.bad += int((wire[first:] > 1).sum()) - len(good)
        self._counts.skipped += int(wire[first:].sum() - wire[good].sum())


def _decode_cobs(raw: bytes, start: Index, end: Index) -> tuple[Bytes, Index, Index, Index]:
    """Decode COBS of the frames from ``start`` to ``end``, block by block, all frames in parallel.

    When its code byte is removed, a block moves by one byte, and the code byte of the next block
    becomes the 0 that it represents. So bytes keep their positions, code bytes become 0, and only
    the code bytes after full blocks are deleted.

    Returns
    -------
    body : (m,) uint8 ndarray
    start, size : (k,) int64 ndarray
        Position of the decoded frames in ``body``.
    kept : (k,) int64 ndarray
        Indices of the frames that are valid COBS.
    """
    codes = np.frombuffer(raw, np.uint8)
    undone = bytearray(raw)
    body = np.frombuffer(undone, np.uint8)
    valid = np.ones(len(start), bool)
    taken: list[Index] = []
    number, at, stop = np.arange(len(start)), start, end
    while len(at) > MAX_LOOP_FRAMES:
        code = codes.take(at)
        at = at + code
        going = at < stop
        if not going.all():
            valid[number[at > stop]] = False
            number, at, stop, code = number[going], at[going], stop[going], code[going]
        body[at] = 0
        full = code > COBS_BLOCK_BYTES
        if full.any():
            taken.append(at[full])
    after: list[int] = []
    for n, position, limit in zip(number.tolist(), at.tolist(), stop.tolist(), strict=True):
        while (following := position + raw[position]) < limit:
            undone[following] = 0
            if raw[position] > COBS_BLOCK_BYTES:
                after.append(following)
            position = following
        valid[n] = following == limit
    out = np.sort(np.concatenate([*taken, np.array(after, np.int64)]))
    kept = np.flatnonzero(valid)
    first, last = start[kept] + 1, end[kept]
    if len(out):
        body = np.delete(body, out)
        first, last = first - np.searchsorted(out, first), last - np.searchsorted(out, last)
    return body, first, last - first, kept


def _check_crcs(body: Bytes, start: Index, size: Index) -> tuple[Index, Index]:
    """Return the sizes of the contents, and the indices of those with a valid CRC."""
    short = size <= MAX_CRC16_BYTES + 2
    content = size - np.where(short, 2, 4)
    valid = (content >= MIN_CONTENT_BYTES) & (short | (content > MAX_CRC16_BYTES))
    many = np.flatnonzero(valid & short)
    if len(many) <= MAX_LOOP_FRAMES:
        many = many[:0]
    single = valid.copy()
    single[many] = False
    raw = body.data
    for n in np.flatnonzero(single).tolist():
        first, middle, last = int(start[n]), int(start[n] + content[n]), int(start[n] + size[n])
        valid[n] = checksum(raw[first:middle]) == raw[middle:last]
    if len(many):
        valid[many] = _is_crc16_valid(body, start[many], content[many])
    return content, np.flatnonzero(valid)


def _is_crc16_valid(body: Bytes, start: Index, size: Index) -> NDArray[np.bool_]:
    """Return whether each content is followed by its CRC-16.

    All contents are processed in parallel, two bytes per step, in descending order of their sizes,
    so that the contents with remaining bytes are always the first ones.
    """
    table = _crc16_table()
    pairs = np.zeros(len(body), np.uint16)
    pairs[:-1] = body[1:]
    pairs <<= 8
    pairs |= body
    order = np.argsort(-size, kind="stable")
    at, remaining = start[order], size[order]
    odd = (remaining & 1).astype(bool)
    crc = np.full(len(at), 0xFFFF, np.uint16)
    crc[odd] = 0x00FF ^ table[(0xFF ^ body[at[odd]]).astype(np.uint16) << 8]
    at += odd
    steps = remaining >> 1
    going = np.searchsorted(-steps, -np.arange(steps[0]))
    for m in going.tolist():
        crc[:m] = table.take(crc[:m] ^ pairs.take(at[:m]))
        at[:m] += 2
    valid = np.empty(len(at), bool)
    valid[order] = crc.byteswap() == pairs.take(at)
    return valid


@cache
def _crc16_table() -> NDArray[np.uint16]:
    """Return the CRC-16 after two more bytes, by the XOR of CRC and these bytes.

    All values have swapped bytes, because the bytes are read as little-endian numbers and the CRC
    is defined for big-endian ones.
    """
    crc: NDArray[np.integer[Any]] = np.arange(1 << 16, dtype=np.uint32)
    for _ in range(16):
        crc = (crc << 1 ^ (crc >> 15) * 0x1021) & 0xFFFF
    swapped = np.arange(1 << 16, dtype=np.uint16).byteswap()
    return crc.astype(np.uint16)[swapped].byteswap()
