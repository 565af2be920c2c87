"""Placement of stations: against exhaustive search, and what a design promises."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from locatk.core.errors import InputError
from locatk.core.lighthouse.calibration import (
    FACTORY_UNITS,
    GENERIC_CALIBRATION,
    Calibration,
    predict_angles,
)
from locatk.core.lighthouse.design import (
    RoomDesign,
    RoomRequest,
    best_addition,
    bill_of_materials,
    check_room,
    design_room,
    mounts,
    placement,
)
from locatk.core.lighthouse.design.calibration_errors import calibration_sigma
from locatk.core.lighthouse.design.mounts import candidates, view_rotation
from locatk.core.lighthouse.design.placement import (
    MIN_SEPARATION_M,
    PlacementProblem,
    choose_stations,
    is_separated,
    refine,
    working_points,
)
from locatk.core.lighthouse.design.report import report_room, station_of
from locatk.core.lighthouse.room import Obstacle, RobotSize, Room
from locatk.core.lighthouse.scene import Scene
from locatk.core.lighthouse.scene.model import JOINT_PARAMETERS
from locatk.core.polygons import rectangle

FLOOR = Room(rectangle(5.0, 4.0), 2.8, (0.1, 0.1))
SPACE = Room(rectangle(5.0, 4.0), 2.8, (0.0, 1.2))
L_ROOM = Room(
    np.array([[0, 0], [7, 0], [7, 3], [3, 3], [3, 6], [0, 6]]),
    2.8,
    (0.1, 0.1),
    obstacles=(Obstacle(rectangle(0.8, 0.8, (1.0, 4.0)), 0.0, 1.5),),
)


@pytest.fixture(scope="module", autouse=True)
def _short_search() -> Iterator[None]:
    """Compare fewer candidates and places: the promises are those of any search."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mounts, "WALL_POSITIONS", 16)
        patch.setattr(mounts, "CEILING_POSITIONS", 6)
        patch.setattr(placement, "SEARCH_POINTS", 150)
        patch.setattr(placement, "REFINEMENT_POINTS", 500)
        patch.setattr(placement, "SEARCH_BUDGET", 2_000_000)
        patch.setattr(placement, "MAX_EVALUATIONS_PER_STAGE", 20)
        yield


@pytest.fixture(scope="module")
def design() -> RoomDesign:
    return design_room(SPACE, RoomRequest(3))


@pytest.mark.parametrize(
    ("room", "count", "number"), [(FLOOR, 2, 40), (SPACE, 2, 40), (SPACE, 3, 16), (L_ROOM, 3, 16)]
)
def test_search_finds_the_best_combination_of_a_few_candidates(
    room: Room, count: int, number: int
) -> None:
    problem = PlacementProblem(room, RoomRequest(count), working_points(room, 60))
    poses = candidates(room, problem.points_m)
    poses = poses.take(np.random.default_rng(4).permutation(len(poses))[:number])
    views = problem.views(poses)
    best = min(
        problem.cost(views.take(list(chosen)))
        for chosen in itertools.combinations(range(number), count)
        if is_separated(poses.position_m[list(chosen)])
    )
    chosen = choose_stations(problem, views, count)
    assert problem.cost(views.take(chosen)) <= 1.05 * best
    moved = refine(problem, poses.take(chosen))
    assert problem.cost(problem.views(moved)) <= 1.05 * best


def test_stations_that_are_alike_are_not_put_into_one_place() -> None:
    """Without a smallest distance, two stations at the best place would be the best."""
    problem = PlacementProblem(FLOOR, RoomRequest(4), working_points(FLOOR, 60))
    poses = candidates(FLOOR, problem.points_m)
    chosen = choose_stations(problem, problem.views(poses), 4)
    assert is_separated(poses.position_m[chosen])
    assert is_separated(refine(problem, poses.take(chosen)).position_m)
    assert not is_separated(poses.position_m[[0, 0]] + [[0, 0, 0], [0, 0, 0.9 * MIN_SEPARATION_M]])


