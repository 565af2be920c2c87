"""Columns of a recording of libsurvive (``.rec``, ``.rec.gz``).

A line contains the seconds since the start, a device's code name, a kind and its values, as
``survive_recording.h`` and ``survive_recording.c`` of cntools/libsurvive (MIT) write them:

=================  ===========================================================  ============
kind               values                                                       read into
=================  ===========================================================  ============
``Y``              channel, timecode, OOTX bit, generation                      syncs
``W``              channel, sensor, timecode, half tick                         sweeps
``B``              channel, sensor, timecode, plane, angle (libsurvive's own)   on demand
``CONFIG``         the device's JSON                                            configs
``POSE``           x y z qw qx qy qz, device to world                           poses
``EXTERNAL_POSE``  the same, of another tracking system or an earlier run       poses
``LH_POSE``        the same, of a base station; before it its channel           poses
``OPTION``         name, type, value                                            options
``C L R A S``      light of the first generation                                kinds
=================  ===========================================================  ============

Channels are counted from 0. Timecodes are of the device's 48 MHz counter, 32 bits. All other
kinds are counted and skipped. Files are read in blocks, of which only the columns stay in memory.
"""

from __future__ import annotations

import re
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import FormatError
from locatk.formats.files import open_binary
from locatk.formats.tables.numbers import parse_number

MAX_BYTES = 1 << 29
MAX_LINES = 1 << 24
"""Decoded bytes and lines that are read of a recording: forty minutes of a tracker and four
stations."""

MAX_COMPRESSION_RATIO = 40
MIN_COMPRESSION_CHECK_BYTES = 4 << 20
"""Largest compression of a recording after so many decoded bytes; published ones have 4 : 1."""

BLOCK_BYTES = 8 << 20

MAX_LINE_BYTES = 1 << 20
"""Longest line; configurations have about 10,000 bytes."""

MAX_DEVICES = 64
MAX_OPTIONS = 4096

MAX_KINDS = 256
"""Most unknown kinds of lines, and most names of poses, that are kept."""

MAX_UNKNOWN_LINES = 100_000
"""Unknown lines at the beginning after which a file is not one of libsurvive."""

MAX_CHANNELS = 16

MAX_POSE_VALUE = 1e9
"""Larger values of a pose are damaged."""

# Each line with the line feed before it: a literal is found faster than `^`.
_TIME = rb"\n(\d{1,9}(?:\.\d{1,9})?) "
_NAME = rb"([^\s]{1,32}) "
_END = rb"[ \t\r]*$"
_SYNC = re.compile(_TIME + _NAME + rb"Y (\d{1,2}) (\d{1,10}) ([01]) \d{1,3}" + _END, re.M)
_SWEEP = re.compile(_TIME + _NAME + rb"W (\d{1,2}) (\d{1,3}) (\d{1,10}) ([01])" + _END, re.M)
_ANGLE = re.compile(
    _TIME
    + _NAME
    + rb"B (\d{1,2}) (\d{1,3}) (\d{1,10}) ([01]) ([-+]?\d{1,3}\.\d{1,12}(?:e[-+]\d\d)?)"
    + _END,
    re.M,
)
_IS_ANGLE = re.compile(rb"\n[^\s]{1,24} [^\s]{1,32} B ", re.M)
_OTHER = re.compile(
    rb"\n([-+0-9.e]{1,24}) (?![^\s]{1,32} [YWB] )([^\s]{1,64}) ([^\s]{1,32})([^\n]*)$", re.M
)
_POSES = (b"POSE", b"EXTERNAL_POSE", b"LH_POSE")
_NAMELESS = (b"OPTION", b"INFO", b"SPHERE", b"EXTERNAL_TO_WORLD", b"LH_UP")


@dataclass(frozen=True)
class Columns:
    """Sweeps, syncs or libsurvive's angles, in the order of the file.

    Attributes
    ----------
    host_s : (n,) float64 ndarray
        Time at which the host wrote the line: late, and in bursts.
    device : (n,) int ndarray
        Index into :attr:`RecFile.devices`.
    channel : (n,) int ndarray
        From 0.
    timecode : (n,) int64 ndarray
        0 to 2^32 - 1.
    sensor : (n,) int ndarray
        Row of the device's ``modelPoints``; 0 for syncs.
    flag : (n,) int ndarray
        OOTX bit of a sync; 1 if a sweep is half a tick later; plane of an angle.
    angle : (n,) float64 ndarray
        Of angles, in radians; 0 for others.
    """

    host_s: NDArray[np.float64]
    device: NDArray[np.int32]
    channel: NDArray[np.int32]
    timecode: NDArray[np.int64]
    sensor: NDArray[np.int32]
    flag: NDArray[np.int32]
    angle: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.host_s)

    def take(self, chosen: NDArray[np.bool_] | NDArray[np.int64]) -> Columns:
        """Return the chosen lines."""
        return Columns(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))


