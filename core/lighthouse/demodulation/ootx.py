"""Decode the factory data of a base station from its slow bits (OOTX).

OOTX ("omnidirectional optical transmitter") is one slow bit per rotation. A frame takes nine
seconds and is repeated without end.

===========  =====================================================================
bits         content
===========  =====================================================================
18           sync: 17 zeros and a one, a pattern that occurs only here
25 x 17      words of 16 bits, each followed by a stuffing bit, a one: the length of
             the payload in bytes, 43; the payload and a byte of padding; CRC-32
             (that of zlib) of the payload. Numbers are little-endian. The highest
             bit of a byte is sent first
===========  =====================================================================

The payload of 43 bytes, little-endian and packed:

==============================  ============================================================
type                            content
==============================  ============================================================
u16                             protocol version (6 bits), firmware version (10 bits)
u32                             serial number
f16 x 4                         phase of planes 0 and 1, tilt of planes 0 and 1
u8, u8                          unlock count, hardware version
f16 x 2                         curve of planes 0 and 1
i8 x 3                          acceleration x, y, z
f16 x 4                         gibphase of planes 0 and 1, gibmag of planes 0 and 1
u8, u8                          channel - 1 (7 bits), faults
f16 x 4                         ogeephase of planes 0 and 1, ogeemag of planes 0 and 1
u16                             nonce
==============================  ============================================================

All frames have the same length, so 67 of the 443 bits are identical in each, and the checksum is
linear in the others. A frame is therefore found by its 67 fixed bits at any rotation, independent
of the bits before it, and missing bits are solved for.

Source: Bitcraze crazyflie-firmware ``ootx_decoder.c``, libsurvive ``ootx_decoder.c`` (MIT). The
tests compare the result with a recording of four stations.
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

MISSING_BIT = -1
"""Value of a slow bit that was not received."""

PAYLOAD_BYTES = 43
"""Length of the payload of Lighthouse V2."""

SYNC_BITS = 18
"""Length of the sync pattern."""

WORD_BITS = 16
"""Length of a word, without its stuffing bit."""

FRAME_BITS = SYNC_BITS + (1 + (PAYLOAD_BYTES + 1) // 2 + 2) * (WORD_BITS + 1)
"""Length of a frame, with its sync pattern."""

FIXED_BITS = 67
"""Number of bits that are equal in all frames."""

MIN_FIXED_BITS = 36
"""At least this number of the fixed bits must be received, and all of those must be right: as many
as the sync, the length and its stuffing bit have. Noise passes with a probability of 2^-36."""

MAX_SOLVED_BITS = 8
"""Largest number of missing bits for which all values are tried. 24 of the checksum's 32 bits
remain for verification."""

VOTING_FRAMES_PER_SIDE = 8
"""Number of frames before and after a frame that vote on its missing bits: two minutes."""

FRAMES_PER_BLOCK = 4096
"""Number of frames that are completed together, which bounds the memory: ten hours."""

_PAYLOAD = struct.Struct("<HIeeeeBBeebbbeeeeBBeeeeH")


@dataclass(frozen=True)
class OotxFrame:
    """Received frame of factory data.

    Attributes
    ----------
    start_rotation : int
        Rotation of its first bit after the sync.
    payload : bytes
        Its 43 bytes; bits that could not be determined are 0.
    is_valid : bool
        True if all bits are known and the checksum is right. Do not use the payload otherwise.
    missing_bits : int
        Number of its 443 bits that were not received, or that other frames outvoted.
    """

    start_rotation: int
    payload: bytes
    is_valid: bool
    missing_bits: int = 0


@dataclass(frozen=True)
class FactoryData:
    """Factory data that a base station sends about itself.

    Attributes
    ----------
    id : int
        Serial number.
    channel : int
        1 to 16, as set when the frame was sent.
    calibration : Calibration
        Of its two light planes, measured by the factory.
    firmware, protocol, hardware : int
        Versions.
    unlock_count : int
        Number of times its rotor lost synchronization.
    acceleration : tuple of 3 int
        Direction against gravity in the axes x right, y up, z back: signed bytes, scaled so that
        the largest is 127 (see :func:`locatk.core.lighthouse.scene.gravity.up_from_acceleration`).
    faults : int
        0 if there are none.
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


# ---- bits to frames


