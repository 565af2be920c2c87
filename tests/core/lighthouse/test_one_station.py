"""A single station over markers in space: its pose, and what it can locate."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from locatk.core.errors import DegenerateError
from locatk.core.lighthouse.calibration import FACTORY_UNITS, Calibration
from locatk.core.lighthouse.epochs import group_epochs
from locatk.core.lighthouse.scene import Scene
from locatk.core.lighthouse.scene.estimation import SceneEstimate, estimate_scene
from locatk.core.lighthouse.solver import SolveOptions, solve

SPACE = np.array(
    [[-0.5, -0.4, 0.0], [0.6, -0.5, 0.1], [0.4, 0.6, 0.7], [-0.6, 0.3, 0.3], [0.1, 0.0, 0.9]]
)


def factory(unit: int) -> Calibration:
    row, sweeps = FACTORY_UNITS[unit], np.zeros((2, 7))
    sweeps[1, 0] = row[0]
    for column, first in enumerate(range(1, 13, 2), start=1):
        sweeps[:, column] = row[first : first + 2]
    return Calibration(sweeps, "factory")


def prior(world: Any, points: np.ndarray, errors: np.ndarray | float = 0.0, **known: Any) -> Scene:
    """Markers whose positions were measured with errors, and the factory data of the station."""
    markers = world.markers_of(world.lamps(1), points)
    errors = np.broadcast_to(errors, points.shape)
    moved = [replace(m, position=m.position + e) for m, e in zip(markers, errors, strict=True)]
    return Scene(markers=tuple(moved), calibrations={1: factory(5)}, **known)


def estimate(world: Any, scene: Scene) -> SceneEstimate:
    drive = world.drive(world.lamps(1), world.curve(40, flat=False))
    return estimate_scene(group_epochs(drive.sweeps), scene)


def codes(estimate: SceneEstimate) -> set[str]:
    return {warning.code for warning in estimate.warnings}


def error_m(world: Any, estimate: SceneEstimate) -> float:
    [lamp], [station] = world.lamps(1), estimate.scene.stations
    return float(np.linalg.norm(station.position - lamp.position))


@pytest.mark.parametrize("number", [4, 5])
def test_factory_data_and_few_markers_give_the_pose(world: Any, number: int) -> None:
    found = estimate(world, prior(world, SPACE[:number]))
    assert error_m(world, found) < 1e-3
    [lamp], [station] = world.lamps(1), found.scene.stations
    np.testing.assert_allclose(station.rotation, lamp.rotation, atol=1e-3)
    assert station.floor_map is None
    assert station.covariance is not None
    assert (found.scene.planar, found.scene.scale) == (False, "markers")
    assert codes(found) == {"direction_only"}
    assert found.scene.notes == ()


def test_a_photodiode_in_space_has_a_direction_only(world: Any) -> None:
    """Projected to a floor, positions would be wrong by decimetres, with a sigma of 1 mm."""
    drive = world.drive(world.lamps(1), world.curve(40, flat=False))
    solution = solve(drive.sweeps, prior(world, SPACE))
    assert len(solution.trajectories[0]) == 0
    assert solution.rejected == {"moment_with_too_few_sweeps": 40}
    [warning] = [w for w in solution.warnings if w.code == "direction_only"]
    assert "planar = true" in warning.message
    # The same with the station given, and with markers on a floor that are said to be in space.
    again = solve(drive.sweeps, solution.artifact)
    assert [w.code for w in again.warnings] == ["direction_only"]
    assert len(again.trajectories[0]) == 0
    floor = np.c_[SPACE[:, :2], np.zeros(5)]
    space = solve(drive.sweeps, prior(world, floor, planar=False))
    assert len(space.trajectories[0]) == 0


def test_a_known_floor_gives_positions(world: Any) -> None:
    lamps, points = world.lamps(1), world.curve(40, flat=True) + [0, 0, 0.25]
    drive = world.drive(lamps, points, noise_rad=2e-5)
    solution = solve(drive.sweeps, prior(world, SPACE, planar=True, floor_z=0.25))
    [track] = solution.trajectories
    assert len(track) == 40
    assert np.linalg.norm(track.position - points, axis=1).max() < 3e-3
    assert "direction_only" not in {w.code for w in solution.warnings}
    # Markers on the floor, up to its slope, are used as before.
    sloping = np.c_[SPACE[:, :2], 0.02 * SPACE[:, 0]]
    found = solve(drive.sweeps, prior(world, sloping))
    assert found.artifact.stations[0].floor_map is not None
    assert found.artifact.planar is True


def test_the_user_can_insist_on_a_floor(world: Any) -> None:
    drive = world.drive(world.lamps(1), world.curve(40, flat=True))
    options = SolveOptions(scene="one-planar")
    assert solve(drive.sweeps, prior(world, SPACE), options).artifact.planar is True


def test_markers_that_disagree(world: Any) -> None:
    errors = np.zeros((5, 3))
    errors[1] = [0.1, -0.3, 0.2]
    points = np.concatenate([SPACE, SPACE[:, [1, 0, 2]] * 0.9])
    found = estimate(world, prior(world, points, np.concatenate([errors, 0 * errors])))
    assert error_m(world, found) < 0.01
    assert codes(found) == {"direction_only", "marker_misfit"}
    with pytest.raises(DegenerateError, match="fewer than four markers agree"):
        estimate(world, prior(world, SPACE[:4], errors[:4]))


def test_markers_that_do_not_determine_a_pose(world: Any) -> None:
    with pytest.raises(DegenerateError, match="needs 4 visited markers"):
        estimate(world, prior(world, SPACE[:3]))
    line = np.linspace([-0.5, 0, 0], [0.5, 0.2, 0.8], 6)
    with pytest.raises(DegenerateError, match="do not determine the pose"):
        estimate(world, prior(world, line))
    # A small plane looks alike from two sides; a small space leaves the distance open.
    plane = 0.06 * np.c_[SPACE[:4, :2], [0.5, -0.5, 0.2, -0.2]]
    plane[:, 2] = 0.4 * plane[:, 0] + 0.3 * plane[:, 1]
    with pytest.raises(DegenerateError, match="two poses"):
        estimate(world, prior(world, plane))
    with pytest.raises(DegenerateError, match=r"two poses|to 0\.\d\d m only"):
        estimate(world, prior(world, 0.05 * SPACE))
