"""Scene solving as published, for comparison.

Alvarado-Marin et al., "Lighthouse Localization of Miniature Wireless Robots", IEEE RA-L 2024
(DOI 10.1109/LRA.2024.3405345), section III: base stations are ideal pinhole cameras, scenes are
estimated by OpenCV's homography and fundamental matrix, and nothing is refined. Equation numbers
are the paper's.

The paper's image axes are x right, y up, and z ahead, a left-handed frame; image points are at
z = 1. Solving in it is consistent, and the results are converted to station axes (x forward,
y left, z up) at the end.

Departures from the printed text, which docs/lighthouse.md lists with their effects: the image
points have one factor 1/cos(theta) instead of two (:func:`paper_image_points`), Eq. 4 is a
difference, Eq. 8 has the factor that makes its matrix a rotation by the right angle, and the
solution among the candidates of Eq. 5 to 10 is selected automatically by the paper's own
conditions, not by hand as in the authors' scripts (DotBots/alvarado23lighthouse).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.geometry import Similarity, rotation_exp, umeyama
from locatk.core.lighthouse.calibration import IDEAL_CALIBRATION
from locatk.core.lighthouse.channels import period_counts
from locatk.core.lighthouse.epochs import Epochs, rotor_angles
from locatk.core.lighthouse.light_planes import angles_to_counts
from locatk.core.lighthouse.localization.photodiodes import detect_stations, split_by_device
from locatk.core.lighthouse.results import LighthouseFacts
from locatk.core.lighthouse.scene import Scene, Station
from locatk.core.lighthouse.scene.estimation import require_two_stations, select_stations
from locatk.core.lighthouse.scene.frame import MIN_MARKERS, marker_angles, scale_from_distances
from locatk.core.lighthouse.scene.keyframes import require_distinct_positions
from locatk.core.lighthouse.scene.reframing import rotation_between
from locatk.core.solution import Solution, SolverWarning

Array = NDArray[np.float64]

TO_STATION = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""(3, 3) matrix from the paper's image axes to station axes."""


@dataclass(frozen=True)
class PaperScene:
    """Scene solved by the paper's method.

    Attributes
    ----------
    locate : callable
        Function from image points (m, s, 2) to positions (m, 3), ``nan`` if a point is missing.
    stations : tuple of ((3,) ndarray, (3, 3) ndarray)
        Position and rotation (station to scene) of each station, in the axes of the first one.
        Empty for one station, whose pose the paper does not estimate.
    to_floor : Similarity
        Transform to the default frame of a planar scene of two stations: the plane is z = 0, the
        first station is above the origin, and its view is along x. Else the identity.
    """

    locate: Callable[[Array], Array]
    stations: tuple[tuple[Array, Array], ...]
    to_floor: Similarity = field(default_factory=Similarity.identity)


def paper_image_points(
    counts: NDArray[np.float64], channel: NDArray[np.int32] | int
) -> NDArray[np.float64]:
    """Return the image points of pairs of sweeps for an ideal station.

    Parameters
    ----------
    counts : (..., 2) ndarray
        LFSR indices of the first and second sweep.
    channel : int or (...) ndarray
        1 to 16.

    Returns
    -------
    (..., 2) ndarray
        x right and y up at distance 1 ahead.

    Notes
    -----
    Eq. 1 and 3 with one factor 1/cos(theta). As printed, Eq. 3 multiplies by it once more
    although tan(phi) of Eq. 1 contains it already. The authors' released analysis scripts have
    one factor, as here; the released DotBot firmware has none. Ideal planes meet in a ray through
    this point only with one.
    """
    revolutions = np.asarray(counts) / np.asarray(period_counts(channel))[..., None]
    first, second = np.moveaxis(2 * np.pi * revolutions, -1, 0)
    theta = (first + second) / 2
    phi_term = np.sin((second - first) / 2 - np.pi / 3) / np.tan(np.pi / 6)
    return np.stack([-np.tan(theta), -phi_term / np.cos(theta)], axis=-1)


