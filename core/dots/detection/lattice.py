"""The grid behind the dots of a frame: a homography, found from the dots alone.

A *lattice* is the grid up to a shift by whole places and quarter turns: ``u`` to the
right and ``v`` down of the image, within 45 degrees. It is seeded from the differences of
neighbouring dots in the middle of the frame, then grown outwards, so that perspective and
lens bend it no more than the next ring of dots can tell (compare papers/dots.txt II-B.2
and 3, which fit one pitch and one direction to the whole frame).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.sheet import OFFSET
from locatk.core.kernels import kernels

SEEDS = 40
"""Dots in the middle of the frame from which the lattice is seeded."""

RINGS = (3.2, 6.0, 9.0, 14.0, 20.0, 28.0, 40.0, np.inf)
"""Radii in pitches up to which dots are used while the lattice grows; as many as it takes."""

GATE = 0.36
"""Largest distance of a dot from its place, per axis and in pitches; dots lie at 1/6."""

LOOSE = 0.12
"""Standard deviation of a dot about its place: most of it is the code's displacement."""

NEIGHBOURS = (0.36, 1.32)
"""Square distances of neighbours, in square pitches; diagonal ones begin at 1.39."""

BENT_FROM = 4.0
"""Radius in pitches from which the bend of a lens is fitted."""

FIRM = 0.03
"""Standard deviation of a dot about where its symbol stands, before it was measured."""

TIGHT = 0.12
"""Largest distance of a dot from where its symbol stands, in pitches."""

FINEST = 0.001
"""Least scatter of dots that is believed, in pitches."""

PRIOR = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.1, 0.1, 0.15])
"""Standard deviation of perspective (two) and of the lens at the corner of the frame."""

FEWEST = 20
"""Dots without which there is no lattice."""

A_U, C_U, A_V, C_V, PERSPECTIVE, LENS = (
    slice(0, 2), 2, slice(3, 5), 5, slice(6, 8), 8,
)  # fmt: skip


@dataclass
class Lattices:
    """Lattices of n frames.

    With ``p`` the offset of a pixel from the centre in half diagonals and
    ``q = p / (1 + lens |p|^2)``: ``u = (a_u q + c_u) / (1 + perspective q)``, likewise v.

    Attributes
    ----------
    parameters : (n, 9) float64 ndarray
        a_u (2), c_u, a_v (2), c_v, perspective (2), lens.
    points : (n, m, 2) float32 ndarray
        p of the dots.
    valid : (n, m) bool ndarray
        Whether there is such a dot.
    uv : (n, m, 2) float32 ndarray
        Lattice coordinates of the dots, with fractions.
    place : (n, m, 2) float32 ndarray
        The same, whole.
    sigma : (n,) float64 ndarray
        Scatter of dots about where symbols stand, in pitches an axis.
    found : (n,) bool ndarray
        Whether there is a lattice at all.
    lens : bool
        Whether the lens was unknown, so that its bend was fitted.
    """

    parameters: NDArray[np.float64]
    points: NDArray[np.float32]
    valid: NDArray[np.bool_]
    uv: NDArray[np.float32]
    place: NDArray[np.float32]
    sigma: NDArray[np.float64]
    found: NDArray[np.bool_]
    lens: bool


def fit_lattices(points: NDArray[np.float32], valid: NDArray[np.bool_], *, lens: bool) -> Lattices:
    """Lattices of the dots of n frames.

    Parameters
    ----------
    points : (n, m, 2) float32 ndarray
        Dots relative to the centre of the camera, in half diagonals of the frame.
    valid : (n, m) bool ndarray
    lens : bool
        Fit the bend of an unknown lens too.
    """
    if kernels is None:
        return fit_lattices_numpy(points, valid, lens=lens)
    n, m = valid.shape
    parameters, sigma = np.zeros((n, 9)), np.zeros(n)
    uv, place = np.zeros((n, m, 2), np.float32), np.zeros((n, m, 2), np.float32)
    found = np.zeros(n, np.bool_)
    kernels.fit_lattices(
        np.ascontiguousarray(points, np.float32),
        np.ascontiguousarray(valid, np.bool_),
        *(n, m, lens),
        np.array(RINGS),
        weights(True),
        *(SEEDS, FEWEST, *NEIGHBOURS, GATE, LOOSE, TIGHT, FIRM, BENT_FROM, OFFSET),
        *(parameters, uv, place, sigma, found),
    )
    return Lattices(parameters, points, valid, uv, place, sigma, found, lens)


