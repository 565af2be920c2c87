"""The bit sequences of Lighthouse V2: which bits a station sends at which turn of its rotor.

Each of the 32 polynomials drives a 17-bit shift register at 6 MHz, from state 1 at the
rotor's zero. The bits that a photodiode sees as the light passes are 17 bits or more of
that sequence; where they stand in it is the rotor's angle. A register that has run
through all of its states would start again after :data:`LENGTH` steps, later than the
rotor does (at most 119,875), so that no index comes twice in a turn.

Polynomials: Bitcraze lighthouse-fpga ``utils.scala``, the same in libsurvive
``lfsr_lh2.c`` and DotBots lh2_on_rp2040. An index counted here from state 1 equals the
sync offsets of the Lighthouse deck and the counts of PyDotBot: the tests hold it against
the published examples of both. (PyDotBot's checkpoint k is the state at 2048 k - 1, which
its subtraction of 1 undoes.)
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

BITS = 17
"""Of the shift register."""

LENGTH = (1 << BITS) - 1
"""Steps after which a sequence repeats: all 32 pass through every state but 0."""

NOWHERE = -1
"""Index of state 0, which no sequence has."""

TAPS: NDArray[np.int64] = np.array(
    [
        0x1D258, 0x17E04, 0x1FF6B, 0x13F67, 0x1B9EE, 0x198D1, 0x178C7, 0x18A55,
        0x15777, 0x1D911, 0x15769, 0x1991F, 0x12BD0, 0x1CF73, 0x1365D, 0x197F5,
        0x194A0, 0x1B279, 0x13A34, 0x1AE41, 0x180D4, 0x17891, 0x12E64, 0x17C72,
        0x19C6D, 0x13F32, 0x1AE14, 0x14E76, 0x13C97, 0x130CB, 0x13750, 0x1CB8D,
    ]
)  # fmt: skip
"""Feedback of polynomials 0 to 31: a step shifts the state left, and the new lowest bit is
the parity of the old state's bits under this mask."""

_LOW = 9
"""A linear map of 17 bits is two small tables: of the lower 9 and of the upper 8."""

_EACH = np.arange(len(TAPS))[:, None]


def indices(states: ArrayLike, polynomial: ArrayLike) -> NDArray[np.int64]:
    """Where states stand in the sequence, as steps from state 1.

    Parameters
    ----------
    states : array_like of int
        17 successive bits, first received in the highest; any shape.
    polynomial : array_like of int
        0 to 31, of a shape that goes with ``states``.

    Returns
    -------
    ndarray
        0 to 131070; :data:`NOWHERE` for state 0.
    """
    index = tables()[1][np.asarray(polynomial), np.asarray(states)]
    return np.asarray(index, np.int64)


def state_at(index: ArrayLike, polynomial: ArrayLike) -> NDArray[np.int64]:
    """The 17 bits that start at ``index`` (any integer, the sequence being cyclic);
    inverse of :func:`indices`."""
    state = tables()[0][np.asarray(polynomial), np.mod(index, LENGTH)]
    return np.asarray(state, np.int64)


def window_index(bits: ArrayLike, offset: ArrayLike, polynomial: ArrayLike) -> NDArray[np.int64]:
    """Index of the first bit of windows of 64, of which the first bits are not trusted.

    Parameters
    ----------
    bits : (n,) array_like of uint64
        The first bit in the highest place, as in ``locatk.LighthouseCapture``.
    offset : (n,) array_like of int
        Bits that are passed over, 0 to 47: the 17 after them are looked up.
    polynomial : (n,) array_like of int
        0 to 31.

    Returns
    -------
    (n,) ndarray
        0 to 131070; :data:`NOWHERE` where the 17 bits are all zero.
    """
    passed = np.asarray(offset, np.int64)
    shift = (64 - BITS - passed).astype(np.uint64)
    state = np.asarray(bits, np.uint64) >> shift & np.uint64(LENGTH)
    index = indices(state.astype(np.int64), polynomial)
    return np.where(index == NOWHERE, NOWHERE, (index - passed) % LENGTH)


def bits_at(index: ArrayLike, polynomial: ArrayLike, length: int = 64) -> NDArray[np.uint64]:
    """The ``length`` bits (1 to 64) that start at ``index``, the first in the highest place.

    With 64 of them, bits and order are those of ``locatk.LighthouseCapture``.
    """
    start = np.asarray(index)
    bits = state_at(start, polynomial).astype(np.uint64)
    for step in (BITS, 2 * BITS):
        bits = bits << np.uint64(BITS) | state_at(start + step, polynomial).astype(np.uint64)
    rest = 64 - 3 * BITS
    last = state_at(start + 3 * BITS, polynomial).astype(np.uint64)
    bits = bits << np.uint64(rest) | last >> np.uint64(BITS - rest)
    return bits >> np.uint64(64 - length)


@cache
def tables() -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """(32, 131071) states by index, and (32, 131072) indices by state: made once a process, in
    a fifth of a second.

    A step is linear over GF(2), and so is a jump of many. The states known so far, jumped
    ahead by their number, are the next ones: 17 doublings give them all.
    """
    states = np.empty((len(TAPS), LENGTH), np.int32)
    states[:, 0] = 1
    basis = 1 << np.arange(BITS)
    # What a jump makes of each single bit; first a jump of one step.
    images = (basis << 1 & LENGTH | np.bitwise_count(basis & TAPS[:, None]) & 1).astype(np.int32)
    known = 1
    while known < LENGTH:
        low, high = _spans(images[:, :_LOW]), _spans(images[:, _LOW:])
        new = min(known, LENGTH - known)
        states[:, known : known + new] = _jump(states[:, :new], low, high)
        images = _jump(images, low, high)
        known += new
    index = np.full((len(TAPS), LENGTH + 1), NOWHERE, np.int32)
    index[_EACH, states] = np.arange(LENGTH, dtype=np.int32)
    return states, index


def _spans(images: NDArray[np.int32]) -> NDArray[np.int32]:
    """(p, 2^k): what linear maps make of any k bits, from (p, k) images of each."""
    table = np.zeros((len(images), 1), np.int32)
    for column in images.T:
        table = np.concatenate([table, table ^ column[:, None]], axis=1)
    return table


def _jump(
    states: NDArray[np.int32], low: NDArray[np.int32], high: NDArray[np.int32]
) -> NDArray[np.int32]:
    """States (p, n) some steps later, by the tables of their lower and upper bits."""
    ahead: NDArray[np.int32] = low[_EACH, states & ((1 << _LOW) - 1)] ^ high[_EACH, states >> _LOW]
    return ahead
