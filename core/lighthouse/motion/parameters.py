"""Parameters that all sweeps of a recording share: stations, light planes, photodiodes.

A scene is never exact. Real stations differ from their factory data by up to 1 mrad in tilt and
2.5 mrad in phase, and by smooth functions of the direction that no parameter describes; the
effective positions of photodiodes differ by tenths of a millimetre from a drawing. These errors
repeat from rotation to rotation, so that they do not average out. They are parameters with a
prior here: they are estimated as far as a recording determines them, and the covariance of each
pose contains what remains.

The parameters are deviations from a start, in this order: for each station
:data:`STATION_PARAMETERS`, then for each photodiode of each device three coordinates, then for each
plane of each station the bias of its angle at each photodiode.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.geometry import rotation_exp
from locatk.core.lighthouse.calibration import (
    CURVE,
    FACTORY_LINEAR_PARAMETERS,
    GIBMAG,
    GIBPHASE,
    LINEAR_PARAMETERS,
    OGEEMAG,
    OGEEPHASE,
    PHASE,
    TILT,
    Calibration,
    predict_sweeps,
)
from locatk.core.lighthouse.scene import Scene
from locatk.core.lighthouse.scene.model import JOINT_PARAMETERS

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

DISTORTION_POWERS = ((2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))
"""Exponents of azimuth and elevation in the distortion of a plane. Constant and linear functions
are those of phase, tilt and rotation."""

DISTORTION_UNIT_RAD = 0.8
"""Azimuth and elevation at which a term of the distortion has its standard deviation."""

DISTORTION_SIGMA_RAD = 1.5e-4
"""Standard deviation of each term. With factory data, sweeps differ by 136 microradians (median)
from motion capture on public flights of a Crazyflie (bitcraze/positioning_dataset)."""

PLANE_PARAMETERS = len(LINEAR_PARAMETERS) + len(DISTORTION_POWERS)
STATION_PARAMETERS = 6 + 2 * PLANE_PARAMETERS
"""Parameters of a station: position, rotation vector in the frame, calibration of the first and of
the second plane, distortion of the first and of the second plane."""

FACTORY_SIGMA = np.zeros(len(LINEAR_PARAMETERS))
FACTORY_SIGMA[[PHASE, TILT, CURVE, GIBMAG, GIBPHASE]] = 1.5e-3, 7e-4, 0.15, 1e-4, 1e-4
FACTORY_SIGMA[[OGEEMAG, OGEEPHASE]] = 0.12
"""Standard deviations of real stations from their factory data. On public flights of a Crazyflie
(bitcraze/positioning_dataset), tilts are up to 1 mrad and phases up to 2.5 mrad beside them, and
the sign of the ogee terms cannot be told: its deviation is half a usual magnitude."""

PHOTODIODE_SIGMA_M = 4.5e-4
"""Standard deviation of each coordinate of a photodiode, for the tolerance of its board and the
point that receives light. An assumption, not a measurement. A Lighthouse deck is 30 mm by 15 mm, so
that the scale of a scene without other known distances is uncertain by 1 to 2 %."""

BIAS_SIGMA_RAD = 1.5e-4
"""Standard deviation of the bias of an angle that is particular to a photodiode and a plane: cover
and glass of a photodiode refract light differently from each side. In a public recording of a
tracker with 22 photodiodes (libsurvive, tracker-cal-attempt), residuals of 0.17 mrad repeat from
rotation to rotation, and the rest is below 0.03 mrad."""

GIVEN_POSITION_SIGMA_M, GIVEN_ROTATION_SIGMA_RAD = 0.01, 3e-3
"""Standard deviations of stations that are given without a covariance, along and about each axis:
of a geometry that was estimated from a few points."""

HELD_FACTOR = 1e6
"""Factor of the information of parameters that are held."""

FREE_SIGMA = 1.0
"""Standard deviation of the pose of an unknown station, relative to the size of the scene, and in
radians: it only bounds what no sweep determines."""


@dataclass(frozen=True)
class CommonParameters:
    """Start, prior and value of the parameters.

    Attributes
    ----------
    positions : (s, 3) ndarray
    rotations : (s, 3, 3) ndarray
    calibrations : tuple of Calibration
        Stations at the start.
    photodiodes : (p, 3) ndarray
        Photodiodes of all devices in the axes of these, at the start.
    information : (k, k) ndarray
        Inverse covariance of the prior, whose mean is the start.
    gauge : (k, g) ndarray
        Orthonormal directions that no sweep depends on; they are not estimated.
    value : (k,) ndarray
        Deviation from the start.
    """

    positions: Array
    rotations: Array
    calibrations: tuple[Calibration, ...]
    photodiodes: Array
    information: Array
    gauge: Array
    value: Array

    @property
    def stations(self) -> tuple[Array, Array, tuple[Calibration, ...]]:
        """Positions, rotations and calibrations of the stations at the current value."""
        by_station = self._by_station()
        calibrations = tuple(
            calibration.with_linear_parameters(calibration.linear_parameters() + change)
            for calibration, change in zip(
                self.calibrations, by_station[:, 6:20].reshape(-1, 2, 7), strict=True
            )
        )
        return (
            self.positions + by_station[:, :3],
            rotation_exp(by_station[:, 3:6]) @ self.rotations,
            calibrations,
        )

    @property
    def levers(self) -> Array:
        """Positions (p, 3) of the photodiodes at the current value."""
        first = len(self.positions) * STATION_PARAMETERS
        change = self.value[first : first + self.photodiodes.size]
        return np.asarray(self.photodiodes + change.reshape(-1, 3))

    def lever_columns(self, photodiode: IntArray) -> IntArray:
        """Return the indices (n, 3) of the coordinates of photodiodes (n,)."""
        first = len(self.positions) * STATION_PARAMETERS
        return np.asarray(first + 3 * photodiode[:, None] + np.arange(3))

    def bias_columns(self, station: IntArray, plane: IntArray, photodiode: IntArray) -> IntArray:
        """Return the indices (n,) of the biases of sweeps."""
        first = len(self.positions) * STATION_PARAMETERS + self.photodiodes.size
        return first + (2 * station + plane) * len(self.photodiodes) + photodiode

    def columns_of(self, photodiodes: IntArray) -> IntArray:
        """Return the indices of all stations and of some photodiodes with their biases."""
        stations = len(self.positions)
        planes = np.arange(2 * stations)[:, None]
        return np.concatenate(
            [
                np.arange(stations * STATION_PARAMETERS),
                self.lever_columns(photodiodes).ravel(),
                self.bias_columns(planes // 2, planes % 2, photodiodes).ravel(),
            ]
        )

    def select(self, photodiodes: IntArray) -> CommonParameters:
        """Return the parameters of all stations and of some photodiodes.

        Before a recording is used, these are independent of the other photodiodes.
        """
        column = self.columns_of(photodiodes)
        return replace(
            self,
            photodiodes=self.photodiodes[photodiodes],
            information=self.information[np.ix_(column, column)],
            gauge=self.gauge[column],
            value=self.value[column],
        )

    def pose_sigma(self, distance_m: float) -> Array:
        """Return the standard deviation (s,) of angles at a distance by the poses of stations."""
        count = len(self.positions)
        covariance = np.linalg.inv(self.information)
        sigma = np.sqrt(np.diagonal(covariance)[: count * STATION_PARAMETERS])
        pose = sigma.reshape(count, STATION_PARAMETERS)[:, :6]
        angle = np.concatenate([pose[:, :3] / distance_m, pose[:, 3:]], axis=1)
        return np.asarray(np.sqrt(np.mean(angle**2, axis=1) * 2))

    def _by_station(self) -> Array:
        count = len(self.positions)
        return self.value[: count * STATION_PARAMETERS].reshape(count, STATION_PARAMETERS)

    def only_poses(self) -> CommonParameters:
        """Return the parameters with light planes and photodiodes held: only stations move."""
        count = len(self.positions) * STATION_PARAMETERS
        is_pose = np.arange(len(self.value)) % STATION_PARAMETERS < 6
        is_pose[count:] = False
        held = np.where(is_pose, 0.0, HELD_FACTOR * np.diagonal(self.information))
        return replace(self, information=self.information + np.diag(held))

    def stepped(self, change: Array) -> CommonParameters:
        """Return the parameters after a change (k,)."""
        return replace(self, value=self.value + change)

    def predict(
        self, station: IntArray, plane: IntArray, position: Array
    ) -> tuple[Array, Array, Array, IntArray]:
        """Predict the rotor angles of sweeps.

        Parameters
        ----------
        station, plane : (n,) int ndarray
        position : (n, 3) ndarray
            Photodiodes at the times of the sweeps, in the frame.

        Returns
        -------
        angle : (n,) ndarray
        by_position : (n, 3) ndarray
        by_station : (n, 20) ndarray
            Derivatives by the parameters of the station that the sweep depends on.
        column : (n, 20) int ndarray
            Their indices.
        """
        n, terms = len(station), len(DISTORTION_POWERS)
        angle, by_position = np.full(n, np.nan), np.zeros((n, 3))
        by_station = np.zeros((n, 6 + PLANE_PARAMETERS))
        positions, rotations, calibrations = self.stations
        distortions = self._by_station()[:, 20:].reshape(-1, 2, terms)
        for i, calibration in enumerate(calibrations):
            rows = np.flatnonzero(station == i)
            offset = position[rows] - positions[i]
            local = offset @ rotations[i]
            angle[rows], by_local, by_calibration = predict_sweeps(local, plane[rows], calibration)
            basis = distortion_basis(local)
            angle[rows] += np.sum(basis * distortions[i, plane[rows]], axis=1)
            by_position[rows] = by_local @ rotations[i].T
            by_station[rows, :3] = -by_position[rows]
            by_station[rows, 3:6] = np.cross(by_position[rows], offset)
            by_station[rows, 6:13], by_station[rows, 13:] = by_calibration, basis
        column = np.empty((n, 6 + PLANE_PARAMETERS), np.int64)
        column[:, :6] = np.arange(6)
        column[:, 6:13] = 6 + 7 * plane[:, None] + np.arange(7)
        column[:, 13:] = 20 + terms * plane[:, None] + np.arange(terms)
        column += STATION_PARAMETERS * station[:, None]
        return angle, by_position, by_station, column


def scene_size(stations: Array, positions: Array) -> float:
    """Return the median distance of positions (n, 3) from the single stations (s, 3)."""
    distance = np.linalg.norm(positions[:, None] - stations, axis=2)
    return float(np.median(distance)) if distance.size else 1.0


def distortion_basis(local: Array) -> Array:
    """Return the terms (n, 7) of the distortion for points (n, 3) in the axes of a station."""
    azimuth = np.arctan2(local[:, 1], local[:, 0]) / DISTORTION_UNIT_RAD
    elevation = np.arctan2(local[:, 2], np.hypot(local[:, 0], local[:, 1])) / DISTORTION_UNIT_RAD
    return np.stack([azimuth**i * elevation**j for i, j in DISTORTION_POWERS], axis=1)


def calibration_covariance(calibration: Calibration) -> Array:
    """Return the covariance (14, 14) of the parameters of a station's planes before a recording."""
    if calibration.is_generic or calibration.source == "none":
        return np.asarray(np.diag(np.var(FACTORY_LINEAR_PARAMETERS, axis=0, ddof=1).ravel()))
    variance = np.tile(FACTORY_SIGMA**2, (2, 1))
    # The manufacturer sets the phase of the first plane to zero: it is the axis of the station.
    variance[0, PHASE] = 0.0
    return np.asarray(np.diag(variance.ravel()))


