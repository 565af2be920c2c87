"""Digital channels in the files of Saleae's Logic 2: captures (``.sal``) and binary exports.

A capture is a zip archive: ``digital-N.bin`` for each digital channel, and ``meta.json`` with names
and settings. Analog channels are ignored. Binary files begin with ``<SALEAE>``, a version (i32) and
a type (i32), all little endian.

**Channels inside a capture** (version 1, type 100) have no public documentation. The layout was
inferred from published captures and verified on each of their chunks and index entries::

    u8 = 1, f64 rate, u64 start ms since the epoch, f64 fraction of a ms, u16, u64 chunks
    chunk: u64 first sample, past the last, samples, rate, 1, bytes of runs
           runs
           u64 n, n x (u64 sample, u64 byte, u32 level)   entry points of the chunk

Runs are lengths minus one, big endian, in groups of bits: of the first byte six and a flag for
more bytes (bit 6), of each further byte seven and a flag for more bytes (bit 7). The last run of a
chunk ends at its border, where the level need not change: there is an edge if the level at the
beginning of the next chunk's index is another one.

**Exports** ("raw data", type 0; support.saleae.com, "Binary export format")::

    version 0: u32 level, f64 begin, f64 end, u64 n, n x f64 time of an edge
    version 1: u64 chunks, each u32 level, f64 rate, f64 begin, f64 end, u64 n, n x f64

Times are in seconds since the start. Between chunks data are missing: if the level has changed
after such a gap, the edge is assumed at the end of the gap.
"""

from __future__ import annotations

import json
import re
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, Any, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import FormatError, LocatkError
from locatk.core.lighthouse.recording import NANOSECONDS_PER_S
from locatk.formats.files import open_binary
from locatk.formats.importers.saleae.digital_lines import (
    DigitalLine,
    EdgeSegment,
    Ticks,
    clean_name,
)

MAGIC = b"<SALEAE>"
CAPTURED_VERSION_AND_TYPE = (1, 100)
"""Version and type of a channel inside a capture."""

HEADER_STRUCT = struct.Struct("<BdQdHQ")
CHUNK_STRUCT = struct.Struct("<6Q")
INDEX_STRUCT = struct.Struct("<QQI")
EXPORT_0_STRUCT = struct.Struct("<IddQ")
EXPORT_1_STRUCT = struct.Struct("<IdddQ")

MAX_CHUNK_BYTES = 8 << 20
"""Largest chunk; published ones have 1.3 million samples in a few kB."""

MAX_CHUNK_SAMPLES = 1 << 36
"""Most samples of a chunk: the sum of any chunk's runs is within int64."""

MAX_RUN_BYTES = 7
"""Longest code of a run: :data:`MAX_CHUNK_SAMPLES` needs no more."""

BATCH_BYTES = 1 << 17
"""Bytes that are decoded at once: many short chunks, but not more than the processor's cache."""

MAX_SAMPLE = 1 << 60
"""Largest number of a sample."""

EXPORT_BATCH_EDGES = 1 << 17
"""Edges of an export that are read at once."""

MAX_EXPORT_S = 1e6
"""Largest time of an export, at which float64 still resolves 0.1 ns."""

CUT_HINT = "The file is cut short or damaged: copy it again from its original"
EXPORT_HINT = "Open it in Logic 2 and export raw data as CSV"


CHANNEL_FILE = re.compile(r"digital-(\d{1,4})\.bin", re.ASCII)
EXPORT_FILE = re.compile(r"digital_(\d{1,4})\.bin", re.ASCII)

MAX_CAPTURE_BYTES = 4 << 30
"""Largest size of all channels of a capture after decompression."""

MAX_META_BYTES = 16 << 20

MAX_START_MS = 7.3e12
"""Largest start of a capture, in the year 2201."""

MIN_RATE_HZ, MAX_RATE_HZ = 1.0, 1e11

LOGIC_COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)

ARCHIVE_ERRORS = (
    zipfile.BadZipFile,
    zlib.error,
    EOFError,
    KeyError,
    OSError,
    OverflowError,
    RuntimeError,  # encrypted; a version or depth of nesting that is not supported
    ValueError,
)
"""Exceptions that a damaged archive can raise."""

COPY_HINT = "Copy the capture again from its original"


@dataclass(frozen=True)
class Header:
    """Header of a binary file.

    Attributes
    ----------
    is_captured : bool
        True for a channel of a capture, false for an export.
    version : int
    rate_hz : float or None
        Sampling rate, if the header contains it.
    start_ns : int
        Time of sample 0 since the epoch; 0 if unknown.
    chunks : int
        Number of chunks, as claimed.
    """

    is_captured: bool
    version: int
    rate_hz: float | None
    start_ns: int
    chunks: int


