"""Rigid devices and single photodiodes in one recording."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from locatk.core.lighthouse.devices.solver import rigid_devices
from locatk.core.lighthouse.receiver import DECK, Receiver
from locatk.core.lighthouse.scene import Marker, MarkerVisit, Scene
from locatk.core.lighthouse.solver import SolveOptions, solve

SPAN = np.array([[-0.06, 0.04, 0.0], [-0.06, -0.04, 0.0], [0.06, 0.04, 0.0], [0.06, -0.04, 0.02]])
BODY = Receiver(SPAN, np.tile([0.0, 0.0, 1.0], (4, 1)), "body")


def where(t: Any) -> Any:
    return np.stack([0.5 * np.cos(0.4 * t), 0.4 * np.sin(0.6 * t), 0.3 + 0.1 * np.sin(t)], axis=1)


@pytest.fixture(scope="module")
def mixed(world: Any) -> tuple[Any, Any, Scene]:
    """Sweeps of a body and of a lone photodiode, and the scene in which they are."""
    lamps = world.lamps(1, 2, 5)
    drive = world.drive(lamps, world.curve(200, flat=False))
    scene = solve(drive.sweeps, Scene(markers=world.markers_of(lamps, world.square))).artifact
    body = world.stream(lamps, where, 4.0, sensors=SPAN)
    lone = world.stream(lamps, where, 4.0, seed=2)
    lone = replace(lone, device=np.ones(len(lone), np.int32))
    both = world.join(body, lone)
    return replace(both, devices=("body", "lone")), lamps, scene


def test_rigid_are_devices_that_are_there_with_three_photodiodes(mixed: Any) -> None:
    sweeps, _, _ = mixed
    two = Receiver(SPAN[:2])
    known = {"body": BODY, "lone": two, "absent": DECK}
    assert rigid_devices(sweeps, known) == {"body": BODY}


def test_both_roads_share_a_scene(mixed: Any) -> None:
    sweeps, _, scene = mixed
    solution = solve(sweeps, scene, receivers={"body": BODY})
    tracks = {t.device: t for t in solution.trajectories}
    assert set(tracks) == {"body", "lone"}
    assert np.isfinite(tracks["body"].covariance).all()  # full pose
    assert np.isnan(tracks["lone"].covariance[:, 3:, 3:]).all()
    for track in tracks.values():
        assert len(track) > 50
        true = where((track.time_ns - track.time_ns[0]) * 1e-9 + 0.0)
        # Both were at the same places; the start of the clock is known to a rotation.
        assert np.median(np.linalg.norm(track.position - true, axis=1)) < 0.03
    assert solution.artifact is scene
    told = sum(row.sweeps + row.rejected for row in solution.detections)
    assert told <= len(sweeps)
    assert [row.channel for row in solution.detections] == [1, 2, 5]
    assert solution.facts.verification is not None
    assert solution.facts.rigid


def test_a_body_alone_needs_no_other(mixed: Any, world: Any) -> None:
    sweeps, _, scene = mixed
    alone = world.take(sweeps, np.flatnonzero(sweeps.device == 0))
    solution = solve(alone, scene, receivers={"body": BODY})
    assert [t.device for t in solution.trajectories] == ["body"]
    assert [row.station for row in solution.detections] == [0, 1, 2]


def test_without_receivers_photodiodes_are_apart(mixed: Any) -> None:
    sweeps, _, scene = mixed
    names = {t.device for t in solve(sweeps, scene).trajectories}
    assert names == {"body/0", "body/1", "body/2", "body/3", "lone/0"}


def test_the_papers_method_says_that_it_knows_no_bodies(world: Any) -> None:
    lamps = world.lamps(1, 2)
    drive = world.drive(lamps, world.curve(150, flat=True))
    paper = SolveOptions(method="paper", scene="two-planar")
    markers = Scene(markers=world.markers_of(lamps, world.square))
    solution = solve(drive.sweeps, markers, paper, receivers={"robot": BODY})
    assert any("knows no rigid devices" in each.message for each in solution.warnings)


PLACES = np.array([[0.5, 0.5, 0.0], [-0.5, 0.5, 0.2], [-0.5, -0.5, 0.0], [0.5, -0.5, 0.1]])
STAND_S, ROUND_S = 1.5, 2.0


def on_markers(t: Any) -> Any:
    """Stands on each place for a while, goes on to the next, and drives a curve at last."""
    t = np.asarray(t, float)
    number = np.clip((t // ROUND_S).astype(int), 0, 3)
    share = np.clip((t - ROUND_S * number - STAND_S) / (ROUND_S - STAND_S), 0, 1)[:, None]
    ahead = PLACES[np.minimum(number + 1, 3)]
    stood = PLACES[number] * (1 - share) + ahead * share
    return np.where((t > 4 * ROUND_S)[:, None], where(t - 4 * ROUND_S), stood)


def marked(world: Any, count: int) -> tuple[Any, Any, tuple[Marker, ...]]:
    lamps = world.lamps(1, 2, 5)
    sweeps = world.stream(lamps, on_markers, 14.0, sensors=SPAN)
    start = int(sweeps.time_ns[0])
    markers = tuple(
        Marker(
            f"m{k}",
            PLACES[k],
            (
                MarkerVisit(
                    "robot",
                    start + round((ROUND_S * k + 0.2) * 1e9),
                    start + round((ROUND_S * k + 1.3) * 1e9),
                ),
            ),
        )
        for k in range(count)
    )
    return lamps, sweeps, markers


def test_markers_give_frame_and_scale_of_a_scene_from_a_body(world: Any) -> None:
    lamps, sweeps, markers = marked(world, 4)
    solution = solve(sweeps, Scene(markers=markers), receivers={"robot": BODY})
    scene = solution.artifact
    assert (scene.scale, scene.frame) == ("markers", "floor")
    assert solution.facts.marker_misfit_m < 2e-3
    for lamp in lamps:
        station = scene.station(lamp.channel)
        assert np.linalg.norm(station.position - lamp.position) < 0.03
    (track,) = solution.trajectories
    assert track.frame == "floor"
    first = (track.time_ns > markers[0].sightings[0].start_ns) & (
        track.time_ns < markers[0].sightings[0].end_ns
    )
    assert np.linalg.norm(np.median(track.position[first], axis=0) - PLACES[0]) < 3e-3


def test_two_markers_fix_no_frame_and_a_note_says_so(world: Any) -> None:
    _, sweeps, markers = marked(world, 2)
    solution = solve(sweeps, Scene(markers=markers), receivers={"robot": BODY})
    assert solution.artifact.scale == "device"
    assert any("fix no frame" in each.message for each in solution.warnings)


def test_a_marker_that_was_measured_wrong_is_told(world: Any) -> None:
    _, sweeps, markers = marked(world, 4)
    wrong = replace(markers[3], position=markers[3].position + [0.15, 0.0, 0.0])
    solution = solve(sweeps, Scene(markers=(*markers[:3], wrong)), receivers={"robot": BODY})
    assert any("measured wrong" in each.message for each in solution.warnings)


def test_each_station_is_verified_against_the_others(mixed: Any, world: Any) -> None:
    _, lamps, scene = mixed
    sweeps = world.stream(lamps, where, 6.0, sensors=SPAN)
    checks = solve(sweeps, scene, receivers={"robot": BODY}).facts.verification
    assert checks.held_out
    assert [check.channel for check in checks.stations] == [1, 2, 5]
    for check in checks.stations:
        assert check.epochs > 100
        assert check.residual_m < 8e-3
        assert check.jump_95_m < 0.02


def test_a_station_that_was_moved_is_the_one_that_disagrees(mixed: Any, world: Any) -> None:
    _, lamps, scene = mixed
    sweeps = world.stream(lamps, where, 6.0, sensors=SPAN)
    first, second, third = scene.stations
    moved = replace(second, position=second.position + [0.0, 0.0, 0.08])
    solution = solve(
        sweeps, replace(scene, stations=(first, moved, third)), receivers={"robot": BODY}
    )
    off = {row.channel: row.verification_m for row in solution.detections}
    assert off[2] > 0.02
    jumps = {c.channel: c.without_rad for c in solution.facts.verification.stations}
    assert jumps[2] < 0.5 * min(jumps[1], jumps[5])


def test_one_station_has_no_other_to_be_verified_against(mixed: Any, world: Any) -> None:
    _, lamps, scene = mixed
    sweeps = world.stream(lamps[:1], where, 4.0, sensors=SPAN)
    solution = solve(sweeps, scene, receivers={"robot": BODY})
    assert solution.facts.verification is None
    assert solution.detections[0].verification_rad is None
