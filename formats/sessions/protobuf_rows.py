"""Encoding of many small protobuf messages of one type at once, one per row of arrays.

A generated class takes 3 microseconds for a pose, of which a recording may have a million. Here
all rows are encoded together: each field is a table of bytes (n, width) with a mask of the bytes
that the row uses, because numbers have one to ten bytes and fields of value 0 are left out. The
bytes are those of ``SerializeToString``.
Encoding: https://protobuf.dev/programming-guides/encoding/
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

VARINT, FIXED64, LENGTH_DELIMITED = 0, 1, 2
"""Wire types."""

MAX_ONE_BYTE_LENGTH = 127


class Rows(NamedTuple):
    """Encoded fields of n messages.

    Attributes
    ----------
    parts : tuple of (data, is_used)
        (n, width) uint8 and bool ndarrays, side by side.
    size : (n,) int64 ndarray
        Number of bytes of each row.
    """

    parts: tuple[tuple[NDArray[np.uint8], NDArray[np.bool_]], ...]
    size: NDArray[np.int64]

    def joined(self) -> bytes:
        """Return the bytes of all rows, one after the other."""
        data, is_used = (np.concatenate(tables, axis=1) for tables in zip(*self.parts, strict=True))
        return data[is_used].tobytes()

    def split(self) -> list[bytes]:
        """Return the bytes of each row."""
        data = self.joined()
        edges = np.append(0, np.cumsum(self.size))
        return [data[start:stop] for start, stop in pairwise(edges.tolist())]


def length_delimited(number: int, content: bytes) -> bytes:
    """Encode one field that is a text, a message, or packed numbers."""
    head, length = [number << 3 | LENGTH_DELIMITED], len(content)
    while length > MAX_ONE_BYTE_LENGTH:
        head.append(length & 127 | 128)
        length >>= 7
    return bytes([*head, length]) + content


def encode_message(fields: Sequence[Rows]) -> Rows:
    """Join the fields of messages, which must be in the order of their numbers."""
    size = np.sum([field.size for field in fields], axis=0)
    return Rows(tuple(part for field in fields for part in field.parts), size)


def message_field(number: int, fields: Sequence[Rows]) -> Rows:
    """Encode a field that is a message of the given fields; each has at most 127 bytes."""
    content = encode_message(fields)
    if np.any(content.size > MAX_ONE_BYTE_LENGTH):
        raise ValueError(f"field {number} has more than {MAX_ONE_BYTE_LENGTH} bytes")
    head = np.empty((len(content.size), 2), np.uint8)
    head[:, 0], head[:, 1] = number << 3 | LENGTH_DELIMITED, content.size
    return Rows(((head, np.ones(head.shape, bool)), *content.parts), content.size + 2)


def double_fields(first_number: int, values: NDArray[np.float64]) -> Rows:
    """Encode the columns of ``values`` (n, k) as ``double`` fields of consecutive numbers."""
    n, k = values.shape
    table = np.empty((n, k), np.dtype([("tag", "u1"), ("value", "<f8")]))
    table["tag"] = np.arange(first_number, first_number + k) << 3 | FIXED64
    table["value"] = values
    # Left out is +0.0 only.
    is_used = np.ascontiguousarray(values, "<f8").view("<u8") != 0
    part = table.view(np.uint8).reshape(n, 9 * k), np.repeat(is_used, 9, axis=1)
    return Rows((part,), 9 * np.count_nonzero(is_used, axis=1))


def integer_field(number: int, values: ArrayLike) -> Rows:
    """Encode ``values`` (n,), which are not negative, as an integer field."""
    value = np.asarray(values, np.uint64)[:, None]
    width = max(1, -(-int(value.max(initial=0)).bit_length() // 7))
    rest = value >> (7 * np.arange(width, dtype=np.uint64))
    data = np.empty((len(value), 1 + width), np.uint8)
    data[:, 0] = number << 3 | VARINT
    data[:, 1:] = rest & 127
    data[:, 1:-1] |= np.where(rest[:, 1:] != 0, 128, 0).astype(np.uint8)
    is_used = np.concatenate([value != 0, rest != 0], axis=1)
    return Rows(((data, is_used),), np.count_nonzero(is_used, axis=1))


def text_field(number: int, text: str, n: int) -> Rows:
    """Encode the same text in n rows."""
    content = text.encode()
    field = length_delimited(number, content) if content else b""
    data = np.broadcast_to(np.frombuffer(field, np.uint8), (n, len(field)))
    return Rows(((data, np.ones(data.shape, bool)),), np.full(n, len(field)))


def timestamp_field(number: int, time_ns: NDArray[np.int64]) -> Rows:
    """Encode times (n,) in ns since 1970 as ``google.protobuf.Timestamp``."""
    seconds, nanos = np.divmod(time_ns, 1_000_000_000)
    return message_field(number, [integer_field(1, seconds), integer_field(2, nanos)])
