"""The grid on which places lie: from a list of surveyed landmarks back to a floor.

Other tools keep places, not cells. The pitch is the largest one of which all distances
between columns and between rows are multiples; pitch and origin are then fitted, and taken
as round as the places' scatter lets them be.
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
from locatk.core.landmarks.map.floor import HOLE, AsBuiltLandmark, FloorMap

Array = NDArray[np.float64]

TOLERANCE_M = 0.010
"""How far a landmark may lie off its cell, along x or y."""

EXACT_M = 1e-6
"""A place that is as near to its cell is that of the design."""

FINEST = 12
"""The pitch is searched down to this part of the smallest distance."""

LARGEST_SIDE = 2_000

_DIGITS = (-1, 0, 1, 2, 3, 6)
"""Decimals of mm to which pitch and origin are rounded, the first that fits."""


@dataclass(frozen=True)
class Grid:
    """A grid along the axes and the cells of the places on it.

    Attributes
    ----------
    pitch_m : float
    origin_m : (float, float)
        Of cell (0, 0), which has the least row and column of all places.
    cells : (n, 2) int64 ndarray
        Row and column of each place.
    offset_m : (n, 2) ndarray
        From each place's cell to the place, x and y.
    """

    pitch_m: float
    origin_m: tuple[float, float]
    cells: NDArray[np.int64]
    offset_m: Array


def built_poses(floor: FloorMap) -> Array:
    """(n, 3) x, y in metres and heading of the landmarks of :meth:`FloorMap.cells`, as built
    where that is known, else as designed."""
    poses = []
    for cell in floor.cells():
        x, y = floor.place(cell)
        built = floor.built.get(cell)
        poses.append(
            (x, y, 0.0) if built is None else (x + built.x_m, y + built.y_m, built.heading_rad)
        )
    return np.array(poses)


def floor_of(
    codes: Sequence[int],
    poses: ArrayLike,
    names: Sequence[str],
    *,
    pitch_m: float | None = None,
    tolerance_m: float = TOLERANCE_M,
) -> FloorMap:
    """The floor of landmarks that are known by their places.

    Parameters
    ----------
    codes : n integers
    poses : (n, 3) ndarray
        x and y in metres, heading in radians.
    names : n strings
        What errors call the landmarks.
    pitch_m, tolerance_m
        See :func:`fit_grid`.

    Returns
    -------
    FloorMap
        With the defaults of all that places do not tell. A landmark that lies off its cell
        or is turned is known as built: with bars of nominal strength, and an unknown
        standard deviation.

    Raises
    ------
    InputError
        As :func:`fit_grid`; two landmarks in one cell.
    """
    at = np.asarray(poses, float).reshape(-1, 3)
    grid = fit_grid(at[:, :2], names, pitch_m=pitch_m, tolerance_m=tolerance_m)
    laid = np.full(grid.cells.max(0) + 1, HOLE, np.int64)
    built = {}
    first: dict[tuple[int, int], str] = {}
    for code, cell, offset, heading, name in zip(
        codes, grid.cells.tolist(), grid.offset_m.tolist(), at[:, 2].tolist(), names, strict=True
    ):
        key = (cell[0], cell[1])
        if key in first:
            raise InputError(
                f"{first[key]} and {name} lie in one cell, row {key[0]}, column {key[1]}"
            )
        first[key] = name
        laid[key] = code
        if heading or max(map(abs, offset)) > EXACT_M:
            x, y = offset
            built[key] = AsBuiltLandmark(x, y, heading, signs(code), np.full(7, np.nan))
    return FloorMap(laid, pitch_m=grid.pitch_m, origin_m=grid.origin_m, built=built)


def fit_grid(
    places: ArrayLike,
    names: Sequence[str],
    *,
    pitch_m: float | None = None,
    tolerance_m: float = TOLERANCE_M,
) -> Grid:
    """The grid of places (n, 2) in metres.

    Parameters
    ----------
    places : (n, 2) ndarray
        Along the axes of the map: a survey in a turned frame has no grid.
    names : n strings
        What errors call the places.
    pitch_m : float, optional
        The pitch, where it is known; else the largest that fits.
    tolerance_m : float
        How far a place may lie off its cell, along x or y; at most a quarter of the pitch.

    Raises
    ------
    InputError
        There are no places; they tell no pitch; no pitch fits; the tolerance is too large; a
        place is off by more than
        the tolerance (the worst is named); the grid is very large.
    """
    at = np.asarray(places, float).reshape(-1, 2)
    if not len(at):
        raise InputError("no landmarks")
    groups = [_groups(axis, 2 * tolerance_m) for axis in at.T]
    gaps = np.sort(np.concatenate([np.diff(middle) for _, middle in groups]))
    pitch = _pitch(gaps, tolerance_m) if pitch_m is None else pitch_m
    if pitch < 4 * tolerance_m:
        raise InputError(
            f"a tolerance of {1e3 * tolerance_m:g} mm is too large for a pitch of "
            f"{1e3 * pitch:g} mm, expected less than a quarter"
        )
    columns, rows = (_indices(group, middle, pitch) for group, middle in groups)
    cells = np.column_stack([rows, columns])
    if cells.max() >= LARGEST_SIDE:
        raise InputError(
            f"the places lie on {cells[:, 0].max() + 1} x {cells[:, 1].max() + 1} cells of "
            f"{1e3 * pitch:g} mm, more than {LARGEST_SIDE} a side",
            hint="Give the --pitch, and leave out what is no landmark",
        )
    steps = cells[:, ::-1].astype(float)  # along x, y
    spread = steps - steps.mean(0)
    lever = (spread**2).sum()
    if pitch_m is None:
        pitch = float((spread * at).sum() / lever)
    origin = (at - pitch * steps).mean(0)
    offset = at - origin - pitch * steps
    _check(offset, names, pitch, tolerance_m)
    scatter = math.sqrt((offset**2).sum() / max(offset.size - 3, 1))
    if pitch_m is None:
        pitch = _round(pitch, 3 * scatter / math.sqrt(lever))
    slack = 3 * scatter / math.sqrt(len(at))
    x, y = (_round(value, slack) for value in (at - pitch * steps).mean(0).tolist())
    return Grid(pitch, (x, y), cells, at - [x, y] - pitch * steps)


def _groups(values: Array, gap_m: float) -> tuple[NDArray[np.int64], Array]:
    """Values that belong together: the group of each, and the groups' middles, ascending."""
    order = np.argsort(values, kind="stable")
    number = np.concatenate([[0], np.cumsum(np.diff(values[order]) > gap_m)])
    group = np.empty(len(values), np.int64)
    group[order] = number
    return group, np.bincount(group, values) / np.bincount(group)


