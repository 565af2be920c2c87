"""Lattice of the dots of a frame: a homography with a radial term, from the dots alone.

A *lattice* is the grid of the pattern except for a shift by whole positions and for quarter turns:
``u`` points to the right of the image and ``v`` down, within 45 degrees. It is seeded from the
differences of neighbouring dots in the middle of the frame and then grown outwards ring by ring, so
that perspective and lens displace the next ring by less than half a pitch. (Hostettler et al. 2016,
II-B.2 and 3, fit one pitch and one direction to the whole frame.)

Strong tilt, strong distortion and covered middles need a thorough fit, which takes several times as
long: seeds are the two highest peaks of the spectrum (periodogram) of the dots in five patches of
the frame, which an affine distortion moves but does not weaken, and the rings are narrower. The
lattice with most dots near the offset of a symbol is kept.

Each ring takes one undamped Gauss-Newton step of nine parameters: the dots used and the grid
position that each is assigned to change from step to step, and there is no cost to descend from one
step to the next. This is why :mod:`locatk.core.least_squares`, whose steps are damped and accepted
by their cost, does not apply. The compiled kernel runs the whole fit (seed, rings, refinement) in
one call for a batch of frames: 22 us for a frame of 180 dots, where the numpy functions below, its
twin, take 380 us and the whole localization of a frame 140 us.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.sheet import DOT_OFFSET_PITCHES
from locatk.core.kernels import kernels

Array = NDArray[np.float64]

SEED_DOTS = 40
"""Number of dots in the middle of the frame from which the lattice is seeded."""

RING_RADII_PITCHES = (3.2, 6.0, 9.0, 14.0, 20.0, 28.0, 40.0, np.inf)
"""Radii up to which dots are used while the lattice grows [pitches]."""

THOROUGH_RADII_PITCHES = (
    2.5, 3.2, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0, 11.0, 12.5, 14.0, 16.0, 18.0, 20.0, 24.0, 28.0,
    34.0, 40.0, np.inf,
)  # fmt: skip
"""Radii of the rings of a thorough fit [pitches]."""

THOROUGH_PASSES = 2
"""Steps in each ring of a thorough fit."""

PATCHES = ((0.5, 0.5), (0.15, 0.15), (0.85, 0.15), (0.15, 0.85), (0.85, 0.85))
"""Middles of the patches of a thorough fit, between the tenth and the ninetieth percentile of the
dots in x and y."""

MIN_SEED_POWER = 0.2
"""Least power of both peaks of a spectrum, relative to that of a perfect grid. Dots displaced by
their symbols have 0.56. The highest of the 240 independent values of 40 random dots is beyond this
in 8 % of the cases, both peaks are in 0.6 %."""

MAX_FREQUENCY_STEPS = 23
"""Largest number of frequencies on each side of zero."""

SUFFICIENT_FRACTION = 0.5
"""Fraction of dots near the offset of a symbol from which no other patch is tried; of dots without
a lattice a quarter are."""

POSITION_GATE_PITCHES = 0.36
"""Largest distance of a dot from its grid position, per axis; the dots are displaced by 1/6."""

POSITION_SIGMA_PITCHES = 0.12
"""Standard deviation of a dot about its grid position, mainly the displacement by the code."""

NEIGHBOUR_SQUARED_PITCHES = (0.36, 1.32)
"""Least and largest squared distance of neighbours; diagonal ones begin at 1.39."""

MIN_LENS_RADIUS_PITCHES = 4.0
"""Radius of the ring beyond which the distortion of an unknown lens is fitted."""

SYMBOL_SIGMA_PITCHES = 0.03
"""Standard deviation of a dot about the offset of its symbol, before the frame's own is known."""

SYMBOL_GATE_PITCHES = 0.12
"""Largest distance of a dot from the offset of its symbol, per axis."""

MIN_SIGMA_PITCHES = 0.001
"""Least standard deviation of dots that is used for a covariance."""

PARAMETER_SIGMAS = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.1, 0.1, 0.15])
"""Prior standard deviations, at the corner of the frame, of perspective (two) and of the lens; 0
for parameters without a prior."""

KNOWN_LENS_WEIGHT = 1e12
"""Prior weight of the lens parameter if the lens is known; it keeps the parameter at zero."""

