"""Where a rigid device was at each moment: located without a guess, and carried on.

A few moments are located without a guess (anchors); from them the others follow in waves,
each moment from its neighbour's pose and rates, all fronts of the waves in one batch. Where
two waves meet and disagree (a flat device has two readings under one station), that of the
less certain anchor is taken back.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.devices.device_sweeps import (
    DeviceSweeps,
    SweepWindows,
    gather_observations,
)
from locatk.core.lighthouse.devices.pnp import LOSS_SCALE_RAD, candidates, lit_from_behind
from locatk.core.lighthouse.devices.pose_fit import (
    DeviceStates,
    Stations,
    SweepObservations,
    fit_poses,
    photodiode_positions,
)
from locatk.core.lighthouse.noise import ANGLE_SIGMA_RAD, INLIER_GATE_RAD, MIN_INLIER_GATE_RAD
from locatk.core.lighthouse.receiver import Receiver

Array = NDArray[np.float64]

FEWEST_SWEEPS = 8
"""Sweeps of a moment: two more than a pose needs, so that something checks it."""

FEWEST_SENSORS = 3

ANCHORS_APART = 50
"""Moments from one anchor to the next, about a second."""

CARRY_S = 0.25
"""Over a longer pause a pose is not carried on: a turning device may be anywhere."""

BLOCK = 256
"""Moments fitted at a time: what fits the processor's cache."""

DISAGREE = 0.35
"""Turn in radians between two neighbours, beyond their rates, that no motion explains."""

LOST = 2 * INLIER_GATE_RAD
"""An angle that misses by more (rad) says nothing of where a device is: 40 mm at two metres."""

READINGS_TRIED = 4
"""Candidates of an anchor that are refined."""

MOST_RESTARTS = 200
"""Moments that are located without a guess a second time, at most: each takes milliseconds."""

MOST = 0.6
"""Share of a moment's sweeps that its pose must meet."""

OPEN, SOLVED, FAILED = 0, 1, 2


@dataclass
class DeviceTrack:
    """One device under way.

    ``reach_ns`` is how far its moments reach before and after them,
    ``status`` is OPEN, SOLVED or FAILED by moment, ``source`` the anchor from which it was
    reached, ``margin`` by anchor how much better its reading was than the next.
    """

    mine: DeviceSweeps
    receiver: Receiver
    stations: Stations
    around: SweepWindows
    reach_ns: int
    poses: DeviceStates
    status: NDArray[np.int64]
    source: NDArray[np.int64]
    margin: list[float] = field(default_factory=list)
    rejected: dict[str, int] = field(default_factory=dict)

    def reject(self, reason: str, number: int | np.signedinteger) -> None:
        if number:
            self.rejected[reason] = self.rejected.get(reason, 0) + int(number)

    def looks(self, moments: NDArray[np.int64]) -> SweepObservations:
        return gather_observations(self.mine, self.around, self.receiver, moments)


def locate_all(track: DeviceTrack) -> None:
    """Give a pose to every open moment that has one."""
    able = np.flatnonzero(track.status == OPEN)
    _drop_anchors(track, able[::ANCHORS_APART], triples=False)
    _carry_on(track)
    # What the waves did not reach, or broke on, gets a second chance from the start.
    lost = able[track.status[able] != SOLVED]
    fresh = np.r_[True, np.diff(lost) > 1][: len(lost)] | (np.arange(len(lost)) % 25 == 0)
    _drop_anchors(track, lost[fresh][:MOST_RESTARTS], triples=True)
    track.status[track.status == FAILED] = np.where(
        np.isin(np.flatnonzero(track.status == FAILED), lost), OPEN, FAILED
    )
    _carry_on(track)
    settled: set[int] = set()
    while (anchor := _less_certain(track, settled)) is not None:
        settled.add(anchor)
        mine = np.flatnonzero(track.source == anchor)
        before = track.poses.take(mine)
        track.status[mine] = OPEN
        _carry_on(track)
        # What the other wave cannot explain stays as it was.
        back = track.status[mine] != SOLVED
        track.status[mine[back]] = SOLVED
        track.source[mine[back]] = anchor
        track.poses.put(mine[back], before.take(back))


