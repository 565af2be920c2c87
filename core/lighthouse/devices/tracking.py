"""Poses of rigid devices over time in a scene with known stations.

Each device is solved by itself, in two passes over its epochs
(:class:`~locatk.core.lighthouse.devices.device_sweeps.SweepWindows`):

1. Initial poses. Some epochs are solved without an initial guess (seeds, from
   :mod:`~locatk.core.lighthouse.devices.pnp`). Their poses and rates are propagated to neighbouring
   epochs, which are solved next; all fronts of this propagation form one batch. Two fronts
   can disagree, because a coplanar device under one station has two poses that explain its angles
   almost equally. The epochs of the less certain seed are then solved again from the other one.
2. Refinement. All epochs are fitted again with the noise that the residuals show, which also yields
   the inlier gate and the covariance.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.geometry import quaternion_from_matrix, rotation_angle
from locatk.core.lighthouse.channels import CHANNELS
from locatk.core.lighthouse.devices.device_sweeps import (
    MIN_SWEEPS,
    ROTATIONS_PER_WINDOW,
    DeviceSweeps,
    SweepWindows,
    gather_observations,
    has_enough_sweeps,
    make_windows,
    mean_angles,
    received_channels,
    rotation_limits_ns,
    select_device_sweeps,
)
from locatk.core.lighthouse.devices.pnp import candidate_poses, is_lit_from_behind
from locatk.core.lighthouse.devices.pose_fit import (
    DeviceStates,
    PoseFit,
    SweepObservations,
    angle_residuals,
    fit_poses,
    photodiode_positions,
)
from locatk.core.lighthouse.noise import (
    ANGLE_SIGMA_RAD,
    CALIBRATION_SIGMA_RAD,
    INLIER_GATE_RAD,
    INLIER_GATE_SIGMAS,
    MIN_INLIER_GATE_RAD,
)
from locatk.core.lighthouse.receiver import Receiver
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.lighthouse.scene import Scene
from locatk.core.lighthouse.scene.model import StationArrays, stack_stations
from locatk.core.robust import robust_sigma
from locatk.core.solution import add_counts
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
Mask = NDArray[np.bool_]

INITIAL_SIGMA_RAD = 2e-3
"""Standard deviation of an angle in radians for the initial poses: 4 mm at two metres, which a
given scene or the dimensions of a device may be off by. With that of exact geometry, rates would
explain errors of the geometry, and spoil the prediction of the neighbouring epochs."""

WEAK_INFORMATION = 1e-3
"""Information of each unknown of a pose that no sweep determines: a standard deviation of 30 m."""

LOSS_SCALE_RAD = 3e-3
"""Scale of the Cauchy loss in radians while the noise is unknown; the residuals of reflections are
far larger."""

LOSS_SCALE_SIGMAS = 3.0
"""Scale of the Cauchy loss in standard deviations of an angle, once these are known."""

OUTLIER_CUTOFF_RAD = 2 * INLIER_GATE_RAD
"""Residual in radians above which a sweep has no weight: 40 mm at two metres."""

MIN_INLIER_FRACTION = 0.6
"""Minimum fraction of the sweeps of an epoch that agree with an accepted pose."""

SEED_SPACING_EPOCHS = 50
"""Number of epochs from one seed to the next, about a second."""

SECOND_SEED_SPACING_EPOCHS = 25
"""Spacing of the seeds in a gap that the first propagation left."""

MAX_SECOND_SEEDS = 200
"""Maximum number of seeds in such gaps; each takes some milliseconds."""

MAX_STATION_CANDIDATES = 3
"""Candidates of a seed from one station that are refined on that station: those of all rays, and
the best of a minimal set."""

MAX_SEED_HYPOTHESES = 4
"""Candidates of a seed that are refined on all stations."""

MIN_SEED_MARGIN = 10.0
"""Minimum cost (half the sum of squares over the variance of an angle) by which a pose of another
orientation must be worse for the seed to be unambiguous."""

MAX_SEED_MARGIN = 1e6
"""Margin of a seed without a second hypothesis."""

FROM_BEHIND_COST = 1e6
"""Cost of a hypothesis that is lit from behind: it ranks after all others."""

MAX_FROM_BEHIND_FRACTION = 0.3
"""Maximum fraction of the sweeps that may reach photodiodes from behind; covers scatter a few."""

MAX_PROPAGATION_GAP_S = 0.25
"""Maximum pause over which a pose is propagated; a rotating device can have any pose after it."""

MAX_UNPREDICTED_ROTATION_RAD = 0.35
"""Largest plausible rotation between neighbouring epochs beyond the predicted one, in radians."""

EPOCHS_PER_BATCH = 256
"""Number of epochs fitted at a time; their arrays fit the processor's cache."""

