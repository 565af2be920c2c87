"""Lines of libsurvive's recordings (``.rec``, ``.rec.gz``), read into columns.

A line is seconds since the start, a device's code name, a kind and its values, as
``survive_recording.h`` and ``survive_recording.c`` of cntools/libsurvive (MIT) print them:

=================  ===========================================================  ============
kind               values                                                       read here
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
kinds are counted and skipped. Files are read in pieces: of what they hold only the columns
stay in memory.
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

from locatk.core.errors import FormatError, MissingDataError

LIMIT = 1 << 29
LINES = 1 << 24
"""Decoded bytes and lines that are read of one recording: forty minutes of a tracker under four
stations."""

DENSE = 40
DENSE_FROM = 4 << 20
"""By so much no recording packs, from so many packed-out bytes on: published ones do 4 : 1."""

BLOCK = 8 << 20
LONGEST = 1 << 20
"""Bytes of one line; configurations have some 10,000."""

DEVICES = 64
OPTIONS = 4096
KINDS = 256
"""So many devices, options, unknown kinds and names of poses are kept at most."""

STRANGE = 100_000
"""After so many lines that are none of libsurvive's, none are looked for."""

_TIME = rb"^(\d{1,9}(?:\.\d{1,9})?) "
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
_IS_ANGLE = re.compile(rb"^[^\s]{1,24} [^\s]{1,32} B ", re.M)
_OTHER = re.compile(
    rb"^([-+0-9.e]{1,24}) (?![^\s]{1,32} [YWB] )([^\s]{1,64}) ([^\s]{1,32})([^\n]*)$", re.M
)
_POSES = (b"POSE", b"EXTERNAL_POSE", b"LH_POSE")
_NAMELESS = (b"OPTION", b"INFO", b"SPHERE", b"EXTERNAL_TO_WORLD", b"LH_UP")


@dataclass(frozen=True)
class Columns:
    """Sweeps, syncs or libsurvive's angles, in the order of the file.

    Attributes
    ----------
    host_s : (n,) float64 ndarray
        When the line was written, by the host's clock: late, in bursts.
    device : (n,) int ndarray
        Index into :attr:`Recording.devices`.
    channel : (n,) int ndarray
        From 0.
    timecode : (n,) int64 ndarray
        0 to 2^32 - 1.
    sensor : (n,) int ndarray
        Row of the device's ``modelPoints``; 0 for syncs.
    flag : (n,) int ndarray
        OOTX bit of a sync; of a sweep whether half a tick is to be added; plane of an angle.
    angle : (n,) float64 ndarray
        In radians, of angles; 0 for others.
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
        """The chosen lines only."""
        return Columns(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))


@dataclass
class Recording:
    """What is in one file.

    Attributes
    ----------
    devices : tuple of str
        Code names of what received light, in the order in which they appear.
    syncs, sweeps, angles : Columns
        ``angles`` is empty where they were not asked for.
    configs : dict of str to bytes
        JSON by device, the last where there are several.
    options : dict of str to str
    poses : dict of (str, str) to (n, 8) float64 ndarray
        By kind and name (of a device; of a station its channel): host's seconds, x, y, z in
        metres, quaternion (w, x, y, z).
    kinds : Counter
        Lines by kind, of those that are not read into columns.
    lines : int
        All of them.
    damaged : int
        Lines that are not what they should be; they are left out.
    cut : str or None
        Why the end of the file is missing, in one line.
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


def read_lines(path: Path, *, angles: bool = False) -> Recording:
    """Read one recording.

    Parameters
    ----------
    path : path
        Packed or not: its first bytes tell.
    angles : bool
        Whether to read libsurvive's own angles too.

    Raises
    ------
    MissingDataError
        The file is not there.
    FormatError
        It cannot be read, or is no recording of libsurvive.
    """
    path = Path(path)
    collected = _Collected(angles)
    pieces = _Pieces(path)
    for block in pieces:
        collected.add(block)
        if collected.recording.lines > STRANGE and not collected.known:
            break
        if collected.recording.lines > LINES:
            pieces.cut = f"only the first {collected.recording.lines:,} lines were read"
            break
    collected.damaged += pieces.overlong
    recording = collected.finish(pieces.cut)
    if not (len(recording.syncs) or len(recording.sweeps) or recording.configs or recording.kinds):
        raise FormatError(
            "no recording of libsurvive",
            file=path,
            hint="give a .rec or .rec.gz, as written by survive-cli --record",
        )
    return recording