NORMAL_MATRIX_RIDGE = 1e-9
"""Added to the diagonal of the normal matrix, so that frames without dots are not singular."""

MIN_LATTICE_DOTS = 20
"""Least number of dots of a lattice."""

CHANCE_FRACTION = 4 * (2 * SYMBOL_GATE_PITCHES) ** 2
"""Fraction of random dots that are near the offset of a symbol."""

MIN_LATTICE_SIGMAS = 5.0
"""Least number of dots near symbols of a lattice, in standard deviations above those by chance; and
least deviation of their scatter below that of dots at random within the gate."""

A_U, C_U, A_V, C_V, PERSPECTIVE, LENS = (
    slice(0, 2), 2, slice(3, 5), 5, slice(6, 8), 8,
)  # fmt: skip


@dataclass
class DotLattices:
    """Lattices of n frames.

    With ``p`` the offset of a pixel from the centre in half diagonals of the frame and
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
    nodes : (n, m, 2) float32 ndarray
        The nearest whole lattice coordinates.
    sigma : (n,) float64 ndarray
        Standard deviation of the dots about the offsets of symbols, per axis, in pitches.
    fitted : (n,) bool ndarray
        Whether the frame has a lattice.
    lens : bool
        Whether the lens was unknown, so that its distortion was fitted.
    """

    parameters: Array
    points: NDArray[np.float32]
    valid: NDArray[np.bool_]
    uv: NDArray[np.float32]
    nodes: NDArray[np.float32]
    sigma: Array
    fitted: NDArray[np.bool_]
    lens: bool

    def select(self, indices: NDArray[np.int64]) -> DotLattices:
        """Return the lattices of some of the frames."""
        return DotLattices(
            self.parameters[indices],
            self.points[indices],
            self.valid[indices],
            self.uv[indices],
            self.nodes[indices],
            self.sigma[indices],
            self.fitted[indices],
            self.lens,
        )


def fit_lattices(
    points: NDArray[np.float32],
    valid: NDArray[np.bool_],
    *,
    lens: bool,
    is_thorough: bool = False,
) -> DotLattices:
    """Fit lattices to the dots of n frames.

    Parameters
    ----------
    points : (n, m, 2) float32 ndarray
        Dots relative to the centre of the camera, in half diagonals of the frame.
    valid : (n, m) bool ndarray
    lens : bool
        Fit the distortion of an unknown lens too.
    is_thorough : bool
        Take more time for frames with strong tilt or distortion or a covered middle.
    """
    if kernels is None:
        return fit_lattices_numpy(points, valid, lens=lens, is_thorough=is_thorough)
    n, m = valid.shape
    parameters, sigma = np.zeros((n, 9)), np.zeros(n)
    uv, nodes = np.zeros((n, m, 2), np.float32), np.zeros((n, m, 2), np.float32)
    fitted = np.zeros(n, np.bool_)
    kernels.fit_lattices(
        np.ascontiguousarray(points, np.float32),
        np.ascontiguousarray(valid, np.bool_),
        *(n, m, lens, is_thorough, THOROUGH_PASSES if is_thorough else 1),
        np.array(THOROUGH_RADII_PITCHES if is_thorough else RING_RADII_PITCHES),
        prior_weights(True),
        *(SEED_DOTS, MIN_LATTICE_DOTS, MIN_LATTICE_SIGMAS, *NEIGHBOUR_SQUARED_PITCHES),
        *(POSITION_GATE_PITCHES, POSITION_SIGMA_PITCHES),
        *(SYMBOL_GATE_PITCHES, SYMBOL_SIGMA_PITCHES),
        *(MIN_LENS_RADIUS_PITCHES, DOT_OFFSET_PITCHES, MIN_SEED_POWER),
        *(parameters, uv, nodes, sigma, fitted),
    )
    return DotLattices(parameters, points, valid, uv, nodes, sigma, fitted, lens)