def one_planar(markers: Array, image: Array) -> PaperScene:
    """Solve a planar scene of one station by a homography from image to floor (III.A).

    Parameters
    ----------
    markers : (k, 2) ndarray
        Positions on the floor in metres; at least four, no three on one line.
    image : (k, 2) ndarray
        Image points of the markers.

    Raises
    ------
    DegenerateError
        The markers do not determine a homography.
    """
    import cv2

    if len(markers) < 4:
        raise DegenerateError(
            f"{len(markers)} observed markers do not determine the floor",
            hint="one station needs four markers, no three of them on one line",
        )
    homography, _ = cv2.findHomography(image, markers)
    if homography is None:
        raise DegenerateError("the markers are on one line", hint="spread them over the floor")

    def locate(points: Array) -> Array:
        homogeneous = np.c_[points[:, 0], np.ones(len(points))] @ homography.T
        return np.c_[homogeneous[:, :2] / homogeneous[:, 2:], np.zeros(len(points))]

    return PaperScene(locate, ())


def two_planar(image: Array) -> PaperScene:
    """Solve a planar scene of two stations by decomposing the homography of their images (III.B).

    Parameters
    ----------
    image : (m, 2, 2) ndarray
        Image points of both stations. Positions are computed from those of the first (Eq. 11).

    Raises
    ------
    DegenerateError
        The points do not determine a homography.
    """
    import cv2

    homography, _ = cv2.findHomography(image[:, 0], image[:, 1], cv2.LMEDS)
    if homography is None:
        raise DegenerateError("no homography relates the two images")
    u, s, vt = np.linalg.svd(homography)
    v1, _, v3 = vt
    s1, s3 = s[0] / s[1], s[2] / s[1]
    # Eq. 4 is printed as a quotient; the authors' code has the difference.
    zeta = s1 - s3
    a, b = _unit(np.sqrt(max(1 - s3**2, 0)), np.sqrt(max(s1**2 - 1, 0)))  # Eq. 6
    # Eq. 8 is printed as d = a b.
    c, d = _unit(1 + s1 * s3, a * b * (s1**2 - s3**2))
    e, f = _unit(-b / s1, -a / s3)  # Eq. 10
    candidates = []
    for sign in (1.0, -1.0):
        normal = b * v1 - sign * a * v3  # Eq. 5
        middle = np.array([[c, 0, sign * d], [0, 1, 0], [-sign * d, 0, c]])
        rotation = (u @ middle @ vt) * np.sign(np.linalg.det(u @ vt))  # Eq. 7
        position = e * v1 + sign * f * v3  # Eq. 9
        candidates.append((normal, rotation, position))
    normal, rotation, position = _select_candidate(candidates, image, zeta)

    def locate(points: Array) -> Array:
        return _intersect_plane(points[:, 0], normal, zeta) @ TO_STATION.T

    second = (TO_STATION @ position, TO_STATION @ rotation.T @ TO_STATION.T)
    to_floor = _to_floor(-TO_STATION @ normal, 1 / zeta)
    return PaperScene(locate, ((np.zeros(3), np.eye(3)), second), to_floor)


def _to_floor(up: Array, height: float) -> Similarity:
    """Return the transform to a plane with normal ``up``, ``height`` below the first station."""
    level = rotation_between(up, np.array([0.0, 0.0, 1.0]))
    heading = float(np.arctan2(level[1, 0], level[0, 0]))
    rotation = rotation_exp([0.0, 0.0, -heading]) @ level
    return Similarity(1.0, rotation, np.array([0.0, 0.0, height]))


def _intersect_plane(image: Array, normal: Array, zeta: float) -> Array:
    """Intersect rays of the first station with the plane (Eq. 11), in its image axes."""
    ray = np.c_[image, np.ones(len(image))]
    positions: Array = ray / (zeta * (ray @ normal))[:, None]
    return positions


