"""What frames of the locatk protocol say: headers and payloads, to bytes and back.

One frame is made at a time, as a firmware does it; frames of one layout are read together,
a row each. docs/firmware/README.md has the tables; all numbers are little-endian.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from locatk.formats.devices.locatk_frames.framing import Bytes, seal

VERSION = 1
"""Of the protocol, as HELLO tells it."""

HEADER = np.dtype([("type", "u1"), ("node", "u1"), ("sequence", "<u2"), ("tick", "<u4")])
"""Of each content."""

COUNTS, TEMPERATURE = 1, 2
"""Flags of a series: int16 counts in place of float32; a temperature a sample."""

MISSING = -(1 << 15)
"""The count that says that a sensor gave nothing."""

LONGEST_TICKS = 1 << 31
"""What a series lasts is less: half of what a tick can tell."""

COUNT_STEPS = 256
"""Parts of a step of the 6 MHz bit clock."""

COUNT_END = (1 << 17) * COUNT_STEPS
"""Counts of sweeps are below: the sequence has 2^17 - 1 states."""

_HEADER = struct.Struct("<BBHI")
_SERIES = struct.Struct("<BBBBI")
_HELLO = struct.Struct("<B3xI")
_CAPTURE = np.dtype(
    [
        ("tick", "<u4"),
        ("sensor", "u1"),
        ("polynomial", "i1"),
        ("bit_offset", "i1"),
        ("zero", "u1"),
        ("bits", "<u8"),
    ]
)
_SWEEP = np.dtype(
    [
        ("tick", "<u4"),
        ("sensor", "u1"),
        ("channel", "u1"),
        ("polynomial", "i1"),
        ("sweep", "i1"),
        ("count", "<u4"),
    ]
)


class Type(IntEnum):
    """First byte of a header."""

    HELLO = 1
    TEXT = 2
    MAGNETOMETERS = 3
    HALLS = 4
    ODOMETRY = 5
    LIGHTHOUSE_CAPTURE = 6
    LIGHTHOUSE_SWEEP = 7


class FrameWriter:
    """Frames of one node, numbered: what ``locatk_frame.h`` does on a device.

    Parameters
    ----------
    node : int
        0 to 255.
    """

    def __init__(self, node: int = 0) -> None:
        self.node = node
        self.sequence = 0

    def frame(self, type: int, tick: int, payload: bytes) -> bytes:
        """The next frame; ``tick`` is taken modulo 2^32.

        Raises
        ------
        ValueError
            The payload is longer than a frame can be.
        """
        header = _HEADER.pack(type, self.node, self.sequence, tick & 0xFFFFFFFF)
        self.sequence = (self.sequence + 1) & 0xFFFF
        return seal(header + payload)


def hello(tick_hz: int, name: str) -> bytes:
    """Who sends, and how fast its clock counts."""
    return _HELLO.pack(VERSION, tick_hz) + name.encode()


def text(level: int, words: str) -> bytes:
    """A line for people; ``level`` as in :class:`.decoder.Batch`."""
    return bytes([level]) + words.encode()


def series(
    values: ArrayLike,
    step: int,
    *,
    scale: float | None = None,
    temperature: ArrayLike | None = None,
) -> bytes:
    """Samples of magnetometers (k, N, 3) or hall sensors (k, N).

    Parameters
    ----------
    values : array_like
        Microtesla, or counts where ``scale`` is given.
    step : int
        Ticks from one sample to the next; 0 where there is only one.
    scale : float, optional
        Microtesla of a count.
    temperature : (k,) array_like, optional
        Degrees Celsius.
    """
    data = np.asarray(values)
    flags = (COUNTS if scale is not None else 0) | (TEMPERATURE if temperature is not None else 0)
    parts = [_SERIES.pack(data.shape[1], data.shape[0], flags, 0, step)]
    if scale is not None:
        parts.append(struct.pack("<f", scale))
    parts.append(data.astype("<f4" if scale is None else "<i2").tobytes())
    if temperature is not None:
        parts.append(np.asarray(temperature, "<f4").tobytes())
    return b"".join(parts)


def odometry(poses: ArrayLike, step: int) -> bytes:
    """Poses (k, 3): x and y in metres, heading in radians."""
    return series(np.asarray(poses)[:, None], step)


def captures(
    tick: ArrayLike,
    sensor: ArrayLike,
    polynomial: ArrayLike,
    bit_offset: ArrayLike,
    bits: ArrayLike,
) -> bytes:
    """Bits of Lighthouse sweeps, (k,) each, as in ``locatk.LighthouseCapture``."""
    return _records(
        _CAPTURE, tick=tick, sensor=sensor, polynomial=polynomial, bit_offset=bit_offset, bits=bits
    )


def sweeps(
    tick: ArrayLike,
    sensor: ArrayLike,
    channel: ArrayLike,
    polynomial: ArrayLike,
    sweep: ArrayLike,
    count: ArrayLike,
) -> bytes:
    """Lighthouse sweeps, (k,) each, as in :class:`locatk.core.lighthouse.recording.Sweeps`."""
    parts = np.rint(np.asarray(count, float) * COUNT_STEPS)
    return _records(
        _SWEEP,
        tick=tick,
        sensor=sensor,
        channel=channel,
        polynomial=polynomial,
        sweep=sweep,
        count=parts,
    )


def _records(dtype: np.dtype[np.void], **columns: ArrayLike) -> bytes:
    records = np.zeros(len(np.asarray(columns["tick"])), dtype)
    for name, column in columns.items():
        records[name] = column
    return records.tobytes()


@dataclass(frozen=True)
class Hello:
    """What HELLO says."""

    version: int
    tick_hz: int
    name: str


def read_hello(payload: bytes) -> Hello | None:
    """None where it cannot be."""
    if len(payload) < _HELLO.size:
        return None
    version, tick_hz = _HELLO.unpack_from(payload)
    reserved = any(payload[1:4]) and version == VERSION
    if not version or not tick_hz or reserved:
        return None
    return Hello(version, tick_hz, payload[_HELLO.size :].decode(errors="backslashreplace"))


def read_text(payload: bytes) -> tuple[int, str] | None:
    """Level and words; None where they cannot be."""
    if not payload or not 1 <= payload[0] <= 5:
        return None
    return payload[0], payload[1:].decode(errors="backslashreplace")


@dataclass(frozen=True)
class Block:
    """Records of n frames of one layout, k in each.

    Attributes
    ----------
    kind, sensors
        As in :class:`.decoder.Stream`.
    right : (n,) bool ndarray
        Frames that hold no value that cannot be.
    tick : (n, k) int64 ndarray
    columns : dict of str to (n, k, ...) ndarray
        As in :class:`.decoder.Batch`.
    """

    kind: str
    sensors: int
    right: NDArray[np.bool_]
    tick: NDArray[np.int64]
    columns: dict[str, NDArray[Any]]


@dataclass(frozen=True)
class _Series:
    """Values of a series of samples, before they have names."""

    right: NDArray[np.bool_]
    tick: NDArray[np.int64]
    values: NDArray[np.float64]
    temperature: NDArray[np.float64] | None


@np.errstate(invalid="ignore")  # of a signalling NaN that becomes a quiet one
def _read_series(payloads: Bytes, tick: NDArray[np.int64], axes: int, flags: int) -> _Series | None:
    """Values (n, k, N axes) of payloads that may have these flags."""
    if payloads.shape[1] < _SERIES.size:
        return None
    sensors, samples, told, zero = payloads[0, :SHAPE].tolist()
    if not sensors or not samples or told & ~flags or zero:
        return None
    scaled, warm = told & COUNTS, told & TEMPERATURE
    start = _SERIES.size + (4 if scaled else 0)
    middle = start + samples * sensors * axes * (2 if scaled else 4)
    if payloads.shape[1] != middle + (4 * samples if warm else 0):
        return None
    step = payloads[:, 4:8].view("<u4").astype(np.int64)
    right = np.ones(len(payloads), bool)
    if samples > 1:
        right = ((step > 0) & (step * (samples - 1) < LONGEST_TICKS))[:, 0]
    if scaled:
        scale = payloads[:, start - 4 : start].view("<f4").astype(float)
        right &= (np.isfinite(scale) & (scale > 0))[:, 0]
        counts = payloads[:, start:middle].view("<i2")
        values = np.where(counts == MISSING, np.nan, counts * scale)
    else:
        values = payloads[:, start:middle].view("<f4").astype(float)
        right &= ~np.isinf(values).any(1)
    return _Series(
        right,
        (tick[:, None] + step * np.arange(samples)) & 0xFFFFFFFF,
        values.reshape(len(payloads), samples, sensors * axes),
        payloads[:, middle:].view("<f4").astype(float) if warm else None,
    )


def _read_magnetometers(payloads: Bytes, tick: NDArray[np.int64]) -> Block | None:
    found = _read_series(payloads, tick, 3, COUNTS | TEMPERATURE)
    if found is None:
        return None
    columns: dict[str, NDArray[Any]] = {"b_tesla": found.values * 1e-6}
    right = found.right
    if found.temperature is not None:
        columns["temperature_celsius"] = found.temperature
        right = right & ~np.isinf(found.temperature).any(1)
    return Block("magnetometers", found.values.shape[2] // 3, right, found.tick, columns)


def _read_halls(payloads: Bytes, tick: NDArray[np.int64]) -> Block | None:
    found = _read_series(payloads, tick, 1, COUNTS)
    if found is None:
        return None
    columns = {"b_tesla": found.values * 1e-6}
    return Block("halls", found.values.shape[2], found.right, found.tick, columns)


def _read_odometry(payloads: Bytes, tick: NDArray[np.int64]) -> Block | None:
    found = _read_series(payloads, tick, 3, 0)
    if found is None or found.values.shape[2] != 3:
        return None
    right = found.right & np.isfinite(found.values).all((1, 2))
    names = ("x_m", "y_m", "heading_rad")
    columns = {name: found.values[..., axis] for axis, name in enumerate(names)}
    return Block("odometry", 0, right, found.tick, columns)


def _read_records(payloads: Bytes, dtype: np.dtype[np.void]) -> NDArray[np.void] | None:
    """Records (n, k); None where the length is of no number of them."""
    if not payloads.shape[1] or payloads.shape[1] % dtype.itemsize:
        return None
    records: NDArray[np.void] = payloads.view(dtype)
    return records


def _read_captures(payloads: Bytes, tick: NDArray[np.int64]) -> Block | None:
    records = _read_records(payloads, _CAPTURE)
    if records is None:
        return None
    right = _between(records["polynomial"], -1, 31) & (records["zero"] == 0)
    columns = {name: records[name] for name in ("sensor", "bits", "polynomial", "bit_offset")}
    return Block(
        "captures",
        0,
        np.logical_and.reduce(right, axis=1),
        records["tick"].astype(np.int64),
        columns,
    )


def _read_sweeps(payloads: Bytes, tick: NDArray[np.int64]) -> Block | None:
    records = _read_records(payloads, _SWEEP)
    if records is None:
        return None
    right = _between(records["channel"], 1, 16)
    right &= _between(records["polynomial"], -1, 31)
    right &= _between(records["sweep"], -1, 1)
    right &= records["count"] < COUNT_END
    names = ("sensor", "channel", "polynomial", "sweep")
    columns: dict[str, NDArray[Any]] = {name: records[name] for name in names}
    columns["count"] = records["count"] / COUNT_STEPS
    return Block(
        "lighthouse",
        0,
        np.logical_and.reduce(right, axis=1),
        records["tick"].astype(np.int64),
        columns,
    )


def _between(values: NDArray[Any], low: int, high: int) -> NDArray[np.bool_]:
    inside: NDArray[np.bool_] = (values >= low) & (values <= high)
    return inside


SERIES = (Type.MAGNETOMETERS, Type.HALLS, Type.ODOMETRY)
"""Types of which the length and the first :data:`SHAPE` bytes tell the layout; that of the
others the length alone."""

SHAPE = 4

READERS: dict[Type, Callable[[Bytes, NDArray[np.int64]], Block | None]] = {
    Type.MAGNETOMETERS: _read_magnetometers,
    Type.HALLS: _read_halls,
    Type.ODOMETRY: _read_odometry,
    Type.LIGHTHOUSE_CAPTURE: _read_captures,
    Type.LIGHTHOUSE_SWEEP: _read_sweeps,
}
"""How payloads (n, size) of one layout become a block, with the ticks (n,) of their headers;
None where there is no such layout. Of the types that hold records; the others are read one
by one."""