class _Pieces:
    """Whole lines of a file, some megabytes at once, unpacked where it is gzip.

    After it has been read, ``cut`` says why the end is missing, and ``overlong`` how many
    lines were longer than any can be.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.cut: str | None = None
        self.overlong = 0

    def __iter__(self) -> Iterator[bytes]:
        rest, total = b"", 0
        for piece in self._decoded():
            total += len(piece)
            if total > LIMIT:
                self.cut = f"only the first {LIMIT >> 20} MB were read"
                break
            end = piece.rfind(b"\n") + 1
            if end == 0 and len(rest) + len(piece) > LONGEST:
                self.overlong += 1
                rest = b""
            elif end == 0:
                rest += piece
            else:
                yield rest + piece[:end]
                rest = piece[end:]
        # The last line of a file that breaks off may be cut within a number.
        if rest and self.cut is None:
            yield rest + b"\n"

    def _decoded(self) -> Iterator[bytes]:
        try:
            with self.path.open("rb") as file:
                packed = file.read(2) == b"\x1f\x8b"
                file.seek(0)
                raw = iter(lambda: file.read(BLOCK), b"")
                yield from self._unpacked(raw) if packed else raw
        except FileNotFoundError:
            raise MissingDataError("no such recording", file=self.path) from None
        except OSError as error:
            raise FormatError(error.strerror or "cannot be read", file=self.path) from None

    def _unpacked(self, packed: Iterator[bytes]) -> Iterator[bytes]:
        unpack = zlib.decompressobj(31)
        taken = given = 0
        for raw in packed:
            while raw:
                if unpack.eof:  # another member follows
                    unpack = zlib.decompressobj(31)
                try:
                    piece = unpack.decompress(raw, BLOCK)
                except zlib.error:
                    self.cut = "the archive is damaged, what follows is lost"
                    return
                yield piece
                rest = unpack.unused_data if unpack.eof else unpack.unconsumed_tail
                taken, given = taken + len(raw) - len(rest), given + len(piece)
                if given > max(DENSE_FROM, DENSE * taken):
                    self.cut = (
                        f"packed {given // taken} : 1 after {given >> 20} MB, as no recording is"
                    )
                    return
                raw = rest
        if not unpack.eof:
            self.cut = "the archive breaks off"


class _Collected:
    """Columns of the pieces read so far."""

    def __init__(self, angles: bool) -> None:
        self.angles = angles
        self.known = 0
        self.devices: dict[bytes, int] = {}
        self.parts: dict[str, list[Columns]] = {"Y": [], "W": [], "B": []}
        self.recording = Recording((), _columns([]), _columns([]), _columns([]))
        self.damaged = 0
        self.poses: dict[tuple[bytes, bytes], list[NDArray[np.float64]]] = {}

    def add(self, block: bytes) -> None:
        """Take in whole lines."""
        lines = block.count(b"\n")
        known = 0
        for kind, pattern in (("Y", _SYNC), ("W", _SWEEP), ("B", _ANGLE)):
            if kind == "B" and not self.angles:
                skipped = len(_IS_ANGLE.findall(block))
                self.recording.kinds.update({"B": skipped} if skipped else {})
                known += skipped
                continue
            found = pattern.findall(block)
            if found:
                known += len(found)
                self.parts[kind].append(self._parse(kind, found))
        others: list[tuple[bytes, bytes, bytes, bytes]] = _OTHER.findall(block)
        poses: dict[tuple[bytes, bytes], list[tuple[float, ...]]] = {}
        for line in others:
            self._other(*line, poses)
        for key, values in poses.items():
            if key in self.poses or len(self.poses) < KINDS:
                self.poses.setdefault(key, []).append(np.array(values))
        self.known += known + len(others)
        self.recording.lines += lines
        self.damaged += max(lines - known - len(others), 0)

    def _parse(self, kind: str, found: list[tuple[bytes, ...]]) -> Columns:
        columns = list(zip(*found, strict=True))
        n = len(found)
        names = columns[1]
        for name in dict.fromkeys(names):
            if len(self.devices) < DEVICES:
                self.devices.setdefault(name, len(self.devices))
        device = np.fromiter((self.devices.get(name, -1) for name in names), np.int32, n)

        def whole(values: tuple[bytes, ...]) -> NDArray[np.int64]:
            return np.array(values).astype(np.int64)

        host = np.array(columns[0]).astype(np.float64)
        channel, zero = whole(columns[2]), np.zeros(n, np.int64)
        if kind == "Y":
            sensor, timecode, flag = zero, whole(columns[3]), whole(columns[4])
        else:
            sensor, timecode, flag = (whole(columns[i]) for i in (3, 4, 5))
        angle = np.array(columns[6]).astype(np.float64) if kind == "B" else np.zeros(n)
        good = (channel < 16) & (timecode < 1 << 32) & (device >= 0)
        self.damaged += n - int(np.count_nonzero(good))
        return Columns(
            host,
            device,
            channel.astype(np.int32),
            timecode,
            sensor.astype(np.int32),
            flag.astype(np.int32),
            angle,
        ).take(good)

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
                values = tuple(map(float, (time, *rest.split()[:7])))
            except ValueError:
                values = ()
            if len(values) == 8 and values[0] >= 0 and all(abs(value) < 1e9 for value in values):
                poses.setdefault((kind, name), []).append(values)
            else:
                self.damaged += 1
        elif kind == b"CONFIG" and len(rest) < LONGEST and len(recording.configs) < DEVICES:
            recording.configs[_text(name)] = rest
        elif kind == b"OPTION" and len(recording.options) < OPTIONS:
            words = rest.split(None, 2)
            recording.options[_text(words[0])] = _text(words[2].strip()) if words[2:] else ""
        label = _text(kind)
        if label not in recording.kinds and len(recording.kinds) >= KINDS:
            label = "..."
        recording.kinds[label] += 1

    def finish(self, cut: str | None) -> Recording:
        """All that was taken in."""
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
    """Pieces put together."""
    types = (np.float64, np.int32, np.int32, np.int64, np.int32, np.int32, np.float64)
    return Columns(
        *(
            np.concatenate([np.zeros(0, kind), *(getattr(part, name) for part in parts)])
            for name, kind in zip(Columns.__dataclass_fields__, types, strict=True)
        )
    )
