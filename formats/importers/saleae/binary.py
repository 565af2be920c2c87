"""Digital channels in the binary files of Saleae's Logic 2.

Two kinds begin with ``<SALEAE>``, a version (i32) and a type (i32), all little endian.

**Channels inside a capture** (``digital-N.bin`` of a ``.sal`` archive; version 1, type 100).
Not documented by its maker; found from published captures and verified on each of their
chunks and index entries::

    u8 = 1, f64 rate, u64 start ms since the epoch, f64 fraction of a ms, u16, u64 chunks
    chunk: u64 first sample, past the last, samples, rate, 1, bytes of runs
           runs
           u64 n, n x (u64 sample, u64 byte, u32 level)   places inside the chunk

Runs are lengths less one, big endian, in groups of bits: of the first byte six and whether
more follow (bit 6), of each further byte seven and whether more follow (bit 7). A chunk's
last run ends at its border, where the level need not change: an edge is there where the
level at which the next chunk's index begins is another one.

**Exports** ("raw data", type 0; support.saleae.com, "Binary export format")::

    version 0: u32 level, f64 begin, f64 end, u64 n, n x f64 time of an edge
    version 1: u64 chunks, each u32 level, f64 rate, f64 begin, f64 end, u64 n, n x f64

with seconds since the start. Between chunks data are missing: where the level is another one
after that, the edge is taken to be where the data begin again.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import FormatError
from locatk.core.lighthouse.recording import NANOSECONDS_PER_S
from locatk.formats.importers.saleae.data_lines import Piece, Ticks

MAGIC = b"<SALEAE>"
CAPTURED = (1, 100)
"""Version and type of a channel inside a capture."""

HEADER = struct.Struct("<BdQdHQ")
CHUNK = struct.Struct("<6Q")
INDEX = struct.Struct("<QQI")
EXPORT_0 = struct.Struct("<IddQ")
EXPORT_1 = struct.Struct("<IdddQ")

MOST_CHUNK = 8 << 20
"""Bytes of one chunk; the published ones are of 1.3 million samples, a few kB."""

MOST_SAMPLES = 1 << 36
"""Of one chunk: the sum of any chunk's runs is within int64."""

MOST_RUN = 7
"""Bytes of one run: a chunk's samples take no more."""

BATCH = 1 << 17
"""Bytes decoded at once: chunks are short, calls are dear, the processor's cache is small."""

LAST_SAMPLE = 1 << 60

TIMES = 1 << 17
"""Edges of an export read at once."""

MOST_SECONDS = 1e6
"""Of an export: there, times in float64 are exact to a nanosecond by far."""

CUT = "the file is cut short or damaged: copy it again from where it was recorded"
EXPORT = "open it in Logic 2 and export raw data as CSV"


@dataclass(frozen=True)
class Head:
    """What a binary file tells about its channel.

    Attributes
    ----------
    captured : bool
        Whether it is from inside a capture; else an export.
    version : int
    rate_hz : float or None
        Sampling rate, where it is told.
    start_ns : int
        Of sample 0, since the epoch; 0 where it is not told.
    chunks : int
        As claimed.
    """

    captured: bool
    version: int
    rate_hz: float | None
    start_ns: int
    chunks: int


@dataclass
class Source:
    """A stream of bytes that is read exactly.

    Attributes
    ----------
    stream : binary file
    file : Path
        For messages.
    name : str
        Member of an archive, for messages; empty for the file itself.
    """

    stream: IO[bytes]
    file: Path
    name: str = ""
    offset: int = 0

    def fail(self, message: str, hint: str = CUT) -> NoReturn:
        """Raise :class:`FormatError` about the place reached."""
        where = f"{self.name} byte {self.offset}" if self.name else f"byte {self.offset}"
        raise FormatError(message, file=self.file, where=where, hint=hint)

    def read(self, n: int) -> bytes:
        """Exactly ``n`` bytes."""
        data = self.stream.read(n)
        if len(data) != n:
            self.fail(f"end of file where {n:,} bytes should be, only {len(data):,} are")
        self.offset += n
        return data

    def values(self, form: struct.Struct) -> tuple[float, ...]:
        """Numbers that stand next."""
        return form.unpack(self.read(form.size))

    def end(self) -> None:
        """Fail unless the stream ends here (which also has an archive check its CRC)."""
        if self.stream.read(1):
            self.fail("more bytes than the chunks of the header")


