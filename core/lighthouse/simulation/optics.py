"""What a receiver gets of the light of a simulated station."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.calibration import predict_angles
from locatk.core.lighthouse.channels import period_counts
from locatk.core.lighthouse.light_planes import ROTOR_ZERO_RAD, angles_to_counts
from locatk.core.lighthouse.scene import Station
from locatk.core.lighthouse.simulation.paths import Course

Array = NDArray[np.float64]
Places = Callable[[Array], Array]

CONE_RAD = np.radians([75.0, 50.0])
"""Azimuth and elevation to which light of a station is received. The maker says 150 by 110
degrees in all; at the very edge the beam is too weak."""

PROCESSING_S = 1e-3
"""From the last sweep to a report that has it: what a DotBot takes to decode a packet."""


@dataclass(frozen=True)
class SimulatedStation:
    """A station with its rotor: zero at ``zero_s`` and every ``period_s`` since, in seconds
    of true time; ``bits`` are the slow bits of its rotations."""

    station: Station
    zero_s: float
    period_s: float
    bits: NDArray[np.int64]

    def observe(self, start_s: Array, where: Places, noise: Array) -> tuple[Array, Array]:
        """When both planes of rotations that start at ``start_s`` (n,) meet a moving point.

        Parameters
        ----------
        start_s : (n,) ndarray
            Seconds of true time.
        where : callable
            From times (...) to points (..., 3).
        noise : (n, 2) ndarray
            Added to the rotor angles, in radians.

        Returns
        -------
        time_s, count : (n, 2) ndarray
            Times in seconds and whole LFSR counts, ``nan`` where the light does not reach.

        Notes
        -----
        A fixed point: each step shrinks the error by the angular speed of the robot over
        that of the rotor, about a thousand times.
        """
        nominal = start_s[:, None] + self.period_s * np.array([1 / 3, 2 / 3])
        time = nominal
        for _ in range(4):
            local = (where(time) - self.station.position) @ self.station.rotation
            # Each plane at its own time: the other plane at that time is not asked for.
            angle = predict_angles(local, self.station.calibration)[..., [0, 1], [0, 1]]
            time = start_s[:, None] + (angle - ROTOR_ZERO_RAD) / (2 * np.pi) * self.period_s
            time = np.where(np.isfinite(time), time, nominal)
        azimuth = np.arctan2(local[..., 1], local[..., 0])
        elevation = np.arctan2(local[..., 2], np.hypot(local[..., 0], local[..., 1]))
        lit = (np.abs(azimuth) < CONE_RAD[0]) & (np.abs(elevation) < CONE_RAD[1])
        angle = np.where(lit, angle + noise, np.nan)
        turn = (angle - ROTOR_ZERO_RAD) / (2 * np.pi)
        count = np.rint(angles_to_counts(angle, self.station.channel))
        # Only noise beyond all measure leaves the rotation.
        count[(count < 0) | (count >= period_counts(self.station.channel))] = np.nan
        return start_s[:, None] + turn * self.period_s, count


@dataclass(frozen=True)
class OpticalLink:
    """A photodiode of a robot under a station.

    ``offset`` (3,) is where it sits, from the robot's middle and in its axes, and ``normal``
    (3,) where it looks; None where it looks everywhere.
    """

    robot: int
    course: Course
    light: SimulatedStation
    sensor: int = 0
    offset: Array | None = None
    normal: Array | None = None

    def position(self, time_s: Array) -> Array:
        """Points (..., 3) in metres at ``time_s`` (...)."""
        middle = self.course.position(time_s)
        return middle if self.offset is None else middle + self._turned(self.offset, time_s)

    def faces(self, time_s: Array) -> NDArray[np.bool_]:
        """Whether it looks at the station's side at ``time_s`` (...)."""
        if self.normal is None:
            return np.ones(np.shape(time_s), bool)
        towards = self.light.station.position - self.position(time_s)
        return np.sum(towards * self._turned(self.normal, time_s), axis=-1) > 0

    def _turned(self, vector: Array, time_s: Array) -> Array:
        """A vector (3,) of the robot's axes (..., 3) as it stands at ``time_s``."""
        heading = self.course.heading(time_s)
        cos, sin = np.cos(heading), np.sin(heading)
        x, y, z = vector
        return np.stack([cos * x - sin * y, sin * x + cos * y, np.full_like(cos, z)], axis=-1)


@dataclass
class SweepPairs:
    """Both sweeps of each rotation that some report holds.

    Attributes
    ----------
    link, report : (n,) int ndarray
    start_s : (n,) ndarray
        The rotor's zero.
    time_s : (n, 2) ndarray
    count : (n, 2) ndarray
        ``nan`` where a sweep was not received.
    channel, polynomial : (n, 2) int ndarray
        As the receiver labels them.
    wrong : (n, 2) bool ndarray
    """

    link: NDArray[np.int64]
    report: NDArray[np.int64]
    start_s: Array
    time_s: Array
    count: Array
    channel: NDArray[np.int64]
    polynomial: NDArray[np.int64]
    wrong: NDArray[np.bool_]

    @classmethod
    def joined(cls, parts: Sequence[SweepPairs]) -> SweepPairs:
        return cls(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)))


def observe_reports(
    link: OpticalLink, number: int, reports_s: Array, hidden: Sequence[Array], noise: Array
) -> SweepPairs:
    """The last pair before each report that no earlier report had.

    ``hidden`` are ascending starts and ends of times without reception, ``noise`` (n, 2) is
    added to the rotor angles.
    """
    light = link.light
    # The second plane passes last: of the rotation in which it had passed.
    local = (link.position(reports_s) - light.station.position) @ light.station.rotation
    turn = (predict_angles(local, light.station.calibration)[:, 1] - ROTOR_ZERO_RAD[1]) / (2 * np.pi)
    since = (reports_s - PROCESSING_S - light.zero_s) / light.period_s - turn
    rotation = np.floor(np.where(np.isfinite(since), since, -1.0)).astype(np.int64)
    fresh = (rotation >= 0) & np.r_[True, np.diff(rotation) != 0][: len(rotation)]
    report, rotation = np.flatnonzero(fresh), rotation[fresh]

    start_s = light.zero_s + rotation * light.period_s
    time_s, count = light.observe(start_s, link.position, noise[fresh])
    lost = (time_s < 0) | ~link.faces(time_s)
    for edges in hidden:
        lost |= np.searchsorted(edges, time_s) % 2 == 1
    count[lost] = np.nan
    channel = np.full(time_s.shape, light.station.channel)
    return SweepPairs(
        np.full(len(report), number),
        report,
        start_s,
        time_s,
        count,
        channel,
        2 * (channel - 1) + light.bits[rotation][:, None],
        np.zeros(time_s.shape, bool),
    )
