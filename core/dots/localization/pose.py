"""Pose of the camera from a decoded window.

Once a window is decoded, the symbol of every dot is known and with it the dot's true position. The
lattice is fitted once more to all dots at these positions, and the pose and its covariance follow
from the fit. (Hostettler et al. 2016, II-B.8, use one corner of the decoded window instead.)
"""

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
from locatk.core.dots.codec.sequences import MIN_SHIFT
from locatk.core.dots.detection.lattice import (
    A_U,
    A_V,
    C_U,
    C_V,
    MIN_SIGMA_PITCHES,
    SYMBOL_GATE_PITCHES,
    DotLattices,
    prior_weights,
    refit_lattices,
    slope_at_centre,
)
from locatk.core.dots.identification.decoding import DecodedWindows
from locatk.core.dots.identification.phase_voting import kernel_tables
from locatk.core.dots.sheet import DOT_OFFSET_PITCHES
from locatk.core.kernels import kernels

Array = NDArray[np.float64]

IMAGE_TO_PRINT = np.array(
    [[[1, 0], [0, 1]], [[0, -1], [1, 0]], [[-1, 0], [0, -1]], [[0, 1], [-1, 0]]], np.int64
)
"""(4, 2, 2) rotation of directions in the image to directions in print, by quarter turns."""

PRINTED_CORNERS = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
"""(4, 2) printed corner of a window, each 0 or 1, that is at the upper left of the image."""


@dataclass(frozen=True)
class DotAssignments:
    """Assignment of the dots of n frames to positions of the pattern.

    Attributes
    ----------
    used : (n, m) bool ndarray
        Whether the dot agrees with the symbol at its position.
    residual : (n, m, 2) float32 ndarray
        Lattice coordinates of the dot minus those of its symbol.
    target : (n, m, 2) float64 ndarray
        Printed position of the dot itself relative to ``origin``, in pitches.
    origin : (n, 2) int64 ndarray
        Grid coordinates of the window's printed corner.
    """

    used: NDArray[np.bool_]
    residual: NDArray[np.float32]
    target: Array
    origin: NDArray[np.int64]


@dataclass(frozen=True)
class GridPoses:
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

    grid: Array
    heading: Array
    covariance: Array


def localize_windows(
    lattices: DotLattices, half: int, windows: DecodedWindows, codec: Codec
) -> GridPoses:
    """Estimate the poses of frames from their lattices and decoded windows of 2 ``half`` lines."""
    if kernels is None:
        return localize_windows_numpy(lattices, half, windows, codec)
    n, m = lattices.valid.shape
    decoded = np.empty((n, 5), np.int64)
    decoded[:, 0], decoded[:, 1], decoded[:, 2:4] = windows.x, windows.y, windows.section
    decoded[:, 4] = windows.rotation
    pose, covariance = np.empty((n, 3)), np.empty((n, 3, 3))
    kernels.poses(
        np.ascontiguousarray(lattices.points),
        np.ascontiguousarray(lattices.valid),
        *(lattices.uv, lattices.nodes, n, m, half, lattices.lens, prior_weights(True), decoded),
        *kernel_tables(codec),
        *(SECTION_LENGTH, MIN_SHIFT, DOT_OFFSET_PITCHES, SYMBOL_GATE_PITCHES, MIN_SIGMA_PITCHES),
        *(lattices.parameters.copy(), pose, covariance),
    )
    return GridPoses(pose[:, :2], pose[:, 2], covariance)


def localize_windows_numpy(
    lattices: DotLattices, half: int, windows: DecodedWindows, codec: Codec
) -> GridPoses:
    """Estimate poses as :func:`localize_windows`, without the compiled kernel."""
    dots = assign_dots(lattices, half, windows, codec)
    parameters, covariance = refit_lattices(lattices, dots.residual, dots.used)
    rotation = IMAGE_TO_PRINT[windows.rotation]
    corner = PRINTED_CORNERS[windows.rotation] * (2 * half - 1)
    centre = parameters[:, [C_U, C_V]] + half
    slope = slope_at_centre(parameters)
    right = np.einsum("nij,nj->ni", rotation, slope[:, :, 0])
    return GridPoses(
        grid=np.einsum("nij,nj->ni", rotation, centre) + corner + dots.origin,
        heading=np.arctan2(-right[:, 1], right[:, 0]),
        covariance=_pose_covariance(covariance, slope, rotation),
    )


def assign_dots(
    lattices: DotLattices, half: int, windows: DecodedWindows, codec: Codec
) -> DotAssignments:
    """Assign the dots of frames to the positions of their decoded windows of 2 ``half`` lines."""
    x, y, section = windows.x, windows.y, windows.section
    rotation = IMAGE_TO_PRINT[windows.rotation]
    corner = PRINTED_CORNERS[windows.rotation] * (2 * half - 1)
    index = (lattices.nodes.astype(np.int64) + half) @ rotation.transpose(0, 2, 1)
    index += corner[:, None]
    steps = np.arange(2 * half)
    column_phases = codec.phases((x[:, None] + steps) % SECTION_LENGTH) + section[:, :1]
    row_phases = codec.phases((y[:, None] + steps) % SECTION_LENGTH) + section[:, 1:]
    is_inside = ((index >= 0) & (index < 2 * half)).all(axis=2)
    column = np.where(is_inside, index[..., 0], 0)
    row = np.where(is_inside, index[..., 1], 0)
    column_bit = MAIN_SEQUENCE[
        (np.take_along_axis(column_phases, column, 1) + y[:, None] + row) % MAIN_SEQUENCE_LENGTH
    ]
    row_bit = MAIN_SEQUENCE[
        (np.take_along_axis(row_phases, row, 1) + x[:, None] + column) % MAIN_SEQUENCE_LENGTH
    ]
    printed_offset = DOT_DIRECTIONS[column_bit + 2 * row_bit] * DOT_OFFSET_PITCHES
    # A row vector times the rotation is rotated by its inverse, from print to image.
    image_offset = (printed_offset @ rotation).astype(np.float32)
    residual = lattices.uv - lattices.nodes - image_offset
    used = lattices.valid & is_inside & (np.abs(residual) < SYMBOL_GATE_PITCHES).all(axis=2)
    return DotAssignments(used, residual, index + printed_offset, np.stack([x, y], axis=1))


def _pose_covariance(covariance: Array, slope: Array, rotation: NDArray[np.int64]) -> Array:
    """Return the covariance (n, 3, 3) of x, y and heading from that of lattice parameters."""
    n = len(covariance)
    jacobian = np.zeros((n, 3, 9))
    jacobian[:, :2, C_U] = rotation[:, :, 0]
    jacobian[:, :2, C_V] = rotation[:, :, 1]
    # Except for quarter turns, the heading is minus the angle of the image's right in the lattice.
    u, v = slope[:, 0, 0], slope[:, 1, 0]
    squared = u * u + v * v
    jacobian[:, 2, A_U.start] = v / squared
    jacobian[:, 2, A_V.start] = -u / squared
    result: Array = jacobian @ covariance @ jacobian.transpose(0, 2, 1)
    return result
