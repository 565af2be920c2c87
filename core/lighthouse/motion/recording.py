"""Paths of recordings of any length, in bounded memory.

The stations and photodiodes are estimated from a recording or, if it is long, from windows spread
over it. With these parameters, the path of each device is then estimated part by part. Parts
overlap, so that each pose follows from the motion before and after it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from locatk.core.errors import DegenerateError
from locatk.core.inertial import InertialSamples
from locatk.core.lighthouse.devices.device_sweeps import DeviceSweeps
from locatk.core.lighthouse.motion.frames import PathFrame
from locatk.core.lighthouse.motion.inertial import MIN_COMPARED_S
from locatk.core.lighthouse.motion.layout import interpolate_flips
from locatk.core.lighthouse.motion.moves import find_moves, moved_stations
from locatk.core.lighthouse.motion.parameters import CommonParameters
from locatk.core.lighthouse.motion.results import (
    PathTrajectory,
    interpolate_trajectory,
    make_trajectory,
)
from locatk.core.lighthouse.motion.solver import (
    MIN_USED_FRACTION,
    PathEstimate,
    estimate_paths,
    follow_path,
)
from locatk.core.progress import track
from locatk.core.solution import SolverWarning
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
Mask = NDArray[np.bool_]

MAX_SAMPLE_KNOTS = 12_000
MAX_SAMPLE_ENTRIES = 40_000_000
"""Largest number of knots from which stations are estimated, and of derivatives of their states by
the common parameters. They bound the memory to 1.5 GB; a device of two stations may move for 120 s.
"""

MAX_SAMPLE_DEVICES, MIN_SAMPLE_WINDOWS = 8, 8
"""Most devices from which stations are estimated, and fewest windows of each."""

SAMPLE_WINDOW_S = 5.0
VISIT_WINDOW_S = 1.0
"""Length of the windows from which stations are estimated, and of those on markers."""

USUAL_USED_FRACTION = 0.97
"""Fraction of accepted sweeps above which no station was moved."""

MIN_END_S, MAX_END_S = 3.0, 60.0
"""Length of the beginning and the end of a recording in which the stations are compared."""

PART_S, PART_OVERLAP_S = 20.0, 1.0
"""Length of the parts of a path, and the overlap with each neighbour."""


class MovedStationError(DegenerateError):
    """The sweeps contradict every path since a station was moved: ``move`` states which."""

    def __init__(self, message: str, move: str) -> None:
        super().__init__(message)
        self.move = move


@dataclass(frozen=True)
class Visit:
    """Time that a device rested on a marker.

    Attributes
    ----------
    device : int
    marker : int
    start_ns, end_ns : int
    """

    device: int
    marker: int
    start_ns: int
    end_ns: int


@dataclass(frozen=True)
class DevicePath:
    """Path of a device.

    Attributes
    ----------
    trajectory : Trajectory
    undetermined : int
        Poses with too large a covariance, or that most sweeps contradict.
    residual : (n,) ndarray
        Of all sweeps of the device in radians; ``nan`` of those that are not on the path.
    is_used : (n,) bool ndarray
    """

    trajectory: Trajectory
    undetermined: int
    residual: Array
    is_used: Mask


@dataclass(frozen=True)
class PathRecording:
    """Sweeps and rough poses of a recording.

    Attributes
    ----------
    sweeps : sequence of DeviceSweeps
        By device, ascending in time.
    photodiodes : sequence of (p,) int ndarray
        By device: its photodiodes in ``common``; empty if the devices are single photodiodes.
    start : sequence of Trajectory
        Rough poses by device.
    common : CommonParameters
        Before the sweeps are used.
    knot_ns : int
        Time from knot to knot.
    rate_hz : float, optional
        Poses per second, infinite for a pose at each sweep. By default, there is one in each two
        knots: a rotation of the fastest station.
    imu : sequence of InertialSamples or None
        By device.
    visits : sequence of Visit
    floor_z : float, optional
        Height of single photodiodes on a floor.
    """

    sweeps: Sequence[DeviceSweeps]
    photodiodes: Sequence[IntArray]
    start: Sequence[Trajectory]
    common: CommonParameters
    knot_ns: int
    rate_hz: float | None
    imu: Sequence[InertialSamples | None]
    visits: Sequence[Visit] = ()
    floor_z: float | None = None

    def estimate_sample(self) -> PathSample:
        """Estimate the common parameters from the recording, or from windows if it is long.

        Raises
        ------
        DegenerateError
            See :func:`~locatk.core.lighthouse.motion.solver.estimate_paths`.
        """
        cells = [np.unique(own.time_ns // self.knot_ns) for own in self.sweeps]
        devices = list(range(len(cells)))
        if sum(map(len, cells)) > self._max_knots(devices):
            most = sorted(devices, key=lambda k: -len(cells[k]))
            devices = sorted(most[:MAX_SAMPLE_DEVICES])
        budget = self._max_knots(devices)
        total = sum(len(cells[k]) for k in devices)
        is_whole = len(devices) == len(cells) and total <= budget
        rows = [
            np.arange(len(self.sweeps[k]))
            if total <= budget
            else self._sample_rows(k, cells[k], budget // len(devices))
            for k in devices
        ]
        photodiodes = [self.photodiodes[k] for k in devices]
        estimate = estimate_paths(
            [self.sweeps[k].take(own) for k, own in zip(devices, rows, strict=True)],
            np.cumsum([0, *map(len, photodiodes)])[:-1].tolist(),
            [self.start[k] for k in devices],
            self.common.select(np.concatenate(photodiodes)),
            self.knot_ns,
            [self.imu[k] for k in devices],
            floor_z=self.floor_z,
        )
        estimate = replace(estimate, device=np.array(devices)[estimate.device])
        return PathSample(estimate, tuple(devices), is_whole)

    def warnings(self, sample: PathSample, channels: Sequence[int]) -> list[SolverWarning]:
        """Return the doubts about IMUs and stations. The channels are those of the stations."""
        warnings = [
            _imu_warning(code, device)
            for code, devices in (
                ("imu_contradicts_light", sample.estimate.contradicting_imus),
                ("imu_not_used", sample.estimate.uncovered_imus),
            )
            for device in devices
        ]
        if np.mean(sample.estimate.is_used) < USUAL_USED_FRACTION:
            message = self.move_message(channels)
            if message is not None:
                warnings.append(SolverWarning("station_moved", message))
        return warnings

    def move_message(self, channels: Sequence[int]) -> str | None:
        """Return which station was moved during the recording, if one was."""
        ends = self._estimate_ends() if len(channels) > 1 else None
        moves = [] if ends is None else find_moves(*ends)
        if ends is None or not moves:
            return None
        compared = int(np.count_nonzero(~(ends[0].is_left_out | ends[1].is_left_out)))
        moved = [channels[i] for i in moved_stations(moves, compared)]
        if not moved:
            return None
        largest = max(moves, key=lambda move: move.distance_m)
        return (
            f"{'one of the stations' if len(moved) > 1 else 'the station'} on channel "
            f"{' or '.join(map(str, moved))} was moved during the recording, by about "
            f"{1e3 * largest.distance_m:.0f} mm and {np.degrees(largest.turn_rad):.1f} degrees: "
            "poses may be wrong by as much"
        )

    def _estimate_ends(self) -> tuple[PathEstimate, PathEstimate] | None:
        """Estimate the beginning and the end of the recording, if they are determined."""
        received = [own for own in self.sweeps if len(own)]
        if not received:
            return None
        start_ns = min(int(own.time_ns[0]) for own in received)
        end_ns = max(int(own.time_ns[-1]) for own in received) + 1
        length_ns = min((end_ns - start_ns) // 3, round(MAX_END_S * 1e9))
        if length_ns < MIN_END_S * 1e9:
            return None
        estimates = []
        for low_ns, high_ns in ((start_ns, start_ns + length_ns), (end_ns - length_ns, end_ns)):
            cut = [own.take(_within(own.time_ns, low_ns, high_ns)) for own in self.sweeps]
            try:
                estimates.append(replace(self, sweeps=cut).estimate_sample().estimate)
            except DegenerateError:
                return None
        return estimates[0], estimates[1]

    def marker_knots(self, estimate: PathEstimate) -> IntArray:
        """Return the number of the marker on which the device is at each knot, or -1."""
        number = np.full(len(estimate.path), -1)
        for visit in self.visits:
            is_visit = estimate.device == visit.device
            is_visit &= _within(estimate.time_ns, visit.start_ns, visit.end_ns + 1)
            number[is_visit] = visit.marker
        return number

    def require_sample(self, channels: Sequence[int]) -> PathSample:
        """Return :meth:`estimate_sample`.

        Raises
        ------
        MovedStationError
            The sweeps contradict every path since a station was moved.
        DegenerateError
        """
        try:
            return self.estimate_sample()
        except DegenerateError as error:
            message = self.move_message(channels)
            raise error if message is None else MovedStationError(str(error), message) from None

    def _max_knots(self, devices: Sequence[int]) -> int:
        """Return the largest number of knots of devices that are estimated at once."""
        count = len(np.concatenate([self.photodiodes[k] for k in devices]))
        pose_size = 6 if count else 3
        parameters = len(self.common.columns_of(np.arange(count)))
        return min(MAX_SAMPLE_KNOTS, MAX_SAMPLE_ENTRIES // (2 * pose_size * parameters))

    def _sample_rows(self, device: int, cells: IntArray, count: int) -> IntArray:
        """Return the sweeps of a device in about ``count`` knots, with those on markers."""
        usual = max(1, round(SAMPLE_WINDOW_S * 1e9) // self.knot_ns)
        windows = np.array_split(cells, max(count // usual, min(count, MIN_SAMPLE_WINDOWS)))
        length = min(usual, count // len(windows))
        chosen = [window[:length] for window in windows]
        for visit in self.visits:
            if visit.device == device:
                end_ns = min(visit.end_ns, visit.start_ns + round(VISIT_WINDOW_S * 1e9))
                chosen.append(np.arange(visit.start_ns // self.knot_ns, end_ns // self.knot_ns + 1))
        cell = self.sweeps[device].time_ns // self.knot_ns
        return np.flatnonzero(np.isin(cell, np.concatenate(chosen)))

    def trace(self, device: int, sample: PathSample, frame: PathFrame | None) -> DevicePath:
        """Return the path of a device with the parameters of a sample.

        The covariances hold in ``frame``; by default, in that of the stations.
        """
        count, rough = len(self.sweeps[device]), self.start[device]
        residual, is_used = np.full(count, np.nan), np.zeros(count, bool)
        trajectories, undetermined = [rough.select(np.zeros(0, np.int64))], 0
        parts = self._parts(device, sample)
        for part in [self._of_sample(device, sample)] if sample.is_whole else parts:
            if part.estimate is None:
                undetermined += part.rough_poses
                continue
            residual[part.rows] = part.estimate.residual[part.sweep]
            is_used[part.rows] = part.estimate.is_used[part.sweep]
            placed = part.estimate if frame is None else frame.apply(part.estimate)
            made = self._trajectory(device, placed, part)
            trajectories.append(made.trajectory)
            undetermined += made.undetermined
        return DevicePath(_join(trajectories), undetermined, residual, is_used)

    def _trajectory(self, device: int, estimate: PathEstimate, part: _Part) -> PathTrajectory:
        """Return the poses of a device in a part, in the frame of an estimate."""
        name, frame = self.start[device].device, self.start[device].frame
        if self.rate_hz is None or not len(part.knots):
            return make_trajectory(estimate, part.knots, name, frame, 2 * self.knot_ns)
        if math.isinf(self.rate_hz):
            time_ns = np.unique(self.sweeps[device].time_ns[part.rows])
        else:
            # Multiples of the interval, also where it is no whole number of nanoseconds.
            first, last = estimate.time_ns[part.knots[[0, -1]]]
            end_ns = int(last) + self.knot_ns
            number = np.arange(
                math.ceil(int(first) * 1e-9 * self.rate_hz) - 1,
                math.floor(end_ns * 1e-9 * self.rate_hz) + 2,
            )
            time_ns = np.array([round(n * 1e9 / self.rate_hz) for n in number.tolist()], np.int64)
            time_ns = time_ns[_within(time_ns, int(first), end_ns)]
        knots = np.flatnonzero(estimate.device == device)
        return interpolate_trajectory(estimate, knots, time_ns, name, frame)

    def _of_sample(self, device: int, sample: PathSample) -> _Part:
        """Return the path of a device from a sample that is the whole recording."""
        estimate = sample.estimate
        first = sum(map(len, self.sweeps[:device]))
        sweep = np.flatnonzero(
            (estimate.sweep >= first) & (estimate.sweep < first + len(self.sweeps[device]))
        )
        rows = estimate.sweep[sweep] - first
        is_testable = ~estimate.is_left_out[self.sweeps[device].station[rows]]
        if np.mean(estimate.is_used[sweep][is_testable]) < MIN_USED_FRACTION:
            none = np.zeros(0, np.int64)
            return _Part(None, none, none, none, len(self.start[device]))
        knots = np.flatnonzero(estimate.device == device)
        return _Part(estimate, knots, sweep, rows)

    def _parts(self, device: int, sample: PathSample) -> Iterator[_Part]:
        """Estimate the path of a device part by part."""
        own, rough = self.sweeps[device], self.start[device]
        common, column, covariance, imu = self._held_parameters(device, sample)
        if len(common.photodiodes):
            rough = interpolate_flips(rough)
        pose_ns = 2 * self.knot_ns
        length_ns = -(-round(PART_S * 1e9) // pose_ns) * pose_ns
        overlap_ns, none = round(PART_OVERLAP_S * 1e9), np.zeros(0, np.int64)
        for number in track(np.unique(own.time_ns // length_ns).tolist(), "parts of the path"):
            start_ns, end_ns = number * length_ns, (number + 1) * length_ns
            rows = np.flatnonzero(_within(own.time_ns, start_ns - overlap_ns, end_ns + overlap_ns))
            near = rough.select(_within(rough.time_ns, start_ns - overlap_ns, end_ns + overlap_ns))
            try:
                made = follow_path(
                    own.take(rows),
                    near,
                    common,
                    self.knot_ns,
                    imu,
                    sample.estimate,
                    floor_z=self.floor_z,
                )
            except DegenerateError:
                count = np.count_nonzero(_within(near.time_ns, start_ns, end_ns))
                yield _Part(None, none, none, none, int(count))
                continue
            response = np.zeros((*made.response.shape[:2], len(covariance)))
            response[:, :, column] = made.response
            estimate = replace(
                made,
                device=np.full(len(made.path), device),
                response=response,
                common_covariance=covariance,
            )
            knots = np.flatnonzero(_within(estimate.time_ns, start_ns, end_ns))
            rows = rows[estimate.sweep]
            sweep = np.flatnonzero(_within(own.time_ns[rows], start_ns, end_ns))
            yield _Part(estimate, knots, sweep, rows[sweep])

    def _held_parameters(
        self, device: int, sample: PathSample
    ) -> tuple[CommonParameters, IntArray, Array, InertialSamples | None]:
        """Return the parameters of a device after a sample.

        Returns
        -------
        common : CommonParameters
        column : (m,) int ndarray
            Their rows in ``covariance``.
        covariance : (p, p) ndarray
            Of all parameters of the sample, then of those of the device that are not in it.
        imu : InertialSamples or None
            Of the device, if it agreed with the light in the sample.
        """
        made, imu = sample.estimate.common, None
        covariance = sample.estimate.common_covariance
        devices = sample.devices
        if device in devices:
            counts = [len(self.photodiodes[k]) for k in devices]
            first = sum(counts[: devices.index(device)])
            photodiode = np.arange(first, first + len(self.photodiodes[device]))
            column, value = made.columns_of(photodiode), made.value
            inertial = sample.estimate.inertial
            names = [] if inertial is None else [imu.device for imu in inertial.imus]
            if inertial is not None and self.start[device].device in names:
                own = inertial.columns(names.index(self.start[device].device))
                column, imu = np.concatenate([column, own]), self.imu[device]
            positions = made.photodiodes[photodiode]
        else:
            prior = self.common.select(self.photodiodes[device])
            of_scene = len(self.common.columns_of(np.zeros(0, np.int64)))
            added = np.linalg.inv(prior.information)[of_scene:, of_scene:]
            column = np.concatenate([np.arange(of_scene), len(covariance) + np.arange(len(added))])
            covariance = np.asarray(block_diag(covariance, added))
            value = np.concatenate([made.value, np.zeros(len(added))])
            positions = prior.photodiodes
        count = len(column)
        common = replace(
            made,
            photodiodes=positions,
            information=np.zeros((count, count)),
            gauge=np.zeros((count, 0)),
            value=value[column],
        )
        return common, column, covariance, imu


@dataclass(frozen=True)
class PathSample:
    """Paths from which the common parameters were estimated.

    Attributes
    ----------
    estimate : PathEstimate
    devices : tuple of int
        Devices of the sample.
    is_whole : bool
        True if it is the whole recording.
    """

    estimate: PathEstimate
    devices: tuple[int, ...]
    is_whole: bool


@dataclass(frozen=True)
class _Part:
    """Part of the path of a device.

    Attributes
    ----------
    estimate : PathEstimate or None
        None if most sweeps contradict the path or do not determine it.
    knots : (k,) int ndarray
        Knots of the estimate in the part.
    sweep, rows : (p,) int ndarray
        Sweeps of the estimate in the part, and their rows among those of the device.
    rough_poses : int
        Rough poses in the part if there is no estimate.
    """

    estimate: PathEstimate | None
    knots: IntArray
    sweep: IntArray
    rows: IntArray
    rough_poses: int = 0


IMU_DOUBTS = {
    "imu_contradicts_light": "its IMU measures another motion than the sweeps and was not used: "
    "its axes or units differ from those of the device, or its time stamps are wrong",
    "imu_not_used": f"its IMU was not used: less than {MIN_COMPARED_S:g} s of its path have "
    "samples of a gyroscope",
}


def _imu_warning(code: str, device: str) -> SolverWarning:
    return SolverWarning(code, f"{device}: {IMU_DOUBTS[code]}")


def _within(time_ns: IntArray, start_ns: int, end_ns: int) -> Mask:
    return np.asarray((time_ns >= start_ns) & (time_ns < end_ns))


def _join(parts: Sequence[Trajectory]) -> Trajectory:
    """Return the poses of parts of a trajectory, one after the other."""
    names = ("time_ns", "position", "quaternion", "covariance")
    joined = {name: np.concatenate([getattr(t, name) for t in parts]) for name in names}
    return Trajectory(parts[0].device, parts[0].frame, **joined)