SEEDS_PER_BATCH = 32
"""Number of seeds solved at a time, which bounds the memory of their hypotheses."""

INITIAL_TOLERANCE = 0.03
REFINED_TOLERANCE = 1e-3
"""Relative decrease of the cost at which the fit of an epoch ends, in the two passes."""

NOISE_EPOCH_STRIDE = 4
"""The noise is estimated from every fourth epoch, because neighbouring epochs share sweeps."""

MAX_ROTATION_PERIOD_NS = 30_000_000
"""Maximum time between two sweeps of consecutive rotations of a station."""

STATE_UNKNOWNS = 12
"""Unknowns of an epoch: position, rotation and their rates."""

MAX_POSE_SIGMA_M_RAD = np.repeat([1.0, 0.5], 3)
"""Maximum standard deviations of an accepted pose, in m and rad."""

UNSOLVED, SOLVED, FAILED = range(3)
"""Status of an epoch in the first pass. A failed epoch is not tried again from its neighbours."""


@dataclass(frozen=True)
class TrackedDevice:
    """Trajectory of one device with its residuals.

    Attributes
    ----------
    trajectory : Trajectory
    sweeps : DeviceSweeps
        Usable sweeps of the device.
    channels : tuple of int
        Channels of the stations that ``sweeps.station`` indexes.
    residual : (n,) ndarray
        Predicted minus observed angle of each sweep in radians, at the epoch closest in time;
        ``nan`` for sweeps without a pose.
    is_used : (n,) bool ndarray
        Sweeps that agree with a pose.
    sigma_rad : float
        Standard deviation of an angle.
    lasting_sigma_rad : float
        Its part that repeats from rotation to rotation.
    rejected : dict of str to int
        Number of rejected sweeps or epochs by reason.
    from_behind_fraction : float
        Fraction of the sweeps that reach their photodiodes from behind.
    ambiguous_epochs : int
        Number of accepted epochs that were propagated from an ambiguous seed.
    """

    trajectory: Trajectory
    sweeps: DeviceSweeps
    channels: tuple[int, ...]
    residual: Array
    is_used: Mask
    sigma_rad: float
    lasting_sigma_rad: float
    rejected: dict[str, int]
    from_behind_fraction: float
    ambiguous_epochs: int


@dataclass(frozen=True)
class TrackingProblem:
    """Sweeps of one device in windows, and the stations that emitted them.

    ``half_width_ns`` is the time from the centre of a window to its ends.
    """

    sweeps: DeviceSweeps
    receiver: Receiver
    stations: StationArrays
    windows: SweepWindows
    half_width_ns: int

    def observations(self, epochs: IntArray) -> SweepObservations:
        """Gather the sweeps of the selected epochs."""
        return gather_observations(self.sweeps, self.windows, self.receiver, epochs)


@dataclass
class EpochStates:
    """Progress of the initial poses, updated by the functions of the first pass.

    Attributes
    ----------
    poses : DeviceStates
        Of all m epochs; valid for solved ones.
    status : (m,) int ndarray
        ``UNSOLVED``, ``SOLVED`` or ``FAILED``.
    seed : (m,) int ndarray
        Number of the seed from which an epoch was propagated; -1 if unsolved.
    seed_margin : list of float
        By seed, cost by which its best pose of another orientation is worse.
    """

    poses: DeviceStates
    status: IntArray
    seed: IntArray
    seed_margin: list[float] = field(default_factory=list)

    @classmethod
    def initial(cls, is_solvable: Mask) -> EpochStates:
        """Return states (m,) of unsolved epochs; unsolvable ones have failed."""
        m = len(is_solvable)
        return cls(
            DeviceStates.at_rest(np.zeros((m, 3)), np.tile(np.eye(3), (m, 1, 1))),
            np.where(is_solvable, UNSOLVED, FAILED),
            np.full(m, -1),
        )


