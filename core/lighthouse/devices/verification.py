"""How well each station agrees with where the others see a rigid device.

In short stretches of the recording each station is left out in turn: the pose comes from the
others, and tells at which angles the one that was left out should have met the photodiodes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.geometry import matrix_from_quaternion
from locatk.core.lighthouse.calibration import predict_angles
from locatk.core.lighthouse.devices.device_sweeps import select_device_sweeps
from locatk.core.lighthouse.devices.rigid_solver import DeviceSolution, solve_rigid_devices
from locatk.core.lighthouse.receiver import Receiver
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.lighthouse.results import StationVerification
from locatk.core.lighthouse.scene import Station
from locatk.core.robust import robust_sigma
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

STRETCHES = 60
STRETCH_NS = 60_000_000
"""Looked at are so many stretches, evenly over the recording, each of three rotations, of which
the poses in the middle count: half a second of work a station, however long the recording."""

NEAR_NS = 10_000_000
"""A pose predicts sweeps this close to it: at half a metre a second 5 mm, on both sides alike."""


def verify_devices(
    sweeps: Sweeps, receivers: Mapping[str, Receiver], answer: DeviceSolution
) -> tuple[StationVerification, ...]:
    """Check each station of a solved scene; empty where there is only one.

    Parameters
    ----------
    sweeps : Sweeps
    receivers : mapping of str to Receiver
        By device; all of them in ``answer``.
    answer : DeviceSolution
        Of these sweeps.
    """
    channels = sorted(answer.used)
    if len(channels) < 2 or len(sweeps) == 0:
        return ()
    first, last = int(sweeps.time_ns.min()), int(sweeps.time_ns.max())
    starts = np.linspace(first, max(first, last - STRETCH_NS), STRETCHES).astype(np.int64)
    at = np.searchsorted(starts, sweeps.time_ns, side="right") - 1
    some = sweeps.take(sweeps.time_ns - starts[at] < STRETCH_NS)
    middles = starts + STRETCH_NS // 2
    return tuple(_check(some, receivers, answer, channel, middles) for channel in channels)


def _check(
    sweeps: Sweeps,
    receivers: Mapping[str, Receiver],
    answer: DeviceSolution,
    channel: int,
    middles: NDArray[np.int64],
) -> StationVerification:
    """One station against the others."""
    others = tuple(s for s in answer.scene.stations if s.channel != channel)
    none = StationVerification(channel, "others", 0, None, None, None, None, None)
    try:
        without = solve_rigid_devices(
            sweeps.take(sweeps.channel != channel),
            receivers,
            replace(answer.scene, stations=others),
        )
    except DegenerateError:
        return none
    station = answer.scene.station(channel)
    assert station is not None
    residual, away, jump = [], [], []
    full = {trajectory.device: trajectory for trajectory in answer.trajectories}
    for whole in without.trajectories:
        trajectory = _near(whole, middles)
        if len(trajectory) == 0:
            continue
        off, distance = _off(sweeps, receivers[trajectory.device], trajectory, station)
        residual.append(off)
        away.append(distance)
        jump.append(_jumps(trajectory, full[trajectory.device]))
    if not residual:
        return none
    off, distance, jumps = (np.concatenate(parts) for parts in (residual, away, jump))
    known = np.isfinite(off)
    if not np.any(known):
        return none
    return StationVerification(
        channel,
        "others",
        int(np.count_nonzero(known)),
        robust_sigma(off),
        robust_sigma(off * distance),
        float(np.median(jumps)) if len(jumps) else None,
        float(np.percentile(jumps, 95)) if len(jumps) else None,
        robust_sigma(np.concatenate(list(without.residuals.values()))),
    )


def _near(trajectory: Trajectory, middles: NDArray[np.int64]) -> Trajectory:
    """The poses that have sweeps on both sides of them."""
    if len(trajectory) == 0:
        return trajectory
    at = _nearest(middles, trajectory.time_ns)
    inner = np.abs(middles[at] - trajectory.time_ns) < NEAR_NS
    return replace(
        trajectory,
        time_ns=trajectory.time_ns[inner],
        position=trajectory.position[inner],
        quaternion=trajectory.quaternion[inner],
        covariance=trajectory.covariance[inner],
    )


def _off(
    sweeps: Sweeps, receiver: Receiver, trajectory: Trajectory, station: Station
) -> tuple[Array, Array]:
    """Predicted minus observed angle of a station's sweeps near poses, and their distances."""
    device = sweeps.devices.index(trajectory.device)
    own, _ = select_device_sweeps(sweeps, device, receiver, [station.channel])
    pose = _nearest(trajectory.time_ns, own.time_ns)
    own_near = np.abs(trajectory.time_ns[pose] - own.time_ns) < NEAR_NS
    own, pose = own.take(own_near), pose[own_near]
    rotation = matrix_from_quaternion(trajectory.quaternion[pose])
    place = receiver.position_m[own.sensor]
    point = trajectory.position[pose] + (rotation @ place[:, :, None])[..., 0]
    local = (point - station.position) @ station.rotation
    predicted = predict_angles(local, station.calibration)[np.arange(len(own)), own.plane]
    return predicted - own.angle, np.linalg.norm(local, axis=1)


def _jumps(without: Trajectory, full: Trajectory) -> Array:
    """How far positions (n, 3) move when a station is left out, in metres."""
    if len(full) == 0:
        return np.zeros(0)
    at = _nearest(full.time_ns, without.time_ns)
    near = np.abs(full.time_ns[at] - without.time_ns) < NEAR_NS
    moved = without.position[near] - full.position[at[near]]
    length: Array = np.linalg.norm(moved, axis=1)
    return length


def _nearest(time_ns: NDArray[np.int64], asked: NDArray[np.int64]) -> NDArray[np.int64]:
    """Index of the ascending ``time_ns`` nearest to each time asked for."""
    after = np.clip(np.searchsorted(time_ns, asked), 0, len(time_ns) - 1)
    before = np.maximum(after - 1, 0)
    earlier = asked - time_ns[before] < time_ns[after] - asked
    return np.where(earlier, before, after)
