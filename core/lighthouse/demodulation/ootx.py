"""Factory data of a base station, as its slow bits tell it (OOTX, "omnidirectional optical
transmitter"): one bit a rotation, one frame in nine seconds, the same for ever.

===========  =====================================================================
bits         content
===========  =====================================================================
18           sync: 17 zeros and a one, which nothing else in a frame can be
25 x 17      words of 16 bits, each with a stuffing bit, a one, after it:
             the length of the payload in bytes, 43; the payload and a byte of
             padding; CRC-32 (zlib's) of the payload. Numbers are little-endian, a
             byte's highest bit comes first
===========  =====================================================================

As all frames are of one length, what a frame is made of is known beforehand: 67 of its 443
bits are the same in each, and the checksum is linear over the others. So a frame is found
by its 67 bits at any rotation, whatever was found before, and missing bits are solved for.

Source: Bitcraze crazyflie-firmware ``ootx_decoder.c``, libsurvive ``ootx_decoder.c`` (MIT);
facts/lighthouse.md 2.6. Held against a recording of four stations in the tests.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from locatk.core.errors import InputError
from locatk.core.lighthouse.calibration import (
    CURVE,
    GIBMAG,
    GIBPHASE,
    OGEEMAG,
    OGEEPHASE,
    PHASE,
    TILT,
    Calibration,
)
from locatk.core.lighthouse.channels import CHANNELS

Bits = NDArray[np.int8]

UNKNOWN = -1
"""A slow bit that was not received."""

PAYLOAD_BYTES = 43
SYNC_BITS = 18
WORD_BITS = 16
FRAME_BITS = SYNC_BITS + (1 + (PAYLOAD_BYTES + 1) // 2 + 2) * (WORD_BITS + 1)

LEAST_FIXED = 36
"""Of the 67 bits that all frames share so many must be received, and all of those right:
as many as the sync, the length and its stuffing have. Chance makes one such in 2^36."""

MOST_SOLVED = 8
"""Missing bits for which all values are tried: of the checksum's 32 bits 24 still check."""

NEIGHBOURS = 8
"""Frames before and after one that vote on its missing bits: two minutes of a station."""

AT_ONCE = 4096
"""Frames that are completed at a time, so that memory stays bounded: ten hours of a station."""

_PAYLOAD = struct.Struct("<HIeeeeBBeebbbeeeeBBeeeeH")


@dataclass(frozen=True)
class OotxFrame:
    """A frame that was received.

    Attributes
    ----------
    start : int
        Rotation of its first bit after the sync.
    payload : bytes
        Its 43 bytes; bits that nothing tells are 0.
    right : bool
        Whether all bits are known and the checksum is right. Do not use it otherwise.
    missed : int
        Bits of it, of 443, that were not received, or that other frames overruled.
    """

    start: int
    payload: bytes
    right: bool
    missed: int = 0


@dataclass(frozen=True)
class FactoryData:
    """What a base station tells of itself.

    Attributes
    ----------
    id : int
        Serial number.
    channel : int
        1 to 16, as it was set when the frame was sent.
    calibration : Calibration
        Of its two light planes, measured by the factory.
    firmware, protocol, hardware : int
        Versions.
    unlock_count : int
        How often its rotor fell out of step.
    acceleration : tuple of 3 int
        How it hangs: signed bytes in no stated unit, of which the second is 127 where it
        stands upright.
    faults : int
        0 where all is well.
    nonce : int
    """

    id: int
    channel: int
    calibration: Calibration
    firmware: int
    protocol: int
    hardware: int
    unlock_count: int
    acceleration: tuple[int, int, int]
    faults: int
    nonce: int


def frames(bits: ArrayLike) -> list[OotxFrame]:
    """Frames of factory data among the slow bits of one station.

    Parameters
    ----------
    bits : (n,) array_like of int
        One a rotation: 0, 1, or -1 where it was missed.

    Returns
    -------
    list of OotxFrame
        Ascending in ``start``. Those that are not right were received to their end and
        damaged. A frame that the recording's end cuts off is only among them where frames
        before it tell the rest, and no frame is right without it.

    Raises
    ------
    InputError
        The bits are no row of -1, 0 and 1.

    Notes
    -----
    Missing bits are those that every frame has, else what most of the neighbouring frames
    say; of what is missing then, up to 8 bits, all values are tried and one must be right.
    Where no frame is right so, one is made of the bits that most of them have.
    """
    received = np.asarray(bits)
    if received.ndim != 1 or not np.all(np.isin(received, (UNKNOWN, 0, 1))):
        raise InputError("slow bits are a row of 0, 1 and -1 (not received)")
    padded = np.concatenate([received, np.full(FRAME_BITS, UNKNOWN)]).astype(np.int8)
    start = _starts(padded)
    found: list[OotxFrame] = []
    for first in range(0, len(start), AT_ONCE):
        found += _read(padded, start[first : first + AT_ONCE])
    end = len(received) - FRAME_BITS + SYNC_BITS
    whole = any(frame.right and frame.start <= end for frame in found)
    found = [f for f in found if f.start <= end or (f.right and not whole)]
    # What overlaps a right frame was a false start.
    right = np.array([frame.start for frame in found if frame.right], np.int64)
    near = _near(np.array([frame.start for frame in found], np.int64), right)
    return [f for f, false in zip(found, near.tolist(), strict=True) if f.right or not false]


