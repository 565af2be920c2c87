"""A lighthouse scene: stations with pose and calibration, and what fixes its frame."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.calibration import Calibration


@dataclass(frozen=True)
class Station:
    """One base station in the scene's frame.

    Attributes
    ----------
    channel : int
        1 to 16.
    position : (3,) ndarray
        Of the rotor's centre in the scene's frame, in metres (or units of the
        scene where :attr:`Scene.scale` is ``"unit"``).
    rotation : (3, 3) ndarray
        Station to scene. The station's x looks forward, y left, z up.
    calibration : Calibration
        Parameters of its two light planes and where they come from.
    id : int, optional
        Serial number, from the factory's OOTX data.
    covariance : (6, 6) ndarray, optional
        Of position and rotation (a rotation vector in the scene's frame), as far as the
        angles tell; errors of markers, scale and frame are not in it.
    floor_map : (3, 3) ndarray, optional
        Homography from its rays (1, y, z) to floor points (1, x, y) in metres, where it is
        the only station over a floor with markers
        (:mod:`locatk.core.lighthouse.localization.floor_map`).
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
    """A time during which a device stood on a marker, or the counts seen there.

    Either ``device``, ``start_ns`` and ``end_ns``, or ``counts``: for each channel
    the LFSR indices of its two sweeps (any order).
    """

    device: str | None = None
    start_ns: int | None = None
    end_ns: int | None = None
    counts: dict[int, tuple[float, float]] = field(default_factory=dict)


@dataclass(frozen=True)
class Marker:
    """A place that was measured by hand: it fixes frame and scale.

    ``position`` is (3,) in metres in the scene's frame; z is 0 for floor points.
    """

    name: str
    position: NDArray[np.float64]
    sightings: tuple[MarkerVisit, ...] = ()


@dataclass(frozen=True)
class Distance:
    """A known distance in metres between two sightings: it fixes the scale only."""

    first: MarkerVisit
    second: MarkerVisit
    distance: float


@dataclass(frozen=True)
class Scene:
    """Stations and the points that fix their frame.

    Attributes
    ----------
    stations : tuple of Station
        Empty in a scene that has yet to be solved.
    markers, distances
        What is known of the place before solving.
    planar : bool or None
        True where all devices move on the plane z = ``floor_z``; None if not known.
    floor_z : float
        Height of the photodiodes in a planar scene, in metres.
    scale : str
        What fixed the scale: ``"markers"``, ``"distance"``, ``"odometry"``, ``"device"`` (of
        known size) or ``"unit"`` (the distance of the first two stations is 1).
    frame : str
        Name of the frame of positions.
    notes : tuple of str
        Assumptions made when it was solved.
    calibrations : dict of int to Calibration
        By channel, of stations that have yet to be solved; used as they are.
    ids : dict of int to int
        By channel, serial numbers of stations that have yet to be solved.
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
        """The station on ``channel``, or None."""
        return next((s for s in self.stations if s.channel == channel), None)
