"""Sweeps that photodiodes of a moving robot receive from simulated base stations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.calibration import predict_angles
from locatk.core.lighthouse.channels import period_counts
from locatk.core.lighthouse.light_planes import ROTOR_ZERO_RAD, angles_to_counts
from locatk.core.lighthouse.scene import Station
from locatk.core.lighthouse.simulation.paths import RobotPath

Array = NDArray[np.float64]

PositionFunction = Callable[[Array], Array]
"""From times (...) in seconds to positions (..., 3) in metres."""

BEAM_HALF_WIDTH_RAD = np.radians([75.0, 50.0])
"""(2,) azimuth and elevation up to which light of a station is received. The manufacturer states
150 by 110 degrees in all; at its upper and lower edges the beam is too weak."""

DECODING_DELAY_S = 1e-3
"""Time from the last sweep to a report that contains it [s]. A DotBot decodes a sweep in 0.9 ms
(paper, Table III)."""


@dataclass(frozen=True)
class SimulatedStation:
    """Base station with a rotor.

    Attributes
    ----------
    station : Station
        Channel, pose and calibration.
    zero_s : float
        True time at which the rotor first passes its zero.
    period_s : float
        Duration of a rotation.
    bits : (k,) int ndarray
        Slow bit (OOTX) of each rotation.
    turned_rotation : (3, 3) ndarray or None
        Rotation of the station from ``turned_s`` on; None if it is never turned.
    turned_s : float
    """

    station: Station
    zero_s: float
    period_s: float
    bits: NDArray[np.int64]
    turned_rotation: Array | None = None
    turned_s: float = np.inf

    def to_local(self, points: Array, time_s: Array) -> Array:
        """Return points (..., 3) in the axes that the station has at times (...)."""
        offset = points - self.station.position
        local = offset @ self.station.rotation
        if self.turned_rotation is None:
            return local
        is_turned = (time_s >= self.turned_s)[..., None]
        return np.where(is_turned, offset @ self.turned_rotation, local)

    def observe(
        self, start_s: Array, position: PositionFunction, noise: Array
    ) -> tuple[Array, Array]:
        """Find the times at which both planes of rotations cross a moving point.

        Parameters
        ----------
        start_s : (n,) ndarray
            True times at which the rotations start.
        position : callable
            From times (...) to points (..., 3).
        noise : (n, 2) ndarray
            Errors of the rotor angles in radians.

        Returns
        -------
        time_s : (n, 2) ndarray
            True times.
        count : (n, 2) ndarray
            LFSR counts, whole numbers; ``nan`` if the point is outside the beam.

        Notes
        -----
        The time is found by fixed-point iteration. Each step multiplies the error by the ratio
        of the angular speeds of the robot and of the rotor, about 0.001.
        """
        nominal_s = start_s[:, None] + self.period_s * np.array([1 / 3, 2 / 3])
        time_s = nominal_s
        for _ in range(4):
            local = self.to_local(position(time_s), time_s)
            # Points are (n, 2, 3), one per plane at its own time: of the angles (n, 2, 2) only
            # that of the same plane is used.
            angle = predict_angles(local, self.station.calibration)[..., [0, 1], [0, 1]]
            time_s = start_s[:, None] + (angle - ROTOR_ZERO_RAD) / (2 * np.pi) * self.period_s
            time_s = np.where(np.isfinite(time_s), time_s, nominal_s)
        azimuth = np.arctan2(local[..., 1], local[..., 0])
        elevation = np.arctan2(local[..., 2], np.hypot(local[..., 0], local[..., 1]))
        in_beam = (np.abs(azimuth) < BEAM_HALF_WIDTH_RAD[0]) & (
            np.abs(elevation) < BEAM_HALF_WIDTH_RAD[1]
        )
        angle = np.where(in_beam, angle + noise, np.nan)
        revolutions = (angle - ROTOR_ZERO_RAD) / (2 * np.pi)
        count = np.rint(angles_to_counts(angle, self.station.channel))
        # Only extreme noise moves a sweep out of its rotation.
        count[(count < 0) | (count >= period_counts(self.station.channel))] = np.nan
        return start_s[:, None] + revolutions * self.period_s, count


@dataclass(frozen=True)
class OpticalLink:
    """One photodiode of a robot in view of one station.

    Attributes
    ----------
    robot : int
        Index of the robot.
    path : RobotPath
    source : SimulatedStation
    sensor : int
        Index of the photodiode.
    offset_m : (3,) ndarray or None
        Position of the photodiode in the robot's axes; None for its origin.
    normal : (3,) ndarray or None
        Direction in which the photodiode points, in the robot's axes; None if it receives light
        from everywhere.
    is_blocked : callable or None
        Function of positions (..., 3) of the photodiode and times (...), True if no light of the
        station arrives; None if nothing stops it.
    """

    robot: int
    path: RobotPath
    source: SimulatedStation
    sensor: int = 0
    offset_m: Array | None = None
    normal: Array | None = None
    is_blocked: Callable[[Array, Array], NDArray[np.bool_]] | None = None

    def position(self, time_s: Array) -> Array:
        """Return the positions (..., 3) of the photodiode in metres at times (...)."""
        origin = self.path.position(time_s)
        return origin if self.offset_m is None else origin + self.path.rotate(self.offset_m, time_s)

    def is_facing(self, time_s: Array) -> NDArray[np.bool_]:
        """Return True if the photodiode points towards the station at times (...)."""
        if self.normal is None:
            return np.ones(np.shape(time_s), bool)
        to_station = self.source.station.position - self.position(time_s)
        return np.sum(to_station * self.path.rotate(self.normal, time_s), axis=-1) > 0


@dataclass
class SweepPairs:
    """Both sweeps of each rotation that a report contains.

    Attributes
    ----------
    link, report : (n,) int ndarray
        Index of the optical link, and of the report among those of its robot.
    start_s : (n,) ndarray
        True time of the rotor's zero.
    time_s : (n, 2) ndarray
        True times of the sweeps.
    count : (n, 2) ndarray
        LFSR counts; ``nan`` for a sweep that was not received.
    channel, polynomial : (n, 2) int ndarray
        Labels assigned by the receiver.
    is_outlier : (n, 2) bool ndarray
    """

    link: NDArray[np.int64]
    report: NDArray[np.int64]
    start_s: Array
    time_s: Array
    count: Array
    channel: NDArray[np.int64]
    polynomial: NDArray[np.int64]
    is_outlier: NDArray[np.bool_]

    @classmethod
    def concatenate(cls, parts: Sequence[SweepPairs]) -> SweepPairs:
        """Concatenate pairs of several links."""
        return cls(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)))


def observe_reports(
    link: OpticalLink, index: int, reports_s: Array, hidden_s: Sequence[Array], noise: Array
) -> SweepPairs:
    """Simulate the reports of one photodiode about one station.

    A report contains the last pair of sweeps before it, unless an earlier report did.

    Parameters
    ----------
    link : OpticalLink
    index : int
        Index of the link, for :attr:`SweepPairs.link`.
    reports_s : (n,) ndarray
        True times of the reports.
    hidden_s : sequence of (2 k,) ndarray
        Ascending starts and ends of times without reception.
    noise : (n, 2) ndarray
        Errors of the rotor angles in radians.
    """
    source, station = link.source, link.source.station
    # The last complete rotation is that whose second plane has crossed the photodiode.
    local = source.to_local(link.position(reports_s), reports_s)
    second_angle = predict_angles(local, station.calibration)[:, 1]
    crossing_turns = (second_angle - ROTOR_ZERO_RAD[1]) / (2 * np.pi)
    elapsed_turns = (reports_s - DECODING_DELAY_S - source.zero_s) / source.period_s
    completed = elapsed_turns - crossing_turns
    rotation = np.floor(np.where(np.isfinite(completed), completed, -1.0)).astype(np.int64)
    is_new = (rotation >= 0) & np.r_[True, np.diff(rotation) != 0][: len(rotation)]
    report, rotation = np.flatnonzero(is_new), rotation[is_new]

    start_s = source.zero_s + rotation * source.period_s
    time_s, count = source.observe(start_s, link.position, noise[is_new])
    is_missing = (time_s < 0) | ~link.is_facing(time_s)
    if link.is_blocked is not None:
        is_missing |= link.is_blocked(link.position(time_s), time_s)
    for edges_s in hidden_s:
        is_missing |= np.searchsorted(edges_s, time_s) % 2 == 1
    count[is_missing] = np.nan
    channel = np.full(time_s.shape, station.channel)
    return SweepPairs(
        np.full(len(report), index),
        report,
        start_s,
        time_s,
        count,
        channel,
        2 * (channel - 1) + source.bits[rotation][:, None],
        np.zeros(time_s.shape, bool),
    )
