"""Pose of a device with several photodiodes under one station, without a guess.

Photodiodes of which both planes are known have a ray; rays and places give candidates
(Perspective-n-Point, by OpenCV: SQPnP of Terzakis and Lourakis 2020 for all of them, IPPE of
Collins and Bartoli 2014 for photodiodes on a plane, which has two readings, and three-point
poses, which need not believe them all). All are then refined on the observed angles of all
photodiodes, also those with one plane only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.calibration import Calibration, ideal_angles
from locatk.core.lighthouse.devices.pose_fit import (
    DeviceStates,
    PoseFit,
    SweepObservations,
    fit_poses,
)
from locatk.core.lighthouse.light_planes import rays
from locatk.core.lighthouse.noise import ANGLE_SIGMA_RAD
from locatk.core.lighthouse.receiver import Receiver

Array = NDArray[np.float64]

CAMERA = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""From a station's axes (x forward, y left, z up) to a camera's (x right, y down, z forward)."""

FLAT = 1e-3
"""Thickness of a device over its extent below which its photodiodes are on one plane."""

LOSS_SCALE_RAD = 3e-3
"""Residual in radians from which on an angle counts less: reflections are far beyond it."""

TRIPLES = 12
"""Sets of three photodiodes tried besides all together: with a third of the rays wrong, one
in 28 times none is clean."""

SAME_TURN = 0.02
SAME_PLACE = 0.01
"""Refined poses nearer than this (rad, and parts of the distance) are one."""

LIT_FROM_BEHIND = -0.1
"""Cosine between a photodiode's normal and the light below which it cannot have seen it;
covers and edges let a little light around."""


@dataclass(frozen=True)
class PoseCandidate:
    """One pose that explains what a device saw of a station.

    Attributes
    ----------
    position : (3,) ndarray
        Of the device in the station's axes, in metres.
    rotation : (3, 3) ndarray
        Device to station.
    cost : float
        Half the robust sum of squares, for angles of standard deviation ``ANGLE_SIGMA_RAD``.
    residual : (k, 2) ndarray
        Predicted minus observed angles in radians; ``nan`` where not seen.
    from_behind : float
        Share of the sweeps that came from behind their photodiodes; 0 without normals.
    covariance : (6, 6) ndarray
        Of position and rotation vector in the station's axes, for angles of ``ANGLE_SIGMA_RAD``.
    """

    position: Array
    rotation: Array
    cost: float
    residual: Array
    from_behind: float
    covariance: Array


def locate_device(
    angles: Array, receiver: Receiver, calibration: Calibration
) -> list[PoseCandidate]:
    """DeviceStates of a device from what it saw of one station at one time.

    Parameters
    ----------
    angles : (k, 2) ndarray
        Observed rotor angles of each photodiode in radians; ``nan`` where not seen.
    receiver : Receiver
        With k photodiodes.
    calibration : Calibration
        Of the station.

    Returns
    -------
    list of PoseCandidate
        Distinct minima, the best first: light from the front before light from behind, then
        by cost. A flat device far away has two of nearly the same cost. Empty where fewer
        than three photodiodes have both planes.
    """
    starts = candidates(angles, receiver, calibration)
    if not starts:
        return []
    looks = _looks(angles, receiver, len(starts))
    stations = (np.zeros((1, 3)), np.eye(3)[None], (calibration,))
    start = DeviceStates.at_rest(np.stack([s[0] for s in starts]), np.stack([s[1] for s in starts]))
    found = fit_poses(
        looks, stations, start, sigma=ANGLE_SIGMA_RAD, soft=LOSS_SCALE_RAD, rates=False
    )
    # Reflections pulled while nothing was known of the rest; now the rest tells its spread.
    spread = 1.4826 * np.median(np.abs(found.residual), axis=1)
    soft = np.clip(3 * spread, 3 * ANGLE_SIGMA_RAD, LOSS_SCALE_RAD)
    found = fit_poses(looks, stations, found.poses, sigma=ANGLE_SIGMA_RAD, soft=soft, rates=False)
    readings = [_reading(found, i, angles, receiver) for i in range(len(starts))]
    return _distinct(readings)


