"""Stations and points from angles alone, up to scale."""

from __future__ import annotations

import warnings
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.geometry import umeyama
from locatk.core.lighthouse.calibration import GENERIC_CALIBRATION, MODEL_SIGMA_RAD
from locatk.core.lighthouse.epochs import group_epochs
from locatk.core.lighthouse.scene import MarkerVisit, Scene
from locatk.core.lighthouse.scene.estimation import (
    StationsEstimate,
    estimate_scene,
    estimate_stations,
    largest_group,
)

Array = NDArray[np.float64]


def angles_of(lamps: Any, points: Array, noise: float = 1e-4, seed: int = 0) -> Array:
    exact = np.stack([s.angles(points) for s in lamps], axis=1)
    return exact + np.random.default_rng(seed).normal(0, noise, exact.shape)


def run(angles: Array, planar: bool | None = None, seed: int = 0) -> StationsEstimate:
    generic = (GENERIC_CALIBRATION,) * angles.shape[1]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return estimate_stations(angles, generic, sigma=MODEL_SIGMA_RAD, planar=planar, seed=seed)


def off(estimate: StationsEstimate, points: Array) -> float:
    """Mean error of the places after the best similarity, in metres."""
    found, true = estimate.adjustment.state.points, points[estimate.chosen]
    return float(np.mean(np.linalg.norm(umeyama(found, true).apply(found) - true, axis=1)))


@pytest.mark.slow
@pytest.mark.parametrize("channels", list(combinations((1, 2, 5, 16), 2)) + [(1, 2, 5, 16)])
@pytest.mark.parametrize("flat", [True, False])
def test_the_scene_and_its_kind_are_found(
    world: Any, channels: tuple[int, ...], flat: bool
) -> None:
    lamps = world.lamps(*channels)
    points = world.curve(150, flat=flat)
    found = run(angles_of(lamps, points))
    assert found.planar is flat
    assert found.facts.planar_decided_by == "data"
    assert found.stations == tuple(range(len(channels)))
    assert off(found, points) < 6e-3
    rig = found.adjustment.state
    to = umeyama(rig.points, points[found.chosen])
    for k, lamp in enumerate(lamps):
        np.testing.assert_allclose(to.apply(rig.positions[k]), lamp.position, atol=0.08)
        np.testing.assert_allclose(to.rotation @ rig.rotations[k], lamp.rotation, atol=0.03)


def test_a_floor_is_z_zero_with_stations_above(world: Any) -> None:
    found = run(angles_of(world.lamps(1, 2, 5), world.curve(100, flat=True)))
    rig = found.adjustment.state
    np.testing.assert_array_equal(rig.points[:, 2], 0)
    assert np.all(rig.positions[:, 2] > 0)
    assert np.all(rig.rotations[:, 2, 2] > 0)  # upright


@pytest.mark.slow
@pytest.mark.parametrize("flat", [True, False])
def test_the_order_of_stations_does_not_matter(world: Any, flat: bool) -> None:
    lamps = world.lamps(1, 2, 5)
    points = world.curve(120, flat=flat)
    angles = angles_of(lamps, points)
    first = run(angles)
    for order in ((1, 0, 2), (2, 1, 0)):
        other = run(angles[:, order])
        assert other.planar is flat
        a = first.adjustment.state.points
        b = other.adjustment.state.points
        np.testing.assert_array_equal(first.chosen, other.chosen)
        np.testing.assert_allclose(umeyama(b, a).apply(b), a, atol=2e-3 * np.ptp(a))


@pytest.mark.slow
@pytest.mark.parametrize("flat", [True, False])
def test_the_seed_does_not_matter(world: Any, flat: bool) -> None:
    lamps = world.lamps(2, 5)
    points = world.curve(120, flat=flat)
    angles = angles_of(lamps, points)
    rigs = [run(angles, seed=seed).adjustment.state.points for seed in (0, 0, 1, 77)]
    np.testing.assert_array_equal(rigs[0], rigs[1])
    for other in rigs[2:]:
        np.testing.assert_allclose(
            umeyama(other, rigs[0]).apply(other), rigs[0], atol=1e-3 * np.ptp(rigs[0])
        )


