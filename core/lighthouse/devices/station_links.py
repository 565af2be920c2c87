"""Rigid devices under single stations, and how pairs of stations stand to each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.calibration import Calibration
from locatk.core.lighthouse.devices.device_sweeps import (
    DeviceSweeps,
    SweepWindows,
    gather_observations,
)
from locatk.core.lighthouse.devices.pnp import LOSS_SCALE_RAD, candidates
from locatk.core.lighthouse.devices.pose_fit import (
    DeviceStates,
    Stations,
    SweepObservations,
    fit_poses,
)
from locatk.core.lighthouse.devices.propagation import has_enough_sweeps, is_accepted, mean_angles
from locatk.core.lighthouse.noise import ANGLE_SIGMA_RAD
from locatk.core.lighthouse.receiver import Receiver

Array = NDArray[np.float64]

SAME_TURN = 0.15
"""Readings (rad) nearer than this are one."""

NEAR_TURN = 0.15
NEAR_SHIFT = 0.15
"""Turn (rad) and shift (parts of the distance) by which two looks may differ on how two
stations stand to each other: a deck of 30 mm at two metres errs by a few degrees."""

RIVAL = 0.8
"""Share of the agreeing moments from which on another answer is as good."""

READINGS_KEPT = 2
"""A flat device has two readings under one station."""

AMBIGUOUS = 50.0
"""Half sum of squares, in sigmas, by which a second reading may be worse and still be tried."""


@dataclass
class StationViews:
    """DeviceStates of devices under single stations: one row a reading.

    Attributes
    ----------
    moment : (v,) int ndarray
        Number of the moment, over all devices.
    station : (v,) int ndarray
    position : (v, 3) ndarray
        Of the device in the station's axes.
    rotation : (v, 3, 3) ndarray
    """

    moment: NDArray[np.int64]
    station: NDArray[np.int64]
    position: Array
    rotation: Array


def views_of(
    mine: DeviceSweeps,
    receiver: Receiver,
    around: SweepWindows,
    moments: NDArray[np.int64],
    calibrations: tuple[Calibration, ...],
) -> StationViews:
    """The device's poses under each station alone."""
    parts = []
    for i, calibration in enumerate(calibrations):
        sweep = around.sweep[moments]
        of_it = np.where((sweep >= 0) & (mine.station[sweep] == i), sweep, -1)
        # Pads to the end, as windows have them.
        of_it = np.take_along_axis(of_it, np.argsort(of_it < 0, axis=1, kind="stable"), axis=1)
        whose, shifts, turns = [], [], []
        for k in np.flatnonzero(has_enough_sweeps(mine, of_it)):
            row = of_it[k]
            angles = mean_angles(mine.take(row[row >= 0]), len(receiver))
            for shift, turn in candidates(angles, receiver, calibration, triples=False):
                whose.append(k)
                shifts.append(shift)
                turns.append(turn)
        if not whose:
            continue
        owner = np.array(whose)
        looks = gather_observations(
            mine, SweepWindows(around.time_ns[moments], of_it), receiver, np.arange(len(moments))
        ).take(owner)
        alone: Stations = (np.zeros((1, 3)), np.eye(3)[None], (calibration,))
        looks = SweepObservations(
            looks.place, np.zeros_like(looks.station), looks.plane, looks.angle,
            looks.since_s, looks.seen,
        )  # fmt: skip
        start = DeviceStates.at_rest(np.stack(shifts), np.stack(turns))
        found = fit_poses(
            looks, alone, start, sigma=ANGLE_SIGMA_RAD, soft=LOSS_SCALE_RAD, iterations=15
        )
        good = is_accepted(looks, found.residual) & (found.poses.position[:, 0] > 0)
        kept = _best_readings(owner, found.cost, found.poses.rotation, good)
        parts.append((owner[kept], np.full(len(kept), i), found.poses.take(kept)))
    if not parts:
        empty = np.zeros(0, np.int64)
        return StationViews(empty, empty, np.zeros((0, 3)), np.zeros((0, 3, 3)))
    return StationViews(
        np.concatenate([p[0] for p in parts]),
        np.concatenate([p[1] for p in parts]),
        np.concatenate([p[2].position for p in parts]),
        np.concatenate([p[2].rotation for p in parts]),
    )


