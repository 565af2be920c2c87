"""Bitcraze's Lighthouse deck: 12 bytes for each pulse of light on one of its photodiodes.

Little-endian, 230,400 baud, and twice per second a sync frame of 12 bytes 0xFF::

    byte 0      sensor (2 bits), slow bit, channel from 0 (4 bits), 1 if both are unknown
    bytes 1-2   width of the pulse in ticks of 24 MHz
    bytes 3-5   offset from the rotor's zero in steps of 6 MHz, 0 if unknown; 7 bits 0
    bytes 6-8   beam word: first 17 bits of the beam, 0 if too few were received; 7 bits 0
    bytes 9-11  start of the pulse in ticks of 24 MHz

Sources: bitcraze/lighthouse-fpga, readme, ``PulseIdentifier`` and ``PulseOffsetFinder``.

**Alignment.** Only the zero bits guard a frame, and the bytes 3 before them are zero as well,
except in wide pulses. Therefore a pulse without polynomial must have no offset (the deck finds
none), and alignment needs a sync frame and two more frames, or three frames whose offsets agree
with the LFSR indices of their beam words. A frame is accepted if the next one is valid too, or
the one after an invalid frame: a lost byte can belong to the frames on both sides of the fault.

**Sweeps.** Pulses less than 10,000 ticks apart are one passage of one light plane, or of two
that cross. The deck identifies a polynomial from two consecutive pulses, so that the first has
none, and searches the offset once per passage; the offsets of the other pulses follow from
their times. Crazyflie's firmware accepts passages of one station that light all four sensors.
Here each beam word decides: in the published frames of a deck the LFSR index of a beam word is
within 0.75 steps of the predicted one. A pulse whose word disagrees is left out; a pulse
without a word gets the polynomial of its passage, if that is unique and its sensor was lit
once. If most offsets disagree with their words (another firmware, empty words), words are not
used, and a remark reports it.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.lighthouse import lfsr
from locatk.core.lighthouse.channels import CHANNELS, channel_of
from locatk.core.lighthouse.recording import UNKNOWN
from locatk.formats.devices.interface import Batch, Counts, Options, Recording, Stream, Ticks

Bytes = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Index = NDArray[np.int64]
_Frames = tuple[Bytes, Index]

FRAME_BYTES = 12
SENSOR_COUNT = 4
TICKS_PER_COUNT = 4
SYNC_FRAME = b"\xff" * FRAME_BYTES
SYNC_INTERVAL_NS = 500_000_000
STREAM = Stream("lighthouse", sensors=SENSOR_COUNT, ticks=Ticks(24e6, 24))

MAX_GAP_TICKS = 10_000
"""Between pulses of one passage (crazyflie-firmware ``pulse_processor_v2.c``)."""

MAX_PASSAGE_PULSES = 64
"""Pulses of one passage: sixteen stations on all sensors."""

MAX_IDENTIFICATION_TICKS = 4096
"""Between two pulses from which the deck identifies their polynomial."""

MAX_COUNT_DIFFERENCE = 4
"""Between the LFSR index of a beam word and the count predicted from the time of its pulse."""

TESTED_OFFSETS = 5
"""Offsets from which it is decided whether beam words are used."""

WORDS_UNUSED = "beam words disagree with the offsets: sweeps are not checked by them"

_PULSE = np.dtype(
    [(k, "i4") for k in ("sensor", "polynomial", "offset", "word", "tick")]
    + [("end", "i8"), ("group", "i8")]
)


class DeckDecoder:
    """Decoder of a Lighthouse deck.

    Sweeps are returned when their passage is over: with the first frames of the next passage,
    or after two sync frames. :attr:`.Batch.end` is that of the pulse's own frame, and
    :attr:`.Batch.tick` its start. The deck does not send the light plane of a sweep.
    """

    def __init__(self, options: Options) -> None:
        self.counts = Counts()
        self.remarks: list[str] = []
        self._aligner = _Aligner(self.counts)
        self._open = np.zeros(0, _PULSE)
        self._waiting = self._open
        self._uses_words: bool | None = None
        self._syncs = self._pulses = self._returned = 0

    def feed(self, data: bytes, *, pause: bool = False) -> list[Batch]:
        """Return the sweeps of the passages that these bytes end."""
        self.counts.bytes += len(data)
        return self._take(data, last=False)

    def restart(self) -> list[Batch]:
        """Return the sweeps of the last passage, after a reconnect."""
        batches = self._take(b"", last=True)
        self._uses_words = None
        return batches

    def finish(self) -> list[Batch]:
        """Return the sweeps of the last passage."""
        batches = self._take(b"", last=True)
        if unused := self._pulses - self._returned:
            self.remarks.append(
                f"{unused} of {self._pulses} pulses are in no sweep: their passage has no offset, "
                "or no polynomial that matches them"
            )
        return batches

    def _take(self, data: bytes, last: bool) -> list[Batch]:
        pulses = self._completed_pulses(*self._aligner.feed(data, last), last)
        pulses = self._valid_pulses(pulses, last)
        if not len(pulses):
            return []
        count, polynomial = _counts(pulses, bool(self._uses_words))
        rows = np.flatnonzero(polynomial != UNKNOWN)
        self._returned += len(rows)
        if not len(rows):
            return []
        columns: dict[str, NDArray[Any]] = {
            "sensor": pulses["sensor"][rows],
            "channel": channel_of(polynomial[rows]).astype(np.int32),
            "polynomial": polynomial[rows],
            "sweep": np.full(len(rows), UNKNOWN, np.int32),
            "count": count[rows],
        }
        return [Batch(STREAM, pulses["end"][rows], columns, pulses["tick"][rows].astype("i8"))]

    def _completed_pulses(self, rows: Bytes, ends: Index, last: bool) -> NDArray[np.void]:
        """Return the pulses of completed passages with an offset, numbered by passage."""
        is_sync = rows[:, 5] == 0xFF
        new = _parse_pulses(rows[~is_sync], ends[~is_sync])
        # Until passages are numbered, "group" is the number of sync frames before a pulse.
        new["group"] = self._syncs + np.cumsum(is_sync)[~is_sync]
        self._syncs += int(np.count_nonzero(is_sync))
        self.counts.frames += int(np.count_nonzero(is_sync))
        pulses = np.concatenate([self._open, new])
        if not len(pulses):
            return pulses
        # A passage also ends if two sync frames, half a second apart, follow without light.
        is_dark = np.diff(pulses["group"]) >= 2
        gap = np.abs(_wrapped_difference(np.diff(pulses["tick"])))
        starts = np.r_[True, (gap > MAX_GAP_TICKS) | is_dark]
        indices = np.arange(len(pulses))
        first = np.maximum.accumulate(np.where(starts, indices, 0))
        starts |= (indices - first) % MAX_PASSAGE_PULSES == 0
        is_complete = last or self._syncs - pulses["group"][-1] >= 2
        stop = len(pulses) if is_complete else int(np.flatnonzero(starts)[-1])
        completed, self._open = pulses[:stop], pulses[stop:].copy()
        group = np.cumsum(starts[:stop]) - 1
        has_offset = np.zeros(stop, bool)
        has_offset[group[completed["offset"] > 0]] = True
        completed["group"] = self._pulses + group
        self._pulses += stop
        self.counts.frames += stop
        return completed[has_offset[group]]

    def _valid_pulses(self, pulses: NDArray[np.void], last: bool) -> NDArray[np.void]:
        """Return the pulses without contradictions, once the use of beam words is decided."""
        pulses, self._waiting = np.concatenate([self._waiting, pulses]), pulses[:0]
        has_offset = pulses["offset"] > 0
        agrees = _word_agrees(pulses, pulses["polynomial"], pulses["offset"])
        if self._uses_words is None and len(pulses):
            tested = agrees[has_offset][:TESTED_OFFSETS]
            if len(tested) < TESTED_OFFSETS and not last:
                self._waiting = pulses
                return pulses[:0]
            self._uses_words = bool(np.mean(tested) >= 0.5)
            if not self._uses_words:
                self.remarks.append(WORDS_UNUSED)
        is_wrong = has_offset & ~agrees & bool(self._uses_words)
        self.counts.bad += int(np.count_nonzero(is_wrong))
        self.counts.frames -= int(np.count_nonzero(is_wrong))
        return pulses[~is_wrong]


class _Aligner:
    """Extracts valid frames from a byte stream, and counts invalid ones."""

    def __init__(self, counts: Counts) -> None:
        self._counts = counts
        self._rest = b""
        self._base = 0  # bytes before the rest
        self._is_aligned = False
        self._doubtful: list[_Frames] = []

    def feed(self, data: bytes, last: bool) -> _Frames:
        """Return frames (n, 12), and the number of bytes fed up to the end of each."""
        data = self._rest + data
        buffer = np.frombuffer(data, np.uint8)
        is_pulse, is_sync = _possible_frames(buffer)
        is_valid = is_pulse | is_sync
        locks: Index | None = None
        frames: list[_Frames] = [(np.zeros((0, FRAME_BYTES), np.uint8), np.zeros(0, np.int64))]
        position = 0
        while True:
            if not self._is_aligned:
                locks = _lock_positions(buffer, is_pulse, is_sync) if locks is None else locks
                following = locks[np.searchsorted(locks, position) :]
                if not len(following):
                    position = max(position, len(data) - 3 * FRAME_BYTES + 1)
                    break
                position = int(following[0])
                position += self._resume(self._base + position, frames)
            chain = is_valid[position::FRAME_BYTES]
            valid_count = len(chain) if np.all(chain) else int(np.argmin(chain))
            # The last valid frame waits until the next one is valid too.
            is_end = last and valid_count == len(chain)
            confirmed = valid_count if is_end else max(valid_count - 1, 0)
            ends = np.arange(1, valid_count + 1) * FRAME_BYTES + position
            rows = buffer[position : position + valid_count * FRAME_BYTES]
            rows = rows.reshape(-1, FRAME_BYTES)
            frames.append((rows[:confirmed], self._base + ends[:confirmed]))
            position += confirmed * FRAME_BYTES
            self._is_aligned = valid_count == len(chain)
            if self._is_aligned:
                break
            self._doubtful = [(rows[confirmed:].copy(), self._base + ends[confirmed:])]
            position += 1
        self._rest = data[position:]
        self._base += min(position, len(data))
        if last:
            self._reset()
        return np.concatenate([row for row, _ in frames]), np.concatenate(
            [end for _, end in frames]
        )

    def _resume(self, start: int, frames: list[_Frames]) -> int:
        """Handle the doubtful frame before a new alignment; return the bytes to skip.

        If a whole number of frames lies between, the frame is accepted. Otherwise bytes were
        lost, and the first frame after them may lack some: it is skipped.
        """
        step = 0
        for rows, ends in self._doubtful:
            invalid_frames, remainder = divmod(start - int(ends[0]), FRAME_BYTES)
            step = FRAME_BYTES if remainder else 0
            self._counts.bad += 1 if remainder else invalid_frames
            self._counts.skipped += start - int(ends[0]) + 2 * step
            frames += [] if remainder else [(rows, ends)]
        self._doubtful = []
        return step

    def _reset(self) -> None:
        """Discard the rest, as at the start of a stream."""
        self._base += len(self._rest)
        for _, ends in self._doubtful:
            self._counts.bad += 1
            self._counts.skipped += self._base - int(ends[0]) + FRAME_BYTES
        self._rest, self._is_aligned, self._doubtful = b"", False, []


def _possible_frames(buffer: Bytes) -> tuple[Mask, Mask]:
    """Return whether a pulse, and whether a sync frame, can start at each byte."""
    n = max(len(buffer) - FRAME_BYTES + 1, 0)

    def byte(k: int) -> Bytes:
        return buffer[k : n + k]

    is_pulse = ((byte(5) | byte(8)) & 0xFE) == 0
    is_pulse &= (byte(0) < 0x80) | ((byte(3) | byte(4) | byte(5)) == 0)
    # Runs of 2, 4 and 8 bytes 0xFF; two of 8 that overlap by 4 are a run of 12.
    is_run = buffer == 0xFF
    for step in (1, 2, 4):
        is_run = is_run[: max(len(is_run) - step, 0)] & is_run[step:]
    return is_pulse, is_run[:n] & is_run[4 : n + 4]


def _lock_positions(buffer: Bytes, is_pulse: Mask, is_sync: Mask) -> Index:
    """Return the bytes at which enough valid frames start for an unambiguous alignment."""
    starts = np.flatnonzero(is_pulse)
    pulses = _parse_pulses(buffer[starts[:, None] + np.arange(FRAME_BYTES)], starts)
    polynomial, offset = pulses["polynomial"], pulses["offset"]
    agrees = np.zeros(len(is_pulse), bool)
    is_consistent = _word_agrees(pulses, polynomial, offset)
    agrees[starts] = np.where(offset > 0, is_consistent, pulses["word"] > 0)
    agrees[starts] |= polynomial == UNKNOWN
    is_strong, is_valid = agrees | is_sync, is_pulse | is_sync
    a, b, c = (
        slice(-2 * FRAME_BYTES),
        slice(FRAME_BYTES, -FRAME_BYTES),
        slice(2 * FRAME_BYTES, None),
    )
    three_agree = is_strong[a] & is_strong[b] & is_strong[c] & (agrees[a] | agrees[b] | agrees[c])
    return np.flatnonzero(three_agree | (is_sync[a] & is_pulse[b] & is_valid[c]))


def _word_agrees(pulses: NDArray[np.void], polynomial: Index, count: NDArray[Any]) -> Mask:
    """Return whether the LFSR index of each beam word agrees with a polynomial and count."""
    index = lfsr.indices(pulses["word"], np.maximum(polynomial, 0))
    difference = np.abs(index - count)
    return np.asarray((index != lfsr.NO_INDEX) & (difference <= MAX_COUNT_DIFFERENCE))


def _parse_pulses(rows: Bytes, ends: Index) -> NDArray[np.void]:
    """Return the fields of frames (n, 12)."""
    pulses = np.zeros(len(rows), _PULSE)
    first, second, third = np.ascontiguousarray(rows).view("<u4").astype(np.int64).T
    pulses["sensor"] = first & 3
    pulses["polynomial"] = np.where(first & 0x80, UNKNOWN, first >> 2 & 31)
    pulses["offset"] = first >> 24 | (second & 0xFFFF) << 8
    pulses["word"] = second >> 16 | (third & 0xFF) << 16
    pulses["tick"] = third >> 8
    pulses["end"] = ends
    return pulses


def _counts(pulses: NDArray[np.void], uses_words: bool) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return counts and polynomials (-1: unknown) of the pulses of whole passages."""
    own, offset, tick = pulses["polynomial"], pulses["offset"], pulses["tick"]
    is_identified, has_offset = own != UNKNOWN, offset > 0
    n, indices = len(pulses), np.arange(len(pulses))
    starts = np.flatnonzero(np.r_[True, np.diff(pulses["group"]) != 0])
    stops = np.r_[starts[1:], n]
    group = np.repeat(np.arange(len(starts)), stops - starts)
    smallest = np.minimum.reduceat(np.where(is_identified, own, 99), starts)
    has_one_polynomial = smallest == np.maximum.reduceat(own, starts)
    group_sensor = group * SENSOR_COUNT + pulses["sensor"]
    is_single = np.bincount(group_sensor)[group_sensor] == 1
    is_unambiguous = is_identified | (has_one_polynomial[group] & is_single)
    is_wordless = np.ones(n, bool)
    if uses_words:
        is_wordless = (pulses["word"] == 0) & ~is_identified

    count, polynomial = np.full(n, np.nan), np.full(n, UNKNOWN, np.int32)
    # Counts follow from the last offset before a pulse, or else from the first one after it.
    before = np.maximum.accumulate(np.where(has_offset, indices, -1))
    after = np.minimum.accumulate(np.where(has_offset, indices, n)[::-1])[::-1]
    for base, in_group in ((before, before >= starts[group]), (after, after < stops[group])):
        base = np.where(in_group, base, indices)
        base_polynomial = np.maximum(own[base], 0)
        predicted = offset[base] + _wrapped_difference(tick - tick[base]) / TICKS_PER_COUNT
        accepted = in_group & (~is_identified | (own == base_polynomial))
        agrees = _word_agrees(pulses, base_polynomial, predicted)
        accepted &= np.where(is_wordless, is_unambiguous, agrees)
        accepted &= polynomial == UNKNOWN
        count[accepted], polynomial[accepted] = predicted[accepted], base_polynomial[accepted]
    return count, polynomial


