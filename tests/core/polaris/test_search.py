"""Search for designs of tags: against an exhaustive one, and its answers to impossible wishes."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from locatk.core.errors import InputError
from locatk.core.polaris import codec
from locatk.core.polaris.codec import families
from locatk.core.polaris.design.planning import ReadingConditions, evaluate_design
from locatk.core.polaris.design.search import (
    STOCKED_DISCS,
    SearchSpace,
    search_designs,
    stocked_magnets,
)
from locatk.core.polaris.simulation.options import SimulationOptions, usual_bar
from locatk.core.polaris.simulation.session import simulate
from locatk.core.polaris.solver import solve
from locatk.core.polaris.tag import Magnet, Tags

SMALL = SearchSpace(
    magnets=(Magnet(),), counts=(3, 4, 5), orders=(2, 3), orientations=(4, 8), spacing_m=0.03
)


def is_enough(tags: Tags, count: int, position_m: float, heading_rad: float) -> bool:
    """Evaluate one design by the report of ``tag design``."""
    report = evaluate_design(tags)
    placed = report.placed
    # The quantiles of equal axes; those of the report differ by little.
    position = 2.448 * math.hypot(placed.pose_x_m, placed.pose_y_m) / math.sqrt(2)
    heading = 1.96 * placed.pose_heading_rad
    if report.warnings or position > 1.02 * position_m or heading > 1.02 * heading_rad:
        return False
    return codec.capacity(tags) >= count


@pytest.mark.slow
@pytest.mark.parametrize(("count", "position_m", "heading_rad"), [(60, 6e-4, 0.02), (9, 1e-3, 1.0)])
def test_no_cheaper_design_is_enough(count: int, position_m: float, heading_rad: float) -> None:
    (best,) = search_designs(count, position_m, heading_rad, space=SMALL).designs
    assert best.position_p95_m <= position_m
    assert best.heading_p95_rad <= heading_rad
    assert is_enough(best.tags, count, position_m, heading_rad)
    for magnets, order, orientations in itertools.product((3, 4, 5), (2, 3), (4, 8)):
        tags = replace(best.tags, magnets=magnets, order=order, orientations=orientations)
        is_cheaper = (magnets, order) < (best.tags.magnets, best.tags.order)
        if not is_cheaper or magnets > order**2 - 1:
            continue
        assert not is_enough(tags, count, 0.96 * position_m, 0.96 * heading_rad)


def test_all_designs_of_a_search_can_be_made() -> None:
    space = SearchSpace(magnets=stocked_magnets()[1:3], clearance_m=(0.008, 0.012))
    found = search_designs(50, 1e-3, math.radians(0.6), space=space, min_distance=3)
    assert len(found.designs) == 2
    keys = [(each.tags.magnets, each.side_m) for each in found.designs]
    assert keys == sorted(keys)
    for design in found.designs:
        tags = design.tags
        assert 0.008 <= tags.clearance_m <= 0.012
        assert len(families.generate_family(tags, 50, 3)) == 50
        assert not evaluate_design(tags).warnings


@pytest.mark.slow
def test_a_design_that_was_found_is_read_as_accurately_as_forecast() -> None:
    """Passes over cylinders that were set by hand, at twice the clearance of the paper."""
    space = SearchSpace(magnets=stocked_magnets()[3:4], clearance_m=(0.02, 0.02))
    (best,) = search_designs(200, 1e-3, space=space, min_distance=2).designs
    tags = replace(best.tags, ids=families.generate_family(best.tags, 200, 2), min_distance=2)
    errors = []
    for seed in range(6):
        assert tags.ids is not None
        tag_id = tags.ids[31 * seed]
        options = SimulationOptions(
            array=usual_bar(rate_hz=60.0, noise_t=None), rate_hz=60.0, route=(tag_id,), seed=seed,
            build_place_m=4e-4, build_angle_rad=math.radians(6), build_seed=seed,
        )  # fmt: skip
        session = simulate(tags, options)
        (tag,) = solve([session.samples], tags).detections
        assert tag.tag_id == tag_id
        truth = session.truth
        row = int(np.abs(truth.time_ns * 1e-9 - tag.time_s).argmin())
        errors.append([tag.y_m, tag.heading_rad])
        assert abs(float(truth.position[row, 1])) < 1e-9
    lateral_m, heading_rad = np.sqrt(np.mean(np.square(np.array(errors, float)), axis=0))
    assert 0.3 * best.position_p95_m < 2.448 * lateral_m < 1.5 * best.position_p95_m
    assert 0.3 * best.heading_p95_rad < 1.96 * heading_rad < 1.7 * best.heading_p95_rad


def test_impossible_wishes_are_answered() -> None:
    space = replace(SMALL, orders=(3,))
    vague = search_designs(9, 1e-5, space=space)
    assert not vague.designs
    assert vague.closest is not None
    assert "locatk calibrate tag" in vague.reason
    far = search_designs(9, space=replace(space, clearance_m=(0.1, 0.1), spacing_m=0.2))
    assert far.closest is None
    assert "too weak" in far.reason
    many = search_designs(10**9, space=space)
    assert "no code" in many.reason
    fast = search_designs(9, use=ReadingConditions(speed_mps=1000.0), space=space)
    assert "at this speed" in fast.reason
    short = search_designs(9, use=ReadingConditions(sensors=2), space=space)
    assert "below the array" in short.reason
    for call in (
        lambda: search_designs(0),
        lambda: search_designs(9, -1.0),
        lambda: search_designs(9, space=SearchSpace(clearance_m=(0.02, 0.01))),
    ):
        with pytest.raises(InputError):
            call()


def test_stocked_discs_have_known_grades() -> None:
    assert [magnet.grade for magnet in stocked_magnets()] == [disc[2] for disc in STOCKED_DISCS]
    moments = [magnet.moment for magnet in stocked_magnets()]
    assert moments == sorted(moments)


def test_more_tags_than_a_family_can_have_are_answered_at_once() -> None:
    found = search_designs(10**6)
    assert (found.designs, found.closest) == ((), None)
    assert "at most 524288 tags" in found.reason


def test_a_family_of_distance_1_needs_no_search(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(families, "generate_family", None)
    assert search_designs(300, space=SMALL).designs