def _starts(bits: Bits) -> NDArray[np.int64]:
    """Where no bit received contradicts what all frames share, and enough agree."""
    n = len(bits) - FRAME_BITS
    agree, fits = np.zeros(n, np.int16), np.ones(n, bool)
    for place, bit in zip(_FIXED, _FIXED_BITS, strict=True):
        part = bits[place : place + n]
        agree += part == bit
        fits &= part != 1 - bit
    return np.flatnonzero(fits & (agree >= LEAST_FIXED))


def _read(bits: Bits, start: NDArray[np.int64]) -> list[OotxFrame]:
    """The frames that begin at ``start``, with what can be told of their missing bits."""
    window = bits[start[:, None] + np.arange(FRAME_BITS)]
    missed = np.count_nonzero(window == UNKNOWN, axis=1)
    window[:, _FIXED] = _FIXED_BITS
    completed, right = _complete(window)
    if not np.any(right):
        agreed = _agreed(window)
        solved, good = _complete(agreed)
        overruled = np.count_nonzero((agreed != window) & (window != UNKNOWN), axis=1)
        for k in np.flatnonzero(good)[np.argsort(overruled[good], kind="stable")][:1]:
            completed[k], right[k] = solved[k], True
            missed[k] += overruled[k]
    return [
        OotxFrame(int(at) + SYNC_BITS, _payload(frame), bool(good), int(gone))
        for at, frame, good, gone in zip(start, completed, right, missed, strict=True)
    ]


