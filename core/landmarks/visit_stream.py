"""Causal division of hall samples and odometry into visits to landmarks, in bounded memory.

The counterpart of :func:`.preprocessing.preprocess` and :func:`.preprocessing.segment_visits` for
observations that arrive one by one. Samples and odometry are merged by time: all decisions are made
at the times of odometry poses, with everything up to that time, so that they do not depend on how
the input is cut.

A visit is complete as soon as the robot leaves the strong fields of its landmark. The margin of the
offline segments is not waited for, because it is of little use: the poses of 263 simulated visits
differ by 0.02 (positions) and 0.09 (headings) of their standard deviations on average, and 99 of
100 by less than 0.42. If the robot returns to the same landmark, the visit is complete once more
when it leaves again.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.geometry import heading_from_quaternion
from locatk.core.landmarks.detection.trace import OdometryDrift, sensor_positions
from locatk.core.landmarks.halls import HallSamples, HallSensors
from locatk.core.landmarks.landmark import Geometry
from locatk.core.landmarks.preprocessing import (
    MARGIN_M,
    MAX_INTERPOLATED_MOTION_M,
    MIN_FIELD_SIGMAS,
    MIN_FIELD_THRESHOLDS,
    MIN_PEAK_THRESHOLDS,
    MIN_POSE_INTERVAL_NS,
    SATURATION_FRACTION,
    STEP_M,
    VELOCITY_SPAN_NS,
    HallRecording,
    VisitSegment,
    average_samples,
    detect_spikes,
    interpolate_smoothly,
    sensor_motion,
)
from locatk.core.landmarks.sensor_statistics import SensorStatistics
from locatk.core.streaming.plausibility import is_plausible_odometry, plausible_fields
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]
Times = NDArray[np.int64]

LEAVING_PATH_M = 5e-3
"""Path of the sensors without a field that would suffice for a visit, after which a landmark is
left. In 3 of 100 simulated visits there is none for longer while the robot is still over the
landmark: it is then left twice."""

MAX_RETURN_M = 1.0
"""Path of the sensors after the last field beyond which a robot that returns to a landmark begins a
new visit."""

MAX_VISIT_ROWS = 60_000
"""Samples of the longest visit: five minutes at 200 Hz. Longer ones are divided; at most twice as
many samples are kept."""

MAX_STEP_ROWS = 1000
"""Samples of a step of :data:`.preprocessing.STEP_M` beyond which a robot rests: further ones are
not used, because the mean of a thousand is exact to a thirtieth of the noise."""

MAX_WAITING_NS = 60_000_000_000
"""Time by which samples and odometry may be apart; older observations are not waited for."""

MAX_SILENCE_NS = 30_000_000_000
"""Time without samples after which a visit has ended."""

SLACK_M = 0.02
"""Path that is kept in addition to the margin of a visit."""

SPLINE_POSES = 4
"""Poses of the odometry before the first sample that its interpolation needs."""


@dataclass
class Rows:
    """Preprocessed samples that may still be used, the newest last.

    Attributes
    ----------
    start : int
        Number of the first one since the start of the recording.
    """

    time_ns: Times
    values: Array
    start: int = 0
    size: int = 0

    @classmethod
    def empty(cls, width: int) -> Rows:
        """Return rows of ``width`` numbers."""
        return cls(np.empty(256, np.int64), np.empty((256, width)))

    @property
    def stop(self) -> int:
        """Number of the next sample."""
        return self.start + self.size

    def append(self, time_ns: Times, values: Array) -> None:
        """Append samples."""
        size = self.size + len(time_ns)
        if size > len(self.time_ns):
            self.time_ns = np.resize(self.time_ns, 2 * size)
            self.values = np.resize(self.values, (2 * size, self.values.shape[1]))
        self.time_ns[self.size : size] = time_ns
        self.values[self.size : size] = values
        self.size = size

    def drop_before(self, number: int) -> None:
        """Remove the samples before one; only if they are many, because the others are copied."""
        count = min(number - self.start, self.size)
        if count < max(256, self.size // 2):
            return
        self.time_ns = self.time_ns[count : self.size].copy()
        self.values = self.values[count : self.size].copy()
        self.start, self.size = self.start + count, self.size - count

    def clear(self) -> None:
        """Remove all samples."""
        self.start, self.size = self.stop, 0

    def column(self, which: int) -> Array:
        """Return one number (size,) of all samples."""
        return self.values[: self.size, which]


@dataclass
class FieldGroup:
    """Successive steps with fields around one position: samples ``first`` to ``stop - 1``.

    Attributes
    ----------
    first, stop : int
    centroid : (2,) ndarray
        Weighted with the squares of the fields, as is the sum ``weight``.
    weight : float
    earliest : int
        First sample that does not belong to the visit before.
    new_peak_t : float
        Strongest field since the visit was reported.
    is_reported : bool
    """

    first: int
    stop: int
    centroid: Array
    weight: float
    earliest: int
    new_peak_t: float
    is_reported: bool = False


@dataclass(frozen=True)
class CompletedVisit:
    """Visit to a landmark that the robot has left.

    Attributes
    ----------
    recording : HallRecording
        Samples around the visit.
    segment : VisitSegment
        Its samples are numbered from the start of the stream.
    is_revised : bool
        True if the robot returned to the landmark of the previous visit, which this one contains.
    """

    recording: HallRecording
    segment: VisitSegment
    is_revised: bool


class VisitStream:
    """Visits of one robot.

    Attributes
    ----------
    statistics : SensorStatistics or None
        None before the first samples.
    lag_ns : int
        Time by which the odometry is later than the fields; it may change.
    scale : float
        Readings relative to those expected.
    left_out : set of int
        Sensors that are not used.
    notes : dict of str to int
        Number of readings and poses that were left out, by reason.
    time_ns : int
        Time of the last pose that was used.
    """

    def __init__(
        self, device: str, geometry: Geometry, pitch_m: float, drift: OdometryDrift
    ) -> None:
        self.device, self.geometry, self.pitch_m, self.drift = device, geometry, pitch_m, drift
        self.statistics: SensorStatistics | None = None
        self.lag_ns, self.scale = 0, 1.0
        self.left_out: set[int] = set()
        self.notes = dict.fromkeys(
            ("spikes", "saturated", "odometry_invalid", "samples_without_odometry"), 0
        )
        self.time_ns = np.iinfo(np.int64).min
        # Observations that wait for those of the other kind.
        self._waiting_ns: Times = np.empty(0, np.int64)
        self._waiting_t: Array = np.empty((0, 0))
        self._odometry_ns: Times = np.empty(0, np.int64)
        self._odometry: Array = np.empty((0, 3))
        self._sampled_ns = np.iinfo(np.int64).min  # No sample up to this time is missing.
        # Valid poses of the odometry, with unwrapped headings.
        self._path_ns: Times = np.empty(0, np.int64)
        self._path: Array = np.empty((0, 3))
        self._is_invalid_between = False
        self._rows = Rows.empty(0)
        self._context_t: Array = np.empty((0, 0))  # Raw reading before the unjudged one.
        self._unjudged_ns: Times = np.empty(0, np.int64)
        self._unjudged_t: Array = np.empty((0, 0))
        self._last = np.zeros(5)  # Pose, path and distance of the last row.
        self._step_start, self._step_rows, self._is_resting = 0, 0, False
        self._group: FieldGroup | None = None
        self._field_path = -math.inf
        self._previous_stop = 0
        self._reported_first = 0
        self._kept_first: int | None = None  # First sample of the visit before, for merging.

    # ---- observations

    @property
    def sensors(self) -> HallSensors:
        """Sensors of the robot; ``ValueError`` if none are known."""
        if self.statistics is None:
            raise ValueError("no samples yet")
        return self.statistics.sensors

    def push_samples(self, samples: HallSamples) -> None:
        """Take the next samples."""
        if self.statistics is None:
            self.statistics = SensorStatistics(samples.sensors)
            count = len(samples.sensors)
            self._waiting_t = self._context_t = self._unjudged_t = np.empty((0, count))
            self._rows = Rows.empty(count + 9)
        is_new = samples.time_ns > self._sampled_ns
        field_t = plausible_fields(samples.field_t[is_new])
        self._waiting_ns = np.concatenate([self._waiting_ns, samples.time_ns[is_new]])
        self._waiting_t = np.concatenate([self._waiting_t, field_t])
        self._sampled_ns = max(self._sampled_ns, *samples.time_ns[-1:].tolist())

    def push_odometry(self, odometry: Trajectory) -> None:
        """Take the next poses."""
        is_plausible = is_plausible_odometry(odometry)
        with np.errstate(invalid="ignore", over="ignore"):
            heading = heading_from_quaternion(odometry.quaternion)
        pose = np.column_stack([odometry.position[:, :2], heading])
        pose[~is_plausible] = np.nan
        self._odometry_ns = np.concatenate([self._odometry_ns, odometry.time_ns])
        self._odometry = np.concatenate([self._odometry, pose])

    def visits(
        self, complete_ns: int | None = None, *, is_finished: bool = False
    ) -> Iterator[CompletedVisit]:
        """Yield the visits that the observations complete.

        Parameters
        ----------
        complete_ns : int, optional
            Time up to which no sample is missing, besides that of the last sample.
        is_finished : bool
            True if no observation is missing.
        """
        if complete_ns is not None:
            self._sampled_ns = max(self._sampled_ns, complete_ns)
        used = 0
        newest_ns = max(self._odometry_ns.tolist(), default=0)
        for used, (time_ns, pose) in enumerate(  # noqa: B007
            zip(self._odometry_ns.tolist(), self._odometry, strict=True)
        ):
            is_late = newest_ns - time_ns > MAX_WAITING_NS
            if not (is_finished or is_late or self._sampled_ns >= time_ns - self.lag_ns):
                break
            yield from self._take_pose(time_ns - self.lag_ns, pose)
        else:
            used = len(self._odometry_ns)
        self._odometry_ns, self._odometry = self._odometry_ns[used:], self._odometry[used:]
        if len(self._waiting_ns):
            is_kept = self._waiting_ns >= self._waiting_ns[-1] - MAX_WAITING_NS
            self._leave_out_waiting(~is_kept)
        if is_finished:
            self._leave_out_waiting(np.ones(len(self._waiting_ns), bool))
            if self.statistics is not None:
                yield from self._take_rows(np.empty(0, np.int64), self._waiting_t, is_last=True)
            if self._rows.stop > self._step_start:
                yield from self._close_step(self._rows.stop)
            yield from self._end_group()

    def _leave_out_waiting(self, chosen: NDArray[np.bool_]) -> None:
        """Leave out samples for which there is no odometry."""
        if chosen.any():
            self.notes["samples_without_odometry"] += int(chosen.sum())
            self._waiting_ns, self._waiting_t = self._waiting_ns[~chosen], self._waiting_t[~chosen]

    def _take_pose(self, time_ns: int, pose: Array) -> Iterator[CompletedVisit]:
        """Take one pose of the odometry, and the samples up to its time."""
        is_first = not len(self._path_ns)
        is_later = is_first or time_ns - self._path_ns[-1] >= MIN_POSE_INTERVAL_NS
        if not (is_later and np.isfinite(pose).all()):
            self.notes["odometry_invalid"] += 1
            self._is_invalid_between = True
            return
        self.time_ns = time_ns
        if not is_first:
            turn = math.remainder(float(pose[2] - self._path[-1, 2]), math.tau)
            pose = np.array([pose[0], pose[1], self._path[-1, 2] + turn])
        self._path_ns = np.append(self._path_ns, time_ns)
        self._path = np.vstack([self._path, pose])
        if is_first:
            self._leave_out_waiting(self._waiting_ns < time_ns)
            return
        count = int(np.searchsorted(self._waiting_ns, time_ns, "right"))
        times, field = self._waiting_ns[:count], self._waiting_t[:count]
        self._waiting_ns, self._waiting_t = self._waiting_ns[count:], self._waiting_t[count:]
        if self._is_invalid_between and self.statistics is not None:
            motion_m = sensor_motion(self.sensors, self._path[-2:])
            if motion_m[0] > MAX_INTERPOLATED_MOTION_M:
                self.notes["samples_without_odometry"] += len(times)
                times, field = times[:0], field[:0]
        self._is_invalid_between = False
        if self.statistics is not None:
            yield from self._take_rows(times, field)
            yield from self._check_departure(pose)
            yield from self._end_after_silence()
        self._drop_unused()

    def _end_after_silence(self) -> Iterator[CompletedVisit]:
        """End a visit, and forget its samples, if no samples came for long.

        The poses since the last sample are kept; without an end, their number would grow.
        """
        if len(self._unjudged_ns):
            newest_ns = int(self._unjudged_ns[-1])
        elif self._rows.size:
            newest_ns = int(self._rows.time_ns[self._rows.size - 1])
        else:
            return
        if self.time_ns - newest_ns <= MAX_SILENCE_NS:
            return
        self._unjudged_ns, self._unjudged_t = self._unjudged_ns[:0], self._unjudged_t[:0]
        self._context_t = self._context_t[:0]
        if self._rows.stop > self._step_start:
            yield from self._close_step(self._rows.stop)
        yield from self._end_group()
        self._kept_first = None
        self._step_start, self._step_rows = self._rows.stop, 0
        self._rows.clear()

    def _take_rows(
        self, time_ns: Times, field_t: Array, *, is_last: bool = False
    ) -> Iterator[CompletedVisit]:
        """Preprocess samples, and yield the visits that they complete.

        The newest sample is kept back until the next one is known, by which a spike is detected.
        """
        assert self.statistics is not None
        if len(time_ns):
            self.statistics.add_raw(field_t)
        times = np.concatenate([self._unjudged_ns, time_ns])
        raw = np.concatenate([self._unjudged_t, field_t])
        if not len(times):
            return
        pose = self._linear_pose(times)
        before = len(self._context_t)
        context = np.concatenate([self._context_t, raw])
        path = np.vstack([self._last[None, :3], pose]) if before else pose
        motion_m = sensor_motion(self.sensors, path)
        field = context.copy()
        noise_t = self.statistics.noise_t
        is_spike = detect_spikes(context, motion_m, noise_t)
        field[is_spike] = np.nan
        is_saturated = np.abs(field) >= SATURATION_FRACTION * self.statistics.range_t
        field[is_saturated] = np.nan
        judged = len(times) if is_last else len(times) - 1
        own = slice(before, before + judged)
        self.notes["spikes"] += int(is_spike[own].sum())
        self.notes["saturated"] += int(is_saturated[own].sum())
        field = field[own]
        if judged:
            self._context_t = raw[judged - 1 : judged]
        self._unjudged_ns, self._unjudged_t = times[judged:], raw[judged:]
        times, pose = times[:judged], pose[:judged]
        if not judged:
            return
        step_m = sensor_motion(self.sensors, np.vstack([self._last[None, :3], pose]))
        if not self._rows.stop:
            step_m[0] = 0.0
        sensor_path = np.cumsum(np.concatenate([self._last[3:4], step_m]))[1:]
        last_step = math.floor(self._last[3] / STEP_M)
        is_in_step = math.floor(sensor_path[-1] / STEP_M) == last_step
        was_resting, self._is_resting = self._is_resting, False
        if is_in_step and self._step_rows >= MAX_STEP_ROWS:
            self._is_resting = True
            if was_resting:  # No sample that is kept is next to the last pose but one.
                self._path_ns = np.delete(self._path_ns, -2)
                self._path = np.delete(self._path, -2, axis=0)
            return
        self.statistics.add_valid(field)
        field = field / self.scale
        unused = [*self.left_out, *np.flatnonzero(self.statistics.is_constant).tolist()]
        field[:, unused] = np.nan
        yield from self._append(times, field, pose, sensor_path)

    def _append(
        self, time_ns: Times, field_t: Array, pose: Array, sensor_path: Array
    ) -> Iterator[CompletedVisit]:
        """Append preprocessed samples, and yield the visits that they complete."""
        magnitude = np.nan_to_num(np.abs(field_t - self.offset_t))
        strongest = magnitude.max(axis=1)
        limit_t = MIN_FIELD_THRESHOLDS * self.geometry.threshold_t
        magnitude[magnitude < max(limit_t, MIN_FIELD_SIGMAS * self.noise_t)] = 0.0
        power = (magnitude**2).sum(axis=1)
        position = sensor_positions(pose, self.sensors.position_m)
        moment = np.einsum("ns,nsi->ni", magnitude**2, position)
        is_first = not self._rows.stop
        steps = np.diff(pose[:, :2], axis=0, prepend=pose[:1, :2] if is_first else [self._last[:2]])
        length = np.concatenate([self._last[4:], np.hypot(*steps.T)])
        distance = np.cumsum(length)[1:]
        first = self._rows.stop
        self._rows.append(
            time_ns,
            np.column_stack([field_t, pose, sensor_path, distance, power, moment, strongest]),
        )
        step = np.floor(sensor_path / STEP_M)
        before = math.floor(self._last[3] / STEP_M) if not is_first else step[0]
        self._last = np.array([*pose[-1], sensor_path[-1], distance[-1]])
        has_field = np.flatnonzero((power > 0) & (strongest >= self._min_peak_t))
        if len(has_field):
            self._field_path = float(sensor_path[has_field[-1]])
        for edge in np.flatnonzero(np.diff(step, prepend=before)).tolist():
            yield from self._close_step(first + edge)
        self._step_rows = self._rows.stop - self._step_start

    def _check_departure(self, pose: Array) -> Iterator[CompletedVisit]:
        """Yield the visit if the robot, which is at a pose by now, has left the landmark."""
        group = self._group
        if group is None:
            return
        motion_m = float(sensor_motion(self.sensors, np.vstack([self._last[:3], pose]))[0])
        since_field_m = float(self._last[3]) + motion_m - self._field_path
        if since_field_m > LEAVING_PATH_M and not self._has_nothing_new(group):
            yield from self._close_step(self._rows.stop)
            if self._group is group and not self._has_nothing_new(group):
                yield self._report(group, self._rows.stop)
        if since_field_m > MAX_RETURN_M or self._rows.stop - group.first > MAX_VISIT_ROWS:
            yield from self._end_group()
            self._kept_first = None

    def _has_nothing_new(self, group: FieldGroup) -> bool:
        """Return whether no strong field was measured since the visit began or was reported."""
        return group.new_peak_t < self._min_peak_t

    @property
    def _min_peak_t(self) -> float:
        """Least peak field of a visit that determines a landmark."""
        return MIN_PEAK_THRESHOLDS * self.geometry.threshold_t

    # ---- groups of fields

    def _close_step(self, stop: int) -> Iterator[CompletedVisit]:
        """Add the fields up to a sample to the visit, or begin another one with them."""
        first, self._step_start = self._step_start, stop
        own = self._rows.values[first - self._rows.start : stop - self._rows.start]
        power = float(own[:, -4].sum())
        if not power > 0:
            return
        position, peak_t = own[:, -3:-1].sum(axis=0) / power, float(own[:, -1].max())
        group = self._group
        if group is not None and np.hypot(*(position - group.centroid)) < self.pitch_m / 2:
            group.stop = stop
            group.weight += power
            group.centroid = group.centroid + (position - group.centroid) * power / group.weight
            group.new_peak_t = max(group.new_peak_t, peak_t)
            return
        if group is not None:
            yield from self._end_group(next_first=first)
        earliest = max((self._previous_stop + first) // 2, self._rows.start)
        self._group = FieldGroup(first, stop, position, power, earliest, peak_t)

    def _end_group(self, next_first: int | None = None) -> Iterator[CompletedVisit]:
        """End a visit, to which the robot cannot return any more."""
        group = self._group
        if group is None:
            return
        if not self._has_nothing_new(group):
            latest = self._rows.stop if next_first is None else (group.stop + next_first) // 2
            yield self._report(group, latest)
        self._group = None
        if group.is_reported:
            self._previous_stop = group.stop
            self._kept_first = self._reported_first

    def _report(self, group: FieldGroup, latest: int) -> CompletedVisit:
        """Return the visit of a group, up to a sample at most."""
        distance, start = self._rows.column(-5), self._rows.start
        begin = np.searchsorted(distance, distance[group.first - start] - MARGIN_M)
        end = np.searchsorted(distance, distance[group.stop - 1 - start] + MARGIN_M, "right")
        first = max(group.earliest, int(begin) + start)
        visit = self._build_visit(
            first, min(latest, int(end) + start), group.centroid, is_revised=group.is_reported
        )
        group.is_reported, group.new_peak_t = True, 0.0
        self._reported_first = first
        return visit

    def merged(
        self, first: VisitSegment, second: VisitSegment, centre: Array
    ) -> CompletedVisit | None:
        """Return two successive visits to the landmark at ``centre`` as one.

        None if their samples are not kept any more.
        """
        if first.first < self._rows.start:
            return None
        return self._build_visit(first.first, second.stop, centre, is_revised=True)

    def _build_visit(
        self, first: int, stop: int, centre: Array, *, is_revised: bool
    ) -> CompletedVisit:
        """Average the samples ``first`` to ``stop - 1``."""
        rows, count = self._rows, len(self.sensors)
        all_ns = rows.time_ns[: rows.size]
        # The velocities are differences over a short time.
        first_ns, last_ns = all_ns[first - rows.start], all_ns[stop - 1 - rows.start]
        low = max(int(np.searchsorted(all_ns, first_ns - VELOCITY_SPAN_NS)) - 1, 0)
        high = int(np.searchsorted(all_ns, last_ns + VELOCITY_SPAN_NS, "right")) + 1
        time_ns = all_ns[low:high].copy()
        field = rows.values[low : min(high, rows.size), :count].copy()
        recording = HallRecording(
            HallSamples(self.device, self.sensors, time_ns, field),
            interpolate_smoothly(time_ns, self._path_ns, self._path),
            self.offset_t,
            self.noise_t,
        )
        shift = rows.start + low
        segment = average_samples(recording, first - shift, stop - shift, centre, self.drift)
        segment = VisitSegment(first, stop, segment.time_ns, segment.trace, segment.origin)
        return CompletedVisit(recording, segment, is_revised)

    @property
    def offset_t(self) -> Array:
        """Offsets (N,) of the scaled readings."""
        assert self.statistics is not None
        return self.statistics.offset_t / self.scale

    @property
    def noise_t(self) -> float:
        """Standard deviation of a scaled reading."""
        assert self.statistics is not None
        return self.statistics.noise_t / self.scale

    # ---- memory

    def correct_scale(self, factor: float) -> None:
        """Divide further readings by a factor more, and discard the visit in progress."""
        self.scale *= factor
        self._restart()

    def leave_out(self, sensor: int) -> None:
        """Use one sensor no more, and discard the visit in progress."""
        self.left_out.add(sensor)
        self._restart()

    def _restart(self) -> None:
        """Discard the visit in progress, which used the previous scale or sensors."""
        self._group, self._kept_first = None, None
        self._previous_stop = self._step_start = self._rows.stop

    def _linear_pose(self, time_ns: Times) -> Array:
        """Interpolate the poses (n, 3) linearly, for the division into visits."""
        known_s = 1e-9 * (self._path_ns - self._path_ns[0])
        wanted_s = 1e-9 * (time_ns - self._path_ns[0])
        return np.column_stack([np.interp(wanted_s, known_s, each) for each in self._path.T])

    def _drop_unused(self) -> None:
        """Forget samples and poses that no visit can contain any more."""
        rows = self._rows
        if rows.size:
            distance = rows.column(-5)
            reached_m = (
                distance[-1]
                if self._group is None
                else distance[max(self._group.first - rows.start, 0)]
            )
            kept = rows.start + int(np.searchsorted(distance, reached_m - MARGIN_M - SLACK_M))
            kept = min(kept, self._step_start)
            if self._kept_first is not None:
                is_recent = rows.stop - self._kept_first <= MAX_VISIT_ROWS
                kept = min(kept, self._kept_first) if is_recent else kept
            rows.drop_before(max(kept, rows.stop - 2 * MAX_VISIT_ROWS))
        first_ns = rows.time_ns[0] if rows.size else self._path_ns[-1]
        first_ns = min(first_ns, *self._unjudged_ns.tolist(), self._path_ns[-1])
        first = int(np.searchsorted(self._path_ns, first_ns)) - SPLINE_POSES
        if first > max(64, len(self._path_ns) // 2):
            self._path_ns, self._path = self._path_ns[first:].copy(), self._path[first:].copy()