def track_devices(
    sweeps: Sweeps,
    receivers: Mapping[str, Receiver],
    scene: Scene,
) -> tuple[TrackedDevice, ...]:
    """Estimate the trajectories of rigid devices in a known scene.

    Parameters
    ----------
    sweeps : Sweeps
        Sweeps of devices without a receiver are ignored.
    receivers : mapping of str to Receiver
        By device.
    scene : Scene
        With stations.

    Returns
    -------
    tuple of TrackedDevice
        One per device of the recording with a receiver, in the order of ``sweeps.devices``.

    Raises
    ------
    DegenerateError
        No device with a receiver has a sweep, or the scene contains none of the stations.
    """
    received = received_channels(sweeps, receivers)
    selected = [station for c in received if (station := scene.station(c)) is not None]
    if not selected:
        raise DegenerateError(
            "the scene has none of the recording's stations",
            hint="its channels are "
            + ", ".join(str(s.channel) for s in scene.stations)
            + "; the recording has "
            + ", ".join(str(c) for c in received),
        )
    channels = tuple(s.channel for s in selected)
    stations = stack_stations(selected)
    tracked = []
    for number, name in enumerate(sweeps.devices):
        if name not in receivers:
            continue
        device_sweeps, rejected = select_device_sweeps(sweeps, number, receivers[name], channels)
        device = track_device(name, scene.frame, device_sweeps, receivers[name], stations, channels)
        tracked.append(replace(device, rejected=add_counts(rejected, device.rejected)))
    return tuple(tracked)


def track_device(
    name: str,
    frame: str,
    sweeps: DeviceSweeps,
    receiver: Receiver,
    stations: StationArrays,
    channels: tuple[int, ...],
) -> TrackedDevice:
    """Estimate the trajectory of one device in a known scene.

    Parameters
    ----------
    name, frame : str
        Names of the device and of the scene's frame.
    sweeps : DeviceSweeps
    receiver : Receiver
    stations : StationArrays
    channels : tuple of int
        Of the stations.

    Notes
    -----
    A window contains the sweeps of one rotation before and after its epoch. Consecutive poses
    therefore share half of their sweeps and are not independent.
    """
    fastest_ns, slowest_ns = rotation_limits_ns(channels)
    windows = make_windows(sweeps, fastest_ns, slowest_ns)
    problem = TrackingProblem(sweeps, receiver, stations, windows, slowest_ns)
    is_solvable = has_enough_sweeps(sweeps, windows.sweep)
    states = EpochStates.initial(is_solvable)
    estimate_initial_poses(problem, states)
    tracked = _refine(problem, states, name, frame, channels)
    rejected = {
        "moment_with_too_few_sweeps": int(np.count_nonzero(~is_solvable)),
        "moment_inconsistent": int(np.count_nonzero(is_solvable & (states.status != SOLVED))),
    }
    return replace(tracked, rejected=add_counts(rejected, tracked.rejected))


# ---- first pass: initial poses


def estimate_initial_poses(problem: TrackingProblem, states: EpochStates) -> None:
    """Estimate the pose of every unsolved epoch: seeds, propagation, conflicts."""
    epochs = np.flatnonzero(states.status == UNSOLVED)
    solve_seeds(problem, states, epochs[::SEED_SPACING_EPOCHS], minimal_sets=False)
    propagate(problem, states)
    # Epochs that the propagation did not reach, or at which it failed, are tried again from new
    # seeds: at the start of each gap and at intervals in it.
    gaps = epochs[states.status[epochs] != SOLVED]
    is_seed = np.r_[True, np.diff(gaps) > 1][: len(gaps)]
    is_seed |= np.arange(len(gaps)) % SECOND_SEED_SPACING_EPOCHS == 0
    seeds = gaps[is_seed][:MAX_SECOND_SEEDS]
    solve_seeds(problem, states, seeds, minimal_sets=False)
    # Minimal sets take longer, and help only if outliers spoil the candidates of all rays.
    solve_seeds(problem, states, seeds[states.status[seeds] != SOLVED], minimal_sets=True)
    states.status[gaps[states.status[gaps] == FAILED]] = UNSOLVED
    propagate(problem, states)
    resolve_conflicts(problem, states)