def decode_frames(bits: ArrayLike) -> list[OotxFrame]:
    """Find the frames of factory data among the slow bits of one station.

    Parameters
    ----------
    bits : (n,) array_like of int
        One per rotation: 0, 1, or -1 if it was not received.

    Returns
    -------
    list of OotxFrame
        Ascending in ``start_rotation``. Invalid ones were received to their end and are damaged.
        A frame that is cut off by the end of the recording is included only if earlier frames
        complete it and there is no valid complete frame.

    Raises
    ------
    InputError
        ``bits`` is not a 1D array of -1, 0 and 1.

    Notes
    -----
    A missing bit is filled in with the value that it has in all frames, else by a majority vote of
    the neighbouring frames. For up to 8 bits that are still missing, all values are tried, and
    exactly one must yield the right checksum. If no frame is valid, one is composed of the
    majority of all frames.
    """
    received = np.asarray(bits)
    if received.ndim != 1 or not np.all(np.isin(received, (MISSING_BIT, 0, 1))):
        raise InputError("slow bits must be a row of 0, 1 and -1 (not received)")
    padded = np.concatenate([received, np.full(FRAME_BITS, MISSING_BIT)]).astype(np.int8)
    start = _find_starts(padded)
    frames: list[OotxFrame] = []
    for k in range(0, len(start), FRAMES_PER_BLOCK):
        frames += _decode_block(padded, start[k : k + FRAMES_PER_BLOCK])
    last_start = len(received) - FRAME_BITS + SYNC_BITS
    has_complete = any(f.is_valid and f.start_rotation <= last_start for f in frames)
    frames = [
        f for f in frames if f.start_rotation <= last_start or (f.is_valid and not has_complete)
    ]
    # An invalid frame that overlaps a valid one was a false start.
    starts = np.array([f.start_rotation for f in frames], np.int64)
    valid_starts = np.array([f.start_rotation for f in frames if f.is_valid], np.int64)
    overlaps = _overlaps_valid(starts, valid_starts)
    return [f for f, o in zip(frames, overlaps.tolist(), strict=True) if f.is_valid or not o]


def _find_starts(bits: Bits) -> NDArray[np.int64]:
    """Return the rotations at which no received bit contradicts the fixed bits of a frame.

    At least :data:`MIN_FIXED_BITS` must agree.
    """
    n = len(bits) - FRAME_BITS
    agreeing, is_possible = np.zeros(n, np.int16), np.ones(n, bool)
    for position, bit in zip(_FIXED_POSITIONS, _FIXED_BITS, strict=True):
        received = bits[position : position + n]
        agreeing += received == bit
        is_possible &= received != 1 - bit
    return np.flatnonzero(is_possible & (agreeing >= MIN_FIXED_BITS))


def _decode_block(bits: Bits, start: NDArray[np.int64]) -> list[OotxFrame]:
    """Decode the frames that begin at rotations ``start``, and fill in missing bits."""
    window = bits[start[:, None] + np.arange(FRAME_BITS)]
    missing_bits = np.count_nonzero(window == MISSING_BIT, axis=1)
    window[:, _FIXED_POSITIONS] = _FIXED_BITS
    completed, is_valid = _complete(window)
    if not np.any(is_valid):
        majority = _majority(window)
        solved, is_solved = _complete(majority)
        outvoted = np.count_nonzero((majority != window) & (window != MISSING_BIT), axis=1)
        # Only the composed frame with the fewest outvoted bits is used.
        for k in np.flatnonzero(is_solved)[np.argsort(outvoted[is_solved], kind="stable")][:1]:
            completed[k], is_valid[k] = solved[k], True
            missing_bits[k] += outvoted[k]
    return [
        OotxFrame(int(first) + SYNC_BITS, _payload(frame), bool(valid), int(missing))
        for first, frame, valid, missing in zip(
            start, completed, is_valid, missing_bits, strict=True
        )
    ]


