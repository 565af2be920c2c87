"""Soft bits of dots on a lattice: log likelihood ratios of the column and the row bit.

A bit is one if the dot is beyond the diagonal through its grid position (Hostettler et al. 2016,
Fig. 6). A dot is either about the nominal offset of one of the four symbols, with the scatter of
the frame's own dots, or an outlier (dirt, texture) anywhere in its cell. The log likelihood ratio
of a bit, one over zero, compares the two symbols that have it with the two that do not. The
fraction of outliers is that of the frame: its dots far from all symbols, and one more by the rule
of succession. (The paper uses the polynomial of Eq. 9 instead.)
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.codec import DOT_DIRECTIONS
from locatk.core.dots.detection.lattice import (
    SYMBOL_GATE_PITCHES,
    DotLattices,
    nearest_symbol_offset,
)
from locatk.core.dots.sheet import DOT_OFFSET_PITCHES
from locatk.core.kernels import kernels

MAX_WINDOW_DOTS = 40
"""Largest number of columns and rows, about the middle of a frame, that are decoded."""

WRONG_SYMBOL_LIKELIHOOD = 0.0002
"""Likelihood of a bit against which the position of its dot speaks with certainty: a print with
defects, where two dots in ten thousand are those of another symbol. It limits a soft bit to 8.
"""

MIN_BIT_SIGMA_PITCHES = 0.03
"""Least standard deviation of a dot for its soft bits; the largest is twice as much."""

BIT_SIGMA_FACTOR = 1.5
"""Ratio of the standard deviation for soft bits to the scatter of the frame's dots, which excludes
those beyond the gate."""


def window_half_width(lattices: DotLattices) -> int:
    """Return half the width of the window that contains the dots of all frames."""
    nodes = np.abs(lattices.nodes[lattices.valid & lattices.fitted[:, None]])
    half = int(nodes.max(initial=4)) + 1 if nodes.size else 5
    return min(half, MAX_WINDOW_DOTS // 2)


def soft_bits(lattices: DotLattices, half: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return column and row bits (n, 2 half, 2 half) for the decoder, 0 without a dot.

    Of two dots at a node the one closer to the offset of a symbol counts.
    """
    n, m = lattices.valid.shape
    sigma = np.clip(
        BIT_SIGMA_FACTOR * lattices.sigma, MIN_BIT_SIGMA_PITCHES, 2 * MIN_BIT_SIGMA_PITCHES
    )
    if kernels is None:
        return soft_bits_numpy(lattices, half, sigma)
    column_bits = np.empty((n, 2 * half, 2 * half), np.float32)
    row_bits = np.empty_like(column_bits)
    kernels.soft_bits(
        *(lattices.uv, lattices.nodes, np.ascontiguousarray(lattices.valid), lattices.fitted),
        *(sigma, n, m, half, DOT_OFFSET_PITCHES, SYMBOL_GATE_PITCHES, WRONG_SYMBOL_LIKELIHOOD),
        *(column_bits, row_bits),
    )
    return column_bits, row_bits


def soft_bits_numpy(
    lattices: DotLattices, half: int, sigma: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return soft bits as :func:`soft_bits`, without the compiled kernel.

    ``sigma`` (n,) is the standard deviation of the dots in pitches.
    """
    length = 2 * half
    n = len(lattices.fitted)
    offset = lattices.uv - lattices.nodes
    distance = np.abs(offset - nearest_symbol_offset(offset)).max(axis=2)
    outliers = (lattices.valid & (distance >= SYMBOL_GATE_PITCHES)).sum(axis=1)
    outlier_fraction = (outliers + 1) / (lattices.valid.sum(axis=1) + 2)
    index = lattices.nodes.astype(np.int64) + half
    is_inside = ((index >= 0) & (index < length)).all(axis=2)
    frame, dot = np.nonzero(lattices.valid & lattices.fitted[:, None] & is_inside)
    index, offset = index[frame, dot], offset[frame, dot]
    cell = (frame * length + index[:, 1]) * length + index[:, 0]
    residual = distance[frame, dot]
    owner = np.full(n * length * length, -1, np.int64)
    order = np.arange(len(cell))
    owner[cell] = order
    displaced = np.flatnonzero(owner[cell] != order)
    for k in displaced[np.argsort(-residual[displaced], kind="stable")]:
        if residual[k] < residual[owner[cell[k]]]:
            owner[cell[k]] = k
    kept = owner[cell] == order
    cell, offset, frame = cell[kept], offset[kept], frame[kept]

    # One outlier in a cell, relative to the peak of the Gaussian; a bit has two symbols.
    floor = 2 * (2 * np.pi * sigma * sigma * outlier_fraction)[frame] + WRONG_SYMBOL_LIKELIHOOD
    likelihood = [
        np.exp(-0.5 * (((offset - symbol) / sigma[frame, None]) ** 2).sum(axis=1))
        for symbol in DOT_DIRECTIONS * DOT_OFFSET_PITCHES
    ]
    bits = []
    for ones in ((1, 3), (2, 3)):
        one, zero = (
            sum(likelihood[k] for k in range(4) if (k in ones) == is_one) + floor
            for is_one in (True, False)
        )
        table = np.zeros(n * length * length, np.float32)
        table[cell] = np.log(one / zero)
        bits.append(table.reshape(n, length, length))
    return bits[0], bits[1]