def solve_seeds(
    problem: TrackingProblem, states: EpochStates, epochs: IntArray, *, minimal_sets: bool
) -> None:
    """Solve epochs without an initial guess.

    ``minimal_sets`` as for :func:`~locatk.core.lighthouse.devices.pnp.candidate_poses`.
    """
    for k in range(0, len(epochs), SEEDS_PER_BATCH):
        _solve_seed_batch(problem, states, epochs[k : k + SEEDS_PER_BATCH], minimal_sets)


def _solve_seed_batch(
    problem: TrackingProblem, states: EpochStates, epochs: IntArray, minimal_sets: bool
) -> None:
    hypotheses = [
        (i, *candidate)
        for i, epoch in enumerate(epochs)
        for candidate in _scene_candidates(problem, int(epoch), minimal_sets)
    ]
    if not hypotheses:
        return
    owners, stations, positions, rotations = zip(*hypotheses, strict=True)
    owner, station = np.array(owners), np.array(stations)
    poses = DeviceStates.at_rest(np.stack(positions), np.stack(rotations))
    observations = problem.observations(epochs).take(owner)
    own_station = observations.station == station[:, None]
    own_observations = replace(observations, is_observed=observations.is_observed & own_station)
    # Of the candidates of an epoch and a station, the few best are fitted to this station, now
    # with rates; of all candidates of an epoch, the few best are then fitted to all stations.
    best = _lowest_costs(
        _initial_cost(problem, own_observations, poses),
        owner * len(problem.stations[2]) + station,
        MAX_STATION_CANDIDATES,
    )
    owner, observations = owner[best], observations.take(best)
    poses = fit_poses(
        own_observations.take(best).trimmed(),
        problem.stations,
        poses.take(best),
        sigma_rad=INITIAL_SIGMA_RAD,
        loss_scale_rad=LOSS_SCALE_RAD,
        tolerance=INITIAL_TOLERANCE,
    ).poses
    best = _lowest_costs(_initial_cost(problem, observations, poses), owner, MAX_SEED_HYPOTHESES)
    owner, observations = owner[best], observations.take(best)
    fit = fit_poses(
        observations,
        problem.stations,
        poses.take(best),
        sigma_rad=INITIAL_SIGMA_RAD,
        loss_scale_rad=LOSS_SCALE_RAD,
    )
    accepted = is_accepted(observations, fit.residual)
    cost = truncated_cost(fit.residual, observations.is_observed, MIN_INLIER_GATE_RAD)
    behind = from_behind_fraction(problem, epochs[owner], fit.poses)
    cost += FROM_BEHIND_COST * (behind > MAX_FROM_BEHIND_FRACTION)
    for i in np.unique(owner[accepted]):
        rows = np.flatnonzero(accepted & (owner == i))
        choice, margin = choose_hypothesis(cost[rows], fit.poses.rotation[rows])
        epoch = epochs[i : i + 1]
        states.poses.put(epoch, fit.poses.take(rows[[choice]]))
        states.status[epoch], states.seed[epoch] = SOLVED, len(states.seed_margin)
        states.seed_margin.append(margin)


def _initial_cost(
    problem: TrackingProblem, observations: SweepObservations, poses: DeviceStates
) -> Array:
    """Return the truncated cost (m,) of poses, without fitting them."""
    residual = angle_residuals(observations, problem.stations, poses)
    return truncated_cost(residual, observations.is_observed, INLIER_GATE_RAD)


def _lowest_costs(cost: Array, group: IntArray, count: int) -> IntArray:
    """Return the indices of the ``count`` lowest costs of each group, in the order of groups."""
    order = np.lexsort((cost, group))
    rank = np.arange(len(order)) - np.searchsorted(group[order], group[order])
    return order[rank < count]


def _scene_candidates(
    problem: TrackingProblem, epoch: int, minimal_sets: bool
) -> list[tuple[int, Array, Array]]:
    """Return rough poses in the scene's frame, each with the index of the station it comes from."""
    row = problem.windows.sweep[epoch]
    sweeps = problem.sweeps.take(row[row >= 0])
    positions, rotations, calibrations = problem.stations
    candidates = []
    for i in np.unique(sweeps.station):
        angles = mean_angles(sweeps.take(sweeps.station == i), len(problem.receiver))
        for position, rotation in candidate_poses(
            angles, problem.receiver, calibrations[i], minimal_sets=minimal_sets
        ):
            candidates.append(
                (int(i), positions[i] + rotations[i] @ position, rotations[i] @ rotation)
            )
    return candidates


