"""Headers and payloads of the locatk protocol: encoding of one frame, parsing of many.

Frames are encoded one at a time, as a firmware does; frames of one layout are parsed together,
one row each. docs/firmware/README.md has the tables; all numbers are little-endian.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from locatk.formats.devices.locatk_frames.framing import Bytes, encode_frame

PROTOCOL_VERSION = 1
"""Version of the protocol, as sent in HELLO."""

HEADER = np.dtype([("type", "u1"), ("node", "u1"), ("sequence", "<u2"), ("tick", "<u4")])
"""Header of each content."""

HAS_COUNTS, HAS_TEMPERATURE = 1, 2
"""Flags of a series: int16 counts instead of float32; a temperature per sample."""

MISSING_COUNT = -(1 << 15)
"""Count of a sensor without a value."""

MAX_SERIES_TICKS = 1 << 31
"""Limit of the duration of a series: half of the range of a tick."""

COUNT_STEPS = 256
"""Fractions of a step of the 6 MHz bit clock."""

COUNT_LIMIT = (1 << 17) * COUNT_STEPS
"""Limit of the counts of sweeps: the sequence has 2^17 - 1 states."""

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
    """Type of a frame, the first byte of its header."""

    HELLO = 1
    TEXT = 2
    MAGNETOMETERS = 3
    HALLS = 4
    ODOMETRY = 5
    LIGHTHOUSE_CAPTURE = 6
    LIGHTHOUSE_SWEEP = 7


class FrameWriter:
    """Writes numbered frames of one node, as ``locatk_frame.h`` does on a device.

    Parameters
    ----------
    node : int
        0 to 255.
    """

    def __init__(self, node: int = 0) -> None:
        self.node = node
        self.sequence = 0

    def frame(self, type: int, tick: int, payload: bytes) -> bytes:
        """Return the next frame; ``tick`` is taken modulo 2^32.

        Raises
        ------
        ValueError
            The payload is too long for a frame.
        """
        header = _HEADER.pack(type, self.node, self.sequence, tick & 0xFFFFFFFF)
        self.sequence = (self.sequence + 1) & 0xFFFF
        return encode_frame(header + payload)


def hello(tick_hz: int, name: str) -> bytes:
    """Return the payload of HELLO: version, tick rate and name of the device."""
    return _HELLO.pack(PROTOCOL_VERSION, tick_hz) + name.encode()


def text(level: int, message: str) -> bytes:
    """Return the payload of a log message; ``level`` as in :class:`.decoder.Batch`."""
    return bytes([level]) + message.encode()


def series(
    values: ArrayLike,
    step: int,
    *,
    scale: float | None = None,
    temperature: ArrayLike | None = None,
) -> bytes:
    """Return the payload of samples of magnetometers (k, N, 3) or hall sensors (k, N).

    Parameters
    ----------
    values : array_like
        Microtesla, or counts if ``scale`` is given.
    step : int
        Ticks from one sample to the next; 0 for a single sample.
    scale : float, optional
        Microtesla per count.
    temperature : (k,) array_like, optional
        Degrees Celsius.
    """
    data = np.asarray(values)
    flags = (HAS_COUNTS if scale is not None else 0) | (
        HAS_TEMPERATURE if temperature is not None else 0
    )
    parts = [_SERIES.pack(data.shape[1], data.shape[0], flags, 0, step)]
    if scale is not None:
        parts.append(struct.pack("<f", scale))
    parts.append(data.astype("<f4" if scale is None else "<i2").tobytes())
    if temperature is not None:
        parts.append(np.asarray(temperature, "<f4").tobytes())
    return b"".join(parts)


def odometry(poses: ArrayLike, step: int) -> bytes:
    """Return the payload of poses (k, 3): x and y in metres, heading in radians."""
    return series(np.asarray(poses)[:, None], step)


def captures(
    tick: ArrayLike,
    sensor: ArrayLike,
    polynomial: ArrayLike,
    bit_offset: ArrayLike,
    bits: ArrayLike,
) -> bytes:
    """Return the payload of bits of sweeps, (k,) each, as in ``locatk.LighthouseCapture``."""
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
    """Return the payload of sweeps, (k,) each, as in ``locatk.LighthouseSweep``."""
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
    """Content of a HELLO."""

    version: int
    tick_hz: int
    name: str


def read_hello(payload: bytes) -> Hello | None:
    """Return the content of a HELLO; None if it is invalid."""
    if len(payload) < _HELLO.size:
        return None
    version, tick_hz = _HELLO.unpack_from(payload)
    reserved = any(payload[1:4]) and version == PROTOCOL_VERSION
    if not version or not tick_hz or reserved:
        return None
    return Hello(version, tick_hz, payload[_HELLO.size :].decode(errors="backslashreplace"))


def read_text(payload: bytes) -> tuple[int, str] | None:
    """Return level and text of a log message; None if it is invalid."""
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
    valid : (n,) bool ndarray
        Frames whose values are all valid.
    tick : (n, k) int64 ndarray
    columns : dict of str to (n, k, ...) ndarray
        As in :class:`.decoder.Batch`.
    """

    kind: str
    sensors: int
    valid: NDArray[np.bool_]
    tick: NDArray[np.int64]
    columns: dict[str, NDArray[Any]]


@dataclass(frozen=True)
class _Series:
    """Values of a series of samples, before they are assigned to columns."""

    valid: NDArray[np.bool_]
    tick: NDArray[np.int64]
    values: NDArray[np.float64]
    temperature: NDArray[np.float64] | None


