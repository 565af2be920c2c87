"""Pose of the camera from a decoded window.

Once a window is decoded, the symbol of every dot is known and with it the dot's true position. The
lattice is fitted once more to the dots at these positions, and the pose and its covariance follow
from the fit. (Hostettler et al. 2016, II-B.8, use one corner of the decoded window instead.)

Near hands, ink and reflections some dots are displaced. Those beyond a gate, whose width follows
from the median residual of the frame, are not used. They show that others within the gate are
displaced as well, which no residual reveals: the covariance therefore contains them as if they were
at the gate, in directions of their own and all together. Neighbours that are displaced alike count
as fewer dots: the correlation of their residuals widens the covariance.

The model of an unknown lens has at most three radial coefficients. Strong lenses displace dots near
the corners further, but only towards the centre or away from it, which hardly moves a pose (the
radial alignment constraint, Tsai 1987). In frames that show more than the first coefficient, the
covariance therefore follows from the components of the residuals across this direction.

In tilted frames the image of a disc is displaced from the image of its centre. To second order of
its radius r, in pitches, the displacement on the paper is r^2 times the slope of the logarithm of
the inverse depth, the same for all dots, so that the residuals do not show it either.
"""

from __future__ import annotations

import math
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
    PERSPECTIVE,
    SYMBOL_GATE_PITCHES,
    DotLattices,
    add_prior,
    prior_weights,
    project_lattices,
    second_lens_columns,
    slope_at_centre,
    sum_equations,
)
from locatk.core.dots.identification.decoding import DecodedWindows
from locatk.core.dots.identification.phase_voting import kernel_tables
from locatk.core.dots.sheet import DOT_OFFSET_PITCHES
from locatk.core.kernels import kernels

Array = NDArray[np.float64]

MAX_REFIT_STEPS = 8
"""Maximum number of Gauss-Newton steps after decoding, each with its own inliers. Sharp frames need
three until no dot changes its side of the gate, strongly bent ones more."""

HIGHER_LENS_SIGMA = 0.15
"""Prior standard deviation of the second and the third radial coefficient at the corner of the
frame, as that of the first."""

MIN_HIGHER_LENS_SIGMAS = 5.0
"""Least first estimate of the second radial coefficient, in its standard deviations; below it, the
first coefficient suffices."""

MIN_DISTINCTION = 1e-6
"""Least part of the third coefficient's effect that is not one of the second; below it, single
precision does not distinguish them."""

INLIER_GATE_SIGMAS = 3.0
"""Radius of the gate of a dot's residual, in standard deviations of an axis; 1.1 % of Gaussian
residuals are beyond it (chi-square with two degrees of freedom)."""

GATED_VARIANCE_RATIO = 1 - 0.5 * INLIER_GATE_SIGMAS**2 / math.expm1(0.5 * INLIER_GATE_SIGMAS**2)
"""Variance of Gaussian residuals within the gate, relative to that of all."""

FITTED_PARAMETERS = 8
"""Number of parameters of a homography, by which residuals have fewer degrees of freedom than
coordinates; the priors determine the lens as much as the dots do."""

NEIGHBOUR_STEPS = ((0, 1), (1, -1), (1, 0), (1, 1))
"""Steps from a grid position to one half of its eight neighbours; it is one of the other half of
theirs."""

SQUARED_DOT_RADIUS = 0.0174
SQUARED_DOT_RADIUS_SIGMA = 0.007
"""Mean and standard deviation of the squared radius of printed dots [squared pitches], if widths
from 1/6 (nominal) to 0.35 pitches (with dot gain) are equally likely."""

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
        *(n, m, half, lattices.lens, prior_weights(True), decoded),
        *kernel_tables(codec),
        *(SECTION_LENGTH, MIN_SHIFT, DOT_OFFSET_PITCHES, SYMBOL_GATE_PITCHES, MIN_SIGMA_PITCHES),
        *(MAX_REFIT_STEPS, FITTED_PARAMETERS, HIGHER_LENS_SIGMA, MIN_HIGHER_LENS_SIGMAS**2),
        *(INLIER_GATE_SIGMAS, GATED_VARIANCE_RATIO),
        *(SQUARED_DOT_RADIUS, SQUARED_DOT_RADIUS_SIGMA),
        *(lattices.parameters.copy(), pose, covariance),
    )
    return GridPoses(pose[:, :2], pose[:, 2], covariance)


