"""The paper's scene solving as written, for comparison.

Alvarado-Marin et al., Lighthouse Localization of Miniature Wireless Robots, RA-L 2024,
section III: stations are ideal pinhole cameras, estimates are those of OpenCV, and nothing
is refined. Equation numbers are the paper's. Two departures, without which it gives no
poses: the image points of Eq. 1 and 3 have one factor 1/cos(theta), not two
(:func:`~locatk.core.lighthouse.light_planes.paper_image_points`), and the candidate of Eq. 5 to
10 is chosen by the paper's own conditions instead of by hand, as in the released scripts.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.geometry import Similarity, umeyama
from locatk.core.lighthouse.calibration import IDEAL_CALIBRATION
from locatk.core.lighthouse.epochs import Epochs, angles_of
from locatk.core.lighthouse.light_planes import angles_to_counts, paper_image_points
from locatk.core.lighthouse.localization.photodiodes import detect_stations, split_by_device
from locatk.core.lighthouse.results import LighthouseFacts
from locatk.core.lighthouse.scene import Scene, Station
from locatk.core.lighthouse.scene.estimation import require_two_stations, select_stations
from locatk.core.lighthouse.scene.frame import MIN_MARKERS, marker_angles, scale_from_distances
from locatk.core.lighthouse.scene.keyframes import require_distinct_positions
from locatk.core.solution import Solution, SolverWarning

Array = NDArray[np.float64]

# The paper's image has x to the right, y up and z ahead: a left-handed frame. Solving in it
# is consistent; its result is turned into station axes (x ahead, y left, z up) at the end.
TO_STATION = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


@dataclass(frozen=True)
class PaperScene:
    """A scene solved the paper's way.

    Attributes
    ----------
    locate : callable
        From image points (m, s, 2) to positions (m, 3), ``nan`` where not seen.
    stations : tuple of ((3,) ndarray, (3, 3) ndarray)
        Position and rotation (station to scene) of each, in the first one's axes; empty
        for one station, of which the paper finds no pose.
    """

    locate: Callable[[Array], Array]
    stations: tuple[tuple[Array, Array], ...]


def one_planar(markers: Array, seen: Array) -> PaperScene:
    """III.A: homography from image to floor through four or more markers.

    ``markers`` (k, 2) in metres, ``seen`` (k, 2) image points.
    """
    import cv2

    if len(markers) < 4:
        raise DegenerateError(
            f"{len(markers)} sighted markers do not fix a floor",
            hint="one station needs four markers, no three on one line",
        )
    h, _ = cv2.findHomography(seen, markers)
    if h is None:
        raise DegenerateError("the markers lie on one line", hint="spread them over the floor")

    def locate(image: Array) -> Array:
        moved = np.c_[image[:, 0], np.ones(len(image))] @ h.T
        return np.c_[moved[:, :2] / moved[:, 2:], np.zeros(len(image))]

    return PaperScene(locate, ())


def two_planar(image: Array) -> PaperScene:
    """III.B: homography between two images, decomposed by Eq. 4 to 10.

    ``image`` is (m, 2, 2): points of both stations. Positions come from the first
    station's image alone (Eq. 11).
    """
    import cv2

    h, _ = cv2.findHomography(image[:, 0], image[:, 1], cv2.LMEDS)
    if h is None:
        raise DegenerateError("no homography relates the two images")
    u, s, vt = np.linalg.svd(h)
    v1, _, v3 = vt
    s1, s3 = s[0] / s[1], s[2] / s[1]
    zeta = s1 - s3  # the paper's Eq. 4 prints a quotient; its code has the difference
    a, b = _unit(np.sqrt(max(1 - s3**2, 0)), np.sqrt(max(s1**2 - 1, 0)))  # Eq. 6
    c, d = _unit(1 + s1 * s3, a * b * (s1**2 - s3**2))  # Eq. 8
    e, f = _unit(-b / s1, -a / s3)  # Eq. 10
    candidates = []
    for sign in (1.0, -1.0):
        normal = b * v1 - sign * a * v3  # Eq. 5
        turn = np.array([[c, 0, sign * d], [0, 1, 0], [-sign * d, 0, c]])
        rotation = (u @ turn @ vt) * np.sign(np.linalg.det(u @ vt))  # Eq. 7
        translation = e * v1 + sign * f * v3  # Eq. 9
        candidates.append((normal, rotation, translation))
    normal, rotation, place = _real_one(candidates, image, zeta)

    def locate(points: Array) -> Array:
        return _on_plane(points[:, 0], normal, zeta) @ TO_STATION.T

    second = (TO_STATION @ place, TO_STATION @ rotation.T @ TO_STATION.T)
    return PaperScene(locate, ((np.zeros(3), np.eye(3)), second))


def _on_plane(image: Array, normal: Array, zeta: float) -> Array:
    """Eq. 11: where rays meet the plane, in the first station's image axes."""
    ray = np.c_[image, np.ones(len(image))]
    places: Array = ray / (zeta * (ray @ normal))[:, None]
    return places


