"""Bitcraze's Lighthouse deck: 12 bytes for each pulse of light on one of its photodiodes.

Little-endian, 230400 baud, and twice a second a frame of nothing but 0xFF::

    byte 0      sensor (2 bits), slow bit, channel from 0 (4 bits), 1 if both are unknown
    bytes 1-2   width of the pulse in ticks of 24 MHz
    bytes 3-5   offset from the rotor's zero in steps of 6 MHz, 0 if not found; 7 bits 0
    bytes 6-8   first 17 bits of the beam, 0 if too few were seen; 7 bits 0
    bytes 9-11  when the pulse began, in ticks of 24 MHz

Source: bitcraze/lighthouse-fpga, readme, ``PulseIdentifier`` and ``PulseOffsetFinder``.

**Alignment.** Only the zero bits guard a frame, and they stand again 3 bytes earlier in
all but wide pulses. So a pulse without polynomial must have no offset (the deck finds
none), and alignment takes a sync frame and two more, or three frames whose offsets are
where their beam words stand in the sequence. A frame counts when the next is right too, or
the one after a wrong one: a lost byte can be of the frames on either side of the fault.

**Sweeps.** Pulses less than 10,000 ticks apart are the passage of one light plane, or of
two that cross. The deck knows a polynomial from two pulses in a row, so that the first has
none, and looks for the offset once; the others stand as many steps further as their time
says. Crazyflie's firmware takes passages of one station with all four sensors lit. Here
each beam word decides: in the deck's published frames they stand within 0.75 steps of where
their time says. A pulse whose word stands elsewhere is left out; without a word it takes
the polynomial of its passage, if there is only one and its sensor was lit once. Where most
offsets are not where their words stand (another firmware, words left empty), words are not
used, and a remark says so.
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
from locatk.formats.devices.decoder import Batch, Counts, Options, Stream, Ticks
from locatk.formats.devices.recording import Recording

Bytes = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Index = NDArray[np.int64]
_Frames = tuple[Bytes, Index]

FRAME = 12
SENSORS = 4
TICKS_PER_COUNT = 4
SYNC = b"\xff" * FRAME
SYNC_NS = 500_000_000
STREAM = Stream("lighthouse", ticks=Ticks(24e6, 24))

GAP = 10_000
"""Ticks from pulse to pulse of one passage (crazyflie-firmware ``pulse_processor_v2.c``)."""

MOST = 64
"""Pulses that are looked at together: sixteen stations on all sensors."""

IDENTIFIED = 4096
"""Ticks within which the deck finds the polynomial of two pulses."""

SLACK = 4
"""Steps by which a beam word may stand elsewhere than the time of its pulse says."""

JURY = 5
"""Offsets on which it is decided whether beam words are to be believed."""

UNBELIEVED = "beam words are not where the offsets say: sweeps are not checked by them"

_PULSE = np.dtype(
    [(k, "i4") for k in ("sensor", "polynomial", "offset", "word", "tick")]
    + [("end", "i8"), ("group", "i8")]
)


class DeckDecoder:
    """Sweeps of a Lighthouse deck, when their passage is over: with the first frames of the
    next, or after two sync frames. ``end`` is that of the pulse's own frame, and ``tick``
    its time. Which plane of the rotation it was, the deck does not tell."""

    def __init__(self, options: Options) -> None:
        self.counts = Counts()
        self.remarks: list[str] = []
        self._aligned = _Aligner(self.counts)
        self._open = np.zeros(0, _PULSE)
        self._waiting = self._open
        self._believed: bool | None = None
        self._syncs = self._pulses = self._given = 0

    def feed(self, data: bytes, *, pause: bool = False) -> list[Batch]:
        """Take the next bytes and give the sweeps of the passages that they end."""
        self.counts.bytes += len(data)
        return self._take(data, last=False)

    def restart(self) -> list[Batch]:
        """The connection was lost: the last passage is over."""
        batches = self._take(b"", last=True)
        self._believed = None
        return batches

    def finish(self) -> list[Batch]:
        """No more bytes: the last passage is over."""
        batches = self._take(b"", last=True)
        if left := self._pulses - self._given:
            self.remarks.append(
                f"{left} of {self._pulses} pulses are in no sweep: their passage has no offset, "
                "or no polynomial of it is theirs"
            )
        return batches

    def _take(self, data: bytes, last: bool) -> list[Batch]:
        pulses = self._judged(self._passages(*self._aligned.feed(data, last), last), last)
        if not len(pulses):
            return []
        count, polynomial = _counts(pulses, bool(self._believed))
        given = np.flatnonzero(polynomial != UNKNOWN)
        self._given += len(given)
        if not len(given):
            return []
        columns: dict[str, NDArray[Any]] = {
            "sensor": pulses["sensor"][given],
            "channel": channel_of(polynomial[given]).astype(np.int32),
            "polynomial": polynomial[given],
            "sweep": np.full(len(given), UNKNOWN, np.int32),
            "count": count[given],
        }
        return [Batch(STREAM, pulses["end"][given], columns, pulses["tick"][given].astype("i8"))]

    def _passages(self, rows: Bytes, ends: Index, last: bool) -> NDArray[np.void]:
        """Pulses of passages that are over and have an offset, numbered by passage."""
        sync = rows[:, 5] == 0xFF
        new = _pulses(rows[~sync], ends[~sync])
        # Until they are numbered, pulses carry the number of sync frames before them.
        new["group"] = self._syncs + np.cumsum(sync)[~sync]
        self._syncs += int(np.count_nonzero(sync))
        self.counts.frames += int(np.count_nonzero(sync))
        pulses = np.concatenate([self._open, new])
        if not len(pulses):
            return pulses
        # Half a second without any light, between sync frames, ends a passage as well.
        dark = np.diff(pulses["group"]) >= 2
        starts = np.r_[True, (np.abs(_wrapped(np.diff(pulses["tick"]))) > GAP) | dark]
        here = np.arange(len(pulses))
        starts |= (here - np.maximum.accumulate(np.where(starts, here, 0))) % MOST == 0
        ended = last or self._syncs - pulses["group"][-1] >= 2
        over = len(pulses) if ended else int(np.flatnonzero(starts)[-1])
        whole, self._open = pulses[:over], pulses[over:].copy()
        group = np.cumsum(starts[:over]) - 1
        found = np.zeros(over, bool)
        found[group[whole["offset"] > 0]] = True
        whole["group"] = self._pulses + group
        self._pulses += over
        self.counts.frames += over
        return whole[found[group]]

    def _judged(self, pulses: NDArray[np.void], last: bool) -> NDArray[np.void]:
        """Those that a deck can have sent, once it is clear whether words are believed."""
        pulses, self._waiting = np.concatenate([self._waiting, pulses]), pulses[:0]
        found = pulses["offset"] > 0
        stands = _stands(pulses, pulses["polynomial"], pulses["offset"])
        if self._believed is None and len(pulses):
            jury = stands[found][:JURY]
            if len(jury) < JURY and not last:
                self._waiting = pulses
                return pulses[:0]
            self._believed = bool(np.mean(jury) >= 0.5)
            if not self._believed:
                self.remarks.append(UNBELIEVED)
        wrong = found & ~stands & bool(self._believed)
        self.counts.bad += int(np.count_nonzero(wrong))
        self.counts.frames -= int(np.count_nonzero(wrong))
        return pulses[~wrong]


class _Aligner:
    """Bytes in, right frames out; counts what is wrong."""

    def __init__(self, counts: Counts) -> None:
        self._counts = counts
        self._rest = b""
        self._base = 0  # bytes before the rest
        self._aligned = False
        self._doubt: list[_Frames] = []

    def feed(self, data: bytes, last: bool) -> _Frames:
        """Frames (n, 12), and how many bytes were fed up to the end of each."""
        data = self._rest + data
        buffer = np.frombuffer(data, np.uint8)
        pulse, sync = _frames(buffer)
        right = pulse | sync
        locks: Index | None = None
        frames: list[_Frames] = [(np.zeros((0, FRAME), np.uint8), np.zeros(0, np.int64))]
        at = 0
        while True:
            if not self._aligned:
                locks = _locks(buffer, pulse, sync) if locks is None else locks
                found = locks[np.searchsorted(locks, at) :]
                if not len(found):
                    at = max(at, len(data) - 3 * FRAME + 1)
                    break
                at = int(found[0])
                at += self._resume(self._base + at, frames)
            chain = right[at::FRAME]
            good = len(chain) if np.all(chain) else int(np.argmin(chain))
            # The last of them waits for a next one that is right too.
            sure = good if last and good == len(chain) else max(good - 1, 0)
            ends = np.arange(1, good + 1) * FRAME + at
            rows = buffer[at : at + good * FRAME].reshape(-1, FRAME)
            frames.append((rows[:sure], self._base + ends[:sure]))
            at += sure * FRAME
            self._aligned = good == len(chain)
            if self._aligned:
                break
            self._doubt = [(rows[sure:].copy(), self._base + ends[sure:])]
            at += 1
        self._rest = data[at:]
        self._base += min(at, len(data))
        if last:
            self._drop()
        return np.concatenate([row for row, _ in frames]), np.concatenate(
            [end for _, end in frames]
        )

    def _resume(self, start: int, frames: list[_Frames]) -> int:
        """Aligned again: keep the frame in doubt, or step over the first after lost bytes,
        some of which may have been its own. Gives the bytes to step over."""
        step = 0
        for rows, ends in self._doubt:
            wrong, odd = divmod(start - int(ends[0]), FRAME)
            step = FRAME if odd else 0
            self._counts.bad += 1 if odd else wrong
            self._counts.skipped += start - int(ends[0]) + 2 * step
            frames += [] if odd else [(rows, ends)]
        self._doubt = []
        return step

    def _drop(self) -> None:
        """Begin anew, as if nothing had been heard before."""
        self._base += len(self._rest)
        for _, ends in self._doubt:
            self._counts.bad += 1
            self._counts.skipped += self._base - int(ends[0]) + FRAME
        self._rest, self._aligned, self._doubt = b"", False, []


def _frames(buffer: Bytes) -> tuple[Mask, Mask]:
    """Whether a pulse, and whether a sync frame, can begin at each byte."""
    n = max(len(buffer) - FRAME + 1, 0)

    def byte(k: int) -> Bytes:
        return buffer[k : n + k]

    pulse = ((byte(5) | byte(8)) & 0xFE) == 0
    pulse &= (byte(0) < 0x80) | ((byte(3) | byte(4) | byte(5)) == 0)
    full = buffer == 0xFF
    for step in (1, 2, 4):
        full = full[: max(len(full) - step, 0)] & full[step:]
    return pulse, full[:n] & full[4 : n + 4]


def _locks(buffer: Bytes, pulse: Mask, sync: Mask) -> Index:
    """Where enough right frames begin to be sure of the alignment."""
    at = np.flatnonzero(pulse)
    pulses = _pulses(buffer[at[:, None] + np.arange(FRAME)], at)
    own, offset = pulses["polynomial"], pulses["offset"]
    words = np.zeros(len(pulse), bool)
    words[at] = np.where(offset > 0, _stands(pulses, own, offset), pulses["word"] > 0)
    words[at] |= own == UNKNOWN
    sure, right = words | sync, pulse | sync
    a, b, c = slice(-2 * FRAME), slice(FRAME, -FRAME), slice(2 * FRAME, None)
    three = sure[a] & sure[b] & sure[c] & (words[a] | words[b] | words[c])
    return np.flatnonzero(three | (sync[a] & pulse[b] & right[c]))


def _stands(pulses: NDArray[np.void], polynomial: Index, count: NDArray[Any]) -> Mask:
    """Whether beam words stand in the sequence of a polynomial at a count."""
    index = lfsr.indices(pulses["word"], np.maximum(polynomial, 0))
    return np.asarray((index != lfsr.NO_INDEX) & (np.abs(index - count) <= SLACK))


def _pulses(rows: Bytes, ends: Index) -> NDArray[np.void]:
    """What frames (n, 12) say."""
    pulses = np.zeros(len(rows), _PULSE)
    first, second, third = np.ascontiguousarray(rows).view("<u4").astype(np.int64).T
    pulses["sensor"] = first & 3
    pulses["polynomial"] = np.where(first & 0x80, UNKNOWN, first >> 2 & 31)
    pulses["offset"] = first >> 24 | (second & 0xFFFF) << 8
    pulses["word"] = second >> 16 | (third & 0xFF) << 16
    pulses["tick"] = third >> 8
    pulses["end"] = ends
    return pulses


def _counts(pulses: NDArray[np.void], believed: bool) -> tuple[NDArray[Any], NDArray[Any]]:
    """Counts and polynomials (-1: no telling) of pulses of whole passages."""
    own, offset, tick = pulses["polynomial"], pulses["offset"], pulses["tick"]
    known, found = own != UNKNOWN, offset > 0
    n, here = len(pulses), np.arange(len(pulses))
    starts = np.flatnonzero(np.r_[True, np.diff(pulses["group"]) != 0])
    stops = np.r_[starts[1:], n]
    group = np.repeat(np.arange(len(starts)), stops - starts)
    one = np.minimum.reduceat(np.where(known, own, 99), starts) == np.maximum.reduceat(own, starts)
    lit = group * SENSORS + pulses["sensor"]
    clear = known | (one[group] & (np.bincount(lit)[lit] == 1))
    silent = (pulses["word"] == 0) & ~known if believed else np.ones(n, bool)

    count, polynomial = np.full(n, np.nan), np.full(n, UNKNOWN, np.int32)
    before = np.maximum.accumulate(np.where(found, here, -1))
    after = np.minimum.accumulate(np.where(found, here, n)[::-1])[::-1]
    for base, there in ((before, before >= starts[group]), (after, after < stops[group])):
        base = np.where(there, base, here)
        of = np.maximum(own[base], 0)
        expected = offset[base] + _wrapped(tick - tick[base]) / TICKS_PER_COUNT
        fits = there & (~known | (own == of))
        fits &= np.where(silent, clear, _stands(pulses, of, expected))
        fits &= polynomial == UNKNOWN
        count[fits], polynomial[fits] = expected[fits], of[fits]
    return count, polynomial


def _wrapped(ticks: NDArray[Any]) -> NDArray[Any]:
    """The shortest way from a time of 24 bits to another."""
    return (ticks + (1 << 23) & 0xFFFFFF) - (1 << 23)


def encode(recording: Recording) -> Iterator[tuple[int, bytes]]:
    """(time in ns, bytes) of a deck that sees the sweeps of the first device.

    The sweeps of a station under one time stamp are laid out as its rotor makes them, the
    last at that time. As in a deck, the first pulse of a passage has no polynomial and the
    second the offset. A pulse that is alone, as all are of a device with one photodiode,
    has both: a deck would not know it. Counts become whole steps, those of the other
    pulses of a passage quarters relative to it.

    Raises
    ------
    InputError
        There are no sweeps that a deck could see.
    """
    sweeps, usable = recording.sweeps, np.zeros(0, bool)
    if sweeps is not None:
        usable = (sweeps.device == 0) & np.isin(sweeps.sensor, range(SENSORS))
        usable &= np.isin(sweeps.channel, CHANNELS)
        usable &= (sweeps.count >= 0.5) & (sweeps.count <= lfsr.SEQUENCE_LENGTH - 1)
    if sweeps is None or not np.any(usable):
        raise InputError(
            "no sweeps that a Lighthouse deck could see",
            hint="give a session with sweeps of sensors 0 to 3 of its first device",
        )
    channel, named = sweeps.channel[usable].astype("i8"), sweeps.polynomial[usable]
    polynomial = np.where(named >> 1 == channel - 1, named, 2 * (channel - 1))
    columns: Iterator[Any] = (c[usable] for c in (sweeps.time_ns, sweeps.sensor, sweeps.count))
    passages = _as_sent(polynomial, *columns)
    syncs = range(passages[0][0], passages[-1][0] + SYNC_NS, SYNC_NS)
    return heapq.merge(((time, SYNC) for time in syncs), passages, key=itemgetter(0))


def _as_sent(
    polynomial: Index, time_ns: Index, sensor: NDArray[Any], count: NDArray[np.float64]
) -> list[tuple[int, bytes]]:
    """Frames by passage, with the time of the last pulse."""
    origin = int(time_ns.min())
    tick = (time_ns - origin) * 3 // 125
    _, moment = np.unique(tick * 16 + (polynomial >> 1), return_inverse=True)
    newest = np.zeros(len(count))
    np.maximum.at(newest, moment, count)
    tick -= np.rint(TICKS_PER_COUNT * (newest[moment] - count)).astype(np.int64)

    # Pulses of a passage are as far apart as their counts.
    order = np.lexsort((tick, polynomial))
    steps = TICKS_PER_COUNT * count[order]
    apart = (np.diff(tick[order]) > GAP) | (np.abs(np.diff(steps)) > GAP)
    starts = np.r_[True, apart | (np.diff(polynomial[order]) != 0)]
    first = np.flatnonzero(starts)[np.cumsum(starts) - 1]
    tick[order] = tick[order][first] + np.rint(steps - steps[first]).astype(np.int64)
    passage = np.empty_like(order)
    passage[order] = first

    order = np.argsort(tick, kind="stable")
    tick, whole = tick[order], np.rint(count[order]).astype(np.int64)
    sensor, polynomial, gaps = sensor[order], polynomial[order], np.diff(tick)
    follows = np.r_[False, (np.diff(passage[order]) == 0) & (gaps <= IDENTIFIED)]
    heads = np.r_[follows[1:], False] & ~follows
    offers = ~heads & ~(follows & np.r_[False, follows[:-1]])
    rows = np.zeros((len(tick), FRAME), np.uint8)
    rows[:, 0] = np.where(heads, 0xFC, polynomial << 2) | sensor
    rows[:, 1], rows[:, 2] = 0x2C, 0x01  # 12.5 us, as at a few metres
    words = lfsr.state_at(whole, polynomial)
    for k, value in ((3, np.where(offers, whole, 0)), (6, words), (9, tick)):
        rows[:, k : k + 3] = value[:, None] >> (0, 8, 16) & 0xFF
    cuts = np.flatnonzero(gaps > GAP) + 1
    times = origin + tick[np.r_[cuts, len(tick)] - 1] * 125 // 3
    parts = np.split(rows, cuts)
    return [(time, part.tobytes()) for time, part in zip(times.tolist(), parts, strict=True)]
