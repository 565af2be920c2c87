"""Causal poses of rigid devices in a known scene.

A device without a pose is solved like a seed of the offline solver
(:mod:`locatk.core.lighthouse.devices.tracking`): by PnP, with all hypotheses. Later poses start
from the last one. Each pose is fitted to the sweeps of the last two rotations and refers to their
mean time, where pose and rates are least correlated. A new one follows with each rotation of the
fastest station.

The fit has the unknowns, the prior on rates and the loss of
:mod:`locatk.core.lighthouse.devices.pose_fit`. Each sweep is corrected to that of an ideal plane
when it comes, by the table of :class:`.known_scene.AngleCorrection`, so that its residual is the
angle between a fixed plane and its photodiode. This takes a tenth of the time of the offline fit.

Successive windows share half of their sweeps. The variance of the noise is doubled, so that the
average of fixes has the covariance of independent ones.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from locatk.core.geometry import quaternion_from_matrix, rotation_angle
from locatk.core.lighthouse.channels import period_counts
from locatk.core.lighthouse.devices.device_sweeps import (
    MAX_SWEEPS_PER_WINDOW,
    MIN_SENSORS,
    MIN_SWEEPS,
    ROTATIONS_PER_WINDOW,
    DeviceSweeps,
    SweepWindows,
    rotation_limits_ns,
)
from locatk.core.lighthouse.devices.pose_fit import RATE, RATE_SIGMA
from locatk.core.lighthouse.devices.tracking import (
    INITIAL_SIGMA_RAD,
    LOSS_SCALE_RAD,
    LOSS_SCALE_SIGMAS,
    MAX_POSE_SIGMA_M_RAD,
    MAX_PROPAGATION_GAP_S,
    MAX_SEED_MARGIN,
    MAX_UNPREDICTED_ROTATION_RAD,
    MIN_INLIER_FRACTION,
    MIN_SEED_MARGIN,
    OUTLIER_CUTOFF_RAD,
    SOLVED,
    WEAK_INFORMATION,
    EpochStates,
    TrackingProblem,
    angle_noise,
    solve_seeds,
)
from locatk.core.lighthouse.light_planes import ROTOR_ZERO_RAD
from locatk.core.lighthouse.noise import (
    ANGLE_SIGMA_RAD,
    INLIER_GATE_RAD,
    INLIER_GATE_SIGMAS,
    MIN_INLIER_GATE_RAD,
)
from locatk.core.lighthouse.receiver import Receiver
from locatk.core.lighthouse.recording import UNKNOWN
from locatk.core.lighthouse.stream.known_scene import KnownScene
from locatk.core.lighthouse.stream.plane_tracking import PlaneTracker, Sweep
from locatk.core.lighthouse.stream.recent_path import MAX_LATENESS_NS, RecentPath
from locatk.core.robust import robust_sigma
from locatk.core.streaming.events import Fix
from locatk.core.trajectory import PROVISIONAL_PROBABILITY

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MAX_FIT_ITERATIONS = 8
"""Gauss-Newton steps of a pose; two are usual."""

MAX_POSITION_STEP_M, MAX_ROTATION_STEP_RAD = 0.3, 0.5
"""Largest step that a predicted pose needs. A larger one means that it is lost."""

CONVERGED_COST = 0.01
"""Square of a step, in standard deviations of the pose, at which a fit ends: a tenth of one. The
next step would be several times smaller."""

FIRST_SEED_INTERVAL_NS, MAX_SEED_INTERVAL_NS = 40_000_000, 640_000_000
"""Time between attempts to find the pose of a device without an initial guess [ns]. It doubles with
each, because one takes as long as a hundred fits."""

AMBIGUITY_INTERVAL_NS = 1_000_000_000
"""Time between attempts to find the orientation of a device that had two [ns]."""

MAX_PARTNER_AGE_NS = 30_000_000
"""Largest age of the other plane's angle from which the correction of an angle is computed [ns]. It
changes the correction by a hundredth of its own change."""

NOISE_WINDOWS = 24
"""Number of windows from which the noise of a device is estimated."""

MIN_NOISE_WINDOWS = 8
"""Fewest windows from which the noise of a device is estimated."""

FIRST_SIGMA_RAD = MIN_INLIER_GATE_RAD / INLIER_GATE_SIGMAS
"""Standard deviation of an angle before it is estimated [rad]."""

CONFIRMING_WINDOWS = 25
"""Successive poses that depart from the path and agree with each other: the device was carried
there. Reflections last for about half a second."""

WINDOW_OVERLAP = 2.0
"""Number of windows that share a sweep."""


class PlaneRow(NamedTuple):
    """Sweep as the plane on which its photodiode was."""

    time_ns: int
    sensor: int
    station: int
    plane: int
    angle: float
    values: tuple[float, ...]
    """Normal (3), lever arm in the device (3), station (3), its up (3), tangent of the tilt."""


@dataclass
class PoseState:
    """Pose with rates at one time; ``margin`` is that of its seed."""

    time_ns: int
    position: Array
    rotation: Array
    rate: Array
    margin: float

    def later(self, time_ns: int) -> PoseState:
        """Return the pose at another time, with constant rates."""
        seconds = (time_ns - self.time_ns) * 1e-9
        return PoseState(
            time_ns,
            self.position + self.rate[:3] * seconds,
            _rotation((self.rate[3:] * seconds).tolist()) @ self.rotation,
            self.rate,
            self.margin,
        )


@dataclass(frozen=True)
class WindowFit:
    """Fit of a pose to the planes of a window; ``information`` is for ``sigma_rad``."""

    state: PoseState
    residual: Array
    information: Array
    sigma_rad: float


@dataclass
class DeviceState:
    """Recent sweeps and pose of one device."""

    name: str
    receiver: Receiver
    has_position: list[bool]
    levers: list[list[float]]
    planes: dict[int, PlaneTracker] = field(default_factory=dict)
    angles: dict[tuple[int, int, int], tuple[int, float]] = field(default_factory=dict)
    rows: deque[PlaneRow] = field(default_factory=lambda: deque(maxlen=MAX_SWEEPS_PER_WINDOW))
    pose: PoseState | None = None
    newest_ns: int = 0
    next_ns: int | None = None
    next_seed_ns: int = 0
    seed_interval_ns: int = FIRST_SEED_INTERVAL_NS
    sigma_rad: float = FIRST_SIGMA_RAD
    lasting_rad: float = 0.0
    gate_rad: float = INLIER_GATE_RAD
    path: RecentPath = field(default_factory=RecentPath)
    windows: deque[tuple[list[PlaneRow], Array]] = field(
        default_factory=lambda: deque(maxlen=NOISE_WINDOWS)
    )


class RigidFixes:
    """Fixes of all rigid devices of a stream.

    Parameters
    ----------
    known : KnownScene
    receivers : mapping of str to Receiver
    count_rejected : callable
        Takes a reason and a number.

    Attributes
    ----------
    used, rejected : list of int
        By station: sweeps that agree with accepted poses, and others.
    residual : list of deque of float
        By station, the last residuals of used sweeps.
    """

    def __init__(
        self,
        known: KnownScene,
        receivers: dict[str, Receiver],
        count_rejected: Callable[[str, int], None],
    ) -> None:
        self.known = known
        n = len(known.stations)
        self.used, self.rejected = [0] * n, [0] * n
        self.residual = [deque[float](maxlen=512) for _ in range(n)]
        self._receivers = receivers
        self._reject = count_rejected
        self._devices: dict[str, DeviceState] = {}
        self._turn = [2 * math.pi / float(period_counts(s.channel)) for s in known.stations]
        fastest_ns, slowest_ns = rotation_limits_ns([s.channel for s in known.stations])
        self._interval_ns = fastest_ns
        self._window_ns = int(ROTATIONS_PER_WINDOW * slowest_ns)
        self._tangents = [[math.tan(t) for t in s.calibration.tilts] for s in known.stations]
        self._rotations = [s.rotation.tolist() for s in known.stations]
        self._positions = [tuple(s.position.tolist()) for s in known.stations]

    # ---- sweeps

    def push(
        self, name: str, time_ns: int, sensor: int, station: int, plane: int, count: float
    ) -> list[Fix]:
        """Take a sweep of a device; return the fix that it makes due, if there is one."""
        device = self._devices.get(name)
        if device is None or time_ns < device.newest_ns - MAX_LATENESS_NS:
            receiver = self._receivers[name]
            has_position = [bool(np.all(np.isfinite(row))) for row in receiver.position_m]
            device = self._devices[name] = DeviceState(
                name, receiver, has_position, receiver.position_m.tolist()
            )
        device.newest_ns = max(device.newest_ns, time_ns)
        if not (0 <= sensor < len(device.has_position) and device.has_position[sensor]):
            self._reject("sensor_unknown", 1)
            return []
        if plane != UNKNOWN:
            labelled = [((time_ns, sensor, count), plane)]
        else:
            tracker = device.planes.get(station)
            if tracker is None:
                channel = self.known.stations[station].channel
                tracker = device.planes[station] = PlaneTracker(channel)
            labelled, rejected = tracker.push((time_ns, sensor, count))
            if rejected:
                self._reject("plane_unknown", rejected)
        for sweep, number in labelled:
            self._add_row(device, sweep, station, number)
        if device.next_ns is None:
            device.next_ns = time_ns + self._interval_ns
        if time_ns < device.next_ns:
            return []
        device.next_ns = max(device.next_ns + self._interval_ns, time_ns)
        fix = self._locate(device, time_ns)
        return [] if fix is None else [fix]

    def _add_row(self, device: DeviceState, sweep: Sweep, station: int, plane: int) -> None:
        """Add the ideal plane of a sweep to the window of its device."""
        time_ns, sensor, count = sweep
        angle = self._turn[station] * count + float(ROTOR_ZERO_RAD[plane])
        device.angles[sensor, station, plane] = (time_ns, angle)
        partner = device.angles.get((sensor, station, 1 - plane))
        if partner is None or time_ns - partner[0] > MAX_PARTNER_AGE_NS:
            same = [
                entry
                for key, entry in device.angles.items()
                if key[1:] == (station, 1 - plane) and time_ns - entry[0] <= MAX_PARTNER_AGE_NS
            ]
            if not same:
                return  # The correction is unknown until the other plane was received.
            partner = max(same)
        pair = (angle, partner[1]) if plane == 0 else (partner[1], angle)
        ideal = self.known.corrections[station].ideal(*pair)[plane]
        if ideal != ideal:
            return
        tangent = self._tangents[station][plane]
        a, b, c = -math.sin(ideal), math.cos(ideal), -tangent
        r = self._rotations[station]
        device.rows.append(
            PlaneRow(
                time_ns,
                sensor,
                station,
                plane,
                angle,
                (
                    r[0][0] * a + r[0][1] * b + r[0][2] * c,
                    r[1][0] * a + r[1][1] * b + r[1][2] * c,
                    r[2][0] * a + r[2][1] * b + r[2][2] * c,
                    *device.levers[sensor],
                    *self._positions[station],
                    r[0][2],
                    r[1][2],
                    r[2][2],
                    tangent,
                ),
            )
        )

    # ---- poses

    def _locate(self, device: DeviceState, now_ns: int) -> Fix | None:
        """Estimate the pose of a device from the window that ends now."""
        rows = device.rows
        while rows and rows[0].time_ns <= now_ns - self._window_ns:
            rows.popleft()
        # Sweeps that came out of order may be older than the window, or than its end.
        window = [row for row in rows if now_ns - self._window_ns < row.time_ns <= now_ns]
        excluded = self.known.excluded
        active = [k for k, row in enumerate(window) if row.station not in excluded]
        if not _is_sufficient(window, active):
            self._reject("moment_with_too_few_sweeps", 1)
            return None
        first_ns = window[0].time_ns
        time_ns = first_ns + round(sum(window[k].time_ns - first_ns for k in active) / len(active))
        planes = np.array([row.values for row in window])
        offset_s = np.array([row.time_ns - time_ns for row in window]) * 1e-9
        last = device.pose
        if last is not None and time_ns - last.time_ns > MAX_PROPAGATION_GAP_S * 1e9:
            last = device.pose = None
        fit = self._track(device, planes[active], offset_s[active], time_ns)
        is_ambiguous = last is not None and last.margin < MIN_SEED_MARGIN
        if (fit is None or is_ambiguous) and now_ns >= device.next_seed_ns:
            own = [window[k] for k in active]
            seeded = self._seed(device, own, time_ns, planes[active], offset_s[active])
            if fit is None:
                device.next_seed_ns = now_ns + device.seed_interval_ns
                device.seed_interval_ns = min(2 * device.seed_interval_ns, MAX_SEED_INTERVAL_NS)
            else:
                device.next_seed_ns = now_ns + AMBIGUITY_INTERVAL_NS
            if seeded is not None and (fit is None or _replaces(seeded.state, fit.state)):
                fit = seeded
        if fit is None:
            self._reject("moment_inconsistent", 1)
            return None
        agreeing = _agreeing_stations([window[k] for k in active], fit.residual)
        kept = [k for k in active if window[k].station in agreeing]
        if len(kept) < len(active) and _is_sufficient(window, kept):
            without = self._fit(
                planes[kept], offset_s[kept], fit.state, INITIAL_SIGMA_RAD, LOSS_SCALE_RAD
            )
            fit, active = (fit, active) if without is None else (without, kept)
        acceleration = np.zeros(6)
        if last is not None:
            acceleration = (fit.state.rate - last.rate) / ((time_ns - last.time_ns) * 1e-9)
        device.pose = fit.state
        device.seed_interval_ns = FIRST_SEED_INTERVAL_NS
        self._count(
            device, window, set(active), _residuals(planes, offset_s[:, None], fit.state)[0]
        )
        return self._accept(device, [window[k] for k in active], fit, acceleration)

    def _track(
        self, device: DeviceState, planes: Array, offset_s: Array, time_ns: int
    ) -> WindowFit | None:
        """Fit the pose that follows from the last one, if there is one."""
        if device.pose is None:
            return None
        start = device.pose.later(time_ns)
        fit = self._fit(
            planes, offset_s, start, device.sigma_rad, LOSS_SCALE_SIGMAS * device.sigma_rad
        )
        if fit is None:
            fit = self._fit(planes, offset_s, start, INITIAL_SIGMA_RAD, LOSS_SCALE_RAD)
        return fit

    def _count(
        self, device: DeviceState, window: list[PlaneRow], active: set[int], residual: Array
    ) -> None:
        """Count the sweeps that agree with a pose, each in the first of its windows.

        Those of stations that are left out for good agree or not; they take no part.
        """
        middle_ns = (window[0].time_ns + window[-1].time_ns) // 2
        for k, (row, value) in enumerate(zip(window, residual.tolist(), strict=True)):
            if row.time_ns <= middle_ns:
                continue
            is_excluded = row.station in self.known.excluded
            if abs(value) < device.gate_rad and (k in active or is_excluded):
                self.used[row.station] += 1
                self.residual[row.station].append(value)
            else:
                self.rejected[row.station] += 1
                self._reject("sweep_contradicts_pose", 1)

    def _seed(
        self,
        device: DeviceState,
        window: list[PlaneRow],
        time_ns: int,
        planes: Array,
        offset_s: Array,
    ) -> WindowFit | None:
        """Estimate a pose without an initial guess, as the offline solver."""
        problem = TrackingProblem(
            _device_sweeps(window),
            device.receiver,
            self.known.arrays,
            SweepWindows(np.array([time_ns]), np.arange(len(window))[None]),
            self._window_ns // 2,
        )
        states = EpochStates.initial(np.ones(1, bool))
        epochs = np.zeros(1, np.int64)
        solve_seeds(problem, states, epochs, minimal_sets=False)
        if states.status[0] != SOLVED:
            solve_seeds(problem, states, epochs, minimal_sets=True)
        if states.status[0] != SOLVED:
            return None
        seed = PoseState(
            time_ns,
            states.poses.position[0],
            states.poses.rotation[0],
            states.poses.rate[0],
            states.seed_margin[-1],
        )
        return self._fit(planes, offset_s, seed, INITIAL_SIGMA_RAD, LOSS_SCALE_RAD)

    def _fit(
        self, planes: Array, offset_s: Array, start: PoseState, sigma_rad: float, loss_rad: float
    ) -> WindowFit | None:
        """Fit a pose to the planes of a window; None if it does not converge or few agree."""
        state = replace(start)
        # Sweeps that are all beyond the cutoff determine nothing.
        prior = np.full(12, WEAK_INFORMATION)
        prior[RATE] = RATE_SIGMA**-2.0
        elapsed = offset_s[:, None]
        jacobian = np.empty((len(planes), 12))
        for _ in range(MAX_FIT_ITERATIONS):
            residual, scaled, arm = _residuals(planes, elapsed, state)
            weight = np.where(
                np.abs(residual) > OUTLIER_CUTOFF_RAD, 0.0, 1.0 / (1.0 + (residual / loss_rad) ** 2)
            )
            jacobian[:, :3] = scaled
            jacobian[:, 3:6] = _cross(arm, scaled)
            jacobian[:, 6:] = jacobian[:, :6] * elapsed
            weighted = jacobian.T * (weight / sigma_rad**2)
            information = weighted @ jacobian
            information[range(12), range(12)] += prior
            gradient = weighted @ residual
            gradient[RATE] += prior[RATE] * state.rate
            step = np.linalg.solve(information, -gradient)
            size_m = float(np.abs(step[:3]).max())
            size_rad = float(np.abs(step[3:6]).max())
            if not (size_m < MAX_POSITION_STEP_M and size_rad < MAX_ROTATION_STEP_RAD):
                return None
            state.position = state.position + step[:3]
            state.rotation = _rotation(step[3:6].tolist()) @ state.rotation
            state.rate = state.rate + step[6:]
            if -float(gradient @ step) < CONVERGED_COST:
                break
        inliers = int(np.count_nonzero(np.abs(residual) < INLIER_GATE_RAD))
        if inliers < max(MIN_SWEEPS, MIN_INLIER_FRACTION * len(planes)):
            return None
        return WindowFit(state, residual, information, sigma_rad)

    def _accept(
        self, device: DeviceState, window: list[PlaneRow], fit: WindowFit, acceleration: Array
    ) -> Fix | None:
        """Return the fix of a pose that is determined, and remember its residuals."""
        device.windows.append((window, fit.residual))
        is_used = np.abs(fit.residual) < device.gate_rad
        if not _is_sufficient(window, np.flatnonzero(is_used).tolist()):
            self._reject("moment_with_too_few_sweeps", 1)
            return None
        unit = np.asarray(np.linalg.inv(fit.information)[:6, :6] / fit.sigma_rad**2, np.float64)
        lasting = device.lasting_rad**2 + self.known.calibration_sigma_rad**2
        noise = max(device.sigma_rad**2 - device.lasting_rad**2, ANGLE_SIGMA_RAD**2 / 4)
        members = sorted({row.station for row in window})
        common: Array = ROTATIONS_PER_WINDOW * lasting * unit
        common += self.known.errors.pose_covariance(fit.state.position, members)
        motion = 0.5 * acceleration * (0.5e-9 * self._window_ns) ** 2 / 3
        covariance = WINDOW_OVERLAP * noise * unit + common + np.outer(motion, motion)
        variance = np.diagonal(covariance)
        if not np.all((variance >= 0) & (variance <= MAX_POSE_SIGMA_M_RAD**2)):
            self._reject("pose_not_determined", 1)
            return None
        noise_m = math.sqrt(float(np.trace((covariance - common)[:3, :3])))
        now = (fit.state.time_ns, fit.state.position, noise_m)
        if not device.path.accepts(now, CONFIRMING_WINDOWS):
            self._reject("moment_jumps", 1)
            return None
        return Fix(
            device.name,
            self.known.scene.frame,
            fit.state.time_ns,
            fit.state.position,
            quaternion_from_matrix(fit.state.rotation),
            covariance,
            common,
            _probability(fit.state.margin),
        )

    def update_noise(self) -> None:
        """Estimate the noise and the gate of each device from its last windows, as offline."""
        for device in self._devices.values():
            if len(device.windows) < MIN_NOISE_WINDOWS:
                continue
            # Every second window: neighbours share sweeps.
            windows = list(device.windows)[::2]
            sweeps = _device_sweeps([row for window, _ in windows for row in window])
            residual = np.concatenate([residual for _, residual in windows])
            device.gate_rad = float(
                np.clip(
                    INLIER_GATE_SIGMAS * robust_sigma(residual),
                    MIN_INLIER_GATE_RAD,
                    INLIER_GATE_RAD,
                )
            )
            sizes = np.array([len(window) for window, _ in windows])
            members = np.where(np.arange(sizes.max()) < sizes[:, None], 0, -1)
            device.sigma_rad, device.lasting_rad = angle_noise(
                sweeps, residual, np.abs(residual) < device.gate_rad, members
            )

    def forget(self, time_ns: int) -> None:
        """Forget devices that received nothing since ``time_ns``."""
        for name in [
            name
            for name, device in self._devices.items()
            if device.next_ns is None or device.next_ns < time_ns
        ]:
            del self._devices[name]

    def moved_to(self, known: KnownScene) -> RigidFixes:
        """Return the fixes in another scene, in which all devices are found anew."""
        return RigidFixes(known, self._receivers, self._reject)


def _is_sufficient(window: list[PlaneRow], rows: list[int]) -> bool:
    """Return whether some rows of a window can determine a pose."""
    return len(rows) >= MIN_SWEEPS and len({window[k].sensor for k in rows}) >= MIN_SENSORS


def _agreeing_stations(window: list[PlaneRow], residual: Array) -> set[int]:
    """Return the stations of which most sweeps agree with a pose; the others are reflected."""
    total, inliers = Counter[int](), Counter[int]()
    for row, value in zip(window, residual.tolist(), strict=True):
        total[row.station] += 1
        inliers[row.station] += abs(value) < INLIER_GATE_RAD
    return {k for k, n in total.items() if inliers[k] >= MIN_INLIER_FRACTION * n}


def _replaces(seeded: PoseState, tracked: PoseState) -> bool:
    """Return whether a new seed is better than the pose of an ambiguous one.

    Raises the margin of the pose if a clearer seed agrees with it.
    """
    if seeded.margin <= tracked.margin:
        return False
    if rotation_angle(seeded.rotation, tracked.rotation) > MAX_UNPREDICTED_ROTATION_RAD:
        return True
    tracked.margin = seeded.margin
    return False


def _probability(margin: float) -> float:
    """Return the probability of the orientation of a seed; nan if there was no other.

    It is that of a provisional pose up to :data:`MIN_SEED_MARGIN`.
    """
    if margin >= MAX_SEED_MARGIN:
        return math.nan
    odds = PROVISIONAL_PROBABILITY / (1.0 - PROVISIONAL_PROBABILITY)
    return 1.0 / (1.0 + math.exp(-math.log(odds) * min(margin / MIN_SEED_MARGIN, 10.0)))


def _device_sweeps(rows: list[PlaneRow]) -> DeviceSweeps:
    """Return sweeps as those of the offline solver."""
    return DeviceSweeps(
        np.array([row.time_ns for row in rows], np.int64),
        np.array([row.sensor for row in rows], np.int64),
        np.array([row.station for row in rows], np.int64),
        np.array([row.plane for row in rows], np.int64),
        np.array([row.angle for row in rows]),
    )


def _residuals(planes: Array, elapsed_s: Array, state: PoseState) -> tuple[Array, Array, Array]:
    """Return predicted minus observed angles (n,) of sweeps, with two factors of their derivatives.

    These are the normals of the planes, divided by the lever arms on which these rotate, and the
    vectors from the device to the photodiodes, (n, 3) each.
    """
    normal, lever, station, up = (planes[:, k : k + 3] for k in (0, 3, 6, 9))
    arm = lever @ state.rotation.T
    if state.rate.any():
        swing = _cross(state.rate[3:] * elapsed_s, arm)
        arm = arm + swing + 0.5 * _cross(state.rate[3:] * elapsed_s, swing)
    point = state.position + state.rate[:3] * elapsed_s + arm - station
    height = (point * up).sum(axis=1)
    squared = (point * point).sum(axis=1) - height**2 * (1.0 + planes[:, 12] ** 2)
    scaled = normal / np.sqrt(np.maximum(squared, 1e-9))[:, None]
    return (scaled * point).sum(axis=1), scaled, arm


def _rotation(vector: list[float]) -> Array:
    """Return the matrix of one rotation vector (3,); faster than ``rotation_exp`` for one."""
    x, y, z = vector
    squared = x * x + y * y + z * z
    angle = math.sqrt(squared)
    sine = math.sin(angle) / angle if angle > 1e-8 else 1.0
    versine = 2.0 * (math.sin(0.5 * angle) / angle) ** 2 if angle > 1e-8 else 0.5
    diagonal = 1.0 - versine * squared
    xy, xz, yz = versine * x * y, versine * x * z, versine * y * z
    sx, sy, sz = sine * x, sine * y, sine * z
    return np.array(
        [
            [diagonal + versine * x * x, xy - sz, xz + sy],
            [xy + sz, diagonal + versine * y * y, yz - sx],
            [xz - sy, yz + sx, diagonal + versine * z * z],
        ]
    )


def _cross(a: Array, b: Array) -> Array:
    """Return the cross products of rows (n, 3); faster than ``np.cross`` for few of them."""
    product = np.empty_like(b)
    product[:, 0] = a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1]
    product[:, 1] = a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2]
    product[:, 2] = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return product
