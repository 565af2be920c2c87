"""Stations against each other, on moments that took no part."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.lighthouse.calibration import Calibration
from locatk.core.lighthouse.results import StationVerification
from locatk.core.lighthouse.scene import Scene
from locatk.core.lighthouse.scene.verification import (
    MAX_VERIFICATION_EPOCHS,
    find_inconsistent_station,
    select_verification_epochs,
    verify_scene,
    verify_stations,
)
from locatk.core.lighthouse.solver import solve

Array = NDArray[np.float64]
NAMES = ("phase", "tilt", "curve", "gibmag", "gibpha", "ogeemag", "ogeephase")


def exact(lamps: Any) -> tuple[Array, Array, tuple[Calibration, ...]]:
    """Where the stations are, with their factory calibrations."""
    return (
        np.stack([lamp.position for lamp in lamps]),
        np.stack([lamp.rotation for lamp in lamps]),
        tuple(
            Calibration(np.array([[getattr(p, n) for n in NAMES] for p in lamp.planes]), "factory")
            for lamp in lamps
        ),
    )


def seen_by(lamps: Any, points: Array, noise: float, seed: int = 1) -> Array:
    rng = np.random.default_rng(seed)
    true = np.stack([lamp.angles(points) for lamp in lamps], axis=1)
    return true + rng.normal(0, noise, true.shape)


def checked(world: Any, channels: tuple[int, ...], *, flat: bool, noise: float = 3e-4,
            shift: tuple[int, Array] | None = None) -> tuple[StationVerification, ...]:  # fmt: skip
    lamps = world.lamps(*channels)
    angles = seen_by(lamps, world.curve(400, flat=flat), noise)
    positions, rotations, calibrations = exact(lamps)
    if shift is not None:
        positions[shift[0]] += shift[1]
    floor_z = 0.0 if flat else None
    return verify_stations(angles, channels, positions, rotations, calibrations, floor_z=floor_z)


@pytest.mark.parametrize("flat", [True, False])
def test_in_a_right_scene_the_residual_is_the_noise(world: Any, flat: bool) -> None:
    checks = checked(world, (1, 2, 5, 16), flat=flat)
    assert [c.channel for c in checks] == [1, 2, 5, 16]
    for check in checks:
        assert check.against == "others"
        assert check.epochs == 400
        # Its own noise, and that of where the other three see the place.
        assert 3e-4 < check.residual_rad < 4.5e-4
        assert check.residual_m == pytest.approx(3 * check.residual_rad, rel=0.25)  # at 3 m
        assert 0 < check.jump_median_m < check.jump_95_m < 3e-3
    assert find_inconsistent_station(checks) is None


def test_two_stations_in_space_have_only_the_joint_fix(world: Any) -> None:
    for check in checked(world, (1, 2), flat=False):
        assert check.against == "joint"
        assert 0 < check.residual_rad < 3e-4
        assert check.jump_median_m is None
        assert check.without_rad is None


def test_two_stations_on_a_floor_check_each_other(world: Any) -> None:
    for check in checked(world, (1, 2), flat=True):
        assert check.against == "others"
        assert check.jump_95_m is not None


@pytest.mark.parametrize("flat", [True, False])
@pytest.mark.parametrize("moved", [0, 1, 2, 3])
def test_a_moved_station_is_found(world: Any, moved: int, flat: bool) -> None:
    channels = (1, 2, 5, 16)
    checks = checked(world, channels, flat=flat, shift=(moved, np.array([0.03, -0.02, 0.01])))
    wrong = find_inconsistent_station(checks)
    assert wrong is not None
    assert wrong.channel == channels[moved]


def test_an_unobserved_station_is_not_verified(world: Any) -> None:
    lamps = world.lamps(1, 2, 5)
    angles = seen_by(lamps, world.curve(20, flat=False), 1e-4)
    angles[:, 2] = np.nan
    check = verify_stations(angles, (1, 2, 5), *exact(lamps))[2]
    assert check.epochs == 0
    assert check.residual_rad is None
    assert check.jump_median_m is None


# ---- the inconsistent station


def check_of(
    channel: int, without_rad: float | None, residual_rad: float = 5e-3, against: str = "others"
) -> StationVerification:
    return StationVerification(channel, against, 100, residual_rad, 1e-3, None, None, without_rad)


def inconsistent(*without_rad: float | None, **options: Any) -> int | None:
    """Channel of the inconsistent station, numbered from 1, by residuals of the others."""
    checks = [check_of(k + 1, value, **options) for k, value in enumerate(without_rad)]
    station = find_inconsistent_station(checks)
    return None if station is None else station.channel


def test_others_must_agree_three_times_better_without_a_station() -> None:
    assert inconsistent(3e-3, 0.9e-3, 3e-3, 4e-3) == 2
    assert inconsistent(3e-3, 1.1e-3, 3e-3, 4e-3) is None
    # The second best counts, not the mean.
    assert inconsistent(3e-3, 0.9e-3, 2e-3, 40e-3) is None


def test_a_small_residual_is_not_inconsistent() -> None:
    # 1.5 mrad are within the errors of a generic calibration.
    assert inconsistent(1e-3, 1e-4, 1e-3, residual_rad=1.4e-3) is None
    assert inconsistent(1e-3, 1e-4, 1e-3, residual_rad=1.6e-3) == 2


def test_two_stations_cannot_decide_which_is_inconsistent() -> None:
    assert inconsistent(3e-3, 1e-4) is None
    assert inconsistent(3e-3, 1e-4, None) is None
    assert inconsistent(3e-3, 1e-4, 3e-3, against="joint") is None


def test_epochs_of_a_single_station_do_not_verify(world: Any) -> None:
    angles = seen_by(world.lamps(1, 2, 5), world.curve(40, flat=True), 1e-4)
    angles[::2, 1:] = np.nan
    np.testing.assert_array_equal(select_verification_epochs(angles), np.arange(1, 40, 2))


def test_a_scene_is_verified_on_a_limited_number_of_epochs(world: Any) -> None:
    lamps = world.lamps(1, 2)
    angles = seen_by(lamps, world.curve(MAX_VERIFICATION_EPOCHS + 50, flat=True), 1e-4)
    checked = verify_scene(angles, (1, 2), exact(lamps), floor_z=0.0)
    assert checked is not None
    assert checked.epochs == MAX_VERIFICATION_EPOCHS
    assert verify_scene(angles[:, :1], (1,), exact(lamps[:1]), floor_z=0.0) is None
    assert verify_scene(angles[:0], (1, 2), exact(lamps), floor_z=0.0) is None


# ---- in a solution


def test_solutions_carry_it(world: Any) -> None:
    lamps = world.lamps(1, 2, 5)
    drive = world.drive(lamps, world.curve(400, flat=True))
    solution = solve(drive.sweeps, Scene(markers=world.markers_of(lamps, world.square)))
    found = solution.facts.verification
    assert found.held_out
    assert found.epochs == 80  # every fifth
    assert solution.facts.bundle_points == 320
    assert [s.channel for s in found.stations] == [1, 2, 5]
    for row, station in zip(solution.detections, found.stations, strict=True):
        assert row.verification_rad == station.residual_rad < 5e-4
        assert row.verification_m == station.residual_m < 2e-3


def test_few_positions_are_all_used_for_the_scene(world: Any) -> None:
    lamps = world.lamps(1, 2, 5)
    drive = world.drive(lamps, world.curve(60, flat=True))
    found = solve(drive.sweeps, Scene(markers=world.markers_of(lamps, world.square))).facts
    assert not found.verification.held_out
    assert found.bundle_points == found.verification.epochs == 60


@pytest.mark.slow
@pytest.mark.parametrize("flat", [True, False])
def test_a_station_that_was_moved_since_is_named(world: Any, flat: bool) -> None:
    lamps = world.lamps(1, 2, 5, 16)
    drive = world.drive(lamps, world.curve(200, flat=flat))
    scene = solve(drive.sweeps, Scene(markers=world.markers_of(lamps, world.square))).artifact
    assert all(w.code != "wrong_station" for w in solve(drive.sweeps, scene).warnings)
    pushed = replace(lamps[2], position=lamps[2].position + [0.08, 0.0, 0.02])
    later = world.drive((*lamps[:2], pushed, lamps[3]), world.curve(200, flat=flat), seed=9)
    (warning,) = [w for w in solve(later.sweeps, scene).warnings if w.code == "wrong_station"]
    assert "channel 5 " in warning.message