def localize_windows_numpy(
    lattices: DotLattices, half: int, windows: DecodedWindows, codec: Codec
) -> GridPoses:
    """Estimate poses as :func:`localize_windows`, without the compiled kernel."""
    fit = _fit_robustly(lattices, half, windows, codec)
    parameters = fit.lattices.parameters
    rotation = IMAGE_TO_PRINT[windows.rotation]
    corner = PRINTED_CORNERS[windows.rotation] * (2 * half - 1)
    slope = slope_at_centre(parameters)
    depth_slope = _depth_slope(slope, parameters[:, PERSPECTIVE])
    centre = parameters[:, [C_U, C_V]] + half + SQUARED_DOT_RADIUS * depth_slope
    right = np.einsum("nij,nj->ni", rotation, slope[:, :, 0])
    covariance = _pose_covariance(fit.covariance, slope, rotation)
    spread = SQUARED_DOT_RADIUS_SIGMA * np.einsum("nij,nj->ni", rotation, depth_slope)
    covariance[:, :2, :2] += spread[:, :, None] * spread[:, None]
    origin = np.stack([windows.x, windows.y], axis=1)
    return GridPoses(
        grid=np.einsum("nij,nj->ni", rotation, centre) + corner + origin,
        heading=np.arctan2(-right[:, 1], right[:, 0]),
        covariance=covariance,
    )


def _depth_slope(slope: Array, perspective: Array) -> Array:
    """Return the slope (n, 2) of the logarithm of the inverse depth on the paper, per pitch."""
    (uu, uv), (vu, vv) = slope.transpose(1, 2, 0)
    first, second = perspective.T
    with np.errstate(invalid="ignore", divide="ignore"):
        area = uu * vv - uv * vu
        solved = [first * vv - second * vu, second * uu - first * uv]
        result: Array = np.stack(solved, axis=1) / area[:, None]
    return result


@dataclass(frozen=True)
class _RobustFit:
    """Lattices fitted to decoded dots, and the covariance (n, 9, 9) of their parameters."""

    lattices: DotLattices
    covariance: Array


def _fit_robustly(
    lattices: DotLattices, half: int, windows: DecodedWindows, codec: Codec
) -> _RobustFit:
    """Fit lattices to the dots of decoded windows within the gate of each frame.

    If the lens is unknown, higher radial coefficients are fitted to the frames that show them.
    """
    n = len(lattices.parameters)
    squared_radius = (lattices.points.astype(np.float64) ** 2).sum(axis=2)
    bend, is_bent = np.zeros((n, 2)), np.full(n, lattices.lens)
    fitted, previous = lattices, np.zeros_like(lattices.valid)
    for _ in range(MAX_REFIT_STEPS):
        current = fitted
        dots = assign_dots(current, half, windows, codec)
        squared = (dots.residual * dots.residual).sum(axis=2)
        variance = np.maximum(_median_variance(squared, dots.used), MIN_SIGMA_PITCHES**2)
        is_inlier = dots.used & (squared < (INLIER_GATE_SIGMAS**2 * variance)[:, None])
        normal, right = sum_equations(current, dots.residual, is_inlier)
        add_prior(normal, right, current.parameters, np.sqrt(variance), lens=lattices.lens)
        inverse = np.linalg.inv(normal)
        step = np.einsum("nij,nj->ni", inverse, right)
        if is_bent.any():
            columns = _higher_lens_columns(current) * is_inlier[:, None, :, None]
            cross = np.stack(
                [sum_equations(current, -columns[:, term], is_inlier)[1] for term in (0, 1)],
                axis=2,
            )
            coupling = inverse @ cross
            columns = columns.astype(np.float64)
            prior = variance * HIGHER_LENS_SIGMA**-2.0
            weight = np.einsum("nsma,ntma->nst", columns, columns)
            weight += prior[:, None, None] * np.eye(2) - cross.transpose(0, 2, 1) @ coupling
            gain = -np.einsum("ntma,nma->nt", columns, dots.residual) - prior[:, None] * bend
            gain -= np.einsum("nit,ni->nt", cross, step)
            if current is lattices:
                threshold = MIN_HIGHER_LENS_SIGMAS**2 * variance
                is_bent = is_bent & (gain[:, 0] ** 2 > threshold * weight[:, 0, 0])
            solution = _invert_pairs(weight) * is_bent[:, None, None]
            change = np.einsum("nst,nt->ns", solution, gain)
            bend = bend + change
            step -= np.einsum("nit,nt->ni", coupling, change)
            inverse += coupling @ solution @ coupling.transpose(0, 2, 1)
        factor = 1 + squared_radius**2 * (bend[:, :1] + bend[:, 1:] * squared_radius)
        fitted = project_lattices(
            lattices, current.parameters + step, lattices.points * factor[..., None]
        )
        if (is_inlier == previous).all():
            break
        previous = is_inlier
    residual = dots.residual
    if is_bent.any():
        across = _across_lens(current, residual)
        residual = np.where(is_bent[:, None, None], across, residual)
        squared = (residual * residual).sum(axis=2)
    # Across the displacement by the lens, residuals have half of their degrees of freedom.
    dimensions_ratio = np.where(is_bent, 2.0, 1.0)
    squares = dimensions_ratio * (squared * is_inlier).sum(axis=1, dtype=np.float64)
    degrees = np.maximum(2 * is_inlier.sum(axis=1) - FITTED_PARAMETERS, 1)
    inlier_variance = np.maximum(squares / (GATED_VARIANCE_RATIO * degrees), MIN_SIGMA_PITCHES**2)
    correlation = _neighbour_correlation(
        current, half, residual, is_inlier, inlier_variance / dimensions_ratio
    )
    inlier_variance *= 1 + np.maximum(correlation, 0)
    # Outliers count as if at the gate: in directions of their own, and all together.
    gate = INLIER_GATE_SIGMAS * np.sqrt(variance)
    is_outlier = dots.used & ~is_inlier & (squared >= (gate * gate)[:, None])
    clipped = residual * (gate[:, None] / np.sqrt(np.maximum(squared, 1e-12)))[..., None]
    outlier_normal, outlier_sum = sum_equations(current, clipped.astype(np.float32), is_outlier)
    hidden = 0.5 * (gate * gate)[:, None, None] * outlier_normal
    hidden += outlier_sum[:, :, None] * outlier_sum[:, None]
    covariance = inlier_variance[:, None, None] * inverse + inverse @ hidden @ inverse
    return _RobustFit(fitted, covariance)


