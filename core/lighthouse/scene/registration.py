"""Registration of stations: on points of known position, or by the pairs they form with others.

A station is resected on points of known position: markers, or keyframes that the registered
stations locate. A station that shares keyframes only with single registered stations is placed
where the arrangements of these pairs agree. A pair gives the rotation and the direction. The
distance comes from keyframes that a third station locates, or from a second pair whose direction
intersects the first.

Stations are added one at a time, and all registered ones are refined after each, so that errors do
not accumulate along a chain.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.geometry import fit_homography as fit_checked_homography
from locatk.core.geometry import fit_plane, rotation_angle
from locatk.core.lighthouse.calibration import Calibration, ideal_angles
from locatk.core.lighthouse.localization.positions import (
    PositionEstimates,
    estimate_positions,
    intersect_planes,
)
from locatk.core.lighthouse.scene.bundle_adjustment import BundleState, adjust_bundle
from locatk.core.lighthouse.scene.keyframes import spread_evenly
from locatk.core.lighthouse.scene.two_view import (
    INLIER_GATE_TAN,
    StationPair,
    fit_homography,
    fit_projection,
    homography_residuals,
)
from locatk.core.robust import consensus

Array = NDArray[np.float64]
Pose = tuple[Array, Array]
"""Position (3,) and rotation (3, 3) from station to frame."""

PairOf = Callable[[int, int], StationPair | None]
"""Arrangement of two stations, by their columns, or None if they do not determine any."""

MIN_PLANE_POINTS = 4
MIN_SPACE_POINTS = 6
"""Points that determine the pose of a station on a plane and in space (linear solutions)."""

PROJECTION_TRIALS = 200
"""Random samples for a projection: with three quarters of inliers, a sample of six is free of
outliers with a probability of 0.18, so that 200 all fail with 1e-17."""

MIN_PLANE_CONDITION = 1e-4
"""Smallest singular value of a homography relative to its largest; below, points are on a line."""

MIN_SPREAD_RATIO = 1e-3
"""Smallest extent of points across their main direction, relative to that along it."""

FLOOR_LOSS_SCALE_TAN = 1e-3
"""Residual of a marker at which the loss of the floor homography becomes linear, as a tangent: 2 mm
at 2 m, the error of a measurement by hand."""

MIN_DISTANCE_KEYFRAMES = 3
"""Fewest keyframes that determine the distance of a pair, so that a single wrong sweep does not."""

MAX_DISTANCE_SPREAD_RATIO = 0.1
"""Largest median deviation of the distances that these keyframes give, relative to their median."""

MAX_RELATIVE_SIGMA = 0.1
"""Largest standard deviation of the position of a station, relative to its distance. A few
keyframes in a corner of its view do not determine it."""

MIN_CROSSING_ANGLE_RAD = np.deg2rad(5.0)
"""Smallest angle between the directions from two registered stations to a new one."""

MAX_ROTATION_DISAGREEMENT_RAD = np.deg2rad(5.0)
"""Largest angle between the rotations of a new station from two pairs that are combined."""

REFINEMENT_GROWTH = 1.5
"""Growth of the number of registered stations after which all are refined together. The work of all
refinements is then proportional to the number of stations, and not to its square."""

MAX_REFINEMENT_KEYFRAMES = 300
REFINEMENT_ITERATIONS = 10
REFINEMENT_GATE_TAN = 3 * INLIER_GATE_TAN
"""Size of a resection and of the bundle adjustments during the registration, and the gate of these:
wider than that of a correspondence, because newly registered stations are not accurate yet. The
accuracy saturates at
:data:`~locatk.core.lighthouse.scene.bundle_adjustment.MAX_INDEPENDENT_POINTS`."""


class StationRegistration:
    """Registered stations in one frame, to which others are added.

    Parameters
    ----------
    angles : (m, s, 2) ndarray
        Observed rotor angles of keyframes in radians, ``nan`` without a sweep.
    rays : (m, s, 3) ndarray
        Directions (1, y, z) of these angles.
    calibrations : tuple of Calibration
        One per station.
    start : StationPair
        First two stations.
    sigma : float
        Standard deviation of an angle, in radians.

    Attributes
    ----------
    registered : list of int
        Columns of the registered stations, ascending.
    positions, rotations, calibrations
        Of all s stations; meaningless for those that are not registered.
    """

    def __init__(
        self,
        angles: Array,
        rays: Array,
        calibrations: tuple[Calibration, ...],
        start: StationPair,
        sigma: float,
    ) -> None:
        self.angles, self.rays, self.sigma = angles, rays, sigma
        self.planar = start.planar
        self.is_observed = np.isfinite(rays[..., 0])
        count = len(calibrations)
        self.positions = np.full((count, 3), np.nan)
        self.rotations = np.tile(np.eye(3), (count, 1, 1))
        self.calibrations = list(calibrations)
        self.registered: list[int] = []
        # Corrected angles, and the calibrations with which they were corrected.
        self._ideal = np.empty_like(angles)
        self._ideal_calibrations: list[Calibration | None] = [None] * count
        self._set(start.columns, start.state)

    def estimate_keyframes(self) -> PositionEstimates:
        """Estimate the positions of all keyframes from the registered stations."""
        chosen = self.registered
        for k in chosen:
            if self._ideal_calibrations[k] is not self.calibrations[k]:
                self._ideal_calibrations[k] = self.calibrations[k]
                self._ideal[:, k] = ideal_angles(self.angles[:, k], self.calibrations[k])
        return intersect_planes(
            self._ideal[:, chosen],
            self.positions[chosen],
            self.rotations[chosen],
            tuple(self.calibrations[k] for k in chosen),
            floor_z=0.0 if self.planar else None,
        )

    def register_all(self, pair_of: PairOf) -> dict[int, str]:
        """Register every station that can be; returns the columns of the others, with reasons.

        The station with the most located keyframes is next, because each registered station makes
        the following ones more accurate. All are refined together when their number has grown by
        :data:`REFINEMENT_GROWTH`, and before a station is given up.
        """
        failed: dict[int, str] = {}
        refined = len(self.registered)
        while len(self.registered) + len(failed) < len(self.positions):
            estimates = self.estimate_keyframes()
            is_located = np.isfinite(estimates.position[:, 0])
            is_located &= estimates.max_residual < INLIER_GATE_TAN
            shared = {
                k: np.flatnonzero(is_located & self.is_observed[:, k])
                for k in range(len(self.positions))
                if k not in self.registered and k not in failed
            }
            index = max(shared, key=lambda k: len(shared[k]))
            station = self._resect(index, shared[index], estimates)
            if station is None and refined < len(self.registered):
                self._refine()
                refined = len(self.registered)
                continue
            if station is None:
                # Even the most keyframes are too few: register any station that pairs determine.
                by_pairs = (
                    (k, self._register_by_pairs(k, shared[k], estimates, pair_of)) for k in shared
                )
                index, station = next(((k, s) for k, s in by_pairs if s is not None), (index, None))
            if station is None:
                failed[index] = self._failure_reason(index, pair_of)
                continue
            self._set([index], station)
            # The new station may determine those that failed before.
            failed.clear()
            if len(self.registered) >= REFINEMENT_GROWTH * refined:
                self._refine()
                refined = len(self.registered)
        if refined < len(self.registered):
            self._refine()
        return failed

    def _set(self, columns: Sequence[int], state: BundleState) -> None:
        """Set stations to those of a state, in the order of ``columns``."""
        for k, index in enumerate(columns):
            self.positions[index], self.rotations[index] = state.positions[k], state.rotations[k]
            self.calibrations[index] = state.calibrations[k]
        self.registered = sorted({*self.registered, *columns})

    def _resect(
        self, index: int, rows: NDArray[np.int64], estimates: PositionEstimates
    ) -> BundleState | None:
        """Resect a station on located keyframes; None if they do not determine its pose."""
        rows = spread_evenly(self.is_observed[:, self.registered], rows, MAX_REFINEMENT_KEYFRAMES)
        points, rays = estimates.position[rows], self.rays[rows, index]
        try:
            poses: list[Pose] = (
                [resect_on_plane(points[:, :2], rays)]
                if self.planar
                else resect_in_space(points, rays)
            )
        except DegenerateError:
            return None
        adjustments = [
            adjust_bundle(
                self.angles[rows][:, [index]],
                BundleState(position[None], rotation[None], (self.calibrations[index],), points),
                sigma_rad=self.sigma,
                fixed_points=True,
            )
            for position, rotation in poses
        ]
        best = min(adjustments, key=lambda adjustment: adjustment.cost)
        distance = np.median(np.linalg.norm(points - best.state.positions[0], axis=1))
        sigma = np.sqrt(max(float(np.trace(best.station_covariance[0, :3, :3])), 0.0))
        agrees = np.nanmedian(np.abs(best.residuals)) < INLIER_GATE_TAN
        return best.state if agrees and sigma < MAX_RELATIVE_SIGMA * distance else None

    def _register_by_pairs(
        self,
        index: int,
        rows: NDArray[np.int64],
        estimates: PositionEstimates,
        pair_of: PairOf,
    ) -> BundleState | None:
        """Estimate the pose of a station from its pairs with registered ones; None if undetermined.

        On a floor pairs are not needed, because there a single station locates keyframes.
        """
        if self.planar:
            return None
        pairs = [p for k in self.registered if (p := pair_of(k, index)) is not None]
        pairs = [p for p in pairs if p.relative_sigma < MAX_RELATIVE_SIGMA]
        pairs.sort(key=lambda p: p.relative_sigma)
        views = [(pair, *self._direction(pair, index)) for pair in pairs]
        for pair, origin, rotation, direction in views:
            distance = self._distance(pair, origin, rows, estimates)
            if distance is not None:
                position = self.positions[origin] + distance * direction
                return _single_station(index, position, rotation, pair)
        for n, (pair, origin, rotation, direction) in enumerate(views):
            for _, second_origin, second_rotation, second_direction in views[n + 1 :]:
                if rotation_angle(rotation, second_rotation) > MAX_ROTATION_DISAGREEMENT_RAD:
                    continue
                crossing = intersect_lines(
                    self.positions[[origin, second_origin]],
                    np.stack([direction, second_direction]),
                )
                if crossing is not None:
                    return _single_station(index, crossing, rotation, pair)
        return None

    def _direction(self, pair: StationPair, index: int) -> tuple[int, Array, Array]:
        """Return the registered station of a pair, and the rotation and direction of the other."""
        new = pair.columns.index(index)
        origin = pair.columns[1 - new]
        state = pair.state
        to_frame = self.rotations[origin] @ state.rotations[1 - new].T
        offset = to_frame @ (state.positions[new] - state.positions[1 - new])
        return origin, to_frame @ state.rotations[new], offset / np.linalg.norm(offset)

    def _distance(
        self,
        pair: StationPair,
        origin: int,
        rows: NDArray[np.int64],
        estimates: PositionEstimates,
    ) -> float | None:
        """Estimate the distance of the stations of a pair from keyframes that others locate.

        None if these are too few or disagree.
        """
        rows = rows[self.is_observed[rows, origin] & (estimates.redundancy[rows] > 0)]
        if len(rows) < MIN_DISTANCE_KEYFRAMES:
            return None
        state = pair.state
        in_pair = estimate_positions(
            self.angles[rows][:, list(pair.columns)],
            state.positions,
            state.rotations,
            state.calibrations,
        ).position
        from_origin = in_pair - state.positions[pair.columns.index(origin)]
        distance = np.linalg.norm(estimates.position[rows] - self.positions[origin], axis=1)
        ratio = distance / np.linalg.norm(from_origin, axis=1)
        scale = consistent_median(ratio[np.isfinite(ratio)])
        if scale is None:
            return None
        return scale * float(np.linalg.norm(state.positions[1] - state.positions[0]))

    def _refine(self) -> None:
        """Adjust all registered stations together."""
        estimates = self.estimate_keyframes()
        is_good = np.isfinite(estimates.position[:, 0]) & (estimates.redundancy > 0)
        is_good &= estimates.max_residual < REFINEMENT_GATE_TAN
        rows = spread_evenly(
            self.is_observed[:, self.registered], np.flatnonzero(is_good), MAX_REFINEMENT_KEYFRAMES
        )
        if len(rows) < MIN_PLANE_POINTS:
            return
        adjustment = adjust_bundle(
            self.angles[rows][:, self.registered],
            BundleState(
                self.positions[self.registered],
                self.rotations[self.registered],
                tuple(self.calibrations[k] for k in self.registered),
                estimates.position[rows],
            ),
            sigma_rad=self.sigma,
            planar=self.planar,
            max_iterations=REFINEMENT_ITERATIONS,
        )
        self._set(self.registered, adjustment.state)

    def _failure_reason(self, index: int, pair_of: PairOf) -> str:
        """Return why a station cannot be registered, as the end of a sentence about it."""
        if not self.planar and any(pair_of(k, index) for k in self.registered):
            return (
                "shares positions with one other only, and none that two others locate, so that "
                "its distance is unknown"
            )
        is_shared = self.is_observed[:, self.registered].any(axis=1) & self.is_observed[:, index]
        if not np.any(is_shared):
            return "shares no position with the others"
        return "shares too few positions with the others"


def _single_station(index: int, position: Array, rotation: Array, pair: StationPair) -> BundleState:
    """Return a state of one station, with its calibration in a pair."""
    calibration = pair.state.calibrations[pair.columns.index(index)]
    return BundleState(position[None], rotation[None], (calibration,), np.zeros((0, 3)))


def consistent_median(ratios: Array) -> float | None:
    """Return the median of ratios (n,), or None if they are too few or disagree.

    The limits are :data:`MIN_DISTANCE_KEYFRAMES` and :data:`MAX_DISTANCE_SPREAD_RATIO`.
    """
    if len(ratios) < MIN_DISTANCE_KEYFRAMES:
        return None
    median = float(np.median(ratios))
    if np.median(np.abs(ratios - median)) > MAX_DISTANCE_SPREAD_RATIO * median:
        return None
    return median


def intersect_lines(origins: Array, directions: Array) -> Array | None:
    """Return the point closest to two half-lines.

    Parameters
    ----------
    origins : (2, 3) ndarray
    directions : (2, 3) ndarray
        Unit vectors.

    Returns
    -------
    (3,) ndarray or None
        None if the point is behind an origin, or if the lines intersect at less than
        :data:`MIN_CROSSING_ANGLE_RAD`.
    """
    angle = np.arccos(np.clip(abs(directions[0] @ directions[1]), 0.0, 1.0))
    if angle < MIN_CROSSING_ANGLE_RAD:
        return None
    projectors = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    point = np.linalg.solve(projectors.sum(axis=0), np.einsum("nij,nj->i", projectors, origins))
    if np.any(np.sum((point - origins) * directions, axis=1) <= 0):
        return None
    return np.asarray(point, float)


# ---- resection


def resect_on_plane(points: Array, rays: Array) -> Pose:
    """Estimate the pose of a station from points of the plane z = 0.

    Parameters
    ----------
    points : (n, 2) ndarray
        Known positions, n >= 4, not on one line. Outliers are rejected if n > 4.
    rays : (n, 3) ndarray
        Directions from the station to them.

    Returns
    -------
    position : (3,) ndarray
        In the unit of ``points``.
    rotation : (3, 3) ndarray
        From station to the frame of the plane.

    Raises
    ------
    DegenerateError
        Fewer than four points, or all on a line.

    Notes
    -----
    The homography from the plane to the rays has the translation and the first two columns of the
    inverse rotation as its columns (Zhang, A Flexible New Technique for Camera Calibration, 2000,
    section 2.2).
    """
    require_plane_homography(points, rays)
    homogeneous = np.c_[np.ones(len(points)), points]
    if len(points) > MIN_PLANE_POINTS:
        h, is_inlier = consensus(
            fit_homography,
            homography_residuals,
            homogeneous,
            rays,
            sample_size=4,
            gate=INLIER_GATE_TAN,
        )
        if np.count_nonzero(is_inlier) >= MIN_PLANE_POINTS:
            homogeneous = homogeneous[is_inlier]
    else:
        h = fit_homography(homogeneous, rays)
    h = h / np.mean(np.linalg.norm(h[:, 1:], axis=0))
    if np.mean(h[0] @ homogeneous.T) < 0:
        h = -h
    columns = h[:, 1:]
    rotation = _nearest_rotation(np.c_[columns, np.cross(columns[:, 0], columns[:, 1])])
    return -rotation.T @ h[:, 0], rotation.T


def resect_in_space(points: Array, rays: Array) -> list[Pose]:
    """Estimate likely poses of a station from points in space.

    Parameters
    ----------
    points : (n, 3) ndarray
        Known positions, n >= 6. Outliers are rejected.
    rays : (n, 3) ndarray

    Returns
    -------
    list of (position, rotation)
        As :func:`resect_on_plane`. One is from the direct linear transform (Hartley and Zisserman,
        Algorithm 7.1), which needs points off one plane; the other from the plane through the
        points, which needs them near it. The caller refines both and compares their costs.

    Raises
    ------
    DegenerateError
        Too few points, or all on a line.
    """
    _require_spread(points)
    centroid, size = points.mean(axis=0), points.std()
    normalized = np.c_[np.ones(len(points)), (points - centroid) / size]
    p, is_inlier = consensus(
        fit_projection,
        homography_residuals,
        normalized,
        rays,
        sample_size=6,
        gate=INLIER_GATE_TAN,
        trials=PROJECTION_TRIALS,
    )
    poses = []
    scale = np.cbrt(np.linalg.det(p[:, 1:]))
    if scale != 0:
        p = p / scale
        rotation = _nearest_rotation(p[:, 1:])
        mean_scale = np.mean(np.linalg.svd(p[:, 1:])[1])
        poses.append((centroid - size * rotation.T @ p[:, 0] / mean_scale, rotation.T))
    has_enough_inliers = np.count_nonzero(is_inlier) >= MIN_SPACE_POINTS
    plane_points = points[is_inlier] if has_enough_inliers else points
    centre, normal = fit_plane(plane_points)
    basis = np.linalg.svd(normal[None])[2]
    axes = np.stack([basis[1], np.cross(normal, basis[1]), normal], axis=1)
    position, rotation = resect_on_plane(((points - centre) @ axes)[:, :2], rays)
    poses.append((centre + axes @ position, axes @ rotation))
    return poses


def fit_floor_homography(points: Array, rays: Array) -> Array:
    """Fit the homography from the rays of a single station to floor points.

    A homography has eight unknowns, the pose of a station six. The other two absorb the remaining
    errors of tilt and phase, which improves positions that rest on a handful of markers: on
    experiment 6 of the published recordings of one station, the mean error falls from 5.8 mm with
    a pose to 3.9 mm.

    Parameters
    ----------
    points : (n, 2) ndarray
        Markers on the floor in metres, n >= 4.
    rays : (n, 3) ndarray
        Directions (1, y, z) from the station to them.

    Returns
    -------
    (3, 3) ndarray
        From rays (1, y, z) to floor points (1, x, y).

    Raises
    ------
    DegenerateError
        The markers do not determine a homography, or fewer than four of them agree.

    Notes
    -----
    Section III.A of the Lighthouse paper. Four markers: direct linear transform. More: RANSAC,
    refined by least squares of the angles with a robust loss.
    """
    require_plane_homography(points, rays)
    floor = np.c_[np.ones(len(points)), points]
    if len(points) == MIN_PLANE_POINTS:
        return _inverse_homography(fit_homography(floor, rays))
    start, is_inlier = consensus(
        fit_homography, homography_residuals, floor, rays, sample_size=4, gate=INLIER_GATE_TAN
    )
    if np.count_nonzero(is_inlier) < MIN_PLANE_POINTS:
        raise DegenerateError(
            "fewer than four markers agree with each other",
            hint="check the measured positions and the times of the visits",
        )
    # scipy.optimize is slow to import, and only sessions with five markers or more need it.
    from scipy.optimize import least_squares

    observed = rays[is_inlier]

    def residuals(entries: Array) -> Array:
        mapped = floor[is_inlier] @ np.append(entries, 1.0).reshape(3, 3).T
        return ((mapped / mapped[:, :1] - observed / observed[:, :1])[:, 1:]).ravel()

    start = start / start[2, 2] if abs(start[2, 2]) > 1e-9 else start
    refined = least_squares(
        residuals, start.ravel()[:8], loss="soft_l1", f_scale=FLOOR_LOSS_SCALE_TAN
    )
    return _inverse_homography(np.append(refined.x, 1.0).reshape(3, 3))


def _inverse_homography(h: Array) -> Array:
    inverse: Array = np.linalg.inv(h / np.linalg.norm(h))
    return inverse


def require_plane_homography(points: Array, rays: Array) -> None:
    """Raise an error if floor points (n, 2) and rays (n, 3) do not determine a homography.

    Raises
    ------
    DegenerateError
        Fewer than four points, three of four on a line, or all at the same position.
    """
    hint = "give four or more markers on the floor, no three of four on one line"
    try:
        h = fit_checked_homography(_unit_spread(points), _unit_spread(rays[:, 1:] / rays[:, :1]))
    except DegenerateError as error:
        raise DegenerateError(str(error), hint=hint) from None
    sizes = np.linalg.svd(h, compute_uv=False)
    if sizes[2] < MIN_PLANE_CONDITION * sizes[0]:
        raise DegenerateError("too many of the markers are on one line", hint=hint)


def _unit_spread(points: Array) -> Array:
    """Shift points (n, 2) to their centroid and scale them to unit spread."""
    spread = points.std() if len(points) else 0.0
    return (points - points.mean(axis=0)) / spread if spread > 0 else points


def _nearest_rotation(matrix: Array) -> Array:
    u, _, vt = np.linalg.svd(matrix)
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt


def _require_spread(points: Array) -> None:
    """Raise an error if points (n, 3) are too few for a pose, or all on a line."""
    remedy = "positions that are not on one line"
    if len(points) < MIN_SPACE_POINTS:
        raise DegenerateError(
            f"{len(points)} known points do not determine the pose of a station",
            hint=f"give at least {MIN_SPACE_POINTS} {remedy}",
        )
    sizes = np.linalg.svd(points - points.mean(axis=0))[1]
    if sizes[1] <= MIN_SPREAD_RATIO * sizes[0]:
        raise DegenerateError("the known points are on one line", hint=f"give {remedy}")
