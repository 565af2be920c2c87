"""The whole way of a robot: poses at the times of its odometry, held by the visits."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from locatk.core.geometry import heading_from_quaternion, quaternion_from_heading
from locatk.core.landmarks.detection.fit import POSE, Priors
from locatk.core.landmarks.detection.trace import bent, compose, relative
from locatk.core.landmarks.localization.smoothing import FINEST, SYSTEMATIC, Link, StayPose, link
from locatk.core.landmarks.visits import Visit
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]


def links(visits: list[Visit], odometry: Trajectory, priors: Priors) -> list[Link]:
    """Odometry between visits, each from the last bin of one to the first of the next."""
    return [link(_way(odometry, one, other)[1], priors) for one, other in pairwise(visits)]


def poses(
    device: str,
    visits: list[Visit],
    stays: list[StayPose],
    odometry: Trajectory,
    priors: Priors,
) -> Trajectory:
    """Poses of a robot in the map's frame at the times of its odometry.

    Parameters
    ----------
    device : str
    visits : list of Visit
        At least one; those whose place on the map is known.
    stays : list of StayPose
        What was found for each.
    odometry : Trajectory
    priors : Priors

    Returns
    -------
    Trajectory
        Height, roll and pitch are 0 and not observed.
    """
    plane = _plane(odometry)
    parts = [_tail(visits[0], stays[0], odometry, priors, before=True)]
    for number, (visit, stay) in enumerate(zip(visits, stays, strict=True)):
        inside = (odometry.time_ns >= visit.time_ns[0]) & (odometry.time_ns <= visit.time_ns[-1])
        at = odometry.time_ns[inside]
        parts.append((at, *_at_visit(visit, stay, at, plane[inside])))
        if number + 1 < len(visits):
            pair = slice(number, number + 2)
            parts.append(_between(visits[pair], stays[pair], odometry, priors))
    parts.append(_tail(visits[-1], stays[-1], odometry, priors, before=False))
    times, found, spread = (np.concatenate(each) for each in zip(*parts, strict=True))
    covariance = np.full((len(found), 6, 6), np.nan)
    rows = np.array([0, 1, 5])
    covariance[:, rows[:, None], rows] = spread
    position = np.column_stack([found[:, :2], np.zeros(len(found))])
    heading = quaternion_from_heading(found[:, 2])
    return Trajectory(device, "map", times, position, heading, covariance)


def _plane(odometry: Trajectory) -> Array:
    """(n, 3) x, y and unwrapped heading."""
    return np.column_stack(
        [odometry.position[:, :2], np.unwrap(heading_from_quaternion(odometry.quaternion))]
    )


def _way(odometry: Trajectory, one: Visit, other: Visit) -> tuple[NDArray[np.int64], Array]:
    """Times of odometry between two visits, and its poses with both ends."""
    first, last = int(one.time_ns[-1]), int(other.time_ns[0])
    inside = (odometry.time_ns > first) & (odometry.time_ns < last)
    ends = _bin_odometry(one, -1), _bin_odometry(other, 0)
    return odometry.time_ns[inside], np.vstack([ends[0], _plane(odometry)[inside], ends[1]])


def _bin_odometry(visit: Visit, at: int) -> Array:
    """Mean pose of one bin by odometry."""
    return compose(visit.origin, visit.trace.pose[at])


def _at_visit(
    visit: Visit, stay: StayPose, at: NDArray[np.int64], pose: Array
) -> tuple[Array, Array]:
    """Poses (n, 3) in the map's frame, and their covariances, at times of a visit."""
    trace, base = visit.trace, visit.time_ns[0]
    index = np.interp(at - base, visit.time_ns - base, np.arange(len(visit.time_ns)))
    low = np.minimum(index.astype(int), max(len(trace) - 2, 0))
    share = (index - low)[:, None, None]
    high = np.minimum(low + 1, len(trace) - 1)
    correction = (1 - share) * trace.correction[low] + share * trace.correction[high]
    return _laid(stay, relative(pose, visit.origin), correction)


