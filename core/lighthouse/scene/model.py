"""Data of a scene: base stations with pose and calibration, and the markers that fix its frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.calibration import Calibration


@dataclass(frozen=True)
class Station:
    """Base station in the frame of a scene.

    Attributes
    ----------
    channel : int
        1 to 16.
    position : (3,) ndarray
        Centre of the rotor in metres (in the unit of the scene if its scale is ``"unit"``).
    rotation : (3, 3) ndarray
        From station to scene. The axes of a station are x forward, y left and z up.
    calibration : Calibration
        Parameters of its two light planes and their source.
    id : int, optional
        Serial number, from the factory data (OOTX).
    covariance : (6, 6) ndarray, optional
        Covariance of position and rotation (a rotation vector in the frame of the scene) from the
        noise of the angles. Errors of markers, scale and frame are not included.
    floor_map : (3, 3) ndarray, optional
        Homography from its rays (1, y, z) to floor points (1, x, y) in metres, if it is the only
        station and over a floor with markers
        (:func:`~locatk.core.lighthouse.scene.registration.fit_floor_homography`).
    """

    channel: int
    position: NDArray[np.float64]
    rotation: NDArray[np.float64]
    calibration: Calibration
    id: int | None = None
    covariance: NDArray[np.float64] | None = None
    floor_map: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class MarkerVisit:
    """Time during which a device was on a marker, or the counts received there.

    Either ``device``, ``start_ns`` and ``end_ns`` are given, or ``counts``: by channel, the LFSR
    indices of both sweeps in any order.
    """

    device: str | None = None
    start_ns: int | None = None
    end_ns: int | None = None
    counts: dict[int, tuple[float, float]] = field(default_factory=dict)


@dataclass(frozen=True)
class Marker:
    """Point measured by hand. Three or more fix the frame and the scale of a scene.

    Attributes
    ----------
    name : str
    position : (3,) ndarray
        In metres in the frame of the scene; z is 0 on the floor.
    visits : tuple of MarkerVisit
    """

    name: str
    position: NDArray[np.float64]
    visits: tuple[MarkerVisit, ...] = ()


@dataclass(frozen=True)
class Distance:
    """Known distance in metres between two visited points. It fixes the scale only."""

    first: MarkerVisit
    second: MarkerVisit
    distance: float


@dataclass(frozen=True)
class Scene:
    """Stations and the points that fix their frame.

    Attributes
    ----------
    stations : tuple of Station
        Empty if the scene has yet to be estimated.
    markers, distances
        Known points and lengths.
    planar : bool or None
        True if all devices move on the plane z = ``floor_z``; None if unknown.
    floor_z : float
        Height of the photodiodes in a planar scene, in metres.
    scale : str
        Source of the scale: ``"markers"``, ``"distance"``, ``"odometry"``, ``"device"`` (of known
        size) or ``"unit"`` (the distance of the first two stations is 1).
    frame : str
        Name of the frame of positions.
    notes : tuple of str
        Assumptions of the estimation, one line each.
    calibrations : dict of int to Calibration
        By channel, for stations that have yet to be estimated. Factory calibrations are used
        unchanged.
    ids : dict of int to int
        By channel, serial numbers of stations that have yet to be estimated.
    """

    stations: tuple[Station, ...] = ()
    markers: tuple[Marker, ...] = ()
    distances: tuple[Distance, ...] = ()
    planar: bool | None = None
    floor_z: float = 0.0
    scale: str = "unit"
    frame: str = "floor"
    notes: tuple[str, ...] = ()
    calibrations: dict[int, Calibration] = field(default_factory=dict)
    ids: dict[int, int] = field(default_factory=dict)

    def station(self, channel: int) -> Station | None:
        """Return the station on ``channel``, or None."""
        return next((s for s in self.stations if s.channel == channel), None)


StationArrays = tuple[NDArray[np.float64], NDArray[np.float64], tuple[Calibration, ...]]
"""Positions (s, 3), rotations (s, 3, 3) and calibrations of s stations."""


def stack_stations(stations: Sequence[Station]) -> StationArrays:
    """Stack the poses of one or more stations."""
    return (
        np.stack([s.position for s in stations]),
        np.stack([s.rotation for s in stations]),
        tuple(s.calibration for s in stations),
    )
