"""Accuracy of positions and poses that a set of stations determines, before anything is measured.

A light plane of a station that is at the origin of its axes (x forward, y left, z up) meets a point
(x, y, z) at the rotor angle ::

    a = atan2(y, x) - asin(z tan(t) / r),        r = hypot(x, y),  t = +30 or -30 degrees

With ``Q = tan(t) / sqrt(r^2 - z^2 tan(t)^2)`` its gradient is ::

    g = ((-y + x z Q) / r^2,  (x + y z Q) / r^2,  -Q)

Planes k of the stations in view give the information matrix ``A = sum g_k g_k^T`` of a position.
Errors e_k of the angles displace its least-squares estimate by ``A^-1 sum g_k e_k``:

noise
    independent in each epoch: covariance ``sigma^2 A^-1``;
calibration
    a constant of each plane at one place, which no averaging removes: the same with the standard
    deviation of the calibration;
stations
    an error d (position, rotation vector) of a station changes both of its angles by ``h_k d`` with
    ``h = (-g, -(p - s) x g)``: covariance ``A^-1 (sum G^T H C H^T G) A^-1`` with C of each station.

Factory tilts of the planes (0.05 rad) change the gradients by less than 3 % and are neglected.

References
----------
Bitcraze, crazyflie-firmware, docs/functional-areas/lighthouse/kalman_measurement_model.md (the
gradient, with the opposite sign of t).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.noise import ANGLE_SIGMA_RAD, CALIBRATION_SIGMA_RAD

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

PLANE_SLOPES = (float(np.tan(np.pi / 6)), -float(np.tan(np.pi / 6)))
"""Tangents of the tilts of both planes: +30 and -30 degrees
(crazyflie-firmware, kalman_measurement_model.md)."""

MIN_CONDITION = 1e-9
"""Smallest ratio of the eigenvalues of an information matrix that determines a position."""


@dataclass(frozen=True)
class AngleErrors:
    """Standard deviations of rotor angles.

    Attributes
    ----------
    noise_rad : float
        Of each sweep, independent (:data:`~locatk.core.lighthouse.noise.ANGLE_SIGMA_RAD`).
    calibration_rad : float
        Of each plane at one place, after the scene was solved with this calibration
        (:data:`~locatk.core.lighthouse.noise.CALIBRATION_SIGMA_RAD`). It contains the errors of the
        solved stations: those that contradict the angles are as large as it.
    """

    noise_rad: float = ANGLE_SIGMA_RAD
    calibration_rad: float = CALIBRATION_SIGMA_RAD


@dataclass(frozen=True)
class PositionAccuracy:
    """Predicted accuracy of the positions of p points; infinite if they are not determined.

    Attributes
    ----------
    noise_covariance, covariance : (p, d, d) ndarray
        By the noise of one epoch, and in all, in m^2; d is 2 on a plane and 3 in space.
    dilution : (p,) ndarray
        Position error per angle error, divided by the root mean square distance of the stations:
        about 1 if the rays of two stations cross at a right angle, large if they are almost
        parallel.
    """

    noise_covariance: Array
    covariance: Array
    dilution: Array

    @property
    def noise_sigma_m(self) -> Array:
        """Standard deviation (p,) of the distance from the mean position: repeatability."""
        return _sigma(self.noise_covariance)

    @property
    def sigma_m(self) -> Array:
        """Standard deviation (p,) of the distance from the true position."""
        return _sigma(self.covariance)


def angle_gradients(position_m: Array, rotation: Array, points_m: Array) -> Array:
    """Return the gradients (s, p, 2, 3) of the angles of both planes [rad/m] in the room's axes.

    Parameters
    ----------
    position_m : (s, 3) ndarray
    rotation : (s, 3, 3) ndarray
        From station to room.
    points_m : (p, 3) ndarray
        nan is returned for points that a plane does not meet: 60 degrees or more above or below a
        station's horizon.
    """
    local = np.einsum("spi,sij->spj", points_m[None] - position_m[:, None], rotation)
    x, y, z = local[..., 0], local[..., 1], local[..., 2]
    square = x**2 + y**2
    gradient = np.empty((*square.shape, 2, 3))
    with np.errstate(divide="ignore", invalid="ignore"):
        for plane, slope in enumerate(PLANE_SLOPES):
            q = slope / np.sqrt(square - (slope * z) ** 2)
            gradient[..., plane, 0] = (-y + x * z * q) / square
            gradient[..., plane, 1] = (x + y * z * q) / square
            gradient[..., plane, 2] = -q
    return np.einsum("spkj,sij->spki", gradient, rotation)


def information(
    gradient: Array, is_seen: BoolArray, dims: int = 3, sigma_rad: Array | float = 1.0
) -> Array:
    """Return the information matrices (s, p, d, d) of stations; 0 if unseen.

    They are additive over stations. ``sigma_rad`` (s, p, 2) are the standard deviations of the
    angles of both planes.
    """
    g = np.where(is_seen[..., None, None], gradient[..., :dims], 0.0)
    g = g / np.broadcast_to(np.asarray(sigma_rad, float), g.shape[:-1])[..., None]
    return np.einsum("spki,spkj->spij", g, g)


def variance_of(info: Array) -> Array:
    """Return the traces (...) of the inverses of information matrices (..., d, d), d 2 or 3.

    They are infinite for singular matrices. This is much faster than ``np.linalg.inv``.
    """
    if info.shape[-1] == 2:
        trace = info[..., 0, 0] + info[..., 1, 1]
        determinant = info[..., 0, 0] * info[..., 1, 1] - info[..., 0, 1] ** 2
        is_regular = determinant > MIN_CONDITION * trace**2
        return np.where(is_regular, trace / np.where(is_regular, determinant, 1.0), np.inf)
    a, b, c = info[..., 0, 0], info[..., 1, 1], info[..., 2, 2]
    d, e, f = info[..., 0, 1], info[..., 0, 2], info[..., 1, 2]
    minor_a, minor_b, minor_c = b * c - f * f, a * c - e * e, a * b - d * d
    determinant = a * minor_a - d * (d * c - e * f) + e * (d * f - b * e)
    is_regular = determinant > MIN_CONDITION * (a + b + c) ** 3
    minors = minor_a + minor_b + minor_c
    return np.where(is_regular, minors / np.where(is_regular, determinant, 1.0), np.inf)


def predict_positions(
    position_m: Array,
    rotation: Array,
    points_m: Array,
    is_seen: BoolArray,
    *,
    is_planar: bool,
    errors: AngleErrors | None = None,
    station_covariances: Sequence[Array | None] | None = None,
) -> PositionAccuracy:
    """Predict the accuracy of one photodiode at each point.

    Parameters
    ----------
    position_m, rotation : (s, 3) and (s, 3, 3) ndarray
        Poses of the stations.
    points_m : (p, 3) ndarray
    is_seen : (s, p) ndarray
    is_planar : bool
        The height of the photodiode is known.
    errors : AngleErrors, optional
    station_covariances : sequence of (6, 6) ndarray or None
        Covariances of position and rotation vector of each station in the room's axes; None for
        stations that were solved, whose errors are in those of the calibration.
    """
    errors = AngleErrors() if errors is None else errors
    dims = 2 if is_planar else 3
    gradient = angle_gradients(position_m, rotation, points_m)
    info = information(gradient, is_seen, dims).sum(axis=0)
    inverse = _inverse(info)
    both = errors.noise_rad**2 + errors.calibration_rad**2
    covariance = both * inverse
    if station_covariances is not None:
        spread = np.zeros_like(info)
        for k, given in enumerate(station_covariances):
            if given is None:
                continue
            g = np.where(is_seen[k, :, None, None], gradient[k], 0.0)
            offset = points_m - position_m[k]
            h = np.concatenate([-g, -np.cross(offset[:, None], g)], axis=-1)
            own = np.einsum("pki,ij,plj->pkl", h, given, h)
            spread += np.einsum("pki,pkl,plj->pij", g[..., :dims], own, g[..., :dims])
        with np.errstate(invalid="ignore"):
            added = inverse @ spread @ inverse
        covariance = np.where(np.isfinite(inverse), covariance + added, np.inf)
    distance = np.linalg.norm(points_m[None] - position_m[:, None], axis=-1)
    count = is_seen.sum(axis=0)
    square = np.where(is_seen, distance**2, 0.0).sum(axis=0) / np.maximum(count, 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        dilution = np.where(count > 0, _sigma(inverse) / np.sqrt(square), np.inf)
    return PositionAccuracy(errors.noise_rad**2 * inverse, covariance, dilution)


@dataclass(frozen=True)
class PoseAccuracy:
    """Predicted accuracy of the poses of a rigid device; infinite if they are not determined.

    Attributes
    ----------
    noise_covariance, covariance : (p, 6, 6) ndarray
        Of position (m) and rotation vector (rad) in the room's axes.
    """

    noise_covariance: Array
    covariance: Array

    @property
    def sigma_m(self) -> Array:
        """Standard deviation (p,) of the distance from the true position."""
        return _sigma(self.covariance[:, :3, :3])

    @property
    def heading_sigma_rad(self) -> Array:
        """Standard deviation (p,) of the heading."""
        return np.sqrt(self.covariance[:, 5, 5])


def predict_poses(
    position_m: Array,
    rotation: Array,
    points_m: Array,
    is_seen: BoolArray,
    photodiodes_m: Array,
    *,
    errors: AngleErrors | None = None,
) -> PoseAccuracy:
    """Predict the accuracy of the pose of a level device with several photodiodes.

    Parameters
    ----------
    position_m, rotation, points_m, is_seen
        See :func:`predict_positions`; all photodiodes see the stations that their centre sees.
    photodiodes_m : (n, 3) ndarray
        Offsets from the point, in the room's axes.
    errors : AngleErrors, optional

    Notes
    -----
    The calibration error of a plane is the same at all photodiodes: they are near to each other. It
    displaces the device, but turns it little. Errors of the effective positions of photodiodes,
    tenths of a millimetre, are not included.
    """
    errors = AngleErrors() if errors is None else errors
    p = len(points_m)
    info, noise, common = (np.zeros((p, 6, 6)) for _ in range(3))
    rows_sum = np.zeros((len(position_m), p, 2, 6))
    for offset in photodiodes_m:
        g = angle_gradients(position_m, rotation, points_m + offset)
        g = np.where(is_seen[..., None, None], g, 0.0)
        # A rotation w moves a photodiode by w x offset: its angle changes by (offset x g) w.
        rows = np.concatenate([g, np.cross(np.broadcast_to(offset, g.shape), g)], axis=-1)
        rows_sum += rows
        info += np.einsum("spki,spkj->pij", rows, rows)
    common = np.einsum("spki,spkj->pij", rows_sum, rows_sum)
    noise = errors.noise_rad**2 * info
    inverse = _inverse(info)
    with np.errstate(invalid="ignore"):
        of_noise = inverse @ noise @ inverse
        total = of_noise + errors.calibration_rad**2 * inverse @ common @ inverse
    is_known = np.isfinite(inverse)
    return PoseAccuracy(np.where(is_known, of_noise, np.inf), np.where(is_known, total, np.inf))


def _inverse(info: Array) -> Array:
    """Return the inverses of information matrices (p, d, d); infinite if they are singular."""
    # Rows of different units: the condition is that of the normalized matrix.
    scale = np.sqrt(np.maximum(np.einsum("pii->pi", info), 0.0))
    scale = np.where(scale > 0, scale, 1.0)
    outer = scale[:, :, None] * scale[:, None, :]
    normalized = np.nan_to_num(info / outer, nan=0.0)
    values = np.linalg.eigvalsh(normalized)
    is_regular = values[:, 0] > MIN_CONDITION * values[:, -1]
    identity = np.eye(info.shape[-1])
    safe = np.where(is_regular[:, None, None], normalized, identity)
    inverse = np.linalg.inv(safe) / outer
    return np.where(is_regular[:, None, None], inverse, np.inf)


def _sigma(covariance: Array) -> Array:
    return np.asarray(np.sqrt(np.einsum("pii->p", covariance)))
