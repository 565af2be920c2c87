"""DotBot gateway: Lighthouse 2 payloads of robots, in HDLC frames over a serial port.

**HDLC.** A frame is enclosed by flags 0x7E; between two frames there are one or two of them. A
flag or an escape byte 0x7D in the content is sent as 0x7D and the byte with bit 5 inverted. The
last two bytes are the FCS-16 of the others, little-endian (CRC-16/X.25; RFC 1662, appendix C;
DotBot-firmware ``drv/hdlc/hdlc.c``).

**Payloads.** Three generations of the protocol and one firmware without headers are
distinguished by length and content. All numbers are little-endian. A frame that fits no layout
is counted as unknown: commands, keep-alives, events of the gateway itself.

=====================  ================================================  ==================
generation             before the payload                                identified by
=====================  ================================================  ==================
2023 (versions 8, 9)   dst u64, src u64, swarm u16, app u8, version u8,  version at 19
                       message u32 (random, not a counter), type u8
2025                   version u8, packet u8, dst u64, src u64, type u8  version 1 at 0
2026, over Mari        event u8, version u8, packet u8, network u16,     3, 3, 16 at 0 and
                       dst u64, src u64, protocol u8, type u8            0x11 at 21
calibration firmware   nothing                                           9 bytes, in range
=====================  ================================================  ==================

=====================  ====  ==============================================================
payload                type  content
=====================  ====  ==============================================================
raw data               2     2 windows; since 2025 one
                       13    since 2025: count u8, windows
processed data         12    polynomial u8, LFSR index u32, time in us u32 (11 in PyDotBot
                             of early version 9)
robot data             6     until 2025: direction i16, 2 windows
location               3     until 2025: x, y, z u32, millionths of the calibration square
advertisement          6     since 2025: calibrated u8, direction i16, x, y u32 in mm,
                             battery u16 in mV, 20 other bytes (28 since 2026)
calibration            -     station u8 from 0, count u32, count u32
=====================  ====  ==============================================================

A window is bits u64, polynomial u8, offset i8: 64 bits of light, most significant bit first, of
which the first ``offset`` are unreliable. Its count is the LFSR index of the 17 bits after
those, minus the offset: the index of its first bit. Robots that decode the window themselves
subtract the offset (DotBot-firmware ``lh2.c``) or not (PyDotBot of 2023); their counts are
stored as received. A polynomial above 31 or an index beyond the sequence is a robot's error
marker, and gives no sweep.

Sources: PyDotBot ``protocol.py``, PyDotBot-utils, DotBot-libs ``frame.h`` and ``protocol.h``,
dotbot-lh2-calibration ``main.c``.
"""

from __future__ import annotations

import re
from binascii import crc_hqx
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from hashlib import blake2b
from itertools import groupby
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.lighthouse import lfsr
from locatk.core.lighthouse.channels import CHANNELS, POLYNOMIAL_COUNT, channel_of
from locatk.core.lighthouse.recording import UNKNOWN
from locatk.formats.devices.interface import Batch, Counts, Options, Recording, Stream, Ticks

FLAG = b"\x7e"
ESCAPE = b"\x7d"
ESCAPED_FLAG = b"\x7d\x5e"
ESCAPED_ESCAPE = b"\x7d\x5d"

MAX_FRAME_BYTES = 1024
"""Longest frame between two flags; DotBot frames have about 500 bytes at most."""

_REVERSED_BITS = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))
_VALID_FCS = int(f"{0xF0B8:016b}"[::-1], 2)
"""CRC over a valid frame with its FCS. X.25 starts with the least significant bit of a byte,
``crc_hqx`` with the most significant one, so that bits of bytes and of the CRC are reversed."""