def _indices(group: NDArray[np.int64], middle: Array, pitch_m: float) -> NDArray[np.int64]:
    """Column (or row) of each place."""
    steps = np.rint(np.diff(middle) / pitch_m)
    whole = np.concatenate([[0.0], np.cumsum(np.minimum(steps, LARGEST_SIDE))])
    return np.asarray(whole.astype(np.int64)[group])


def _pitch(gaps: Array, tolerance_m: float) -> float:
    """The largest pitch of which all gaps, ascending, are multiples."""
    if not len(gaps):
        raise InputError("one place tells no pitch", hint="Give the --pitch")
    for part in range(1, FINEST + 1):
        pitch = float(gaps[0]) / part
        if pitch < 4 * tolerance_m:
            break  # any place would fit
        top = bottom = 0.0
        for gap in gaps.tolist():  # the longer the gap, the better the pitch must be known
            count = max(round(gap / pitch), 1)
            if abs(gap - count * pitch) > 2 * tolerance_m:
                break
            top, bottom = top + gap * count, bottom + count * count
            pitch = top / bottom
        else:
            return pitch
    raise InputError(
        "the places lie on no grid along the axes",
        hint="Give the --pitch to see which place is off, or a larger --tolerance",
    )


def _check(offset: Array, names: Sequence[str], pitch: float, tolerance_m: float) -> None:
    off = np.abs(offset).max(1)
    worst = int(np.argmax(off))
    if off[worst] > tolerance_m:
        raise InputError(
            f"{names[worst]} lies {1e3 * off[worst]:.1f} mm off the grid of {1e3 * pitch:.6g} mm, "
            f"more than {1e3 * tolerance_m:g}; so do {int((off > tolerance_m).sum()) - 1} others",
            hint="Correct the place, or give the --pitch or a larger --tolerance",
        )


def _round(value_m: float, slack_m: float) -> float:
    """The roundest number of mm within the slack, in metres."""
    for digits in _DIGITS:
        near = float(Decimal(repr(round(1e3 * value_m, digits))).scaleb(-3))
        if abs(near - value_m) <= slack_m + 1e-10:
            return near + 0.0
    return value_m