def fit_lattices_numpy(
    points: NDArray[np.float32],
    valid: NDArray[np.bool_],
    *,
    lens: bool,
    is_thorough: bool = False,
) -> DotLattices:
    """Fit lattices as :func:`fit_lattices`, without the compiled kernel."""
    if is_thorough:
        parameters, fitted = _grow_from_patches(points, valid, lens=lens)
    else:
        parameters, fitted = _seed_lattices(points, valid)
        _grow_lattices(parameters, points, valid, RING_RADII_PITCHES, 1, lens=lens)
    uv, _ = _project(parameters, points)
    shift = np.rint(parameters[:, [C_U, C_V]])
    parameters[:, :3] -= shift[:, :1] * _unit_shift(parameters)
    parameters[:, 3:6] -= shift[:, 1:] * _unit_shift(parameters)
    uv -= shift[:, None]
    residual, used = _match_symbols(uv, valid)
    count = used.sum(axis=1)
    squares = (residual * residual).sum(axis=2)
    sigma = np.sqrt((squares * used).sum(axis=1) / np.maximum(2 * count - 8, 1))
    fitted = fitted & (count >= _least_count(valid.sum(axis=1)))
    fitted &= (sigma < _largest_sigma(count)) & np.isfinite(parameters).all(axis=1)
    return DotLattices(
        parameters, points, valid, uv, np.rint(uv), sigma.astype(float), fitted, lens
    )


def _least_count(dots: NDArray[np.int64]) -> Array:
    """Return the least numbers of dots near symbols from which frames with ``dots`` have a grid."""
    spread = np.sqrt(CHANCE_FRACTION * (1 - CHANCE_FRACTION) * dots)
    return np.maximum(CHANCE_FRACTION * dots + MIN_LATTICE_SIGMAS * spread, MIN_LATTICE_DOTS)


def _largest_sigma(count: NDArray[np.int64]) -> Array:
    """Return the scatter below which ``count`` dots are nearer to symbols than random ones.

    Of 2 n values that are uniform within a gate g, the root mean square is g / sqrt(3), with a
    relative standard deviation of sqrt(1 / 5 / (2 n)).
    """
    spread = np.sqrt(0.2 / np.maximum(2 * count, 1))
    return SYMBOL_GATE_PITCHES / math.sqrt(3) * (1 - MIN_LATTICE_SIGMAS * spread)


def _grow_lattices(
    parameters: Array,
    points: NDArray[np.float32],
    valid: NDArray[np.bool_],
    radii: tuple[float, ...],
    passes: int,
    *,
    lens: bool,
) -> None:
    """Grow lattices in place from their seeds about node (0, 0) over all dots."""
    for radius in np.repeat(radii, passes):
        uv, z = _project(parameters, points)
        nodes = np.rint(uv)
        residual = uv - nodes
        used = valid & (np.abs(residual) < POSITION_GATE_PITCHES).all(axis=2)
        if np.isfinite(radius):
            used &= (nodes * nodes).sum(axis=2) < radius * radius
        fit_lens = lens and radius > MIN_LENS_RADIUS_PITCHES
        _step(parameters, z, uv, -residual, used, POSITION_SIGMA_PITCHES, lens=fit_lens)
    for _ in range(2):
        uv, z = _project(parameters, points)
        residual, used = _match_symbols(uv, valid)
        _step(parameters, z, uv, -residual, used, SYMBOL_SIGMA_PITCHES, lens=lens)