def test_places_that_see_two_stations_in_one_direction_are_not_covered() -> None:
    room = Room(rectangle(5.0, 2.0), 2.8, (0.0, 1.0))
    problem = PlacementProblem(room, RoomRequest(2), working_points(room, 200))
    rotation = view_rotation(np.zeros(2), np.full(2, -0.6))
    costs, missing = [], []
    for second in ([0.1, 1.0, 2.7], [0.1, 1.9, 2.7]):
        views = problem.views_of(np.array([[0.1, 1.0, 2.7], second]), rotation)
        costs.append(problem.cost(views))
        missing.append(np.clip(2 - views.is_seen.sum(axis=0), 0, 2).mean() / 2)
    # Half of a place is missing if it sees the same station twice.
    assert costs[0] > 1e3 * (missing[0] + 0.3)
    assert costs[1] < 1e3 * missing[1] + 10.0


def test_a_design_fulfils_its_promises(design: RoomDesign) -> None:
    scene, report = design.scene, design.report
    assert [station.channel for station in scene.stations] == [1, 2, 3]
    assert scene.frame_source == scene.scale == "design"
    assert scene.room is SPACE
    for station in scene.stations:
        assert np.all((station.position > 0) & (station.position < [5.0, 4.0, 2.8]))
        # Centimetres, degrees and no roll: the left side of the station is horizontal.
        assert station.position == pytest.approx(np.round(station.position, 2), abs=1e-12)
        assert station.rotation[2, 1] == pytest.approx(0.0, abs=1e-12)
        assert station.covariance is not None
    assert report.covered_fraction > 0.99
    assert np.all(report.stations_seen[report.is_covered] >= 2)
    assert np.all(report.noise_sigma_m <= report.sigma_m)
    assert report.mean_sigma_m < report.p95_sigma_m < 0.03
    # Unsolved stations are centimetres off.
    assert design.mounted_report.p95_sigma_m > 5 * report.p95_sigma_m
    assert design.is_reached
    assert sum(design.mounts.values()) == 3


def test_a_designed_scene_is_checked_like_its_design(design: RoomDesign) -> None:
    checked = check_room(design.scene)
    assert checked.sigma_m == pytest.approx(design.report.sigma_m)
    given = check_room(design.scene, given_errors=True)
    assert given.sigma_m == pytest.approx(design.mounted_report.sigma_m)
    assert np.array_equal(checked.stations_seen, design.report.stations_seen)


def test_percentile_is_over_all_places_and_infinite_if_many_are_not_covered(
    design: RoomDesign,
) -> None:
    report = design.report
    sigma = np.where(report.is_covered, report.sigma_m, np.inf)
    assert np.mean(sigma <= report.p95_sigma_m) >= 0.95
    assert np.mean(sigma < report.p95_sigma_m) < 0.95
    hidden = replace(report, is_covered=np.arange(len(sigma)) % 10 > 0)
    assert hidden.p95_sigma_m == np.inf
    assert hidden.covered_fraction == pytest.approx(0.9, abs=0.01)
    assert not hidden.is_covered[hidden.worst_points[0]]


@pytest.mark.slow
def test_the_smallest_number_of_stations_that_reaches_an_accuracy() -> None:
    one = design_room(SPACE, RoomRequest(2)).report.p95_sigma_m
    wanted = 0.8 * one
    found = design_room(SPACE, RoomRequest(None, wanted))
    assert found.is_reached
    assert found.report.p95_sigma_m <= wanted
    assert len(found.poses) > 2
    assert not found.warnings