class HdlcDecoder:
    """Extracts payloads from a byte stream; updates ``frames``, ``bad`` and ``skipped``."""

    def __init__(self, counts: Counts) -> None:
        self._counts = counts
        self._base = 0  # bytes before the rest
        self._rest = b""
        self._discarded = 0  # bytes of the current frame, if it is too long
        self._has_flag = False
        self._has_frame = False

    def feed(self, data: bytes) -> list[tuple[int, bytes]]:
        """Return the payloads of the frames that ``data`` completes.

        Each comes with the number of bytes fed up to and including its closing flag.
        """
        *pieces, rest = (self._rest + data).split(FLAG)
        payloads = []
        for piece in pieces:
            self._base += len(piece) + 1
            payload = None if self._discarded or not self._has_flag else decode_hdlc(piece)
            if payload is not None:
                payloads.append((self._base, payload))
                self._counts.frames += 1
                self._has_frame = True
            elif self._has_frame and (piece or self._discarded):
                self._counts.bad += 1
                self._counts.skipped += self._discarded + len(piece)
            self._has_flag, self._discarded = True, 0
        if self._discarded + len(rest) > MAX_FRAME_BYTES:
            self._base += len(rest)
            self._discarded += len(rest)
            rest = b""
        self._rest = rest
        return payloads

    def restart(self) -> None:
        """Discard a partial frame; the next bytes may begin within a frame."""
        self._base += len(self._rest)
        self._rest, self._discarded = b"", 0
        self._has_flag = self._has_frame = False


def encode_hdlc(payload: bytes) -> bytes:
    """Return the frame of a payload, with both flags."""
    crc = crc_hqx(payload.translate(_REVERSED_BITS), 0xFFFF) ^ 0xFFFF
    body = payload + bytes([_REVERSED_BITS[crc >> 8], _REVERSED_BITS[crc & 0xFF]])
    body = body.replace(ESCAPE, ESCAPED_ESCAPE).replace(FLAG, ESCAPED_FLAG)
    return FLAG + body + FLAG


def decode_hdlc(body: bytes) -> bytes | None:
    """Return the payload of the bytes between two flags; None if they are no valid frame."""
    if not 2 <= len(body) <= MAX_FRAME_BYTES:
        return None
    if ESCAPE in body:
        if body.count(ESCAPE) != body.count(ESCAPED_FLAG) + body.count(ESCAPED_ESCAPE):
            return None
        body = body.replace(ESCAPED_FLAG, FLAG).replace(ESCAPED_ESCAPE, ESCAPE)
    return body[:-2] if crc_hqx(body.translate(_REVERSED_BITS), 0xFFFF) == _VALID_FCS else None


# ---- payloads

Columns = dict[str, NDArray[Any]]
Frames = NDArray[np.void]
Index = NDArray[np.int64]

SWEEPS = Stream("lighthouse")
TIMED_SWEEPS = Stream("lighthouse", ticks=Ticks(1e6, 32))
CAPTURES = Stream("captures")
OLD_READINGS = Stream("readings", names=("direction_deg", "x", "y", "z"))
READINGS = Stream("readings", names=("direction_deg", "x_m", "y_m", "battery_v"))
"""Values that a payload does not contain, or marks as unknown, are NaN."""

UNKNOWN_COORDINATE = 0xFFFFFFFF
"""Marks an unknown coordinate of an advertisement."""

MAX_DIRECTION_DEG = 500
"""A robot sends a larger value if its direction is unknown."""

MAX_WINDOWS = 16
"""Windows of a raw payload of type 13."""

_WINDOW = [("bits", "<u8"), ("polynomial", "u1"), ("offset", "i1")]
_PROCESSED = [("polynomial", "u1"), ("index", "<u4"), ("time", "<u4")]
_ADVERTISEMENT = [
    ("calibrated", "u1"),
    ("direction", "<i2"),
    ("x", "<u4"),
    ("y", "<u4"),
    ("battery", "<u2"),
]
_ADDRESSES = [("dst", "<u8"), ("src", "<u8")]
_HEADER_2023 = [*_ADDRESSES, ("swarm", "<u2"), ("app", "u1"), ("version", "u1"), ("message", "<u4"),
        ("type", "u1")]  # fmt: skip
_HEADER_2025 = [("version", "u1"), ("packet", "u1"), *_ADDRESSES, ("type", "u1")]
_HEADER_MARI = [("event", "u1"), ("version", "u1"), ("packet", "u1"), ("network", "<u2"),
                *_ADDRESSES, ("protocol", "u1"), ("type", "u1")]  # fmt: skip


