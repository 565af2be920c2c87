"""The DotBot gateway: what robots tell of Lighthouse 2 light, in HDLC frames.

Three generations of the protocol and one firmware without any are told apart by length and
content, all numbers little-endian. A frame that fits none is counted as unknown: commands,
keep-alives, the gateway's own events.

=====================  ================================================  ==================
generation             before the payload                                told by
=====================  ================================================  ==================
2023 (versions 8, 9)   dst u64, src u64, swarm u16, app u8, version u8,  version at 19
                       message u32 (at random: no counter), type u8
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
                             battery u16 in mV, 20 bytes of other things (since 2026 or 28)
calibration            -     station u8 from 0, count u32, count u32
=====================  ====  ==============================================================

A window is bits u64, polynomial u8, offset i8: 64 bits of light, the first in the highest
place, of which the first ``offset`` are not trusted. Its count is the place of the 17 bits
after those, less the offset: that of its first bit. Robots that do so themselves take off
the offset (DotBot-firmware ``lh2.c``) or not (PyDotBot of 2023); their counts are kept as
they come. A polynomial above 31 or an index beyond the sequence is a robot's mark of an
error, and gives no sweep.

Source: PyDotBot ``protocol.py``, PyDotBot-utils, DotBot-libs ``frame.h`` and ``protocol.h``,
dotbot-lh2-calibration ``main.c``.
"""

from __future__ import annotations

import re
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
from locatk.formats.devices.decoder import Batch, Counts, Options, Stream, Ticks
from locatk.formats.devices.hdlc import HdlcDecoder, packed
from locatk.formats.devices.recording import Recording

Columns = dict[str, NDArray[Any]]
Frames = NDArray[np.void]
Index = NDArray[np.int64]

SWEEPS = Stream("lighthouse")
TIMED_SWEEPS = Stream("lighthouse", ticks=Ticks(1e6, 32))
CAPTURES = Stream("captures")
OLD_READINGS = Stream("readings", names=("direction_deg", "x", "y", "z"))
READINGS = Stream("readings", names=("direction_deg", "x_m", "y_m", "battery_v"))
"""A value that a payload does not tell, or tells to be unknown, is nan."""

UNKNOWN_PLACE = 0xFFFFFFFF
LARGEST_DIRECTION = 500
"""What is beyond says that a robot does not know its direction."""

MOST_WINDOWS = 16

_WINDOW = [("bits", "<u8"), ("polynomial", "u1"), ("offset", "i1")]
_PROCESSED = [("polynomial", "u1"), ("index", "<u4"), ("time", "<u4")]
_ADVERTISED = [
    ("calibrated", "u1"),
    ("direction", "<i2"),
    ("x", "<u4"),
    ("y", "<u4"),
    ("battery", "<u2"),
]
_ADDRESSES = [("dst", "<u8"), ("src", "<u8")]
_OLD = [*_ADDRESSES, ("swarm", "<u2"), ("app", "u1"), ("version", "u1"), ("message", "<u4"),
        ("type", "u1")]  # fmt: skip
_NEW = [("version", "u1"), ("packet", "u1"), *_ADDRESSES, ("type", "u1")]
_MARI = [("event", "u1"), ("version", "u1"), ("packet", "u1"), ("network", "<u2"), *_ADDRESSES,
         ("protocol", "u1"), ("type", "u1")]  # fmt: skip


@dataclass(frozen=True)
class _Rows:
    """Records of one kind: of which frames and robots."""

    stream: Stream
    frame: Index
    columns: Columns
    tick: Index | None = None


_Reader = Callable[[Frames, Index], list[_Rows]]


@dataclass(frozen=True)
class _Layout:
    """A whole payload with what is before it, and from where to where its fields can be."""

    dtype: np.dtype[np.void]
    ranges: tuple[tuple[str, int, int], ...]
    read: _Reader
    named: bool


