"""Candidate poses of a rigid device under one base station, without an initial guess.

A photodiode with both planes has a ray. Rays and photodiode positions are an instance of the
Perspective-n-Point problem, which OpenCV solves by several methods:

- SQPnP (Terzakis and Lourakis, ECCV 2020) from all rays;
- IPPE (Collins and Bartoli, IJCV 109, 2014) from all rays of photodiodes on a plane, which returns
  both solutions of the planar ambiguity;
- P3P from random sets of three rays, some of which contain no outlier.

The candidates are rough. :func:`~locatk.core.lighthouse.devices.pose_fit.fit_poses` refines them
and also uses the photodiodes with one plane only.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.calibration import Calibration, ideal_angles
from locatk.core.lighthouse.light_planes import rays
from locatk.core.lighthouse.receiver import Receiver

Array = NDArray[np.float64]

STATION_TO_CAMERA = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""Rotation from a station's axes (x forward, y left, z up) to those of a camera (x right, y down,
z forward)."""

MIN_RELATIVE_SPREAD = 1e-3
"""Spread of the photodiodes along an axis, relative to the largest, below which they count as
coplanar or collinear."""

MAX_IMAGE_COORDINATE = 20.0
"""Maximum image coordinate of a ray at unit distance: 87 degrees off the forward axis. A corrupted
pair of angles can have a ray far beyond it."""

MINIMAL_SETS = 12
"""Number of random sets of three rays. If three of nine rays are outliers, every set contains one
of them in 4 % of the cases."""

MIN_LIGHT_COSINE = -0.1
"""Cosine between a photodiode's normal and the direction to the station below which it cannot
receive light; covers and edges scatter a little light around the edge of a photodiode."""


def candidate_poses(
    angles: Array, receiver: Receiver, calibration: Calibration, *, minimal_sets: bool = True
) -> list[tuple[Array, Array]]:
    """Estimate rough poses of a device from its rays to one station.

    Parameters
    ----------
    angles : (k, 2) ndarray
        Observed rotor angles of each photodiode in radians; ``nan`` if not received.
    receiver : Receiver
        With k photodiodes.
    calibration : Calibration
        Of the station.
    minimal_sets : bool
        Also solve random sets of three rays, for the case that some rays are outliers. Three rays
        are always solved.

    Returns
    -------
    list of ((3,) ndarray, (3, 3) ndarray)
        Positions in metres and rotations, device to station. Empty if fewer than three
        photodiodes have both planes, or if four or more are collinear.
    """
    import cv2

    sensor = np.flatnonzero(np.isfinite(angles).all(axis=1))
    if len(sensor) < 3:
        return []
    ray = rays(ideal_angles(angles[sensor], calibration), calibration.tilts)
    is_valid = np.isfinite(ray).all(axis=1) & (np.abs(ray) < MAX_IMAGE_COORDINATE).all(axis=1)
    sensor, ray = sensor[is_valid], ray[is_valid]
    if len(sensor) < 3:
        return []
    image_points = (ray @ STATION_TO_CAMERA.T)[:, :2].copy()
    sensor_positions = receiver.position_m[sensor]
    poses: list[tuple[Array, Array]] = []

    def solve(rows: NDArray[np.int64], method: int) -> None:
        points = (sensor_positions[rows], image_points[rows], np.eye(3), np.zeros(5))
        try:
            # The generic function refuses sets of three.
            if method == cv2.SOLVEPNP_P3P:
                _, rotation_vectors, translations = cv2.solveP3P(*points, flags=method)
            else:
                _, rotation_vectors, translations, _ = cv2.solvePnPGeneric(*points, flags=method)
        except cv2.error:
            return  # OpenCV refuses degenerate sets.
        for rotation_vector, translation in zip(rotation_vectors, translations, strict=True):
            is_finite = np.all(np.isfinite(rotation_vector)) and np.all(np.isfinite(translation))
            # A station emits light forward only.
            if is_finite and translation[2, 0] > 0:
                rotation = cv2.Rodrigues(rotation_vector)[0]
                poses.append(
                    (STATION_TO_CAMERA.T @ translation[:, 0], STATION_TO_CAMERA.T @ rotation)
                )

    if len(sensor) >= 4:
        centred = sensor_positions - sensor_positions.mean(axis=0)
        spread = np.linalg.svd(centred, compute_uv=False)
        if spread[1] <= MIN_RELATIVE_SPREAD * spread[0]:
            return []  # The rotation about the line of the photodiodes is not observable.
        everything = np.arange(len(sensor))
        if spread[2] <= MIN_RELATIVE_SPREAD * spread[0]:
            solve(everything, cv2.SOLVEPNP_IPPE)
        solve(everything, cv2.SOLVEPNP_SQPNP)
    rng = np.random.default_rng(0)
    trials = 1 if len(sensor) == 3 else MINIMAL_SETS if minimal_sets else 0
    for _ in range(trials):
        rows = np.sort(rng.choice(len(sensor), 3, replace=False))
        solve(rows, cv2.SOLVEPNP_P3P)
    return poses


def is_lit_from_behind(direction: Array, normal: Array) -> NDArray[np.bool_]:
    """Return whether photodiodes are lit from behind by a station.

    Parameters
    ----------
    direction : (..., 3) ndarray
        From the station to the photodiodes, of any length.
    normal : (..., 3) ndarray
        Unit normals of the photodiodes in the same axes.
    """
    length = np.maximum(np.linalg.norm(direction, axis=-1), 1e-12)
    cosine = -np.sum(direction * normal, axis=-1) / length
    return np.asarray(cosine < MIN_LIGHT_COSINE)
