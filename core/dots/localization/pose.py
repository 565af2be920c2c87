"""From a decoded window to the pose of the camera, and what its dots say of that pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.codec import (
    DOT_DIRECTIONS,
    MAIN_SEQUENCE,
    MAIN_SEQUENCE_LENGTH,
    SECTION_LENGTH,
    Codec,
)
from locatk.core.dots.codec.sequences import SMALLEST_SHIFT
from locatk.core.dots.detection import lattice as grid
from locatk.core.dots.detection.lattice import Lattices
from locatk.core.dots.identification.decoding import Decoded
from locatk.core.dots.identification.phase_voting import kernel_tables
from locatk.core.dots.sheet import OFFSET
from locatk.core.kernels import kernels

TURNS = np.array(
    [[[1, 0], [0, 1]], [[0, -1], [1, 0]], [[-1, 0], [0, -1]], [[0, 1], [-1, 0]]], np.int64
)
"""(4, 2, 2) directions as seen to directions as printed, by rotation."""

CORNERS = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
"""(4, 2) printed corner of a window, each 0 or 1, that is seen as its upper left."""


@dataclass(frozen=True)
class Match:
    """Dots of frames against the pattern: (n, m) in use, (n, m, 2) by how much each misses
    its lattice coordinates, and (n, m, 2) where it stands from ``origin`` on."""

    use: NDArray[np.bool_]
    miss: NDArray[np.float32]
    target: NDArray[np.float64]
    origin: NDArray[np.int64]


@dataclass(frozen=True)
class Poses:
    """Poses of n frames on the grid.

    Attributes
    ----------
    grid : (n, 2) float64 ndarray
        Grid coordinates of the camera's centre.
    heading : (n,) float64 ndarray
        From the sheet's x axis to the image's right, counter-clockwise, in rad.
    covariance : (n, 3, 3) float64 ndarray
        Of x, y (pitches, y down) and heading (rad).
    """

    grid: NDArray[np.float64]
    heading: NDArray[np.float64]
    covariance: NDArray[np.float64]


def poses(lattices: Lattices, half: int, decoded: Decoded, codec: Codec) -> Poses:
    """Fit the lattices once more, to the dots that say what they should, and read poses off.

    Where in its cell a dot should stand is known once its frame is decoded, so that every
    dot tells the grid as well as it was found; papers/dots.txt II-B.8 takes one corner of
    the decoded window instead.
    """
    if kernels is None:
        return poses_numpy(lattices, half, decoded, codec)
    n, m = lattices.valid.shape
    windows = np.empty((n, 5), np.int64)
    windows[:, 0], windows[:, 1], windows[:, 2:4] = decoded.x, decoded.y, decoded.section
    windows[:, 4] = decoded.rotation
    pose, covariance = np.empty((n, 3)), np.empty((n, 3, 3))
    kernels.poses(
        np.ascontiguousarray(lattices.points),
        np.ascontiguousarray(lattices.valid),
        *(lattices.uv, lattices.place, n, m, half, lattices.lens, grid.weights(True), windows),
        *kernel_tables(codec),
        *(SECTION_LENGTH, SMALLEST_SHIFT, OFFSET, grid.TIGHT, grid.FINEST),
        *(lattices.parameters.copy(), pose, covariance),
    )
    return Poses(pose[:, :2], pose[:, 2], covariance)


def poses_numpy(lattices: Lattices, half: int, decoded: Decoded, codec: Codec) -> Poses:
    """:func:`poses` without the compiled kernel."""
    dots = match(lattices, half, decoded, codec)
    parameters, covariance = grid.refit(lattices, dots.miss, dots.use)
    turn = TURNS[decoded.rotation]
    corner = CORNERS[decoded.rotation] * (2 * half - 1)
    centre = parameters[:, [grid.C_U, grid.C_V]] + half
    slope = grid.slope_at_centre(parameters)
    right = np.einsum("nij,nj->ni", turn, slope[:, :, 0])
    return Poses(
        grid=np.einsum("nij,nj->ni", turn, centre) + corner + dots.origin,
        heading=np.arctan2(-right[:, 1], right[:, 0]),
        covariance=_pose_covariance(covariance, slope, turn),
    )


def match(
    lattices: Lattices,
    half: int,
    decoded: Decoded,
    codec: Codec,
) -> Match:
    """Where in the lattice each dot should stand, if it is what the code has there."""
    x, y, section, rotation = decoded.x, decoded.y, decoded.section, decoded.rotation
    turn, corner = TURNS[rotation], CORNERS[rotation] * (2 * half - 1)
    index = (lattices.place.astype(np.int64) + half) @ turn.transpose(0, 2, 1) + corner[:, None]
    steps = np.arange(2 * half)
    columns = codec.phases((x[:, None] + steps) % SECTION_LENGTH) + section[:, :1]
    rows = codec.phases((y[:, None] + steps) % SECTION_LENGTH) + section[:, 1:]
    inside = ((index >= 0) & (index < 2 * half)).all(axis=2)
    column = np.where(inside, index[..., 0], 0)
    row = np.where(inside, index[..., 1], 0)
    column_bit = MAIN_SEQUENCE[
        (np.take_along_axis(columns, column, 1) + y[:, None] + row) % MAIN_SEQUENCE_LENGTH
    ]
    row_bit = MAIN_SEQUENCE[
        (np.take_along_axis(rows, row, 1) + x[:, None] + column) % MAIN_SEQUENCE_LENGTH
    ]
    printed = DOT_DIRECTIONS[column_bit + 2 * row_bit] * OFFSET
    seen = (printed @ turn).astype(np.float32)  # the inverse turn
    miss = lattices.uv - lattices.place - seen
    use = lattices.valid & inside & (np.abs(miss) < grid.TIGHT).all(axis=2)
    target = index + printed
    return Match(use, miss, target, np.stack([x, y], axis=1))


def _pose_covariance(
    covariance: NDArray[np.float64], slope: NDArray[np.float64], turn: NDArray[np.int64]
) -> NDArray[np.float64]:
    """(n, 3, 3) of x, y and heading from that of a lattice's parameters."""
    n = len(covariance)
    jacobian = np.zeros((n, 3, 9))
    jacobian[:, :2, grid.C_U] = turn[:, :, 0]
    jacobian[:, :2, grid.C_V] = turn[:, :, 1]
    # Heading is minus the angle of the image's right in the lattice, but for quarter turns.
    u, v = slope[:, 0, 0], slope[:, 1, 0]
    square = u * u + v * v
    jacobian[:, 2, grid.A_U.start] = v / square
    jacobian[:, 2, grid.A_V.start] = -u / square
    result: NDArray[np.float64] = jacobian @ covariance @ jacobian.transpose(0, 2, 1)
    return result
