"""Rigid devices and single photodiodes in one recording, markers, verification."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from locatk.core.lighthouse.devices.solver import select_rigid_receivers
from locatk.core.lighthouse.receiver import DECK, Receiver
from locatk.core.lighthouse.scene import Marker, MarkerVisit, Scene
from locatk.core.lighthouse.solver import SolveOptions, solve
from locatk.core.solution import Solution, to_json

SPAN = np.array([[-0.06, 0.04, 0.0], [-0.06, -0.04, 0.0], [0.06, 0.04, 0.0], [0.06, -0.04, 0.02]])
RIGID = Receiver(SPAN, np.tile([0.0, 0.0, 1.0], (4, 1)), "rigid")


def codes(solution: Solution) -> set[str]:
    return {warning.code for warning in solution.warnings}


def facts_of(solution: Solution) -> Any:
    """Return the facts in their JSON form."""
    return to_json(solution.facts)


def detections_as_json(solution: Solution) -> Any:
    """Return the detections in their JSON form."""
    return to_json(solution.detections)


def position_at(t: Any) -> Any:
    return np.stack([0.5 * np.cos(0.4 * t), 0.4 * np.sin(0.6 * t), 0.3 + 0.1 * np.sin(t)], axis=1)


@pytest.fixture(scope="module")
def mixed(world: Any) -> tuple[Any, Any, Scene]:
    """Return sweeps of a rigid device and of a single photodiode, their stations and scene."""
    lamps = world.lamps(1, 2, 5)
    drive = world.drive(lamps, world.curve(200, flat=False))
    scene = solve(drive.sweeps, Scene(markers=world.markers_of(lamps, world.square))).artifact
    rigid = world.stream(lamps, position_at, 1.2, sensors=SPAN)
    single = world.stream(lamps, position_at, 1.2, seed=2)
    single = replace(single, device=np.ones(len(single), np.int32))
    both = world.join(rigid, single)
    return replace(both, devices=("rigid", "single")), lamps, scene


@pytest.fixture(scope="module")
def alone(mixed: Any) -> Solution:
    """Return the solution of the rigid device without the other."""
    sweeps, _, scene = mixed
    return solve(sweeps.take(sweeps.device == 0), scene, receivers={"rigid": RIGID})


def test_devices_in_the_recording_with_three_photodiodes_are_rigid(mixed: Any) -> None:
    sweeps, _, _ = mixed
    two = Receiver(SPAN[:2])
    known = {"rigid": RIGID, "single": two, "absent": DECK}
    assert select_rigid_receivers(sweeps, known) == {"rigid": RIGID}


@pytest.mark.slow
def test_rigid_devices_and_single_photodiodes_share_a_scene(mixed: Any, alone: Solution) -> None:
    sweeps, _, scene = mixed
    solution = solve(sweeps, scene, receivers={"rigid": RIGID})
    tracks = {t.device: t for t in solution.trajectories}
    assert set(tracks) == {"rigid", "single"}
    assert np.isfinite(tracks["rigid"].covariance).all()  # full pose
    assert np.isnan(tracks["single"].covariance[:, 3:, 3:]).all()
    for track in tracks.values():
        assert len(track) > 50
        true = position_at((track.time_ns - track.time_ns[0]) * 1e-9 + 0.0)
        # Both were at the same positions; the start of the clock is known to a rotation.
        assert np.median(np.linalg.norm(track.position - true, axis=1)) < 0.03
    assert solution.artifact is scene
    rows = detections_as_json(solution)
    assert sum(int(row["sweeps"]) + int(row["rejected"]) for row in rows) <= len(sweeps)
    assert [row["channel"] for row in rows] == [1, 2, 5]
    assert [row["station"] for row in rows] == [0, 1, 2]
    assert "verification" in facts_of(solution)
    assert facts_of(solution)["rigid"]
    rigid_rows = detections_as_json(alone)
    single_rows = detections_as_json(solve(sweeps.take(sweeps.device == 1), scene))
    for merged, first, second in zip(rows, rigid_rows, single_rows, strict=True):
        assert merged["sweeps"] == first["sweeps"] + second["sweeps"]
        assert merged["rejected"] == first["rejected"] + second["rejected"]


@pytest.mark.slow
def test_a_rigid_device_needs_no_single_photodiode(alone: Solution) -> None:
    assert [t.device for t in alone.trajectories] == ["rigid"]
    assert [row["station"] for row in detections_as_json(alone)] == [0, 1, 2]


def test_without_receivers_each_photodiode_has_a_trajectory(mixed: Any) -> None:
    sweeps, _, scene = mixed
    names = {t.device for t in solve(sweeps, scene).trajectories}
    assert names == {"rigid/0", "rigid/1", "rigid/2", "rigid/3", "single/0"}


def test_the_papers_method_warns_that_it_ignores_receivers(world: Any) -> None:
    lamps = world.lamps(1, 2)
    drive = world.drive(lamps, world.curve(150, flat=True))
    paper = SolveOptions(method="paper", scene="two-planar")
    markers = Scene(markers=world.markers_of(lamps, world.square))
    solution = solve(drive.sweeps, markers, paper, receivers={"robot": RIGID})
    assert any(w.code == "rigid_devices_ignored" for w in solution.warnings)


POSITIONS = np.array([[0.5, 0.5, 0.0], [-0.5, 0.5, 0.2], [-0.5, -0.5, 0.0], [0.5, -0.5, 0.1]])
REST_S, PERIOD_S = 0.4, 0.65


def on_markers(t: Any) -> Any:
    """Return the path of a device that rests at each position, then moves along a curve."""
    t = np.asarray(t, float)
    number = np.clip((t // PERIOD_S).astype(int), 0, 3)
    fraction = np.clip((t - PERIOD_S * number - REST_S) / (PERIOD_S - REST_S), 0, 1)[:, None]
    following = POSITIONS[np.minimum(number + 1, 3)]
    position = POSITIONS[number] * (1 - fraction) + following * fraction
    return np.where((t > 4 * PERIOD_S)[:, None], position_at(t - 4 * PERIOD_S), position)


def marked(world: Any, count: int, seconds: float) -> tuple[Any, Any, tuple[Marker, ...]]:
    lamps = world.lamps(1, 2, 5)
    sweeps = world.stream(lamps, on_markers, seconds, sensors=SPAN)
    start = int(sweeps.time_ns[0])
    markers = tuple(
        Marker(
            f"m{k}",
            POSITIONS[k],
            (
                MarkerVisit(
                    "robot",
                    start + round((PERIOD_S * k + 0.05) * 1e9),
                    start + round((PERIOD_S * k + 0.35) * 1e9),
                ),
            ),
        )
        for k in range(count)
    )
    return lamps, sweeps, markers


@pytest.mark.slow
def test_markers_give_frame_and_scale_of_a_scene_from_a_device(world: Any) -> None:
    lamps, sweeps, markers = marked(world, 4, 2.9)
    solution = solve(sweeps, Scene(markers=markers), receivers={"robot": RIGID})
    scene = solution.artifact
    assert (scene.scale, scene.frame) == ("markers", "floor")
    assert facts_of(solution)["marker_misfit_m"] < 2e-3
    # The scene was estimated from the same sweeps.
    assert not facts_of(solution)["verification"]["held_out"]
    for lamp in lamps:
        station = scene.station(lamp.channel)
        assert np.linalg.norm(station.position - lamp.position) < 0.03
    assert not {"too_few_markers", "marker_misfit", "device_scale"} & codes(solution)
    (track,) = solution.trajectories
    assert track.frame == "floor"
    first = (track.time_ns > markers[0].visits[0].start_ns) & (
        track.time_ns < markers[0].visits[0].end_ns
    )
    assert np.linalg.norm(np.median(track.position[first], axis=0) - POSITIONS[0]) < 3e-3


@pytest.mark.slow
def test_a_photodiode_without_a_station_leaves_rigid_devices_their_poses(
    mixed: Any, alone: Solution
) -> None:
    sweeps, _, scene = mixed
    sweeps = sweeps.take((sweeps.device == 0) | (np.arange(len(sweeps)) % 5 == 0))
    is_single = sweeps.device == 1
    for channel, reason in ((9, "station_not_in_scene"), (77, "unknown_channel")):
        unseen = replace(sweeps, channel=np.where(is_single, channel, sweeps.channel))
        solution = solve(unseen, scene, receivers={"rigid": RIGID})
        assert {each.device: len(each) for each in solution.trajectories} == {
            "rigid": alone.poses,
            "single": 0,
        }
        assert solution.rejected.get(reason, 0) > 0
        assert sum(solution.rejected.values()) - sum(alone.rejected.values()) == is_single.sum()
        (warning,) = (each for each in solution.warnings if each.code == "no_device_pose")
        assert warning.message.startswith("single: ")


@pytest.mark.slow
def test_two_markers_determine_no_frame(world: Any) -> None:
    _, sweeps, markers = marked(world, 2, 1.6)
    solution = solve(sweeps, Scene(markers=markers), receivers={"robot": RIGID})
    assert solution.artifact.scale == "device"
    assert {"too_few_markers", "device_scale"} <= codes(solution)


@pytest.mark.slow
def test_a_marker_that_was_measured_wrong_is_reported(world: Any) -> None:
    _, sweeps, markers = marked(world, 4, 2.6)
    wrong = replace(markers[3], position=markers[3].position + [0.15, 0.0, 0.0])
    solution = solve(sweeps, Scene(markers=(*markers[:3], wrong)), receivers={"robot": RIGID})
    assert "marker_misfit" in codes(solution)
    assert "visits_not_used" not in codes(solution)


@pytest.mark.slow
def test_each_station_is_verified_against_the_others(mixed: Any, world: Any) -> None:
    _, lamps, scene = mixed
    sweeps = world.stream(lamps, position_at, 2.2, sensors=SPAN)
    checks = facts_of(solve(sweeps, scene, receivers={"robot": RIGID}))["verification"]
    assert checks["held_out"]
    assert [check["channel"] for check in checks["stations"]] == [1, 2, 5]
    for check in checks["stations"]:
        assert check["moments"] > 100
        assert check["residual_m"] < 8e-3
        assert check["jump_95_m"] < 0.02


@pytest.mark.slow
def test_a_station_that_was_moved_is_the_one_that_disagrees(mixed: Any, world: Any) -> None:
    _, lamps, scene = mixed
    sweeps = world.stream(lamps, position_at, 2.2, sensors=SPAN)
    first, second, third = scene.stations
    moved = replace(second, position=second.position + [0.0, 0.0, 0.08])
    solution = solve(
        sweeps, replace(scene, stations=(first, moved, third)), receivers={"robot": RIGID}
    )
    off = {row["channel"]: row["verification_m"] for row in detections_as_json(solution)}
    assert off[2] > 0.02
    jumps = {c["channel"]: c["without_rad"] for c in facts_of(solution)["verification"]["stations"]}
    assert jumps[2] < 0.5 * min(jumps[1], jumps[5])


@pytest.mark.slow
def test_one_station_has_no_other_to_be_verified_against(mixed: Any, world: Any) -> None:
    _, lamps, scene = mixed
    sweeps = world.stream(lamps[:1], position_at, 2.0, sensors=SPAN)
    solution = solve(sweeps, scene, receivers={"robot": RIGID})
    assert "verification" not in facts_of(solution)
    assert "verification_rad" not in detections_as_json(solution)[0]
