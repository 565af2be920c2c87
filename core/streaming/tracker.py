"""Pose of one device at any time: fixes of its system, carried by odometry or an IMU.

A device without odometry and IMU has the poses of its fixes, unchanged. With odometry, the filter
of :mod:`.planar_filter` gives a pose at each odometry sample, with an IMU alone that of
:mod:`.inertial_filter` at each of its samples; a fix that is newer than the last pose gives one at
once. (If a device has both, odometry is used.) Poses that were published are never retracted: a fix
that is late or contradicts them changes the next pose, and a :class:`.Correction` says so.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from locatk.core.geometry import (
    quaternion_from_heading,
    quaternion_multiply,
)
from locatk.core.inertial import InertialSamples
from locatk.core.streaming import inertial_filter, planar_filter
from locatk.core.streaming.events import (
    ArtifactUpdate,
    Correction,
    Fix,
    LiveEvent,
    PoseEstimate,
    StateChange,
    TrackingState,
)
from locatk.core.streaming.history import CHI2_999, FilterHistory, NewestState
from locatk.core.streaming.inertial_filter import (
    MAX_SILENCE_S,
    InertialFilter,
    InertialNoise,
)
from locatk.core.streaming.planar_filter import OdometryNoise, PlanarFilter
from locatk.core.streaming.plausibility import (
    MAX_ANGULAR_RATE_RAD_S,
    MAX_SPECIFIC_FORCE_M_S2,
    is_plausible_odometry,
)
from locatk.core.trajectory import PROVISIONAL_PROBABILITY, Trajectory

Array = NDArray[np.float64]


class StateReason(StrEnum):
    """Reasons of states other than ``TRACKING`` that a tracker gives (streams give others)."""

    NO_FIX = "no fix yet"
    SILENT = "no fix and no motion data"
    NO_RECENT_FIX = "no recent fix"
    AMBIGUOUS = "other positions are possible"
    UNCERTAIN = "sigma above the limit"
    ODOMETRY_JUMP = "jump of the odometry"


REPLACEABLE_REASONS = (
    StateReason.NO_FIX,
    StateReason.SILENT,
    StateReason.NO_RECENT_FIX,
    StateReason.AMBIGUOUS,
)
"""Reasons that are replaced by that of the system's stream, which says more."""

ODOMETRY_CAPACITY, INERTIAL_CAPACITY = 2048, 1024
"""Number of motions and fixes that are kept for late fixes: 20 s of odometry at 50 Hz and fixes at
50 Hz, 5 s of an IMU at 100 Hz and fixes at 100 Hz. A Polaris tag of 0.3 m at 0.05 m/s takes 6 s,
and its fix may be as late as its length."""

MAX_EARLY_FIXES = 8
"""Number of fixes before the first odometry that are kept."""

MAX_EXTRAPOLATION_S = 0.25
"""Time after the newest motion (odometry or IMU) up to which it is extrapolated to a fix [s]: one
sample is missing at 10 Hz, and its successor is late."""

MAX_ODOMETRY_SPEED_M_S, MAX_ODOMETRY_RATE_RAD_S, MIN_JUMP_M = 20.0, 30.0, 0.05
"""Speed and rate above which a step of the odometry is a jump (a restart of its driver), and the
length up to which a step is none: time stamps that jitter make short steps fast."""

JUMP_MARGIN_RAD = 0.5
"""Angle of a step beyond that of the largest rate from which it is a jump [rad]."""

CONTRADICTION = "fix contradicts the prediction"
"""Reason of a correction without a known source."""

MAX_INERTIAL_READING = np.repeat([MAX_SPECIFIC_FORCE_M_S2, MAX_ANGULAR_RATE_RAD_S], 3)
"""Limits (6,) of the readings of accelerometer and gyroscope [m/s^2 and rad/s]."""

PROVISIONAL_REFUSALS = 3
"""Number of provisional fixes in a row that end a pose that was certain."""

MIN_INDEPENDENT_FRACTION = 1e-3
"""Least part of the variance of a fix that is taken as independent of other fixes."""

ON_PLANE, OFF_PLANE = np.ix_([0, 1, 5], [0, 1, 5]), np.ix_([2, 3, 4], [2, 3, 4])
"""Blocks of a covariance of poses: x, y, heading; z, roll, pitch."""