def test_an_accuracy_that_no_room_has_is_answered_with_what_is_possible(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(placement, "MAX_STATIONS", 5)  # The search among 16 takes longer.
    room = Room(rectangle(3.0, 3.0), 2.5, (0.1, 0.1))
    found = design_room(room, RoomRequest(None, 1e-6))
    assert not found.is_reached
    assert any("not reached" in text and "places" in text for text in found.warnings)
    assert found.report.covered_fraction > 0.95


def test_one_station_in_space_is_answered_not_refused() -> None:
    found = design_room(SPACE, RoomRequest(1))
    assert found.report.covered_fraction == 0.0
    assert found.report.p95_sigma_m == np.inf
    assert any("give more stations" in text for text in found.warnings)


@pytest.mark.parametrize(
    "make",
    [
        lambda: RoomRequest(0),
        lambda: RoomRequest(17),
        lambda: RoomRequest(None),
        lambda: RoomRequest(None, -1.0),
        lambda: RoomRequest(4, min_seen=0),
        lambda: RoomRequest(4, max_range_m=0.0),
        lambda: RoomRequest(4, field_of_view_rad=(3.0, 2.2)),
        lambda: design_room(replace(FLOOR, area_m=rectangle(1, 1, (9, 9))), RoomRequest(1)),
        lambda: design_room(
            replace(FLOOR, mounts=("tripod",), tripods_m=np.array([[9.0, 0, 1]])), RoomRequest(1)
        ),
    ],
)
def test_requests_that_make_no_sense_are_refused(make: object) -> None:
    assert callable(make)
    with pytest.raises(InputError):
        make()


TRIPODS = replace(
    SPACE,
    mounts=("tripod",),
    tripods_m=np.array([[0.5, 0.5, 2.0], [4.5, 3.5, 2.0], [4.5, 0.5, 2.0]]),
)


def test_tripods_are_used_as_told() -> None:
    found = design_room(TRIPODS, RoomRequest(2))
    assert found.mounts == {"tripod": 2}
    for position in found.poses.position_m:
        assert np.min(np.linalg.norm(TRIPODS.tripods_m - position, axis=1)) < 1e-9


def test_walls_are_used_as_told() -> None:
    walls = design_room(replace(FLOOR, mounts=("wall",)), RoomRequest(1))
    x, y, _ = walls.poses.position_m[0]
    assert min(x, y, 5 - x, 4 - y) == pytest.approx(0.1)


def test_fewer_stations_are_placed_if_there_is_no_space_for_more() -> None:
    fewer = design_room(TRIPODS, RoomRequest(5))
    assert len(fewer.poses) == 3
    assert any("only 3 of 5" in text for text in fewer.warnings)


def facing_down(*places: tuple[float, float]) -> Scene:
    stations = tuple(
        station_of(channel, np.array([x, y, 2.7]), view_rotation(0.0, -np.pi / 2))
        for channel, (x, y) in enumerate(places, 1)
    )
    return Scene(stations, scale="design", frame_source="design", planar=True)


def test_best_addition_covers_what_is_hidden() -> None:
    scene = replace(facing_down((1.5, 1.5)), room=L_ROOM)
    before = check_room(scene)
    addition = best_addition(scene, L_ROOM, RoomRequest())
    assert before.covered_fraction < 0.95
    assert any("not covered" in text for text in before.warnings)
    assert addition is not None
    assert addition.station.channel == 2
    assert addition.report.covered_fraction > before.covered_fraction + 0.03
    all_channels = replace(scene, stations=tuple(replace(scene.stations[0], channel=c)
                                                 for c in range(1, 17)))  # fmt: skip
    assert best_addition(all_channels, L_ROOM, RoomRequest()) is None


def test_an_addition_that_makes_a_room_worse_is_not_named() -> None:
    """A station over a floor is solved by markers; two stations solve each other, less well."""
    scene = replace(facing_down((2.5, 2.0)), room=FLOOR)
    before, addition = check_room(scene), best_addition(scene, FLOOR, RoomRequest())
    assert before.covered_fraction > 0.99
    assert addition is None or addition.report.p95_sigma_m < 1.05 * before.p95_sigma_m


def test_places_need_as_many_stations_as_are_wanted() -> None:
    scene = facing_down((2.5, 2.0))
    assert check_room(scene, FLOOR, RoomRequest(min_seen=2)).covered_fraction == 0.0
    assert check_room(scene, FLOOR, RoomRequest(min_seen=1)).covered_fraction > 0.99


def test_a_station_that_sees_nothing_is_reported() -> None:
    scene = facing_down((2.5, 2.0))
    up = station_of(7, np.array([1.0, 1.0, 1.0]), view_rotation(0.0, np.pi / 2))
    report = check_room(replace(scene, stations=(*scene.stations, up)), FLOOR)
    assert report.station_points.tolist()[1] == 0
    assert any("station 7 sees nothing" in text for text in report.warnings)


def test_photodiodes_that_face_up_do_not_see_stations_below() -> None:
    low = station_of(1, np.array([2.5, 2.0, 0.5]), view_rotation(0.0, 0.3))
    scene = Scene((low,), scale="design", frame_source="design")
    room = replace(SPACE, photodiode_z_m=(0.8, 0.8))
    up = check_room(scene, room, RoomRequest(facing="up"))
    everywhere = check_room(scene, room, RoomRequest(facing="all"))
    assert up.stations_seen.max() == 0
    assert everywhere.stations_seen.max() == 1


def test_robots_make_a_room_less_available() -> None:
    crowded = replace(FLOOR, photodiode_z_m=(0.02, 0.02), robots=RobotSize(60, 0.1, 0.4))
    scene = facing_down((1.0, 1.0), (4.0, 3.0))
    one, two = (
        check_room(scene, crowded, RoomRequest(min_seen=count)).availability for count in (1, 2)
    )
    assert np.all(two <= one)
    assert two.min() < 0.9
    assert any("hide each other" in t for t in check_room(scene, crowded).warnings)
    assert check_room(scene, FLOOR).availability.min() == 1.0


def test_joint_covariance_of_a_solved_scene_replaces_the_prediction() -> None:
    scene = replace(facing_down((1.0, 1.0), (4.0, 3.0)), frame_source="markers", scale="markers")
    size = 2 * JOINT_PARAMETERS
    exact = check_room(replace(scene, covariance=np.zeros((size, size))), FLOOR)
    assert exact.sigma_m == pytest.approx(exact.noise_sigma_m)
    moved = np.zeros((size, size))
    both = [0, JOINT_PARAMETERS]
    moved[np.ix_(both, both)] = 0.03**2  # both stations along x, together
    report = check_room(replace(scene, covariance=moved), FLOOR)
    expected = np.hypot(report.noise_sigma_m, 0.03)
    assert report.sigma_m == pytest.approx(expected, rel=0.02)


def test_scenes_without_scale_or_floor_are_refused() -> None:
    scene = facing_down((1.0, 1.0))
    with pytest.raises(InputError, match="scale"):
        check_room(replace(scene, scale="unit"), FLOOR)
    with pytest.raises(InputError, match="floor"):
        check_room(replace(scene, frame_source="station", scale="device", planar=None))
    with pytest.raises(InputError, match="no stations"):
        check_room(Scene(), FLOOR)


def test_a_scene_without_a_room_gets_the_rectangle_around_its_stations() -> None:
    report = check_room(facing_down((1.0, 1.0), (4.0, 3.0)))
    assert any("has no room" in text for text in report.notes)
    low, high = report.points_m.min(axis=0), report.points_m.max(axis=0)
    assert np.all((low[:2] > 0.85) & (low[:2] < 1.0))
    assert np.all((high[:2] < [4.15, 3.15]) & (high[:2] > [4.0, 3.0]))


def test_places_beyond_published_recordings_are_noted() -> None:
    hall = Room(rectangle(8.0, 8.0), 6.0, (0.1, 0.1))
    station = station_of(1, np.array([4.0, 4.0, 5.9]), view_rotation(0.0, -np.pi / 2))
    report = report_room(Scene((station,), scale="design", frame_source="design"), hall)
    assert any("5 m" in text for text in report.notes)
    assert not report_room(facing_down((1.5, 2.0), (3.5, 2.0)), FLOOR).notes
    assert "markers" in report_room(facing_down((2.5, 2.0)), FLOOR).notes[0]


def test_calibration_errors_are_those_of_real_units() -> None:
    """Fit rotation, tilts and phase of each real unit to its angles over the whole beam."""
    azimuth, elevation = np.meshgrid(
        np.radians(np.linspace(-72, 72, 17)), np.radians(np.linspace(-52, 52, 13)), indexing="ij"
    )
    a, e = azimuth.ravel(), elevation.ravel()
    direction = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=1)
    generic = predict_angles(direction, GENERIC_CALIBRATION)

    def change(rotation: np.ndarray, calibration: Calibration) -> np.ndarray:
        turned = direction + np.cross(direction, rotation)
        return predict_angles(turned, calibration) - generic

    step = 1e-5
    columns = [change(step * axis, GENERIC_CALIBRATION) / step for axis in np.eye(3)]
    for plane, parameter in ((0, 1), (1, 1), (1, 0)):
        sweeps = GENERIC_CALIBRATION.sweeps.copy()
        sweeps[plane, parameter] += step
        columns.append(change(np.zeros(3), Calibration(sweeps, "generic")) / step)
    jacobian = np.stack([column.ravel() for column in columns], axis=1)
    rests = []
    for unit in FACTORY_UNITS:
        # Phase of the second sweep, then tilt, curve, gib and ogee of both sweeps.
        sweeps = np.stack([np.append(0.0, unit[1::2]), np.append(unit[0], unit[2::2])])
        error = change(np.zeros(3), Calibration(sweeps, "factory")).ravel()
        fit = np.linalg.lstsq(jacobian, error, rcond=None)[0]
        rests.append((error - jacobian @ fit).reshape(len(a), 2))
    reached = np.sqrt(np.mean(np.square(rests), axis=0))
    predicted = calibration_sigma(direction)
    assert np.median(predicted / reached) == pytest.approx(1.0, abs=0.2)
    assert np.corrcoef(predicted.ravel(), reached.ravel())[0, 1] > 0.9