@dataclass
class Source:
    """Stream of bytes that is read exactly.

    Attributes
    ----------
    stream : binary file
    file : Path
        For error messages.
    name : str
        Member of an archive, for error messages; empty for the file itself.
    """

    stream: IO[bytes]
    file: Path
    name: str = ""
    offset: int = 0

    def fail(self, message: str, hint: str = CUT_HINT) -> NoReturn:
        """Raise :class:`FormatError` about the current byte."""
        position = f"{self.name} byte {self.offset}" if self.name else f"byte {self.offset}"
        raise FormatError(message, file=self.file, where=position, hint=hint)

    def read(self, n: int) -> bytes:
        """Read exactly ``n`` bytes."""
        data = self.stream.read(n)
        if len(data) != n:
            self.fail(f"end of file after {len(data):,} of {n:,} bytes")
        self.offset += n
        return data

    def values(self, form: struct.Struct) -> tuple[float, ...]:
        """Read the next numbers."""
        return form.unpack(self.read(form.size))

    def end(self) -> None:
        """Fail unless the stream ends here; an archive checks its CRC then."""
        if self.stream.read(1):
            self.fail("more bytes than the chunks in the header")


def read_header(source: Source) -> Header:
    """Read the header of either kind, from the start of the stream.

    Raises
    ------
    FormatError
        The file has no such header, another version or type, or an impossible rate.
    """
    magic = source.stream.read(len(MAGIC))
    if magic != MAGIC:
        source.fail("not a binary file of Logic 2", "Give a capture (.sal) or its raw export")
    source.offset += len(magic)
    version, kind = map(int, source.values(struct.Struct("<ii")))
    if (version, kind) == CAPTURED_VERSION_AND_TYPE:
        _, rate, ms, fraction, _, chunks = source.values(HEADER_STRUCT)
        start_ns = _start_ns(int(ms), fraction)
        return Header(True, version, _check_rate(source, rate), start_ns, int(chunks))
    if kind == 1:
        source.fail("an analog channel", "Export the digital channels")
    if kind != 0 or version not in (0, 1):
        source.fail(f"unknown version {version}, type {kind} of a binary file", EXPORT_HINT)
    chunks = int(source.values(struct.Struct("<Q"))[0]) if version else 1
    return Header(False, version, None, 0, chunks)


def _check_rate(source: Source, rate: float) -> float:
    if not MIN_RATE_HZ <= rate <= MAX_RATE_HZ:  # includes NaN
        source.fail(f"sampling rate of {rate:g} Hz")
    return float(rate)


def _start_ns(ms: float, fraction: float) -> int:
    """Return a start in nanoseconds since the epoch; 0 if it is not one until the year 2200."""
    if not 0 < ms < MAX_START_MS or not 0 <= fraction < 1:
        return 0
    return int(ms) * 1_000_000 + round(fraction * 1_000_000)


# ---- channels inside a capture


class Chunk(NamedTuple):
    """Runs of consecutive samples; ``level`` is None if it is that at the end of the last chunk."""

    start: int
    samples: int
    level: int | None
    runs: bytes


def captured_edges(source: Source, header: Header) -> Iterator[EdgeSegment]:
    """Yield the edges of a channel inside a capture, in ticks of its rate, after its header.

    Raises
    ------
    FormatError
        Chunks are not contiguous, the sum of runs is not the samples of their chunk, or the
        stream is shorter or longer than the chunks.
    """
    batch: list[Chunk] = []
    size, level = 0, None
    for chunk in _chunks(source, header):
        if batch and size + len(chunk.runs) > BATCH_BYTES:
            edges, level = _decode_runs(source, batch, level)
            yield edges
            batch, size = [], 0
        batch.append(chunk)
        size += len(chunk.runs)
    if batch:
        yield _decode_runs(source, batch, level)[0]
    source.end()


