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

from locatk.core.lighthouse.channels import channel_of
from locatk.core.lighthouse.recording import UNKNOWN
from locatk.formats.devices.interface import Ticks
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

DECK_SENSORS = 4
"""Photodiodes of the Lighthouse deck."""

DECK_TICKS = Ticks(24e6, 24, "deck")
"""Clock of the Lighthouse deck (bitcraze/lighthouse-fpga, readme)."""

MAX_DECK_DELAY_TICKS = 10_000
"""Longest time between two pulses of one passage of a light plane over the deck: 0.4 ms, in which
the rotor turns by 7.5 degrees. Later pulses are of another passage (crazyflie-firmware
``pulse_processor_v2.c`` separates passages by the same limit; ``lighthouse_transmit.c``, which
sends them, does not)."""

HALF_WIDTH_TICKS, MIN_HALF_WIDTH_TICKS, MAX_HALF_WIDTH_TICKS = 150, 40, 500
"""Half of the width of a pulse on the Lighthouse deck: typical, shortest and longest. Published
frames of a deck have widths of 272 to 327 ticks (lighthouse-fpga, readme); near a station, pulses
are longer in proportion."""

MAX_QUATERNION_ERROR = 0.01
"""Largest deviation of the length of a quaternion from 1, for values of half precision."""

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
_DECK_PASSAGE = np.dtype(
    [("head", "u1", 3), ("reference", "u1", 3), ("delay", "<i2", DECK_SENSORS)]
)
_ABSENT_DELAY = 0x7FFF
_TICKS_PER_COUNT = 4


class Type(IntEnum):
    """Type of a frame, the first byte of its header."""

    HELLO = 1
    TEXT = 2
    MAGNETOMETERS = 3
    HALLS = 4
    ODOMETRY = 5
    LIGHTHOUSE_CAPTURE = 6
    LIGHTHOUSE_SWEEP = 7
    IMU = 8
    POSE = 9
    LIGHTHOUSE_DECK = 10


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
    """Return the payload of samples (k, N, values of a sensor) or (k, N).

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
        As in :class:`.interface.Stream`.
    valid : (n,) bool ndarray
        Frames whose values are all valid.
    tick : (n, k) int64 ndarray
    columns : dict of str to (n, k, ...) ndarray
        As in :class:`.interface.Batch`.
    ticks : Ticks or None
        Counter of ``tick``, if it is not that of the headers.
    is_present : (n, k) bool ndarray or None
        Records that there are; None if all are.
    unused : int
        Measurements in valid frames that give no record.
    """

    kind: str
    sensors: int
    valid: NDArray[np.bool_]
    tick: NDArray[np.int64]
    columns: dict[str, NDArray[Any]]
    ticks: Ticks | None = None
    is_present: NDArray[np.bool_] | None = None
    unused: int = 0


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


def _read_imu(payloads: Bytes, tick: NDArray[np.int64]) -> Block | None:
    series_data = _read_series(payloads, tick, 6, 0)
    if series_data is None or series_data.values.shape[2] != 6:
        return None
    columns: dict[str, NDArray[Any]] = {
        "acceleration_m_s2": series_data.values[..., :3],
        "angular_rate_rad_s": series_data.values[..., 3:],
    }
    return Block("imu", 0, series_data.valid, series_data.tick, columns)


def _read_poses(payloads: Bytes, tick: NDArray[np.int64]) -> Block | None:
    series_data = _read_series(payloads, tick, 7, 0)
    if series_data is None or series_data.values.shape[2] != 7:
        return None
    position, quaternion = series_data.values[..., :3], series_data.values[..., 3:]
    length = np.linalg.norm(quaternion, axis=2)
    with np.errstate(invalid="ignore"):
        valid = series_data.valid & np.isfinite(position).all((1, 2))
        valid &= np.logical_and.reduce(np.abs(length - 1) <= MAX_QUATERNION_ERROR, axis=1)
    columns: dict[str, NDArray[Any]] = {
        "position_m": position,
        "quaternion_xyzw": quaternion / np.where(valid[:, None], length, 1.0)[..., None],
    }
    return Block("poses", 0, valid, series_data.tick, columns)


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