@dataclass(frozen=True)
class TrackerSettings:
    """Settings of a tracker.

    Attributes
    ----------
    fix_timeout_s : float
        Age of the last fix from which on a pose is dead reckoning.
    lost_timeout_s : float
        Time without any fix or sample of odometry or IMU after which the device is lost.
    max_sigma_m : float
        Standard deviation of the position above which the device is lost.
    refusals_before_reset : int
        Number of fixes in a row that contradict the prediction after which the filter starts
        anew from the last of them. 1 if fixes are no outliers, because a code identifies them.
    odometry, inertial : OdometryNoise, InertialNoise
    """

    fix_timeout_s: float = 0.2
    lost_timeout_s: float = 1.0
    max_sigma_m: float = 0.5
    refusals_before_reset: int = 3
    odometry: OdometryNoise = field(default_factory=OdometryNoise)
    inertial: InertialNoise = field(default_factory=InertialNoise)


DEFAULT_SETTINGS = {
    "lighthouse": TrackerSettings(),
    "dots": TrackerSettings(),
    "polaris": TrackerSettings(fix_timeout_s=1.0, lost_timeout_s=3.0, refusals_before_reset=1),
    "landmarks": TrackerSettings(fix_timeout_s=1.0, lost_timeout_s=3.0, refusals_before_reset=1),
}
"""Settings by system. Lighthouse and dots have fixes at 10 to 100 Hz, some of which are wrong
(reflections); those of Polaris and landmarks are rare, and their codes exclude wrong ones."""