def _laid(stay: StayPose, local: Array, correction: Array) -> tuple[Array, Array]:
    """Poses and covariances of what is at ``local`` (n, 3) in a stay's frame."""
    local = local + correction @ stay.wrong
    cos, sin = np.cos(stay.pose[2]), np.sin(stay.pose[2])
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    slope = np.zeros((len(local), 3, POSE + correction.shape[2]))
    slope[:, :, :POSE] = np.eye(3)
    slope[:, 0, 2] = -sin * local[:, 0] - cos * local[:, 1]
    slope[:, 1, 2] = cos * local[:, 0] - sin * local[:, 1]
    slope[:, :, POSE:] = turn @ correction
    covariance = slope @ stay.covariance @ slope.swapaxes(1, 2)
    return compose(stay.pose, local), covariance


def _between(
    visits: list[Visit], stays: list[StayPose], odometry: Trajectory, priors: Priors
) -> tuple[NDArray[np.int64], Array, Array]:
    """The way between two visits: odometry, its misfit spread over the way."""
    at, way = _way(odometry, *visits)
    joint = link(way, priors)
    start, start_spread = _end(visits[0], stays[0], -1)
    goal, goal_spread = _end(visits[1], stays[1], 0)
    steady = stays[0].wrong[:SYSTEMATIC]
    local = bent(joint.pose, steady, priors.drift)
    walk = joint.correction[:, :, SYSTEMATIC:]
    cos, sin = np.cos(start[2]), np.sin(start[2])
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    miss = turn.T @ (goal - start) - local[-1]
    miss[2] = np.remainder(miss[2] + np.pi, 2 * np.pi) - np.pi
    last = walk[-1]
    gain = last.T @ np.linalg.inv(last @ last.T + np.diag(FINEST**2))
    local = local + walk @ (gain @ miss)
    rest = np.eye(walk.shape[2]) - gain @ last
    bridge = turn @ (walk @ rest @ walk.swapaxes(1, 2)) @ turn.T
    # How far along: by what the random walk has added.
    growth = np.einsum("nim,nim->n", walk, walk)
    share = (growth / max(growth[-1], 1e-300))[:, None, None]
    covariance = (1 - share) * start_spread + share * goal_spread + bridge
    return at, compose(start, local)[1:-1], covariance[1:-1]


def _tail(
    visit: Visit, stay: StayPose, odometry: Trajectory, priors: Priors, *, before: bool
) -> tuple[NDArray[np.int64], Array, Array]:
    """The way before the first or after the last visit: odometry alone."""
    edge = 0 if before else -1
    bound = visit.time_ns[edge]
    inside = odometry.time_ns < bound if before else odometry.time_ns > bound
    at, way = odometry.time_ns[inside], _plane(odometry)[inside]
    order = slice(None, None, -1) if before else slice(None)
    way = np.vstack([_bin_odometry(visit, edge), way[order]])
    joint = link(way, priors)
    start, spread = _end(visit, stay, edge)
    # What turns the way as it is driven turns it the other way backward.
    sign = np.array([1.0, 1.0, -1.0 if before else 1.0])
    steady = joint.correction[:, :, :SYSTEMATIC] * sign
    walk = joint.correction[:, :, SYSTEMATIC:]
    local = bent(joint.pose, sign * stay.wrong[:SYSTEMATIC], priors.drift)
    cos, sin = np.cos(start[2]), np.sin(start[2])
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    known = stay.covariance[POSE : POSE + SYSTEMATIC, POSE : POSE + SYSTEMATIC]
    own = steady @ known @ steady.swapaxes(1, 2) + walk @ walk.swapaxes(1, 2)
    slope = np.tile(np.eye(3), (len(local), 1, 1))
    slope[:, 0, 2] = -sin * local[:, 0] - cos * local[:, 1]
    slope[:, 1, 2] = cos * local[:, 0] - sin * local[:, 1]
    covariance = slope @ spread @ slope.swapaxes(1, 2) + turn @ own @ turn.T
    pose = compose(start, local)[1:]
    return at, pose[order], covariance[1:][order]


def _end(visit: Visit, stay: StayPose, at: int) -> tuple[Array, Array]:
    """Pose and covariance at one bin of a visit."""
    pose, covariance = _laid(stay, visit.trace.pose[[at]], visit.trace.correction[[at]])
    return pose[0], covariance[0]