def fit_lattices_numpy(
    points: NDArray[np.float32], valid: NDArray[np.bool_], *, lens: bool
) -> Lattices:
    """:func:`fit_lattices` without the compiled kernel."""
    parameters, found = _seed(points, valid)
    for ring in RINGS:
        uv, z = _project(parameters, points)
        place = np.rint(uv)
        rest = uv - place
        use = valid & (np.abs(rest) < GATE).all(axis=2)
        if np.isfinite(ring):
            use &= (place * place).sum(axis=2) < ring * ring
        _step(parameters, z, uv, -rest, use, LOOSE, lens=lens and ring > BENT_FROM)
    for _ in range(2):
        uv, z = _project(parameters, points)
        place = np.rint(uv)
        miss = uv - place - displacement(uv - place)
        use = valid & (np.abs(miss) < TIGHT).all(axis=2)
        _step(parameters, z, uv, -miss, use, FIRM, lens=lens)
    uv, _ = _project(parameters, points)
    shift = np.rint(parameters[:, [C_U, C_V]])
    parameters[:, :3] -= shift[:, :1] * _unit(parameters)
    parameters[:, 3:6] -= shift[:, 1:] * _unit(parameters)
    uv -= shift[:, None]
    place = np.rint(uv)
    rest = uv - place
    miss = rest - displacement(rest)
    use = valid & (np.abs(miss) < TIGHT).all(axis=2)
    count = use.sum(axis=1)
    square = (miss * miss).sum(axis=2)
    sigma = np.sqrt((square * use).sum(axis=1) / np.maximum(2 * count - 8, 1))
    found = found & (count >= FEWEST) & np.isfinite(parameters).all(axis=1)
    return Lattices(parameters, points, valid, uv, place, sigma.astype(float), found, lens)


def _unit(parameters: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 3) what a shift of u by one adds to (a_u, c_u): ``u + 1 = (... + g q + 1) / ...``."""
    unit = np.ones((len(parameters), 3))
    unit[:, :2] = parameters[:, PERSPECTIVE]
    return unit


def displacement(rest: NDArray[np.float32]) -> NDArray[np.float32]:
    """(..., 2) where, about its place, the symbol stands that is nearest to ``rest``."""
    along_x = np.abs(rest[..., 0]) > np.abs(rest[..., 1])
    result = np.zeros_like(rest)
    result[..., 0] = np.where(along_x, np.copysign(OFFSET, rest[..., 0]), 0)
    result[..., 1] = np.where(along_x, 0, np.copysign(OFFSET, rest[..., 1]))
    return result


def _seed(
    points: NDArray[np.float32], valid: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Pitch, direction and shift of the lattice in the middle of each frame."""
    n, m = valid.shape
    square = np.where(valid, (points * points).sum(axis=2), np.inf)
    if m > SEEDS:
        nearest = np.argpartition(square, SEEDS, axis=1)[:, :SEEDS]
        middle = np.take_along_axis(points, nearest[:, :, None], axis=1)
        there = np.take_along_axis(valid, nearest, axis=1)
    else:
        middle, there = points, valid
    x, y = middle[..., 0], middle[..., 1]
    dx, dy = x[:, :, None] - x[:, None], y[:, :, None] - y[:, None]
    square = dx * dx + dy * dy
    np.einsum("nii->ni", square)[:] = np.inf
    square[~(there[:, :, None] & there[:, None])] = np.inf

    # A dot has four neighbours at a pitch, more or less: take the median of the third.
    third = np.partition(square, min(2, square.shape[2] - 1), axis=2)[
        :, :, min(2, square.shape[2] - 1)
    ]
    third = np.where(there, third, np.nan)
    found = there.sum(axis=1) >= FEWEST
    third[~found] = 1.0
    pitch_square = np.nanmedian(third, axis=1)[:, None, None]

    # Neighbours lie in four directions, which the fourth power turns into one.
    low, high = NEIGHBOURS
    near = (square > low * pitch_square) & (square < high * pitch_square)
    inverse = near / np.where(near, square, 1)
    real = (dx * dx - dy * dy) * inverse
    imaginary = 2 * dx * dy * inverse
    angle = 0.25 * np.arctan2(
        (2 * real * imaginary).sum(axis=(1, 2)), (real**2 - imaginary**2).sum(axis=(1, 2))
    )
    c, s = np.cos(angle), np.sin(angle)
    along = np.maximum(
        np.abs(c[:, None, None] * dx + s[:, None, None] * dy),
        np.abs(c[:, None, None] * dy - s[:, None, None] * dx),
    )
    pairs = near.sum(axis=(1, 2))
    found &= pairs > 0
    pitch = np.where(found, (along * near).sum(axis=(1, 2)) / np.maximum(pairs, 1), 1.0)

    parameters = np.zeros((n, 9))
    parameters[:, 0], parameters[:, 1] = c / pitch, s / pitch
    parameters[:, 3], parameters[:, 4] = -s / pitch, c / pitch
    uv, _ = _project(parameters, middle)
    phase = (np.exp(2j * np.pi * uv) * there[..., None]).sum(axis=1)
    parameters[:, [C_U, C_V]] = -np.angle(phase) / (2 * np.pi)
    return parameters, found