class DeviceTracker:
    """Poses of one device from its fixes and its odometry or IMU.

    Parameters
    ----------
    device : str
    settings : TrackerSettings, optional

    Attributes
    ----------
    rejected : dict of str to int
        Numbers of fixes that were refused by the filter (``refused_fixes``) or came too late for it
        (``late_fixes``), and of motions that were invalid (``bad_motions``) or jumped
        (``odometry_jumps``).
    """

    def __init__(self, device: str, settings: TrackerSettings | None = None) -> None:
        self.device = device
        self.settings = settings or TrackerSettings()
        self.rejected = dict.fromkeys(
            ("refused_fixes", "late_fixes", "bad_motions", "odometry_jumps"), 0
        )
        self._history: FilterHistory | None = None
        self._is_planar = False
        self._odometry_pose: tuple[float, ...] | None = None
        self._reading: Array | None = None
        self._early_fixes: deque[Fix] = deque(maxlen=MAX_EARLY_FIXES)
        self._unfused: tuple[int, Array] | None = None
        self._last_fix: Fix | None = None
        self._off_plane: _FixOffPlane | None = None
        self._frame: str | None = None
        self._restart_reason = ""
        self._published_ns: int | None = None
        self._reset_counter = 0
        self._state: TrackingState | None = None
        self._reason, self._own_reason, self._stream_reason = "", "", ""
        self._state_ns = 0

    # ---- input

    def fix(self, fix: Fix, source: str = "") -> list[LiveEvent]:
        """Return the events of a fix; ``source`` names it in a correction, as in ``"tag 77"``."""
        events = self._expire(fix.time_ns)
        if not _is_provisional(fix):
            self._stream_reason = ""
        if self._frame is not None and fix.frame != self._frame:
            self._restart_reason = f"frame {fix.frame}"
            self._early_fixes.clear()
        is_other_frame = self._frame is not None and fix.frame != self._frame
        self._frame = fix.frame
        history = self._history
        if history is None or not self._has_recent_motion(fix.time_ns):
            if history is None:
                self._early_fixes.append(fix)
            else:
                self._unfused = fix.time_ns, self._measurement(fix)
            self._use(fix)
            if self._restart_reason:
                events.append(self._correct(None, None, fix, self._restart_reason))
            return events + self._publish(_estimate_of(fix))
        head_ns = history.time_ns
        assert head_ns is not None
        time_ns = max(fix.time_ns, head_ns)
        before = history.newest_state()
        accepted, refused, resets = self._counters()
        if not history.add_fix(fix.time_ns, self._measurement(fix)):
            self.rejected["late_fixes"] += 1
            return events
        now_accepted, now_refused, now_resets = self._counters()
        self.rejected["refused_fixes"] += max(now_refused - refused, 0)
        # A fix in the order of time without a reset is refused, or within the gate: no jump.
        is_usual = fix.time_ns >= head_ns and now_resets == resets and not self._restart_reason
        predicted = None if is_usual else self._estimate(time_ns, before)
        if now_accepted > accepted:
            self._use(fix)
        estimate = self._estimate(time_ns)
        if predicted is not None and estimate is not None and not is_other_frame:
            is_jump = now_resets > resets or _is_beyond(predicted, estimate)
            if is_jump or self._restart_reason:
                reason = self._restart_reason or source or CONTRADICTION
                events.append(self._correct(predicted, estimate, fix, reason))
        elif self._restart_reason or now_resets > resets:
            reason = self._restart_reason or source or CONTRADICTION
            events.append(self._correct(None, None, fix, reason))
        if estimate is None and self._last_fix is fix:
            # The heading is still unknown, so that odometry cannot carry the position.
            estimate = _estimate_of(fix)
        return events if estimate is None else events + self._publish(estimate)

    def odometry(self, odometry: Trajectory) -> list[LiveEvent]:
        """Return the events of odometry: poses in any frame that does not move."""
        events: list[LiveEvent] = []
        is_plausible = is_plausible_odometry(odometry).tolist()
        for index, time_ns in enumerate(odometry.time_ns.tolist()):
            pose = None
            if is_plausible[index]:
                x, y, _ = odometry.position[index].tolist()
                heading = _heading(odometry.quaternion[index])
                pose = x, y, heading, float(odometry.covariance[index, 5, 5])
            events += self._take_odometry_pose(time_ns, pose)
        return events

    def inertial(self, samples: InertialSamples) -> list[LiveEvent]:
        """Return the events of samples of an IMU; none if the device has odometry."""
        events: list[LiveEvent] = []
        if self._is_planar:
            return events
        readings = np.column_stack([samples.acceleration, samples.angular_rate])
        for time_ns, reading in zip(samples.time_ns.tolist(), readings, strict=True):
            events += self._take_reading(time_ns, reading)
        return events

    def advance(self, time_ns: int) -> list[LiveEvent]:
        """Return the events that follow from the time alone.

        The caller has passed on all observations up to it.
        """
        return self._expire(time_ns)

    def take_reason(self, change: StateChange) -> list[LiveEvent]:
        """Use the reason of the system's stream; the tracker itself decides on the state."""
        is_tracking = change.state is TrackingState.TRACKING
        self._stream_reason = "" if is_tracking else change.reason
        if self._state is None:
            return self._set_state(TrackingState.LOST, StateReason.NO_FIX, change.time_ns)
        if self._state is TrackingState.TRACKING or not self._is_replaceable:
            return []
        return self._set_state(self._state, self._own_reason, change.time_ns)

    def use_artifact(self, update: ArtifactUpdate) -> None:
        """Start anew with the next fix, because later fixes refer to another artifact."""
        if self._frame is not None:
            self._restart_reason = f"scene version {update.version}"

    # ---- motion

    def _has_recent_motion(self, time_ns: int) -> bool:
        """Return whether the motion up to a time is known, or can be extrapolated to it."""
        motion_ns = self._history.motion_time_ns if self._history is not None else None
        return motion_ns is not None and time_ns - motion_ns <= MAX_EXTRAPOLATION_S * 1e9

    def _take_odometry_pose(self, time_ns: int, pose: tuple[float, ...] | None) -> list[LiveEvent]:
        """Add the motion since the previous pose; None is a pose that is not plausible."""
        if not self._is_planar:
            self._begin_odometry()
        assert self._history is not None
        before, before_ns = self._odometry_pose, self._history.motion_time_ns
        if pose is None or (before_ns is not None and time_ns <= before_ns):
            self.rejected["bad_motions"] += 1
            return []
        events = self._expire(time_ns)
        motion = np.zeros(4)
        if before is not None and before_ns is not None:
            motion, duration_s = _twist(before, pose), (time_ns - before_ns) * 1e-9
            distance_m, angle = math.hypot(motion[0], motion[1]), abs(motion[2])
            if (
                distance_m > max(MIN_JUMP_M, MAX_ODOMETRY_SPEED_M_S * duration_s)
                or angle > MAX_ODOMETRY_RATE_RAD_S * duration_s + JUMP_MARGIN_RAD
            ):
                self.rejected["odometry_jumps"] += 1
                self._begin_odometry()
                self._early_fixes.clear()
                self._unfused = None
                self._last_fix = None
                self._reset_counter = (self._reset_counter + 1) % 256
                events += self._set_state(TrackingState.LOST, StateReason.ODOMETRY_JUMP, time_ns)
        self._odometry_pose = pose
        return events + self._add_motion(time_ns, motion)

    def _begin_odometry(self) -> None:
        self._history = FilterHistory(PlanarFilter(self.settings.odometry), ODOMETRY_CAPACITY)
        self._is_planar = True

    def _take_reading(self, time_ns: int, reading: Array) -> list[LiveEvent]:
        """Add the motion since the previous reading (6,) of an IMU."""
        if self._history is None:
            model = InertialFilter(self.settings.inertial)
            self._history = FilterHistory(model, INERTIAL_CAPACITY)
        before, before_ns = self._reading, self._history.motion_time_ns
        is_plausible = np.abs(reading) < MAX_INERTIAL_READING
        # A sensor that was not sampled keeps its reading.
        reading = np.where(is_plausible, reading, np.nan if before is None else before)
        if not np.isfinite(reading).all() or (before_ns is not None and time_ns <= before_ns):
            self.rejected["bad_motions"] += 1
            return []
        events = self._expire(time_ns)
        self._reading = reading
        motion = reading
        if before is not None and before_ns is not None:
            is_silent = time_ns - before_ns > MAX_SILENCE_S * 1e9
            motion = np.full(6, np.nan) if is_silent else (before + reading) / 2
        return events + self._add_motion(time_ns, motion)

    def _add_motion(self, time_ns: int, motion: Array) -> list[LiveEvent]:
        """Return the events of the motion since the previous sample."""
        history = self._history
        assert history is not None
        history.add_motion(time_ns, motion)
        while self._early_fixes:
            fix = self._early_fixes.popleft()
            history.add_fix(fix.time_ns, self._measurement(fix))
        if self._unfused is not None:
            # Of a silence of the odometry, only the latest fix is used; all were published.
            history.add_fix(*self._unfused)
            self._unfused = None
        head_ns = history.time_ns
        assert head_ns is not None
        estimate = self._estimate(head_ns)
        if estimate is not None:
            return self._publish(estimate)
        if self._last_fix is None and self._state is None:
            return self._set_state(TrackingState.LOST, StateReason.NO_FIX, time_ns)
        return []

    # ---- filter

    def _counters(self) -> tuple[int, int, int]:
        """Return the numbers of accepted and refused fixes and of resets of the filter."""
        assert self._history is not None
        state, components = self._history.state, self._components
        return (
            int(state[components.ACCEPTED]),
            int(state[components.REFUSED]),
            int(state[components.RESETS]),
        )

    @property
    def _components(self) -> Any:
        """Module with the names of the components of the filter's state."""
        return planar_filter if self._is_planar else inertial_filter

    @property
    def _is_running(self) -> bool:
        """True if the filter has a pose."""
        components = self._components
        assert self._history is not None
        return bool(self._history.state[components.PHASE] == components.RUNNING)

    def _measurement(self, fix: Fix) -> Array:
        """Return a fix as the filter takes it: with errors that are independent of other fixes."""
        is_provisional = _is_provisional(fix)
        max_refusals = self.settings.refusals_before_reset
        if self._restart_reason:
            max_refusals = 0
        elif is_provisional:
            max_refusals = max(max_refusals, PROVISIONAL_REFUSALS)
        handling = [float(max_refusals), float(is_provisional)]
        covariance = independent_covariance(fix)
        if not self._is_planar:
            return np.concatenate([fix.position, fix.quaternion, covariance.ravel(), handling])
        pose = np.array([*fix.position[:2], _heading(fix.quaternion)])
        plane = covariance[ON_PLANE]
        pose[np.isnan(np.diagonal(plane))] = np.nan
        return np.concatenate([pose, plane.ravel(), handling])

    def _estimate(self, time_ns: int, newest: NewestState | None = None) -> PoseEstimate | None:
        """Return the pose by the filter at a time that is not before its state, if there is one."""
        fix = self._last_fix
        assert self._history is not None
        if fix is None:
            return None
        state, covariance = self._history.predict(time_ns, newest)
        if state[self._components.PHASE] != self._components.RUNNING:
            return None
        if self._is_planar:
            if self._off_plane is None or self._off_plane.fix is not fix:
                self._off_plane = _FixOffPlane(fix)
            position, quaternion, covariance = self._off_plane.pose(state, covariance)
        else:
            position = state[inertial_filter.POSITION].copy()
            quaternion = state[inertial_filter.QUATERNION].copy()
            covariance = inertial_filter.pose_covariance(state, covariance)
            if fix.common_covariance is not None:
                covariance = covariance + np.nan_to_num(fix.common_covariance)
        return PoseEstimate(
            self.device, fix.frame, time_ns, position, quaternion, covariance, fix.probability
        )

    # ---- output

    def _use(self, fix: Fix) -> None:
        """Remember an accepted fix if it is the newest."""
        if self._last_fix is None or fix.time_ns >= self._last_fix.time_ns or self._restart_reason:
            self._last_fix = fix

    def _correct(
        self,
        predicted: PoseEstimate | None,
        estimate: PoseEstimate | None,
        fix: Fix,
        reason: str,
    ) -> Correction:
        """Return the correction from a pose to another, and count the discontinuity."""
        self._reset_counter = (self._reset_counter + 1) % 256
        self._restart_reason = ""
        displacement_m, rotation = np.full(3, np.nan), math.nan
        if predicted is not None and estimate is not None:
            displacement_m = estimate.position - predicted.position
            rotation = _rotation(predicted, estimate)
        time_ns = max(fix.time_ns, self._published_ns or fix.time_ns)
        return Correction(self.device, time_ns, displacement_m, rotation, reason)

    def _publish(self, estimate: PoseEstimate) -> list[LiveEvent]:
        """Return a pose with its state, if it is newer than the last one."""
        if self._published_ns is not None and estimate.time_ns <= self._published_ns:
            return []
        fix = self._last_fix
        assert fix is not None
        state, reason = TrackingState.TRACKING, ""
        variance = max(float(estimate.covariance[0, 0]), float(estimate.covariance[1, 1]))
        if not variance <= self.settings.max_sigma_m**2:
            state, reason = TrackingState.LOST, StateReason.UNCERTAIN
        elif _is_provisional(fix):
            state, reason = TrackingState.PROVISIONAL, StateReason.AMBIGUOUS
        elif estimate.time_ns - fix.time_ns > self.settings.fix_timeout_s * 1e9:
            state, reason = TrackingState.DEAD_RECKONING, StateReason.NO_RECENT_FIX
        events = self._set_state(state, reason, estimate.time_ns)
        if state is TrackingState.LOST:
            return events
        self._published_ns = estimate.time_ns
        pose = PoseEstimate(
            self.device,
            estimate.frame,
            estimate.time_ns,
            estimate.position,
            estimate.quaternion,
            estimate.covariance,
            estimate.probability,
            state,
            self._reason,
            self._reset_counter,
        )
        return [*events, pose]

    def _expire(self, time_ns: int) -> list[LiveEvent]:
        """Return the changes of state by timeouts before a time."""
        fix, settings = self._last_fix, self.settings
        if fix is None:
            return []
        motion_ns = self._history.motion_time_ns if self._history is not None else None
        lost_ns = max(fix.time_ns, motion_ns or fix.time_ns) + round(1e9 * settings.lost_timeout_s)
        stale_ns = fix.time_ns + round(1e9 * settings.fix_timeout_s)
        events: list[LiveEvent] = []
        is_stale = self._state is TrackingState.TRACKING and stale_ns < min(time_ns, lost_ns)
        if is_stale and self._history is not None and self._is_running:
            events += self._set_state(
                TrackingState.DEAD_RECKONING, StateReason.NO_RECENT_FIX, stale_ns + 1
            )
        if self._state is not TrackingState.LOST and lost_ns < time_ns:
            events += self._set_state(TrackingState.LOST, StateReason.SILENT, lost_ns + 1)
        return events

    @property
    def _is_replaceable(self) -> bool:
        """True if a reason of the system says more than that of the tracker."""
        return self._own_reason in REPLACEABLE_REASONS

    def _set_state(self, state: TrackingState, reason: str, time_ns: int) -> list[LiveEvent]:
        """Return the change of state, if it is one."""
        self._own_reason = reason
        if self._stream_reason and self._is_replaceable:
            reason = self._stream_reason
        if state is self._state and reason == self._reason:
            return []
        self._state, self._reason = state, str(reason)
        self._state_ns = max(time_ns, self._state_ns)
        return [StateChange(self.device, self._state_ns, state, self._reason)]