@dataclass(frozen=True)
class _FrameRecords:
    """Records of one stream, and the index of the frame of each."""

    stream: Stream
    frame: Index
    columns: Columns
    tick: Index | None = None


_Reader = Callable[[Frames, Index], list[_FrameRecords]]


@dataclass(frozen=True)
class _PayloadLayout:
    """Header and payload of one kind of frame, with the valid ranges of its fields.

    Attributes
    ----------
    dtype : dtype
    ranges : tuple of (str, int, int)
        Field, smallest and largest value.
    read : callable
        Converts contents and frame indices to records.
    has_source : bool
        The header contains the address of the robot.
    """

    dtype: np.dtype[np.void]
    ranges: tuple[tuple[str, int, int], ...]
    read: _Reader
    has_source: bool


class GatewayDecoder:
    """Decoder of a DotBot gateway: sweeps, windows of bits and readings of its robots.

    The node of a stream is the robot's address as 16 hexadecimal digits; the calibration
    firmware sends none. Frames do not state the light plane of a sweep.
    """

    def __init__(self, options: Options) -> None:
        self.counts = Counts()
        self.remarks: list[str] = []
        self._hdlc = HdlcDecoder(self.counts)
        lfsr.tables()  # They take 0.1 s, which is better spent before the first frame.

    def feed(self, data: bytes, *, pause: bool = False) -> list[Batch]:
        """Return the records of the frames that these bytes complete."""
        self.counts.bytes += len(data)
        frames = self._hdlc.feed(data)
        indices_by_length: dict[int, list[int]] = defaultdict(list)
        for index, (_, payload) in enumerate(frames):
            indices_by_length[len(payload)].append(index)
        ends = np.array([end for end, _ in frames], np.int64)
        source = np.zeros(len(frames), np.uint64)
        records: dict[tuple[Stream, bool], list[_FrameRecords]] = defaultdict(list)
        for length, indices in indices_by_length.items():
            unmatched = np.array(indices)
            for layout in _layouts().get(length, ()):
                content = np.frombuffer(b"".join(frames[k][1] for k in unmatched), layout.dtype)
                fits = np.ones(len(unmatched), bool)
                for field, low, high in layout.ranges:
                    fits &= (content[field] >= low) & (content[field] <= high)
                content, matched, unmatched = content[fits], unmatched[fits], unmatched[~fits]
                if layout.has_source:
                    source[matched] = content["src"]
                for part in layout.read(content, matched):
                    records[part.stream, layout.has_source].append(part)
            self.counts.unknown += len(unmatched)
        return [
            batch
            for (stream, has_source), parts in records.items()
            for batch in _batches(stream, has_source, parts, ends, source)
        ]

    def restart(self) -> list[Batch]:
        """Discard a partial frame after a reconnect."""
        self._hdlc.restart()
        return []

    def finish(self) -> list[Batch]:
        """Return nothing, because no record is held back."""
        return []


def _batches(
    stream: Stream,
    has_source: bool,
    parts: list[_FrameRecords],
    ends: Index,
    source: NDArray[np.uint64],
) -> Iterator[Batch]:
    """Yield the records of all layouts as one batch per robot, in the order of their frames."""
    frame = np.concatenate([part.frame for part in parts])
    order = np.argsort(frame, kind="stable")
    robot = source[frame[order]]
    ticks = [part.tick for part in parts if part.tick is not None]
    for address in np.unique(robot):
        rows = order[robot == address]
        yield Batch(
            replace(stream, node=f"{address:016x}" if has_source else ""),
            ends[frame[rows]],
            {
                name: np.concatenate([part.columns[name] for part in parts])[rows]
                for name in parts[0].columns
            },
            np.concatenate(ticks)[rows] if ticks else None,
        )


def _sweeps(channel: NDArray[Any], polynomial: NDArray[Any], count: NDArray[Any]) -> Columns:
    n = len(count)
    return {
        "sensor": np.zeros(n, np.int32),
        "channel": channel.astype(np.int32),
        "polynomial": polynomial.astype(np.int32),
        "sweep": np.full(n, UNKNOWN, np.int32),
        "count": count.astype(np.float64),
    }