def truncated_cost(residual: Array, is_valid: Mask, gate_rad: float) -> Array:
    """Return half the sums of squares (m,) over the variance of an angle, truncated at a gate.

    If a station was moved, a pose that agrees exactly with the other stations is better than one
    that misses all of them a little. A loss that grows without bound would prefer the latter.
    """
    ratio = np.minimum(np.nan_to_num(np.abs(residual), nan=gate_rad) / gate_rad, 1.0)
    squares = np.sum(ratio**2, axis=1, where=is_valid)
    return np.asarray(0.5 * (gate_rad / ANGLE_SIGMA_RAD) ** 2 * squares)


def choose_hypothesis(cost: Array, rotation: Array) -> tuple[int, float]:
    """Choose the best pose of a seed.

    Parameters
    ----------
    cost : (h,) ndarray
    rotation : (h, 3, 3) ndarray

    Returns
    -------
    index : int
        Of the least cost.
    margin : float
        Cost by which the best pose of another orientation is worse; ``MAX_SEED_MARGIN`` if there
        is none.
    """
    order = np.argsort(cost)
    best = int(order[0])
    is_other = rotation_angle(rotation, rotation[best]) > MAX_UNPREDICTED_ROTATION_RAD
    margin = np.min(cost[is_other] - cost[best], initial=MAX_SEED_MARGIN)
    return best, float(margin)


def from_behind_fraction(problem: TrackingProblem, epochs: IntArray, poses: DeviceStates) -> Array:
    """Return the fraction (m,) of sweeps that would reach their photodiodes from behind.

    ``poses`` are those of ``epochs`` (m,). The fraction is 0 for a receiver without normals.
    """
    if problem.receiver.normal is None:
        return np.zeros(len(epochs))
    observations = problem.observations(epochs)
    _, positions = photodiode_positions(observations, poses)
    sweep = problem.windows.sweep[epochs][:, : observations.angle.shape[1]]
    normal = problem.receiver.normal[problem.sweeps.sensor[sweep]]
    normal = normal @ np.swapaxes(poses.rotation, -1, -2)
    direction = positions - problem.stations[0][observations.station]
    is_behind = is_lit_from_behind(direction, normal) & observations.is_observed
    return np.asarray(np.sum(is_behind, axis=1) / np.sum(observations.is_observed, axis=1))


def propagate(problem: TrackingProblem, states: EpochStates) -> None:
    """Solve unsolved epochs from solved neighbours until no front advances."""
    time_ns = problem.windows.time_ns
    epochs = np.flatnonzero(states.status != FAILED)
    while True:
        # A front steps over epochs that have failed.
        epochs = epochs[states.status[epochs] != FAILED]
        is_solved = states.status[epochs] == SOLVED
        is_close = np.diff(time_ns[epochs]) < MAX_PROPAGATION_GAP_S * 1e9
        forward = np.flatnonzero(is_solved[:-1] & ~is_solved[1:] & is_close) + 1
        backward = np.flatnonzero(~is_solved[:-1] & is_solved[1:] & is_close)
        backward = np.setdiff1d(backward, forward)
        targets = epochs[np.r_[forward, backward]]
        sources = epochs[np.r_[forward - 1, backward + 1]]
        if not len(targets):
            return
        elapsed_s = np.asarray((time_ns[targets] - time_ns[sources]) * 1e-9)
        accepted = _solve_from(
            problem, states, targets, states.poses.take(sources).later(elapsed_s)
        )
        states.status[targets] = np.where(accepted, SOLVED, FAILED)
        states.seed[targets[accepted]] = states.seed[sources[accepted]]