class GatewayDecoder:
    """Sweeps, windows of bits and readings of the robots behind a DotBot gateway.

    The node of a stream is the robot's address as 16 hexadecimal digits; the calibration
    firmware has none. Sweeps are not told to be of the first or second plane.
    """

    def __init__(self, options: Options) -> None:
        self.counts = Counts()
        self.remarks: list[str] = []
        self._hdlc = HdlcDecoder(self.counts)

    def feed(self, data: bytes, *, pause: bool = False) -> list[Batch]:
        """Take the next bytes and give the records of the frames that they complete."""
        self.counts.bytes += len(data)
        frames = self._hdlc.feed(data)
        by_length: dict[int, list[int]] = defaultdict(list)
        for place, (_, payload) in enumerate(frames):
            by_length[len(payload)].append(place)
        ends = np.array([end for end, _ in frames], np.int64)
        source = np.zeros(len(frames), np.uint64)
        rows: dict[tuple[Stream, bool], list[_Rows]] = defaultdict(list)
        for length, places in by_length.items():
            left = np.array(places)
            for layout in _layouts().get(length, ()):
                content = np.frombuffer(b"".join(frames[k][1] for k in left), layout.dtype)
                fits = np.ones(len(left), bool)
                for field, low, high in layout.ranges:
                    fits &= (content[field] >= low) & (content[field] <= high)
                content, number, left = content[fits], left[fits], left[~fits]
                if layout.named:
                    source[number] = content["src"]
                for part in layout.read(content, number):
                    rows[part.stream, layout.named].append(part)
            self.counts.unknown += len(left)
        return [
            batch
            for (stream, named), parts in rows.items()
            for batch in _batches(stream, named, parts, ends, source)
        ]

    def restart(self) -> list[Batch]:
        """The connection was lost: what is half received is dropped."""
        self._hdlc.restart()
        return []

    def finish(self) -> list[Batch]:
        """No more bytes: nothing is held back."""
        return []