def test_bill_names_every_part_and_prices_those_that_are_published() -> None:
    items = {item.part: item for item in bill_of_materials({"wall": 3, "tripod": 1}, robots=5)}
    assert items["base station"].count == 4
    assert items["base station"].amount == 800.0
    assert items["wall mount"].count == 3
    assert items["wall mount"].price is None
    assert "ceiling mount" not in items
    assert items["photodiode"].count == items["front end"].count == 5
    assert items["photodiode"].amount == pytest.approx(11.5)


def test_a_few_places_in_view_of_two_stations_are_predicted() -> None:
    """They do not determine the frame of the scene, which has more motions than they have."""
    hall = Room(rectangle(30.0, 30.0), 8.0, (1.0, 1.0))
    stations = facing_down((5.0, 5.0), (6.0, 5.0))
    room = replace(hall, photodiode_z_m=(0.0, 2.0))
    for points in ([[5.5, 5.0, 1.0]], [[5.5, 5.0, 1.0], [5.5, 5.5, 1.0]]):
        report = report_room(
            stations, room, RoomRequest(max_range_m=2.8), points_m=np.array(points)
        )
        assert np.all(report.stations_seen == 2)
        assert np.all(np.isfinite(report.sigma_m))


@pytest.mark.slow
def test_a_hall_that_is_too_large_for_its_stations_is_designed() -> None:
    everywhere = design_room(Room(rectangle(60.0, 60.0), 8.0, (0.0, 1.5)), RoomRequest(6))
    assert 0.0 < everywhere.report.covered_fraction < 0.5