def _solve_from(
    problem: TrackingProblem, states: EpochStates, epochs: IntArray, start: DeviceStates
) -> Mask:
    """Fit epochs from starting values, store accepted poses, return which are accepted."""
    accepted = np.zeros(len(epochs), bool)
    for k in range(0, len(epochs), EPOCHS_PER_BATCH):
        rows = np.arange(k, min(k + EPOCHS_PER_BATCH, len(epochs)))
        observations = problem.observations(epochs[rows])
        fit = fit_poses(
            observations,
            problem.stations,
            start.take(rows),
            sigma_rad=INITIAL_SIGMA_RAD,
            loss_scale_rad=LOSS_SCALE_RAD,
            tolerance=INITIAL_TOLERANCE,
            cutoff_rad=OUTLIER_CUTOFF_RAD,
        )
        accepted[rows] = is_accepted(observations, fit.residual)
        states.poses.put(epochs[rows[accepted[rows]]], fit.poses.take(accepted[rows]))
    return accepted


def is_accepted(observations: SweepObservations, residual: Array) -> Mask:
    """Return for each epoch (m,) whether enough of its sweeps agree with the pose."""
    with np.errstate(invalid="ignore"):
        inliers = np.count_nonzero(np.abs(residual) < INLIER_GATE_RAD, axis=1)
    number = np.count_nonzero(observations.is_observed, axis=1)
    return np.asarray((inliers >= MIN_SWEEPS) & (inliers >= MIN_INLIER_FRACTION * number))


def resolve_conflicts(problem: TrackingProblem, states: EpochStates) -> None:
    """Solve the epochs of the less certain of two conflicting seeds again from the other seed."""
    resolved: set[int] = set()
    time_ns = problem.windows.time_ns
    while (seed := find_conflicting_seed(time_ns, states, resolved)) is not None:
        resolved.add(seed)
        epochs = np.flatnonzero(states.seed == seed)
        states.status[epochs] = UNSOLVED
        propagate(problem, states)
        # Epochs that the other seed does not explain keep their poses, which the propagation
        # replaces by accepted ones only.
        states.status[epochs[states.status[epochs] != SOLVED]] = SOLVED


def find_conflicting_seed(time_ns: IntArray, states: EpochStates, resolved: set[int]) -> int | None:
    """Return the least certain seed that contradicts a neighbouring seed.

    Neighbouring epochs contradict each other if their rotations differ by more than their rates
    predict. Seeds in ``resolved`` are not returned; None if no conflict is left.
    """
    solved = np.flatnonzero(states.status == SOLVED)
    first, second = solved[:-1], solved[1:]
    elapsed_s = np.asarray((time_ns[second] - time_ns[first]) * 1e-9)
    predicted = states.poses.take(first).later(elapsed_s).rotation
    unpredicted_rad = rotation_angle(predicted, states.poses.rotation[second])
    is_conflict = unpredicted_rad > MAX_UNPREDICTED_ROTATION_RAD
    is_conflict &= elapsed_s < MAX_PROPAGATION_GAP_S
    is_conflict &= states.seed[first] != states.seed[second]
    if not np.any(is_conflict):
        return None
    margin = np.array(states.seed_margin)
    seeds = states.seed[first[is_conflict]], states.seed[second[is_conflict]]
    weaker = np.where(margin[seeds[0]] < margin[seeds[1]], *seeds)
    weaker = weaker[~np.isin(weaker, list(resolved))]
    return int(weaker[np.argmin(margin[weaker])]) if len(weaker) else None


def is_ambiguous(states: EpochStates, epochs: IntArray) -> Mask:
    """Return which solved epochs were propagated from a seed with a margin below the minimum."""
    margin = np.array(states.seed_margin, float)
    return np.asarray(margin[states.seed[epochs]] < MIN_SEED_MARGIN)


# ---- second pass: refinement