@dataclass
class RecFile:
    """Content of a recording.

    Attributes
    ----------
    devices : tuple of str
        Code names of the devices that received light, in the order in which they appear.
    syncs, sweeps, angles : Columns
        ``angles`` is empty unless they are requested.
    configs : dict of str to bytes
        JSON by device, the last if there are several.
    options : dict of str to str
    poses : dict of (str, str) to (n, 8) float64 ndarray
        By kind and name (of a device; of a station its channel): host's seconds, x, y, z in
        metres, quaternion (w, x, y, z).
    kinds : Counter
        Numbers of lines by kind, without those that are read into columns.
    lines : int
        Number of all lines.
    damaged : int
        Number of malformed lines, which are skipped.
    cut : str or None
        Reason why the end of the file is missing, in one line.
    """

    devices: tuple[str, ...]
    syncs: Columns
    sweeps: Columns
    angles: Columns
    configs: dict[str, bytes] = field(default_factory=dict)
    options: dict[str, str] = field(default_factory=dict)
    poses: dict[tuple[str, str], NDArray[np.float64]] = field(default_factory=dict)
    kinds: Counter[str] = field(default_factory=Counter)
    lines: int = 0
    damaged: int = 0
    cut: str | None = None


def read_rec_file(path: Path, *, angles: bool = False) -> RecFile:
    """Read one recording.

    Parameters
    ----------
    path : path
        Compressed or not, which is detected from the first bytes.
    angles : bool
        Also read the angles of libsurvive.

    Raises
    ------
    MissingDataError
        The file is missing.
    FormatError
        The file is not readable, or is not a recording of libsurvive.
    """
    path = Path(path)
    collector = ColumnCollector(angles)
    blocks = LineBlocks(path)
    for block in blocks:
        collector.add(block)
        if collector.recording.lines > MAX_UNKNOWN_LINES and not collector.known:
            break
        if collector.recording.lines > MAX_LINES:
            blocks.cut = f"only the first {collector.recording.lines:,} lines were read"
            break
    collector.damaged += blocks.overlong
    recording = collector.finish(blocks.cut)
    if not (len(recording.syncs) or len(recording.sweeps) or recording.configs or recording.kinds):
        raise FormatError(
            "not a recording of libsurvive",
            file=path,
            hint="Give a .rec or .rec.gz, as written by survive-cli --record",
        )
    return recording


