"""Estimation of paths in continuous time, with stations and photodiodes as uncertain parameters.

Every sweep is a measurement at its own time. :func:`estimate_paths` refines rough trajectories:

1. The paths, and then the poses of the stations, are fitted with a robust loss.
2. Sweeps that contradict the path are rejected, and those that agree with it are reinstated, until
   nothing changes (:mod:`~locatk.core.lighthouse.motion.consistency`); the common parameters, the
   noise of the angles and the power of the motion are estimated meanwhile.
3. The covariance of each pose contains the noise and what remains of the common parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from locatk.core.errors import DegenerateError
from locatk.core.geometry import (
    matrix_from_quaternion,
    quaternion_angle,
    quaternion_inverse,
    quaternion_multiply,
    slerp,
)
from locatk.core.inertial import InertialSamples
from locatk.core.lighthouse.devices.device_sweeps import DeviceSweeps
from locatk.core.lighthouse.motion.consistency import (
    Consistency,
    agrees_with_most,
    find_contested,
    find_contradictions,
    residual_statistics,
)
from locatk.core.lighthouse.motion.equations import (
    NormalEquations,
    PathSweeps,
    assemble,
    linearize,
)
from locatk.core.lighthouse.motion.inertial import InertialFactors, make_factors
from locatk.core.lighthouse.motion.parameters import (
    STATION_PARAMETERS,
    CommonParameters,
    scene_size,
)
from locatk.core.lighthouse.motion.path import Path, prior_information
from locatk.core.lighthouse.noise import ANGLE_SIGMA_RAD, INLIER_GATE_RAD
from locatk.core.robust import robust_sigma
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
Mask = NDArray[np.bool_]

MAX_PAUSE_S = 1.0
"""Longest pause of the sweeps over which a path continues."""

MAX_GAP_S = 0.3
"""Longest gap without sweeps in which a path has knots."""

MAX_START_GAP_S = 0.25
"""Longest time from a sweep to the nearest pose of the rough trajectory."""

MAX_JUMP_RAD = 0.6
"""Largest turn between neighbouring rough poses: 30 rad/s at 50 poses a second."""

MAX_FLIP_S = 3.0
"""Longest time with a wrong orientation that is interpolated."""

START_POWER = np.array([0.5, 30.0])
"""Power of the motion at the start: of the position, relative to the square of the distance of the
stations in metres, and of the rotation in rad^2/s^3. Those of an agile flight."""

MIN_POWER, MAX_POWER = np.array([1e-5, 1e-3]), np.array([5.0, 1e3])
"""Smallest and largest power of the motion, in the same units: at rest, and thrown or shaken. With
more, a path could follow wrong sweeps."""

POWER_WINDOW_S = 1.0
"""Time over which the power of the motion is averaged."""

USUAL_POWER_QUANTILE = 0.75
MAX_LOCAL_POWER = 10.0
"""Quantile of the power over windows that counts as usual, and the largest one of a window relative
to it: undetected outliers look like accelerations."""

ROBUST_ITERATIONS = 8
MAX_ROUNDS = 20
FINAL_ITERATIONS = 4
"""Iterations with the robust loss, largest number of rounds of each search for outliers, and
iterations after it."""

MAX_KNOTS = 40_000
"""Largest number of knots, which bounds the memory to about 2 GB: of a device for 400 s."""

MIN_USED_FRACTION = 0.3
"""Smallest fraction of accepted sweeps of a path that is trusted."""

STRETCH_PASSES, STRETCH_ITERATIONS = 2, 4
"""Passes over stretches in which many sweeps are rejected, and iterations after each."""

MAX_PREDICTION_SIGMA_RAD = 5e-3
"""Largest standard deviation of a predicted angle with which a sweep is reinstated: with more,
reflections agree by chance."""

STATION_GATE_SIGMAS = 6.0
"""Median residual of a station that contradicts the others, in standard deviations of its pose."""

LOSS_SIGMAS = 3.0
"""Scale of the Cauchy loss in standard deviations."""

MIN_SIGMA_RAD, MAX_SIGMA_RAD = 2e-5, 1e-3
"""Smallest standard deviation of an angle, that of rounding to an LFSR step, and the largest."""

STEP_LENGTHS = (1.0, 0.5, 0.25, 0.125)
MAX_GROWTH = 2.0
"""Lengths of a step that are tried, and the largest growth of the median residual."""


@dataclass(frozen=True)
class PathEstimate:
    """Estimated paths of the devices of a recording.

    Attributes
    ----------
    path : Path
    device : (k,) int ndarray
        Device of each knot.
    time_ns : (k,) int64 ndarray
        Of the knots.
    common : CommonParameters
    common_covariance : (m, m) ndarray
        Of the common parameters, for the poses.
    station_covariance : (m, m) ndarray
        The same in the frame in which the covariances of the poses hold, for the stations.
    pose_covariance : (k, n, n) ndarray
        Of the pose at each knot while the common parameters are known.
    response : (k, n, m) ndarray
        Change of each pose per change of the common parameters.
    sweep : (p,) int ndarray
        Rows of the given sweeps, all devices one after the other, that are on a path.
    residual : (p,) ndarray
        Of these, in radians.
    is_used : (p,) bool ndarray
    knot : (p,) int ndarray
        Knot before each of them.
    sigma_rad : float
        Standard deviation of an angle.
    contradicting_imus : tuple of str
        Devices whose IMU contradicts the light and was left out.
    """

    path: Path
    device: IntArray
    time_ns: IntArray
    common: CommonParameters
    common_covariance: Array
    station_covariance: Array
    pose_covariance: Array
    response: Array
    sweep: IntArray
    residual: Array
    is_used: Mask
    knot: IntArray
    sigma_rad: float
    contradicting_imus: tuple[str, ...] = ()


def estimate_paths(
    sweeps: Sequence[DeviceSweeps],
    first_photodiode: Sequence[int],
    start: Sequence[Trajectory],
    common: CommonParameters,
    knot_ns: int,
    imu: Sequence[InertialSamples | None] = (),
    *,
    floor_z: float | None = None,
) -> PathEstimate:
    """Estimate the paths of the devices of a recording.

    Parameters
    ----------
    sweeps : sequence of DeviceSweeps
        By device, ascending in time.
    first_photodiode : sequence of int
        Number of the first photodiode of each device in ``common``.
    start : sequence of Trajectory
        Rough poses by device.
    common : CommonParameters
        Without photodiodes if the devices have single ones.
    knot_ns : int
        Time from knot to knot.
    imu : sequence of InertialSamples or None
        By device; empty without any. Of single photodiodes, they are not used.
    floor_z : float, optional
        Height of single photodiodes on a floor.

    Raises
    ------
    DegenerateError
        No device has a sweep near a pose, the sweeps do not determine the paths, or the recording
        is too long.
    """
    layout = _lay_out(
        sweeps, first_photodiode, start, knot_ns, is_rigid=len(common.photodiodes) > 0
    )
    if layout is None:
        raise DegenerateError("no sweep is near a pose")
    if len(layout.path) > MAX_KNOTS:
        raise DegenerateError(
            f"the devices move for {1e-9 * knot_ns * len(layout.path):.0f} s in all, and paths are "
            f"estimated for up to {1e-9 * knot_ns * MAX_KNOTS:.0f} s"
        )
    problem = PathProblem(layout.sweeps, common, layout.path, floor_z)
    problem.fit_robustly()
    problem.reject_contradictions()
    problem.add_imus(imu, layout)
    problem.resolve_stretches()
    problem.finish()
    if np.mean(problem.is_used) < MIN_USED_FRACTION:
        raise DegenerateError(
            f"{1 - np.mean(problem.is_used):.0%} of the sweeps contradict every path"
        )
    return problem.estimate(layout)


# ---- knots


@dataclass(frozen=True)
class _Layout:
    """Knots, and the sweeps between them."""

    path: Path
    device: IntArray
    time_ns: IntArray
    sweeps: PathSweeps
    sweep: IntArray


def _lay_out(
    sweeps: Sequence[DeviceSweeps],
    first_photodiode: Sequence[int],
    start: Sequence[Trajectory],
    knot_ns: int,
    *,
    is_rigid: bool,
) -> _Layout | None:
    """Place knots at multiples of ``knot_ns`` around each sweep near a rough pose, and in gaps."""
    times_ns, devices, knots, rows, poses = [], [], [], [], []
    count = offset = 0
    for number, (own, rough) in enumerate(zip(sweeps, start, strict=True)):
        trajectory = without_flips(rough) if is_rigid else rough
        near = _near(own.time_ns, rough.time_ns)
        if len(near):
            cell, of_sweep = np.unique(own.time_ns[near] // knot_ns, return_inverse=True)
            cells = np.unique(np.concatenate([cell, cell + 1]))
            edge = _fill_gaps(cells, round(MAX_GAP_S * 1e9) // knot_ns)
            time_ns = edge * knot_ns
            times_ns.append(time_ns)
            devices.append(np.full(len(edge), number))
            knots.append(count + np.searchsorted(edge, cell)[of_sweep.ravel()])
            rows.append(offset + near)
            poses.append(_interpolate(trajectory, time_ns))
            count += len(edge)
        offset += len(own)
    if not count:
        return None
    time_ns, device = np.concatenate(times_ns), np.concatenate(devices)
    sweep, knot = np.concatenate(rows), np.concatenate(knots)
    start_ns = int(time_ns.min())
    time_s = np.asarray((time_ns - start_ns) * 1e-9, np.float64)
    position = np.concatenate([p for p, _ in poses])
    quaternion = np.concatenate([q for _, q in poses])
    is_linked = (np.diff(device) == 0) & (np.abs(np.diff(time_s)) < MAX_PAUSE_S)
    path = Path(
        time_s,
        is_linked,
        position,
        np.zeros_like(position),
        matrix_from_quaternion(quaternion) if is_rigid else None,
        np.zeros_like(position) if is_rigid else None,
    )
    all_ns, station, plane, sensor, angle = (
        np.concatenate([getattr(s, name) for s in sweeps])[sweep]
        for name in ("time_ns", "station", "plane", "sensor", "angle")
    )
    photodiode = sensor + np.array(first_photodiode)[device[knot]]
    weights = path.hermite_weights(knot, (all_ns - start_ns) * 1e-9)
    return _Layout(
        path,
        device,
        time_ns,
        PathSweeps(knot, weights, station, plane, photodiode, angle),
        sweep,
    )


def _fill_gaps(edge: IntArray, max_count: int) -> IntArray:
    """Return ascending numbers of knots with those in gaps of up to ``max_count``."""
    gap = np.diff(edge)
    steps = np.where(gap <= max_count, gap, 1)
    start = np.repeat(edge[:-1], steps)
    step = np.arange(len(start)) - np.repeat(np.cumsum(steps) - steps, steps)
    return np.append(start + step, edge[-1])


def without_flips(trajectory: Trajectory) -> Trajectory:
    """Return a trajectory without short parts in which a device has a wrong orientation.

    A coplanar device has two poses that explain its angles almost equally. From the longest part
    without a jump of the orientation, in both directions, short parts are left out whose
    orientation does not continue that of the last part.
    """
    if len(trajectory) < 2:
        return trajectory
    quaternion, time_ns = trajectory.quaternion, trajectory.time_ns
    edge = np.flatnonzero(_turn(quaternion[:-1], quaternion[1:]) > MAX_JUMP_RAD) + 1
    start, stop = np.r_[0, edge], np.r_[edge, len(trajectory)]
    longest = int(np.argmax(stop - start))
    kept = np.ones(len(trajectory), bool)
    forward, backward = range(longest + 1, len(start)), range(longest - 1, -1, -1)
    for parts, near, far in ((forward, start, stop - 1), (backward, stop - 1, start)):
        last = int(far[longest])
        for part in parts:
            is_long = time_ns[stop[part] - 1] - time_ns[start[part]] > MAX_FLIP_S * 1e9
            is_late = abs(time_ns[near[part]] - time_ns[last]) > MAX_FLIP_S * 1e9
            turn = _turn(quaternion[last], quaternion[near[part]])
            if is_long or is_late or turn < MAX_JUMP_RAD:
                last = int(far[part])
            else:
                kept[start[part] : stop[part]] = False
    return trajectory.select(kept)


def _turn(first: Array, second: Array) -> Array:
    """Return the angles (n,) between orientations (n, 4) in radians."""
    return quaternion_angle(quaternion_multiply(quaternion_inverse(first), second))


def _near(time_ns: IntArray, pose_ns: IntArray) -> IntArray:
    """Return the sweeps that are near a pose of the rough trajectory."""
    if not len(pose_ns):
        return np.zeros(0, np.int64)
    after = np.clip(np.searchsorted(pose_ns, time_ns), 0, len(pose_ns) - 1)
    before = np.maximum(after - 1, 0)
    gap_ns = np.minimum(np.abs(pose_ns[after] - time_ns), np.abs(time_ns - pose_ns[before]))
    return np.flatnonzero(gap_ns <= MAX_START_GAP_S * 1e9)


def _interpolate(trajectory: Trajectory, time_ns: IntArray) -> tuple[Array, Array]:
    """Return positions and quaternions at times; beyond the ends, those of the ends."""
    pose_s = (trajectory.time_ns - trajectory.time_ns[0]) * 1e-9
    time_s = np.clip((time_ns - trajectory.time_ns[0]) * 1e-9, 0.0, pose_s[-1])
    after = np.clip(np.searchsorted(pose_s, time_s), 1, max(len(pose_s) - 1, 1))
    after = np.minimum(after, len(pose_s) - 1)
    before = np.maximum(after - 1, 0)
    span_s = np.maximum(pose_s[after] - pose_s[before], 1e-9)
    fraction = np.clip((time_s - pose_s[before]) / span_s, 0.0, 1.0)
    position = trajectory.position[before] + fraction[:, None] * (
        trajectory.position[after] - trajectory.position[before]
    )
    return position, slerp(trajectory.quaternion[before], trajectory.quaternion[after], fraction)


# ---- estimation


class PathProblem:
    """Paths and common parameters while they are estimated."""

    def __init__(
        self,
        sweeps: PathSweeps,
        common: CommonParameters,
        path: Path,
        floor_z: float | None = None,
    ) -> None:
        self.sweeps, self.common, self.path, self.floor_z = sweeps, common, path, floor_z
        self.size_m = scene_size(common.positions, path.position)
        unit = np.array([self.size_m**2, 1.0])
        self.min_power, self.max_power = MIN_POWER * unit, MAX_POWER * unit
        self.power = np.tile(START_POWER * unit, (len(path) - 1, 1))
        self.sigma = ANGLE_SIGMA_RAD
        self.residuals = linearize(sweeps, path, common)
        self.is_used = np.isfinite(self.residuals.residual)
        self.is_left_out = np.zeros(len(sweeps), bool)
        self.inertial: InertialFactors | None = None
        self.contradicting_imus: tuple[str, ...] = ()

    @property
    def weight(self) -> Array:
        """Inverse variances (n,) of the accepted sweeps."""
        return np.where(self.is_used, self.sigma**-2.0, 0.0)

    def equations(self, weight: Array, *, with_common: bool = False) -> NormalEquations:
        equations = assemble(
            self.sweeps,
            self.residuals,
            weight,
            self.path,
            self.power,
            self.common,
            with_common=with_common,
            floor_z=self.floor_z,
            inertial=self.inertial,
        )
        if with_common and (self.inertial is None or not self.inertial.has_force):
            self._hold_scale(equations)
        return equations

    def _hold_scale(self, equations: NormalEquations) -> None:
        """Remove the pull of the prior towards a smaller scene from the gradients.

        The power of the motion is proportional to the square of the size of the scene, the rms
        distance of the paths from the centre of the stations. With the derivative of its
        normalization, the prior does not depend on the size.
        """
        error = self.path.prior_errors()[:, :, :3]
        unit = prior_information(np.diff(self.path.time_s))[:, 2:, 2:]
        energy = np.einsum("kia,kij,kja->k", error, unit, error) * self.path.is_linked
        pull = float(np.sum(energy / self.power[:, 0]))
        stations = self.common.stations[0]
        offset = self.path.position - stations.mean(axis=0)
        by_position = pull * offset / float(np.sum(offset**2))
        equations.gradient[:, :3] -= by_position
        of_stations = equations.common_gradient[: len(stations) * STATION_PARAMETERS]
        of_stations.reshape(-1, STATION_PARAMETERS)[:, :3] += by_position.sum(axis=0) / len(
            stations
        )

    def move(self, equations: NormalEquations, *, with_common: bool) -> float:
        """Take a step; return its largest change of a position, relative to the scene.

        The step is shortened if the residuals grow by more than their noise explains.
        """
        shared = np.zeros(len(self.common.value))
        if with_common:
            change, shared = equations.step()
        else:
            change = equations.states_step()
        path, common = self.path, self.common
        limit = max(MAX_GROWTH * self._usual_residual(), 5 * self.sigma)
        for length in STEP_LENGTHS:
            self.path = path.stepped(length * change)
            self.common = common.stepped(length * shared)
            self.residuals = linearize(self.sweeps, self.path, self.common)
            if self._usual_residual() <= limit:
                break
        return length * float(np.max(np.abs(change[:, :3]))) / self.size_m

    def _usual_residual(self) -> float:
        """Return the median residual of the accepted sweeps; infinite if most have none."""
        residual = np.abs(self.residuals.residual[self.is_used])
        return float(np.median(np.nan_to_num(residual, nan=np.inf))) if len(residual) else 0.0

    def fit_robustly(self) -> None:
        """Fit the paths with a Cauchy loss that narrows from the gate to the noise.

        Light planes and photodiodes are held, so that wrong sweeps cannot bend them.
        """
        common = self.common
        self.common = common.only_poses()
        for iteration in range(ROBUST_ITERATIONS):
            residual = self.residuals.residual
            spread = float(np.clip(robust_sigma(residual), self.sigma, INLIER_GATE_RAD))
            scale = np.clip(LOSS_SIGMAS * spread, LOSS_SIGMAS * self.sigma, INLIER_GATE_RAD)
            with np.errstate(invalid="ignore"):
                weight = spread**-2.0 / (1.0 + (residual / scale) ** 2)
            with_common = iteration > ROBUST_ITERATIONS // 2
            if iteration == ROBUST_ITERATIONS // 2:
                self.leave_out_stations()
            weight[self.is_left_out] = 0.0
            equations = self.equations(np.nan_to_num(weight), with_common=with_common)
            self.move(equations, with_common=with_common)
        with np.errstate(invalid="ignore"):
            spread = robust_sigma(self.residuals.residual[~self.is_left_out])
            self.is_used = np.abs(self.residuals.residual) < max(6 * spread, 10 * self.sigma)
        self.is_used &= ~self.is_left_out
        self.common = replace(common, value=self.common.value)
        self.update_sigma()

    def leave_out_stations(self) -> None:
        """Leave out stations whose sweeps contradict those of the others.

        Their residuals exceed what the uncertainty of the stations explains, and those of the other
        stations do not.
        """
        count = len(self.common.positions)
        usual = np.array(
            [
                np.nanmedian(np.abs(self.residuals.residual[self.sweeps.station == i]))
                if np.any(self.sweeps.station == i)
                else np.nan
                for i in range(count)
            ]
        )
        gate = np.maximum(
            INLIER_GATE_RAD, STATION_GATE_SIGMAS * self.common.pose_sigma(self.size_m)
        )
        is_out = usual > gate
        if np.any(usual < gate / 2):
            self.is_left_out = is_out[self.sweeps.station]

    def reject_contradictions(self) -> None:
        """Reject sweeps and reinstate them until nothing changes."""
        return_count = np.zeros(len(self.sweeps), np.int64)
        for number in range(MAX_ROUNDS):
            with_common = number % 2 == 1
            equations = self.equations(self.weight, with_common=with_common)
            self.move(equations, with_common=with_common)
            consistency = self.check(equations)
            self.update_power(equations)
            self.update_sigma(consistency)
            if self.inertial is not None:
                self.inertial.update_density(self.path, self.common, equations.states)
                self.inertial.loosen_position_prior(self.power)
            leaving, returning = find_contradictions(self.sweeps, consistency, self.is_used)
            returning &= (return_count < 2) & ~self.is_left_out
            return_count += returning
            self.is_used = (self.is_used & ~leaving) | returning
            if number >= 5 and with_common and np.sum(leaving) + np.sum(returning) == 0:
                break

    def resolve_stretches(self) -> None:
        """Estimate again where many sweeps contradict the path, from both ends inwards.

        Reflections of both stations at a time agree with each other and bend the path to them. All
        sweeps of such a stretch are left out, and those are reinstated that agree with the motion
        before and after it.
        """
        for _ in range(STRETCH_PASSES):
            is_contested = find_contested(self.sweeps, self.is_used | self.is_left_out)
            if not np.any(is_contested):
                return
            self.is_used &= ~is_contested
            self.reinstate(is_contested)
            for _ in range(STRETCH_ITERATIONS):
                equations = self.equations(self.weight, with_common=True)
                self.move(equations, with_common=True)
                consistency = self.check(equations)
                self.update_power(equations)
                self.update_sigma(consistency)
                leaving, _ = find_contradictions(self.sweeps, consistency, self.is_used)
                self.is_used &= ~leaving

    def reinstate(self, candidates: Mask) -> None:
        """Reinstate sweeps that agree with the path, as far as it predicts them."""
        for _ in range(MAX_ROUNDS):
            for _ in range(2):
                equations = self.equations(self.weight)
                self.move(equations, with_common=False)
            consistency = self.check(equations)
            leaving, returning = find_contradictions(self.sweeps, consistency, self.is_used)
            returning &= candidates & ~self.is_left_out
            returning &= consistency.variance < MAX_PREDICTION_SIGMA_RAD**2
            returning &= agrees_with_most(self.sweeps, returning | self.is_used)
            self.is_used = (self.is_used & ~leaving) | returning
            if not np.any(returning & ~leaving):
                return

    def add_imus(self, imu: Sequence[InertialSamples | None], layout: _Layout) -> None:
        """Estimate the paths with the IMUs that agree with the light."""
        if self.path.rotation is None:
            return
        samples = [(s, layout.device == k) for k, s in enumerate(imu) if s is not None]
        start_ns = int(layout.time_ns.min())
        # With several stations, the accelerometer biases the scale of an estimated scene.
        made = make_factors(
            samples,
            self.path,
            self.common,
            start_ns,
            with_force=len(self.common.positions) == 1,
        )
        self.inertial, self.common, self.contradicting_imus = made
        if self.inertial is not None:
            self.inertial.loosen_position_prior(self.power)
            self.reject_contradictions()

    def finish(self) -> None:
        """Converge with the accepted sweeps."""
        for _ in range(FINAL_ITERATIONS):
            equations = self.equations(self.weight, with_common=True)
            if self.move(equations, with_common=True) < 1e-6:
                break

    def check(self, equations: NormalEquations) -> Consistency:
        """Return how far the path determines the angle of each sweep."""
        return residual_statistics(
            self.sweeps, self.residuals, equations.states, self.sigma, self.is_used
        )

    def update_sigma(self, consistency: Consistency | None = None) -> None:
        """Estimate the noise of an angle from the residuals of the accepted sweeps."""
        residual = self.residuals.residual[self.is_used]
        if consistency is not None:
            share = 1.0 - consistency.variance[self.is_used] / self.sigma**2
            residual = residual[share > 0.1] / np.sqrt(share[share > 0.1])
        if len(residual):
            self.sigma = float(np.clip(robust_sigma(residual), MIN_SIGMA_RAD, MAX_SIGMA_RAD))

    def update_power(self, equations: NormalEquations) -> None:
        """Estimate the power of the motion, locally and in all (MacKay 1992).

        It is the energy of the accelerations over the number of degrees of freedom that the sweeps
        determine.
        """
        if not np.any(self.path.is_linked):
            return
        diagonal, above = equations.states.inverse_blocks
        error = self.path.prior_errors()
        span_s = np.diff(self.path.time_s)
        unit = prior_information(span_s)
        k, n = len(self.path), self.path.pose_size
        own = diagonal.reshape(k, 2, n, 2, n)
        cross = above.reshape(k - 1, 2, n, 2, n)
        window = max(1, round(POWER_WINDOW_S / float(np.median(span_s[self.path.is_linked]))))
        for part in range(n // 3):
            energy, spread = np.zeros(k - 1), np.zeros(k - 1)
            for axis in range(3 * part, 3 * part + 3):
                e = error[:, :, axis]
                energy += np.einsum("ki,kij,kj->k", e, unit[:, 2:, 2:], e)
                before, after = own[:-1, :, axis, :, axis], own[1:, :, axis, :, axis]
                between = cross[:, :, axis, :, axis]
                spread += np.einsum("kij,kji->k", unit[:, :2, :2], before)
                spread += np.einsum("kij,kji->k", unit[:, 2:, 2:], after)
                spread += 2 * np.einsum("kij,kij->k", unit[:, :2, 2:], between)
            known = np.maximum(6.0 - spread / self.power[:, part], 1e-3) * self.path.is_linked
            energy *= self.path.is_linked
            smooth = uniform_filter1d(np.stack([energy, known]), window, axis=1, mode="nearest")
            # Windows between two paths have no degrees of freedom.
            known_windows = smooth[:, smooth[1] > 0.0]
            ratio = known_windows[0] / known_windows[1]
            usual = max(float(np.quantile(ratio, USUAL_POWER_QUANTILE)), self.min_power[part])
            # One degree of freedom of usual motion keeps windows without sweeps in range.
            local = (smooth[0] + usual / window) / (smooth[1] + 1.0 / window)
            largest = min(MAX_LOCAL_POWER * usual, self.max_power[part])
            self.power[:, part] = np.clip(local, self.min_power[part], largest)

    def estimate(self, layout: _Layout) -> PathEstimate:
        """Return the result with covariances."""
        equations = self.equations(self.weight, with_common=True)
        common_covariance, response = equations.covariances()
        diagonal, _ = equations.states.inverse_blocks
        n = self.path.pose_size
        return PathEstimate(
            self.path,
            layout.device,
            layout.time_ns,
            self.common,
            common_covariance,
            common_covariance,
            diagonal[:, :n, :n],
            response[:, :n],
            layout.sweep,
            self.residuals.residual,
            self.is_used,
            self.sweeps.knot,
            self.sigma,
            self.contradicting_imus,
        )