def _chunks(source: Source, header: Header) -> Iterator[Chunk]:
    """Read the chunks of a channel, and check that they are contiguous."""
    next_sample = None
    for _ in range(header.chunks):
        start, end, samples, rate, _, size = map(int, source.values(CHUNK_STRUCT))
        if not 0 < samples <= MAX_CHUNK_SAMPLES or end - start != samples or end > MAX_SAMPLE:
            source.fail(f"a chunk of {samples} samples from {start} to {end}")
        if next_sample is not None and start != next_sample:
            source.fail(f"a chunk that begins at sample {start} instead of {next_sample}")
        if rate != header.rate_hz:
            source.fail(f"a chunk of {rate} samples per second in a file of {header.rate_hz:g}")
        if not 0 < size <= MAX_CHUNK_BYTES:
            source.fail(f"a chunk of {size} bytes")
        runs = source.read(size)
        (entries,) = map(int, source.values(struct.Struct("<Q")))
        if entries > size:
            source.fail(f"a chunk of {size} bytes with {entries} index entries")
        level = None
        if entries:
            sample, byte, level = map(int, source.values(INDEX_STRUCT))
            if sample or byte or level > 1:
                source.fail("a chunk whose index does not begin with its level")
            source.read((entries - 1) * INDEX_STRUCT.size)
        yield Chunk(start, samples, level, runs)
        next_sample = end


def _decode_runs(source: Source, batch: list[Chunk], before: int | None) -> tuple[EdgeSegment, int]:
    """Return the edges of consecutive chunks, and the level at their end.

    ``before`` is the level at the end of the last chunk before them; None for the first chunks.
    """
    payload = np.frombuffer(b"".join(chunk.runs for chunk in batch), np.uint8)
    begin = np.cumsum([0] + [len(chunk.runs) for chunk in batch])[:-1]  # byte of each chunk
    begins_run = find_run_starts(payload)
    if begins_run is None or not begins_run[begin].all():
        source.fail("a chunk that ends inside a run, or runs of an unknown code")
    run_start = np.flatnonzero(begins_run)
    runs = run_lengths(payload, run_start)
    if runs is None or runs.max() > MAX_CHUNK_SAMPLES:
        source.fail("a run longer than any chunk")
    first_run = np.searchsorted(run_start, begin)  # of each chunk
    sums = np.add.reduceat(runs, first_run)
    is_wrong = sums != [chunk.samples for chunk in batch]
    if is_wrong.any():
        k = int(np.argmax(is_wrong))
        source.fail(f"runs of {sums[k]} samples in a chunk of {batch[k].samples}")

    # Each end of a run is an edge, that of a chunk only if the next one begins at another level.
    ends = batch[0].start + np.cumsum(runs)
    is_edge = np.ones(len(runs), bool)
    entry = _level(batch[0], before)
    level = entry
    for k, n in enumerate(np.diff(first_run, append=len(runs)).tolist()):
        begins = _level(batch[k], level)
        if k:
            is_edge[first_run[k] - 1] = begins != level
        level = begins ^ ((n - 1) & 1)
    is_edge[-1] = False  # depends on the next chunk
    tick = ends[is_edge]
    if before is not None and before != entry:
        tick = np.concatenate([[batch[0].start], tick])
        entry = before
    return EdgeSegment(tick, not entry, int(ends[-1])), level


def _level(chunk: Chunk, before: int | None) -> int:
    """Return the level at the start of a chunk; low if unknown."""
    return (before or 0) if chunk.level is None else chunk.level


def find_run_starts(payload: NDArray[np.uint8]) -> NDArray[np.bool_] | None:
    """Find the bytes that begin a run.

    Bit 6 of the first byte of a run and bit 7 of any other byte state that more bytes follow.
    A byte maps this state to the next: if its two bits agree, it sets the state, and with bit 6
    alone it inverts the state. The state after a byte is therefore the one that the last byte
    of the former kind set, inverted once for each byte of the latter kind since.

    Returns
    -------
    (n,) bool ndarray or None
        None if the last run does not end, or a first byte has bit 7, which is never set there.
    """
    six, seven = (payload >> 6) & 1, payload >> 7
    sets_state = six == seven
    inverted = np.bitwise_xor.accumulate(six & (seven ^ 1))
    last = np.maximum.accumulate(np.where(sets_state, np.arange(len(payload), dtype=np.int32), -1))
    base = (six ^ inverted)[last]
    base[last < 0] = 0  # a stream begins like after the end of a run
    more = base ^ inverted
    first = np.empty(len(payload), bool)
    first[0] = True
    np.equal(more[:-1], 0, out=first[1:])
    if more[-1] or np.any(seven[first]):
        return None
    return first


def run_lengths(payload: NDArray[np.uint8], start: NDArray[np.intp]) -> Ticks | None:
    """Return the samples of the runs that begin at bytes ``start``; None if one is too long."""
    sizes = np.diff(start, append=len(payload))
    longest = int(sizes.max())
    if longest > MAX_RUN_BYTES:
        return None
    value = (payload[start] & 0x3F).astype(np.int64)
    continuing = np.arange(len(start))
    for k in range(1, longest):
        continuing = continuing[sizes[continuing] > k]
        value[continuing] = value[continuing] << 7 | payload[start[continuing] + k] & 0x7F
    return value + 1