def _select_candidate(
    candidates: list[tuple[Array, Array, Array]], image: Array, zeta: float
) -> tuple[Array, Array, Array]:
    """Select the (normal, rotation, position) that meets the paper's conditions.

    The plane is ahead of both cameras, and below cameras that are mounted upright: y is up in
    the image, so that the normal that points away from a camera points down in both views.
    """
    ray = np.c_[image[:, 0], np.ones(len(image))]
    ranked = []
    for normal, rotation, position in candidates:
        sign = 1.0 if np.median(ray @ normal) > 0 else -1.0
        normal, position = sign * normal, sign * position
        in_second = (_intersect_plane(image[:, 0], normal, zeta) - position) @ rotation.T
        is_behind = np.mean(in_second[:, 2] <= 0) > 0.5
        upward = normal[1] + (rotation @ normal)[1]
        ranked.append((bool(is_behind), float(upward), (normal, rotation, position)))
    return min(ranked, key=lambda candidate: candidate[:2])[2]


def two_3d(image: Array) -> PaperScene:
    """Solve a scene in space of two stations by the fundamental matrix (III.C).

    The essential matrix is decomposed with OpenCV's cheirality check, and positions are
    triangulated by the direct linear transform.

    Parameters
    ----------
    image : (m, 2, 2) ndarray
        Image points of both stations.

    Raises
    ------
    DegenerateError
        The points do not determine a fundamental matrix.
    """
    import cv2

    first, second = np.ascontiguousarray(image[:, 0]), np.ascontiguousarray(image[:, 1])
    fundamental, inliers = cv2.findFundamentalMat(first, second, cv2.FM_LMEDS)
    if fundamental is None or fundamental.shape != (3, 3):
        raise DegenerateError(
            "no fundamental matrix relates the two images",
            hint="record at least 8 positions that are not on one plane",
        )
    _, rotation, translation, _ = cv2.recoverPose(
        fundamental, first, second, np.eye(3), mask=inliers
    )
    first_projection = np.hstack([np.eye(3), np.zeros((3, 1))])
    second_projection = np.hstack([rotation, translation])

    def locate(points: Array) -> Array:
        positions = np.full((len(points), 3), np.nan)
        rows = np.isfinite(points).all(axis=(1, 2))
        if np.any(rows):
            homogeneous = cv2.triangulatePoints(
                first_projection, second_projection, points[rows, 0].T, points[rows, 1].T
            )
            positions[rows] = (homogeneous[:3] / homogeneous[3]).T @ TO_STATION.T
        return positions

    return PaperScene(locate, _station_poses(rotation, translation[:, 0]))


def _station_poses(rotation: Array, translation: Array) -> tuple[tuple[Array, Array], ...]:
    """Return the poses of both stations in the axes of the first, from second = R first + t."""
    second_position = TO_STATION @ (-rotation.T @ translation)
    second_rotation = TO_STATION @ rotation.T @ TO_STATION.T
    return ((np.zeros(3), np.eye(3)), (second_position, second_rotation))


def _unit(p: float, q: float) -> tuple[float, float]:
    """Scale (p, q) to unit length."""
    length = float(np.hypot(p, q))
    return p / length, q / length


# ---- a session