@np.errstate(invalid="ignore")  # A signalling NaN becomes a quiet one.
def _read_series(payloads: Bytes, tick: NDArray[np.int64], axes: int, flags: int) -> _Series | None:
    """Return values (n, k, N axes) of payloads with some of ``flags``; None for another layout."""
    if payloads.shape[1] < _SERIES.size:
        return None
    sensors, samples, present, zero = payloads[0, :SHAPE_BYTES].tolist()
    if not sensors or not samples or present & ~flags or zero:
        return None
    has_counts, has_temperature = present & HAS_COUNTS, present & HAS_TEMPERATURE
    start = _SERIES.size + (4 if has_counts else 0)
    middle = start + samples * sensors * axes * (2 if has_counts else 4)
    if payloads.shape[1] != middle + (4 * samples if has_temperature else 0):
        return None
    step = payloads[:, 4:8].view("<u4").astype(np.int64)
    valid = np.ones(len(payloads), bool)
    if samples > 1:
        valid = ((step > 0) & (step * (samples - 1) < MAX_SERIES_TICKS))[:, 0]
    if has_counts:
        scale = payloads[:, start - 4 : start].view("<f4").astype(float)
        valid &= (np.isfinite(scale) & (scale > 0))[:, 0]
        counts = payloads[:, start:middle].view("<i2")
        values = np.where(counts == MISSING_COUNT, np.nan, counts * scale)
    else:
        values = payloads[:, start:middle].view("<f4").astype(float)
        valid &= ~np.isinf(values).any(1)
    return _Series(
        valid,
        (tick[:, None] + step * np.arange(samples)) & 0xFFFFFFFF,
        values.reshape(len(payloads), samples, sensors * axes),
        payloads[:, middle:].view("<f4").astype(float) if has_temperature else None,
    )


def _read_magnetometers(payloads: Bytes, tick: NDArray[np.int64]) -> Block | None:
    series_data = _read_series(payloads, tick, 3, HAS_COUNTS | HAS_TEMPERATURE)
    if series_data is None:
        return None
    columns: dict[str, NDArray[Any]] = {"b_tesla": series_data.values * 1e-6}
    valid = series_data.valid
    if series_data.temperature is not None:
        columns["temperature_celsius"] = series_data.temperature
        valid = valid & ~np.isinf(series_data.temperature).any(1)
    return Block(
        "magnetometers", series_data.values.shape[2] // 3, valid, series_data.tick, columns
    )


def _read_halls(payloads: Bytes, tick: NDArray[np.int64]) -> Block | None:
    series_data = _read_series(payloads, tick, 1, HAS_COUNTS)
    if series_data is None:
        return None
    columns = {"b_tesla": series_data.values * 1e-6}
    return Block("halls", series_data.values.shape[2], series_data.valid, series_data.tick, columns)


def _read_odometry(payloads: Bytes, tick: NDArray[np.int64]) -> Block | None:
    series_data = _read_series(payloads, tick, 3, 0)
    if series_data is None or series_data.values.shape[2] != 3:
        return None
    valid = series_data.valid & np.isfinite(series_data.values).all((1, 2))
    names = ("x_m", "y_m", "heading_rad")
    columns = {name: series_data.values[..., axis] for axis, name in enumerate(names)}
    return Block("odometry", 0, valid, series_data.tick, columns)


def _read_records(payloads: Bytes, dtype: np.dtype[np.void]) -> NDArray[np.void] | None:
    """Return records (n, k); None if the size is not a multiple of the record size."""
    if not payloads.shape[1] or payloads.shape[1] % dtype.itemsize:
        return None
    records: NDArray[np.void] = payloads.view(dtype)
    return records


def _read_captures(payloads: Bytes, tick: NDArray[np.int64]) -> Block | None:
    records = _read_records(payloads, _CAPTURE)
    if records is None:
        return None
    valid = _in_range(records["polynomial"], -1, 31) & (records["zero"] == 0)
    columns = {name: records[name] for name in ("sensor", "bits", "polynomial", "bit_offset")}
    return Block(
        "captures",
        0,
        np.logical_and.reduce(valid, axis=1),
        records["tick"].astype(np.int64),
        columns,
    )


def _read_sweeps(payloads: Bytes, tick: NDArray[np.int64]) -> Block | None:
    records = _read_records(payloads, _SWEEP)
    if records is None:
        return None
    valid = _in_range(records["channel"], 1, 16)
    valid &= _in_range(records["polynomial"], -1, 31)
    valid &= _in_range(records["sweep"], -1, 1)
    valid &= records["count"] < COUNT_LIMIT
    names = ("sensor", "channel", "polynomial", "sweep")
    columns: dict[str, NDArray[Any]] = {name: records[name] for name in names}
    columns["count"] = records["count"] / COUNT_STEPS
    return Block(
        "lighthouse",
        0,
        np.logical_and.reduce(valid, axis=1),
        records["tick"].astype(np.int64),
        columns,
    )


def _in_range(values: NDArray[Any], low: int, high: int) -> NDArray[np.bool_]:
    inside: NDArray[np.bool_] = (values >= low) & (values <= high)
    return inside


SERIES = (Type.MAGNETOMETERS, Type.HALLS, Type.ODOMETRY)
"""Types whose layout follows from the size and the first :data:`SHAPE_BYTES` bytes; that of the
others follows from the size."""

SHAPE_BYTES = 4

READERS: dict[Type, Callable[[Bytes, NDArray[np.int64]], Block | None]] = {
    Type.MAGNETOMETERS: _read_magnetometers,
    Type.HALLS: _read_halls,
    Type.ODOMETRY: _read_odometry,
    Type.LIGHTHOUSE_CAPTURE: _read_captures,
    Type.LIGHTHOUSE_SWEEP: _read_sweeps,
}
"""Functions that convert payloads (n, size) of one layout and the ticks (n,) of their headers to a
block, or None if there is no such layout. Types without records are parsed one by one."""