def _raw(content: Frames, frame: Index) -> list[_FrameRecords]:
    """Return the windows, and the sweeps of those whose bits are in their sequence."""
    windows = content["windows"]
    frame = np.repeat(frame, windows.shape[1])
    windows = windows.ravel()
    bits, offset = windows["bits"], windows["offset"].astype(np.int64)
    polynomial = windows["polynomial"].astype(np.int64)
    is_known = polynomial < POLYNOMIAL_COUNT
    captures = {
        "sensor": np.zeros(len(bits), np.int32),
        "bits": bits,
        "polynomial": np.where(is_known, polynomial, UNKNOWN).astype(np.int32),
        "bit_offset": offset.astype(np.int32),
    }
    is_valid = is_known & (offset >= 0) & (offset <= 64 - lfsr.REGISTER_BITS)
    count = np.full(len(bits), lfsr.NO_INDEX)
    count[is_valid] = lfsr.window_index(bits[is_valid], offset[is_valid], polynomial[is_valid])
    is_valid &= count != lfsr.NO_INDEX
    sweeps = _sweeps(channel_of(polynomial[is_valid]), polynomial[is_valid], count[is_valid])
    return [
        _FrameRecords(CAPTURES, frame, captures),
        _FrameRecords(SWEEPS, frame[is_valid], sweeps),
    ]


def _robot_data(content: Frames, frame: Index) -> list[_FrameRecords]:
    return [*_raw(content, frame), _readings(OLD_READINGS, frame, [_direction(content)])]


def _processed(content: Frames, frame: Index) -> list[_FrameRecords]:
    is_valid = (content["polynomial"] < POLYNOMIAL_COUNT) & (
        content["index"] < lfsr.SEQUENCE_LENGTH
    )
    content, polynomial = content[is_valid], content["polynomial"][is_valid]
    sweeps = _sweeps(channel_of(polynomial), polynomial, content["index"])
    return [_FrameRecords(TIMED_SWEEPS, frame[is_valid], sweeps, content["time"].astype(np.int64))]


def _location(content: Frames, frame: Index) -> list[_FrameRecords]:
    values = [content[name] * 1e-6 for name in ("x", "y", "z")]
    return [_readings(OLD_READINGS, frame, [np.full(len(frame), np.nan), *values])]


def _advertisement(content: Frames, frame: Index) -> list[_FrameRecords]:
    x, y = (
        np.where(content[name] == UNKNOWN_COORDINATE, np.nan, content[name] * 1e-3) for name in "xy"
    )
    return [_readings(READINGS, frame, [_direction(content), x, y, content["battery"] * 1e-3])]


def _direction(content: Frames) -> NDArray[np.float64]:
    value = content["direction"].astype(np.float64)
    return np.where(np.abs(value) > MAX_DIRECTION_DEG, np.nan, value)


def _readings(stream: Stream, frame: Index, values: list[NDArray[np.float64]]) -> _FrameRecords:
    value = np.full((len(frame), len(stream.names)), np.nan)
    value[:, : len(values)] = np.stack(values, axis=1)
    return _FrameRecords(stream, frame, {"value": value})


def _calibration(content: Frames, frame: Index) -> list[_FrameRecords]:
    channel = np.repeat(content["station"].astype(np.int64) + 1, 2)
    count = np.stack([content["first"], content["second"]], axis=1).ravel()
    sweeps = _sweeps(channel, np.full(len(count), UNKNOWN), count)
    return [_FrameRecords(SWEEPS, np.repeat(frame, 2), sweeps)]


