"""The array's way over the floor: poses by each tag, between tags, and what to steer."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.geometry import heading_from_quaternion, quaternion_from_heading
from locatk.core.polaris.array import Samples
from locatk.core.polaris.identification.tags import Seen
from locatk.core.polaris.results import HeadingCorrection
from locatk.core.polaris.tag import Placed, Tags
from locatk.core.solution import SolverWarning
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

UNSURE_M = 0.01
"""No poses are given where the way is not known to this standard deviation."""

NEAR_M = 0.03
"""Poses are given up to so far before the first and after the last magnet."""

SCALE_SIGMA = 0.025
"""Share by which a height may be wrong besides its noise: it has the scale of the way, and
of every published run the way from the field alone is 2.5 % short; wheels are no better."""


def along(driven: Trajectory, time_ns: NDArray[np.int64]) -> Array:
    """How far (n,) a robot had driven by its odometry at each time, in m.

    Backwards counts as negative, by the heading of the odometry; before its first and after
    its last pose the robot is taken to stand.
    """
    step = np.diff(driven.position[:, :2], axis=0)
    heading = heading_from_quaternion(driven.quaternion)
    forward = np.column_stack([np.cos(heading), np.sin(heading)])
    ahead = (step * (forward[1:] + forward[:-1]) / 2).sum(axis=1)
    way = np.concatenate([[0.0], np.cumsum(ahead)])
    return np.asarray(np.interp(time_ns, driven.time_ns, way))


def tag_poses(
    recording: Samples, read: Sequence[Seen], tags: Tags | None
) -> tuple[list[Trajectory], list[SolverWarning]]:
    """Poses of the array while it was over tags that were read.

    In the frame of the site where tags have places on it, else in that of the first tag.

    Returns
    -------
    poses : list of Trajectory
        One or none.
    warnings : list of SolverWarning
        Tags whose place is not known.
    """
    if tags is None or not read:
        return [], []
    frame, site = "site", dict(tags.site)
    if not site:
        assert read[0].tag_id is not None
        frame, site = f"tag-{read[0].tag_id}", {read[0].tag_id: Placed(0.0, 0.0, 0.0)}
    parts, warnings = [], []
    for seen in read:
        assert seen.tag_id is not None
        placed = site.get(seen.tag_id)
        if placed is None:
            where = "on the site" if frame == "site" else f"in the frame of {frame}"
            message = f"tag {seen.tag_id} has no place {where}"
            warnings.append(SolverWarning("tag_not_on_site", message).about(recording.device))
        else:
            parts.append(_over(recording, seen, placed))
    if not parts:
        return [], warnings
    time, position, heading, covariance = (
        np.concatenate([part[k] for part in parts]) for k in range(4)
    )
    _, first = np.unique(time, return_index=True)  # the passes of two tags may overlap
    poses = Trajectory(
        recording.device,
        frame,
        time[first],
        position[first],
        quaternion_from_heading(heading[first]),
        covariance[first],
    )
    return [poses], warnings


def _over(
    recording: Samples, seen: Seen, placed: Placed
) -> tuple[NDArray[np.int64], Array, Array, Array]:
    """Times (n,), positions (n, 3), headings (n,) and covariances (n, 6, 6) over one tag."""
    sighting, match = seen.sighting, seen.match
    assert match is not None
    near = sighting.path_m >= sighting.place_m[:, 0].min() - NEAR_M
    near &= sighting.path_m <= sighting.place_m[:, 0].max() + NEAR_M
    near &= np.nan_to_num(sighting.path_sigma_m) < UNSURE_M
    way = sighting.path_m[near]
    heading = placed.heading_rad - match.heading_rad
    cos, sin = np.cos(heading), np.sin(heading)
    rotation = np.array([[cos, -sin], [sin, cos]])
    turned = np.array([[-sin, -cos], [cos, -sin]])
    course = np.array([1.0, np.tan(sighting.crab_rad)])
    offset = way[:, None] * course - [match.x_m, match.y_m]
    position = np.empty((len(way), 3))
    position[:, :2] = offset @ rotation.T + [placed.x_m, placed.y_m]
    position[:, 2] = sighting.height_m
    jacobian = np.zeros((len(way), 3, 4))  # of x, y, heading by the match's and the way
    jacobian[:, :2, :2] = -rotation
    jacobian[:, :2, 2] = -offset @ turned.T
    jacobian[:, :2, 3] = rotation @ course
    jacobian[:, 2, 2] = -1.0
    inner = np.zeros((len(way), 4, 4))
    inner[:, :3, :3] = match.covariance
    inner[:, 3, 3] = np.nan_to_num(sighting.path_sigma_m[near]) ** 2
    planar = jacobian @ inner @ jacobian.transpose(0, 2, 1)
    covariance = np.full((len(way), 6, 6), np.nan)
    plane = [0, 1, 5]
    covariance[np.ix_(range(len(way)), plane, plane)] = planar
    covariance[:, 2, :], covariance[:, :, 2] = 0.0, 0.0
    covariance[:, 2, 3:5] = covariance[:, 3:5, 2] = np.nan
    scale = SCALE_SIGMA * sighting.height_m
    covariance[:, 2, 2] = sighting.height_sigma_m**2 + scale**2
    time = recording.time_ns[sighting.first : sighting.stop][near]
    return time, position, np.full(len(way), heading), covariance


def joined(poses: list[Trajectory], driven: Trajectory) -> list[Trajectory]:
    """Poses with those between two tags filled in from odometry.

    Odometry carries on from the last pose over a tag; what it is off at the next tag is
    spread over the way between them.
    """
    return [_filled(trajectory, driven) for trajectory in poses]


def _filled(poses: Trajectory, driven: Trajectory) -> Trajectory:
    usual = np.median(np.diff(poses.time_ns)) if len(poses) > 1 else 0
    gaps = np.flatnonzero(np.diff(poses.time_ns) > 5 * usual)
    heading = heading_from_quaternion(poses.quaternion)
    own = np.unwrap(heading_from_quaternion(driven.quaternion))
    way = along(driven, driven.time_ns)
    times, places, turns, covariances = (
        [poses.time_ns],
        [poses.position],
        [heading],
        [poses.covariance],
    )
    for gap in gaps:
        ends = poses.time_ns[[gap, gap + 1]]
        if ends[0] < driven.time_ns[0] or ends[1] > driven.time_ns[-1]:
            continue
        inside = (driven.time_ns > ends[0]) & (driven.time_ns < ends[1])
        time = np.concatenate([[ends[0]], driven.time_ns[inside], [ends[1]]])
        x, y, turn, gone = (
            np.interp(time, driven.time_ns, column)
            for column in (driven.position[:, 0], driven.position[:, 1], own, way)
        )
        start = heading[gap] - turn[0]
        cos, sin = np.cos(start), np.sin(start)
        place = poses.position[gap, :2] + np.column_stack(
            [cos * (x - x[0]) - sin * (y - y[0]), sin * (x - x[0]) + cos * (y - y[0])]
        )
        turned = turn + start
        share = np.abs(gone - gone[0]) / max(abs(gone[-1] - gone[0]), 1e-9)
        share = np.clip(share, 0, 1)
        miss = poses.position[gap + 1, :2] - place[-1]
        twist = np.remainder(heading[gap + 1] - turned[-1] + np.pi, 2 * np.pi) - np.pi
        place, turned = place + share[:, None] * miss, turned + share * twist
        inner = slice(1, -1)
        position = np.column_stack(
            [place, poses.position[gap, 2] + share * np.diff(poses.position[gap : gap + 2, 2])]
        )[inner]
        # Known at both ends; in between, what odometry was off by may be anywhere.
        loose = (share * (1 - share))[inner]
        weight = share[inner, None, None]
        spread = (1 - weight) * poses.covariance[gap] + weight * poses.covariance[gap + 1]
        spread[:, 0, 0] += loose * (miss @ miss)
        spread[:, 1, 1] += loose * (miss @ miss)
        spread[:, 5, 5] += loose * twist**2
        times.append(time[inner])
        places.append(position)
        turns.append(turned[inner])
        covariances.append(spread)
    time = np.concatenate(times)
    order = np.argsort(time, kind="stable")
    return replace(
        poses,
        time_ns=time[order],
        position=np.concatenate(places)[order],
        quaternion=quaternion_from_heading(np.concatenate(turns)[order]),
        covariance=np.concatenate(covariances)[order],
    )


def corrections(
    recording: Samples, read: Sequence[Seen], tags: Tags | None
) -> list[HeadingCorrection]:
    """What to turn by at each tag so as to come straight to the next one (paper 8.3.7).

    One entry for each two tags in a row that have places on the site: by how much the
    robot must turn at the end of the first, counter-clockwise, and how far it is.
    """
    if tags is None:
        return []
    placed = [seen for seen in read if seen.tag_id in tags.site]
    found = []
    for here, there in itertools.pairwise(placed):
        assert here.tag_id is not None
        assert there.tag_id is not None
        if here.tag_id == there.tag_id:
            continue
        time, position, heading, covariance = _over(recording, here, tags.site[here.tag_id])
        goal = tags.site[there.tag_id]
        way = np.array([goal.x_m, goal.y_m]) - position[-1, :2]
        distance = float(np.hypot(*way))
        if distance == 0:
            continue
        turn = np.arctan2(way[1], way[0]) - heading[-1]
        # The bearing changes with the place, the heading by itself.
        change = np.array([way[1], -way[0], -(distance**2)]) / distance**2
        spread = covariance[-1][np.ix_([0, 1, 5], [0, 1, 5])]
        found.append(
            HeadingCorrection(
                device=recording.device,
                time_s=float(time[-1]) * 1e-9,
                from_tag=here.tag_id,
                to_tag=there.tag_id,
                rotation_rad=float(np.remainder(turn + np.pi, 2 * np.pi) - np.pi),
                sigma_rotation_rad=float(np.sqrt(change @ spread @ change)),
                distance_m=distance,
            )
        )
    return found
