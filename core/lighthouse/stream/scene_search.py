"""Estimation of a scene in the background, from the sweeps since the start.

Sweeps are kept in blocks of time. When there are too many, every second block is dropped, so that
the rest is spread over all the time. The scene is estimated by the offline solver, at growing
intervals: the first success gives version 1, later ones replace it if they are better. A later
version is aligned with the earlier one, so that poses jump as little as possible.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.geometry import Similarity, umeyama
from locatk.core.lighthouse.receiver import Receiver
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.lighthouse.scene import Scene
from locatk.core.lighthouse.scene.designed_frame import (
    DesignedFrame,
    fit_designed_frame,
    is_design,
)
from locatk.core.lighthouse.solver import SolveOptions, solve
from locatk.core.solution import SolverWarning
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

BLOCK_NS = 500_000_000
"""Time of a block of sweeps [ns]: some twenty rotations, which rigid devices are tracked over."""

MAX_SWEEPS = 60_000
"""Largest number of sweeps from which a scene is estimated: 30 s of ten robots under two
stations, on which the offline solver takes some seconds."""

FIRST_ATTEMPT_NS = 5_000_000_000
"""Time of sweeps before the first attempt [ns]: a robot at 0.2 m/s has driven a metre."""

INTERVAL_GROWTH = 1.6
"""Growth of the time from one attempt to the next."""

MAX_INTERVAL_NS = 120_000_000_000
"""Longest time between attempts as long as there is no scene [ns]."""

LAST_ATTEMPT_NS = 600_000_000_000
"""Time of sweeps after which a scene is not refined further [ns]: its error is that of the
calibrations then."""

BETTER_SIGMA_RATIO = 0.8
"""Standard deviation of the positions of stations, relative to that of the version before, from
which a new version is better."""

ODOMETRY_INTERVAL_NS = 100_000_000
"""Time between the poses of odometry that are kept [ns]."""

MAX_ODOMETRY_POSES = 6_000
"""Largest number of poses of odometry that are kept of a device: ten minutes."""

SCALE_RANK = {"unit": 0, "odometry": 1, "device": 1, "design": 1, "distance": 2, "markers": 2}
"""Rank of the sources of the scale of a scene; a higher one is better."""

Row = tuple[int, int, int, int, int, int, float]
"""Time, device, sensor, channel, polynomial, plane and count of a sweep."""


@dataclass(frozen=True)
class SceneResult:
    """Scene that was estimated in the background.

    Attributes
    ----------
    scene : Scene
    warnings : tuple of SolverWarning
    frame : DesignedFrame or None
        Uncertainty of the frame, if it is that of a designed room.
    """

    scene: Scene
    warnings: tuple[SolverWarning, ...]
    frame: DesignedFrame | None = None


def estimate_live_scene(
    sweeps: Sweeps,
    prior: Scene,
    options: SolveOptions,
    odometry: tuple[Trajectory, ...],
    receivers: dict[str, Receiver],
) -> SceneResult:
    """Estimate the stations from the sweeps so far, by the offline solver.

    Raises
    ------
    DegenerateError
        The sweeps do not determine the scene. The message states what is missing.
    """
    solution = solve(sweeps, prior, options, odometry, receivers)
    if is_design(solution.artifact):
        (warning,) = [w for w in solution.warnings if w.code == "designed_poses_used"]
        raise DegenerateError(warning.message)
    frame = None
    if is_design(prior) and solution.artifact.frame_source != "markers":
        frame = fit_designed_frame(solution.artifact, prior)
    return SceneResult(solution.artifact, solution.warnings, frame)


class SweepStore:
    """Sweeps since the start, thinned to a largest number.

    Attributes
    ----------
    devices : list of str
        Names that the rows of sweeps index.
    """

    def __init__(self) -> None:
        self.devices: list[str] = []
        self._blocks: dict[int, list[Row]] = {}
        self._stride = 1
        self._size = 0
        self._start_ns: int | None = None

    def __len__(self) -> int:
        return self._size

    def add(self, row: Row) -> None:
        """Add a sweep."""
        if self._start_ns is None:
            self._start_ns = row[0]
        number = (row[0] - self._start_ns) // BLOCK_NS
        if number % self._stride:
            return
        block = self._blocks.setdefault(number, [])
        if len(block) >= MAX_SWEEPS // 2:
            return
        block.append(row)
        self._size += 1
        if self._size > MAX_SWEEPS:
            self._stride *= 2
            self._blocks = {n: rows for n, rows in self._blocks.items() if n % self._stride == 0}
            self._size = sum(map(len, self._blocks.values()))

    def sweeps(self) -> Sweeps:
        """Return the sweeps that are kept."""
        return make_sweeps(self.devices, [row for block in self._blocks.values() for row in block])


def make_sweeps(devices: Sequence[str], rows: Sequence[Row]) -> Sweeps:
    """Return rows as sweeps."""
    columns = zip(*rows, strict=True) if rows else ([] for _ in range(7))
    time_ns, device, sensor, channel, polynomial, sweep, count = columns
    return Sweeps(
        tuple(devices),
        np.array(time_ns, np.int64),
        np.array(device, np.int32),
        np.array(sensor, np.int32),
        np.array(channel, np.int32),
        np.array(polynomial, np.int32),
        np.array(sweep, np.int32),
        np.array(count, np.float64),
    )


class OdometryStore:
    """Poses of odometry, thinned."""

    def __init__(self) -> None:
        self._poses: dict[str, list[tuple[int, Array, Array]]] = {}
        self._frames: dict[str, str] = {}

    def add(self, track: Trajectory) -> None:
        """Add the newest poses of a device."""
        poses = self._poses.setdefault(track.device, [])
        self._frames[track.device] = track.frame
        for k, time_ns in enumerate(track.time_ns.tolist()):
            is_due = not poses or time_ns - poses[-1][0] >= ODOMETRY_INTERVAL_NS
            if is_due and len(poses) < MAX_ODOMETRY_POSES:
                poses.append((time_ns, track.position[k], track.quaternion[k]))

    def tracks(self) -> tuple[Trajectory, ...]:
        """Return the poses that are kept, a trajectory for each device."""
        return tuple(
            Trajectory(
                device,
                self._frames[device],
                np.array([pose[0] for pose in poses], np.int64),
                np.stack([pose[1] for pose in poses]),
                np.stack([pose[2] for pose in poses]),
                np.full((len(poses), 6, 6), np.nan),
            )
            for device, poses in self._poses.items()
            if poses
        )


def is_better(new: Scene, old: Scene) -> bool:
    """Return whether a scene should replace an earlier one of the same stations.

    It has all stations of the earlier one, and more of them, a better scale, or stations whose
    positions are more certain.
    """
    channels = {s.channel for s in old.stations}
    if not channels <= {s.channel for s in new.stations}:
        return False
    new_rank, old_rank = SCALE_RANK.get(new.scale, 0), SCALE_RANK.get(old.scale, 0)
    if new_rank != old_rank:
        return new_rank > old_rank
    if len(new.stations) > len(old.stations):
        return True
    return _position_sigma(new) < BETTER_SIGMA_RATIO * _position_sigma(old)


def _position_sigma(scene: Scene) -> float:
    """Return the rms standard deviation of the positions of stations, relative to their extent."""
    variance = [np.trace(s.covariance[:3, :3]) for s in scene.stations if s.covariance is not None]
    positions = np.stack([s.position for s in scene.stations])
    extent = float(np.linalg.norm(np.ptp(positions, axis=0))) if len(positions) > 1 else 1.0
    return float(np.sqrt(np.mean(variance))) / max(extent, 1e-9) if variance else np.inf


def align_scene(new: Scene, old: Scene) -> Scene:
    """Return a new version of a scene in the frame of the earlier one.

    A scene whose frame is that of markers is returned as it is. The scale is never changed.
    """
    if new.frame_source == "markers":
        return new
    old_stations = {s.channel: s for s in old.stations}
    source, target = [], []
    for station in new.stations:
        earlier = old_stations.get(station.channel)
        if earlier is not None:
            # Points on the axes of a station let its orientation count as well.
            for axis in (np.zeros(3), *np.eye(3)):
                source.append(station.position + station.rotation @ axis)
                target.append(earlier.position + earlier.rotation @ axis)
    if not source:
        return new
    transform = umeyama(np.stack(source), np.stack(target), with_scale=False)
    return replace(new.transformed(_level(transform, new)), frame=old.frame)


def _level(transform: Similarity, scene: Scene) -> Similarity:
    """Return a transform without its tilt and height, if the z axis of the scene is vertical."""
    if not (scene.is_level or scene.planar):
        return transform
    heading = np.arctan2(
        transform.rotation[1, 0] - transform.rotation[0, 1],
        transform.rotation[0, 0] + transform.rotation[1, 1],
    )
    cos, sin = np.cos(heading), np.sin(heading)
    rotation = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    centre = np.mean([s.position for s in scene.stations], axis=0)
    moved = transform.apply(centre) - rotation @ centre
    return Similarity(1.0, rotation, np.array([moved[0], moved[1], 0.0]))