def candidates(
    angles: Array, receiver: Receiver, calibration: Calibration, *, triples: bool = True
) -> list[tuple[Array, Array]]:
    """Rough poses, device to station, from the photodiodes with both planes.

    Parameters and axes as for :func:`locate_device`; without ``triples`` all rays are
    believed. Empty where fewer than three photodiodes have both planes.
    """
    import cv2

    full = np.flatnonzero(np.isfinite(angles).all(axis=1))
    if len(full) < 3:
        return []
    ray = rays(ideal_angles(angles[full], calibration), calibration.tilts)
    known = np.isfinite(ray).all(axis=1) & (np.abs(ray) < 20).all(axis=1)
    full, ray = full[known], ray[known]
    seen = (ray @ CAMERA.T)[:, :2].copy()
    place = receiver.position_m[full]
    starts: list[tuple[Array, Array]] = []

    def propose(rows: NDArray[np.int64], method: int) -> None:
        try:
            _, turns, shifts, _ = cv2.solvePnPGeneric(
                place[rows], seen[rows], np.eye(3), np.zeros(5), flags=method
            )
        except cv2.error:
            return  # a degenerate set, as three on a line; others do
        for turn, shift in zip(turns, shifts, strict=True):
            # In front of the station only.
            if np.all(np.isfinite(turn)) and np.all(np.isfinite(shift)) and shift[2, 0] > 0:
                rotation = cv2.Rodrigues(turn)[0]
                starts.append((CAMERA.T @ shift[:, 0], CAMERA.T @ rotation))

    everything = np.arange(len(full))
    if len(full) >= 4:
        spread = np.linalg.svd(place - place.mean(axis=0), compute_uv=False)
        if spread[1] <= FLAT * spread[0]:
            return []  # on a line: it can turn about itself
        if spread[2] <= FLAT * spread[0]:
            propose(everything, cv2.SOLVEPNP_IPPE)
        propose(everything, cv2.SOLVEPNP_SQPNP)
    rng = np.random.default_rng(0)
    trials = 1 if len(full) == 3 else TRIPLES if triples else 0
    for _ in range(trials):
        rows = np.sort(rng.choice(len(full), 3, replace=False))
        propose(rows, cv2.SOLVEPNP_P3P)
    return starts


def _looks(angles: Array, receiver: Receiver, copies: int) -> SweepObservations:
    """All seen angles as one moment, ``copies`` times."""
    sensor, plane = np.nonzero(np.isfinite(angles))
    one = SweepObservations(
        receiver.position_m[sensor][None],
        np.zeros((1, len(sensor)), np.int64),
        plane[None],
        angles[sensor, plane][None],
        np.zeros((1, len(sensor))),
        np.ones((1, len(sensor)), bool),
    )
    return one.take(np.zeros(copies, np.int64))


def _reading(found: PoseFit, row: int, angles: Array, receiver: Receiver) -> PoseCandidate:
    residual = np.full(angles.shape, np.nan)
    residual[np.isfinite(angles)] = found.residual[row]
    position, rotation = found.poses.position[row], found.poses.rotation[row]
    behind = 0.0
    if receiver.normal is not None:
        sensor = np.nonzero(np.isfinite(angles))[0]
        place = position + receiver.position_m[sensor] @ rotation.T
        behind = float(np.mean(lit_from_behind(place, receiver.normal[sensor] @ rotation.T)))
    covariance = np.asarray(
        np.linalg.pinv(found.information[row, :6, :6], hermitian=True), np.float64
    )
    return PoseCandidate(position, rotation, float(found.cost[row]), residual, behind, covariance)


def lit_from_behind(away: Array, normal: Array) -> NDArray[np.bool_]:
    """Whether light cannot have reached photodiodes: ``away`` (..., 3) from the station to
    them and their normals (..., 3), in the same axes."""
    cosine = -np.sum(away * normal, axis=-1) / np.maximum(np.linalg.norm(away, axis=-1), 1e-12)
    return np.asarray(cosine < LIT_FROM_BEHIND)


def _distinct(readings: list[PoseCandidate]) -> list[PoseCandidate]:
    kept: list[PoseCandidate] = []
    for reading in sorted(readings, key=lambda r: r.cost):
        away = float(np.linalg.norm(reading.position))
        if not np.isfinite(reading.cost) or reading.position[0] <= 0:
            continue
        if all(
            np.linalg.norm(reading.position - k.position) > SAME_PLACE * away
            or np.trace(reading.rotation.T @ k.rotation) < 1 + 2 * np.cos(SAME_TURN)
            for k in kept
        ):
            kept.append(reading)
    return sorted(kept, key=lambda r: (round(r.from_behind, 1) > 0.3, r.cost))