@pytest.mark.slow
@pytest.mark.parametrize("n", [8, 12, 30])
def test_few_places_in_space_are_enough(world: Any, n: int) -> None:
    # The paper's Fig. 12 needs 20 for 11 mm; here the arrangement itself must be right.
    points = world.curve(n, flat=False)
    found = run(angles_of(world.lamps(1, 5), points), planar=False)
    assert off(found, points) < 0.03


@pytest.mark.parametrize("n", [5, 6, 10])
def test_few_places_on_a_floor_are_enough(world: Any, n: int) -> None:
    points = world.curve(n, flat=True)
    found = run(angles_of(world.lamps(1, 5), points), planar=True)
    assert off(found, points) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("where", ["first", "second", "third"])
@pytest.mark.parametrize("flat", [True, False])
def test_reflections_of_one_station_are_outvoted(world: Any, where: str, flat: bool) -> None:
    lamps = world.lamps(1, 2, 5)
    points = world.curve(200, flat=flat)
    angles = angles_of(lamps, points)
    liar = ["first", "second", "third"].index(where)
    mirrored = points[80:100] * [-1, 1, 1] + [0.3, 0.4, 0.2]
    angles[80:100, liar] = lamps[liar].angles(mirrored)
    found = run(angles)
    assert found.planar is flat
    assert off(found, points) < 5e-3


def test_a_station_without_common_positions_is_left_out(world: Any) -> None:
    angles = angles_of(world.lamps(1, 2, 5), world.curve(100, flat=True))
    angles[:80, 2] = np.nan
    angles[80:, :2] = np.nan
    found = run(angles)
    assert found.stations == (0, 1)
    assert np.all(found.chosen < 80)


@pytest.mark.slow
def test_stations_are_linked_through_others(world: Any) -> None:
    # 1 and 16 share no place, but both share with 2 and 5.
    lamps = world.lamps(1, 2, 5, 16)
    points = world.curve(200, flat=False)
    angles = angles_of(lamps, points)
    angles[120:, 0] = np.nan
    angles[:120, 3] = np.nan
    found = run(angles)
    assert found.stations == (0, 1, 2, 3)
    assert off(found, points) < 5e-3


REFUSED = {
    "still": (None, "stood still"),
    "three places": (None, "positions"),
    "a long line": (None, "line"),
    "a short line": (None, "line"),
    "a wobbly line": (None, "line"),
    "never together": (None, "observed by two stations at once"),
    "flat, as space": (False, "plane"),
    "five places, as space": (False, "positions"),
}


@pytest.mark.parametrize("kind", REFUSED)
@pytest.mark.parametrize("noise", [0.0, 1e-4])
def test_insufficient_observations_are_refused_with_a_reason(
    world: Any, kind: str, noise: float
) -> None:
    points = {
        "still": np.tile([[0.3, 0.2, 0.0]], (60, 1)),
        "three places": np.repeat(world.curve(3, flat=True), 20, axis=0),
        "a long line": np.linspace([-0.8, -0.3, 0], [0.7, 0.5, 0], 60),
        "a short line": np.linspace([-0.2, 0.5, 0], [0.2, 0.6, 0], 60),
        "a wobbly line": np.linspace([-0.8, 0.1, 0], [0.8, 0.1, 0], 60)
        + [[0, 1e-3 * (-1) ** k, 0] for k in range(60)],
        "five places, as space": world.curve(5, flat=False),
    }.get(kind, world.curve(60, flat=True))
    planar, word = REFUSED[kind]
    angles = angles_of(world.lamps(1, 2), points, noise)
    if kind == "never together":
        angles[:30, 0], angles[30:, 1] = np.nan, np.nan
    with pytest.raises(DegenerateError, match=word) as refused:
        run(angles, planar)
    assert refused.value.hint


def test_four_positions_do_not_determine_the_kind(world: Any) -> None:
    # A homography fits any four places exactly: that is no sign of a floor.
    with pytest.raises(DegenerateError) as refused:
        run(angles_of(world.lamps(1, 2), world.curve(4, flat=False)))
    assert refused.value.hint


