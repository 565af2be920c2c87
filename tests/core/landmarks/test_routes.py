"""Routes over a landmark map: what is read, where the robot is localized, and what would help."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.errors import InputError
from locatk.core.landmarks.design.generation import DesignOptions, design_map
from locatk.core.landmarks.design.routes import (
    best_shift,
    check_routes,
    count_matching_poses,
    find_visits,
    forecast_floor,
    max_pass_offset,
)
from locatk.core.landmarks.design.visit_accuracy import VisitErrors
from locatk.core.landmarks.landmark import PATTERN_OF, Geometry, rotated
from locatk.core.landmarks.map.floor import HOLE_CODE, AsBuiltLandmark, FloorMap
from locatk.core.routes import Route
from locatk.core.streaming.planar_filter import OdometryNoise

FLOOR = design_map(DesignOptions(7, 9))


def route(*points: tuple[float, float], name: str = "drive") -> Route:
    return Route(np.array(points), name)


def places_by_hand(floor: FloorMap, cells: list[tuple[int, int]]) -> int:
    """Places and headings of a map that read the same along a path, one after the other."""

    def letter(cell: tuple[int, int], quarters: int) -> int | None:
        row, column = cell
        if not (0 <= row < floor.shape[0] and 0 <= column < floor.shape[1]):
            return None
        code = int(floor.codes[cell])
        if code == HOLE_CODE:
            return None
        return int(PATTERN_OF[code] if floor.alphabet == "6" else rotated(code, -quarters))

    count = 0
    for row in range(floor.shape[0]):
        for column in range(floor.shape[1]):
            for quarters in range(4):
                is_same = True
                for cell in cells:
                    offset = complex(cell[1] - cells[0][1], cell[0] - cells[0][0]) * 1j**quarters
                    there = (row + round(offset.imag), column + round(offset.real))
                    is_same &= letter(there, quarters) == letter(cell, 0)
                count += is_same
    return count


@settings(deadline=None, max_examples=40)
@given(st.data())
def test_places_are_those_of_a_walk(data) -> None:
    shape = data.draw(st.tuples(st.integers(2, 5), st.integers(2, 5)))
    codes = np.array(
        data.draw(
            st.lists(
                st.sampled_from([HOLE_CODE, 5, 7, 11, 15]),
                min_size=shape[0] * shape[1],
                max_size=shape[0] * shape[1],
            )
        )
    ).reshape(shape)
    floor = FloorMap(codes, alphabet=data.draw(st.sampled_from(["6", "16"])))
    cells = floor.cells()
    if not cells:
        return
    path = data.draw(st.lists(st.sampled_from(cells), min_size=1, max_size=4, unique=True))
    counts = count_matching_poses(floor, path)
    assert counts.tolist() == [places_by_hand(floor, path[: k + 1]) for k in range(len(path))]


def test_landmarks_on_and_beside_a_route_are_found() -> None:
    visits = find_visits(FLOOR, route((-0.2, 0.22), (1.0, 0.22)), is_smoothed=True)
    assert [visit.cell for visit in visits] == [(1, column) for column in range(6)]
    np.testing.assert_allclose([visit.offset_m for visit in visits], 0.02, atol=1e-6)
    np.testing.assert_allclose(
        [visit.distance_m for visit in visits], 0.2 + 0.2 * np.arange(6), atol=2e-3
    )
    assert all(visit.is_read for visit in visits)


def test_live_fix_is_where_the_robot_leaves_the_landmark() -> None:
    path = route((-0.2, 0.2), (1.0, 0.2))
    live, smoothed = (find_visits(FLOOR, path, is_smoothed=flag) for flag in (False, True))
    for late, at in zip(live[:-1], smoothed[:-1], strict=True):
        assert 0.03 < late.fix.distance_m - at.fix.distance_m < 0.09
        assert late.distance_m == at.distance_m
    assert np.trace(live[2].fix.covariance) > np.trace(smoothed[2].fix.covariance)


def test_robot_is_localized_at_the_first_unique_landmark() -> None:
    check = check_routes(FLOOR, [route((0.0, 0.2), (1.2, 0.2))])[0]
    cells = [visit.cell for visit in check.visits]
    counts = [places_by_hand(FLOOR, cells[: k + 1]) for k in range(len(cells))]
    assert check.localized_after == counts.index(1) + 1
    assert check.final_after is not None
    assert check.final_after > check.localized_after
    assert check.localized_m == check.visits[check.localized_after - 1].fix.distance_m
    known = np.isfinite(check.accuracy.position_rms_m)
    assert known[check.accuracy.distance_m > check.localized_m].all()
    assert not known[check.accuracy.distance_m < check.localized_m - 1e-9].any()
    assert check.covered_fraction == pytest.approx(1 - check.localized_m / 1.2, abs=0.01)
    assert not check.warnings


def test_route_between_rows_is_not_localisable_and_its_remedy_works() -> None:
    path = route((0.0, 0.1), (1.2, 0.1), name="between")
    check = check_routes(FLOOR, [path])[0]
    assert not check.visits
    assert not check.is_localizable
    assert math.isnan(check.position_sigma_m)
    assert check.covered_fraction == 0
    assert "shift the route by 0 mm in x and -100 mm in y" in check.warnings[0]
    shift = best_shift(FLOOR, path, max_pass_offset(FLOOR.geometry))
    assert shift is not None
    moved = Route(path.waypoint_m + [shift.x_m, shift.y_m])
    assert check_routes(FLOOR, [moved])[0].is_localizable


def test_hole_is_named_and_filling_it_helps() -> None:
    codes = FLOOR.codes.copy()
    codes[3, 2:7] = HOLE_CODE
    floor = replace(FLOOR, codes=codes)
    path = route((0.0, 0.6), (1.6, 0.6))
    check = check_routes(floor, [path], wanted_position_m=5e-3)[0]
    assert "add a landmark at 3,4" in check.warnings[0]
    codes = codes.copy()
    codes[3, 4] = FLOOR.codes[3, 4]
    better = check_routes(replace(floor, codes=codes), [path])[0]
    assert better.longest_without_fix_m < 0.7 * check.longest_without_fix_m


def test_route_off_the_map_is_told_apart_from_a_hole() -> None:
    check = check_routes(FLOOR, [route((5.0, 5.0), (7.0, 5.0))])[0]
    assert "leaves the map (x 0 to 1.6 m, y 0 to 1.2 m)" in check.warnings[0]


def test_few_landmarks_leave_other_places() -> None:
    check = check_routes(FLOOR, [route((0.1, 0.2), (0.3, 0.2))])[0]
    assert len(check.visits) == 1
    others = places_by_hand(FLOOR, [check.visits[0].cell]) - 1
    assert check.ambiguous_places == others > 0
    assert f"{others} other places" in check.warnings[0]


def test_bad_odometry_does_not_connect_landmarks() -> None:
    path = route((0.0, 0.2), (1.2, 0.2))
    good = check_routes(FLOOR, [path])[0]
    bad = check_routes(FLOOR, [path], OdometryNoise(distance_m=0.2))[0]
    assert good.is_localizable
    assert not bad.is_localizable


def test_grazed_landmarks_are_not_read_but_named() -> None:
    path = route((0.0, 0.2), (0.5, 0.2), (0.5, 0.27), (1.2, 0.27))
    errors = VisitErrors(noise_t=4e-4)
    check = check_routes(FLOOR, [path], errors=errors)[0]
    grazed = [visit.cell for visit in check.visits if not visit.is_read]
    assert grazed
    assert all(cell[0] == 1 and cell[1] >= 3 for cell in grazed)
    limit_m = max_pass_offset(FLOOR.geometry, errors=errors)
    assert limit_m < min(0.07, max_pass_offset(FLOOR.geometry))
    assert f"{grazed[0][0]},{grazed[0][1]} at 70 mm" in check.notes[0]
    assert f"within {1e3 * limit_m:.0f} mm" in check.notes[0]


def test_accuracy_that_is_not_reached_is_a_warning() -> None:
    path = route((0.0, 0.2), (1.2, 0.2))
    check = check_routes(FLOOR, [path], wanted_position_m=1e-3, wanted_heading_rad=1e-3)[0]
    assert len(check.warnings) == 2
    assert "position error" in check.warnings[0]
    assert "heading error" in check.warnings[1]
    assert not check_routes(FLOOR, [path], wanted_position_m=0.1)[0].warnings


def test_measured_landmarks_are_more_accurate_and_missing_bars_count() -> None:
    sigma = np.array([2e-4, 2e-4, 2e-3, 0.01, 0.01, 0.01, 0.01])
    built = {
        cell: AsBuiltLandmark(0.0, 0.0, 0.0, np.full(4, np.nan), sigma) for cell in FLOOR.cells()
    }
    path = route((0.0, 0.2), (1.2, 0.2))
    nominal, measured = (
        check_routes(floor, [path], is_smoothed=True)[0]
        for floor in (FLOOR, replace(FLOOR, built=built))
    )
    assert measured.position_sigma_m < 0.5 * nominal.position_sigma_m
    broken = dict(built)
    broken[(1, 2)] = replace(built[(1, 2)], strength=np.zeros(4))
    check = check_routes(replace(FLOOR, built=broken), [path])[0]
    assert (1, 2) not in [visit.cell for visit in check.visits]


def test_landmark_that_is_visited_twice_counts_its_installation_once() -> None:
    errors = VisitErrors(landmark_position_m=5e-3, landmark_heading_rad=0.0)
    path = route((0.3, 0.2), (0.5, 0.2), (0.3, 0.2 + 1e-3))
    first, second = (
        visit
        for visit in find_visits(FLOOR, path, errors=errors, is_smoothed=True)
        if visit.cell == (1, 2)
    )
    joint = np.linalg.inv(
        np.linalg.inv(first.fix.covariance) + np.linalg.inv(second.fix.covariance)
    )
    assert joint[0, 0] >= 0.98 * errors.landmark_position_m**2


def test_offline_estimates_are_better_than_live_ones() -> None:
    path = route((0.0, 0.0), (1.6, 1.2), (0.0, 1.2))
    live, offline = (check_routes(FLOOR, [path], is_smoothed=flag)[0] for flag in (False, True))
    assert offline.position_sigma_m < live.position_sigma_m
    assert offline.covered_fraction == pytest.approx(1.0)


def test_no_landmarks_at_all() -> None:
    floor = replace(FLOOR, codes=np.full((3, 3), HOLE_CODE))
    check = check_routes(floor, [route((0.0, 0.0), (0.4, 0.0))])[0]
    assert not check.is_localizable
    assert "add a landmark at 0,1" in check.warnings[0]


def test_unusable_requests_are_refused() -> None:
    with pytest.raises(InputError, match="speed"):
        check_routes(FLOOR, [route((0.0, 0.0), (1.0, 0.0))], speed_mps=0.0)
    with pytest.raises(InputError, match="long"):
        check_routes(FLOOR, [route((0.0, 0.0), (1e5, 0.0))])
    with pytest.raises(InputError, match="pitch"):
        forecast_floor(Geometry(), 0.0)


def test_forecast_gets_worse_with_the_pitch() -> None:
    near, far = (forecast_floor(Geometry(), pitch_m, routes=5) for pitch_m in (0.2, 0.4))
    assert near.position_at_p95_m < near.position_p95_m < far.position_p95_m
    assert near.without_fix_p95_m < far.without_fix_p95_m
    assert near.landmarks_per_m > far.landmarks_per_m
    assert near.read_fraction > 0.8