def independent_covariance(fix: Fix) -> Array:
    """Return the covariance (6, 6) of the errors that a fix does not share with other fixes."""
    if fix.common_covariance is None:
        return fix.covariance
    known = np.flatnonzero(np.isfinite(np.diagonal(fix.covariance)))
    index = known[:, None], known
    total = fix.covariance[index]
    sigma = np.sqrt(np.diagonal(total))
    correlation = total / np.outer(sigma, sigma) + 1e-12 * np.eye(len(known))
    common = np.nan_to_num(fix.common_covariance[index]) / np.outer(sigma, sigma)
    # In the coordinates in which the total is the identity, eigenvalues are fractions of it.
    root = np.linalg.cholesky(correlation)
    whitened = np.linalg.solve(root, np.linalg.solve(root, correlation - common).T)
    fraction, axes = np.linalg.eigh((whitened + whitened.T) / 2)
    axes = root @ axes
    part = axes * np.clip(fraction, MIN_INDEPENDENT_FRACTION, 1.0) @ axes.T
    result = np.full((6, 6), np.nan)
    result[index] = part * np.outer(sigma, sigma)
    return result


def _is_provisional(fix: Fix) -> bool:
    return fix.probability < PROVISIONAL_PROBABILITY


def _estimate_of(fix: Fix) -> PoseEstimate:
    """Return a fix as an estimate."""
    return PoseEstimate(
        fix.device,
        fix.frame,
        fix.time_ns,
        fix.position,
        fix.quaternion,
        fix.covariance,
        fix.probability,
    )