def solve_published(epochs: Epochs, prior: Scene, kind: str) -> Solution:
    """Solve a session by the published method: positions without covariance.

    One station: positions on the floor, by four or more markers. Two stations: the scale is from
    markers or a distance, else the distance of the stations is 1.

    Parameters
    ----------
    epochs : Epochs
        At least one.
    prior : Scene
        Without stations; its markers and distances are used.
    kind : str
        ``"one-planar"``, ``"two-planar"`` or ``"two-3d"``; ``"two-auto"`` is taken as planar.

    Raises
    ------
    DegenerateError
        The recording does not determine the scene.
    """
    warnings = []
    if kind == "two-auto":
        kind = "two-planar"
        warnings.append(
            SolverWarning(
                "plane_assumed",
                "the published method cannot decide whether a scene is planar: planar is assumed",
            )
        )
    is_planar = kind != "two-3d"
    if kind == "one-planar":
        columns = [0]
    else:
        require_two_stations(kind, epochs)
        columns = [0, 1]
    rejected = Counter(epochs.rejected)
    epochs, left_out = select_stations(epochs, columns, "other_station")
    angles = rotor_angles(epochs)
    image = image_points(epochs, angles)
    is_complete = np.isfinite(image).all(axis=(1, 2))
    marker_points, visited = marker_angles(prior.markers, epochs, angles)
    is_visited = np.isfinite(visited).all(axis=(1, 2))
    marker_points, visited = marker_points[is_visited], image_points(epochs, visited[is_visited])

    if kind == "one-planar":
        solved = one_planar(marker_points[:, :2], visited[:, 0])
        raised = np.array([0.0, 0.0, np.mean(marker_points[:, 2])])
        to_frame, scale = Similarity(1.0, np.eye(3), raised), "markers"
    else:
        first, second = (np.insert(image[is_complete, k], 0, 1.0, axis=1) for k in (0, 1))
        require_distinct_positions(first, second, 4 if kind == "two-planar" else 8)
        solved = (two_planar if kind == "two-planar" else two_3d)(image[is_complete])
        to_frame, scale = _scene_frame(solved, marker_points, visited, prior, epochs, angles)
        if scale == "unit":
            warnings.append(
                SolverWarning("unit_scale", "unit scale: the distance of the two stations is 1")
            )
    position = np.full((len(image), 3), np.nan)
    position[is_complete] = to_frame.apply(solved.locate(image[is_complete]))
    is_accepted = np.isfinite(position).all(axis=1)
    rejected.update(left_out)
    rejected["moment_with_too_few_sweeps"] += int(np.count_nonzero(~is_accepted))
    scene = Scene(
        tuple(
            Station(
                int(channel),
                to_frame.apply(station_position),
                to_frame.rotation @ rotation,
                IDEAL_CALIBRATION,
            )
            for channel, (station_position, rotation) in zip(
                epochs.channels, solved.stations, strict=False
            )
        ),
        prior.markers,
        prior.distances,
        is_planar,
        float(np.mean(marker_points[:, 2])) if is_planar and scale == "markers" else 0.0,
        scale,
        prior.frame,
        tuple(warning.message for warning in warnings),
        frame_source="markers" if scale == "markers" else "floor" if is_planar else "station",
    )
    return Solution(
        "lighthouse",
        "paper",
        split_by_device(epochs, is_accepted, position, scene.frame),
        {reason: count for reason, count in rejected.items() if count},
        detect_stations(epochs, {s.channel: s for s in scene.stations}),
        scene,
        facts=LighthouseFacts(),
        warnings=tuple(warnings),
    )


def image_points(epochs: Epochs, angles: Array) -> Array:
    """Return the image points (m, s, 2) of the paper for rotor angles (m, s, 2)."""
    image = np.empty_like(angles)
    for i, channel in enumerate(epochs.channels):
        counts = angles_to_counts(angles[:, i], int(channel))
        image[:, i] = paper_image_points(counts, int(channel))
    return image


def _scene_frame(
    solved: PaperScene,
    marker_points: Array,
    visited: Array,
    prior: Scene,
    epochs: Epochs,
    angles: Array,
) -> tuple[Similarity, str]:
    """Return the similarity to the frame of the markers, or to the known scale, and its source."""
    if len(marker_points) >= MIN_MARKERS:
        return umeyama(solved.locate(visited), marker_points), "markers"
    unit = solved.to_floor
    if not prior.distances:
        return unit, "unit"
    scale, _ = scale_from_distances(
        lambda observed: solved.locate(image_points(epochs, observed)),
        prior.distances,
        epochs,
        angles,
    )
    return Similarity(scale, unit.rotation, scale * unit.translation), "distance"