def _higher_lens_columns(lattices: DotLattices) -> NDArray[np.float32]:
    """Return the derivatives (n, 2, m, 2) by the second and the third radial coefficient."""
    second = second_lens_columns(lattices)
    squared_radius = (lattices.points * lattices.points).sum(axis=2)
    return np.stack([second, second * squared_radius[..., None]], axis=1)


def _invert_pairs(weight: Array) -> Array:
    """Invert symmetric matrices (n, 2, 2); only their first element if they are nearly singular."""
    product = weight[:, 0, 0] * weight[:, 1, 1]
    area = product - weight[:, 1, 0] ** 2
    is_distinct = area > MIN_DISTINCTION * product
    divisor = np.where(is_distinct, area, 1)
    result = np.zeros_like(weight)
    result[:, 0, 0] = np.where(is_distinct, weight[:, 1, 1] / divisor, 1 / weight[:, 0, 0])
    result[:, 1, 1] = np.where(is_distinct, weight[:, 0, 0] / divisor, 0)
    result[:, 0, 1] = result[:, 1, 0] = np.where(is_distinct, -weight[:, 1, 0] / divisor, 0)
    return result


def _across_lens(lattices: DotLattices, residual: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return residuals (n, m, 2) without their component along the displacement by the lens."""
    along = second_lens_columns(lattices)
    squared = np.maximum((along * along).sum(axis=2), np.float32(1e-30))
    ratio = (residual * along).sum(axis=2) / squared
    result: NDArray[np.float32] = residual - ratio[..., None] * along
    return result


def _neighbour_correlation(
    lattices: DotLattices,
    half: int,
    residual: NDArray[np.float32],
    used: NDArray[np.bool_],
    variance: Array,
) -> Array:
    """Return the sum (n,) of the correlations of a dot's error with those of its eight neighbours.

    A sum of n such errors has 1 plus this times the variance of independent ones. Residuals have
    negative correlations even if the errors are independent, because the fit takes a part of each
    that its neighbours share: parameters / n of their variance on average, added again here.
    """
    n = len(used)
    cells = np.zeros((n, 2 * half + 3, 2 * half + 3, 3))
    frame, dot = np.nonzero(used)
    column, row = lattices.nodes[frame, dot].astype(np.int64).T + half + 1
    values = np.concatenate([residual[frame, dot], np.ones((len(frame), 1))], axis=1)
    np.add.at(cells, (frame, row, column), values)
    sums = np.zeros((n, 3))
    middle = cells[:, 1:-1, 1:-1]
    for down, right in NEIGHBOUR_STEPS:
        neighbours = cells[:, 1 + down : 2 * half + 2 + down, 1 + right : 2 * half + 2 + right]
        sums += (middle * neighbours).sum(axis=(1, 2))
    count = np.maximum(used.sum(axis=1), 1)
    result: Array = (sums[:, 0] + sums[:, 1]) / (count * variance)
    result += FITTED_PARAMETERS * sums[:, 2] / count**2
    return result


def _median_variance(squared: NDArray[np.float32], used: NDArray[np.bool_]) -> Array:
    """Return the variance (n,) of dots per axis from the median of their squared residuals."""
    count = used.sum(axis=1)
    ordered = np.sort(np.where(used, squared, np.float32(np.inf)), axis=1)
    middle = np.take_along_axis(ordered, np.maximum(count - 1, 0)[:, None] // 2, axis=1)[:, 0]
    middle = np.where(count > 0, middle, 0).astype(np.float64)
    degrees = 2 * count / np.maximum(2 * count - FITTED_PARAMETERS, 1)
    result: Array = middle / (2 * math.log(2)) * degrees
    return result


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
