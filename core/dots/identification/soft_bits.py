"""From dots on a lattice to soft bits: what each dot says, and how sure it is.

A bit is one where the dot lies beyond the diagonal through its place (papers/dots.txt
Fig. 6). Its logarithm of likelihoods, one over zero, follows from two Gaussians about where
symbols stand, as wide as the scatter of the frame's own dots, and from a share of dots that
lie anywhere (instead of the paper's polynomial, eq. 9).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.detection import lattice as grid
from locatk.core.dots.detection.lattice import Lattices
from locatk.core.dots.sheet import OFFSET
from locatk.core.kernels import kernels

WIDEST = 40
"""Columns and rows about the middle of a frame that are decoded."""

OFTEN = 0.018
"""Likelihood of a bit that the dot's position all but excludes."""

SHARPEST = 0.03
"""Least standard deviation of a dot that is believed, in pitches; the largest is twice it."""


def half_width(lattices: Lattices) -> int:
    """Half the width of the window in which all frames' dots lie."""
    places = np.abs(lattices.place[lattices.valid & lattices.found[:, None]])
    reach = int(places.max(initial=4)) + 1 if places.size else 5
    return min(reach, WIDEST // 2)


def soft_bits(lattices: Lattices, half: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Column and row bits (n, 2 half, 2 half) as the decoder takes them, 0 without a dot.

    Where two dots claim a place, the one closer to where symbols stand is taken.
    """
    n, m = lattices.valid.shape
    sigma = np.clip(1.5 * lattices.sigma, SHARPEST, 2 * SHARPEST)
    if kernels is None:
        return soft_bits_numpy(lattices, half, sigma)
    x_bits = np.empty((n, 2 * half, 2 * half), np.float32)
    y_bits = np.empty_like(x_bits)
    kernels.soft_bits(
        *(lattices.uv, lattices.place, np.ascontiguousarray(lattices.valid), lattices.found),
        *(sigma, n, m, half, OFFSET, OFTEN, x_bits, y_bits),
    )
    return x_bits, y_bits


def soft_bits_numpy(
    lattices: Lattices, half: int, scatter: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """:func:`soft_bits` without the compiled kernel; ``scatter`` is (n,), in pitches."""
    length = 2 * half
    n = len(lattices.found)
    rest = lattices.uv - lattices.place
    index = lattices.place.astype(np.int64) + half
    inside = (
        lattices.valid & lattices.found[:, None] & ((index >= 0) & (index < length)).all(axis=2)
    )
    frame, dot = np.nonzero(inside)
    index, rest = index[frame, dot], rest[frame, dot]
    cell = (frame * length + index[:, 1]) * length + index[:, 0]
    miss = np.abs(rest - grid.displacement(rest)).max(axis=1)
    holder = np.full(n * length * length, -1, np.int64)
    order = np.arange(len(cell))
    holder[cell] = order
    worse = np.flatnonzero(holder[cell] != order)
    for k in worse[np.argsort(-miss[worse], kind="stable")]:
        if miss[k] < miss[holder[cell[k]]]:
            holder[cell[k]] = k
    kept = holder[cell] == order
    cell, rest, frame = cell[kept], rest[kept], frame[kept]

    sigma = scatter[frame]
    spread = (-0.25 / (sigma * sigma)).astype(np.float32)
    bits = []
    for along in (rest[:, 1] - rest[:, 0], rest[:, 1] + rest[:, 0]):
        one = np.exp(spread * (along - OFFSET) ** 2) + OFTEN
        zero = np.exp(spread * (along + OFFSET) ** 2) + OFTEN
        table = np.zeros(n * length * length, np.float32)
        table[cell] = np.log(one / zero)
        bits.append(table.reshape(n, length, length))
    return bits[0], bits[1]