# ---- exports


def export_edges(source: Source, header: Header) -> Iterator[EdgeSegment]:
    """Yield the edges of an exported channel, in nanoseconds.

    Raises
    ------
    FormatError
        Times are wrong or do not ascend, or the stream is shorter or longer than claimed.
    """
    level, last = None, -(1 << 62)
    for _ in range(header.chunks):
        state, begin, end, count = _export_header(source, header.version)
        changes = level is not None and level != state
        if begin > end or begin < last + changes:
            source.fail(f"data from {begin} ns to {end} ns after data until {last} ns")
        last = max(last, begin - 1)
        if changes:
            yield EdgeSegment(np.array([begin]), bool(state), begin + 1)
            last = begin
        level = state
        while count:
            n = min(count, EXPORT_BATCH_EDGES)
            tick = _nanoseconds(source, np.frombuffer(source.read(8 * n), "<f8"))
            is_late = np.diff(tick, prepend=last) <= 0
            if is_late.any():
                source.fail(f"an edge at {tick[np.argmax(is_late)]} ns, not after the one before")
            if tick[-1] > end:
                source.fail(f"an edge at {tick[-1]} ns, but the data end at {end} ns")
            yield EdgeSegment(tick, not level, int(tick[-1]) + 1)
            level ^= n & 1
            last, count = int(tick[-1]), count - n
        yield EdgeSegment(np.zeros(0, np.int64), not level, max(end, last + 1))
    source.end()


def export_rate(source: Source, header: Header) -> float | None:
    """Return the sampling rate of an export, after its header; None if it has none."""
    if not header.version or not header.chunks:
        return None
    return _check_rate(source, source.values(EXPORT_1_STRUCT)[1])


def _export_header(source: Source, version: int) -> tuple[int, int, int, int]:
    """Read the level, start and end in nanoseconds, and the number of edges of a chunk."""
    values = source.values(EXPORT_1_STRUCT if version else EXPORT_0_STRUCT)
    state, begin, end, count = int(values[0]), values[-3], values[-2], int(values[-1])
    if state > 1:
        source.fail(f"a level of {state}")
    first, last = _nanoseconds(source, np.array([begin, end])).tolist()
    return state, first, last, count


def _nanoseconds(source: Source, seconds: NDArray[np.float64]) -> Ticks:
    if not np.all(np.abs(seconds) <= MAX_EXPORT_S):  # includes NaN
        source.fail("a time that is not a number of seconds within eleven days")
    return np.rint(seconds * NANOSECONDS_PER_S).astype(np.int64)


# ---- binary files as lines


@contextmanager
def _opened(path: Path, member: str) -> Iterator[Source]:
    """Open a binary file, or a member of an archive; errors of either are LocatkErrors."""
    if not member:
        with open_binary(path) as stream:
            yield Source(stream, path)
        return
    with _archive(path, member) as archive, archive.open(member) as stream:
        yield Source(stream, path, member)


def _read_edges(path: Path, member: str) -> Iterator[EdgeSegment]:
    """Yield the edges of a binary file, reading it again."""
    with _opened(path, member) as source:
        header = read_header(source)
        read = captured_edges if header.is_captured else export_edges
        yield from read(source, header)


def read_binary(path: Path) -> DigitalLine:
    """Return the only channel of a binary file.

    Raises
    ------
    MissingDataError, FormatError
        The file is missing, or has no valid header.
    """
    with _opened(path, "") as source:
        header = read_header(source)
        rate_hz = header.rate_hz or export_rate(source, header)
    match = CHANNEL_FILE.fullmatch(path.name) or EXPORT_FILE.fullmatch(path.name)
    number = int(match[1]) if match else None
    name = clean_name(path.stem) if number is None else f"Channel {number}"
    ticks_hz = header.rate_hz or float(NANOSECONDS_PER_S)
    rate_hz = rate_hz and min(rate_hz, ticks_hz)
    edges = partial(_read_edges, path, "")
    return DigitalLine(name, number, ticks_hz, rate_hz, header.start_ns, edges)


# ---- archives


