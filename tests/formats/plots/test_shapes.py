"""Shapes of artifacts: magnets, bars and detections at their positions, and in pictures."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.collections import PolyCollection
from matplotlib.quiver import Quiver
from matplotlib.text import Text

from locatk.core.dots.sheet import Manifest, Sheet
from locatk.core.geometry import Similarity, quaternion_from_heading
from locatk.core.landmarks.drawing.floor_bars import MAX_DRAWN_LANDMARKS, bars_on_floor, cells_near
from locatk.core.landmarks.drawing.landmark import bar_outlines
from locatk.core.landmarks.landmark import Geometry, signs
from locatk.core.landmarks.map.floor import AsBuiltLandmark, FloorMap
from locatk.core.landmarks.results import LandmarkDetection
from locatk.core.polaris.codec import layout_of
from locatk.core.polaris.results import MagnetDetection, TagDetection
from locatk.core.polaris.tag import AsBuiltTag, PlanarPose, Tags, as_built_magnets
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory
from locatk.formats.plots.ground import MAX_LABELS, View
from locatk.formats.plots.picture import draw_picture
from locatk.formats.plots.shapes import Drawing, Label, draw_artifact

START_NS = 1_000_000_000
ROTATION = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
TO = Similarity(2.0, ROTATION, np.array([1.0, 2, 0]))


def points_of(drawing: Drawing, name: str, kind: str) -> np.ndarray:
    """The points of the shapes of a name and kind, none if there are no such shapes."""
    named = {shape.style for shape in drawing.shapes if shape.name == name}
    points = [s.points for s in drawing.shapes if s.style in named and s.kind == kind]
    return np.concatenate(points) if points else np.zeros((0, 0, 3))


def path(x: np.ndarray, y: float, frame: str, device: str) -> Trajectory:
    """A straight drive along x at 100 poses a second."""
    n = len(x)
    return Trajectory(
        device,
        frame,
        START_NS + 10_000_000 * np.arange(n),
        np.column_stack([x, np.full(n, y), np.zeros(n)]),
        quaternion_from_heading(np.zeros(n)),
        np.broadcast_to(np.eye(6) * 1e-6, (n, 6, 6)),
    )


# ---- sheets of dots


def test_only_sheets_with_poses_are_drawn() -> None:
    sheets = tuple(
        Sheet(name, (1000 * k, 0), (101, 51), (0, 0), (60.0, 30.0), (5.0, 6.0))
        for k, name in enumerate("ab")
    )
    manifest = Manifest(sheets)
    solution = Solution(
        "dots", "lattice", (path(np.zeros(3), 0.0, "b", "camera"),), artifact=manifest
    )
    drawing = draw_artifact(solution)
    (paper,) = points_of(drawing, "paper", "polygon")
    (dots,) = points_of(drawing, "dot pattern", "polygon")
    np.testing.assert_allclose(np.ptp(paper, axis=0), [0.06, 0.03, 0])
    extent = np.array([100, 50, 0]) * manifest.pitch_mm * 1e-3
    np.testing.assert_allclose(np.ptp(dots, axis=0), extent, rtol=1e-9)
    # The margins of a page are given from its upper left corner.
    left, top = dots[:, 0].min() - paper[:, 0].min(), paper[:, 1].max() - dots[:, 1].max()
    np.testing.assert_allclose([left, top], [0.005, 0.006])


# ---- magnetic tags

ID = 4711
BUILT = Tags(built={ID: AsBuiltTag(np.full((5, 2), 1e-3), np.full(5, 0.1), 3)})


def tag_detection(tags: Tags, x: float, y: float, heading: float) -> TagDetection:
    """The tag detected at that pose, without error."""
    position, angle = as_built_magnets(tags, ID, layout_of(tags, ID))
    c, s = math.cos(heading), math.sin(heading)
    position = position @ np.array([[c, s], [-s, c]]) + [x, y]
    magnets = tuple(
        MagnetDetection(px, py, a, 0, (0, 0), 1e-4, 1e-4, 1e-2, 1e-3)
        for (px, py), a in zip(position.tolist(), (angle + heading).tolist(), strict=True)
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


def tag_solution(tags: Tags, frame: str) -> Solution:
    unread = replace(tag_detection(tags, 9.0, 9.0, 0.0), tag_id=None)
    return Solution(
        "polaris",
        "joint",
        (path(np.linspace(-0.1, 0.1, 20), 0.0, frame, "bar"),),
        {},
        (tag_detection(tags, 0.02, -0.01, 0.7), unread),
        tags,
    )


@pytest.mark.parametrize("site_pose", [None, PlanarPose(1.2, -0.3, 2.5)])
def test_detected_magnets_are_at_the_nominal_ones(site_pose: PlanarPose | None) -> None:
    tags = BUILT if site_pose is None else replace(BUILT, site={ID: site_pose})
    drawing = draw_artifact(tag_solution(tags, f"tag-{ID}" if site_pose is None else "site"))
    assert [label.text for label in drawing.labels] == [f"tag {ID}"]
    nominal = points_of(drawing, "magnet", "arrow")
    detected = points_of(drawing, "detected magnet", "arrow")
    assert nominal.shape == (5, 2, 3)  # Magnets that were not identified are not drawn.
    np.testing.assert_allclose(detected, nominal, atol=1e-12)
    np.testing.assert_allclose(points_of(drawing, "magnet", "marker"), nominal[:, :1])
    if site_pose is not None:
        assert np.linalg.norm(nominal[:, 0].mean(axis=0)[:2] - [1.2, -0.3]) < 0.05


def test_the_map_shows_all_magnets() -> None:
    figure = draw_picture(tag_solution(BUILT, f"tag-{ID}"))
    axes = figure.axes[0]
    position = 1e3 * as_built_magnets(BUILT, ID, layout_of(BUILT, ID))[0]  # A small map is in mm.
    for arrows in figure.findobj(Quiver):
        np.testing.assert_allclose(arrows.XY, position)
    assert len(figure.findobj(Quiver)) == 2
    assert axes.get_xlabel() == "x [mm]"
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    assert left < position[:, 0].min() < position[:, 0].max() < right
    assert low < position[:, 1].min() < position[:, 1].max() < high
    words = {text.get_text() for text in figure.findobj(Text)}
    assert {f"tag {ID}", "magnet", "detected magnet"} <= words


def test_a_solution_without_poses_shows_the_site() -> None:
    empty = replace(tag_solution(BUILT, "site"), trajectories=(), detections=())
    assert draw_artifact(empty).shapes == ()
    site = replace(empty, artifact=replace(BUILT, site={ID: PlanarPose(3.0, 4.0, 0.0)}))
    axes = draw_picture(site).axes[0]
    assert axes.get_xlim()[0] < 3000 < axes.get_xlim()[1]  # mm
    assert axes.get_ylim()[0] < 4000 < axes.get_ylim()[1]


# ---- floors of landmarks

FLOOR = FloorMap(np.array([[7, -1], [12, 5]]), origin_m=(1.0, -2.0))


def visit(cell: tuple[int, int] | None, refused: str = "", time_s: float = 1.0) -> Any:
    return LandmarkDetection(
        time_s=time_s,
        device="robot",
        cell=cell,
        pattern="NNNS",
        code=7,
        probability=1.0,
        x_m=0.004,
        y_m=-0.003,
        heading_rad=0.0,
        sigma_x_m=1e-4,
        sigma_y_m=1e-4,
        sigma_heading_rad=1e-3,
        strength=None,
        residual_sigma=1.0,
        refused=refused,
    )


def floor_solution(floor: FloorMap | None, *detections: Any, n: int = 21, y: float = -2.0) -> Any:
    """A drive of 0.2 s along x, 1 m to 1.2 m, at ``y``; without poses if ``n`` is 0."""
    tracks = (path(np.linspace(1.0, 1.2, n), y, "map", "robot"),) if n else ()
    return Solution("landmarks", "field", tracks, {}, detections, floor)


@settings(max_examples=30, deadline=None)
@given(
    code=st.integers(0, 15),
    x=st.floats(-0.05, 0.05),
    y=st.floats(-0.05, 0.05),
    heading=st.floats(-3, 3),
)
def test_bars_are_those_of_the_installation_pack(
    code: int, x: float, y: float, heading: float
) -> None:
    """The same poles at the same positions as on the sheets by which landmarks are built."""
    floor = FloorMap(np.array([[code]]), origin_m=(0.3, 0.4))
    as_built = AsBuiltLandmark(x, y, heading, signs(code), np.full(7, np.nan))
    for built, shift, rotation_rad in (
        (floor, np.zeros(2), 0.0),
        (replace(floor, built={(0, 0): as_built}), np.array([x, y]), heading),
    ):
        centre, direction, strength = bars_on_floor(built, (0, 0))
        c, s = math.cos(rotation_rad), math.sin(rotation_rad)
        rotation = np.array([[c, -s], [s, c]])
        for k, bar in enumerate(bar_outlines(Geometry(), code)):
            poles = np.array([bar.south, bar.north]) * 1e-3 @ rotation.T + [0.3, 0.4] + shift
            half = 0.015 * np.array([math.cos(direction[k]), math.sin(direction[k])])
            np.testing.assert_allclose([centre[k] - half, centre[k] + half], poles, atol=1e-12)
            assert (strength[k] > 0) == (bar.letter == "N")


def test_halves_of_bars_are_north_and_south() -> None:
    drawing = draw_artifact(floor_solution(FLOOR, visit((0, 0))))
    north = points_of(drawing, "north pole", "polygon")
    assert north.shape == points_of(drawing, "south pole", "polygon").shape == (12, 4, 3)
    assert [label.text for label in drawing.labels] == ["0,0", "1,0", "1,1"]
    bar = bar_outlines(Geometry(), 7)[1]
    # The centre of each half is halfway between the bar's centre and its pole.
    centre = north[1].mean(axis=0)[:2] - [1.0, -2.0]
    np.testing.assert_allclose(
        centre, 1e-3 * (np.array(bar.north) * 0.75 + np.array(bar.south) * 0.25), atol=1e-12
    )
    area = np.ptp(north, axis=1)
    np.testing.assert_allclose(np.sort(area[:, :2], axis=1), [[0.01, 0.015]] * 12, atol=1e-12)


def test_the_view_contains_detected_landmarks_else_all() -> None:
    detected = draw_artifact(floor_solution(FLOOR, visit((0, 0)))).extent
    assert np.abs(detected[:, :2] - [1.0, -2.0]).max() < 0.05
    every = draw_artifact(floor_solution(FLOOR)).extent
    assert np.ptp(every, axis=0)[0] > 0.2


def test_missing_bars_and_walls_are_drawn() -> None:
    built = AsBuiltLandmark(0, 0, 0, np.array([1.0, 0.1, -1.0, 0.0]), np.full(7, np.nan))
    walls = frozenset({((1, 0), (1, 1))})
    floor = replace(FLOOR, built={(1, 1): built}, walls=walls)
    drawing = draw_artifact(floor_solution(floor))
    assert len(points_of(drawing, "north pole", "polygon")) == 10
    assert len(points_of(drawing, "weak or missing", "polygon")) == 2
    # Halfway between the two cells, along y.
    (wall,) = points_of(drawing, "wall", "line")
    np.testing.assert_allclose(np.sort(wall[:, :2], axis=0), [[1.1, -1.9], [1.1, -1.7]])


def test_detections_are_on_the_path() -> None:
    detections = (visit((0, 0), "", 1.1), visit(None, "no_landmark", 1.2), visit((1, 0), "", 9.0))
    drawing = draw_artifact(floor_solution(FLOOR, *detections))
    # The last one is long after the path, and is drawn at its pose relative to the landmark.
    used = points_of(drawing, "landmark detected", "marker")[:, 0]
    np.testing.assert_allclose(used, [[1.1, -2, 0], [1.004, -1.803, 0]], atol=1e-9)
    refused = points_of(drawing, "detection refused", "marker")[:, 0]
    np.testing.assert_allclose(refused, [[1.2, -2, 0]])


def test_drawings_move_with_the_alignment() -> None:
    drawing = draw_artifact(floor_solution(FLOOR, visit((0, 0))))
    moved = drawing.transformed(TO)
    for before, after in zip(drawing.shapes, moved.shapes, strict=True):
        np.testing.assert_allclose(after.points, 2 * before.points @ ROTATION.T + [1, 2, 0])
    np.testing.assert_allclose(moved.extent, 2 * drawing.extent @ ROTATION.T + [1, 2, 0])
    label, label_moved = drawing.labels[0], moved.labels[0]
    np.testing.assert_allclose(label_moved.position, TO.apply(label.position))
    assert label_moved.clearance == pytest.approx(2 * label.clearance)


@pytest.mark.slow
@pytest.mark.parametrize("n", [21, 0])
def test_the_picture_shows_the_floor(n: int) -> None:
    """With a path, and without one if the robot is not localised."""
    detection = visit((0, 0)) if n else visit(None, "off_map")
    figure = draw_picture(floor_solution(FLOOR, detection, n=n))
    axes = figure.axes[0]
    halves = [c for c in axes.collections if isinstance(c, PolyCollection)]
    assert [len(c.get_paths()) for c in halves] == [12, 12]
    words = {text.get_text() for text in figure.findobj(Text)}
    assert {"0,0", "north pole"} <= words
    assert ("landmark detected" in words) == bool(n)
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    points = np.concatenate([p.vertices for p in halves[0].get_paths()[:4]])
    assert left < points[:, 0].min() < points[:, 0].max() < right
    assert low < points[:, 1].min() < points[:, 1].max() < high


def test_other_systems_have_no_shapes() -> None:
    assert draw_artifact(floor_solution(None)).shapes == ()


def test_of_a_large_floor_only_landmarks_near_the_path_are_drawn() -> None:
    large = FloorMap(np.full((60, 60), 3), origin_m=(1.0, -2.0))
    assert len(large.cells()) > MAX_DRAWN_LANDMARKS
    position = floor_solution(large).trajectories[0].position
    near = cells_near(large, [position, np.full((1, 3), np.nan)])
    assert set(near) == {(row, column) for row in range(4) for column in range(5)}
    assert cells_near(large, []) == []
    figure = draw_picture(floor_solution(large, visit((0, 0)), y=4.0))
    assert len(figure.axes[0].texts) <= MAX_LABELS
    assert draw_picture(floor_solution(large, n=0)).axes


def test_labels_are_written_only_if_they_do_not_overlap() -> None:
    view = View((0, 1), np.zeros(2), np.ones(2))
    labels = [Label(str(k), np.zeros(3)) for k in range(MAX_LABELS)]
    outside = Label("outside", np.array([2.0, 0, 0]))
    assert view.select_labels([*labels, outside]) == labels
    assert view.select_labels([*labels, Label("one too many", np.zeros(3))]) == []