class LineBlocks:
    """Whole lines of a file, some megabytes at once, decompressed if it is gzip.

    After reading, ``cut`` is the reason why the end is missing, if it is, and ``overlong`` the
    number of lines that were too long.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.cut: str | None = None
        self.overlong = 0

    def __iter__(self) -> Iterator[bytes]:
        rest, total = b"", 0
        for piece in self._decoded():
            total += len(piece)
            if total > MAX_BYTES:
                self.cut = f"only the first {MAX_BYTES >> 20} MB were read"
                break
            end = piece.rfind(b"\n") + 1
            if end == 0 and len(rest) + len(piece) > MAX_LINE_BYTES:
                self.overlong += 1
                rest = b""
            elif end == 0:
                rest += piece
            else:
                yield rest + piece[:end]
                rest = piece[end:]
        # The last line of a truncated file may be cut within a number.
        if rest and self.cut is None:
            yield rest + b"\n"

    def _decoded(self) -> Iterator[bytes]:
        with open_binary(self.path) as file:
            is_gzip = file.read(2) == b"\x1f\x8b"
            file.seek(0)
            raw = iter(lambda: file.read(BLOCK_BYTES), b"")
            yield from self._decompressed(raw) if is_gzip else raw

    def _decompressed(self, compressed: Iterator[bytes]) -> Iterator[bytes]:
        decompressor = zlib.decompressobj(31)
        taken = given = 0
        for raw in compressed:
            while raw:
                if decompressor.eof:  # another member of the archive follows
                    decompressor = zlib.decompressobj(31)
                try:
                    piece = decompressor.decompress(raw, BLOCK_BYTES)
                except zlib.error:
                    self.cut = "the archive is damaged; the rest is lost"
                    return
                yield piece
                rest = (
                    decompressor.unused_data if decompressor.eof else decompressor.unconsumed_tail
                )
                taken, given = taken + len(raw) - len(rest), given + len(piece)
                if given > max(MIN_COMPRESSION_CHECK_BYTES, MAX_COMPRESSION_RATIO * taken):
                    ratio = given // taken
                    self.cut = f"compressed {ratio} : 1 after {given >> 20} MB, unlike a recording"
                    return
                raw = rest
        if not decompressor.eof:
            self.cut = "the archive is truncated"


class ColumnCollector:
    """Columns of the blocks read so far."""

    def __init__(self, angles: bool) -> None:
        self.angles = angles
        self.known = 0
        self.devices: dict[bytes, int] = {}
        self.parts: dict[str, list[Columns]] = {"Y": [], "W": [], "B": []}
        self.recording = RecFile((), _columns([]), _columns([]), _columns([]))
        self.damaged = 0
        self.poses: dict[tuple[bytes, bytes], list[NDArray[np.float64]]] = {}

    def add(self, block: bytes) -> None:
        """Add whole lines."""
        lines = block.count(b"\n")
        block = b"\n" + block
        known = 0
        for kind, pattern in (("Y", _SYNC), ("W", _SWEEP), ("B", _ANGLE)):
            if kind == "B" and not self.angles:
                skipped = len(_IS_ANGLE.findall(block))
                self.recording.kinds.update({"B": skipped} if skipped else {})
                known += skipped
                continue
            matches = pattern.findall(block)
            if matches:
                known += len(matches)
                self.parts[kind].append(self._parse(kind, matches))
        others: list[tuple[bytes, bytes, bytes, bytes]] = _OTHER.findall(block)
        poses: dict[tuple[bytes, bytes], list[tuple[float, ...]]] = {}
        for line in others:
            self._other(*line, poses)
        for key, values in poses.items():
            if key in self.poses or len(self.poses) < MAX_KINDS:
                self.poses.setdefault(key, []).append(np.array(values))
        self.known += known + len(others)
        self.recording.lines += lines
        self.damaged += max(lines - known - len(others), 0)

    def _parse(self, kind: str, matches: list[tuple[bytes, ...]]) -> Columns:
        columns = list(zip(*matches, strict=True))
        n = len(matches)
        names = columns[1]
        for name in dict.fromkeys(names):
            if len(self.devices) < MAX_DEVICES:
                self.devices.setdefault(name, len(self.devices))
        device = np.fromiter((self.devices.get(name, -1) for name in names), np.int32, n)

        def integers(values: tuple[bytes, ...]) -> NDArray[np.int64]:
            return np.array(values).astype(np.int64)

        host = np.array(columns[0]).astype(np.float64)
        channel, zero = integers(columns[2]), np.zeros(n, np.int64)
        if kind == "Y":
            sensor, timecode, flag = zero, integers(columns[3]), integers(columns[4])
        else:
            sensor, timecode, flag = (integers(columns[i]) for i in (3, 4, 5))
        angle = np.array(columns[6]).astype(np.float64) if kind == "B" else np.zeros(n)
        is_valid = (channel < MAX_CHANNELS) & (timecode < 1 << 32) & (device >= 0)
        self.damaged += n - int(np.count_nonzero(is_valid))
        return Columns(
            host,
            device,
            channel.astype(np.int32),
            timecode,
            sensor.astype(np.int32),
            flag.astype(np.int32),
            angle,
        ).take(is_valid)

    def _other(
        self,
        time: bytes,
        name: bytes,
        kind: bytes,
        rest: bytes,
        poses: dict[tuple[bytes, bytes], list[tuple[float, ...]]],
    ) -> None:
        recording = self.recording
        if name in _NAMELESS:
            name, kind, rest = b"", name, kind + rest
        if kind in _POSES:
            try:
                texts = (time + b" " + rest).decode("latin-1").split()[:8]
                values = tuple(map(parse_number, texts))
            except ValueError:
                values = ()
            if (
                len(values) == 8
                and values[0] >= 0
                and all(abs(value) < MAX_POSE_VALUE for value in values)
            ):
                poses.setdefault((kind, name), []).append(values)
            else:
                self.damaged += 1
        elif (
            kind == b"CONFIG"
            and len(rest) < MAX_LINE_BYTES
            and len(recording.configs) < MAX_DEVICES
        ):
            recording.configs[_text(name)] = rest
        elif kind == b"OPTION" and len(recording.options) < MAX_OPTIONS:
            words = rest.split(None, 2)
            recording.options[_text(words[0])] = _text(words[2].strip()) if words[2:] else ""
        label = _text(kind)
        if label not in recording.kinds and len(recording.kinds) >= MAX_KINDS:
            label = "..."
        recording.kinds[label] += 1

    def finish(self, cut: str | None) -> RecFile:
        """Return the content of the file."""
        recording = self.recording
        recording.devices = tuple(map(_text, self.devices))
        recording.syncs, recording.sweeps, recording.angles = (
            _columns(self.parts[kind]) for kind in "YWB"
        )
        recording.poses = {
            (_text(kind), _text(name)): np.concatenate(parts)
            for (kind, name), parts in self.poses.items()
        }
        recording.damaged, recording.cut = self.damaged, cut
        return recording


def _text(name: bytes) -> str:
    return "".join(c if c.isprintable() else "?" for c in name.decode("utf-8", "replace"))


def _columns(parts: list[Columns]) -> Columns:
    """Concatenate the columns of all blocks."""
    types = (np.float64, np.int32, np.int32, np.int64, np.int32, np.int32, np.float64)
    return Columns(
        *(
            np.concatenate([np.zeros(0, kind), *(getattr(part, name) for part in parts)])
            for name, kind in zip(Columns.__dataclass_fields__, types, strict=True)
        )
    )
