"""Landmarks with errors and faults, and the field of their bars.

magpylib computes the field of each bar as a cuboid; the closed form of the solvers is not used.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import magpylib
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from locatk.core.errors import InputError
from locatk.core.geometry import rotation_exp
from locatk.core.landmarks.landmark import (
    CODE_COUNT,
    PATTERN_OF,
    PATTERNS,
    Geometry,
    code_of,
    signs,
)
from locatk.core.landmarks.map.floor import Cell, FloorMap
from locatk.core.landmarks.simulation.options import Errors, Faults, RandomSource
from locatk.core.magnetics import MU0_4PI, dipole_field
from locatk.core.simulation import random_stream

Array = NDArray[np.float64]

FIELD_RANGE_M = 0.3
"""Distance beyond which the field of a landmark is ignored [m]. That of a strong one is 1 uT
there, a hundredth of the noise."""

DIPOLE_LENGTHS = 6
"""Distance in lengths of a bar beyond which it is a dipole, to 0.3 uT. Dipoles are faster."""

BAR_DRAWS = 24
"""Random numbers for the bars of a landmark: for each a strength, a position (2), a rotation and a
tilt (2)."""


@dataclass(frozen=True)
class InstalledLandmark:
    """One landmark as installed.

    Attributes
    ----------
    cell : (row, column)
    designed, code : int
        Code of the map, and code as installed. They differ if a wrong landmark was installed;
        flipped and missing bars are in :attr:`strength`.
    x_m, y_m, heading_rad : float
        Position in the map's frame, and heading of the landmark's x.
    strength : (4,) ndarray
        Strengths of the bars in units of the nominal one: positive N, negative S, 0 missing.
    faults : tuple of str
        ``"misread"``, ``"flipped:2"``, ``"missing:3"``, ``"displaced"``.
    middle_m : (4, 3) ndarray
        Middles of the bars in the map's frame; z is up from the top faces of the bars.
    axes : (4, 3, 3) ndarray
        Rotations of the bars: columns are along (as magnetised, if N), across and up.
    """

    cell: Cell
    designed: int
    code: int
    x_m: float
    y_m: float
    heading_rad: float
    strength: Array
    faults: tuple[str, ...]
    middle_m: Array
    axes: Array


def install_landmarks(
    floor: FloorMap, errors: Errors, faults: Faults, seed: int
) -> dict[Cell, InstalledLandmark]:
    """Install the landmarks of a map with errors and faults.

    Each landmark has a random stream of its own: a fault of one leaves the others unchanged.
    A landmark with an as-built record in the map is installed accordingly, except for the
    positions of its bars.

    Raises
    ------
    InputError
        A fault is of a cell without landmark, or of a bar that does not exist.
    """
    _check_faults(floor, faults)
    cells = floor.cells()
    rngs = [random_stream(seed, RandomSource.LANDMARK, *cell) for cell in cells]
    draws = np.array([rng.standard_normal(3 + BAR_DRAWS) for rng in rngs]).reshape(len(rngs), -1)
    strength, middle, axes = scatter_bars(floor.geometry, draws[:, 3:], errors)
    inputs = zip(cells, rngs, draws[:, :3], strength, middle, axes, strict=True)
    return {cell: _install(floor, cell, errors, faults, *values) for cell, *values in inputs}


def _check_faults(floor: FloorMap, faults: Faults) -> None:
    cells = set(floor.cells())
    for cell, _ in (*faults.flipped, *faults.missing, *faults.displaced):
        if cell not in cells:
            raise InputError(
                f"a fault of cell {cell[0]},{cell[1]}, where the map has no landmark",
                hint=f"Name row,column of a map of {floor.shape[0]} x {floor.shape[1]} cells",
            )
    for cell, bar in (*faults.flipped, *faults.missing):
        if not 0 <= bar < 4:
            raise InputError(
                f"a fault of bar {bar} of cell {cell[0]},{cell[1]}", hint="Bars are 0 to 3"
            )


def _install(
    floor: FloorMap,
    cell: Cell,
    errors: Errors,
    faults: Faults,
    rng: np.random.Generator,
    draws: Array,
    strength: Array,
    middle: Array,
    axes: Array,
) -> InstalledLandmark:
    """Return the landmark of a cell.

    ``strength``, ``middle`` and ``axes`` are those of its bars in its own frame; ``draws`` are
    standard normal numbers for its position (2) and its rotation.
    """
    designed = int(floor.codes[cell])
    x, y = floor.position(cell)
    offset_x, offset_y = draws[:2] * errors.landmark_place_m
    heading = float(draws[2] * errors.landmark_turn_rad)
    is_wrong = rng.random() < faults.misread_rate
    code, names = designed, []
    if is_wrong:
        code = int(rng.choice(_other_codes(floor.alphabet, designed)))
        names.append("misread")
    signed = signs(code) * strength
    built = floor.built.get(cell)
    if built is not None and not is_wrong:
        offset_x, offset_y, heading = built.x_m, built.y_m, built.heading_rad
        signed = np.where(np.isfinite(built.strength), built.strength, signed)
    for bar in range(4):
        if (cell, bar) in faults.flipped:
            signed[bar] *= -1
            names.append(f"flipped:{bar}")
        if (cell, bar) in faults.missing:
            signed[bar] = 0.0
            names.append(f"missing:{bar}")
    for displaced, (dx, dy) in faults.displaced:
        if displaced == cell:
            offset_x, offset_y = offset_x + dx, offset_y + dy
            names.append("displaced")
    cos, sin = math.cos(heading), math.sin(heading)
    rotation = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    position = np.array([x + offset_x, y + offset_y, 0.0])
    return InstalledLandmark(
        cell,
        designed,
        code,
        float(position[0]),
        float(position[1]),
        heading,
        signed,
        tuple(names),
        middle @ rotation.T + position,
        rotation @ axes,
    )


def _other_codes(alphabet: str, code: int) -> list[int]:
    """Return the codes that may be installed by mistake instead of ``code``."""
    if alphabet == "6":
        codes = [code_of(letters) for letters in PATTERNS]
        return [other for other in codes if PATTERN_OF[other] != PATTERN_OF[code]]
    compass = [code_of(letters) for letters in ("NNNS", "SSSN", "NNSS")]
    return [c for c in (compass if alphabet == "compass" else range(CODE_COUNT)) if c != code]


def scatter_bars(geometry: Geometry, draws: Array, errors: Errors) -> tuple[Array, Array, Array]:
    """Return the bars of landmarks with their errors, in the landmarks' frames.

    ``draws`` (count, :data:`BAR_DRAWS`) are standard normal numbers. Returns strengths (count, 4),
    middles (count, 4, 3) and rotations (count, 4, 3, 3).
    """
    count = len(draws)
    strength_draw, position_draw, rotation_draw, tilt_draw = np.split(
        draws.reshape(count, 4, BAR_DRAWS // 4), [1, 3, 4], axis=-1
    )
    angle = np.arange(4) * math.pi / 2
    middle = np.zeros((count, 4, 3))
    middle[..., 0] = geometry.radius_m * np.cos(angle)
    middle[..., 1] = geometry.radius_m * np.sin(angle)
    middle[..., 2] = -geometry.bar_height_m / 2
    middle[..., :2] += errors.bar_place_m * position_draw
    rotation = np.zeros((count, 4, 3))
    # A bar points counter-clockwise along the circle, 90 degrees from the direction of its middle.
    rotation[..., 2] = angle + math.pi / 2 + errors.bar_turn_rad * rotation_draw[..., 0]
    tilt = np.zeros((count, 4, 3))
    tilt[..., :2] = errors.bar_lean_rad * tilt_draw
    strength = 1 + errors.bar_strength * strength_draw[..., 0]
    return strength, middle, rotation_exp(rotation) @ rotation_exp(tilt)


def bar_fields(geometry: Geometry, middle: ArrayLike, axes: ArrayLike, points: ArrayLike) -> Array:
    """Return the vertical field (...) in tesla of bars of nominal strength, each at its own points.

    Parameters
    ----------
    geometry : Geometry
    middle : (..., 3) ndarray
        Middles of the bars; broadcast with ``points``.
    axes : (..., 3, 3) ndarray
        Rotations of the bars.
    points : (..., 3) ndarray
        Points in the same frame.
    """
    axes = np.asarray(axes, float)
    offset = np.asarray(points, float) - middle
    local = np.einsum("...ij,...i->...j", axes, offset)
    bar = magpylib.magnet.Cuboid(
        polarization=(geometry.remanence_t, 0, 0),
        dimension=(geometry.bar_length_m, geometry.bar_width_m, geometry.bar_height_m),
    )
    field = np.asarray(bar.getB(local.reshape(-1, 3), squeeze=False)).reshape(local.shape)
    return np.asarray(np.einsum("...j,...j->...", axes[..., 2, :], field))


def dipole_fields(
    geometry: Geometry, middle: ArrayLike, axes: ArrayLike, points: ArrayLike
) -> Array:
    """Return the field of dipoles in the middles of bars; see :func:`bar_fields`."""
    volume = geometry.bar_length_m * geometry.bar_width_m * geometry.bar_height_m
    moment_am2 = geometry.remanence_t * volume / (4 * math.pi * MU0_4PI)
    moment = moment_am2 * np.asarray(axes, float)[..., :, 0]
    return dipole_field(np.asarray(points, float) - middle, moment)[..., 2]


def floor_field(geometry: Geometry, landmarks: Iterable[InstalledLandmark], points: Array) -> Array:
    """Return the vertical field (...) in tesla of landmarks at points (..., 3) of the map's frame.

    A landmark is ignored at distances above :data:`FIELD_RANGE_M`.
    """
    flat = points.reshape(-1, 3)
    field = np.zeros(len(flat))
    installed = list(landmarks)
    if not installed or not len(flat):
        return field.reshape(points.shape[:-1])
    tree = cKDTree(flat[:, :2])
    positions = [(mark.x_m, mark.y_m) for mark in installed]
    dipole_distance_m = DIPOLE_LENGTHS * geometry.bar_length_m
    for mark, in_range in zip(
        installed, tree.query_ball_point(positions, FIELD_RANGE_M), strict=True
    ):
        index = np.asarray(in_range, np.int64)
        distance_m = np.hypot(*(flat[index, :2] - [mark.x_m, mark.y_m]).T)
        is_dipole = distance_m > dipole_distance_m
        for part, fields in ((index[is_dipole], dipole_fields), (index[~is_dipole], bar_fields)):
            if len(part):
                unit_fields = fields(geometry, mark.middle_m, mark.axes, flat[part][:, None])
                field[part] += unit_fields @ mark.strength
    return field.reshape(points.shape[:-1])
