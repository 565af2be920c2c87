"""Two-view initialization: the relative pose of two stations from photodiodes that both received.

A station receives a photodiode along a ray (1, y, z), like a camera. Two relations are fitted
between the rays of two stations: a homography, which holds if all photodiodes are on one plane,
and an essential matrix, which holds if they are not (Hartley and Zisserman, Multiple View
Geometry, 2nd ed., chapters 9 and 13). Each is decomposed into candidate arrangements, which are
refined by bundle adjustment and compared. The scale is arbitrary.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.lighthouse.calibration import Calibration
from locatk.core.lighthouse.results import TwoViewCandidate
from locatk.core.lighthouse.scene.bundle_adjustment import (
    BundleAdjustment,
    BundleState,
    adjust_bundle,
)
from locatk.core.lighthouse.scene.gravity import MAX_UP_CHI2, MIN_UP_CHI2_GAP, up_chi2
from locatk.core.lighthouse.scene.keyframes import (
    MIN_RAY_SEPARATION_RAD,
    require_distinct_positions,
)
from locatk.core.robust import consensus

Array = NDArray[np.float64]
MarkerMisfit = Callable[[BundleState, tuple[int, int]], float]
"""Rms misfit in metres of the markers in the state of two stations, given with their columns."""

INLIER_GATE_TAN = 0.01
"""Largest residual of a correct correspondence, as a tangent: the error of a calibration plus the
motion of a robot between the sweeps of two stations (5 mm at 0.5 m/s and 2 m distance are
2.5e-3)."""

EPIPOLAR_TRIALS = 150
"""Random samples for an epipolar matrix: with three quarters of inliers, samples of eight are free
of outliers with a probability of 0.1 each, so that 150 all fail with 1e-7."""

MAX_CANDIDATE_KEYFRAMES = 300
"""Number of keyframes with which candidate arrangements are compared."""

MAX_CANDIDATE_ITERATIONS = 60
"""Iterations within which a correct candidate converges (on simulated and published scenes)."""

MIN_EARLY_STOP_KEYFRAMES = 60
EARLY_STOP_RMS_RAD = 1.5e-4
"""With at least so many keyframes, and an rms residual at the noise of a receiver at a standstill
(1.15e-4 rad), a candidate in space is accepted without trying the others."""

MIN_BASELINE_RATIO = 0.02
"""Smallest distance of two stations relative to their distance from the plane of the robots."""

MAX_PLANE_RESIDUAL_TAN = 3e-3
"""Largest median residual of the homography of a planar scene, as a tangent."""

MAX_PLANE_RESIDUAL_RATIO = 0.03
"""The same relative to the spread of the rays: a narrow field is always nearly flat. Measured on
the published recordings: 0.007 on the floor and 0.3 on the grid in space. Photodiodes on a body of
8 cm have 0.05 (simulated)."""

CERTAIN_PLANE_FRACTION = 0.9
"""From this fraction of keyframes on one plane the scene is planar; the others are outliers."""

MIN_PLANE_TO_SPACE_RATIO = 0.7
"""Smallest number of keyframes on the plane of a planar scene, relative to those that agree with
an epipolar matrix. Simulated and published floors have 0.83 and more with a tenth of wrong sweeps,
scenes in space 0.63 and less."""

MIN_FRACTION_IN_FRONT = {"plane": 0.9, "space": 0.7}
"""Fraction of the points of a candidate that are in front of both stations, at least. Noise moves
distant points in space behind a station, but not points on a plane."""

MAX_DEPTH_BASELINES = 100.0
"""Largest depth of a triangulated point, in baselines; beyond, its rays are parallel to noise."""

MAX_COST_RATIO = 2.0
"""Candidates whose cost is at most so many times the lowest explain the angles equally well."""

MAX_MARKER_MISFIT_RATIO = 0.5
"""Markers decide between two candidates if one misfits them at most so much as the other."""

MIN_KEYFRAMES_ON_PLANE = 4
MIN_KEYFRAMES_IN_SPACE = 8
MIN_KEYFRAMES_UNDECIDED = 5
"""Distinct positions that determine a homography, an epipolar matrix, and which of them holds: a
homography fits any four positions."""


@dataclass(frozen=True)
class TwoViewFacts:
    """Figures on which the arrangement of two stations was decided.

    Attributes
    ----------
    plane_fraction : float
        Fraction of the keyframes that agree with a homography.
    plane_median_rad : float
        Median residual of the homography, as a tangent.
    candidates : tuple of TwoViewCandidate or None
        Refined candidates on a plane; None in space.
    candidate_decided_by : str or None
        ``"markers"`` or ``"gravity"`` if these chose the candidate.
    """

    plane_fraction: float
    plane_median_rad: float
    candidates: tuple[TwoViewCandidate, ...] | None = None
    candidate_decided_by: str | None = None


@dataclass(frozen=True)
class StationPair:
    """Two stations with common keyframes, in a frame and unit of their own.

    Attributes
    ----------
    columns : (int, int)
        Columns of the stations.
    adjustment : BundleAdjustment
        Bundle adjustment of both over some of the keyframes. In a planar scene z = 0 is the plane
        of the photodiodes and z is up.
    inliers : (k,) int ndarray
        Indices of the keyframes that agree with the arrangement.
    planar : bool
    facts : TwoViewFacts
    """

    columns: tuple[int, int]
    adjustment: BundleAdjustment
    inliers: NDArray[np.int64]
    planar: bool
    facts: TwoViewFacts

    @property
    def state(self) -> BundleState:
        """Both stations, in the order of ``columns``."""
        return self.adjustment.state

    @property
    def relative_sigma(self) -> float:
        """Standard deviation of the positions of the stations, relative to their distance."""
        variance = np.trace(self.adjustment.station_covariance[:, :3, :3], axis1=1, axis2=2)
        baseline = np.linalg.norm(self.state.positions[1] - self.state.positions[0])
        return float(np.sqrt(max(float(np.sum(variance)), 0.0)) / max(float(baseline), 1e-12))


def estimate_station_pair(
    angles: Array,
    rays: Array,
    calibrations: tuple[Calibration, ...],
    columns: tuple[int, int],
    *,
    sigma: float,
    planar: bool | None = None,
    marker_misfit: MarkerMisfit | None = None,
    ups: Array | None = None,
    seed: int = 0,
) -> StationPair:
    """Estimate the relative pose of two stations from their common keyframes.

    Parameters
    ----------
    angles : (m, s, 2) ndarray
        Observed rotor angles of all stations in radians, ``nan`` without a sweep.
    rays : (m, s, 3) ndarray
        Directions (1, y, z) of these angles.
    calibrations : tuple of Calibration
        One per station.
    columns : (int, int)
        Columns of the two stations.
    sigma, planar, marker_misfit, ups, seed
        As for :func:`~locatk.core.lighthouse.scene.estimation.estimate_stations`.

    Raises
    ------
    DegenerateError
        The common keyframes do not determine the stations.
    """
    i, j = columns
    common = np.flatnonzero(np.isfinite(rays[:, i, 0]) & np.isfinite(rays[:, j, 0]))
    a, b = rays[common, i], rays[common, j]
    require_distinct_positions(
        a, b, MIN_KEYFRAMES_UNDECIDED if planar is None else _min_keyframes(planar)
    )

    homography, is_on_plane = estimate_homography(a, b, seed)
    plane_fraction = float(np.mean(is_on_plane))
    plane_median = float(np.median(homography_residuals(homography, a, b)))
    if planar is None:
        planar = is_plane_like(a, b, plane_median)
        planar = planar and not _fits_space_better(a, b, plane_fraction, seed)
    is_inlier = is_on_plane if planar else _spatial_inliers(a, b, seed)
    a, b = a[is_inlier], b[is_inlier]
    require_distinct_positions(a, b, _min_keyframes(planar))
    if not planar:
        _require_volume(a, b)
    _require_baseline(a, b)

    pair_calibrations = (calibrations[i], calibrations[j])
    list_candidates = planar_candidates if planar else spatial_candidates
    candidates = list_candidates(a, b, pair_calibrations)
    if not candidates:
        raise DegenerateError(
            "no arrangement of two stations explains the angles",
            hint="check that the channels of the stations are those of the recording",
        )
    inliers = common[is_inlier]
    best, tried, decided_by = _choose_candidate(
        angles[inliers][:, [i, j]],
        candidates,
        planar,
        sigma,
        marker_misfit,
        (i, j),
        None if ups is None else ups[[i, j]],
    )
    facts = TwoViewFacts(plane_fraction, plane_median, tried if planar else None, decided_by)
    return StationPair((i, j), best, inliers, planar, facts)


# ---- homography and epipolar matrix


def fit_homography(a: Array, b: Array) -> Array:
    """Fit homographies with b ~ H a by direct linear transform.

    ``a`` and ``b`` are (..., n, 3) rays or homogeneous points, n >= 4; returns (..., 3, 3).
    Normal equations serve hundreds of samples at a time, degenerate ones included;
    :func:`locatk.core.geometry.fit_homography` fits one set to rounding, or raises an error.
    The points are normalized by the centroid and size of each set (Hartley 1997).
    """
    a, from_a = _normalize(a)
    b, from_b = _normalize(b)
    return np.linalg.inv(from_b) @ fit_projection(a, b) @ from_a


def fit_projection(points: Array, rays: Array) -> Array:
    """Fit projections (..., 3, d) with rays ~ P points by direct linear transform.

    ``points`` (..., n, d) are homogeneous, ``rays`` (..., n, 3) with x = 1 in front
    (Hartley and Zisserman, sections 4.1 and 7.1). The points are not normalized.
    """
    zero = np.zeros_like(points)
    rows = np.concatenate(
        [
            np.concatenate([-rays[..., 1:2] * points, rays[..., 0:1] * points, zero], axis=-1),
            np.concatenate([-rays[..., 2:3] * points, zero, rays[..., 0:1] * points], axis=-1),
        ],
        axis=-2,
    )
    return _null_vector(rows).reshape(*rows.shape[:-2], 3, points.shape[-1])


def homography_residuals(h: Array, a: Array, b: Array) -> Array:
    """Return the (..., n) distances of H a from b in the image plane at x = 1, as tangents."""
    mapped = a @ np.swapaxes(h, -1, -2)
    with np.errstate(divide="ignore", invalid="ignore"):
        mapped = mapped[..., 1:] / mapped[..., :1]
        return np.linalg.norm(mapped - (b / b[..., :1])[..., 1:], axis=-1)


def fit_epipolar(a: Array, b: Array) -> Array:
    """Fit matrices with b E a = 0 by the normalized eight-point method.

    ``a`` and ``b`` are (..., n, 3) rays, n >= 8; returns (..., 3, 3). The result is not forced
    to be essential, because that makes the fit worse in a narrow field;
    :func:`decompose_essential` takes the nearest essential matrix.
    """
    a, from_a = _normalize(a)
    b, from_b = _normalize(b)
    rows = (b[..., :, None] * a[..., None, :]).reshape(*a.shape[:-1], 9)
    matrix = _null_vector(rows).reshape(*rows.shape[:-2], 3, 3)
    return np.swapaxes(from_b, -1, -2) @ matrix @ from_a


def epipolar_residuals(e: Array, a: Array, b: Array) -> Array:
    """Return (..., n) Sampson distances, as tangents (Hartley and Zisserman, Eq. 11.9)."""
    line_b = a @ np.swapaxes(e, -1, -2)
    line_a = b @ e
    algebraic = np.sum(b * line_b, axis=-1)
    slope = np.sum(line_b[..., 1:] ** 2, axis=-1) + np.sum(line_a[..., 1:] ** 2, axis=-1)
    return algebraic / np.sqrt(slope + 1e-300)


def _normalize(points: Array) -> tuple[Array, Array]:
    """Shift and scale points (..., n, 3) to unit spread; returns them and the (..., 3, 3) map."""
    points = points / points[..., :1]
    mean = points[..., 1:].mean(axis=-2)
    size = np.sqrt(np.mean((points[..., 1:] - mean[..., None, :]) ** 2, axis=(-1, -2)))
    scale = 1.0 / np.maximum(size, 1e-12)
    transform = np.zeros((*points.shape[:-2], 3, 3))
    transform[..., 0, 0] = 1.0
    transform[..., 1:, 0] = -mean * scale[..., None]
    transform[..., 1, 1] = transform[..., 2, 2] = scale
    return points @ np.swapaxes(transform, -1, -2), transform


def _null_vector(rows: Array) -> Array:
    """Return the unit vectors (..., k) with the smallest norm of rows (..., n, k) times vector."""
    normal = np.swapaxes(rows, -1, -2) @ rows
    return np.linalg.eigh(normal)[1][..., 0]


def estimate_homography(a: Array, b: Array, seed: int = 0) -> tuple[Array, NDArray[np.bool_]]:
    """Estimate a homography by RANSAC; returns it and its (n,) inliers."""
    return consensus(
        fit_homography, homography_residuals, a, b, sample_size=4, gate=INLIER_GATE_TAN, seed=seed
    )


def estimate_epipolar(a: Array, b: Array, seed: int = 0) -> tuple[Array, NDArray[np.bool_]]:
    """Estimate an epipolar matrix by RANSAC; returns it and its (n,) inliers."""
    return consensus(
        fit_epipolar,
        epipolar_residuals,
        a,
        b,
        sample_size=8,
        gate=INLIER_GATE_TAN,
        trials=EPIPOLAR_TRIALS,
        seed=seed,
    )


def decompose_homography(h: Array) -> list[tuple[Array, Array, Array]]:
    """Decompose a homography between two calibrated views into motions.

    Returns
    -------
    list of (rotation, translation, normal)
        b = R a + t for points with normal . a = 1; the four of Ma, Soatto, Kosecka and
        Sastry, An Invitation to 3-D Vision, section 5.3.3 (Eq. 5 to 10 of the Lighthouse paper
        are two of them). Empty if both stations have the same position.
    """
    h = h / np.linalg.svd(h)[1][1]
    if np.linalg.det(h) < 0:
        h = -h
    values, vectors = np.linalg.eigh(h.T @ h)
    s3, _, s1 = values
    if s1 - s3 < 1e-9:
        return []
    v3, v2, v1 = vectors.T
    p, q = np.sqrt(max(1 - s3, 0.0)) * v1, np.sqrt(max(s1 - 1, 0.0)) * v3
    motions = []
    for u in (p + q, p - q):
        u = u / np.sqrt(s1 - s3)
        normal = np.cross(v2, u)
        before = np.stack([v2, u, normal], axis=1)
        after = np.stack([h @ v2, h @ u, np.cross(h @ v2, h @ u)], axis=1)
        rotation = after @ before.T
        translation = (h - rotation) @ normal
        motions += [(rotation, translation, normal), (rotation, -translation, -normal)]
    return motions


def decompose_essential(e: Array) -> list[tuple[Array, Array]]:
    """Decompose the essential matrix nearest to ``e`` into its four motions.

    Returns
    -------
    list of (rotation, translation)
        b = R a + t (Hartley and Zisserman, Result 9.19); translations have unit length.
    """
    u, _, vt = np.linalg.svd(e)
    u *= np.sign(np.linalg.det(u))
    vt *= np.sign(np.linalg.det(vt))
    w = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return [(u @ middle @ vt, sign * u[:, 2]) for middle in (w, w.T) for sign in (1.0, -1.0)]


def upright_motions(
    a: Array, b: Array, headings: int = 36, best: int = 3
) -> list[tuple[Array, Array]]:
    """Return the most likely motions between two upright and level stations.

    For each heading the translation follows linearly, as the direction most nearly normal to all
    b x R a. Real stations lean, so that these motions only serve as initial guesses.
    """
    heading = np.linspace(0, 2 * np.pi, headings, endpoint=False)
    cos, sin = np.cos(heading), np.sin(heading)
    rotation = np.zeros((headings, 3, 3))
    rotation[:, 0, 0] = rotation[:, 1, 1] = cos
    rotation[:, 0, 1], rotation[:, 1, 0] = -sin, sin
    rotation[:, 2, 2] = 1.0
    normals = np.cross(b, a @ np.swapaxes(rotation, -1, -2))
    values, vectors = np.linalg.eigh(np.swapaxes(normals, -1, -2) @ normals)
    chosen = np.argsort(values[:, 0] / values[:, 1])[:best]
    return [(rotation[k], sign * vectors[k, :, 0]) for k in chosen for sign in (1.0, -1.0)]


def triangulate(a: Array, b: Array, rotation: Array, translation: Array) -> tuple[Array, Array]:
    """Return the depths along rays ``a`` and ``b`` (n, 3) of their closest points, b = R a + t.

    Midpoint method; the depths of parallel rays are ``inf`` or very large.
    """
    rotated = a @ rotation.T
    aa, bb, ab = (np.sum(p * q, axis=-1) for p, q in ((rotated, rotated), (b, b), (rotated, b)))
    a_dot_t, b_dot_t = -rotated @ translation, -b @ translation
    with np.errstate(divide="ignore", invalid="ignore"):
        determinant = aa * bb - ab**2
        depth_a = (a_dot_t * bb - ab * b_dot_t) / determinant
        return depth_a, (ab * a_dot_t - aa * b_dot_t) / determinant


# ---- plane or space


def _min_keyframes(planar: bool) -> int:
    return MIN_KEYFRAMES_ON_PLANE if planar else MIN_KEYFRAMES_IN_SPACE


def is_plane_like(a: Array, b: Array, median_residual: float) -> bool:
    """Return whether the rays (n, 3) of two stations can be those of a plane.

    ``median_residual`` is that of their homography, as a tangent.
    """
    spread = min(float(np.std(view[:, 1:], axis=0).max()) for view in (a, b))
    return median_residual < min(MAX_PLANE_RESIDUAL_TAN, MAX_PLANE_RESIDUAL_RATIO * spread)


def _fits_space_better(a: Array, b: Array, plane_fraction: float, seed: int) -> bool:
    """Return whether many keyframes off the plane agree with an epipolar matrix.

    A few stops and the paths between them are the larger part of a short recording, and part of
    them is always near some plane.
    """
    if plane_fraction > CERTAIN_PLANE_FRACTION or len(a) < MIN_KEYFRAMES_IN_SPACE:
        return False
    _, is_inlier = estimate_epipolar(a, b, seed)
    return plane_fraction < MIN_PLANE_TO_SPACE_RATIO * float(np.mean(is_inlier))


def _spatial_inliers(a: Array, b: Array, seed: int) -> NDArray[np.bool_]:
    """Return the (n,) inliers of an epipolar matrix."""
    if len(a) < MIN_KEYFRAMES_IN_SPACE:
        raise DegenerateError(
            f"{len(a)} positions off one plane do not determine a scene in space",
            hint=f"record at least {MIN_KEYFRAMES_IN_SPACE} positions, better 20",
        )
    return estimate_epipolar(a, b, seed)[1]


def _require_volume(a: Array, b: Array) -> None:
    """Raise an error if the rays of a scene in space are those of one plane."""
    residual = homography_residuals(fit_homography(a, b), a, b)
    if np.sqrt(np.median(residual**2)) < MIN_RAY_SEPARATION_RAD / 2:
        raise DegenerateError(
            "all positions are on one plane, which does not determine a scene in space",
            hint="move the photodiode up and down as well, or use --scene two-planar",
        )


def _require_baseline(a: Array, b: Array) -> None:
    """Raise an error if two stations are at the same position.

    Their views then differ by a rotation only.
    """
    h = fit_homography(a, b)
    if np.median(homography_residuals(h, a, b)) > MAX_PLANE_RESIDUAL_TAN:
        return
    stretch = np.linalg.svd(h, compute_uv=False)
    if stretch[0] - stretch[2] < MIN_BASELINE_RATIO * stretch[1]:
        raise DegenerateError(
            "two stations are at the same position, which does not determine a scene",
            hint="move them apart, best by their distance from the robots",
        )


# ---- candidate arrangements


def planar_candidates(a: Array, b: Array, pair: tuple[Calibration, ...]) -> list[BundleState]:
    """Return the arrangements with the photodiodes at z = 0, in front of both stations."""
    candidates = []
    for rotation, translation, normal in decompose_homography(fit_homography(a, b)):
        depth = a @ normal
        local = a / depth[:, None]
        is_in_front = (depth > 0) & ((local @ rotation.T + translation)[:, 0] > 0)
        if np.mean(is_in_front) < MIN_FRACTION_IN_FRONT["plane"]:
            continue
        height = 1.0 / np.linalg.norm(normal)
        up = -normal * height
        forward = np.eye(3)[0] - up[0] * up
        forward = forward / np.linalg.norm(forward)
        level = np.stack([forward, np.cross(up, forward), up])
        first = np.array([0.0, 0.0, height])
        second = first - level @ rotation.T @ translation
        if second[2] <= 0:  # The stations would be on opposite sides of the floor.
            continue
        points = local @ level.T + first
        points[:, 2] = 0.0
        candidates.append(
            BundleState(
                np.stack([first, second]), np.stack([level, level @ rotation.T]), pair, points
            )
        )
    return candidates


def spatial_candidates(a: Array, b: Array, pair: tuple[Calibration, ...]) -> list[BundleState]:
    """Return the arrangements, in the axes of the first station, with most points in front."""
    motions = decompose_essential(fit_epipolar(a, b))
    # With few positions in a narrow field the essential matrix is inaccurate. The plane through
    # the positions is then the better initial guess.
    for rotation, translation, _ in decompose_homography(fit_homography(a, b)):
        motions.append((rotation, translation / np.linalg.norm(translation)))
    motions += upright_motions(a, b)
    candidates = []
    for rotation, translation in motions:
        depth, second_depth = triangulate(a, b, rotation, translation)
        is_in_front = (depth > 0) & (second_depth > 0) & (depth < MAX_DEPTH_BASELINES)
        if np.mean(is_in_front) < MIN_FRACTION_IN_FRONT["space"]:
            continue
        depth = np.where(is_in_front, depth, np.median(depth[is_in_front]))
        candidates.append(
            BundleState(
                np.stack([np.zeros(3), -rotation.T @ translation]),
                np.stack([np.eye(3), rotation.T]),
                pair,
                a * depth[:, None],
            )
        )
    return candidates


def _choose_candidate(
    angles: Array,
    candidates: list[BundleState],
    planar: bool,
    sigma: float,
    marker_misfit: MarkerMisfit | None,
    columns: tuple[int, int],
    ups: Array | None = None,
) -> tuple[BundleAdjustment, tuple[TwoViewCandidate, ...], str | None]:
    """Refine the candidates and choose the one that explains the angles best.

    A homography has two valid decompositions, which predict the same angles without noise. Only
    other knowledge decides between them: the markers, the accelerometers of the stations (``ups``,
    (2, 3) in their axes, ``nan`` if unknown) on a level floor, or else that stations are mounted
    upright, with little roll (the conditions of the Lighthouse paper on the signs of n and t state
    the same).

    Returns the chosen adjustment, the figures of all, and ``"markers"`` or ``"gravity"`` if these
    decided.
    """
    rows = np.unique(np.linspace(0, len(angles) - 1, MAX_CANDIDATE_KEYFRAMES).astype(int))
    refined: list[tuple[float, float, BundleAdjustment]] = []
    for state in candidates:
        subset = BundleState(
            state.positions, state.rotations, state.calibrations, state.points[rows]
        )
        # All residuals count in full: a robust loss would let a wrong candidate ignore them.
        adjustment = adjust_bundle(
            angles[rows],
            subset,
            sigma_rad=sigma,
            planar=planar,
            loss_scale_rad=1.0,
            max_iterations=MAX_CANDIDATE_ITERATIONS,
        )
        roll = _total_roll(adjustment.state.rotations) if planar else 0.0
        refined.append((adjustment.cost, roll, adjustment))
        # In space only one arrangement fits, and many keyframes do not fit to the noise by chance.
        is_exact = np.sqrt(np.nanmean(adjustment.residuals**2)) < EARLY_STOP_RMS_RAD
        is_exact &= adjustment.iterations < MAX_CANDIDATE_ITERATIONS
        if not planar and len(rows) >= MIN_EARLY_STOP_KEYFRAMES and is_exact:
            break
    max_cost = MAX_COST_RATIO * min(cost for cost, _, _ in refined) + 1e-9
    fitting = [item for item in refined if item[0] <= max_cost]
    _, _, chosen = min(fitting, key=lambda item: (item[1], item[0]))
    decided_by = None
    if planar and marker_misfit is not None and len(fitting) > 1:
        misfits = [marker_misfit(adjustment.state, columns) for _, _, adjustment in fitting]
        order = np.argsort(misfits)
        if misfits[order[0]] < MAX_MARKER_MISFIT_RATIO * misfits[order[1]]:
            chosen = fitting[int(order[0])][2]
            decided_by = "markers"
    if planar and ups is not None and len(fitting) > 1 and decided_by is None:
        directions = [
            np.einsum("kij,kj->ki", adjustment.state.rotations, ups) for _, _, adjustment in fitting
        ]
        chi2 = [up_chi2(each, np.array([0.0, 0.0, 1.0])) for each in directions]
        order = np.argsort(chi2)
        max_chi2 = MAX_UP_CHI2 * np.count_nonzero(np.isfinite(ups).all(axis=1))
        if chi2[order[0]] <= max_chi2 and chi2[order[1]] - chi2[order[0]] > MIN_UP_CHI2_GAP:
            chosen = fitting[int(order[0])][2]
            decided_by = "gravity"
    figures = tuple(
        TwoViewCandidate(
            float(cost), float(np.degrees(roll)), bool(cost <= max_cost), adjustment is chosen
        )
        for cost, roll, adjustment in refined
    )
    return chosen, figures, decided_by


def _total_roll(rotations: Array) -> float:
    """Return the root of the sum of squares of the roll angles of stations, in radians."""
    return float(np.sqrt(np.sum(np.arcsin(np.clip(rotations[:, 2, 1], -1, 1)) ** 2)))