def _overlaps_valid(
    starts: NDArray[np.int64], valid_starts: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """Return a mask of ``starts`` less than a frame from one of ``valid_starts`` (ascending)."""
    if not len(valid_starts):
        return np.zeros(len(starts), bool)
    after = np.searchsorted(valid_starts, starts)
    previous = valid_starts[np.maximum(after - 1, 0)]
    following = valid_starts[np.minimum(after, len(valid_starts) - 1)]
    distance = np.minimum(np.abs(starts - previous), np.abs(following - starts))
    return np.asarray(distance < FRAME_BITS)


def _complete(window: Bits) -> tuple[Bits, NDArray[np.bool_]]:
    """Fill in missing bits of frames (m, 443); return them and a mask of right checksums."""
    votes = _votes(window)
    voted = np.where((window == MISSING_BIT) & (votes != 0), votes > 0, window).astype(np.int8)
    result, is_valid = voted.copy(), np.zeros(len(window), bool)
    # A wrong vote can prevent a solution that the frame's own bits allow.
    for attempt in (voted, window):
        for k in np.flatnonzero(~is_valid):
            solved = _solve_missing(attempt[k])
            if solved is not None:
                result[k], is_valid[k] = solved, True
    return result, is_valid


def _majority(window: Bits) -> Bits:
    """Return frames (m, 443) with the majority value of each bit; missing if it is a tie."""
    votes = _votes(window)
    return np.where(votes == 0, MISSING_BIT, votes > 0).astype(np.int8)


def _votes(window: Bits) -> NDArray[np.int32]:
    """Return ones minus zeros (m, 443) of each bit in a frame and its neighbours."""
    ballots = np.where(window == MISSING_BIT, 0, 2 * window.astype(np.int32) - 1)
    total = np.concatenate([np.zeros((1, FRAME_BITS), np.int32), np.cumsum(ballots, axis=0)])
    frame = np.arange(len(window))
    votes = total[np.minimum(frame + VOTING_FRAMES_PER_SIDE + 1, len(window))]
    votes -= total[np.maximum(frame - VOTING_FRAMES_PER_SIDE, 0)]
    return np.asarray(votes, np.int32)


def _solve_missing(frame: Bits) -> Bits | None:
    """Return the frame with its missing bits solved for; None without a unique solution."""
    missing = np.flatnonzero(frame == MISSING_BIT)
    if len(missing) > MAX_SOLVED_BITS:
        return None
    syndrome = _SYNDROME_OF_ZERO ^ np.bitwise_xor.reduce(_SYNDROME[frame == 1], initial=0)
    candidates = np.zeros(1, np.int64)
    for position in missing:
        candidates = np.concatenate([candidates, candidates ^ _SYNDROME[position]])
    solutions = np.flatnonzero(candidates == syndrome)
    if len(solutions) != 1:
        return None
    solved = frame.copy()
    solved[missing] = solutions[0] >> np.arange(len(missing)) & 1
    return solved


def encode_frame(payload: bytes) -> Bits:
    """Return the 443 slow bits of a frame, sync first, that a station repeats.

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
    """Return the 43 bytes in a frame of 443 bits; missing bits become 0."""
    words = frame[SYNC_BITS:].reshape(-1, WORD_BITS + 1)[1:, :WORD_BITS]
    return np.packbits(words.ravel() == 1).tobytes()[:PAYLOAD_BYTES]


def _check_length(payload: bytes) -> None:
    """Raise InputError if a payload does not have the length of Lighthouse V2."""
    if len(payload) != PAYLOAD_BYTES:
        raise InputError(
            f"factory data have {len(payload)} bytes instead of {PAYLOAD_BYTES} (Lighthouse V2)"
        )


def _fixed_bits() -> tuple[NDArray[np.int64], Bits]:
    """Return positions and values of the bits that are the same in all frames."""
    word = np.arange(SYNC_BITS, FRAME_BITS, WORD_BITS + 1)
    padding = word[-3] + WORD_BITS // 2 + np.arange(WORD_BITS // 2)
    positions = np.concatenate(
        [np.arange(SYNC_BITS), word[0] + np.arange(WORD_BITS), word + WORD_BITS, padding]
    )
    positions.sort()
    return positions, encode_frame(bytes(PAYLOAD_BYTES))[positions]


def _syndromes() -> NDArray[np.int64]:
    """Return the change (443,) of (CRC of the payload) xor (received CRC) by each bit."""
    syndrome = np.zeros(FRAME_BITS, np.int64)
    word = np.arange(SYNC_BITS, FRAME_BITS, WORD_BITS + 1)
    content = (word[1:, None] + np.arange(WORD_BITS)).ravel()
    for number in range(8 * PAYLOAD_BYTES):
        payload = bytearray(PAYLOAD_BYTES)
        payload[number // 8] = 0x80 >> number % 8
        syndrome[content[number]] = zlib.crc32(payload) ^ _SYNDROME_OF_ZERO
    for number, position in enumerate(content[-32:]):
        syndrome[position] = 1 << (8 * (number // 8) + 7 - number % 8)
    return syndrome


_SYNDROME_OF_ZERO = zlib.crc32(bytes(PAYLOAD_BYTES))
_SYNDROME = _syndromes()
_FIXED_POSITIONS, _FIXED_BITS = _fixed_bits()


# ---- frames to factory data


def decode_factory_data(payload: bytes) -> FactoryData:
    """Decode the payload of a valid frame.

    Raises
    ------
    InputError
        It is not 43 bytes long, a parameter is not finite, or the channel is not 1 to 16.
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
        raise InputError(f"a parameter in the factory data of station {serial:08x} is not finite")
    channel = (mode & 0x7F) + 1
    if channel not in CHANNELS:
        raise InputError(
            f"channel {channel} in the factory data of station {serial:08x} does not exist"
        )
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