def has_enough_sweeps(mine: DeviceSweeps, sweep: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether moments with these sweeps (m, n) can have a pose."""
    sensor = np.sort(np.where(sweep >= 0, mine.sensor[sweep] if len(mine) else 0, -1), axis=1)
    different = np.count_nonzero(np.diff(sensor, axis=1, prepend=-1), axis=1)
    number = np.count_nonzero(sweep >= 0, axis=1)
    return np.asarray((number >= FEWEST_SWEEPS) & (different >= FEWEST_SENSORS))


# ---- anchors


def _drop_anchors(track: DeviceTrack, moments: NDArray[np.int64], *, triples: bool) -> None:
    """Locate moments without a guess."""
    for k in range(0, len(moments), 32):
        _locate_block(track, moments[k : k + 32], triples)


def _locate_block(track: DeviceTrack, moments: NDArray[np.int64], triples: bool) -> None:
    owner, origins, shifts, turns = [], [], [], []
    for i, moment in enumerate(moments):
        for origin, shift, turn in scene_candidates(track, int(moment), triples):
            owner.append(i)
            origins.append(origin)
            shifts.append(shift)
            turns.append(turn)
    if not owner:
        return
    start = DeviceStates.at_rest(np.stack(shifts), np.stack(turns))
    whose = np.array(owner)
    looks = track.looks(moments)
    # First under the station it comes from, with its motion; then all stations say which few
    # are worth more.
    alone = looks.take(whose)
    alone = replace(alone, seen=alone.seen & (alone.station == np.array(origins)[:, None]))
    start = fit_poses(
        alone, track.stations, start, sigma=ANGLE_SIGMA_RAD, soft=LOSS_SCALE_RAD, settled=0.03
    ).poses
    rough = fit_poses(
        looks.take(whose),
        track.stations,
        start,
        sigma=ANGLE_SIGMA_RAD,
        soft=LOSS_SCALE_RAD,
        iterations=0,
    )
    order = np.lexsort((_score(rough.residual, looks.seen[whose], INLIER_GATE_RAD), whose))
    rank = np.arange(len(order)) - np.searchsorted(whose[order], whose[order])
    chosen = order[rank < READINGS_TRIED]
    whose = whose[chosen]
    found = fit_poses(
        looks.take(whose),
        track.stations,
        start.take(chosen),
        sigma=ANGLE_SIGMA_RAD,
        soft=LOSS_SCALE_RAD,
    )
    good = is_accepted(looks.take(whose), found.residual)
    cost = _score(found.residual, looks.seen[whose], MIN_INLIER_GATE_RAD)
    cost += 1e6 * (from_behind(track, moments[whose], found.poses) > 0.3)
    for i in np.unique(whose[good]):
        rows = np.flatnonzero(good & (whose == i))
        rows = rows[np.argsort(cost[rows])]
        best = found.poses.rotation[rows[0]]
        turned = np.einsum("mij,ij->m", found.poses.rotation[rows], best)
        others = cost[rows][turned < 1 + 2 * np.cos(DISAGREE)]
        margin = float(np.min(others - cost[rows[0]], initial=1e6))
        at = moments[i : i + 1]
        track.poses.put(at, found.poses.take(rows[:1]))
        track.status[at], track.source[at] = SOLVED, len(track.margin)
        track.margin.append(margin)


def _score(residual: Array, seen: NDArray[np.bool_], gate: float) -> Array:
    """(m,) half sums of squares, in sigmas, cut off at ``gate``.

    Where a station was moved, a pose that meets the others exactly is better than one that
    misses all a little; a loss that grows without bound would not say so.
    """
    ratio = np.minimum(np.nan_to_num(np.abs(residual), nan=gate) / gate, 1.0)
    return np.asarray(0.5 * (gate / ANGLE_SIGMA_RAD) ** 2 * np.sum(ratio**2, axis=1, where=seen))


def scene_candidates(
    track: DeviceTrack, moment: int, triples: bool
) -> list[tuple[int, Array, Array]]:
    """Rough poses of the device in the scene, each with the station that it comes from."""
    sweep = track.around.sweep[moment]
    sweep = sweep[sweep >= 0]
    mine = track.mine.take(sweep)
    positions, rotations, calibrations = track.stations
    found = []
    for i in np.unique(mine.station):
        angles = mean_angles(mine.take(mine.station == i), len(track.receiver))
        for shift, turn in candidates(angles, track.receiver, calibrations[i], triples=triples):
            found.append((int(i), positions[i] + rotations[i] @ shift, rotations[i] @ turn))
    return found


def mean_angles(mine: DeviceSweeps, sensors: int) -> Array:
    """(sensors, 2) mean angle of each photodiode and plane; ``nan`` where not seen."""
    total, number = np.zeros((sensors, 2)), np.zeros((sensors, 2))
    np.add.at(total, (mine.sensor, mine.plane), mine.angle)
    np.add.at(number, (mine.sensor, mine.plane), 1)
    with np.errstate(invalid="ignore"):
        return np.asarray(total / number)


def from_behind(track: DeviceTrack, moments: NDArray[np.int64], poses: DeviceStates) -> Array:
    """(m,) share of sweeps that would have come from behind their photodiodes."""
    if track.receiver.normal is None:
        return np.zeros(len(moments))
    looks = track.looks(moments)
    _, place = photodiode_positions(looks, poses)
    sensor = track.mine.sensor[track.around.sweep[moments][:, : looks.angle.shape[1]]]
    normal = track.receiver.normal[sensor] @ np.swapaxes(poses.rotation, -1, -2)
    behind = lit_from_behind(place - track.stations[0][looks.station], normal)
    return np.asarray(np.sum(behind & looks.seen, axis=1) / np.sum(looks.seen, axis=1))


# ---- waves


def _carry_on(track: DeviceTrack) -> None:
    """Solve open moments from solved neighbours until no wave goes on."""
    ready = np.flatnonzero(track.status != FAILED)
    time = track.around.time_ns
    while True:
        # Failed moments are stepped over.
        ready = ready[track.status[ready] != FAILED]
        solved = track.status[ready] == SOLVED
        near = np.diff(time[ready]) < CARRY_S * 1e9
        right = np.flatnonzero(solved[:-1] & ~solved[1:] & near) + 1
        left = np.flatnonzero(~solved[:-1] & solved[1:] & near)
        left = np.setdiff1d(left, right)
        moments = ready[np.r_[right, left]]
        sources = ready[np.r_[right - 1, left + 1]]
        if not len(moments):
            return
        since = np.asarray((time[moments] - time[sources]) * 1e-9)
        good = _solve(track, moments, track.poses.take(sources).later(since))
        track.status[moments] = np.where(good, SOLVED, FAILED)
        track.source[moments[good]] = track.source[sources[good]]


def _solve(
    track: DeviceTrack, moments: NDArray[np.int64], start: DeviceStates
) -> NDArray[np.bool_]:
    """Fit moments from starting values, and say which are explained."""
    good = np.zeros(len(moments), bool)
    for k in range(0, len(moments), BLOCK):
        rows = np.arange(k, min(k + BLOCK, len(moments)))
        looks = track.looks(moments[rows])
        found = fit_poses(
            looks,
            track.stations,
            start.take(rows),
            sigma=ANGLE_SIGMA_RAD,
            soft=LOSS_SCALE_RAD,
            settled=0.03,
            lost=LOST,
        )
        good[rows] = is_accepted(looks, found.residual)
        fine = good[rows]
        track.poses.put(moments[rows[fine]], found.poses.take(fine))
    return good


def is_accepted(looks: SweepObservations, residual: Array) -> NDArray[np.bool_]:
    """Moments of which most sweeps are met."""
    with np.errstate(invalid="ignore"):
        met = np.count_nonzero(np.abs(residual) < INLIER_GATE_RAD, axis=1)
    return np.asarray((met >= FEWEST_SWEEPS) & (met >= MOST * np.count_nonzero(looks.seen, axis=1)))


def _less_certain(track: DeviceTrack, settled: set[int]) -> int | None:
    """The less certain of two anchors whose waves disagree; None where all agree."""
    solved = np.flatnonzero(track.status == SOLVED)
    first, second = solved[:-1], solved[1:]
    since = np.asarray((track.around.time_ns[second] - track.around.time_ns[first]) * 1e-9)
    ahead = track.poses.take(first).later(since).rotation
    overlap = np.einsum("mij,mij->m", ahead, track.poses.rotation[second])
    jump = (overlap < 1 + 2 * np.cos(DISAGREE)) & (since < CARRY_S)
    jump &= track.source[first] != track.source[second]
    if not np.any(jump):
        return None
    margin = np.array(track.margin)
    one, other = track.source[first[jump]], track.source[second[jump]]
    weaker = np.where(margin[one] < margin[other], one, other)
    weaker = weaker[~np.isin(weaker, list(settled))]
    return int(weaker[np.argmin(margin[weaker])]) if len(weaker) else None
