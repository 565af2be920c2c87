"""Guards of the scene estimation from rigid devices and of the device solver, by function."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.geometry import rotation_exp
from locatk.core.lighthouse.devices.alignment import align_to_markers
from locatk.core.lighthouse.devices.device_sweeps import DeviceSweeps, SweepWindows
from locatk.core.lighthouse.devices.pose_fit import DeviceStates
from locatk.core.lighthouse.devices.scene_initialization import (
    MAX_ADJUSTED_EPOCHS,
    MAX_EPOCHS_PER_POSITION,
    StationLink,
    StationPoses,
    cluster_poses,
    connect_stations,
    epoch_weights,
    estimate_link,
    estimate_links,
    select_epochs,
    select_hypotheses,
    select_keyframes,
)
from locatk.core.lighthouse.devices.solver import (
    contradiction_warnings,
    device_warnings,
    merge_solutions,
)
from locatk.core.lighthouse.devices.tracking import TrackedDevice
from locatk.core.lighthouse.results import LighthouseFacts, StationDetection
from locatk.core.lighthouse.scene import Marker, MarkerVisit
from locatk.core.lighthouse.scene.frame import unused_visits_warnings
from locatk.core.solution import Solution, SolverWarning
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

LINK_POSITION = np.array([3.0, -1.0, 0.2])
LINK_ROTATION = rotation_exp([0.2, -0.1, 2.5])
RIVAL_POSITION = np.array([1.0, 2.0, 0.0])
RIVAL_ROTATION = rotation_exp([0.0, 1.0, 1.0])


# ---- poses under single stations


def test_distinct_hypotheses_close_to_the_best_are_kept() -> None:
    flip, near = rotation_exp([0.0, 0.5, 0.0]), rotation_exp([0.0, 0.1, 0.0])
    rotation = np.stack([np.eye(3), near, flip, np.eye(3), flip, np.eye(3), flip, flip @ flip])
    owner = np.array([0, 0, 0, 1, 1, 2, 2, 2])
    cost = np.array([5.0, 6.0, 54.0, 5.0, 56.0, 7.0, 8.0, 9.0])
    accepted = np.ones(8, bool)
    # A near copy, a hypothesis that is worse by more than 50, and a third one are left out.
    assert select_hypotheses(owner, cost, rotation, accepted).tolist() == [0, 2, 3, 5, 6]
    accepted[[0, 3]] = False
    assert select_hypotheses(owner, cost, rotation, accepted).tolist() == [1, 2, 4, 5, 6]


def test_epochs_with_more_stations_are_selected() -> None:
    # Windows of 10 sweeps; in every fifth one, the sweeps are of two stations.
    count = 1000
    window_station = np.zeros((count, 16), np.int64)
    window_station[::5, 8:] = 1
    sweep = np.arange(count * 16).reshape(count, 16)
    sweep[1::5, 12:] = -1
    zero = np.zeros(count * 16, np.int64)
    sweeps = DeviceSweeps(np.arange(count * 16), zero, window_station.ravel(), zero, zero * 0.0)
    windows = SweepWindows(np.arange(count) * 10**7, sweep)
    assert select_epochs(sweeps, windows).tolist() == list(range(0, count, 5))


# ---- relative poses of stations


def common_poses(
    epochs: int, rival_epochs: int, *, noise: float = 0.0, outliers: int = 0
) -> StationPoses:
    """Return poses under two stations; of some epochs with a second one under the other."""
    rng = np.random.default_rng(0)
    rows = []
    for epoch in range(epochs):
        rotation = rotation_exp(rng.normal(0, 1, 3))
        position = np.array([2.0, *rng.normal(0, 0.3, 2)])
        rows.append((epoch, 0, position, rotation))
        links = [(LINK_POSITION, LINK_ROTATION)]
        if epoch < rival_epochs:
            links.append((RIVAL_POSITION, RIVAL_ROTATION))
        if epoch >= epochs - outliers:
            links = [(rng.normal(0, 3, 3), rotation_exp(rng.normal(0, 1, 3)))]
        for link_position, link_rotation in links:
            local = link_rotation.T @ (position + rng.normal(0, noise, 3) - link_position)
            rows.append((epoch, 1, local, link_rotation.T @ rotation))
    epoch, station, position, rotation = zip(*rows, strict=True)
    return StationPoses(np.array(epoch), np.array(station), np.stack(position), np.stack(rotation))


def test_the_link_is_that_of_most_epochs() -> None:
    link = estimate_link(common_poses(20, 0, noise=0.01, outliers=8), 0, 1)
    assert link is not None
    assert link.position == pytest.approx(LINK_POSITION, abs=0.02)
    assert link.rotation == pytest.approx(LINK_ROTATION, abs=1e-9)
    assert link.epochs == 12
    assert not link.is_ambiguous


@pytest.mark.parametrize(("rival_epochs", "is_ambiguous"), [(7, False), (8, True), (10, True)])
def test_a_link_with_a_rival_is_ambiguous(rival_epochs: int, is_ambiguous: bool) -> None:
    link = estimate_link(common_poses(10, rival_epochs), 0, 1)
    assert link is not None
    assert link.epochs == 10
    assert link.is_ambiguous == is_ambiguous


@pytest.mark.parametrize(("angle", "agree"), [(0.13, 2), (0.17, 1)])
def test_epochs_agree_up_to_a_rotation(angle: float, agree: int) -> None:
    poses = common_poses(2, 0)
    rotation = poses.rotation.copy()
    position = poses.position.copy()
    row = int(np.flatnonzero((poses.station == 1) & (poses.epoch == 1))[0])
    # Rotate the second station about the device: its relative position changes little.
    position[row] *= 1e-6
    position[np.flatnonzero((poses.station == 0) & (poses.epoch == 1))[0]] = LINK_POSITION
    rotation[row] = rotation_exp([0.0, 0.0, angle]) @ rotation[row]
    link = estimate_link(replace(poses, rotation=rotation, position=position), 0, 1)
    assert link is not None
    assert link.epochs == agree


def test_stations_without_a_common_epoch_have_no_link() -> None:
    poses = common_poses(5, 0)
    apart = replace(poses, epoch=poses.epoch + 100 * poses.station)
    assert estimate_link(apart, 0, 1) is None
    assert [(k.first, k.second) for k in estimate_links(poses, 3)] == [(0, 1)]


def link_of(first: int, second: int, epochs: int, shift: float = 1.0) -> StationLink:
    return StationLink(first, second, np.array([shift, 0.0, 0.0]), np.eye(3), epochs)


def poses_of(stations: list[int]) -> StationPoses:
    n = len(stations)
    return StationPoses(
        np.arange(n), np.array(stations), np.zeros((n, 3)), np.tile(np.eye(3), (n, 1, 1))
    )


def test_the_spanning_tree_prefers_links_with_more_epochs() -> None:
    links = [link_of(0, 2, 3, shift=9.0), link_of(0, 1, 5), link_of(1, 2, 4)]
    connected = connect_stations(links, poses_of([0, 1, 2]), 3)
    assert {k: p[0] for k, (p, _) in connected.items()} == {0: 0.0, 1: 1.0, 2: 2.0}


def test_the_largest_set_of_connected_stations_is_returned() -> None:
    links = [link_of(0, 1, 50), link_of(3, 4, 5), link_of(2, 4, 5)]
    connected = connect_stations(links, poses_of([0, 1, 2, 3, 4]), 5)
    assert {k: p[0] for k, (p, _) in connected.items()} == {2: 0.0, 3: 0.0, 4: 1.0}
    # The inverse of a link is used if its second station is connected first.
    assert list(connected) == [2, 3, 4]


def test_a_station_without_poses_is_no_root() -> None:
    assert list(connect_stations([], poses_of([1]), 2)) == [1]


# ---- keyframes


def test_poses_close_in_position_and_orientation_are_one() -> None:
    position = np.array([[0.0, 0, 0], [0.04, 0, 0], [0.06, 0, 0], [0, 0, 0], [0, 0, 0]])
    vectors = np.array([[0.0, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 0.14], [0, 0, 0.16]])
    states = DeviceStates.at_rest(position, rotation_exp(vectors))
    assert cluster_poses(states).tolist() == [0, 0, 1, 0, 2]


def test_a_few_epochs_of_each_position_with_the_most_stations_are_selected() -> None:
    position = np.array([0] * 10 + [1] * 2)
    stations = np.array([1, 1, 3, 1, 2, 3, 2, 1, 3, 1, 1, 1])
    assert select_keyframes(position, stations).tolist() == [2, 4, 5, 8, 10, 11]
    many = select_keyframes(np.arange(1000), np.ones(1000, int))
    assert len(many) == MAX_ADJUSTED_EPOCHS
    assert many[0] == 0
    assert many[-1] == 999
    assert len(select_keyframes(np.zeros(9, int), np.ones(9, int))) == MAX_EPOCHS_PER_POSITION


def test_the_epochs_of_a_position_together_weigh_as_one_rotation() -> None:
    assert epoch_weights(np.array([0, 0, 1, 0, 0])).tolist() == [0.125, 0.125, 0.5, 0.125, 0.125]


# ---- solver


def trajectory(name: str, positions: Any) -> Trajectory:
    n = len(positions)
    return Trajectory(
        name, "station-1", np.arange(n) * 10**9, np.asarray(positions, float).reshape(n, 3),
        np.tile([0.0, 0, 0, 1], (n, 1)), np.zeros((n, 6, 6)),
    )  # fmt: skip


def tracked(poses: int = 3, behind: float = 0.0, ambiguous: int = 0) -> TrackedDevice:
    none = np.zeros(0, np.int64)
    sweeps = DeviceSweeps(none, none, none, none, none * 0.0)
    return TrackedDevice(
        trajectory("a", np.zeros((poses, 3))), sweeps, (1,), none * 0.0, none > 0, 1e-4, 0.0, {},
        behind, ambiguous,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("device", "codes"),
    [
        (tracked(), []),
        (tracked(poses=0, behind=1.0), ["no_device_pose"]),
        (tracked(behind=0.29), []),
        (tracked(behind=0.31), ["light_from_behind"]),
        (tracked(ambiguous=1), ["ambiguous_orientation"]),
    ],
)
def test_doubts_about_a_device_are_warnings(device: TrackedDevice, codes: list[str]) -> None:
    assert [warning.code for warning in device_warnings([device])] == codes


def detection(channel: int, sweeps: int, rejected: int, **values: Any) -> StationDetection:
    return StationDetection(0, channel, None, 959_000, "factory", sweeps, rejected, **values)


@pytest.mark.parametrize(
    ("numbers", "is_warned"),
    [
        ([(9, 1), (4, 5)], True),
        ([(9, 1), (5, 5)], False),
        ([(1, 9), (1, 9)], False),  # all stations: the receiver or the scene is wrong
    ],
)
def test_a_station_with_many_contradicting_sweeps_is_reported(
    numbers: list[tuple[int, int]], is_warned: bool
) -> None:
    rows = [detection(k + 1, *number) for k, number in enumerate(numbers)]
    path = trajectory("a", np.zeros((1, 3)))
    codes = [warning.code for warning in contradiction_warnings(rows, [path])]
    assert codes == ["station_contradicts_others"] * is_warned
    assert contradiction_warnings(rows, [trajectory("a", np.zeros((0, 3)))]) == []


def visited(positions: Any) -> tuple[Marker, ...]:
    return tuple(
        Marker(f"m{k}", np.asarray(p, float), (MarkerVisit("a", k * 10**9, k * 10**9 + 1),))
        for k, p in enumerate(positions)
    )


def test_markers_on_which_a_device_rested_give_the_transform() -> None:
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    rotation = rotation_exp([0.1, 0.2, 0.3])
    path = trajectory("a", (corners / 1.01 - [1.0, 2.0, 3.0]) @ rotation)
    alignment = align_to_markers(visited(corners), [path])
    assert alignment is not None
    assert alignment.misfit_m == pytest.approx(0.0, abs=1e-9)
    assert alignment.transform.scale == pytest.approx(1.01)
    assert alignment.transform.rotation == pytest.approx(rotation)
    assert alignment.visits == 4
    later = trajectory("a", corners).select(np.arange(4) > 0)
    without_first = align_to_markers(visited(corners), [later])
    assert without_first is not None
    assert without_first.visits == 3
    (warning,) = unused_visits_warnings(visited(corners), 3)
    assert (warning.code, warning.message[:20]) == ("visits_not_used", "1 of 4 visits of mar")
    assert align_to_markers(visited(corners[:2]), [path]) is None
    assert align_to_markers(visited(corners), [trajectory("b", corners)]) is None
    line = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    assert align_to_markers(visited(line), [trajectory("a", line)]) is None


def test_merged_solutions_add_sweeps_by_station_and_keep_each_trajectory_once() -> None:
    doubt, other = SolverWarning("device_scale", "scale"), SolverWarning("x", "other")
    rigid = Solution(
        "lighthouse", "bundle", (trajectory("a", np.zeros((2, 3))),), {"plane_unknown": 2},
        [detection(1, 10, 1), detection(4, 7, 0, verification_rad=1e-4)],
        facts=LighthouseFacts(iterations=3), warnings=(doubt,),
    )  # fmt: skip
    empty, single = trajectory("a", np.zeros((0, 3))), trajectory("b", np.zeros((1, 3)))
    photodiodes = Solution(
        "lighthouse", "bundle", (empty, single), {"plane_unknown": 1, "spike": 4},
        [detection(2, 1, 0), detection(1, 5, 2, residual_rad=2e-4)],
        facts=LighthouseFacts(planar=True), warnings=(replace(doubt, code=""), other),
    )  # fmt: skip
    merged = merge_solutions(rigid, photodiodes)
    assert [(t.device, len(t)) for t in merged.trajectories] == [("a", 2), ("b", 1)]
    assert merged.rejected == {"plane_unknown": 3, "spike": 4}
    assert [(row.station, row.channel, row.sweeps, row.rejected) for row in merged.detections] == [
        (0, 1, 15, 3),
        (1, 2, 1, 0),
        (2, 4, 7, 0),
    ]
    assert merged.detections[0].residual_rad == 2e-4
    assert merged.facts == LighthouseFacts(planar=True, rigid=LighthouseFacts(iterations=3))
    assert merged.warnings == (doubt, other)
