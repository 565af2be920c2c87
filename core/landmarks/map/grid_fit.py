"""Fit of a grid to surveyed positions: from a list of landmarks to a floor.

Other tools store positions, not cells. The pitch is the largest length of which all distances
between columns and between rows are multiples. Pitch and origin are then fitted by least squares,
and rounded as far as the scatter of the positions allows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from locatk.core.errors import InputError
from locatk.core.landmarks.landmark import signs
from locatk.core.landmarks.map.floor import HOLE_CODE, AsBuiltLandmark, FloorMap

Array = NDArray[np.float64]

MAX_OFFSET_M = 0.010
"""Default of the largest offset of a landmark from its cell, along x or y."""

DESIGN_OFFSET_M = 1e-6
"""Largest offset from the cell of a landmark that counts as being as designed."""

MAX_PITCH_DIVISOR = 12
"""The smallest pitch that is tried is the smallest distance divided by this number."""

MAX_CELLS_PER_SIDE = 2_000
"""Largest number of rows or columns; more come from positions that are no landmarks."""

ROUNDING_SIGMAS = 3.0
"""Pitch and origin are rounded within this many of their standard deviations."""

_DECIMALS_MM = (-1, 0, 1, 2, 3, 6)
"""Decimals of mm to which pitch and origin are rounded; the first that is close enough."""


@dataclass(frozen=True)
class FittedGrid:
    """Grid parallel to the axes, and the cells of the positions on it.

    Attributes
    ----------
    pitch_m : float
    origin_m : (float, float)
        Position of cell (0, 0), which has the smallest row and column of all positions.
    cells : (n, 2) int64 ndarray
        Row and column of each position.
    offset_m : (n, 2) ndarray
        Offset (x, y) of each position from its cell.
    """

    pitch_m: float
    origin_m: tuple[float, float]
    cells: NDArray[np.int64]
    offset_m: Array


def floor_from_poses(
    codes: Sequence[int],
    poses: ArrayLike,
    names: Sequence[str],
    *,
    pitch_m: float | None = None,
    tolerance_m: float = MAX_OFFSET_M,
) -> FloorMap:
    """Return the floor of landmarks whose poses are known.

    Parameters
    ----------
    codes : n integers
    poses : (n, 3) ndarray
        x and y in metres, heading in radians.
    names : n strings
        Names of the landmarks in error messages.
    pitch_m, tolerance_m
        See :func:`fit_grid`.

    Returns
    -------
    FloorMap
        A landmark that is off its cell or rotated has an as-built record with bars of nominal
        strength and unknown standard deviations. Everything that poses do not contain has its
        default.

    Raises
    ------
    InputError
        As :func:`fit_grid`; or two landmarks are in one cell.
    """
    pose = np.asarray(poses, float).reshape(-1, 3)
    grid = fit_grid(pose[:, :2], names, pitch_m=pitch_m, tolerance_m=tolerance_m)
    floor_codes = np.full(grid.cells.max(0) + 1, HOLE_CODE, np.int64)
    built = {}
    name_of_cell: dict[tuple[int, int], str] = {}
    for code, (row, column), offset, heading, name in zip(
        codes, grid.cells.tolist(), grid.offset_m.tolist(), pose[:, 2].tolist(), names, strict=True
    ):
        cell = (row, column)
        if cell in name_of_cell:
            raise InputError(
                f"{name_of_cell[cell]} and {name} are in one cell, row {row}, column {column}"
            )
        name_of_cell[cell] = name
        floor_codes[cell] = code
        if heading or max(map(abs, offset)) > DESIGN_OFFSET_M:
            x, y = offset
            built[cell] = AsBuiltLandmark(x, y, heading, signs(code), np.full(7, np.nan))
    return FloorMap(floor_codes, pitch_m=grid.pitch_m, origin_m=grid.origin_m, built=built)


def fit_grid(
    positions_m: ArrayLike,
    names: Sequence[str],
    *,
    pitch_m: float | None = None,
    tolerance_m: float = MAX_OFFSET_M,
) -> FittedGrid:
    """Fit a grid to positions.

    Parameters
    ----------
    positions_m : (n, 2) ndarray
        In a frame whose axes are parallel to the rows and columns.
    names : n strings
        Names of the positions in error messages.
    pitch_m : float, optional
        Pitch, if it is known; otherwise the largest that fits.
    tolerance_m : float
        Largest offset of a position from its cell, along x or y; at most a quarter of the pitch.

    Raises
    ------
    InputError
        There are no positions, or too few for the pitch; no pitch fits; the tolerance is too
        large; a position is off by more than the tolerance (the worst is named); the grid is very
        large.
    """
    position = np.asarray(positions_m, float).reshape(-1, 2)
    if not len(position):
        raise InputError("no landmarks")
    groups = [_group_coordinates(axis, 2 * tolerance_m) for axis in position.T]
    gaps = np.sort(np.concatenate([np.diff(centres) for _, centres in groups]))
    pitch = _largest_common_pitch(gaps, tolerance_m) if pitch_m is None else pitch_m
    if pitch < 4 * tolerance_m:
        raise InputError(
            f"a tolerance of {1e3 * tolerance_m:g} mm is too large for a pitch of "
            f"{1e3 * pitch:g} mm, expected less than a quarter"
        )
    columns, rows = (_cell_indices(group, centres, pitch) for group, centres in groups)
    cells = np.column_stack([rows, columns])
    if cells.max() >= MAX_CELLS_PER_SIDE:
        raise InputError(
            f"the positions are on {cells[:, 0].max() + 1} x {cells[:, 1].max() + 1} cells of "
            f"{1e3 * pitch:g} mm, more than {MAX_CELLS_PER_SIDE} per side",
            hint="Give the --pitch, and leave out positions that are no landmarks",
        )
    steps = cells[:, ::-1].astype(float)  # along x, y
    centred_steps = steps - steps.mean(0)
    sum_of_squares = (centred_steps**2).sum()
    if pitch_m is None:
        pitch = float((centred_steps * position).sum() / sum_of_squares)
    origin = (position - pitch * steps).mean(0)
    offset = position - origin - pitch * steps
    _check_offsets(offset, names, pitch, tolerance_m)
    # Three parameters are fitted: the pitch and the origin.
    scatter = math.sqrt((offset**2).sum() / max(offset.size - 3, 1))
    if pitch_m is None:
        pitch = _round_mm(pitch, ROUNDING_SIGMAS * scatter / math.sqrt(sum_of_squares))
    rounding = ROUNDING_SIGMAS * scatter / math.sqrt(len(position))
    x, y = (_round_mm(value, rounding) for value in (position - pitch * steps).mean(0).tolist())
    return FittedGrid(pitch, (x, y), cells, position - [x, y] - pitch * steps)


def _group_coordinates(values: Array, gap_m: float) -> tuple[NDArray[np.int64], Array]:
    """Group coordinates that no gap separates; return group indices and centres, ascending."""
    order = np.argsort(values, kind="stable")
    sorted_groups = np.concatenate([[0], np.cumsum(np.diff(values[order]) > gap_m)])
    group = np.empty(len(values), np.int64)
    group[order] = sorted_groups
    return group, np.bincount(group, values) / np.bincount(group)


def _cell_indices(group: NDArray[np.int64], centres: Array, pitch_m: float) -> NDArray[np.int64]:
    """Return the column (or row) of each position."""
    steps = np.rint(np.diff(centres) / pitch_m)
    index = np.concatenate([[0.0], np.cumsum(np.minimum(steps, MAX_CELLS_PER_SIDE))])
    return np.asarray(index.astype(np.int64)[group])


def _largest_common_pitch(gaps: Array, tolerance_m: float) -> float:
    """Return the largest pitch of which all gaps, given in ascending order, are multiples."""
    if not len(gaps):
        raise InputError("one position does not give a pitch", hint="Give the --pitch")
    for divisor in range(1, MAX_PITCH_DIVISOR + 1):
        pitch = float(gaps[0]) / divisor
        if pitch < 4 * tolerance_m:
            break  # Any position would fit.
        numerator = denominator = 0.0
        # A longer gap needs a better pitch, which the shorter ones provide.
        for gap in gaps.tolist():
            count = max(round(gap / pitch), 1)
            if abs(gap - count * pitch) > 2 * tolerance_m:
                break
            numerator, denominator = numerator + gap * count, denominator + count * count
            pitch = numerator / denominator
        else:
            return pitch
    raise InputError(
        "the positions are on no grid parallel to the axes",
        hint="Give the --pitch to find the position that is off, or a larger --tolerance",
    )


def _check_offsets(offset: Array, names: Sequence[str], pitch: float, tolerance_m: float) -> None:
    """Raise an error that names the worst position if it is farther off than the tolerance."""
    largest = np.abs(offset).max(1)
    worst = int(np.argmax(largest))
    if largest[worst] > tolerance_m:
        raise InputError(
            f"{names[worst]} is {1e3 * largest[worst]:.1f} mm off the grid of "
            f"{1e3 * pitch:.6g} mm, more than {1e3 * tolerance_m:g}; so are "
            f"{int((largest > tolerance_m).sum()) - 1} others",
            hint="Correct the position, or give the --pitch or a larger --tolerance",
        )


def _round_mm(value_m: float, tolerance_m: float) -> float:
    """Return the length with the fewest decimals of mm within the tolerance, in metres."""
    for decimals in _DECIMALS_MM:
        rounded = float(Decimal(repr(round(1e3 * value_m, decimals))).scaleb(-3))
        if abs(rounded - value_m) <= tolerance_m + 1e-10:
            return rounded + 0.0  # 0.0 instead of -0.0
    return value_m
