"""Frames of the locatk protocol: COBS, a delimiter and a CRC around what a frame says.

On the wire a frame is ``COBS(content, CRC)`` and a byte 0, which comes nowhere else: after
any fault the next 0 starts afresh. What a content says is in :mod:`.payloads`;
docs/firmware/README.md tells all of it byte by byte.
"""

from __future__ import annotations

import zlib
from binascii import crc_hqx
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from locatk.formats.devices.decoder import Counts

Bytes = NDArray[np.uint8]
Index = NDArray[np.int64]

SHORT = 256
"""Longest content that a CRC-16 guards; a CRC-32 guards what is longer."""

LARGEST_BODY = 4096
"""Bytes of content and CRC of the longest frame."""

LARGEST_CONTENT = LARGEST_BODY - 4

SMALLEST_CONTENT = 8
"""A header alone."""

BLOCK = 254
"""Bytes without a 0 that one code byte of COBS leads."""

LARGEST_WIRE = LARGEST_BODY + -(-LARGEST_BODY // BLOCK)
"""Bytes of the longest frame before its delimiter."""

FEW = 128
"""Frames for which a loop over them is quicker than arrays."""


def cobs_encode(data: bytes) -> bytes:
    """``data`` without any byte 0, one byte longer and one more for each 254.

    Cheshire and Baker, Consistent Overhead Byte Stuffing, IEEE/ACM Transactions on
    Networking 7(2), 1999. A full block at the very end has no empty block after it.
    """
    out = bytearray()
    *pieces, last = data.split(b"\0")
    for piece in pieces:
        out += _blocks(piece, BLOCK)
    return bytes(out + _blocks(last, BLOCK + 1))


def _blocks(piece: bytes, room: int) -> bytes:
    """Blocks of what stands before a 0; a full one takes no 0 with it."""
    out = b""
    while len(piece) >= room:
        out += b"\xff" + piece[:BLOCK]
        piece = piece[BLOCK:]
    return out + bytes([len(piece) + 1]) + piece


def checksum(content: bytes | memoryview) -> bytes:
    """CRC of a content, little-endian: CRC-16/CCITT-FALSE, or CRC-32 of a long one."""
    if len(content) <= SHORT:
        return crc_hqx(content, 0xFFFF).to_bytes(2, "little")
    return zlib.crc32(content).to_bytes(4, "little")


def seal(content: bytes) -> bytes:
    """The frame of a content, as it goes over the wire.

    Raises
    ------
    ValueError
        The content is shorter than a header, or longer than a frame can be.
    """
    if not SMALLEST_CONTENT <= len(content) <= LARGEST_CONTENT:
        raise ValueError(f"a content of {len(content)} bytes is not in the range of a frame")
    return cobs_encode(content + checksum(content)) + b"\0"


@dataclass(frozen=True)
class Contents:
    """Contents of the right frames among some bytes, in their order.

    Attributes
    ----------
    data : (m,) uint8 ndarray
        In which they lie.
    start, size : (n,) int64 ndarray
        Where, without their CRC.
    end : (n,) int64 ndarray
        Bytes fed up to and with each frame's delimiter.
    wire : (n,) int64 ndarray
        Bytes of each frame on the wire, with its delimiter.
    """

    data: Bytes
    start: Index
    size: Index
    end: Index
    wire: Index

    def __len__(self) -> int:
        return len(self.start)

    def rows(self, which: Index, start: int, stop: int) -> Bytes:
        """Bytes ``start`` to ``stop`` of some contents, a row each; all must be as long."""
        width = stop - start
        if not width or not len(which):
            return np.zeros((len(which), width), np.uint8)
        places = len(self.data) - width + 1
        windows = np.ndarray((places,), f"V{width}", self.data, strides=(1,))
        found: Bytes = windows[self.start[which] + start].view(np.uint8)
        return found.reshape(len(which), width)


class Deframer:
    """Bytes in, contents of right frames out; counts what belongs to none.

    A frame that never ends is cut at the length of the longest, so that memory is bounded.

    Parameters
    ----------
    counts : Counts
        Whose ``bytes``, ``bad`` and ``skipped`` are kept.
    """

    def __init__(self, counts: Counts) -> None:
        self._counts = counts
        self._tail = b""
        self._cut = 0
        self._met = False

    def feed(self, data: bytes) -> Contents:
        """Contents of the frames that these bytes complete."""
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
        whole = np.flatnonzero((wire > SMALLEST_CONTENT + 3) & (wire <= LARGEST_WIRE + 1))
        body, at, size, kept = _stuffed(raw, start[whole], end[whole])
        size, right = _checked(body, at, size)
        good = whole[kept[right]]
        wire[0] += self._cut
        self._count(wire, good)
        self._tail, self._cut = b"", 0
        self._keep(data[last:])
        return Contents(body, at[right], size[right], before + end[good] + 1, wire[good])

    def drop(self) -> None:
        """Forget what is half received: nobody stops to listen between two frames, so this
        is no fault unless no frame can be as long."""
        if self._cut and self._met:
            self._counts.bad += 1
            self._counts.skipped += len(self._tail) + self._cut
        self._tail, self._cut = b"", 0

    def restart(self) -> None:
        """The line was lost: what comes next need not be the start of a frame."""
        self.drop()
        self._met = False

    def _keep(self, tail: bytes) -> None:
        self._tail = tail[: LARGEST_WIRE + 1]
        self._cut += len(tail) - len(self._tail)

    def _count(self, wire: Index, good: Index) -> None:
        """Count frames that are wrong, and bytes of none, from the first right one on."""
        first = 0 if self._met else int(good[0]) if len(good) else len(wire)
        self._met |= len(good) > 0
        self._counts.bad += int((wire[first:] > 1).sum()) - len(good)
        self._counts.skipped += int(wire[first:].sum() - wire[good].sum())


def _stuffed(raw: bytes, start: Index, end: Index) -> tuple[Bytes, Index, Index, Index]:
    """Undo COBS of the frames from ``start`` to ``end``, all in step.

    Most blocks only move by one byte when their code byte goes: where it stood before the
    next block is the 0 that it stands for. So bytes stay where they are, code bytes become
    0, and only those after a full block are taken out.

    Returns
    -------
    body : (m,) uint8 ndarray
    start, size : (k,) int64 ndarray
        Where in it the frames lie.
    kept : (k,) int64 ndarray
        Which of them are COBS at all.
    """
    codes = np.frombuffer(raw, np.uint8)
    undone = bytearray(raw)
    body = np.frombuffer(undone, np.uint8)
    right = np.ones(len(start), bool)
    taken: list[Index] = []
    number, at, stop = np.arange(len(start)), start, end
    while len(at) > FEW:
        code = codes.take(at)
        at = at + code
        going = at < stop
        if not going.all():
            right[number[at > stop]] = False
            number, at, stop, code = number[going], at[going], stop[going], code[going]
        body[at] = 0
        full = code > BLOCK
        if full.any():
            taken.append(at[full])
    after: list[int] = []
    for n, place, limit in zip(number.tolist(), at.tolist(), stop.tolist(), strict=True):
        while (following := place + raw[place]) < limit:
            undone[following] = 0
            if raw[place] > BLOCK:
                after.append(following)
            place = following
        right[n] = following == limit
    out = np.sort(np.concatenate([*taken, np.array(after, np.int64)]))
    kept = np.flatnonzero(right)
    first, last = start[kept] + 1, end[kept]
    if len(out):
        body = np.delete(body, out)
        first, last = first - np.searchsorted(out, first), last - np.searchsorted(out, last)
    return body, first, last - first, kept


def _checked(body: Bytes, start: Index, size: Index) -> tuple[Index, Index]:
    """Sizes of the contents of some bodies, and which have the CRC that they tell."""
    short = size <= SHORT + 2
    content = size - np.where(short, 2, 4)
    right = (content >= SMALLEST_CONTENT) & (short | (content > SHORT))
    many = np.flatnonzero(right & short)
    if len(many) <= FEW:
        many = many[:0]
    single = right.copy()
    single[many] = False
    raw = body.data
    for n in np.flatnonzero(single).tolist():
        first, middle, last = int(start[n]), int(start[n] + content[n]), int(start[n] + size[n])
        right[n] = checksum(raw[first:middle]) == raw[middle:last]
    if len(many):
        right[many] = _crc16_right(body, start[many], content[many])
    return content, np.flatnonzero(right)


def _crc16_right(body: Bytes, start: Index, size: Index) -> NDArray[np.bool_]:
    """Whether the CRC-16 of some contents is what follows each.

    All contents in step, two bytes a step; the longest first, so that those which still
    have bytes are always the first ones.
    """
    table = _crc16_table()
    pairs = np.zeros(len(body), np.uint16)
    pairs[:-1] = body[1:]
    pairs <<= 8
    pairs |= body
    order = np.argsort(-size, kind="stable")
    at, left = start[order], size[order]
    odd = (left & 1).astype(bool)
    crc = np.full(len(at), 0xFFFF, np.uint16)
    crc[odd] = 0x00FF ^ table[(0xFF ^ body[at[odd]]).astype(np.uint16) << 8]
    at += odd
    steps = left >> 1
    going = np.searchsorted(-steps, -np.arange(steps[0]))
    for m in going.tolist():
        crc[:m] = table.take(crc[:m] ^ pairs.take(at[:m]))
        at[:m] += 2
    right = np.empty(len(at), bool)
    right[order] = crc.byteswap() == pairs.take(at)
    return right


@cache
def _crc16_table() -> NDArray[np.uint16]:
    """CRC-16 after two bytes more, by CRC xor these bytes; all with their bytes swapped, as
    bytes are read little-endian and the CRC is defined on big-endian ones."""
    crc: NDArray[np.integer[Any]] = np.arange(1 << 16, dtype=np.uint32)
    for _ in range(16):
        crc = (crc << 1 ^ (crc >> 15) * 0x1021) & 0xFFFF
    swapped = np.arange(1 << 16, dtype=np.uint16).byteswap()
    return crc.astype(np.uint16)[swapped].byteswap()