@cache
def _layouts() -> dict[int, list[_PayloadLayout]]:
    """Return the layouts of all frames by their length."""
    layouts: dict[int, list[_PayloadLayout]] = defaultdict(list)

    def add(header: list[Any], ranges: list[Any], payload: list[Any], read: _Reader) -> None:
        layout = _PayloadLayout(np.dtype([*header, *payload]), tuple(ranges), read, bool(header))
        layouts[layout.dtype.itemsize].append(layout)

    def type_range(first: int, last: int | None = None) -> tuple[str, int, int]:
        return "type", first, first if last is None else last

    def windows(n: int) -> tuple[str, list[tuple[str, str]], tuple[int]]:
        return "windows", _WINDOW, (n,)

    version = ("version", 8, 9)
    add(_HEADER_2023, [version, type_range(2)], [windows(2)], _raw)
    add(_HEADER_2023, [version, type_range(6)], [("direction", "<i2"), windows(2)], _robot_data)
    add(_HEADER_2023, [version, type_range(3)], [(name, "<u4") for name in "xyz"], _location)
    add(_HEADER_2023, [version, type_range(11, 12)], _PROCESSED, _processed)
    mari = [("event", 3, 3), ("version", 3, 3), ("packet", 16, 16), ("protocol", 0x11, 0x11)]
    for header, fixed in ((_HEADER_2025, [("version", 1, 1)]), (_HEADER_MARI, mari)):
        add(header, [*fixed, type_range(2)], [windows(1)], _raw)
        for n in range(1, MAX_WINDOWS + 1):
            add(header, [*fixed, type_range(13), ("n", n, n)], [("n", "u1"), windows(n)], _raw)
        add(header, [*fixed, type_range(12)], _PROCESSED, _processed)
        for rest in ("V20", "V28"):
            add(
                header,
                [*fixed, type_range(6)],
                [*_ADVERTISEMENT, ("rest", rest)],
                _advertisement,
            )
    ranges = [("station", 0, len(CHANNELS) - 1)]
    ranges += [(name, 0, lfsr.SEQUENCE_LENGTH - 1) for name in ("first", "second")]
    calibration = [("station", "u1"), ("first", "<u4"), ("second", "<u4")]
    add([], ranges, calibration, _calibration)
    return layouts


def robot_address(name: str) -> int:
    """Return the 64-bit address of a robot called ``name``.

    A name of 16 hexadecimal digits is the address; of any other name it is a hash
    (BLAKE2b of 8 bytes, little-endian).
    """
    if re.fullmatch("[0-9a-fA-F]{16}", name):
        return int(name, 16)
    return int.from_bytes(blake2b(name.encode(), digest_size=8).digest(), "little")


def encode(recording: Recording) -> Iterator[tuple[int, bytes]]:
    """Return (time in ns, bytes) of a gateway whose robots send processed data of version 9.

    Each device gets its :func:`robot_address`. Counts are rounded to integers.

    Raises
    ------
    InputError
        There are no sweeps of sensor 0; a DotBot has only this photodiode.
    """
    sweeps, usable = recording.sweeps, np.zeros(0, bool)
    if sweeps is not None:
        usable = (sweeps.sensor == 0) & np.isin(sweeps.channel, CHANNELS)
        usable &= (sweeps.count >= 0) & (sweeps.count < lfsr.SEQUENCE_LENGTH - 0.5)
    if sweeps is None or not np.any(usable):
        raise InputError(
            "no sweeps that a DotBot receives", hint="Give a session with sweeps of sensor 0"
        )
    rows = np.flatnonzero(usable)
    rows = rows[np.argsort(sweeps.time_ns[rows], kind="stable")]
    channel, polynomial = sweeps.channel[rows], sweeps.polynomial[rows]
    frames = np.zeros(len(rows), np.dtype([*_HEADER_2023, *_PROCESSED]))
    addresses = np.array([robot_address(name) for name in sweeps.devices], np.uint64)
    frames["src"] = addresses[sweeps.device[rows]]
    frames["version"], frames["type"] = 9, 12
    matches = polynomial >> 1 == channel - 1
    frames["polynomial"] = np.where(matches, polynomial, 2 * (channel - 1))
    frames["index"] = np.rint(sweeps.count[rows])
    frames["time"] = sweeps.time_ns[rows] // 1000 & 0xFFFFFFFF
    return _group_by_time(sweeps.time_ns[rows].tolist(), frames)


def _group_by_time(times: list[int], frames: Frames) -> Iterator[tuple[int, bytes]]:
    for time_ns, group in groupby(zip(times, frames, strict=True), key=itemgetter(0)):
        yield time_ns, b"".join(encode_hdlc(frame.tobytes()) for _, frame in group)