def _read_deck(payloads: Bytes, tick: NDArray[np.int64]) -> Block | None:
    """Read passages of light planes over the Lighthouse deck, as a Crazyflie sends them.

    The reference is the start of the pulse whose offset was found, and delays are those of the
    middles of all pulses. Sweeps refer to the starts of pulses, as in the frames of the deck and in
    the Crazyflie, so that their scenes agree: half of the width of the reference pulse is
    subtracted.
    """
    passages = _read_records(payloads, _DECK_PASSAGE)
    if passages is None:
        return None
    byte_weights = np.array([1, 1 << 8, 1 << 16])
    head = passages["head"] @ byte_weights
    reference = passages["reference"] @ byte_weights
    # In the order of the pulses, because times of a stream must ascend.
    sensor = np.argsort(passages["delay"], axis=2, kind="stable")
    delay = np.take_along_axis(passages["delay"], sensor, axis=2).astype(np.int64)
    is_received = delay != _ABSENT_DELAY
    offset = (head & 0x1FFFF)[..., None]
    start = delay - _reference_half_width(delay)[..., None]
    count = offset + start / _TICKS_PER_COUNT
    is_present = is_received & (np.abs(delay) <= MAX_DECK_DELAY_TICKS) & (offset > 0) & (count >= 0)
    valid = np.logical_and.reduce(head & 0xC0000 == 0, axis=1)
    polynomial = (head >> 20 << 1 | head >> 17 & 1).astype(np.int32)[..., None]
    values = {
        "sensor": sensor.astype(np.int32),
        "channel": channel_of(polynomial).astype(np.int32),
        "polynomial": polynomial,
        "sweep": np.int32(UNKNOWN),
        "count": count,
    }
    size = (len(payloads), passages.shape[1] * DECK_SENSORS)
    columns: dict[str, NDArray[Any]] = {
        name: np.broadcast_to(value, delay.shape).reshape(size) for name, value in values.items()
    }
    return Block(
        "lighthouse",
        DECK_SENSORS,
        valid,
        ((reference[..., None] + start) & (1 << DECK_TICKS.bits) - 1).reshape(size),
        columns,
        DECK_TICKS,
        is_present.reshape(size),
        int(np.count_nonzero(is_received[valid] & ~is_present[valid])),
    )


def _reference_half_width(delay: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return half of the width (n, m) of the pulses with the offsets, in ticks.

    It is the delay of that pulse. Which one it is was not sent. The deck identifies a station from
    two pulses, and then finds the offset: it is the second pulse if that has a possible delay,
    otherwise the one with the most typical delay.

    Parameters
    ----------
    delay : (n, m, 4) ndarray
        Ascending along the last axis.
    """
    is_possible = (delay >= MIN_HALF_WIDTH_TICKS) & (delay <= MAX_HALF_WIDTH_TICKS)
    distance = np.where(is_possible, np.abs(delay - HALF_WIDTH_TICKS), np.iinfo(np.int64).max)
    pulse = np.where(is_possible[..., 1], 1, np.argmin(distance, axis=2))[..., None]
    half_width = np.take_along_axis(delay, pulse, axis=2)[..., 0]
    return np.where(is_possible.any(axis=2), half_width, HALF_WIDTH_TICKS)


def _in_range(values: NDArray[Any], low: int, high: int) -> NDArray[np.bool_]:
    inside: NDArray[np.bool_] = (values >= low) & (values <= high)
    return inside


SERIES = (Type.MAGNETOMETERS, Type.HALLS, Type.ODOMETRY, Type.IMU, Type.POSE)
"""Types whose layout follows from the size and the first :data:`SHAPE_BYTES` bytes; that of the
others follows from the size."""

SHAPE_BYTES = 4

READERS: dict[Type, Callable[[Bytes, NDArray[np.int64]], Block | None]] = {
    Type.MAGNETOMETERS: _read_magnetometers,
    Type.HALLS: _read_halls,
    Type.ODOMETRY: _read_odometry,
    Type.LIGHTHOUSE_CAPTURE: _read_captures,
    Type.LIGHTHOUSE_SWEEP: _read_sweeps,
    Type.IMU: _read_imu,
    Type.POSE: _read_poses,
    Type.LIGHTHOUSE_DECK: _read_deck,
}
"""Functions that convert payloads (n, size) of one layout and the ticks (n,) of their headers to a
block, or None if there is no such layout. Types without records are parsed one by one."""