def read_head(source: Source) -> Head:
    """Header of either kind, from the start of the stream.

    Raises
    ------
    FormatError
        It is none, is of another version or type, or has an impossible rate.
    """
    magic = source.stream.read(len(MAGIC))
    if magic != MAGIC:
        source.fail("no binary file of Logic 2", "give a capture (.sal) or its raw export")
    source.offset += len(magic)
    version, kind = map(int, source.values(struct.Struct("<ii")))
    if (version, kind) == CAPTURED:
        _, rate, ms, fraction, _, chunks = source.values(HEADER)
        return Head(True, version, _rate(source, rate), start_of(int(ms), fraction), int(chunks))
    if kind == 1:
        source.fail("an analog channel", "export the digital channels")
    if kind != 0 or version not in (0, 1):
        source.fail(f"unknown version {version}, type {kind} of a binary file", EXPORT)
    chunks = int(source.values(struct.Struct("<Q"))[0]) if version else 1
    return Head(False, version, None, 0, chunks)


def _rate(source: Source, rate: float) -> float:
    if not 1 <= rate <= 1e11:  # not for NaN either
        source.fail(f"sampling rate of {rate:g} Hz")
    return float(rate)


def start_of(ms: float, fraction: float) -> int:
    """Nanoseconds since the epoch; 0 for what is no time of the years to 2200."""
    if not 0 < ms < 7.3e12 or not 0 <= fraction < 1:
        return 0
    return int(ms) * 1_000_000 + round(fraction * 1_000_000)


# ---- channels inside a capture


class _Chunk(NamedTuple):
    start: int
    samples: int
    level: int | None  # at its start; None: as at the end of the chunk before
    runs: bytes


def captured_pieces(source: Source, head: Head) -> Iterator[Piece]:
    """Edges of a channel inside a capture, in ticks of its sampling rate, from its header on.

    Raises
    ------
    FormatError
        Chunks that do not follow one another, runs that do not sum to their chunk's samples,
        a stream cut short or longer than the chunks.
    """
    batch: list[_Chunk] = []
    size, level = 0, None
    for chunk in _chunks(source, head):
        if batch and size + len(chunk.runs) > BATCH:
            piece, level = _piece(source, batch, level)
            yield piece
            batch, size = [], 0
        batch.append(chunk)
        size += len(chunk.runs)
    if batch:
        yield _piece(source, batch, level)[0]
    source.end()


def _chunks(source: Source, head: Head) -> Iterator[_Chunk]:
    until = None
    for _ in range(head.chunks):
        start, end, samples, rate, _, size = map(int, source.values(CHUNK))
        if not 0 < samples <= MOST_SAMPLES or end - start != samples or end > LAST_SAMPLE:
            source.fail(f"a chunk of {samples} samples from {start} to {end}")
        if until is not None and start != until:
            source.fail(f"a chunk that begins at sample {start}, where {until} is next")
        if rate != head.rate_hz:
            source.fail(f"a chunk of {rate} samples a second in a file of {head.rate_hz:g}")
        if not 0 < size <= MOST_CHUNK:
            source.fail(f"a chunk of {size} bytes")
        runs = source.read(size)
        (entries,) = map(int, source.values(struct.Struct("<Q")))
        if entries > size:
            source.fail(f"a chunk of {size} bytes with {entries} index entries")
        level = None
        if entries:
            sample, byte, level = map(int, source.values(INDEX))
            if sample or byte or level > 1:
                source.fail("a chunk whose index does not begin with its level")
            source.read((entries - 1) * INDEX.size)
        yield _Chunk(start, samples, level, runs)
        until = end


def _piece(source: Source, batch: list[_Chunk], before: int | None) -> tuple[Piece, int]:
    """Edges of consecutive chunks, and the level at their end.

    ``before`` is the level at the end of what came before them; None: nothing did.
    """
    payload = np.frombuffer(b"".join(chunk.runs for chunk in batch), np.uint8)
    begin = np.cumsum([0] + [len(chunk.runs) for chunk in batch])[:-1]  # byte of each chunk
    first = first_bytes(payload)
    if first is None or not first[begin].all():
        source.fail("a chunk that ends inside a run, or runs of an unknown code")
    at = np.flatnonzero(first)
    runs = run_lengths(payload, at)
    if runs is None or runs.max() > MOST_SAMPLES:
        source.fail("a run longer than any chunk")
    of_chunk = np.searchsorted(at, begin)  # first run of each chunk
    sums = np.add.reduceat(runs, of_chunk)
    wrong = sums != [chunk.samples for chunk in batch]
    if wrong.any():
        k = int(np.argmax(wrong))
        source.fail(f"runs of {sums[k]} samples in a chunk of {batch[k].samples}")

    # All ends of runs are edges; that of a chunk only if the next one begins at the other level.
    ends = batch[0].start + np.cumsum(runs)
    is_edge = np.ones(len(runs), bool)
    entry = _level(batch[0], before)
    level = entry
    for k, n in enumerate(np.diff(of_chunk, append=len(runs)).tolist()):
        begins = _level(batch[k], level)
        if k:
            is_edge[of_chunk[k] - 1] = begins != level
        level = begins ^ ((n - 1) & 1)
    is_edge[-1] = False  # the next piece tells
    tick = ends[is_edge]
    if before is not None and before != entry:
        tick = np.concatenate([[batch[0].start], tick])
        entry = before
    return Piece(tick, not entry, int(ends[-1])), level