def _match_symbols(
    uv: NDArray[np.float32], valid: NDArray[np.bool_]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return the distances (n, m, 2) of dots from their nearest symbols, and which are near."""
    offset = uv - np.rint(uv)
    residual = offset - nearest_symbol_offset(offset)
    return residual, valid & (np.abs(residual) < SYMBOL_GATE_PITCHES).all(axis=2)


def _grow_from_patches(
    points: NDArray[np.float32], valid: NDArray[np.bool_], *, lens: bool
) -> tuple[Array, NDArray[np.bool_]]:
    """Grow lattices from several patches of each frame; keep those with most dots near symbols."""
    n = len(valid)
    parameters, fitted = np.zeros((n, 9)), np.zeros(n, np.bool_)
    for frame in range(n):
        dots = points[frame, valid[frame]]
        if len(dots) < MIN_LATTICE_DOTS:
            continue
        rank = len(dots) // 10
        ordered = np.sort(dots, axis=0)
        low, high = ordered[rank], ordered[len(dots) - 1 - rank]
        most = -1
        for patch in np.array(PATCHES, np.float32):
            seed = _spectral_seed(dots, low + (high - low) * patch)
            if seed is None:
                continue
            part = np.s_[frame : frame + 1]
            candidate = seed[None]
            _grow_lattices(
                candidate,
                points[part],
                valid[part],
                THOROUGH_RADII_PITCHES,
                THOROUGH_PASSES,
                lens=lens,
            )
            _, used = _match_symbols(_project(candidate, points[part])[0], valid[part])
            count = int(used.sum())
            if count <= most or not np.isfinite(candidate).all():
                continue
            most = count
            parameters[frame], fitted[frame] = candidate[0], True
            if count > SUFFICIENT_FRACTION * len(dots):
                break
    return parameters, fitted


def _spectral_seed(dots: NDArray[np.float32], middle: NDArray[np.float32]) -> Array | None:
    """Estimate the lattice (9,) of the dots nearest to ``middle``; None if the peaks are weak.

    Node (0, 0) is at the median of the dots.
    """
    squared = ((dots - middle) ** 2).sum(axis=1)
    wanted = min(SEED_DOTS, len(dots))
    nearest = dots[squared <= np.partition(squared, wanted - 1)[wanted - 1]][:wanted]
    count = len(nearest)
    centre = np.sort(nearest, axis=0)[count // 2].astype(float)
    offset = nearest - centre
    distance = ((offset[:, None] - offset) ** 2).sum(axis=2)
    np.fill_diagonal(distance, np.inf)
    third = np.sort(np.partition(distance, 2, axis=1)[:, 2])
    pitch = math.sqrt(third[count // 2])
    if not pitch > 0:
        return None
    # Frequencies up to 1.7 per pitch, so near to each other that no peak is missed.
    largest = 1.7 / pitch
    radius = float(np.linalg.norm(offset, axis=1).max())
    half = int(min(math.ceil(largest / (0.3 / radius)), MAX_FREQUENCY_STEPS))
    frequencies = largest / half * np.arange(-half, half + 1)
    waves = np.exp(2j * np.pi * frequencies[:, None, None] * offset.T)
    power = np.abs(waves[half:, 1] @ waves[:, 0].T) ** 2 / count**2
    fx, fy = np.meshgrid(frequencies, frequencies[half:])
    size = np.hypot(fx, fy)
    is_allowed = (size >= 0.5 / pitch) & (size <= largest * (1 + 1e-9))
    peaks: list[Array] = []
    for _ in range(2):
        index = np.where(is_allowed, power, 0).argmax()
        if np.where(is_allowed, power, 0).flat[index] < MIN_SEED_POWER:
            return None
        first = np.array([fx.flat[index], fy.flat[index]])
        peaks.append(first)
        length = float(np.hypot(*first))
        with np.errstate(invalid="ignore", divide="ignore"):
            sine = np.abs(fx * first[1] - fy * first[0]) / (size * length)
        is_allowed &= (sine >= 0.6) & (size >= 0.5 * length) & (size <= 2 * length)
    if abs(peaks[0][0]) < abs(peaks[1][0]):
        peaks.reverse()
    parameters = np.zeros(9)
    for axis, peak in enumerate(peaks):
        a = -peak if peak[axis] < 0 else peak
        phasor = np.exp(2j * np.pi * (offset @ a)).sum()
        parameters[3 * axis : 3 * axis + 2] = a
        parameters[3 * axis + 2] = -np.angle(phasor) / (2 * np.pi) - a @ centre
    return parameters


def _unit_shift(parameters: Array) -> Array:
    """Return the change (n, 3) of (a_u, c_u) that increases u by one everywhere."""
    unit = np.ones((len(parameters), 3))
    unit[:, :2] = parameters[:, PERSPECTIVE]
    return unit


def nearest_symbol_offset(offset: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the nominal offset (..., 2) of the symbol nearest to an observed one, in pitches."""
    along_x = np.abs(offset[..., 0]) > np.abs(offset[..., 1])
    result = np.zeros_like(offset)
    result[..., 0] = np.where(along_x, np.copysign(DOT_OFFSET_PITCHES, offset[..., 0]), 0)
    result[..., 1] = np.where(along_x, 0, np.copysign(DOT_OFFSET_PITCHES, offset[..., 1]))
    return result


def _seed_lattices(
    points: NDArray[np.float32], valid: NDArray[np.bool_]
) -> tuple[Array, NDArray[np.bool_]]:
    """Estimate pitch, direction and shift of the lattice in the middle of each frame."""
    n, m = valid.shape
    squared = np.where(valid, (points * points).sum(axis=2), np.inf)
    if m > SEED_DOTS:
        innermost = np.argpartition(squared, SEED_DOTS, axis=1)[:, :SEED_DOTS]
        middle = np.take_along_axis(points, innermost[:, :, None], axis=1)
        exists = np.take_along_axis(valid, innermost, axis=1)
    else:
        middle, exists = points, valid
    x, y = middle[..., 0], middle[..., 1]
    dx, dy = x[:, :, None] - x[:, None], y[:, :, None] - y[:, None]
    squared = dx * dx + dy * dy
    np.einsum("nii->ni", squared)[:] = np.inf
    squared[~(exists[:, :, None] & exists[:, None])] = np.inf

    # A dot has four neighbours at about one pitch: take the median distance of the third.
    order = min(2, squared.shape[2] - 1)
    third = np.where(exists, np.partition(squared, order, axis=2)[:, :, order], np.nan)
    fitted = exists.sum(axis=1) >= MIN_LATTICE_DOTS
    third[~fitted] = 1.0
    pitch_squared = np.nanmedian(third, axis=1)[:, None, None]

    # Neighbours are in four directions, of which the fourth power makes one.
    low, high = NEIGHBOUR_SQUARED_PITCHES
    is_neighbour = (squared > low * pitch_squared) & (squared < high * pitch_squared)
    inverse = is_neighbour / np.where(is_neighbour, squared, 1)
    real = (dx * dx - dy * dy) * inverse
    imaginary = 2 * dx * dy * inverse
    angle = 0.25 * np.arctan2(
        (2 * real * imaginary).sum(axis=(1, 2)), (real**2 - imaginary**2).sum(axis=(1, 2))
    )
    c, s = np.cos(angle), np.sin(angle)
    along_axis = np.maximum(
        np.abs(c[:, None, None] * dx + s[:, None, None] * dy),
        np.abs(c[:, None, None] * dy - s[:, None, None] * dx),
    )
    pairs = is_neighbour.sum(axis=(1, 2))
    fitted &= pairs > 0
    mean_pitch = (along_axis * is_neighbour).sum(axis=(1, 2)) / np.maximum(pairs, 1)
    pitch = np.where(fitted, mean_pitch, 1.0)

    parameters = np.zeros((n, 9))
    parameters[:, 0], parameters[:, 1] = c / pitch, s / pitch
    parameters[:, 3], parameters[:, 4] = -s / pitch, c / pitch
    uv, _ = _project(parameters, middle)
    phasor = (np.exp(2j * np.pi * uv) * exists[..., None]).sum(axis=1)
    parameters[:, [C_U, C_V]] = -np.angle(phasor) / (2 * np.pi)
    return parameters, fitted


def _project(
    parameters: Array, points: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the lattice coordinates (n, m, 2) of points, and terms (n, m, 4) of the derivatives.

    The terms are q (two), |p|^2 / (1 + lens |p|^2) and 1 / (1 + perspective q).
    """
    t = parameters.astype(np.float32)
    squared = (points * points).sum(axis=2)
    scale = 1 / (1 + t[:, LENS, None] * squared)
    z = np.empty((*squared.shape, 4), np.float32)
    np.multiply(points, scale[..., None], out=z[..., :2])
    np.multiply(squared, scale, out=z[..., 2])
    q = z[..., :2]
    np.divide(1, 1 + (q @ t[:, PERSPECTIVE, None])[..., 0], out=z[..., 3])
    linear = q @ np.stack([t[:, A_U], t[:, A_V]], axis=2) + t[:, None, [C_U, C_V]]
    return linear * z[..., 3:], z


def _step(
    parameters: Array,
    z: NDArray[np.float32],
    uv: NDArray[np.float32],
    correction: NDArray[np.float32],
    used: NDArray[np.bool_],
    sigma: float | Array,
    *,
    lens: bool,
) -> Array:
    """Take a Gauss-Newton step in place; return the normal matrix (n, 9, 9) per ``sigma``."""
    normal, right = normal_equations(parameters, z, uv, correction, used, lens=lens)
    add_prior(normal, right, parameters, sigma, lens=lens)
    parameters += np.linalg.solve(normal, right[..., None])[..., 0]
    return normal


def project_lattices(lattices: DotLattices, parameters: Array, points: Array) -> DotLattices:
    """Return lattices with other parameters (n, 9) and positions of the dots (n, m, 2)."""
    positions = points.astype(np.float32)
    uv, _ = _project(parameters, positions)
    return replace(lattices, parameters=parameters, points=positions, uv=uv, nodes=np.rint(uv))


def sum_equations(
    lattices: DotLattices, residual: NDArray[np.float32], used: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """Return :func:`normal_equations` of lattices whose dots in ``used`` have these residuals."""
    uv, z = _project(lattices.parameters, lattices.points)
    return normal_equations(lattices.parameters, z, uv, -residual, used, lens=lattices.lens)


def second_lens_columns(lattices: DotLattices) -> NDArray[np.float32]:
    """Return the derivatives (n, m, 2) of lattice coordinates by a second radial coefficient.

    The coefficient c moves the points p to ``p (1 + c |p|^4)``; terms of its second order are left
    out.
    """
    uv, z = _project(lattices.parameters, lattices.points)
    t = lattices.parameters.astype(np.float32)
    q = z[..., :2]
    by_axis = q @ np.stack([t[:, A_U], t[:, A_V]], axis=2) - uv * (q @ t[:, PERSPECTIVE, None])
    squared = (lattices.points * lattices.points).sum(axis=2)
    result: NDArray[np.float32] = by_axis * (z[..., 2] * z[..., 3] * squared)[..., None]
    return result


def slope_at_centre(parameters: Array) -> Array:
    """Return the derivative (n, 2, 2) of (u, v) by p at the centre of the camera."""
    rows = []
    for a, c in ((A_U, C_U), (A_V, C_V)):
        rows.append(parameters[:, a] - parameters[:, c, None] * parameters[:, PERSPECTIVE])
    return np.stack(rows, axis=1)


def normal_equations(
    parameters: Array,
    z: NDArray[np.float32],
    uv: NDArray[np.float32],
    correction: NDArray[np.float32],
    used: NDArray[np.bool_],
    *,
    lens: bool,
) -> tuple[Array, Array]:
    """Return ``J^T J`` (n, 9, 9) and ``J^T correction`` (n, 9) over the dots in ``used``."""
    n, m = used.shape
    t = parameters.astype(np.float32)
    q, inverse_depth = z[..., :2], z[..., 3] * used
    # Columns that u and v share except for a factor: q, 1, then those of perspective and lens.
    table = np.zeros((2, n, m, 7), np.float32)
    table[..., :2] = q * inverse_depth[..., None]
    table[..., 2] = inverse_depth
    for axis, a in enumerate((A_U, A_V)):
        value = uv[..., axis]
        table[axis, ..., 3:5] = -value[..., None] * table[axis, ..., :2]
        if lens:
            slope = (q @ t[:, a, None])[..., 0] - value * (q @ t[:, PERSPECTIVE, None])[..., 0]
            table[axis, ..., 5] = -slope * z[..., 2] * inverse_depth
        table[axis, ..., 6] = correction[..., axis] * used
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


def prior_weights(lens: bool) -> Array:
    """Return the prior weight (9,) of each parameter, with an unknown or a known lens."""
    weights = np.zeros(9)
    weights[6:] = PARAMETER_SIGMAS[6:] ** -2.0
    if not lens:
        weights[LENS] = KNOWN_LENS_WEIGHT
    return weights


def add_prior(
    normal: Array, right: Array, parameters: Array, sigma: float | Array, *, lens: bool
) -> None:
    """Add the priors of perspective and lens to normal equations in units of ``sigma``."""
    weights = prior_weights(lens) * np.square(np.asarray(sigma, float))[..., None]
    np.einsum("nii->ni", normal)[:] += weights + NORMAL_MATRIX_RIDGE
    right -= weights * parameters
