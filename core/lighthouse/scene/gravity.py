"""Direction of gravity in a scene, from the accelerometers of its stations.

Every Lighthouse V2 station sends the direction of its accelerometer with its factory data. The
directions of several stations level a scene that has neither markers nor a floor, decide between
mirrored arrangements of the stations, and reveal a station that is not where the scene says.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.scene.model import Scene

Array = NDArray[np.float64]

STATION_UP_SIGMA_RAD = float(np.deg2rad(2.0))
"""Standard deviation of the direction of a station's accelerometer, about each axis. Pairs of
stations in public recordings of libsurvive differ by 1.5 to 5.5 degrees, rms 3.0: 2.1 degrees per
station."""

MAX_UP_CHI2 = 11.83
"""Largest weighted square of a deviation with two degrees of freedom: three standard deviations
(probability 0.0027)."""

MIN_UP_CHI2_GAP = 9.2
"""Smallest difference of the weighted squares of two arrangements between which gravity decides:
a likelihood ratio of 100."""


@dataclass(frozen=True)
class UpMeasurement:
    """Measured direction against gravity in the frame of a scene.

    Attributes
    ----------
    source : str
        Name for messages, as in ``"channel 3"``.
    direction : (3,) ndarray
        Unit vector.
    sigma_rad : float
        Standard deviation about each axis.
    """

    source: str
    direction: Array
    sigma_rad: float = STATION_UP_SIGMA_RAD


@dataclass(frozen=True)
class UpEstimate:
    """Direction against gravity in the frame of a scene.

    Attributes
    ----------
    direction : (3,) ndarray or None
        Unit vector; None if two measurements contradict each other and no third one decides.
    sigma_rad : float
        Standard deviation about each axis.
    used : tuple of str
        Sources of the measurements that agree on it.
    contradicting : tuple of str
        Sources of those that deviate from the others by more than three standard deviations.
    """

    direction: Array | None
    sigma_rad: float
    used: tuple[str, ...]
    contradicting: tuple[str, ...] = ()


def up_from_acceleration(acceleration: Sequence[int]) -> Array | None:
    """Return the unit vector (3,) against gravity in the axes of a station (forward, left, up).

    ``acceleration`` is as transmitted: x right, y up, z back, of any length. None if it is zero.
    The axes and the sign were verified in public recordings with stations tilted by 12 to 34
    degrees, against poses whose world is levelled by the IMU of a tracker.
    """
    x, y, z = (float(value) for value in acceleration)
    up = np.array([-z, -x, y])
    length = float(np.linalg.norm(up))
    return up / length if length > 0 else None


def with_ups(scene: Scene, ups: Mapping[int, Array]) -> Scene:
    """Return the scene with the directions ``ups``, by channel, of stations that have none."""
    stations = tuple(
        station if station.up is not None else replace(station, up=ups.get(station.channel))
        for station in scene.stations
    )
    return replace(scene, stations=stations)


def station_ups(scene: Scene) -> list[UpMeasurement]:
    """Return the directions of the accelerometers of the stations, in the frame of the scene."""
    return [
        UpMeasurement(f"channel {station.channel}", station.rotation @ station.up)
        for station in scene.stations
        if station.up is not None
    ]


def estimate_up(measurements: Sequence[UpMeasurement]) -> UpEstimate | None:
    """Estimate the direction against gravity as the weighted mean of measurements.

    Measurements that contradict the mean of the others are left out, the worst one first. Of two
    that contradict each other none can be trusted. None if there are no measurements.
    """
    if not measurements:
        return None
    remaining = list(measurements)
    contradicting: list[str] = []
    while len(remaining) > 1:
        chi2 = [_deviation_chi2(k, remaining) for k in range(len(remaining))]
        worst = int(np.argmax(chi2))
        if chi2[worst] <= MAX_UP_CHI2:
            break
        if len(remaining) == 2:
            sources = (*contradicting, *(each.source for each in remaining))
            return UpEstimate(None, float(np.pi), (), sources)
        contradicting.append(remaining.pop(worst).source)
    mean, sigma_rad = _weighted_mean(remaining)
    return UpEstimate(
        mean, sigma_rad, tuple(each.source for each in remaining), tuple(contradicting)
    )


def up_chi2(directions: Array, up: Array) -> float:
    """Return the weighted square of the angles of stations' directions (n, 3) from ``up``.

    Rows that are ``nan`` are left out. It has two degrees of freedom per direction.
    """
    known = directions[np.isfinite(directions).all(axis=1)]
    return float(np.sum(angles_between(known, up) ** 2) / STATION_UP_SIGMA_RAD**2)


def angles_between(directions: Array, reference: Array) -> Array:
    """Return the angles (...) in radians of unit vectors (..., 3) from a unit vector (3,)."""
    across = np.linalg.norm(np.cross(directions, reference), axis=-1)
    return np.asarray(np.arctan2(across, directions @ reference))


def _weighted_mean(measurements: Sequence[UpMeasurement]) -> tuple[Array, float]:
    weights = np.array([each.sigma_rad**-2 for each in measurements])
    mean = weights @ np.stack([each.direction for each in measurements])
    return mean / np.linalg.norm(mean), float(np.sum(weights) ** -0.5)


def _deviation_chi2(index: int, measurements: Sequence[UpMeasurement]) -> float:
    """Return the weighted square of the angle of a measurement from the mean of the others."""
    own = measurements[index]
    mean, sigma_rad = _weighted_mean([*measurements[:index], *measurements[index + 1 :]])
    return float(angles_between(own.direction, mean) ** 2 / (own.sigma_rad**2 + sigma_rad**2))