@contextmanager
def _archive(path: Path, where: str | None = None) -> Iterator[zipfile.ZipFile]:
    """Open an archive; any error in it is a FormatError."""
    try:
        with open_binary(path) as stream, zipfile.ZipFile(stream) as archive:
            yield archive
    except LocatkError:
        raise
    except ARCHIVE_ERRORS as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise FormatError(
            f"damaged archive ({reason})", file=path, where=where, hint=COPY_HINT
        ) from error


def read_capture_file(path: Path) -> list[DigitalLine]:
    """Return the digital channels of a capture, ascending.

    Raises
    ------
    FormatError
        The archive or a channel is damaged or missing, or there is no digital channel.
    """
    with _archive(path) as archive:
        meta = _meta(archive)
        members: dict[int, zipfile.ZipInfo] = {}
        for info in archive.infolist():
            match = CHANNEL_FILE.fullmatch(info.filename)
            if match is None:
                continue
            if int(match[1]) in members or info.compress_type not in LOGIC_COMPRESSIONS:
                raise FormatError(
                    "a channel that occurs twice, or has a compression that Logic does not use",
                    file=path,
                    where=info.filename,
                    hint=COPY_HINT,
                )
            members[int(match[1])] = info
        missing = sorted(_recorded_channels(meta) - set(members))
        if missing:
            raise FormatError(
                f"digital-{missing[0]}.bin is missing, which meta.json lists",
                file=path,
                hint=COPY_HINT,
            )
        if not members:
            raise FormatError(
                "no digital channel", file=path, hint="Record photodiodes as digital channels"
            )
        size = sum(info.file_size for info in members.values())
        if size > MAX_CAPTURE_BYTES:
            raise FormatError(
                f"channels of {size:,} bytes, more than {MAX_CAPTURE_BYTES:,}",
                file=path,
                hint="Save a shorter part of the capture",
            )
        names = _channel_names(meta)
        start_ns = _capture_start_ns(meta)
        return [
            _member(path, info.filename, number, names.get(number, f"Channel {number}"), start_ns)
            for number, info in sorted(members.items())
        ]


def _member(path: Path, member: str, number: int, name: str, start_ns: int) -> DigitalLine:
    with _opened(path, member) as source:
        header = read_header(source)
        if not header.is_captured or header.rate_hz is None:
            source.fail("an export inside a capture")
    rate_hz = header.rate_hz
    edges = partial(_read_edges, path, member)
    return DigitalLine(name, number, rate_hz, rate_hz, header.start_ns or start_ns, edges)


# ---- meta.json, from which an intact capture needs only names


def _meta(archive: zipfile.ZipFile) -> Mapping[str, Any]:
    """Return the content of ``meta.json``; empty if it is missing or damaged."""
    try:
        if archive.getinfo("meta.json").compress_type not in LOGIC_COMPRESSIONS:
            return {}
        with archive.open("meta.json") as stream:
            text = stream.read(MAX_META_BYTES + 1)
        meta = json.loads(text) if len(text) <= MAX_META_BYTES else None
    except ARCHIVE_ERRORS:
        return {}
    return meta if isinstance(meta, dict) else {}


def _get(value: object, *keys: str) -> Any:
    """Return the value below ``keys``; None if there is none."""
    for key in keys:
        value = value.get(key) if isinstance(value, dict) else None
    return value


def _digital(value: object) -> int | None:
    """Return the number of a digital channel in ``meta.json``; None for another channel."""
    number = _get(value, "deviceChannel")
    return number if _get(value, "type") == "Digital" and isinstance(number, int) else None


def _recorded_channels(meta: Mapping[str, Any]) -> set[int]:
    """Return the digital channels that should be in the archive."""
    entries = _get(meta, "binData")
    numbers = map(_digital, entries if isinstance(entries, list) else ())
    return {number for number in numbers if number is not None}


def _channel_names(meta: Mapping[str, Any]) -> dict[int, str]:
    """Return the names of the digital channels by number."""
    rows = _get(meta, "data", "rowsSettings")
    names: dict[int, str] = {}
    for row in rows if isinstance(rows, list) else ():
        number, name = _digital(_get(row, "channel")), _get(row, "name")
        if number is not None and isinstance(name, str) and clean_name(name):
            names[number] = clean_name(name)
    return names


def _capture_start_ns(meta: Mapping[str, Any]) -> int:
    """Return the start of the capture in nanoseconds since the epoch; 0 if unknown."""
    start = _get(meta, "data", "captureStartTime")
    ms, fraction = _get(start, "unixTimeMilliseconds"), _get(start, "fractionalMilliseconds")
    if not isinstance(ms, int | float) or not isinstance(fraction, int | float):
        return 0
    return _start_ns(ms, fraction)