def _wrapped_difference(ticks: NDArray[Any]) -> NDArray[Any]:
    """Return differences of a 24-bit counter in the range of -2^23 to 2^23 - 1."""
    return (ticks + (1 << 23) & 0xFFFFFF) - (1 << 23)


def encode(recording: Recording) -> Iterator[tuple[int, bytes]]:
    """Return (time in ns, bytes) of a deck that receives the sweeps of the first device.

    The sweeps of a station with one timestamp are spread as its rotor makes them, the last at
    that time. As in a deck, the first pulse of a passage has no polynomial and the second has
    the offset. A single pulse, as all are of a device with one photodiode, has both, although a
    deck could not identify it. Counts are rounded to integers; those of the other pulses of a
    passage are quarters relative to it.

    Raises
    ------
    InputError
        There are no sweeps of sensors 0 to 3 of the first device.
    """
    sweeps, usable = recording.sweeps, np.zeros(0, bool)
    if sweeps is not None:
        usable = (sweeps.device == 0) & np.isin(sweeps.sensor, range(SENSOR_COUNT))
        usable &= np.isin(sweeps.channel, CHANNELS)
        usable &= (sweeps.count >= 0.5) & (sweeps.count <= lfsr.SEQUENCE_LENGTH - 1)
    if sweeps is None or not np.any(usable):
        raise InputError(
            "no sweeps that a Lighthouse deck receives",
            hint="Give a session with sweeps of sensors 0 to 3 of its first device",
        )
    channel, own = sweeps.channel[usable].astype("i8"), sweeps.polynomial[usable]
    polynomial = np.where(own >> 1 == channel - 1, own, 2 * (channel - 1))
    columns: Iterator[Any] = (c[usable] for c in (sweeps.time_ns, sweeps.sensor, sweeps.count))
    passages = _encode_passages(polynomial, *columns)
    syncs = range(passages[0][0], passages[-1][0] + SYNC_INTERVAL_NS, SYNC_INTERVAL_NS)
    return heapq.merge(((time, SYNC_FRAME) for time in syncs), passages, key=itemgetter(0))


