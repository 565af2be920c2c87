"""Rigid devices and single photodiodes in one recording."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from locatk.core.lighthouse.devices import rigid_devices
from locatk.core.lighthouse.receiver import DECK, Receiver
from locatk.core.lighthouse.scene import Scene
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
    told = sum(int(row["sweeps"]) + int(row["rejected"]) for row in solution.detections)
    assert told <= len(sweeps)
    assert [row["channel"] for row in solution.detections] == [1, 2, 5]
    assert "verification" in solution.facts
    assert solution.facts["rigid"]


def test_a_body_alone_needs_no_other(mixed: Any, world: Any) -> None:
    sweeps, _, scene = mixed
    alone = world.take(sweeps, np.flatnonzero(sweeps.device == 0))
    solution = solve(alone, scene, receivers={"body": BODY})
    assert [t.device for t in solution.trajectories] == ["body"]
    assert [row["station"] for row in solution.detections] == [0, 1, 2]


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
    assert any("knows no rigid devices" in note for note in solution.notes)
