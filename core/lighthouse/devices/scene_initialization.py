"""A scene solved from rigid devices alone: nothing else is measured, not even the scale.

Each station sees a device of known shape, so that one look gives the pose of the device
under that station. Two stations that look at one device at one time know where they stand to
each other; over many moments they agree on it, or are outvoted. All stations are then joined
and adjusted together with the devices' poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.lighthouse.calibration import GENERIC_CALIBRATION, MODEL_SIGMA_RAD, Calibration
from locatk.core.lighthouse.devices.bundle_adjustment import adjust_devices
from locatk.core.lighthouse.devices.device_sweeps import (
    DeviceSweeps,
    SweepWindows,
    gather_observations,
    make_windows,
)
from locatk.core.lighthouse.devices.pnp import LOSS_SCALE_RAD
from locatk.core.lighthouse.devices.pose_fit import (
    DeviceStates,
    Stations,
    SweepObservations,
    fit_poses,
)
from locatk.core.lighthouse.devices.station_links import (
    StationLink,
    StationViews,
    join,
    links_of,
    views_of,
)
from locatk.core.lighthouse.devices.tracking import REPEATS, rotation_ns
from locatk.core.lighthouse.noise import ANGLE_SIGMA_RAD
from locatk.core.lighthouse.receiver import Receiver
from locatk.core.lighthouse.scene import Scene, Station
from locatk.core.robust import robust_sigma

Array = NDArray[np.float64]

MOMENTS_LOOKED_AT = 200
"""Moments of a device that are located under each station, at most."""

MOMENTS_ADJUSTED = 160
MOMENTS_OF_A_PLACE = 4
"""A device that stands still repeats the same errors: of one place a few moments are enough,
and together they weigh as one."""

SAME_PLACE_M = 0.05
SAME_TURN = 0.15
"""DeviceStates (m, rad) nearer than this are one place."""

FEW_PLACES = 8
"""Places below which a scene calls for a word."""


@dataclass
class SolvedScene:
    """Stations with what is to be said about them."""

    scene: Scene
    facts: dict[str, object] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def solve_scene(
    devices: Sequence[tuple[DeviceSweeps, Receiver]],
    channels: Sequence[int],
    scene: Scene,
) -> SolvedScene:
    """Stations from what rigid devices saw of them.

    Parameters
    ----------
    devices : sequence of (DeviceSweeps, Receiver)
        Their ``station`` are columns of ``channels``.
    channels : sequence of int
    scene : Scene
        Without stations; its calibrations and serial numbers are used.

    Raises
    ------
    DegenerateError
        No station sees enough of a device to tell its pose.
    """
    calibrations = tuple(scene.calibrations.get(c, GENERIC_CALIBRATION) for c in channels)
    every_ns, reach_ns = rotation_ns(list(channels))
    looks, views, number = [], [], 0
    for mine, receiver in devices:
        around = make_windows(mine, every_ns, reach_ns)
        moments = _promising(mine, around)
        if not len(moments):
            continue
        found = views_of(mine, receiver, around, moments, calibrations)
        looks.append(gather_observations(mine, around, receiver, moments))
        views.append((found, number))
        number += len(moments)
    if not views or not any(len(v.moment) for v, _ in views):
        raise DegenerateError(
            "no station sees enough photodiodes of a device at a time to tell its pose",
            hint="three or more must see both planes of one station; is the receiver's file of "
            "this device?",
        )
    every = StationViews(
        np.concatenate([v.moment + n for v, n in views]),
        np.concatenate([v.station for v, _ in views]),
        np.concatenate([v.position for v, _ in views]),
        np.concatenate([v.rotation for v, _ in views]),
    )
    links = links_of(every, len(channels))
    joined, placed = join(links, every, len(channels))
    stations: Stations = (
        np.stack([placed[i][0] for i in joined]),
        np.stack([placed[i][1] for i in joined]),
        tuple(calibrations[i] for i in joined),
    )
    return _adjusted(_stacked(looks), every, stations, joined, channels, scene, links)


# ---- single stations


def _promising(mine: DeviceSweeps, around: SweepWindows) -> NDArray[np.int64]:
    """Moments spread over the recording, of each stretch that with the most looks."""
    if not len(around):
        return np.zeros(0, np.int64)
    held = around.sweep >= 0
    station = np.where(held, mine.station[around.sweep], -1)
    # Stations first, then sweeps: what joins stations is worth more.
    worth = np.count_nonzero(held, axis=1).astype(float)
    for i in np.unique(mine.station):
        worth += 1e4 * (np.count_nonzero(station == i, axis=1) >= 8)
    stretch = np.arange(len(around)) * MOMENTS_LOOKED_AT // max(len(around), MOMENTS_LOOKED_AT)
    order = np.lexsort((-worth, stretch))
    first = np.r_[True, np.diff(stretch[order]) > 0]
    return np.sort(order[first])


# ---- all together


def _stacked(parts: list[SweepObservations]) -> SweepObservations:
    """Moments of several devices, padded to one width."""
    wide = max(p.angle.shape[1] for p in parts)

    def widened(values: NDArray[np.generic]) -> NDArray[np.generic]:
        room = [(0, 0), (0, wide - values.shape[1])] + [(0, 0)] * (values.ndim - 2)
        return np.pad(values, room)

    return SweepObservations(
        *(
            np.concatenate([widened(getattr(p, name)) for p in parts])
            for name in ("place", "station", "plane", "angle", "since_s", "seen")
        )
    )


def _adjusted(
    looks: SweepObservations,
    views: StationViews,
    stations: Stations,
    joined: list[int],
    channels: Sequence[int],
    scene: Scene,
    links: list[StationLink],
) -> SolvedScene:
    """Stations adjusted together with the devices' poses, in the first station's axes."""
    columns = np.full(len(channels), -1)
    columns[joined] = np.arange(len(joined))
    looks = SweepObservations(
        looks.place, columns[looks.station], looks.plane, looks.angle, looks.since_s,
        looks.seen & (columns[looks.station] >= 0),
    )  # fmt: skip
    moments, poses, turned = _first_poses(looks, views, stations, columns)
    looks = looks.take(moments)
    place = _places(poses)
    chosen = _spread_out(place, turned)
    looks, poses, place = looks.take(chosen), poses.take(chosen), place[chosen]
    size = np.bincount(place)
    share = np.asarray(1.0 / (REPEATS * size[place]), np.float64)

    guessed = np.array([c.source == "generic" for c in stations[2]])
    sigma = MODEL_SIGMA_RAD if np.any(guessed) else 2 * ANGLE_SIGMA_RAD
    done = adjust_devices(
        looks, stations, poses, sigma=sigma, soft=LOSS_SCALE_RAD, share=share, calibrate=guessed
    )
    # Again with the noise that the recording shows.
    sigma = max(ANGLE_SIGMA_RAD, robust_sigma(done.residual))
    done = adjust_devices(
        looks,
        done.stations,
        done.poses,
        sigma=sigma,
        soft=min(3 * sigma, LOSS_SCALE_RAD),
        share=share,
        calibrate=guessed,
    )
    answer = SolvedScene(scene)
    answer.facts = {
        "moments_adjusted": len(looks),
        "places_adjusted": len(size),
        "scene_angle_sigma_rad": sigma,
        "iterations": done.iterations,
        "links": [
            {"channels": [int(channels[k.first]), int(channels[k.second])], "moments": k.agreed}
            for k in links
        ],
    }
    answer.notes = _remarks(joined, channels, done.stations[2], len(size))
    rivals = [f"{channels[k.first]} and {channels[k.second]}" for k in links if k.rivalled]
    if rivals:
        answer.notes.append(
            f"how the stations on channels {', '.join(rivals)} stand to each other has two "
            "answers of which neither is better: carry the device around, and turn it"
        )
    solved = tuple(
        Station(
            int(channels[i]),
            done.stations[0][k],
            done.stations[1][k],
            done.stations[2][k],
            scene.ids.get(int(channels[i])),
            done.covariance[k],
        )
        for k, i in enumerate(joined)
    )
    answer.scene = Scene(
        solved,
        scene.markers,
        scene.distances,
        False,
        0.0,
        "device",
        f"station-{channels[joined[0]]}",
        tuple(answer.notes),
        scene.calibrations,
        scene.ids,
    )
    return answer


def _first_poses(
    looks: SweepObservations, views: StationViews, stations: Stations, columns: NDArray[np.int64]
) -> tuple[NDArray[np.int64], DeviceStates, NDArray[np.int64]]:
    """Moments with a pose that all their stations accept; the poses; stations of each."""
    known = np.flatnonzero(columns[views.station] >= 0)
    column = columns[views.station[known]]
    turn = stations[1][column]
    start = DeviceStates.at_rest(
        stations[0][column] + (turn @ views.position[known][..., None])[..., 0],
        turn @ views.rotation[known],
    )
    whose = views.moment[known]
    rough = fit_poses(
        looks.take(whose),
        stations,
        start,
        sigma=MODEL_SIGMA_RAD,
        soft=10 * LOSS_SCALE_RAD,
        iterations=0,
    )
    order = np.lexsort((rough.cost, whose))
    first = order[np.r_[True, np.diff(whose[order]) > 0]]
    seen = looks.take(whose[first])
    found = fit_poses(
        seen, stations, start.take(first), sigma=MODEL_SIGMA_RAD, soft=10 * LOSS_SCALE_RAD
    )
    number = np.zeros(len(first), np.int64)
    for i in range(len(stations[2])):
        number += np.any(seen.seen & (seen.station == i), axis=1)
    return whose[first], found.poses, number


def _places(poses: DeviceStates) -> NDArray[np.int64]:
    """(m,) number of the place and orientation at which a device was; greedy, in order."""
    at: list[int] = []
    place = np.empty(len(poses), np.int64)
    for i in range(len(poses)):
        near = np.linalg.norm(poses.position[at] - poses.position[i], axis=1) < SAME_PLACE_M
        overlap = np.einsum("kij,ij->k", poses.rotation[at], poses.rotation[i])
        same = np.flatnonzero(near & (overlap > 1 + 2 * np.cos(SAME_TURN)))
        if not len(same):
            at.append(i)
        place[i] = same[0] if len(same) else len(at) - 1
    return place


def _spread_out(place: NDArray[np.int64], stations: NDArray[np.int64]) -> NDArray[np.int64]:
    """A few moments of each place, those with the most stations; of too many places those
    spread over all."""
    order = np.lexsort((-stations, place))
    rank = np.arange(len(order)) - np.searchsorted(place[order], place[order])
    order = order[rank < MOMENTS_OF_A_PLACE]
    if len(order) > MOMENTS_ADJUSTED:
        order = order[np.linspace(0, len(order) - 1, MOMENTS_ADJUSTED).astype(int)]
    return np.sort(order)


def _remarks(
    joined: list[int], channels: Sequence[int], calibrations: tuple[Calibration, ...], places: int
) -> list[str]:
    notes = []
    left = [str(c) for i, c in enumerate(channels) if i not in joined]
    if left:
        notes.append(
            f"station on channel {', '.join(left)} never saw a device together with the others "
            "and is left out"
        )
    guessed = [
        str(channels[i])
        for i, c in zip(joined, calibrations, strict=True)
        if c.source in ("generic", "estimated")
    ]
    if guessed:
        notes.append(
            f"no factory calibration is known of channel {', '.join(guessed)}: the mean of "
            "other units is used (generic), refined where the data tell"
        )
    if places < FEW_PLACES and len(joined) > 1:
        notes.append(
            f"the devices were at {places} place{'' if places == 1 else 's'} only: carry one "
            "around, and turn it, so that the stations do not stand on the errors of a few looks"
        )
    return notes