def _refine(
    problem: TrackingProblem,
    states: EpochStates,
    name: str,
    frame: str,
    channels: tuple[int, ...],
) -> TrackedDevice:
    """Fit all solved epochs again with the noise and the inlier gate that the residuals show."""
    solved = np.flatnonzero(states.status == SOLVED)
    noise = max(ANGLE_SIGMA_RAD, robust_sigma(_residuals(problem, states, solved)))
    fit = _fit_epochs(
        problem, states.poses, solved, noise, LOSS_SCALE_SIGMAS * noise, iterations=10
    )
    sweep = problem.windows.sweep[solved]
    residual = _closest_residuals(problem, solved, fit.residual)
    gate = float(
        np.clip(INLIER_GATE_SIGMAS * robust_sigma(residual), MIN_INLIER_GATE_RAD, INLIER_GATE_RAD)
    )
    with np.errstate(invalid="ignore"):
        is_used = np.abs(residual) < gate
        inliers = np.where(np.abs(fit.residual) < gate, sweep, -1)
    sigma, lasting_sigma = angle_noise(problem.sweeps, residual, is_used, sweep)
    covariance = pose_covariance(problem, solved, fit, noise, sigma, lasting_sigma)

    has_too_few = ~has_enough_sweeps(problem.sweeps, inliers)
    variance = np.einsum("mii->mi", covariance)
    is_known = (variance >= 0) & (variance <= MAX_POSE_SIGMA_M_RAD**2)
    is_undetermined = ~np.all(is_known, axis=1)
    rejected = {
        "moment_with_too_few_sweeps": int(np.count_nonzero(has_too_few)),
        "pose_not_determined": int(np.count_nonzero(is_undetermined & ~has_too_few)),
        "sweep_contradicts_pose": int(np.count_nonzero(np.isfinite(residual) & ~is_used)),
    }
    is_good = ~(has_too_few | is_undetermined)
    accepted, poses = solved[is_good], fit.poses.take(is_good)
    trajectory = Trajectory(
        name,
        frame,
        problem.windows.time_ns[accepted],
        poses.position,
        quaternion_from_matrix(poses.rotation),
        covariance[is_good],
    )
    sampled = accepted[:: max(1, len(accepted) // EPOCHS_PER_BATCH)]
    behind = from_behind_fraction(problem, sampled, states.poses.take(sampled))
    return TrackedDevice(
        trajectory,
        problem.sweeps,
        channels,
        residual,
        is_used,
        sigma,
        lasting_sigma,
        add_counts(rejected),
        float(np.mean(behind)) if len(sampled) else 0.0,
        int(np.count_nonzero(is_ambiguous(states, accepted))),
    )


def _fit_epochs(
    problem: TrackingProblem,
    poses: DeviceStates,
    epochs: IntArray,
    sigma: float,
    loss_scale: float,
    iterations: int,
) -> PoseFit:
    """Fit epochs from their poses, in batches; residuals (m, n) in the columns of the windows."""
    width = problem.windows.sweep.shape[1]
    fits = []
    for k in range(0, max(len(epochs), 1), EPOCHS_PER_BATCH):
        batch = epochs[k : k + EPOCHS_PER_BATCH]
        observations = problem.observations(batch)
        fit = fit_poses(
            observations,
            problem.stations,
            poses.take(batch),
            sigma_rad=sigma,
            loss_scale_rad=loss_scale,
            max_iterations=iterations,
            tolerance=REFINED_TOLERANCE,
            cutoff_rad=OUTLIER_CUTOFF_RAD,
        )
        residual = np.full((len(batch), width), np.nan)
        residual[:, : observations.angle.shape[1]] = fit.residual
        fits.append(replace(fit, residual=residual))
    states = DeviceStates(
        *(np.concatenate([getattr(f.poses, n.name) for f in fits]) for n in fields(DeviceStates))
    )
    residual, information, cost = (
        np.concatenate([getattr(f, name) for f in fits])
        for name in ("residual", "information", "cost")
    )
    return PoseFit(states, residual, information, cost)


def _residuals(problem: TrackingProblem, states: EpochStates, epochs: IntArray) -> Array:
    """Return the residuals of a part of the epochs, enough to estimate their noise."""
    parts = [np.zeros(0)]
    sampled = epochs[::NOISE_EPOCH_STRIDE]
    for k in range(0, len(sampled), EPOCHS_PER_BATCH):
        batch = sampled[k : k + EPOCHS_PER_BATCH]
        residual = angle_residuals(
            problem.observations(batch), problem.stations, states.poses.take(batch)
        )
        parts.append(residual.ravel())
    return np.concatenate(parts)


def _closest_residuals(problem: TrackingProblem, epochs: IntArray, residual: Array) -> Array:
    """Return the residual (n,) of each sweep at the epoch closest in time.

    ``residual`` (m, w) is that of the windows of ``epochs``. Sweeps in none of them are ``nan``.
    """
    is_valid = np.isfinite(residual)
    sweep = problem.windows.sweep[epochs][is_valid]
    epoch_ns = np.repeat(problem.windows.time_ns[epochs], np.count_nonzero(is_valid, axis=1))
    distance_ns = np.abs(problem.sweeps.time_ns[sweep] - epoch_ns)
    # Of several values assigned to one element numpy keeps the last: assign the closest last.
    order = np.argsort(-distance_ns, kind="stable")
    closest = np.full(len(problem.sweeps), np.nan)
    closest[sweep[order]] = residual[is_valid][order]
    return closest


def angle_noise(
    sweeps: DeviceSweeps, residual: Array, is_used: Mask, window_sweeps: IntArray
) -> tuple[float, float]:
    """Estimate the standard deviation of an angle in radians: in all, and its lasting part."""
    window_sizes = np.count_nonzero(window_sweeps >= 0, axis=1)
    if not len(window_sizes) or not np.any(is_used):
        return ANGLE_SIGMA_RAD, 0.0
    number = float(np.median(window_sizes))
    # The unknowns of an epoch absorb a part of its residuals.
    inflation = np.sqrt(number / max(number - STATE_UNKNOWNS, 0.25 * number))
    total = max(ANGLE_SIGMA_RAD, inflation * robust_sigma(residual[is_used]))
    return total, lasting_noise(sweeps, residual, is_used, total)


def lasting_noise(sweeps: DeviceSweeps, residual: Array, is_used: Mask, total: float) -> float:
    """Estimate the lasting part of the standard deviation ``total`` of an angle in radians.

    Errors of a photodiode's position, its cover or a generic calibration repeat from rotation to
    rotation and do not average out. The residuals of consecutive rotations differ by the rest of
    the noise only, which separates the two parts.
    """
    series = np.ravel_multi_index(
        (sweeps.station, sweeps.sensor, sweeps.plane),
        (len(CHANNELS), int(np.max(sweeps.sensor)) + 1, 2),
    )
    rows = np.flatnonzero(is_used)
    rows = rows[np.argsort(series[rows], kind="stable")]
    is_consecutive = (np.diff(series[rows]) == 0) & (
        np.diff(sweeps.time_ns[rows]) < MAX_ROTATION_PERIOD_NS
    )
    if not np.any(is_consecutive):
        return total
    passing = robust_sigma(np.diff(residual[rows])[is_consecutive]) / np.sqrt(2)
    return float(np.sqrt(max(0.0, total**2 - passing**2)))


def pose_covariance(
    problem: TrackingProblem,
    epochs: IntArray,
    fit: PoseFit,
    fit_sigma: float,
    sigma: float,
    lasting_sigma: float,
) -> Array:
    """Return the covariance (m, 6, 6) of position and rotation.

    The information of the fit assumes independent angles of ``fit_sigma``. Lasting errors, among
    them those of a generic calibration, repeat in all rotations of a window. Motion that the
    constant rates of a window do not describe is added.
    """
    is_generic = any(c.is_generic for c in problem.stations[2])
    variance = sigma**2 + (ROTATIONS_PER_WINDOW - 1.0) * lasting_sigma**2
    variance += ROTATIONS_PER_WINDOW * CALIBRATION_SIGMA_RAD**2 if is_generic else 0.0
    # What no sweep determines has a large covariance, not an infinite one.
    information = fit.information + WEAK_INFORMATION * np.eye(fit.information.shape[1])
    covariance = np.linalg.inv(information)[:, :6, :6] * variance / fit_sigma**2
    unmodelled = unmodelled_motion(
        problem.windows.time_ns[epochs], fit.poses.rate, problem.half_width_ns
    )
    return np.asarray(covariance + unmodelled[:, :, None] * unmodelled[:, None, :])


def unmodelled_motion(time_ns: IntArray, rate: Array, half_width_ns: int) -> Array:
    """Return the displacement (m, 6) by acceleration that constant rates do not describe.

    It is half the acceleration times the mean square of time in a window. The acceleration is
    that between the neighbouring epochs; it is 0 if these are not close.
    """
    displacement = np.zeros((len(time_ns), 6))
    if len(time_ns) < 3:
        return displacement
    span_s = (time_ns[2:] - time_ns[:-2]) * 1e-9
    is_close = span_s < 6e-9 * half_width_ns
    acceleration = (rate[2:] - rate[:-2]) / span_s[:, None]
    half_width_s = half_width_ns * 1e-9
    displacement[1:-1][is_close] = 0.5 * acceleration[is_close] * half_width_s**2 / 3
    return displacement