def _batches(
    stream: Stream, named: bool, parts: list[_Rows], ends: Index, source: NDArray[np.uint64]
) -> Iterator[Batch]:
    """Rows of all layouts, by robot, in the order of their frames."""
    frame = np.concatenate([rows.frame for rows in parts])
    order = np.argsort(frame, kind="stable")
    robot = source[frame[order]]
    ticks = [rows.tick for rows in parts if rows.tick is not None]
    for one in np.unique(robot):
        mine = order[robot == one]
        yield Batch(
            replace(stream, node=f"{one:016x}" if named else ""),
            ends[frame[mine]],
            {
                name: np.concatenate([rows.columns[name] for rows in parts])[mine]
                for name in parts[0].columns
            },
            np.concatenate(ticks)[mine] if ticks else None,
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


def _raw(content: Frames, frame: Index) -> list[_Rows]:
    """Windows, and the sweeps that they are of."""
    windows = content["windows"]
    frame = np.repeat(frame, windows.shape[1])
    windows = windows.ravel()
    bits, offset = windows["bits"], windows["offset"].astype(np.int64)
    polynomial = windows["polynomial"].astype(np.int64)
    known = polynomial < POLYNOMIAL_COUNT
    captures = {
        "sensor": np.zeros(len(bits), np.int32),
        "bits": bits,
        "polynomial": np.where(known, polynomial, UNKNOWN).astype(np.int32),
        "bit_offset": offset.astype(np.int32),
    }
    good = known & (offset >= 0) & (offset <= 64 - lfsr.REGISTER_BITS)
    count = np.full(len(bits), lfsr.NO_INDEX)
    count[good] = lfsr.window_index(bits[good], offset[good], polynomial[good])
    good &= count != lfsr.NO_INDEX
    sweeps = _sweeps(channel_of(polynomial[good]), polynomial[good], count[good])
    return [_Rows(CAPTURES, frame, captures), _Rows(SWEEPS, frame[good], sweeps)]


def _robot_data(content: Frames, frame: Index) -> list[_Rows]:
    return [*_raw(content, frame), _readings(OLD_READINGS, frame, [_direction(content)])]


def _processed(content: Frames, frame: Index) -> list[_Rows]:
    good = (content["polynomial"] < POLYNOMIAL_COUNT) & (content["index"] < lfsr.SEQUENCE_LENGTH)
    content, polynomial = content[good], content["polynomial"][good]
    sweeps = _sweeps(channel_of(polynomial), polynomial, content["index"])
    return [_Rows(TIMED_SWEEPS, frame[good], sweeps, content["time"].astype(np.int64))]


def _location(content: Frames, frame: Index) -> list[_Rows]:
    values = [content[name] * 1e-6 for name in ("x", "y", "z")]
    return [_readings(OLD_READINGS, frame, [np.full(len(frame), np.nan), *values])]


def _advertisement(content: Frames, frame: Index) -> list[_Rows]:
    x, y = (np.where(content[name] == UNKNOWN_PLACE, np.nan, content[name] * 1e-3) for name in "xy")
    return [_readings(READINGS, frame, [_direction(content), x, y, content["battery"] * 1e-3])]


def _direction(content: Frames) -> NDArray[np.float64]:
    value = content["direction"].astype(np.float64)
    return np.where(np.abs(value) > LARGEST_DIRECTION, np.nan, value)


def _readings(stream: Stream, frame: Index, values: list[NDArray[np.float64]]) -> _Rows:
    value = np.full((len(frame), len(stream.names)), np.nan)
    value[:, : len(values)] = np.stack(values, axis=1)
    return _Rows(stream, frame, {"value": value})


def _calibration(content: Frames, frame: Index) -> list[_Rows]:
    channel = np.repeat(content["station"].astype(np.int64) + 1, 2)
    count = np.stack([content["first"], content["second"]], axis=1).ravel()
    sweeps = _sweeps(channel, np.full(len(count), UNKNOWN), count)
    return [_Rows(SWEEPS, np.repeat(frame, 2), sweeps)]


@cache
def _layouts() -> dict[int, list[_Layout]]:
    """All layouts by length."""
    found: dict[int, list[_Layout]] = defaultdict(list)

    def add(header: list[Any], ranges: list[Any], payload: list[Any], read: _Reader) -> None:
        layout = _Layout(np.dtype([*header, *payload]), tuple(ranges), read, bool(header))
        found[layout.dtype.itemsize].append(layout)

    def kind(first: int, last: int | None = None) -> tuple[str, int, int]:
        return "type", first, first if last is None else last

    def windows(n: int) -> tuple[str, list[tuple[str, str]], tuple[int]]:
        return "windows", _WINDOW, (n,)

    old = ("version", 8, 9)
    add(_OLD, [old, kind(2)], [windows(2)], _raw)
    add(_OLD, [old, kind(6)], [("direction", "<i2"), windows(2)], _robot_data)
    add(_OLD, [old, kind(3)], [(name, "<u4") for name in "xyz"], _location)
    add(_OLD, [old, kind(11, 12)], _PROCESSED, _processed)
    mari = [("event", 3, 3), ("version", 3, 3), ("packet", 16, 16), ("protocol", 0x11, 0x11)]
    for header, fixed in ((_NEW, [("version", 1, 1)]), (_MARI, mari)):
        add(header, [*fixed, kind(2)], [windows(1)], _raw)
        for n in range(1, MOST_WINDOWS + 1):
            add(header, [*fixed, kind(13), ("n", n, n)], [("n", "u1"), windows(n)], _raw)
        add(header, [*fixed, kind(12)], _PROCESSED, _processed)
        for rest in ("V20", "V28"):
            add(header, [*fixed, kind(6)], [*_ADVERTISED, ("rest", rest)], _advertisement)
    places = [("station", 0, len(CHANNELS) - 1)]
    places += [(name, 0, lfsr.SEQUENCE_LENGTH - 1) for name in ("first", "second")]
    bare = [("station", "u1"), ("first", "<u4"), ("second", "<u4")]
    add([], places, bare, _calibration)
    return found


def address(name: str) -> int:
    """Address of a robot called ``name``: what its 16 hexadecimal digits say, else a hash of
    the name that is always the same (BLAKE2b of 8 bytes, little-endian)."""
    if re.fullmatch("[0-9a-fA-F]{16}", name):
        return int(name, 16)
    return int.from_bytes(blake2b(name.encode(), digest_size=8).digest(), "little")


def encode(recording: Recording) -> Iterator[tuple[int, bytes]]:
    """(time in ns, bytes) of a gateway whose robots send their sweeps as processed data of
    version 9, each device under its :func:`address`. Counts become whole steps.

    Raises
    ------
    InputError
        There are no sweeps of a robot's photodiode, of which it has one (sensor 0).
    """
    sweeps, usable = recording.sweeps, np.zeros(0, bool)
    if sweeps is not None:
        usable = (sweeps.sensor == 0) & np.isin(sweeps.channel, CHANNELS)
        usable &= (sweeps.count >= 0) & (sweeps.count < lfsr.SEQUENCE_LENGTH - 0.5)
    if sweeps is None or not np.any(usable):
        raise InputError(
            "no sweeps that a DotBot could see", hint="give a session with sweeps of sensor 0"
        )
    chosen = np.flatnonzero(usable)
    chosen = chosen[np.argsort(sweeps.time_ns[chosen], kind="stable")]
    channel, named = sweeps.channel[chosen], sweeps.polynomial[chosen]
    frames = np.zeros(len(chosen), np.dtype([*_OLD, *_PROCESSED]))
    frames["src"] = np.array([address(name) for name in sweeps.devices], np.uint64)[
        sweeps.device[chosen]
    ]
    frames["version"], frames["type"] = 9, 12
    frames["polynomial"] = np.where(named >> 1 == channel - 1, named, 2 * (channel - 1))
    frames["index"] = np.rint(sweeps.count[chosen])
    frames["time"] = sweeps.time_ns[chosen] // 1000 & 0xFFFFFFFF
    return _by_time(sweeps.time_ns[chosen].tolist(), frames)


def _by_time(times: list[int], frames: Frames) -> Iterator[tuple[int, bytes]]:
    for time, sent in groupby(zip(times, frames, strict=True), key=itemgetter(0)):
        yield time, b"".join(packed(frame.tobytes()) for _, frame in sent)
