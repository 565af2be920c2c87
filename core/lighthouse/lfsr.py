"""Bit sequences (LFSR) of Lighthouse V2: bits sent at each rotor angle, and their inverse.

Each of the 32 polynomials drives a 17-bit shift register at 6 MHz that starts from state 1 at the
rotor's zero. While a light plane crosses a photodiode, the photodiode receives 17 or more bits of
that sequence, and their index in the sequence is the rotor angle. A register that has passed
through all of its states would repeat after :data:`SEQUENCE_LENGTH` steps. A rotation is shorter
(at most 119,875 steps), so that an index occurs only once per rotation.

Polynomials: Bitcraze lighthouse-fpga ``utils.scala``; identical in libsurvive ``lfsr_lh2.c`` and
DotBots lh2_on_rp2040. Indices count from state 1 and equal the sync offsets of the Lighthouse
deck and the counts of PyDotBot. The tests compare them with published examples of both.
(PyDotBot's checkpoint k is the state at 2048 k - 1. Its subtraction of 1 compensates for that.)
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

REGISTER_BITS = 17
"""Width of the shift register."""

SEQUENCE_LENGTH = (1 << REGISTER_BITS) - 1
"""Steps after which a sequence repeats. All 32 polynomials pass through every state but 0."""

NO_INDEX = -1
"""Index of state 0, which occurs in no sequence."""

TAPS: NDArray[np.int64] = np.array(
    [
        0x1D258, 0x17E04, 0x1FF6B, 0x13F67, 0x1B9EE, 0x198D1, 0x178C7, 0x18A55,
        0x15777, 0x1D911, 0x15769, 0x1991F, 0x12BD0, 0x1CF73, 0x1365D, 0x197F5,
        0x194A0, 0x1B279, 0x13A34, 0x1AE41, 0x180D4, 0x17891, 0x12E64, 0x17C72,
        0x19C6D, 0x13F32, 0x1AE14, 0x14E76, 0x13C97, 0x130CB, 0x13750, 0x1CB8D,
    ]
)  # fmt: skip
"""Feedback of polynomials 0 to 31. A step shifts the state left. The new lowest bit is the parity
of the old state's bits under this mask."""

_LOW_BITS = 9
"""Lower bits of a state. A linear map of 17 bits is stored as two small tables: one for the lower
9 bits and one for the upper 8."""

_POLYNOMIAL_ROWS = np.arange(len(TAPS))[:, None]


def indices(states: ArrayLike, polynomial: ArrayLike) -> NDArray[np.int64]:
    """Return the index of states in the sequence, as steps from state 1.

    Parameters
    ----------
    states : array_like of int
        17 successive bits, the first received in the highest position; any shape.
    polynomial : array_like of int
        0 to 31, of a shape that broadcasts with ``states``.

    Returns
    -------
    ndarray
        0 to 131070; :data:`NO_INDEX` for state 0.
    """
    index = tables()[1][np.asarray(polynomial), np.asarray(states)]
    return np.asarray(index, np.int64)


def state_at(index: ArrayLike, polynomial: ArrayLike) -> NDArray[np.int64]:
    """Return the 17 bits that start at ``index``; inverse of :func:`indices`.

    ``index`` is any integer, because the sequence is cyclic. It broadcasts with ``polynomial``.
    """
    state = tables()[0][np.asarray(polynomial), np.mod(index, SEQUENCE_LENGTH)]
    return np.asarray(state, np.int64)


def window_index(bits: ArrayLike, offset: ArrayLike, polynomial: ArrayLike) -> NDArray[np.int64]:
    """Return the index of the first bit of 64-bit windows whose first bits are unreliable.

    Parameters
    ----------
    bits : (n,) array_like of uint64
        The first bit in the highest position, as in ``locatk.LighthouseCapture``.
    offset : (n,) array_like of int
        Number of bits to skip, 0 to 47. The 17 bits after them are looked up.
    polynomial : (n,) array_like of int
        0 to 31.

    Returns
    -------
    (n,) ndarray
        0 to 131070; :data:`NO_INDEX` if the 17 bits are all zero.
    """
    skipped_bits = np.asarray(offset, np.int64)
    shift = (64 - REGISTER_BITS - skipped_bits).astype(np.uint64)
    state = np.asarray(bits, np.uint64) >> shift & np.uint64(SEQUENCE_LENGTH)
    index = indices(state.astype(np.int64), polynomial)
    return np.where(index == NO_INDEX, NO_INDEX, (index - skipped_bits) % SEQUENCE_LENGTH)


def bits_at(index: ArrayLike, polynomial: ArrayLike, length: int = 64) -> NDArray[np.uint64]:
    """Return ``length`` bits (1 to 64) that start at ``index``, the first in the highest position.

    For a length of 64, bits and order are those of ``locatk.LighthouseCapture``.
    """
    start = np.asarray(index)
    bits = state_at(start, polynomial).astype(np.uint64)
    for step in (REGISTER_BITS, 2 * REGISTER_BITS):
        bits = bits << np.uint64(REGISTER_BITS) | state_at(start + step, polynomial).astype(
            np.uint64
        )
    rest_bits = 64 - 3 * REGISTER_BITS
    last = state_at(start + 3 * REGISTER_BITS, polynomial).astype(np.uint64)
    bits = bits << np.uint64(rest_bits) | last >> np.uint64(REGISTER_BITS - rest_bits)
    return bits >> np.uint64(64 - length)


@cache
def tables() -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return the states by index (32, 131071) and the indices by state (32, 131072).

    The tables are built once per process. A step is linear over GF(2), and so is a jump of many
    steps. Jumping all known states ahead by their number yields as many new states. 17 doublings
    yield the whole sequence.
    """
    states = np.empty((len(TAPS), SEQUENCE_LENGTH), np.int32)
    states[:, 0] = 1
    basis = 1 << np.arange(REGISTER_BITS)
    # Images of the single bits under a jump; at first a jump of one step.
    images = (basis << 1 & SEQUENCE_LENGTH | np.bitwise_count(basis & TAPS[:, None]) & 1).astype(
        np.int32
    )
    count = 1
    while count < SEQUENCE_LENGTH:
        low, high = (
            _linear_map_table(images[:, :_LOW_BITS]),
            _linear_map_table(images[:, _LOW_BITS:]),
        )
        new = min(count, SEQUENCE_LENGTH - count)
        states[:, count : count + new] = _jump(states[:, :new], low, high)
        images = _jump(images, low, high)
        count += new
    index = np.full((len(TAPS), SEQUENCE_LENGTH + 1), NO_INDEX, np.int32)
    index[_POLYNOMIAL_ROWS, states] = np.arange(SEQUENCE_LENGTH, dtype=np.int32)
    return states, index


def _linear_map_table(images: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return the images (p, 2^k) of all k-bit words from the images (p, k) of single bits."""
    table = np.zeros((len(images), 1), np.int32)
    for column in images.T:
        table = np.concatenate([table, table ^ column[:, None]], axis=1)
    return table


def _jump(
    states: NDArray[np.int32], low: NDArray[np.int32], high: NDArray[np.int32]
) -> NDArray[np.int32]:
    """Return the states (p, n) after a jump, given by the tables of lower and upper bits."""
    jumped: NDArray[np.int32] = (
        low[_POLYNOMIAL_ROWS, states & ((1 << _LOW_BITS) - 1)]
        ^ high[_POLYNOMIAL_ROWS, states >> _LOW_BITS]
    )
    return jumped