def _twist(before: tuple[float, ...], after: tuple[float, ...]) -> Array:
    """Return the motion (4,) between two planar poses as the filter takes it."""
    dx, dy = after[0] - before[0], after[1] - before[1]
    rotation = math.remainder(after[2] - before[2], 2 * math.pi)
    c, s = math.cos(before[2]), math.sin(before[2])
    rx, ry = planar_filter.logarithm(c * dx + s * dy, c * dy - s * dx, rotation)
    return np.array([rx, ry, rotation, after[3] - before[3]])


class _FixOffPlane:
    """What poses in the plane take from the last fix: height, roll, pitch and common errors."""

    def __init__(self, fix: Fix) -> None:
        self.fix = fix
        self.height_m = float(fix.position[2])
        level = quaternion_from_heading(-_heading(fix.quaternion))
        self.tilt = quaternion_multiply(level, fix.quaternion).tolist()
        self.covariance = np.zeros((6, 6))
        self.covariance[OFF_PLANE] = fix.covariance[OFF_PLANE]
        if fix.common_covariance is not None:
            self.covariance[ON_PLANE] = np.nan_to_num(fix.common_covariance[ON_PLANE])
        unknown = np.isnan(np.diagonal(self.covariance))
        self.covariance[unknown], self.covariance[:, unknown] = np.nan, np.nan

    def pose(self, state: Array, covariance: Array) -> tuple[Array, Array, Array]:
        """Return position, quaternion and covariance (6, 6) of a state of the planar filter."""
        x, y, heading = state[:3].tolist()
        # The product of a rotation about the vertical and the tilt.
        s, c = math.sin(heading / 2), math.cos(heading / 2)
        tx, ty, tz, tw = self.tilt
        quaternion = np.array([c * tx - s * ty, c * ty + s * tx, c * tz + s * tw, c * tw - s * tz])
        full = self.covariance.copy()
        full[ON_PLANE] += planar_filter.pose_covariance(state, covariance)
        return np.array([x, y, self.height_m]), quaternion, full


def _heading(quaternion: Array) -> float:
    """Return the heading of one quaternion (4,), see :func:`.geometry.heading_from_quaternion`."""
    x, y, z, w = quaternion.tolist()
    return math.atan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)


def _rotation(first: PoseEstimate, second: PoseEstimate) -> float:
    """Return the rotation about the vertical from one pose to another."""
    headings = [_heading(each.quaternion) for each in (first, second)]
    return math.remainder(headings[1] - headings[0], 2 * math.pi)


def _is_beyond(predicted: PoseEstimate, estimate: PoseEstimate) -> bool:
    """Return whether a pose contradicts the covariance of the predicted one."""
    shift = estimate.position - predicted.position
    difference = np.array([shift[0], shift[1], _rotation(predicted, estimate)])
    covariance = predicted.covariance[ON_PLANE]
    return bool(difference @ np.linalg.solve(covariance, difference) > CHI2_999[3])
