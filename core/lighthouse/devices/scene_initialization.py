"""Scene estimated from rigid devices alone; their size gives the scale.

The sweeps of one station determine the pose of a device of known shape under that station. The
scene follows in four steps:

1. Poses of the devices under each single station, at epochs distributed over the recording
   (:func:`estimate_station_poses`). A coplanar device can have two.
2. Relative poses of pairs of stations from epochs at which both received a device
   (:func:`estimate_links`). The epochs vote, since some of the poses are wrong.
3. Poses of all linked stations in the frame of the first one, along the spanning tree of the
   links with the most epochs (:func:`connect_stations`).
4. Bundle adjustment of the stations and of the poses of the devices.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.geometry import rotation_angle
from locatk.core.least_squares import cauchy_loss
from locatk.core.lighthouse.calibration import GENERIC_CALIBRATION, MODEL_SIGMA_RAD, Calibration
from locatk.core.lighthouse.devices.bundle_adjustment import adjust_devices
from locatk.core.lighthouse.devices.device_sweeps import (
    MIN_SWEEPS,
    ROTATIONS_PER_WINDOW,
    DeviceSweeps,
    SweepWindows,
    gather_observations,
    has_enough_sweeps,
    make_windows,
    mean_angles,
    rotation_limits_ns,
)
from locatk.core.lighthouse.devices.pnp import candidate_poses
from locatk.core.lighthouse.devices.pose_fit import (
    DeviceStates,
    SweepObservations,
    angle_residuals,
    fit_poses,
)
from locatk.core.lighthouse.devices.tracking import (
    LOSS_SCALE_RAD,
    LOSS_SCALE_SIGMAS,
    is_accepted,
)
from locatk.core.lighthouse.noise import ANGLE_SIGMA_RAD, UNREACHABLE_RESIDUAL_SIGMAS
from locatk.core.lighthouse.receiver import Receiver
from locatk.core.lighthouse.results import LighthouseFacts, StationPairLink
from locatk.core.lighthouse.scene import Scene, Station
from locatk.core.lighthouse.scene.estimation import generic_calibration_warnings
from locatk.core.lighthouse.scene.model import StationArrays
from locatk.core.robust import robust_sigma
from locatk.core.solution import SolverWarning

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
Mask = NDArray[np.bool_]

MAX_EPOCHS_PER_DEVICE = 200
"""Maximum number of epochs of a device that are solved under each station."""

STATION_WEIGHT_SWEEPS = 1e4
"""Number of sweeps that a further station of an epoch is worth: more than a window can contain,
because epochs with several stations link these."""

MAX_STATION_HYPOTHESES = 2
"""Poses of a device under one station that are kept; a coplanar device has two."""

MAX_HYPOTHESIS_COST = 50.0
"""Maximum cost (half the sum of squares over the variance of an angle) by which the second pose may
be worse than the first."""

MIN_HYPOTHESIS_ROTATION_RAD = 0.15
"""Minimum angle between two poses of a device under one station that count as different."""

LINK_ROTATION_GATE_RAD = 0.15
LINK_POSITION_GATE_FRACTION = 0.15
"""Rotation (rad) and displacement (fraction of the sum of both distances to the device) by which
the relative pose of two stations at one epoch may differ from that of the pair. The pose of a deck
of 30 mm at two metres is off by a few degrees."""

MAX_LINK_PROPOSALS = 200
"""Maximum number of epochs whose relative pose is proposed for a pair of stations."""

LINK_ITERATIONS = 5
"""Number of times that the relative pose is averaged over the agreeing epochs."""

MIN_RIVAL_FRACTION = 0.8
"""Fraction of the votes for the best relative pose from which on another is as good."""

MAX_ADJUSTED_EPOCHS = 160
MAX_EPOCHS_PER_POSITION = 4
"""Maximum number of epochs in the bundle adjustment, in all and at one position. A device at rest
repeats the same errors, so that the epochs of a position together have the weight of one."""

MAX_CLUSTER_DISTANCE_M = 0.05
MAX_CLUSTER_ROTATION_RAD = 0.15
"""Maximum distance and angle between epochs that count as one position of a device."""

MIN_POSITIONS = 8
"""Number of positions below which a warning is given."""

INITIAL_LOSS_SCALE_RAD = 10 * LOSS_SCALE_RAD
"""Scale of the Cauchy loss while the poses of the stations are rough."""


@dataclass(frozen=True)
class DeviceSceneEstimate:
    """Scene estimated from rigid devices, with facts and warnings."""

    scene: Scene
    facts: LighthouseFacts
    warnings: tuple[SolverWarning, ...]


@dataclass(frozen=True)
class StationPoses:
    """Poses of devices under single stations, one row per hypothesis.

    Attributes
    ----------
    epoch : (v,) int ndarray
        Number of the epoch, over all devices.
    station : (v,) int ndarray
    position : (v, 3) ndarray
        Of the device in the station's axes, in metres.
    rotation : (v, 3, 3) ndarray
        Device to station.
    """

    epoch: IntArray
    station: IntArray
    position: Array
    rotation: Array

    def __len__(self) -> int:
        return len(self.epoch)


@dataclass(frozen=True)
class StationLink:
    """Pose of a second station in the axes of a first one.

    Attributes
    ----------
    first, second : int
        Indices of the stations.
    position : (3,) ndarray
        In metres.
    rotation : (3, 3) ndarray
        Second to first.
    epochs : int
        Number of epochs that agree with it.
    is_ambiguous : bool
        True if a quite different pose has about as many votes. A coplanar device that was not
        moved has two poses under each station, and nothing decides between them.
    """

    first: int
    second: int
    position: Array
    rotation: Array
    epochs: int
    is_ambiguous: bool = False


def estimate_scene_from_devices(
    devices: Sequence[tuple[DeviceSweeps, Receiver]], channels: Sequence[int], scene: Scene
) -> DeviceSceneEstimate:
    """Estimate the stations from the sweeps of rigid devices.

    Parameters
    ----------
    devices : sequence of (DeviceSweeps, Receiver)
        Their ``station`` indexes ``channels``.
    channels : sequence of int
    scene : Scene
        Without stations; its calibrations and serial numbers are used.

    Returns
    -------
    DeviceSceneEstimate
        In the axes of the first station that is linked to others.

    Raises
    ------
    DegenerateError
        No station determines the pose of a device.
    """
    calibrations = tuple(scene.calibrations.get(c, GENERIC_CALIBRATION) for c in channels)
    interval_ns, half_width_ns = rotation_limits_ns(list(channels))
    observations, station_poses, number = [], [], 0
    for sweeps, receiver in devices:
        windows = make_windows(sweeps, interval_ns, half_width_ns)
        epochs = select_epochs(sweeps, windows)
        if not len(epochs):
            continue
        poses = estimate_station_poses(sweeps, receiver, windows, epochs, calibrations)
        station_poses.append(replace(poses, epoch=poses.epoch + number))
        observations.append(gather_observations(sweeps, windows, receiver, epochs))
        number += len(epochs)
    poses = _concatenate_poses(station_poses)
    if not len(poses):
        raise DegenerateError(
            "no station determines the pose of a device: too few photodiodes receive it at a time",
            hint="three or more photodiodes must receive both planes of one station; does the "
            "receiver's file describe this device?",
        )
    links = estimate_links(poses, len(channels))
    connected = connect_stations(links, poses, len(channels))
    joined = list(connected)
    stations: StationArrays = (
        np.stack([connected[i][0] for i in joined]),
        np.stack([connected[i][1] for i in joined]),
        tuple(calibrations[i] for i in joined),
    )
    return _adjust_scene(
        _stack_observations(observations), poses, stations, joined, channels, scene, links
    )


def select_epochs(sweeps: DeviceSweeps, windows: SweepWindows) -> IntArray:
    """Select epochs distributed over the recording, with many stations and sweeps.

    The recording is divided into ``MAX_EPOCHS_PER_DEVICE`` parts; the best epoch of each part is
    selected.
    """
    if not len(windows):
        return np.zeros(0, np.int64)
    is_sweep = windows.sweep >= 0
    station = np.where(is_sweep, sweeps.station[windows.sweep], -1)
    value = np.count_nonzero(is_sweep, axis=1).astype(float)
    for i in np.unique(sweeps.station):
        is_received = np.count_nonzero(station == i, axis=1) >= MIN_SWEEPS
        value += STATION_WEIGHT_SWEEPS * is_received
    count = max(len(windows), MAX_EPOCHS_PER_DEVICE)
    part = np.arange(len(windows)) * MAX_EPOCHS_PER_DEVICE // count
    order = np.lexsort((-value, part))
    is_best = np.r_[True, np.diff(part[order]) > 0]
    return np.sort(order[is_best])


# ---- poses under single stations


def estimate_station_poses(
    sweeps: DeviceSweeps,
    receiver: Receiver,
    windows: SweepWindows,
    epochs: IntArray,
    calibrations: tuple[Calibration, ...],
) -> StationPoses:
    """Estimate the poses of a device at selected epochs under each station by itself.

    The ``epoch`` of the result indexes ``epochs``.
    """
    parts = []
    for i, calibration in enumerate(calibrations):
        sweep = windows.sweep[epochs]
        sweep = np.where((sweep >= 0) & (sweeps.station[sweep] == i), sweep, -1)
        # The padding of a window follows its sweeps.
        sweep = np.take_along_axis(sweep, np.argsort(sweep < 0, axis=1, kind="stable"), axis=1)
        hypotheses: list[tuple[int, Array, Array]] = []
        for k in np.flatnonzero(has_enough_sweeps(sweeps, sweep)):
            angles = mean_angles(sweeps.take(sweep[k][sweep[k] >= 0]), len(receiver))
            candidates = candidate_poses(angles, receiver, calibration, minimal_sets=False)
            hypotheses.extend((int(k), *candidate) for candidate in candidates)
        if not hypotheses:
            continue
        owners, positions, rotations = zip(*hypotheses, strict=True)
        owner = np.array(owners)
        station_windows = SweepWindows(windows.time_ns[epochs], sweep)
        all_epochs = np.arange(len(epochs))
        observations = gather_observations(sweeps, station_windows, receiver, all_epochs)
        observations = observations.take(owner)
        fit = fit_poses(
            replace(observations, station=np.zeros_like(observations.station)),
            (np.zeros((1, 3)), np.eye(3)[None], (calibration,)),
            DeviceStates.at_rest(np.stack(positions), np.stack(rotations)),
            sigma_rad=ANGLE_SIGMA_RAD,
            loss_scale_rad=LOSS_SCALE_RAD,
            max_iterations=15,
        )
        is_in_front = fit.poses.position[:, 0] > 0
        accepted = is_accepted(observations, fit.residual) & is_in_front
        kept = select_hypotheses(owner, fit.cost, fit.poses.rotation, accepted)
        poses = fit.poses.take(kept)
        parts.append(
            StationPoses(owner[kept], np.full(len(kept), i), poses.position, poses.rotation)
        )
    return _concatenate_poses(parts)


def select_hypotheses(owner: IntArray, cost: Array, rotation: Array, accepted: Mask) -> IntArray:
    """Select the distinct hypotheses of each epoch that are not much worse than its best.

    Parameters
    ----------
    owner : (h,) int ndarray
        Epoch of each hypothesis.
    cost : (h,) ndarray
    rotation : (h, 3, 3) ndarray
    accepted : (h,) bool ndarray

    Returns
    -------
    (k,) int ndarray
        Rows, by epoch and cost.
    """
    kept: list[int] = []
    kept_of_epoch: list[int] = []
    for row in np.lexsort((cost, owner)):
        if not accepted[row]:
            continue
        if kept_of_epoch and owner[kept_of_epoch[0]] != owner[row]:
            kept_of_epoch = []
        if len(kept_of_epoch) >= MAX_STATION_HYPOTHESES:
            continue
        if kept_of_epoch and cost[row] > cost[kept_of_epoch[0]] + MAX_HYPOTHESIS_COST:
            continue
        if all(
            rotation_angle(rotation[row], rotation[k]) > MIN_HYPOTHESIS_ROTATION_RAD
            for k in kept_of_epoch
        ):
            kept_of_epoch.append(int(row))
            kept.append(int(row))
    return np.array(kept, np.int64)


def _concatenate_poses(parts: Sequence[StationPoses]) -> StationPoses:
    if not parts:
        none = np.zeros(0, np.int64)
        return StationPoses(none, none, np.zeros((0, 3)), np.zeros((0, 3, 3)))
    return StationPoses(
        np.concatenate([p.epoch for p in parts]),
        np.concatenate([p.station for p in parts]),
        np.concatenate([p.position for p in parts]),
        np.concatenate([p.rotation for p in parts]),
    )


# ---- relative poses of stations


def estimate_links(poses: StationPoses, stations: int) -> list[StationLink]:
    """Estimate the relative poses of all pairs of stations that received a device together."""
    pairs = [(i, j) for i in range(stations) for j in range(i + 1, stations)]
    links = [estimate_link(poses, i, j) for i, j in pairs]
    return [link for link in links if link is not None]


def estimate_link(poses: StationPoses, first: int, second: int) -> StationLink | None:
    """Estimate the pose of a second station in the axes of a first one.

    Each epoch with poses under both stations yields a relative pose, or several if the poses are
    ambiguous. The relative pose with the least truncated cost over all epochs is chosen and
    averaged over the epochs that agree with it. None without a common epoch.
    """
    rows = [np.flatnonzero(poses.station == i) for i in (first, second)]
    pair = np.nonzero(poses.epoch[rows[0]][:, None] == poses.epoch[rows[1]][None])
    if not len(pair[0]):
        return None
    a, b = rows[0][pair[0]], rows[1][pair[1]]
    # Second station to device, then device to first station.
    rotation = poses.rotation[a] @ np.swapaxes(poses.rotation[b], -1, -2)
    position = poses.position[a] - (rotation @ poses.position[b][..., None])[..., 0]
    distance = np.linalg.norm(poses.position[a], axis=1) + np.linalg.norm(poses.position[b], axis=1)

    def squared_misfit(pairs: IntArray, positions: Array, rotations: Array) -> Array:
        """Return the misfit (h, p) of proposals (h) at pairs of poses (p); 1 at the gate."""
        angle = rotation_angle(rotations[:, None], rotation[pairs])
        displacement = np.linalg.norm(positions[:, None] - position[pairs], axis=2)
        return (angle / LINK_ROTATION_GATE_RAD) ** 2 + (
            displacement / (LINK_POSITION_GATE_FRACTION * distance[pairs])
        ) ** 2

    all_pairs = np.arange(len(a))
    count = min(len(a), MAX_LINK_PROPOSALS)
    proposals = np.unique(np.linspace(0, len(a) - 1, count).astype(int))
    misfit = squared_misfit(all_pairs, position[proposals], rotation[proposals])
    # At most one of the hypotheses of an epoch is right: the one with the least misfit counts.
    epochs, epoch = np.unique(poses.epoch[a], return_inverse=True)
    cost = np.ones((len(proposals), len(epochs)))
    np.minimum.at(cost.T, epoch, np.minimum(misfit, 1.0).T)
    best = int(proposals[np.argmin(cost.sum(axis=1))])
    link_position, link_rotation = position[best], rotation[best]
    for _ in range(LINK_ITERATIONS):
        misfit = squared_misfit(all_pairs, link_position[None], link_rotation[None])
        inliers = np.flatnonzero(misfit[0] < 1.0)
        if not len(inliers):
            return None
        link_position = np.median(position[inliers], axis=0)
        link_rotation = _mean_rotation(rotation[inliers])
    agreeing = len(np.unique(epoch[inliers]))
    is_rival = squared_misfit(proposals, link_position[None], link_rotation[None])[0] >= 1.0
    rival_votes = np.count_nonzero(cost[is_rival] < 1.0, axis=1)
    is_ambiguous = bool(np.any(rival_votes >= MIN_RIVAL_FRACTION * agreeing))
    return StationLink(first, second, link_position, link_rotation, agreeing, is_ambiguous)


def _mean_rotation(rotations: Array) -> Array:
    """Return the rotation (3, 3) closest to all of (n, 3, 3) (chordal mean)."""
    u, _, vt = np.linalg.svd(np.sum(rotations, axis=0))
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)


def connect_stations(
    links: Sequence[StationLink], poses: StationPoses, stations: int
) -> dict[int, tuple[Array, Array]]:
    """Connect stations along the spanning tree of the links with the most epochs (Prim 1957).

    Returns
    -------
    dict of int to ((3,) ndarray, (3, 3) ndarray)
        Positions and rotations of the largest set of connected stations in the axes of the first
        of them, by ascending station.
    """
    largest: dict[int, tuple[Array, Array]] = {}
    for root in range(stations):
        if root in largest or not np.any(poses.station == root):
            continue
        connected = {root: (np.zeros(3), np.eye(3))}
        while True:
            open_links = [k for k in links if (k.first in connected) != (k.second in connected)]
            if not open_links:
                break
            link = max(open_links, key=lambda k: k.epochs)
            if link.first in connected:
                position, rotation = connected[link.first]
                connected[link.second] = (
                    position + rotation @ link.position,
                    rotation @ link.rotation,
                )
            else:
                position, rotation = connected[link.second]
                first_rotation = rotation @ link.rotation.T
                connected[link.first] = (position - first_rotation @ link.position, first_rotation)
        if len(connected) > len(largest):
            largest = connected
    return dict(sorted(largest.items()))


# ---- bundle adjustment


def _stack_observations(parts: list[SweepObservations]) -> SweepObservations:
    """Concatenate the epochs of several devices, padded to the same number of sweeps."""
    width = max(p.angle.shape[1] for p in parts)

    def pad(values: NDArray[np.generic]) -> NDArray[np.generic]:
        padding = [(0, 0), (0, width - values.shape[1])] + [(0, 0)] * (values.ndim - 2)
        return np.pad(values, padding)

    return SweepObservations(
        *(
            np.concatenate([pad(getattr(p, name)) for p in parts])
            for name in (
                "sensor_position",
                "station",
                "plane",
                "angle",
                "time_offset_s",
                "is_observed",
            )
        )
    )


def _adjust_scene(
    observations: SweepObservations,
    poses: StationPoses,
    stations: StationArrays,
    joined: list[int],
    channels: Sequence[int],
    scene: Scene,
    links: list[StationLink],
) -> DeviceSceneEstimate:
    """Adjust stations and device poses together, in the axes of the first station.

    ``joined`` are the indices in ``channels`` of ``stations``.
    """
    column = np.full(len(channels), -1)
    column[joined] = np.arange(len(joined))
    observations = replace(
        observations,
        station=column[observations.station],
        is_observed=observations.is_observed & (column[observations.station] >= 0),
    )
    epochs, states, station_count = _initial_states(observations, poses, stations, column)
    observations = observations.take(epochs)
    position = cluster_poses(states)
    chosen = select_keyframes(position, station_count)
    observations, states, position = (
        observations.take(chosen),
        states.take(chosen),
        position[chosen],
    )
    position_count = int(np.max(position)) + 1
    weight = epoch_weights(position)

    is_refined = np.array([c.source == "generic" for c in stations[2]])
    sigma = MODEL_SIGMA_RAD if np.any(is_refined) else 2 * ANGLE_SIGMA_RAD
    adjusted = adjust_devices(
        observations, stations, states,
        sigma_rad=sigma, loss_scale_rad=LOSS_SCALE_RAD, epoch_weight=weight, calibrate=is_refined,
    )  # fmt: skip
    # A second adjustment uses the noise that the residuals of the first one show.
    sigma = max(ANGLE_SIGMA_RAD, robust_sigma(adjusted.residual))
    loss_scale = min(LOSS_SCALE_SIGMAS * sigma, LOSS_SCALE_RAD)
    adjusted = adjust_devices(
        observations, adjusted.stations, adjusted.poses,
        sigma_rad=sigma, loss_scale_rad=loss_scale, epoch_weight=weight, calibrate=is_refined,
    )  # fmt: skip
    facts = LighthouseFacts(
        adjusted_epochs=len(observations),
        adjusted_positions=position_count,
        scene_angle_sigma_rad=sigma,
        iterations=adjusted.iterations,
        links=tuple(
            StationPairLink((int(channels[k.first]), int(channels[k.second])), k.epochs)
            for k in links
        ),
    )
    warnings = _warnings(joined, channels, adjusted.stations[2], position_count, links)
    positions, rotations, calibrations = adjusted.stations
    solved = tuple(
        Station(
            int(channels[i]),
            positions[k],
            rotations[k],
            calibrations[k],
            scene.ids.get(int(channels[i])),
            adjusted.covariance[k],
        )
        for k, i in enumerate(joined)
    )
    estimated = replace(
        scene,
        stations=solved,
        planar=False,
        floor_z=0.0,
        scale="device",
        frame=f"station-{channels[joined[0]]}",
        frame_source="station",
        notes=tuple(warning.message for warning in warnings),
    )
    return DeviceSceneEstimate(estimated, facts, warnings)


def _initial_states(
    observations: SweepObservations, poses: StationPoses, stations: StationArrays, column: IntArray
) -> tuple[IntArray, DeviceStates, IntArray]:
    """Fit the poses of the devices to all stations, from the hypothesis that fits them best.

    Returns
    -------
    epochs : (m,) int ndarray
        Epochs with a pose.
    states : DeviceStates
    station_count : (m,) int ndarray
        Number of stations of each epoch.
    """
    rows = np.flatnonzero(column[poses.station] >= 0)
    station = column[poses.station[rows]]
    positions, rotations = stations[0][station], stations[1][station]
    start = DeviceStates.at_rest(
        positions + (rotations @ poses.position[rows][..., None])[..., 0],
        rotations @ poses.rotation[rows],
    )
    epoch = poses.epoch[rows]
    residual = angle_residuals(observations.take(epoch), stations, start) / MODEL_SIGMA_RAD
    is_observed = observations.is_observed[epoch]
    residual = np.where(np.isfinite(residual), residual, UNREACHABLE_RESIDUAL_SIGMAS)
    loss, _ = cauchy_loss(residual, INITIAL_LOSS_SCALE_RAD / MODEL_SIGMA_RAD)
    order = np.lexsort((np.sum(loss, axis=1, where=is_observed), epoch))
    best = order[np.r_[True, np.diff(epoch[order]) > 0]]
    observations = observations.take(epoch[best])
    fit = fit_poses(
        observations,
        stations,
        start.take(best),
        sigma_rad=MODEL_SIGMA_RAD,
        loss_scale_rad=INITIAL_LOSS_SCALE_RAD,
    )
    station_count = np.zeros(len(best), np.int64)
    for i in range(len(stations[2])):
        station_count += np.any(observations.is_observed & (observations.station == i), axis=1)
    return epoch[best], fit.poses, station_count


def cluster_poses(poses: DeviceStates) -> IntArray:
    """Return the number (m,) of the position and orientation of each pose.

    Poses are assigned in order to the first cluster whose first pose is close.
    """
    first_poses: list[int] = []
    cluster = np.empty(len(poses), np.int64)
    for i in range(len(poses)):
        distance = np.linalg.norm(poses.position[first_poses] - poses.position[i], axis=1)
        angle = rotation_angle(poses.rotation[first_poses], poses.rotation[i])
        is_close = (distance < MAX_CLUSTER_DISTANCE_M) & (angle <= MAX_CLUSTER_ROTATION_RAD)
        clusters = np.flatnonzero(is_close)
        if not len(clusters):
            first_poses.append(i)
        cluster[i] = clusters[0] if len(clusters) else len(first_poses) - 1
    return cluster


def select_keyframes(position: IntArray, station_count: IntArray) -> IntArray:
    """Select the epochs for the bundle adjustment.

    At each position those with the most stations are selected, ``MAX_EPOCHS_PER_POSITION`` at
    most. If these are more than ``MAX_ADJUSTED_EPOCHS``, a subset spread over all positions is.
    """
    order = np.lexsort((-station_count, position))
    rank = np.arange(len(order)) - np.searchsorted(position[order], position[order])
    order = order[rank < MAX_EPOCHS_PER_POSITION]
    if len(order) > MAX_ADJUSTED_EPOCHS:
        order = order[np.linspace(0, len(order) - 1, MAX_ADJUSTED_EPOCHS).astype(int)]
    return np.sort(order)


def epoch_weights(position: IntArray) -> Array:
    """Return the weight (m,) of each epoch in the bundle adjustment.

    The epochs of a position together have the weight of one rotation, because both rotations of a
    window and all epochs of a device at rest repeat the same errors.
    """
    epochs_at_position = np.bincount(position)
    return np.asarray(1.0 / (ROTATIONS_PER_WINDOW * epochs_at_position[position]), np.float64)


def _warnings(
    joined: list[int],
    channels: Sequence[int],
    calibrations: tuple[Calibration, ...],
    positions: int,
    links: Sequence[StationLink],
) -> tuple[SolverWarning, ...]:
    warnings = []
    unlinked = [str(c) for i, c in enumerate(channels) if i not in joined]
    if unlinked:
        warnings.append(
            SolverWarning(
                "station_not_linked",
                f"station on channel {', '.join(unlinked)} is left out: it never received a "
                "device at the same time as the other stations",
            )
        )
    warnings += generic_calibration_warnings([channels[i] for i in joined], calibrations)
    if positions < MIN_POSITIONS and len(joined) > 1:
        warnings.append(
            SolverWarning(
                "few_device_positions",
                f"the scene depends on {positions} position{'' if positions == 1 else 's'} of the "
                "devices only: move and rotate a device during the recording, so that single "
                "errors average out",
            )
        )
    ambiguous = [f"{channels[k.first]} and {channels[k.second]}" for k in links if k.is_ambiguous]
    if ambiguous:
        warnings.append(
            SolverWarning(
                "ambiguous_station_pair",
                f"the relative pose of the stations on channels {', '.join(ambiguous)} has two "
                "solutions that fit equally well: move and rotate the device during the recording",
            )
        )
    return tuple(warnings)
