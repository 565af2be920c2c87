"""Data of a scene: base stations with pose and calibration, and the markers that fix its frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.geometry import Similarity, transform_covariance
from locatk.core.lighthouse.calibration import Calibration
from locatk.core.lighthouse.room import Room

FRAME_SOURCES = ("markers", "floor", "gravity", "station", "design")
"""Sources of the axes and the origin of a scene, see :attr:`Scene.frame_source`."""

JOINT_PARAMETERS = 20
"""Parameters of a station in :attr:`Scene.covariance`: position, rotation vector, calibration."""


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
    up : (3,) ndarray, optional
        Unit vector against gravity in the axes of the station, from its accelerometer.
    """

    channel: int
    position: NDArray[np.float64]
    rotation: NDArray[np.float64]
    calibration: Calibration
    id: int | None = None
    covariance: NDArray[np.float64] | None = None
    floor_map: NDArray[np.float64] | None = None
    up: NDArray[np.float64] | None = None


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
        size), ``"design"`` (the room was designed: stations are near to designed positions) or
        ``"unit"`` (the distance of the first two stations is 1).
    frame : str
        Name of the frame of positions.
    notes : tuple of str
        Assumptions of the estimation, one line each.
    calibrations : dict of int to Calibration
        By channel, for stations that have yet to be estimated. Factory calibrations are used
        unchanged.
    ids : dict of int to int
        By channel, serial numbers of stations that have yet to be estimated.
    ups : dict of int to (3,) ndarray
        By channel, ``Station.up`` of stations that have yet to be estimated.
    frame_source : str or None
        Source of the axes and the origin: ``"markers"``, ``"floor"`` (z = 0 is a floor, or a plane
        at a known height above it), ``"gravity"`` (z is up; the origin is the first station, or the
        level of the photodiodes is unknown), ``"station"`` (the axes of the first station, which
        are not level) or ``"design"`` (the axes of ``room``; the stations were mounted by hand near
        to their designed poses, within their covariances). None if unknown, as in files of older
        versions.
    level_sigma_rad : float or None
        Standard deviation of the inclination of the z axis against the vertical, or against the
        floor if this is the source of the frame; about each horizontal axis. None if unknown.
    covariance : (k, k) ndarray or None
        Joint covariance of all stations, :data:`JOINT_PARAMETERS` each, in the order of
        ``stations``: position (m), rotation vector in the frame of the scene (rad), and of the
        first and then of the second sweep phase, tilt, curve, ``gibmag`` times cosine and sine of
        ``gibphase``, ``ogeemag`` times cosine and sine of ``ogeephase``.
    room : Room or None
        Walls, obstacles and the working volume, if they are known; in the frame of the scene.
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
    ups: dict[int, NDArray[np.float64]] = field(default_factory=dict)
    frame_source: str | None = None
    level_sigma_rad: float | None = None
    covariance: NDArray[np.float64] | None = None
    room: Room | None = None

    @property
    def is_on_floor(self) -> bool:
        """True if the frame is that of markers, a floor or a room: z is up and 0 on the floor.

        Scenes of older versions, which do not state the source of their frame, count if their scale
        is that of markers.
        """
        source = self.frame_source or ("markers" if self.scale == "markers" else None)
        return source in ("markers", "floor", "design")

    @property
    def is_level(self) -> bool:
        """True if z is up: on a floor, or levelled by gravity."""
        return self.is_on_floor or self.frame_source == "gravity"

    def transformed(self, to: Similarity) -> Scene:
        """Return the scene with its stations, their covariances and its floor transformed.

        Markers and the room are kept: they are in the frame that ``to`` leads to. Names and sources
        of frame and scale are those of the caller. A homography of the floor is dropped if ``to``
        tilts the floor.
        """
        stations = tuple(
            replace(
                station,
                position=to.apply(station.position),
                rotation=to.rotation @ station.rotation,
                covariance=None
                if station.covariance is None
                else transform_covariance(station.covariance, to.scale, to.rotation),
                floor_map=_transform_floor_map(station.floor_map, to),
            )
            for station in self.stations
        )
        covariance = self.covariance
        if covariance is not None:
            own = np.eye(JOINT_PARAMETERS)
            own[0:3, 0:3], own[3:6, 3:6] = to.scale * to.rotation, to.rotation
            jacobian = np.kron(np.eye(len(stations)), own)
            covariance = jacobian @ covariance @ jacobian.T
        floor_z = self.floor_z
        if self.planar:
            floor_z = float(to.scale * floor_z + to.translation[2])
        return replace(self, stations=stations, covariance=covariance, floor_z=floor_z)

    def station(self, channel: int) -> Station | None:
        """Return the station on ``channel``, or None."""
        return next((s for s in self.stations if s.channel == channel), None)


def _transform_floor_map(
    floor_map: NDArray[np.float64] | None, to: Similarity
) -> NDArray[np.float64] | None:
    """Return the homography to floor points (1, x, y) in the transformed frame."""
    if floor_map is None or not np.allclose(to.rotation[2], [0.0, 0.0, 1.0], atol=1e-12):
        return None
    to_floor = np.eye(3)
    to_floor[1:, 0], to_floor[1:, 1:] = to.translation[:2], to.scale * to.rotation[:2, :2]
    return np.asarray(to_floor @ floor_map)


StationArrays = tuple[NDArray[np.float64], NDArray[np.float64], tuple[Calibration, ...]]
"""Positions (s, 3), rotations (s, 3, 3) and calibrations of s stations."""


def stack_stations(stations: Sequence[Station]) -> StationArrays:
    """Stack the poses of one or more stations."""
    return (
        np.stack([s.position for s in stations]),
        np.stack([s.rotation for s in stations]),
        tuple(s.calibration for s in stations),
    )