def _best_readings(
    owner: NDArray[np.int64], cost: Array, rotation: Array, good: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """Rows of the distinct readings of each moment that are not much worse than its best."""
    kept: list[int] = []
    mine: list[int] = []
    for row in np.lexsort((cost, owner)):
        if not good[row]:
            continue
        if mine and owner[mine[0]] != owner[row]:
            mine = []
        if len(mine) >= READINGS_KEPT or (mine and cost[row] > cost[mine[0]] + AMBIGUOUS):
            continue
        near = (np.trace(rotation[row].T @ rotation[k]) > 1 + 2 * np.cos(SAME_TURN) for k in mine)
        if any(near):
            continue
        mine.append(int(row))
        kept.append(int(row))
    return np.array(kept, np.int64)


@dataclass(frozen=True)
class StationLink:
    """How a second station stands in the axes of a first, and how many moments agree.

    ``rivalled`` where quite another answer has about as many: a flat device that only stood
    has two readings under each station, and nothing tells which are right.
    """

    first: int
    second: int
    position: Array
    rotation: Array
    agreed: int
    rivalled: bool = False


def links_of(views: StationViews, number: int) -> list[StationLink]:
    """Pairs of stations that saw a device at the same moments."""
    found = []
    for i in range(number):
        for j in range(i + 1, number):
            link = _link(views, i, j)
            if link is not None:
                found.append(link)
    return found


def _link(views: StationViews, i: int, j: int) -> StationLink | None:
    first, second = np.flatnonzero(views.station == i), np.flatnonzero(views.station == j)
    a, b = np.nonzero(views.moment[first][:, None] == views.moment[second][None])
    if not len(a):
        return None
    a, b = first[a], second[b]
    # Second to first: device to first, after second to device.
    rotation = views.rotation[a] @ np.swapaxes(views.rotation[b], -1, -2)
    position = views.position[a] - (rotation @ views.position[b][..., None])[..., 0]
    away = np.linalg.norm(views.position[a], axis=1) + np.linalg.norm(views.position[b], axis=1)

    def misfit(rows: NDArray[np.int64], shift: Array, turn: Array) -> Array:
        """(h, p) squared, 1 at the limit, of proposals (h) at pairs ``rows``."""
        overlap = np.einsum("hij,pij->hp", turn, rotation[rows])
        angle = np.arccos(np.clip((overlap - 1) / 2, -1, 1))
        apart = np.linalg.norm(shift[:, None] - position[rows], axis=2)
        return (angle / NEAR_TURN) ** 2 + (apart / (NEAR_SHIFT * away[rows])) ** 2

    proposals = np.unique(np.linspace(0, len(a) - 1, min(len(a), 200)).astype(int))
    everything = np.arange(len(a))
    cost = np.minimum(misfit(everything, position[proposals], rotation[proposals]), 1.0)
    # Of the readings of one moment at most one is right.
    moments, moment = np.unique(views.moment[a], return_inverse=True)
    least = np.ones((len(proposals), len(moments)))
    np.minimum.at(least.T, moment, cost.T)
    best = int(proposals[np.argmin(least.sum(axis=1))])
    shift, turn = position[best], rotation[best]
    near = everything
    for _ in range(5):
        near = np.flatnonzero(misfit(everything, shift[None], turn[None])[0] < 1.0)
        if not len(near):
            return None
        shift = np.median(position[near], axis=0)
        u, _, vt = np.linalg.svd(np.sum(rotation[near], axis=0))
        turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    agreed = len(np.unique(moment[near]))
    other = misfit(proposals, shift[None], turn[None])[0] >= 1.0
    votes = np.count_nonzero(least[other] < 1.0, axis=1)
    return StationLink(i, j, shift, turn, agreed, bool(np.any(votes >= RIVAL * agreed)))


def join(
    links: list[StationLink], views: StationViews, number: int
) -> tuple[list[int], dict[int, tuple[Array, Array]]]:
    """Stations that hang together, ascending, with poses in the axes of the first of them."""
    best: dict[int, tuple[Array, Array]] = {}
    for root in range(number):
        if root in best or not np.any(views.station == root):
            continue
        placed = {root: (np.zeros(3), np.eye(3))}
        # Prim's tree of the links with the most moments.
        while True:
            open_ = [k for k in links if (k.first in placed) != (k.second in placed)]
            if not open_:
                break
            link = max(open_, key=lambda k: k.agreed)
            if link.first in placed:
                shift, turn = placed[link.first]
                placed[link.second] = (shift + turn @ link.position, turn @ link.rotation)
            else:
                shift, turn = placed[link.second]
                turned = turn @ link.rotation.T
                placed[link.first] = (shift - turned @ link.position, turned)
        if len(placed) > len(best):
            best = placed
    return sorted(best), best
