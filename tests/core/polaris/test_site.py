"""Sites of tags: points, unique ids, and the findings of the check."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from locatk.core import polaris
from locatk.core.errors import InputError
from locatk.core.polaris.codec import families
from locatk.core.polaris.design.planning import ReadingConditions
from locatk.core.polaris.design.site import (
    MAX_SITE_TAGS,
    SitePoint,
    check_site,
    grid_points,
    pass_separation,
    place_tags,
    route_points,
)
from locatk.core.polaris.simulation.options import SimulationOptions, usual_bar
from locatk.core.polaris.simulation.session import simulate
from locatk.core.polaris.tag import Magnet, PlanarPose, Tags

FAMILY = (5, 77, 1234, 9)


def positions(points: list[SitePoint]) -> np.ndarray:
    return np.array([[point.x_m, point.y_m] for point in points])


# ---- points


def test_a_grid_is_row_by_row_from_its_origin() -> None:
    points = grid_points(2, 3, 0.5, (1.0, -1.0), 0.3)
    expected = [(1.0, -1.0), (1.5, -1.0), (2.0, -1.0), (1.0, -0.5), (1.5, -0.5), (2.0, -0.5)]
    np.testing.assert_allclose(positions(points), expected)
    assert {point.heading_rad for point in points} == {0.3}
    with pytest.raises(InputError, match=f"more than {MAX_SITE_TAGS} tags"):
        grid_points(2000, 2000, 0.5)


def test_a_route_has_a_tag_at_each_waypoint_and_no_larger_gap() -> None:
    corners = [(0.0, 0.0), (2.0, 0.0), (2.0, 1.0)]
    waypoints = [SitePoint(x, y, name=f"line {k}") for k, (x, y) in enumerate(corners)]
    waypoints[1] = replace(waypoints[1], tag_id=7, meaning="turn")
    points, left_out = route_points(waypoints, 0.7)
    assert left_out == 0
    expected = [(0, 0), (2 / 3, 0), (4 / 3, 0), (2, 0), (2, 0.5), (2, 1)]
    np.testing.assert_allclose(positions(points), expected)
    headings = [0, 0, 0, math.pi / 2, math.pi / 2, math.pi / 2]
    assert [point.heading_rad for point in points] == pytest.approx(headings)
    assert [point.tag_id for point in points] == [None, None, None, 7, None, None]
    assert points[3].meaning == "turn"
    # A distance that divides the segment exactly has no further point.
    assert len(route_points(waypoints[:2], 0.5)[0]) == 5


def test_a_route_that_returns_has_one_tag_at_each_position() -> None:
    corners = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0), (0.0, 0.01)]
    waypoints = [SitePoint(x, y, name=f"line {k}") for k, (x, y) in enumerate(corners)]
    points, left_out = route_points(waypoints, 5.0, 0.12)
    assert (len(points), left_out) == (4, 1)


def test_routes_that_are_refused() -> None:
    one = SitePoint(0.0, 0.0, name="line 2")
    with pytest.raises(InputError, match="a route of one point"):
        route_points([one], 1.0)
    with pytest.raises(InputError, match="line 3: the position of the previous"):
        route_points([one, replace(one, name="line 3")], 1.0)
    with pytest.raises(InputError, match="more than"):
        route_points([one, replace(one, x_m=1e4)], 1e-3)


# ---- ids


def test_ids_of_the_family_in_its_order() -> None:
    tags = Tags(ids=FAMILY, meanings={77: "stop", 9: "spare"})
    points = [SitePoint(0.1 + 0.2, 0.0), SitePoint(1.0, 0.0, 0.5, 5, "start"), SitePoint(2.0, 0.0)]
    site = place_tags(tags, points)
    assert site.ids == FAMILY
    assert site.site == {
        5: PlanarPose(1.0, 0.0, 0.5),
        77: PlanarPose(0.3, 0.0, 0.0),
        1234: PlanarPose(2.0, 0.0, 0.0),
    }
    assert site.meanings == {5: "start", 77: "stop"}


def test_a_family_is_generated_if_there_is_none() -> None:
    site = place_tags(Tags(), grid_points(3, 4, 1.0), 3)
    assert site.ids is not None
    assert len(set(site.ids)) == len(site.site) == 12
    assert site.min_distance == 3
    families.check_family(site)
    points = [SitePoint(0.0, 0.0, tag_id=0), *grid_points(1, 5, 1.0)]
    with_given = place_tags(Tags(), points, 3)
    families.check_family(with_given)
    assert 0 in with_given.site
    assert len(with_given.site) == 6
    only_given = place_tags(Tags(), [SitePoint(0.0, 0.0, tag_id=k) for k in (3, 4)], 3)
    assert only_given.ids == (3, 4)
    families.check_family(only_given)


@pytest.mark.parametrize(
    ("points", "words"),
    [
        ([], "no positions"),
        ([SitePoint(0, 0, 0, 5, "", "a"), SitePoint(1, 0, 0, 5, "", "b")], "b: id 5 is also at a"),
        ([SitePoint(0, 0, 0, 327_680, "", "a")], "a: 327680 is not an id"),
        ([SitePoint(0, 0, 0, 6, "", "a")], "a: id 6 is not in the family"),
        (grid_points(1, 5, 1.0), "5 positions, but only 4 ids"),
    ],
)
def test_ids_that_are_refused(points: list[SitePoint], words: str) -> None:
    with pytest.raises(InputError, match=words):
        place_tags(Tags(ids=FAMILY), points)


# ---- check


def codes(tags: Tags, **more: object) -> list[str]:
    return [finding.code for finding in check_site(tags, **more).findings]  # type: ignore[arg-type]


def test_a_site_without_findings() -> None:
    report = check_site(place_tags(Tags(), grid_points(2, 3, 0.5)), bounds_m=(-0.1, -0.1, 2, 2))
    assert report.findings == ()
    assert report.tags == 6
    np.testing.assert_allclose([report.low_m, report.high_m], [[-0.04, -0.04], [1.04, 0.54]])
    assert report.nearest_m == pytest.approx(0.5)
    assert 0.16 < report.separation_m < 0.3
    assert report.shared_passes == 0
    with pytest.raises(InputError, match="no tag has a position"):
        check_site(Tags())
    alone = check_site(place_tags(Tags(), [SitePoint(0.0, 0.0)]))
    assert math.isnan(alone.nearest_m)
    assert alone.findings == ()


def test_findings() -> None:
    row = place_tags(Tags(), grid_points(1, 3, 0.2))
    report = check_site(row)
    (finding,) = report.findings
    assert finding.code == "row"
    assert finding.ids[1] == next(k for k, pose in row.site.items() if pose.x_m == 0.2)
    assert f"{1e3 * report.separation_m:.6g} mm apart" in finding.message
    assert report.shared_passes == 2
    # Two tags in a pass are read, and so are three round a corner.
    assert codes(place_tags(Tags(), grid_points(1, 2, 0.2))) == []
    corner = [SitePoint(0.0, 0.0), SitePoint(0.2, 0.0), SitePoint(0.2, 0.2)]
    assert codes(place_tags(Tags(), corner)) == []
    assert codes(place_tags(Tags(), grid_points(1, 2, 0.06))) == ["overlap"]
    both = check_site(place_tags(Tags(ids=FAMILY), [SitePoint(0.0, 0.0), SitePoint(0.0, 0.0)]))
    assert (both.nearest_m, both.nearest_ids) == (0.0, (5, 77))
    assert [finding.code for finding in both.findings] == ["overlap"]
    single = place_tags(Tags(), [SitePoint(0.0, 0.0)])
    (finding,) = check_site(single, bounds_m=(-0.035, -1, 1, 1)).findings
    assert (finding.code, finding.message) == ("out_of_bounds", "tag 0 is 5 mm out of bounds")
    assert codes(replace(single, meanings={0: "here", 9: "gone"})) == ["meaning"]
    assert codes(replace(single, clearance_m=0.1)) == ["no_pass"]


def test_separation_grows_with_field_and_speed() -> None:
    usual = pass_separation(Tags())
    assert pass_separation(Tags(magnet=Magnet(diameter_m=6e-3, height_m=3e-3))) > usual + 0.02
    assert pass_separation(Tags(), ReadingConditions(speed_mps=0.4)) > usual + 0.05
    assert pass_separation(Tags(), ReadingConditions(noise_t=1e-5)) < usual


@pytest.mark.slow
def test_tags_at_the_separation_are_separate_passes() -> None:
    """Fields of cylinders with noise: five tags in a row are read, but not when they are near."""
    conditions = ReadingConditions(rate_hz=60.0, noise_t=1e-6)
    separation_m = pass_separation(Tags(), conditions)
    bar = usual_bar(noise_t=1e-6)
    for ratio, is_read in ((1.0, True), (0.85, False)):
        site = place_tags(Tags(), grid_points(1, 5, ratio * separation_m))
        route = tuple(sorted(site.site, key=lambda tag_id: site.site[tag_id].x_m))
        options = SimulationOptions(
            route=route, array=bar, rate_hz=60.0, heading_rad=0.0, run_up_m=0.3, seed=1
        )
        session = simulate(site, options)
        found = polaris.solve([session.samples], site).detections
        assert (tuple(each.tag_id for each in found) == route) == is_read