def make_parameters(
    scene: Scene,
    channels: Sequence[int],
    photodiodes: Array,
    *,
    is_estimated: bool,
    size_m: float,
) -> CommonParameters:
    """Return the parameters of a scene before its sweeps are used.

    Parameters
    ----------
    scene : Scene
        With stations on all ``channels``.
    channels : sequence of int
    photodiodes : (p, 3) ndarray
        Of all devices, in the axes of these; empty for single photodiodes.
    is_estimated : bool
        True if the scene was estimated from the same sweeps, so that its covariances are no
        independent knowledge. Its frame is kept, and its scale if no device determines it.
    size_m : float
        Distance of the stations from the devices.
    """
    stations = [s for c in channels if (s := scene.station(c)) is not None]
    positions = np.stack([s.position for s in stations])
    biases = 2 * len(stations) * len(photodiodes)
    count = len(stations) * STATION_PARAMETERS + photodiodes.size + biases
    covariance = np.zeros((count, count))
    rows_of_scene = [scene.stations.index(s) for s in stations]
    joint = scene.covariance if not is_estimated else None
    for i, station in enumerate(stations):
        first = i * STATION_PARAMETERS
        pose, planes = slice(first, first + 6), slice(first + 6, first + 20)
        if is_estimated:
            covariance[pose, pose] = np.diag(np.repeat([FREE_SIGMA * size_m, FREE_SIGMA], 3) ** 2)
        elif station.covariance is not None:
            covariance[pose, pose] = station.covariance
        else:
            sigma = np.repeat([GIVEN_POSITION_SIGMA_M, GIVEN_ROTATION_SIGMA_RAD], 3)
            covariance[pose, pose] = np.diag(sigma**2)
        covariance[planes, planes] = calibration_covariance(station.calibration)
        if joint is not None:
            own = _rows(rows_of_scene[i], JOINT_PARAMETERS)
            for j, other in enumerate(rows_of_scene):
                covariance[
                    first : first + 20, j * STATION_PARAMETERS : j * STATION_PARAMETERS + 20
                ] = joint[own, _rows(other, JOINT_PARAMETERS)]
        shape = slice(first + 20, first + STATION_PARAMETERS)
        covariance[shape, shape] = np.eye(2 * len(DISTORTION_POWERS)) * DISTORTION_SIGMA_RAD**2
    diodes = slice(len(stations) * STATION_PARAMETERS, count - biases)
    covariance[diodes, diodes] = np.eye(photodiodes.size) * PHOTODIODE_SIGMA_M**2
    covariance[count - biases :, count - biases :] = np.eye(biases) * BIAS_SIGMA_RAD**2
    # Parameters without a variance are known: a tiny one keeps the information finite.
    floor = np.where(np.diagonal(covariance) == 0.0, 1e-12, 0.0)
    covariance += np.diag(floor + 1e-9 * np.diagonal(covariance))
    gauge = np.zeros((count, 0))
    if is_estimated:
        is_single = photodiodes.size == 0
        floor_z = scene.floor_z if is_single and scene.planar else None
        gauge = gauge_directions(positions, count, with_scale=is_single, floor_z=floor_z)
    return CommonParameters(
        positions,
        np.stack([s.rotation for s in stations]),
        tuple(s.calibration for s in stations),
        photodiodes,
        np.asarray(np.linalg.inv(covariance), np.float64),
        gauge,
        np.zeros(count),
    )


def _rows(index: int, size: int) -> slice:
    return slice(index * size, (index + 1) * size)


def gauge_directions(
    positions: Array, count: int, *, with_scale: bool, floor_z: float | None = None
) -> Array:
    """Return orthonormal changes (``count``, g) of all stations that no sweep depends on.

    They are translations and rotations of everything, and a change of scale; over a floor only
    those that keep it.
    """
    centre = positions.mean(axis=0)
    if floor_z is not None:
        centre[2] = floor_z
    centred = positions - centre
    size = max(float(np.sqrt(np.mean(np.sum(centred**2, axis=1)))), 1e-9)
    directions = np.zeros((count, 7 if with_scale else 6))
    for i, offset in enumerate(centred):
        row = i * STATION_PARAMETERS
        directions[row : row + 3, :3] = np.eye(3)
        for axis in range(3):
            directions[row : row + 3, 3 + axis] = np.cross(np.eye(3)[axis], offset)
            directions[row + 3 + axis, 3 + axis] = 1.0
        if with_scale:
            directions[row : row + 3, 6] = offset / size
    if floor_z is not None:
        directions = directions[:, [0, 1, 5, *range(6, directions.shape[1])]]
    return np.linalg.qr(directions)[0]