def _project(
    parameters: NDArray[np.float64], points: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Lattice coordinates (n, m, 2), and (n, m, 4): q, |p|^2 / (1 + lens |p|^2), 1 / (1 + g q)."""
    t = parameters.astype(np.float32)
    square = (points * points).sum(axis=2)
    bend = 1 / (1 + t[:, LENS, None] * square)
    z = np.empty((*square.shape, 4), np.float32)
    np.multiply(points, bend[..., None], out=z[..., :2])
    np.multiply(square, bend, out=z[..., 2])
    q = z[..., :2]
    np.divide(1, 1 + (q @ t[:, PERSPECTIVE, None])[..., 0], out=z[..., 3])
    linear = q @ np.stack([t[:, A_U], t[:, A_V]], axis=2) + t[:, None, [C_U, C_V]]
    return linear * z[..., 3:], z


def _step(
    parameters: NDArray[np.float64],
    z: NDArray[np.float32],
    uv: NDArray[np.float32],
    wanted: NDArray[np.float32],
    use: NDArray[np.bool_],
    sigma: float | NDArray[np.float64],
    *,
    lens: bool,
) -> NDArray[np.float64]:
    """One Gauss-Newton step, in place; the (n, 9, 9) normal matrix in units of ``sigma``."""
    normal, right = normal_equations(parameters, z, uv, wanted, use, lens=lens)
    add_prior(normal, right, parameters, sigma, lens=lens)
    parameters += np.linalg.solve(normal, right[..., None])[..., 0]
    return normal


def refit(
    lattices: Lattices, miss: NDArray[np.float32], use: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Parameters (n, 9) once the dots in ``use`` are moved back by ``miss``; covariance (n, 9, 9).

    The scatter of the dots is taken from what they miss by, at least :data:`FINEST`.
    """
    parameters = lattices.parameters.copy()
    uv, z = _project(parameters, lattices.points)
    count = use.sum(axis=1)
    square = ((miss * miss).sum(axis=2) * use).sum(axis=1, dtype=np.float64)
    variance = np.maximum(square / np.maximum(2 * count - 8, 1), FINEST**2)
    normal = _step(parameters, z, uv, -miss, use, np.sqrt(variance), lens=lattices.lens)
    return parameters, np.linalg.inv(normal) * variance[:, None, None]


def slope_at_centre(parameters: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 2, 2) derivative of (u, v) by p at the centre of the camera."""
    rows = []
    for a, c in ((A_U, C_U), (A_V, C_V)):
        rows.append(parameters[:, a] - parameters[:, c, None] * parameters[:, PERSPECTIVE])
    return np.stack(rows, axis=1)


def normal_equations(
    parameters: NDArray[np.float64],
    z: NDArray[np.float32],
    uv: NDArray[np.float32],
    wanted: NDArray[np.float32],
    use: NDArray[np.bool_],
    *,
    lens: bool,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(n, 9, 9) and (n, 9): ``J^T J`` and ``J^T wanted`` over the dots in ``use``."""
    n, m = use.shape
    t = parameters.astype(np.float32)
    q, over = z[..., :2], z[..., 3] * use
    # Columns that u and v share up to a factor: q, 1, then those of perspective and lens.
    table = np.zeros((2, n, m, 7), np.float32)
    table[..., :2] = q * over[..., None]
    table[..., 2] = over
    for axis, a in enumerate((A_U, A_V)):
        value = uv[..., axis]
        table[axis, ..., 3:5] = -value[..., None] * table[axis, ..., :2]
        if lens:
            slope = (q @ t[:, a, None])[..., 0] - value * (q @ t[:, PERSPECTIVE, None])[..., 0]
            table[axis, ..., 5] = -slope * z[..., 2] * over
        table[axis, ..., 6] = wanted[..., axis] * use
    gram = (table.transpose(0, 1, 3, 2) @ table).astype(np.float64)
    normal = np.zeros((n, 9, 9))
    right = np.zeros((n, 9))
    for axis, rows in enumerate((slice(0, 3), slice(3, 6))):
        normal[:, rows, rows] = gram[axis, :, :3, :3]
        normal[:, rows, 6:] = gram[axis, :, :3, 3:6]
        normal[:, 6:, rows] = gram[axis, :, 3:6, :3]
        right[:, rows] = gram[axis, :, :3, 6]
    normal[:, 6:, 6:] = gram[0, :, 3:6, 3:6] + gram[1, :, 3:6, 3:6]
    right[:, 6:] = gram[0, :, 3:6, 6] + gram[1, :, 3:6, 6]
    return normal, right


def weights(lens: bool) -> NDArray[np.float64]:
    """(9,) inverse variance of each parameter; a known lens bends nothing."""
    weight = np.zeros(9)
    weight[6:] = PRIOR[6:] ** -2.0
    if not lens:
        weight[LENS] = 1e12
    return weight


def add_prior(
    normal: NDArray[np.float64],
    right: NDArray[np.float64],
    parameters: NDArray[np.float64],
    sigma: float | NDArray[np.float64],
    *,
    lens: bool,
) -> None:
    """Add what is known of perspective and lens to normal equations in units of ``sigma``."""
    weight = weights(lens) * np.square(np.asarray(sigma, float))[..., None]
    np.einsum("nii->ni", normal)[:] += weight + 1e-9
    right -= weight * parameters