def _near(starts: NDArray[np.int64], right: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which of ``starts`` are less than a frame from one of ``right`` (ascending)."""
    if not len(right):
        return np.zeros(len(starts), bool)
    after = np.searchsorted(right, starts)
    before, following = right[np.maximum(after - 1, 0)], right[np.minimum(after, len(right) - 1)]
    gap = np.minimum(np.abs(starts - before), np.abs(following - starts))
    return np.asarray(gap < FRAME_BITS)


def _complete(window: Bits) -> tuple[Bits, NDArray[np.bool_]]:
    """Frames (m, 443) with their missing bits found, and which have a right checksum."""
    votes = _votes(window)
    voted = np.where((window == UNKNOWN) & (votes != 0), votes > 0, window).astype(np.int8)
    result, right = voted.copy(), np.zeros(len(window), bool)
    # A vote that is wrong can hide what the frame's own bits tell.
    for attempt in (voted, window):
        for k in np.flatnonzero(~right):
            solved = _solve(attempt[k])
            if solved is not None:
                result[k], right[k] = solved, True
    return result, right


def _agreed(window: Bits) -> Bits:
    """Frames (m, 443) with the bits that most neighbours have; unknown where it is even."""
    votes = _votes(window)
    return np.where(votes == 0, UNKNOWN, votes > 0).astype(np.int8)


def _votes(window: Bits) -> NDArray[np.int32]:
    """How many more ones than zeros a frame and its neighbours have, for each bit."""
    ballots = np.where(window == UNKNOWN, 0, 2 * window.astype(np.int32) - 1)
    total = np.concatenate([np.zeros((1, FRAME_BITS), np.int32), np.cumsum(ballots, axis=0)])
    each = np.arange(len(window))
    votes = total[np.minimum(each + NEIGHBOURS + 1, len(window))]
    votes -= total[np.maximum(each - NEIGHBOURS, 0)]
    return np.asarray(votes, np.int32)


def _solve(frame: Bits) -> Bits | None:
    """The one right frame with these bits, if it is one and at most 8 are missing."""
    missing = np.flatnonzero(frame == UNKNOWN)
    if len(missing) > MOST_SOLVED:
        return None
    wrong = _SYNDROME_OF_ZERO ^ np.bitwise_xor.reduce(_SYNDROME[frame == 1], initial=0)
    choices = np.zeros(1, np.int64)
    for place in missing:
        choices = np.concatenate([choices, choices ^ _SYNDROME[place]])
    found = np.flatnonzero(choices == wrong)
    if len(found) != 1:
        return None
    solved = frame.copy()
    solved[missing] = found[0] >> np.arange(len(missing)) & 1
    return solved


def encode(payload: bytes) -> Bits:
    """The 443 slow bits of a frame, sync first, that a station repeats.

    Raises
    ------
    InputError
        ``payload`` is not 43 bytes long.
    """
    _check_length(payload)
    content = struct.pack("<H", PAYLOAD_BYTES) + payload + b"\0"
    content += struct.pack("<I", zlib.crc32(payload))
    words = np.unpackbits(np.frombuffer(content, np.uint8)).reshape(-1, WORD_BITS)
    stuffed = np.concatenate([words, np.ones((len(words), 1), np.uint8)], axis=1)
    return np.concatenate([[0] * (SYNC_BITS - 1), [1], stuffed.ravel()]).astype(np.int8)


def _payload(frame: Bits) -> bytes:
    """The 43 bytes that a frame of 443 bits carries; missing bits are 0."""
    words = frame[SYNC_BITS:].reshape(-1, WORD_BITS + 1)[1:, :WORD_BITS]
    return np.packbits(words.ravel() == 1).tobytes()[:PAYLOAD_BYTES]


def _check_length(payload: bytes) -> None:
    if len(payload) != PAYLOAD_BYTES:
        raise InputError(
            f"factory data has {len(payload)} bytes, where Lighthouse V2 has {PAYLOAD_BYTES}"
        )


def _shared() -> tuple[NDArray[np.int64], Bits]:
    """Places and values of the bits that are the same in all frames."""
    word = np.arange(SYNC_BITS, FRAME_BITS, WORD_BITS + 1)
    padding = word[-3] + WORD_BITS // 2 + np.arange(WORD_BITS // 2)
    places = np.concatenate(
        [np.arange(SYNC_BITS), word[0] + np.arange(WORD_BITS), word + WORD_BITS, padding]
    )
    places.sort()
    return places, encode(bytes(PAYLOAD_BYTES))[places]


def _syndromes() -> NDArray[np.int64]:
    """(443,): by what each bit changes (checksum of the payload) xor (checksum sent)."""
    syndrome = np.zeros(FRAME_BITS, np.int64)
    word = np.arange(SYNC_BITS, FRAME_BITS, WORD_BITS + 1)
    content = (word[1:, None] + np.arange(WORD_BITS)).ravel()
    for number in range(8 * PAYLOAD_BYTES):
        one = bytearray(PAYLOAD_BYTES)
        one[number // 8] = 0x80 >> number % 8
        syndrome[content[number]] = zlib.crc32(one) ^ _SYNDROME_OF_ZERO
    for number, place in enumerate(content[-32:]):
        syndrome[place] = 1 << (8 * (number // 8) + 7 - number % 8)
    return syndrome


_SYNDROME_OF_ZERO = zlib.crc32(bytes(PAYLOAD_BYTES))
_SYNDROME = _syndromes()
_FIXED, _FIXED_BITS = _shared()


def factory_data(payload: bytes) -> FactoryData:
    """What the payload of a right frame says.

    Raises
    ------
    InputError
        It is not 43 bytes long, a parameter is no finite number, or there is no such
        channel.
    """
    _check_length(payload)
    values = _PAYLOAD.unpack(payload)
    version, serial = values[:2]
    sweeps = np.zeros((2, 7))
    sweeps[:, PHASE], sweeps[:, TILT] = values[2:4], values[4:6]
    unlock_count, hardware = values[6:8]
    sweeps[:, CURVE] = values[8:10]
    sweeps[:, GIBPHASE], sweeps[:, GIBMAG] = values[13:15], values[15:17]
    mode, faults = values[17:19]
    sweeps[:, OGEEPHASE], sweeps[:, OGEEMAG] = values[19:21], values[21:23]
    if not np.all(np.isfinite(sweeps)):
        raise InputError(f"factory data of station {serial:08x} has a parameter that is no number")
    channel = (mode & 0x7F) + 1
    if channel not in CHANNELS:
        raise InputError(f"factory data of station {serial:08x} is of no channel ({channel})")
    return FactoryData(
        serial,
        channel,
        Calibration(sweeps, "factory"),
        firmware=version >> 6,
        protocol=version & 0x3F,
        hardware=hardware,
        unlock_count=unlock_count,
        acceleration=values[10:13],
        faults=faults,
        nonce=values[23],
    )