def _level(chunk: _Chunk, before: int | None) -> int:
    """At the start of a chunk; low where nothing tells."""
    return (before or 0) if chunk.level is None else chunk.level


def first_bytes(payload: NDArray[np.uint8]) -> NDArray[np.bool_] | None:
    """Which bytes begin a run; (n,) bool.

    Whether a byte is followed by more of its run depends on its bit 6 if it is a first one,
    on bit 7 if not: as a map of that state, a byte whose two bits agree sets it, and one
    with bit 6 only inverts it. So the state after a byte is what the last byte of the
    former kind set, inverted once for each of the latter kind since.

    Returns
    -------
    (n,) bool ndarray or None
        None where the last run does not end or a first byte has bit 7, which none has.
    """
    six, seven = (payload >> 6) & 1, payload >> 7
    sets = six == seven
    inverted = np.bitwise_xor.accumulate(six & (seven ^ 1))
    last = np.maximum.accumulate(np.where(sets, np.arange(len(payload), dtype=np.int32), -1))
    base = (six ^ inverted)[last]
    base[last < 0] = 0  # a stream begins as if a run had just ended
    more = base ^ inverted
    first = np.empty(len(payload), bool)
    first[0] = True
    np.equal(more[:-1], 0, out=first[1:])
    if more[-1] or np.any(seven[first]):
        return None
    return first


def run_lengths(payload: NDArray[np.uint8], at: NDArray[np.intp]) -> Ticks | None:
    """Samples of the runs that begin at bytes ``at``; None where one is too long."""
    sizes = np.diff(at, append=len(payload))
    longest = int(sizes.max())
    if longest > MOST_RUN:
        return None
    value = (payload[at] & 0x3F).astype(np.int64)
    going = np.arange(len(at))
    for k in range(1, longest):
        going = going[sizes[going] > k]
        value[going] = value[going] << 7 | payload[at[going] + k] & 0x7F
    return value + 1


# ---- exports


def export_pieces(source: Source, head: Head) -> Iterator[Piece]:
    """Edges of an exported channel, in nanoseconds.

    Raises
    ------
    FormatError
        Times that do not ascend or are no times, a stream cut short or longer than told.
    """
    level, last = None, -(1 << 62)
    for _ in range(head.chunks):
        state, begin, end, count = _export_head(source, head.version)
        changes = level is not None and level != state
        if begin > end or begin < last + changes:
            source.fail(f"data from {begin} ns to {end} ns, where {last} ns is reached")
        last = max(last, begin - 1)
        if changes:
            yield Piece(np.array([begin]), bool(state), begin + 1)
            last = begin
        level = state
        while count:
            n = min(count, TIMES)
            tick = _nanoseconds(source, np.frombuffer(source.read(8 * n), "<f8"))
            back = np.diff(tick, prepend=last) <= 0
            if back.any():
                source.fail(f"an edge at {tick[np.argmax(back)]} ns, not after what is before it")
            if tick[-1] > end:
                source.fail(f"an edge at {tick[-1]} ns, where the data end at {end} ns")
            yield Piece(tick, not level, int(tick[-1]) + 1)
            level ^= n & 1
            last, count = int(tick[-1]), count - n
        yield Piece(np.zeros(0, np.int64), not level, max(end, last + 1))
    source.end()


def export_rate(source: Source, head: Head) -> float | None:
    """Sampling rate of an export, from its header on; None where it tells none."""
    if not head.version or not head.chunks:
        return None
    return _rate(source, source.values(EXPORT_1)[1])


def _export_head(source: Source, version: int) -> tuple[int, int, int, int]:
    """Level, begin and end in nanoseconds, edges."""
    values = source.values(EXPORT_1 if version else EXPORT_0)
    state, begin, end, count = int(values[0]), values[-3], values[-2], int(values[-1])
    if state > 1:
        source.fail(f"a level of {state}")
    first, last = _nanoseconds(source, np.array([begin, end])).tolist()
    return state, first, last, count


def _nanoseconds(source: Source, seconds: NDArray[np.float64]) -> Ticks:
    if not np.all(np.abs(seconds) <= MOST_SECONDS):  # not for NaN either
        source.fail("a time that is no number of seconds within eleven days")
    return np.rint(seconds * NANOSECONDS_PER_S).astype(np.int64)
