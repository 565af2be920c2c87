"""Estimation of paths in continuous time, with stations and photodiodes as uncertain parameters.

Every sweep is a measurement at its own time. :func:`estimate_paths` refines rough trajectories:

1. The paths are fitted with a robust loss while the common parameters are held.
2. Sweeps that contradict the path are rejected, and those that agree with it are taken back, until
   nothing changes (:mod:`~locatk.core.lighthouse.motion.consistency`); the common parameters, the
   noise of the angles and the power of the motion are estimated meanwhile.
3. The covariance of each pose contains the noise and what remains of the common parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from locatk.core.geometry import (
    matrix_from_quaternion,
    quaternion_angle,
    quaternion_inverse,
    quaternion_multiply,
    slerp,
)
from locatk.core.inertial import InertialSamples
from locatk.core.lighthouse.devices.device_sweeps import DeviceSweeps
from locatk.core.lighthouse.motion.consistency import Consistency, find_contradictions, leverage
from locatk.core.lighthouse.motion.equations import (
    NormalEquations,
    PathSweeps,
    assemble,
    linearize,
)
from locatk.core.lighthouse.motion.inertial import InertialFactors, make_factors
from locatk.core.lighthouse.motion.parameters import STATION_PARAMETERS, CommonParameters
from locatk.core.lighthouse.motion.path import Path, prior_information
from locatk.core.lighthouse.noise import ANGLE_SIGMA_RAD, INLIER_GATE_RAD
from locatk.core.robust import robust_sigma
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
Mask = NDArray[np.bool_]

MAX_PAUSE_S = 1.0
"""Longest pause of the sweeps over which a path continues."""

MAX_START_GAP_S = 0.25
"""Longest time from a sweep to the nearest pose of the rough trajectory."""

MAX_JUMP_RAD = 0.6
"""Largest turn between neighbouring rough poses: 30 rad/s at 50 poses a second."""

MAX_FLIP_S = 3.0
"""Longest time with a wrong orientation that is interpolated."""

START_POWER = np.array([0.5, 30.0])
"""Power of the motion at the start: of the position, relative to the square of the distance of the
stations in metres, and of the rotation in rad^2/s^3. Those of an agile flight."""

MIN_POWER = np.array([1e-6, 1e-4])
"""Smallest power of the motion, in the same units: that of a device at rest."""

POWER_WINDOW_S = 1.0
"""Time over which the power of the motion is averaged."""

USUAL_POWER_QUANTILE = 0.75
MAX_LOCAL_POWER = 10.0
"""Quantile of the power over windows that counts as usual, and the largest one of a window relative
to it: undetected outliers look like accelerations."""

ROBUST_ITERATIONS = 8
MAX_ROUNDS = 20
FINAL_ITERATIONS = 4
"""Iterations with the robust loss, of the search for outliers, and after it."""

STATION_GATE_SIGMAS = 6.0
"""Median residual of a station that contradicts the others, in standard deviations of its pose."""

LOSS_SIGMAS = 3.0
"""Scale of the Cauchy loss in standard deviations."""

MIN_SIGMA_RAD = 2e-5
"""Smallest standard deviation of an angle, that of rounding to an LFSR step."""


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
        Of the common parameters.
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
) -> PathEstimate | None:
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

    Returns
    -------
    PathEstimate or None
        None if no device has a sweep near a pose.
    """
    layout = _lay_out(
        sweeps, first_photodiode, start, knot_ns, imu, is_rigid=len(common.photodiodes) > 0
    )
    if layout is None:
        return None
    problem = _Problem(layout.sweeps, common, layout.path)
    problem.fit_robustly()
    problem.reject_contradictions()
    problem.add_imus(imu, layout)
    problem.finish()
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
    imu: Sequence[InertialSamples | None],
    *,
    is_rigid: bool,
) -> _Layout | None:
    """Place knots at multiples of ``knot_ns`` on both sides of each sweep near a rough pose.

    Devices with an IMU have knots in pauses as well.
    """
    times_ns, devices, knots, rows, poses = [], [], [], [], []
    count = offset = 0
    for number, (own, rough) in enumerate(zip(sweeps, start, strict=True)):
        trajectory = without_flips(rough) if is_rigid else rough
        near = _near(own.time_ns, rough.time_ns)
        if len(near):
            cell, of_sweep = np.unique(own.time_ns[near] // knot_ns, return_inverse=True)
            edge = np.unique(np.concatenate([cell, cell + 1]))
            if imu and imu[number] is not None:
                edge = _fill_pauses(edge, round(MAX_PAUSE_S * 1e9) // knot_ns)
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
    time_s = (time_ns - start_ns) * 1e-9
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


def _fill_pauses(edge: IntArray, max_count: int) -> IntArray:
    """Return ascending numbers of knots with those in pauses of up to ``max_count``."""
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


class _Problem:
    """Paths and common parameters while they are estimated."""

    def __init__(self, sweeps: PathSweeps, common: CommonParameters, path: Path) -> None:
        self.sweeps, self.common, self.path = sweeps, common, path
        centre = common.positions.mean(axis=0)
        self.size_m = float(np.median(np.linalg.norm(path.position - centre, axis=1)))
        unit = np.array([self.size_m**2, 1.0])
        self.min_power = MIN_POWER * unit
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
        """Take a step; return its largest change of a position, relative to the scene."""
        if with_common:
            change, shared = equations.step()
            self.common = self.common.stepped(shared)
        else:
            change = equations.states_step()
        self.path = self.path.stepped(change)
        self.residuals = linearize(self.sweeps, self.path, self.common)
        return float(np.max(np.abs(change[:, :3]))) / self.size_m

    def fit_robustly(self) -> None:
        """Fit the paths with a Cauchy loss that narrows from the gate to the noise."""
        for iteration in range(ROBUST_ITERATIONS):
            residual = self.residuals.residual
            spread = max(robust_sigma(residual), self.sigma)
            scale = np.clip(LOSS_SIGMAS * spread, LOSS_SIGMAS * self.sigma, INLIER_GATE_RAD)
            with np.errstate(invalid="ignore"):
                weight = self.sigma**-2.0 / (1.0 + (residual / scale) ** 2)
            with_common = iteration > ROBUST_ITERATIONS // 2
            if iteration == ROBUST_ITERATIONS // 2:
                self.leave_out_stations()
            weight[self.is_left_out] = 0.0
            equations = self.equations(np.nan_to_num(weight), with_common=with_common)
            self.move(equations, with_common=with_common)
            if iteration >= 2:
                self.update_power(equations)
        with np.errstate(invalid="ignore"):
            spread = robust_sigma(self.residuals.residual)
            self.is_used = np.abs(self.residuals.residual) < max(6 * spread, 10 * self.sigma)
        self.is_used &= ~self.is_left_out
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
        """Reject sweeps and take them back until nothing changes."""
        returns = np.zeros(len(self.sweeps), np.int64)
        for number in range(MAX_ROUNDS):
            with_common = number % 2 == 1
            equations = self.equations(self.weight, with_common=with_common)
            self.move(equations, with_common=with_common)
            consistency = self.check(equations)
            self.update_power(equations)
            self.update_sigma(consistency)
            if self.inertial is not None:
                self.inertial.update_density(self.path, self.common, equations.states)
                self.inertial.release_positions(self.power)
            leaves, comes = find_contradictions(self.sweeps, consistency, self.is_used)
            comes &= (returns < 2) & ~self.is_left_out
            returns += comes
            self.is_used = (self.is_used & ~leaves) | comes
            if number >= 5 and with_common and np.sum(leaves) + np.sum(comes) == 0:
                break

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
            self.inertial.release_positions(self.power)
            self.reject_contradictions()

    def finish(self) -> None:
        """Converge with the accepted sweeps."""
        for _ in range(FINAL_ITERATIONS):
            equations = self.equations(self.weight, with_common=True)
            if self.move(equations, with_common=True) < 1e-6:
                break

    def check(self, equations: NormalEquations) -> Consistency:
        """Return how far the path determines the angle of each sweep."""
        return leverage(self.sweeps, self.residuals, equations.states, self.sigma, self.is_used)

    def update_sigma(self, consistency: Consistency | None = None) -> None:
        """Estimate the noise of an angle from the residuals of the accepted sweeps."""
        residual = self.residuals.residual[self.is_used]
        if consistency is not None:
            share = 1.0 - consistency.variance[self.is_used] / self.sigma**2
            residual = residual[share > 0.1] / np.sqrt(share[share > 0.1])
        if len(residual):
            self.sigma = max(MIN_SIGMA_RAD, robust_sigma(residual))

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
            usual = float(np.quantile(smooth[0] / smooth[1], USUAL_POWER_QUANTILE))
            usual = max(usual, self.min_power[part])
            # One degree of freedom of usual motion keeps windows without sweeps in range.
            local = (smooth[0] + usual / window) / (smooth[1] + 1.0 / window)
            self.power[:, part] = np.clip(local, self.min_power[part], MAX_LOCAL_POWER * usual)

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
            diagonal[:, :n, :n],
            response[:, :n],
            layout.sweep,
            self.residuals.residual,
            self.is_used,
            self.sweeps.knot,
            self.sigma,
            self.contradicting_imus,
        )
