"""Tags on the map of a picture: magnets where they lie and where they were found."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.quiver import Quiver
from matplotlib.text import Text

from locatk.core.geometry import Similarity, quaternion_from_heading
from locatk.core.polaris.codec import layout_of
from locatk.core.polaris.results import MagnetDetection, TagDetection
from locatk.core.polaris.tag import AsBuiltTag, PlanarPose, Tags, as_built_magnets
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory
from locatk.formats.plots.solution import draw
from locatk.formats.plots.tags import tags_of

ID = 4711
BUILT = Tags(built={ID: AsBuiltTag(np.full((5, 2), 1e-3), np.full(5, 0.1), 3)})


def detection(tags: Tags, x: float, y: float, heading: float) -> TagDetection:
    """The tag seen at that pose, without error."""
    place, angle = as_built_magnets(tags, ID, layout_of(tags, ID))
    c, s = math.cos(heading), math.sin(heading)
    place = place @ np.array([[c, s], [-s, c]]) + [x, y]
    magnets = tuple(
        MagnetDetection(px, py, a, 0, (0, 0), 1e-4, 1e-4, 1e-2, 1e-3)
        for (px, py), a in zip(place.tolist(), (angle + heading).tolist(), strict=True)
    )
    return TagDetection(
        time_s=1.0,
        device="bar",
        tag_id=ID,
        margin=1.0,
        refused=None,
        x_m=x,
        y_m=y,
        heading_rad=heading,
        sigma_x_m=1e-4,
        sigma_y_m=1e-4,
        sigma_heading_rad=1e-3,
        array_pose=PlanarPose(-c * x - s * y, s * x - c * y, -heading),
        magnets=magnets,
        residual_sigma=1.0,
        height_m=0.01,
        speed_mps=0.1,
        scale=1.0,
        corrected=0,
        erased=0,
        other_sources=0,
    )


def solution(tags: Tags, frame: str, n: int = 20) -> Solution:
    track = Trajectory(
        "bar",
        frame,
        1_000_000_000 + 10_000_000 * np.arange(n),
        np.column_stack([np.linspace(-0.1, 0.1, n), np.zeros(n), np.full(n, 0.01)]),
        quaternion_from_heading(np.zeros(n)),
        np.broadcast_to(np.eye(6) * 1e-8, (n, 6, 6)),
    )
    unread = replace(detection(tags, 9.0, 9.0, 0.0), tag_id=None)
    return Solution(
        "polaris", "joint", (track,), {}, (detection(tags, 0.02, -0.01, 0.7), unread), tags
    )


@pytest.mark.parametrize("placed", [None, PlanarPose(1.2, -0.3, 2.5)])
def test_magnets_were_found_where_they_lie(placed: PlanarPose | None) -> None:
    tags = BUILT if placed is None else replace(BUILT, site={ID: placed})
    frame = f"tag-{ID}" if placed is None else "site"
    (tag,) = tags_of(solution(tags, frame))
    assert tag.name == f"tag {ID}"
    (found,) = tag.found  # what was not read belongs to no tag
    np.testing.assert_allclose(found.tail, tag.known.tail, atol=1e-12)
    np.testing.assert_allclose(found.tip, tag.known.tip, atol=1e-12)
    if placed is not None:
        assert np.linalg.norm(tag.known.tail.mean(axis=0)[:2] - [1.2, -0.3]) < 0.05


def test_tags_move_with_the_alignment() -> None:
    (tag,) = tags_of(solution(BUILT, f"tag-{ID}"))
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    moved = tag.moved(Similarity(1.0, turn, np.array([1.0, 2, 0])))
    np.testing.assert_allclose(moved.known.tail, tag.known.tail @ turn.T + [1, 2, 0])
    np.testing.assert_allclose(
        moved.known.tip - moved.known.tail, (tag.known.tip - tag.known.tail) @ turn.T, atol=1e-15
    )


def test_the_map_shows_all_magnets() -> None:
    figure = draw(solution(BUILT, f"tag-{ID}"))
    ground = figure.axes[0]
    known, found = figure.findobj(Quiver)
    place = 1e3 * as_built_magnets(BUILT, ID, layout_of(BUILT, ID))[0]  # a small map is in mm
    np.testing.assert_allclose(known.XY, place)
    np.testing.assert_allclose(found.XY, place)
    assert ground.get_xlabel() == "x [mm]"
    (left, right), (low, high) = ground.get_xlim(), ground.get_ylim()
    assert left < place[:, 0].min() < place[:, 0].max() < right
    assert low < place[:, 1].min() < place[:, 1].max() < high
    words = {text.get_text() for text in figure.findobj(Text)}
    assert {f"tag {ID}", "magnet", "as found"} <= words


def test_a_solution_without_poses_shows_the_site() -> None:
    empty = replace(solution(BUILT, "site", n=0), trajectories=(), detections=())
    assert tags_of(empty) == ()
    site = replace(empty, artifact=replace(BUILT, site={ID: PlanarPose(3.0, 4.0, 0.0)}))
    ground = draw(site).axes[0]
    assert ground.get_xlim()[0] < 3000 < ground.get_xlim()[1]  # mm
    assert ground.get_ylim()[0] < 4000 < ground.get_ylim()[1]