def test_of_two_readings_of_a_floor_the_upright_one_is_taken(world: Any) -> None:
    # Two stations side by side: both readings of the homography see all places ahead.
    first, second = world.lamps(1, 2)
    side = np.array([2.5, 0.6, 2.0]), np.array([2.5, 0.9, 2.4])
    lamps = tuple(
        replace(lamp, position=place, rotation=world.look(place, np.zeros(3)))
        for lamp, place in zip((first, second), side, strict=True)
    )
    points = world.curve(150, flat=True)
    found = run(angles_of(lamps, points), planar=True)
    candidates = found.facts.candidates
    assert candidates is not None
    assert [c.fits for c in candidates] == [True, True]
    (chosen,) = [c for c in candidates if c.chosen]
    assert chosen.roll_deg < 10 < max(c.roll_deg for c in candidates)
    assert off(found, points) < 0.03


# ---- groups and warnings


def test_the_largest_group_has_the_most_stations_then_keyframes() -> None:
    shared = np.zeros((5, 5), np.int64)

    def link(i: int, j: int, count: int) -> None:
        shared[i, j] = shared[j, i] = count

    link(0, 1, 900)
    link(2, 3, 4)
    link(3, 4, 4)
    assert largest_group(shared) == (2, 3, 4)
    link(3, 4, 3)  # Too few keyframes to be a link.
    assert largest_group(shared) == (0, 1)
    with pytest.raises(DegenerateError, match="two stations at once"):
        largest_group(np.zeros((3, 3), np.int64))


@pytest.mark.parametrize(("off_plane", "warned"), [(0.02, False), (0.08, True)])
def test_positions_off_the_plane_are_named(world: Any, off_plane: float, warned: bool) -> None:
    lamps = world.lamps(1, 2)
    points = world.curve(300, flat=True)
    points[: int(300 * off_plane), 2] = 0.4
    drive = world.drive(lamps, points)
    estimate = estimate_scene(group_epochs(drive.sweeps), Scene(), kind="two-planar")
    codes = {warning.code for warning in estimate.warnings}
    assert ("plane_contradicted" in codes) is warned


def test_two_arrangements_that_fit_alike_are_named(world: Any) -> None:
    first, second = world.lamps(1, 2)
    side = np.array([2.5, 0.6, 2.0]), np.array([2.5, 0.9, 2.4])
    lamps = tuple(
        replace(lamp, position=position, rotation=world.look(position, np.zeros(3)))
        for lamp, position in zip((first, second), side, strict=True)
    )
    epochs = group_epochs(world.drive(lamps, world.curve(150, flat=True)).sweeps)
    codes = {w.code for w in estimate_scene(epochs, Scene(), kind="two-planar").warnings}
    assert "two_candidates" in codes
    around = group_epochs(world.drive((first, second), world.curve(150, flat=True)).sweeps)
    codes = {w.code for w in estimate_scene(around, Scene(), kind="two-planar").warnings}
    assert "two_candidates" not in codes


def test_a_single_station_is_that_with_the_most_markers(world: Any) -> None:
    lamps = world.lamps(1, 2)
    markers = [*world.markers_of(lamps, world.square)]
    markers[0] = replace(
        markers[0], visits=(MarkerVisit(counts={2: markers[0].visits[0].counts[2]}),)
    )
    epochs = group_epochs(world.drive(lamps, world.curve(40, flat=True, size=0.5)).sweeps)
    estimate = estimate_scene(epochs, Scene(markers=tuple(markers)), kind="one-planar")
    (station,) = estimate.scene.stations
    assert station.channel == 2
    assert estimate.rejected == {"other_station": 80}
    assert estimate.epochs.channels.tolist() == [2]
    assert "visits_not_used" not in {w.code for w in estimate.warnings}
    other = replace(markers[0], visits=(MarkerVisit("robot", 0, 1),))
    estimate = estimate_scene(epochs, Scene(markers=(*markers, other)), kind="one-planar")
    assert "visits_not_used" in {w.code for w in estimate.warnings}
