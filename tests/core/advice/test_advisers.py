"""Advice on each system, against counts and conditions that do not come from it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from locatk.core.advice import dots, landmarks, lighthouse, polaris
from locatk.core.advice.answer import SystemAdvice
from locatk.core.advice.task import Task
from locatk.core.errors import InputError
from locatk.core.polaris.design.planning import ReadingConditions
from locatk.core.polaris.design.routes import forecast_routes
from locatk.core.polaris.tag import PlanarPose, Tags
from locatk.core.routes import Route

STRAIGHT = Route(np.array([[0.0, 0.0], [6.0, 0.0]]), "aisle")
L_SHAPE = np.array([[0.0, 0.0], [6.0, 0.0], [6.0, 2.0], [2.0, 2.0], [2.0, 5.0], [0.0, 5.0]])


def failures(advice: SystemAdvice) -> set[str]:
    return {check.name for check in advice.failures}


def test_dots_cover_a_concave_area_with_the_fewest_sheets() -> None:
    advice = dots.advise(Task(outline_m=L_SHAPE), {})
    shown = advice.accuracy_map
    assert shown is not None
    # Every point of the area is on a sheet, in one of the two directions of the paper.
    rng = np.random.default_rng(0)
    points = rng.uniform([0, 0], [6, 5], (4000, 2))
    points = points[(points[:, 1] < 2) | (points[:, 0] < 2)]
    gap = np.abs(points[:, None] - shown.infrastructure_m)
    is_covered = [
        (gap <= np.array(half) + 1e-9).all(axis=2).any(axis=1).all()
        for half in ((0.4205, 0.5945), (0.5945, 0.4205))
    ]
    assert any(is_covered)
    sheets = next(item.count for item in advice.infrastructure if item.part == "printed sheet")
    assert sheets == len(shown.infrastructure_m) < 6 * 5 / (0.841 * 1.189)
    assert advice.hours == pytest.approx((15 * sheets + 120) / 60)


def test_dots_need_a_floor_that_may_be_covered_indoors_and_slow_robots() -> None:
    assert failures(dots.advise(Task(size_m=(0.5, 0.5)), {})) == set()
    task = Task(size_m=(0.5, 0.5), floor_work=frozenset({"mill"}), is_outdoor=True, speed_mps=20.0)
    assert {"floor", "indoors", "speed"} <= failures(dots.advise(task, {}))


def test_sheets_laid_by_hand_are_less_accurate_than_one_sheet() -> None:
    one, many = (dots.advise(Task(size_m=size), {}) for size in ((0.5, 0.5), (3.0, 3.0)))
    errors = [advice.check("position").expected for advice in (one, many)]  # type: ignore[union-attr]
    # The paper's largest errors on one sheet, 0.155 and 0.273 mm, are beyond 95 %.
    assert 0.1e-3 < float(errors[0]) < 0.3e-3
    assert 3e-3 < float(errors[1]) < 5e-3


def test_battery_lasts_as_long_as_in_the_paper() -> None:
    power = {power.mode: power.power_w for power in dots.advise(Task(), {}).power}
    assert 0.6 * 3.7 / power["moving"] == pytest.approx(2.54, abs=0.01)  # "more than 2.5 hours"


def test_polaris_forecast_holds_for_the_tags_that_are_counted() -> None:
    task = Task(routes=(STRAIGHT,), size_m=(6.0, 1.0), position_m=0.008, speed_mps=0.2)
    advice = polaris.advise(task, {})
    shown = advice.accuracy_map
    assert shown is not None
    assert failures(advice) == set()
    assert {item.part for item in advice.robot_parts} == {"magnetometer", "microcontroller"}
    assert "disc magnet" in {item.part for item in advice.infrastructure}
    assert "magnetometer" not in {item.part for item in advice.infrastructure}
    tags = Tags(
        clearance_m=task.clearance_m,
        site={k: PlanarPose(x, y, 0.0) for k, (x, y) in enumerate(shown.infrastructure_m.tolist())},
    )
    forecast = forecast_routes(tags, [STRAIGHT], ReadingConditions(speed_mps=0.2))
    assert forecast.tags == len(shown.infrastructure_m)
    assert forecast.position_p95_m <= task.position_m
    # Half of the tags, every second one, are not enough.
    sparse = replace(tags, site=dict(list(tags.site.items())[::2]))
    wide = forecast_routes(sparse, [STRAIGHT], ReadingConditions(speed_mps=0.2))
    assert wide.position_p95_m > task.position_m


@pytest.mark.slow
def test_polaris_needs_routes_odometry_and_a_floor_without_plates() -> None:
    task = Task(routes=(STRAIGHT,), position_m=0.02)
    assert failures(polaris.advise(task, {})) == set()
    assert failures(polaris.advise(replace(task, routes=()), {})) == {"coverage"}
    assert "iron" in failures(polaris.advise(replace(task, iron="plates"), {}))
    assert "odometry" in failures(polaris.advise(replace(task, has_odometry=False), {}))
    assert "floor" in failures(polaris.advise(replace(task, floor_work=frozenset()), {}))
    assert "robots in space" in failures(polaris.advise(replace(task, is_flying=True), {}))


def test_a_route_that_takes_too_many_tags_has_no_accuracy() -> None:
    lanes = [[x, float(y)] for y in range(101) for x in ((0.0, 100.0), (100.0, 0.0))[y % 2]]
    task = Task(size_m=(100.0, 100.0), routes=(Route(np.array(lanes)),))
    advice = polaris.advise(task, {})
    assert {"position", "coverage", "tags"} <= failures(advice)
    remedy = advice.check("coverage").remedy  # type: ignore[union-attr]
    assert "--route" not in remedy
    assert remedy


def test_a_hall_beyond_the_range_of_all_stations_is_refused_at_once() -> None:
    with pytest.raises(InputError, match="16 stations cover at most 2463 m2"):
        lighthouse.advise(Task(size_m=(100.0, 100.0)), {})


def test_accuracy_below_the_bound_is_answered_with_what_would_have_to_change() -> None:
    advice = polaris.advise(Task(routes=(STRAIGHT,), position_m=1e-4), {})
    check = advice.check("position")
    assert check is not None
    assert check.is_met is False
    assert "survey" in check.remedy


@pytest.mark.slow
def test_lighthouse_reaches_the_accuracy_with_more_stations() -> None:
    coarse, fine = (
        lighthouse.advise(Task(size_m=(6.0, 6.0), position_m=error), {}) for error in (0.02, 0.006)
    )
    counts = [
        next(item.count for item in advice.infrastructure if item.part == "base station")
        for advice in (coarse, fine)
    ]
    assert counts[0] < counts[1]
    for advice, wanted in ((coarse, 0.02), (fine, 0.006)):
        check = advice.check("position")
        assert check is not None
        assert check.is_met
        assert float(check.expected) <= wanted


@pytest.mark.slow
def test_lighthouse_fails_outdoors_and_in_the_sun() -> None:
    task = Task(size_m=(3.0, 3.0), position_m=0.02, is_outdoor=True, infrared="sun")
    assert {"indoors", "light"} == failures(lighthouse.advise(task, {}))


@pytest.mark.slow
def test_lighthouse_without_walls_stands_on_tripods() -> None:
    advice = lighthouse.advise(Task(size_m=(4.0, 4.0), may_use_ceiling=False), {})
    assert "tripod" in advice.design
    assert "tripod mount" in {item.part for item in advice.infrastructure}


@pytest.mark.slow
def test_landmarks_are_as_far_apart_as_the_accuracy_allows() -> None:
    fine, coarse = (
        landmarks.advise(Task(size_m=(2.0, 2.0), position_m=error), {}) for error in (0.008, 0.05)
    )
    counts = [
        next(item.count for item in advice.infrastructure if item.part == "bar magnet") / 4
        for advice in (fine, coarse)
    ]
    assert counts[0] > counts[1] >= 9
    for advice, wanted in ((fine, 0.008), (coarse, 0.05)):
        check = advice.check("position")
        assert check is not None
        assert float(check.expected) <= wanted
    assert fine.hours == pytest.approx((counts[0] * 6 + 120) / 60)


@pytest.mark.slow
def test_landmarks_in_pockets_need_no_clearance_over_the_bars() -> None:
    task = Task(size_m=(0.4, 0.4), position_m=0.05, clearance_m=0.005)
    assert "floor" in failures(landmarks.advise(task, {}))
    milled = replace(task, floor_work=frozenset({"mill"}))
    assert "floor" not in failures(landmarks.advise(milled, {}))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"size_m": (-1.0, 2.0)}, "side"),
        ({"size_m": (4000.0, 2.0)}, "side"),
        ({"position_m": 0.0}, "position"),
        ({"position_m": 100.0}, "position"),
        ({"heading_rad": 4.0}, "heading"),
        ({"robots": 0}, "robots"),
        ({"infrared": "much"}, "infrared"),
        ({"budget": -1.0}, "budget"),
        ({"height_m": math.nan}, "height"),
        ({"outline_m": np.array([[0, 0], [1, 1], [1, 0], [0, 1.0]])}, "crosses"),
    ],
)
def test_impossible_values_are_refused_with_a_hint(values: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        Task(**values)  # type: ignore[arg-type]
    assert caught.value.hint