def _real_one(
    candidates: list[tuple[Array, Array, Array]], image: Array, zeta: float
) -> tuple[Array, Array, Array]:
    """The candidate that the paper's conditions choose.

    The plane lies ahead of both cameras, and below cameras that stand upright: y is up in
    the image, so that the normal that leads away from a camera points down in both views.
    """
    ray = np.c_[image[:, 0], np.ones(len(image))]
    ranked = []
    for normal, rotation, place in candidates:
        sign = 1.0 if np.median(ray @ normal) > 0 else -1.0
        normal, place = sign * normal, sign * place
        seen = (_on_plane(image[:, 0], normal, zeta) - place) @ rotation.T
        behind = np.mean(seen[:, 2] <= 0) > 0.5
        down = normal[1] + (rotation @ normal)[1]
        ranked.append((bool(behind), float(down), (normal, rotation, place)))
    return min(ranked, key=lambda r: r[:2])[2]


def two_3d(image: Array) -> PaperScene:
    """III.C: fundamental matrix, essential matrix, cheirality, triangulation by DLT.

    ``image`` is (m, 2, 2): points of both stations.
    """
    import cv2

    first, second = np.ascontiguousarray(image[:, 0]), np.ascontiguousarray(image[:, 1])
    f, inliers = cv2.findFundamentalMat(first, second, cv2.FM_LMEDS)
    if f is None or f.shape != (3, 3):
        raise DegenerateError(
            "no fundamental matrix relates the two images",
            hint="record at least 8 places that are not on one plane",
        )
    _, rotation, translation, _ = cv2.recoverPose(f, first, second, np.eye(3), mask=inliers)
    ahead = np.hstack([np.eye(3), np.zeros((3, 1))])
    other = np.hstack([rotation, translation])

    def locate(points: Array) -> Array:
        places = np.full((len(points), 3), np.nan)
        seen = np.isfinite(points).all(axis=(1, 2))
        if np.any(seen):
            h = cv2.triangulatePoints(ahead, other, points[seen, 0].T, points[seen, 1].T)
            places[seen] = (h[:3] / h[3]).T @ TO_STATION.T
        return places

    return PaperScene(locate, _pair(rotation, translation[:, 0]))


def _pair(rotation: Array, translation: Array) -> tuple[tuple[Array, Array], ...]:
    """Poses of both stations in the first one's axes, from second = R first + t."""
    position = TO_STATION @ (-rotation.T @ translation)
    turned = TO_STATION @ rotation.T @ TO_STATION.T
    return ((np.zeros(3), np.eye(3)), (position, turned))


def _unit(p: float, q: float) -> tuple[float, float]:
    size = float(np.hypot(p, q))
    return p / size, q / size


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
    if kind == "one-planar":
        columns = [0]
    else:
        require_two_stations(kind, epochs)
        columns = [0, 1]
    rejected = Counter(epochs.rejected)
    epochs, left_out = select_stations(epochs, columns, "other_station")
    angles = angles_of(epochs)
    image = image_points(epochs, angles)
    is_complete = np.isfinite(image).all(axis=(1, 2))
    known, visited = marker_angles(prior.markers, epochs, angles)
    is_visited = np.isfinite(visited).all(axis=(1, 2))
    known, visited = known[is_visited], image_points(epochs, visited[is_visited])

    if kind == "one-planar":
        solved = one_planar(known[:, :2], visited[:, 0])
        to_frame, scale = Similarity.identity(), "markers"
    else:
        first, second = (np.insert(image[is_complete, k], 0, 1.0, axis=1) for k in (0, 1))
        require_distinct_positions(first, second, 4 if kind == "two-planar" else 8)
        solved = (two_planar if kind == "two-planar" else two_3d)(image[is_complete])
        to_frame, scale = _scene_frame(solved, known, visited, prior, epochs, angles)
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
        kind != "two-3d",
        0.0,
        scale,
        prior.frame,
        tuple(warning.message for warning in warnings),
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
    known: Array,
    visited: Array,
    prior: Scene,
    epochs: Epochs,
    angles: Array,
) -> tuple[Similarity, str]:
    """Return the similarity to the frame of the markers, or to the known scale, and its source."""
    if len(known) >= MIN_MARKERS:
        return umeyama(solved.locate(visited), known), "markers"
    unit = Similarity.identity()
    if not prior.distances:
        return unit, "unit"
    scale = scale_from_distances(
        lambda observed: solved.locate(image_points(epochs, observed)),
        prior.distances,
        epochs,
        angles,
    )
    return Similarity(scale, unit.rotation, unit.translation), "distance"