def _encode_passages(
    polynomial: Index, time_ns: Index, sensor: NDArray[Any], count: NDArray[np.float64]
) -> list[tuple[int, bytes]]:
    """Return the frames of each passage, with the time of its last pulse."""
    origin = int(time_ns.min())
    tick = (time_ns - origin) * 3 // 125
    _, timestamp_index = np.unique(tick * 16 + (polynomial >> 1), return_inverse=True)
    largest = np.zeros(len(count))
    np.maximum.at(largest, timestamp_index, count)
    tick -= np.rint(TICKS_PER_COUNT * (largest[timestamp_index] - count)).astype(np.int64)

    # Make the intervals between the pulses of a passage agree with their counts.
    order = np.lexsort((tick, polynomial))
    steps = TICKS_PER_COUNT * count[order]
    is_gap = (np.diff(tick[order]) > MAX_GAP_TICKS) | (np.abs(np.diff(steps)) > MAX_GAP_TICKS)
    starts = np.r_[True, is_gap | (np.diff(polynomial[order]) != 0)]
    first = np.flatnonzero(starts)[np.cumsum(starts) - 1]
    tick[order] = tick[order][first] + np.rint(steps - steps[first]).astype(np.int64)
    passage = np.empty_like(order)
    passage[order] = first

    order = np.argsort(tick, kind="stable")
    tick, integer_count = tick[order], np.rint(count[order]).astype(np.int64)
    sensor, polynomial, gaps = sensor[order], polynomial[order], np.diff(tick)
    is_pair = (np.diff(passage[order]) == 0) & (gaps <= MAX_IDENTIFICATION_TICKS)
    follows = np.r_[False, is_pair]
    is_head = np.r_[follows[1:], False] & ~follows
    has_offset = ~is_head & ~(follows & np.r_[False, follows[:-1]])
    rows = np.zeros((len(tick), FRAME_BYTES), np.uint8)
    rows[:, 0] = np.where(is_head, 0xFC, polynomial << 2) | sensor
    rows[:, 1], rows[:, 2] = 0x2C, 0x01  # Width of 12.5 us, typical at a few metres.
    words = lfsr.state_at(integer_count, polynomial)
    for k, value in ((3, np.where(has_offset, integer_count, 0)), (6, words), (9, tick)):
        rows[:, k : k + 3] = value[:, None] >> (0, 8, 16) & 0xFF
    cuts = np.flatnonzero(gaps > MAX_GAP_TICKS) + 1
    times = origin + tick[np.r_[cuts, len(tick)] - 1] * 125 // 3
    parts = np.split(rows, cuts)
    return [(time, part.tobytes()) for time, part in zip(times.tolist(), parts, strict=True)]
