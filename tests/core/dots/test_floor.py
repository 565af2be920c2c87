"""Floors as built: from measurements whose errors are known, and from frames end to end."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.dots.calibration import floor as calibration
from locatk.core.dots.calibration.floor import FloorRecording, built_manifest, calibrate_floor
from locatk.core.dots.calibration.floor_fit import (
    FieldWeights,
    FloorFit,
    FloorProblem,
    Hyperparameters,
    TruthObservations,
    cross_validate,
    fit_floor,
    lay_out_unknowns,
    unresolved_variance,
)
from locatk.core.dots.calibration.floor_frame import build_sheets
from locatk.core.dots.calibration.seam_measurements import SeamMeasurement
from locatk.core.dots.camera import Camera
from locatk.core.dots.frames import Frames
from locatk.core.dots.sheet import Distortion, Manifest, Sheet
from locatk.core.errors import DegenerateError, InputError
from locatk.core.geometry import quaternion_from_heading
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]
Warp = Callable[[Array], Array]

PITCH_MM, PAGE, FIRST, SIZE = 0.508, (150.0, 210.0), (5.0, 5.0), (276, 394)
WIDTH_MM, HEIGHT_MM = PAGE
SIGMA_MM, SIGMA_RAD = 5e-3, 2e-3


def designed(columns: int, rows: int) -> Manifest:
    """Tiles without overlap, row by row from the lower left one."""
    return Manifest(
        tuple(
            Sheet(
                f"c{column}r{row}",
                (1000 + 300 * column, 5000 - 400 * row),
                SIZE,
                (0, 0),
                PAGE,
                FIRST,
                (WIDTH_MM * column, HEIGHT_MM * row),
            )
            for row in range(rows)
            for column in range(columns)
        )
    )


def rotated(points: Array, angle: float) -> Array:
    turned = (points[..., 0] + 1j * points[..., 1]) * complex(math.cos(angle), math.sin(angle))
    return np.stack([turned.real, turned.imag], axis=-1)


def no_warp(points: Array) -> Array:
    return np.zeros_like(points)


class Floor:
    """Tiles glued with errors, whose seams and poses are measured with known noise."""

    def __init__(
        self, seed: int, columns: int = 3, rows: int = 2, warps: dict[int, Warp] | None = None
    ) -> None:
        self.rng = np.random.default_rng(seed)
        self.manifest = designed(columns, rows)
        self.columns, self.rows = columns, rows
        self.warps = warps or {}
        nominal = np.array([[*s.position_mm, 0.0] for s in self.manifest.sheets])  # type: ignore[misc]
        error = self.rng.normal(0, [1.0, 1.0, math.radians(0.3)], nominal.shape)
        error[0] = 0
        self.poses = nominal + error

    def on_floor(self, number: int, points: Array) -> Array:
        x, y, angle = self.poses[number]
        several = np.atleast_2d(points)
        moved = several + self.warps.get(number, no_warp)(several)
        return (rotated(moved, angle) + [x, y]).reshape(points.shape)

    def seams(self, frames: int, sigma_mm: float = SIGMA_MM) -> list[SeamMeasurement]:
        """Measure each seam in as many frames as given."""
        result = []
        for number in range(len(self.poses)):
            row, column = divmod(number, self.columns)
            if column + 1 < self.columns:
                result += self.measure(number, number + 1, 0, frames, sigma_mm)
            if row + 1 < self.rows:
                result += self.measure(number, number + self.columns, 1, frames, sigma_mm)
        return result

    def measure(
        self, first: int, other: int, axis: int, frames: int, sigma_mm: float = SIGMA_MM
    ) -> list[SeamMeasurement]:
        seams = []
        for frame in range(frames):
            along = self.rng.uniform(10, PAGE[1 - axis] - 10)
            point = np.array([2.0, along] if axis == 0 else [along, 2.0])
            spot = self.on_floor(other, point)
            x, y, angle = self.poses[first]
            position = rotated(spot - [x, y], -angle)
            heading = self.poses[other, 2] - angle
            sigma = np.array([sigma_mm, sigma_mm, SIGMA_RAD])
            pose = np.append(position, heading) + self.rng.normal(0, sigma)
            seams.append(
                SeamMeasurement(
                    *(0, frame, (first, other), point[None], pose[None], np.diag(sigma**2)), ()
                )
            )
        return seams

    def truth(self, number: int, count: int, sigma_mm: float = 0.02) -> TruthObservations:
        """Poses in a frame that is rotated by 1 rad, of a body 30 mm from the camera."""
        points = self.rng.uniform([8, 8], [WIDTH_MM - 8, HEIGHT_MM - 8], (count, 2))
        headings = self.rng.uniform(-math.pi, math.pi, count)
        body = self.poses[number, 2] + headings + 1.0 + 0.3
        world = rotated(self.on_floor(number, points), 1.0) + [500, -200]
        lever = np.stack([30 * np.cos(body) - 5 * np.sin(body),
                          30 * np.sin(body) + 5 * np.cos(body)], axis=1)  # fmt: skip
        world -= lever
        return TruthObservations(
            number,
            0,
            np.arange(count) + 10_000 * number,
            points,
            headings,
            np.full((count, 2), 1e-8),
            world + self.rng.normal(0, sigma_mm, world.shape),
            np.angle(np.exp(1j * (body + self.rng.normal(0, 1e-3, count)))),
        )

    def fit(
        self, seams: list[SeamMeasurement], truths: list[TruthObservations] | None = None
    ) -> FloorFit:
        sheets = list(range(len(self.poses)))
        poses = calibration.initial_poses(self.manifest, sheets, seams, truths or [], 1)
        problem, state = calibration.floor_problem(
            self.manifest, sheets, seams, truths or [], poses
        )
        return fit_floor(problem, state)

    def errors(self, fit: FloorFit) -> list[tuple[Array, Array]]:
        """Errors (3,) of all tiles but the datum, with their covariances."""
        return [
            (sheet.pose - self.poses[sheet.number], sheet.covariance)
            for sheet in build_sheets(fit)[1:]
        ]


def nees(errors: list[tuple[Array, Array]]) -> float:
    return float(np.mean([e @ np.linalg.solve(c, e) / 3 for e, c in errors]))


@pytest.mark.slow
def test_the_covariance_of_the_tiles_is_that_of_their_errors() -> None:
    errors = []
    for seed in range(8):
        floor = Floor(seed, 2, 2)
        fit = floor.fit(floor.seams(8))
        assert not fit.problem.layout.nodes
        errors += floor.errors(fit)
    assert max(np.hypot(*e[:2]) for e, _ in errors) < 0.03
    assert 0.6 < nees(errors) < 1.6


@pytest.mark.slow
def test_wrong_frames_are_rejected() -> None:
    floor = Floor(3)
    seams = floor.seams(8)
    for k in (1, 9, 10, 30):
        pose = seams[k].poses + [[0.6, -0.4, 0.02]]
        seams[k] = replace(seams[k], poses=pose)
    fit = floor.fit(seams)
    used = {id(seam) for seam in fit.problem.seams}
    assert [k for k, seam in enumerate(seams) if id(seam) not in used] == [1, 9, 10, 30]
    assert nees(floor.errors(fit)) < 3


def displaced(seam: SeamMeasurement, x_mm: float, y_mm: float) -> SeamMeasurement:
    return replace(seam, poses=seam.poses + [[x_mm, y_mm, 0.0]])


def test_a_sheet_whose_frames_disagree_has_no_position() -> None:
    """One of three frames is right, so that the rejection of outliers may leave any of them."""
    for seed in range(3):
        floor = Floor(seed, 3, 1)
        good = floor.measure(0, 1, 0, 8)
        doubtful = floor.measure(1, 2, 0, 3)
        doubtful[1:] = [displaced(doubtful[1], 4, 3), displaced(doubtful[2], -5, 6)]
        given, problem, _, fit = calibration.fit_consistent_sheets(
            floor.manifest, [0, 1, 2], good + doubtful, []
        )
        built = build_sheets(fit)
        assert [sheet.number for sheet in built] == [0, 1]
        assert np.hypot(*(built[1].pose - floor.poses[1])[:2]) < 0.03
        assert problem.layout.sheets == (0, 1)
        notes = list(calibration.notes_of(given, fit))
        assert "c1r0 and c2r0: 0 of 3 frames at their seam agree" in notes
        assert any(note.startswith("c2r0 has no position") for note in notes)
        # The position of the design is not one of the floor as built.
        manifest = built_manifest(floor.manifest, built, (math.nan, math.nan))
        assert manifest.frame(1) == "floor"
        assert manifest.frame(2) == "c2r0"


def test_of_two_opinions_with_equal_votes_neither_is_believed() -> None:
    floor = Floor(3, 3, 1)
    seams = floor.measure(0, 1, 0, 8) + floor.measure(1, 2, 0, 10)
    seams[-5:] = [displaced(seam, 0.4, -0.3) for seam in seams[-5:]]
    _, _, _, fit = calibration.fit_consistent_sheets(floor.manifest, [0, 1, 2], seams, [])
    assert [sheet.number for sheet in build_sheets(fit)] == [0, 1]
    # One vote more decides.
    seams += floor.measure(1, 2, 0, 4)
    _, _, _, fit = calibration.fit_consistent_sheets(floor.manifest, [0, 1, 2], seams, [])
    _, _, last = build_sheets(fit)
    assert last.seam_frames == 9
    assert np.hypot(*(last.pose - floor.poses[2])[:2]) < 0.03


def test_a_floor_whose_datum_is_not_connected_is_refused() -> None:
    floor = Floor(3, 3, 1)
    seams = floor.measure(0, 1, 0, 3)
    seams[1:] = [displaced(seams[1], 4, 3), displaced(seams[2], -5, 6)]
    seams += floor.measure(1, 2, 0, 8)
    with pytest.raises(DegenerateError, match="no sheet is connected with c0r0"):
        calibration.fit_consistent_sheets(floor.manifest, [0, 1, 2], seams, [])


def test_a_seam_without_a_majority_is_named() -> None:
    floor = Floor(3, 2, 1)
    seams = floor.measure(0, 1, 0, 10)
    seams[5:] = [displaced(seam, 0.4, -0.3) for seam in seams[5:]]
    given, _, _, fit = calibration.fit_consistent_sheets(floor.manifest, [0, 1], seams, [])
    (note,) = calibration.notes_of(given, fit)
    assert "times as much as the noise of their dots" in note


def test_headings_are_compared_modulo_a_turn() -> None:
    floor = Floor(2, 3, 1)
    sheets = list(floor.manifest.sheets)
    sheets[1] = replace(sheets[1], heading_deg=180.0, position_mm=(300.0, 210.0))
    sheets[2] = replace(sheets[2], heading_deg=-90.0, position_mm=(300.0, 500.0))
    floor.manifest = replace(floor.manifest, sheets=tuple(sheets))
    floor.poses = np.array([[0, 0, 0], [300.3, 210.2, 0.004 - math.pi], [300, 500, -math.pi / 2]])
    seams = floor.measure(0, 1, 0, 20) + floor.measure(1, 2, 0, 20)
    _, second, third = build_sheets(floor.fit(seams))
    assert second.shift == pytest.approx([0.3, 0.2, 0.004], abs=0.05)
    assert third.shift == pytest.approx([0, 0, 0], abs=0.05)
    assert abs(third.pose[2]) <= math.pi


@pytest.mark.slow
def test_errors_of_the_print_along_a_seam_widen_the_covariance() -> None:
    """Errors of 0.1 mm along the seams, where a frame measures to 5 um."""

    def warp(points: Array, phase: float) -> Array:
        return 0.1 * np.stack(
            [np.sin(points[:, 1] / 40 + phase), np.cos(points[:, 0] / 35 + phase)], axis=1
        )

    errors = []
    for seed in range(4):
        warps = {n: lambda points, n=n, k=seed: warp(points, 2.0 * n + k) for n in range(2)}
        floor = Floor(seed, 2, 1, warps)
        fit = floor.fit(floor.seams(20))
        assert fit.problem.layout.nodes
        sheets = build_sheets(fit)
        assert all(sheet.distortion is None for sheet in sheets)
        assert all(0.02 < sheet.distortion_sigma_mm[0] < 0.4 for sheet in sheets)
        # Local rotations are half the curl: 0.1 mm / 35 mm and / 40 mm, two sines.
        rotation = 0.05 * math.hypot(1 / 35, 1 / 40) / math.sqrt(2)
        assert all(0.3 < sheet.distortion_sigma_rad / rotation < 3 for sheet in sheets)
        errors += floor.errors(fit)
    assert nees(errors) < 3


def test_what_the_nodes_of_a_field_do_not_resolve() -> None:
    """Against fields that are drawn at the nodes and next to a point, with weights of nodes."""
    rng = np.random.default_rng(0)
    nodes = np.stack(np.meshgrid([0.0, 40, 80], [0.0, 40, 80]), axis=-1).reshape(-1, 2)
    point, step, length = np.array([[27.0, 51.0]]), 0.5, 50.0
    near = point + step * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    every = np.concatenate([nodes, near])
    ratio = math.sqrt(3) / length * np.linalg.norm(every[:, None] - every, axis=2)
    root = np.linalg.cholesky((1 + ratio) * np.exp(-ratio) + 1e-12 * np.eye(len(every)))
    drawn = rng.normal(size=(40_000, len(every))) @ root.T
    value, by_x, by_y = rng.normal(0, [[0.2], [0.01], [0.01]], (3, 9))
    at_nodes, around = drawn[:, :9], drawn[:, 9:]
    weights = FieldWeights(value[None], by_x[None], by_y[None])
    result = unresolved_variance(nodes, point, weights, length)
    errors = (
        around[:, 0] - at_nodes @ value,
        (around[:, 1] - around[:, 2]) / (2 * step) - at_nodes @ by_x,
        (around[:, 3] - around[:, 4]) / (2 * step) - at_nodes @ by_y,
    )
    assert result == pytest.approx([np.mean(error**2) for error in errors], rel=0.04)


def stretched(points: Array) -> Array:
    """0.15 % and -0.1 % of scale, and regions with errors of 0.03 and 0.1 mm."""
    x, y = points.T
    return np.stack(
        [
            1.5e-3 * x + 0.03 * np.sin(y / 40 + 1) * np.cos(x / 45),
            -1e-3 * y + 0.1 * np.sin(y / 35) * np.cos(x / 50 + 2),
        ],
        axis=1,
    )


@pytest.mark.slow
def test_truth_maps_the_errors_of_the_print() -> None:
    floor = Floor(5, 2, 1, {0: stretched, 1: stretched})
    fit = floor.fit(floor.measure(0, 1, 0, 8), [floor.truth(0, 150), floor.truth(1, 150)])
    sheets = build_sheets(fit)
    assert all(sheet.distortion is not None for sheet in sheets)
    index = fit.problem.layout.scale
    scale = 1 + fit.state[index]
    assert scale == pytest.approx([1.0015, 0.999], abs=1e-3)
    without, with_maps = cross_validate(fit)
    # Of the rest, 0.041 mm are noise of the truth and of its heading, times the lever.
    assert 0.041 < with_maps < 0.85 * without
    # Places anywhere on the tiles, where nothing was measured: relative positions on the floor.
    built = built_manifest(floor.manifest, sheets, (float(scale[0]), float(scale[1])))
    rng = np.random.default_rng(0)
    points = rng.uniform([10, 10], [WIDTH_MM - 10, HEIGHT_MM - 10], (200, 2))
    estimated, true, normalized = [], [], []
    for number in (0, 1):
        upper = [points[:, 0] - FIRST[0], PAGE[1] - points[:, 1] - FIRST[1]]
        grid = np.stack(upper, axis=1) / PITCH_MM + floor.manifest.sheets[number].origin
        estimated.append(built.to_metres(number, grid) * 1e3)
        true.append(floor.on_floor(number, points))
        normalized.append(built.covariance(number, estimated[-1] * 1e-3)[:, :2, :2] * 1e6)
    both, at = np.concatenate(estimated), np.concatenate(true)
    shift, turn = (at - both).mean(axis=0), np.zeros(1)
    centred = (both - both.mean(axis=0)) @ [1, 1j]
    turn = np.angle((np.conj(centred) * ((at - at.mean(axis=0)) @ [1, 1j])).sum())
    aligned = rotated(both - both.mean(axis=0), float(turn)) + both.mean(axis=0) + shift
    error = aligned - at
    assert np.sqrt(np.mean(np.sum(error**2, axis=1))) < 0.03
    spread = np.concatenate(normalized)
    values = np.einsum("ni,ni->n", error, np.linalg.solve(spread, error[..., None])[..., 0]) / 2
    assert 0.1 < values.mean() < 2


@pytest.mark.slow
def test_a_good_print_gets_no_map() -> None:
    floor = Floor(6, 2, 1)
    fit = floor.fit(floor.measure(0, 1, 0, 8), [floor.truth(0, 100), floor.truth(1, 100)])
    assert not fit.problem.layout.nodes
    assert all(sheet.distortion is None for sheet in build_sheets(fit))
    # 0.02 mm, and the error of the heading of the body (0.001 rad) times the lever of 30 mm.
    assert fit.hyperparameters.position_mm == pytest.approx(
        math.hypot(0.02, 0.03 / math.sqrt(2)), rel=0.2
    )


def test_maps_that_cannot_be_renewed_are_named() -> None:
    floor = Floor(6, 2, 1)
    fit = floor.fit(floor.measure(0, 1, 0, 8))
    mapped = replace(floor.manifest.sheets[0], distortion=Distortion(*(((0.0, 0.0),) * 2,) * 2))
    problem = replace(fit.problem, layout=lay_out_unknowns(floor.manifest, (0, 1), 0))
    built = replace(floor.manifest, sheets=(mapped, floor.manifest.sheets[1]))
    (note,) = calibration.notes_of(replace(problem, manifest=built), fit)
    assert "they need --truth" in note
    assert list(calibration.notes_of(problem, fit)) == []


@pytest.mark.slow
def test_truth_connects_sheets_without_a_seam() -> None:
    floor = Floor(8, 2, 1)
    fit = floor.fit([], [floor.truth(0, 60), floor.truth(1, 60)])
    ((error, covariance),) = floor.errors(fit)
    assert np.hypot(*error[:2]) < 0.03
    assert error @ np.linalg.solve(covariance, error) / 3 < 4


def test_truth_without_orientation() -> None:
    floor = Floor(8, 2, 1)
    truths = [
        replace(truth, truth_headings=np.full(len(truth.time_ns), np.nan), truth_mm=at)
        for truth in (floor.truth(0, 60), floor.truth(1, 60))
        for at in [rotated(floor.on_floor(truth.number, truth.points_mm), 1.0)]
    ]
    ((error, _),) = floor.errors(floor.fit([], truths))
    assert np.hypot(*error[:2]) < 0.01


@pytest.mark.slow
def test_the_datum_keeps_its_pose() -> None:
    floor = Floor(5, 2, 1, {0: stretched, 1: stretched})
    datum, _ = build_sheets(
        floor.fit(floor.measure(0, 1, 0, 8), [floor.truth(0, 80), floor.truth(1, 80)])
    )
    np.testing.assert_allclose(datum.pose, 0, atol=1e-9)
    np.testing.assert_allclose(datum.covariance, 0, atol=1e-12)
    # Its map has neither a shift nor a rotation.
    assert datum.distortion is not None
    assert np.abs(datum.distortion.displacement_mm.mean(axis=(0, 1))).max() < 1e-6


def test_poses_in_the_frame_of_the_datum_have_the_covariance_of_their_derivatives() -> None:
    floor = Floor(2, 2, 1)
    layout = lay_out_unknowns(floor.manifest, (0, 1), 1)
    problem = FloorProblem(floor.manifest, layout, (), ())
    rng = np.random.default_rng(0)
    state = rng.normal(0, 0.05, layout.size)
    state[layout.pose(1)] = [151.0, -0.5, 0.3]
    root = rng.normal(0, 1e-4, (layout.size, 8))

    def pose(at: Array) -> Array:
        fit = FloorFit(problem, at, root @ root.T, Hyperparameters(), 0.0)
        return build_sheets(fit)[1].pose

    steps = 1e-4 * root / np.abs(root).max()
    moved = np.array([pose(state + step) - pose(state - step) for step in steps.T]) / 2
    moved *= np.abs(root).max() / 1e-4
    covariance = build_sheets(FloorFit(problem, state, root @ root.T, Hyperparameters(), 0.0))[
        1
    ].covariance
    # Without products of the heading and the shift by the field, which are 1e-2 of the latter.
    sigma = np.sqrt(np.diag(covariance))
    scale = np.outer(sigma, sigma)
    np.testing.assert_allclose(covariance / scale, moved.T @ moved / scale, atol=1e-2)


def test_parts_of_a_floor_are_named() -> None:
    floor = Floor(0)
    seams = floor.measure(0, 1, 0, 5) + floor.measure(3, 4, 0, 5) + floor.measure(1, 4, 1, 2)
    sheets = list(range(6))
    poses = calibration.initial_poses(floor.manifest, sheets, seams, [], 3)
    with pytest.raises(DegenerateError, match=r"c2r0, c0r1, c1r1, c2r1 are not connected") as error:
        calibration.require_connected(floor.manifest, sheets, poses)
    assert "across each seam" in str(error.value.hint)


def test_large_floors_have_coarser_fields() -> None:
    sizes = {}
    for count in (4, 6, 7, 10):
        manifest = designed(count, count)
        layout = lay_out_unknowns(manifest, tuple(range(count**2)), 1)
        assert layout.size <= 2000
        sizes[count] = layout.nodes.get(0)
        unknowns = [layout.field(number).ravel() for number in layout.nodes]
        assert sum(map(len, unknowns)) == layout.size - layout.rigid_size
        assert len(np.unique(np.concatenate([*unknowns, [0]]))) == 1 + sum(map(len, unknowns))
    assert sizes == {4: (5, 6), 6: (4, 5), 7: None, 10: None}


def blank_recording() -> FloorRecording:
    image = np.full((120, 188), 200, np.uint8)
    frames = Frames("cam", np.arange(3) * 10**7, ("a", "b", "c"), [image] * 3)
    return FloorRecording("blank", frames, Camera((188, 120), 348.7, (93.5, 59.5)))


def test_refusals() -> None:
    with pytest.raises(InputError, match="a single sheet"):
        calibrate_floor([blank_recording()], designed(1, 1))
    small = replace(designed(2, 1).sheets[0], id="small", size=(50, 394))
    inside = replace(designed(2, 1), sheets=(*designed(2, 1).sheets, small))
    with pytest.raises(InputError, match="tile small is inside of that of c0r0"):
        calibrate_floor([blank_recording()], inside)
    with pytest.raises(DegenerateError, match="no frame shows a sheet"):
        calibrate_floor([blank_recording()], designed(2, 1))
    large = replace(blank_recording(), camera=Camera((320, 240), 348.7, (159.5, 119.5)))
    with pytest.raises(InputError, match="no frame of blank has the size of the camera"):
        calibrate_floor([large], designed(2, 1))
    without = replace(blank_recording(), camera=None)
    with pytest.raises(DegenerateError, match="camera of blank cannot be estimated") as error:
        calibrate_floor([without], designed(2, 1))
    assert "--camera" in str(error.value.hint)


@pytest.fixture(scope="module")
def left_alone(
    laid_sheet: Callable[..., Any], shoot_floor: Callable[..., Any]
) -> tuple[Manifest, Frames]:
    """Two sheets without positions, and frames over the first one only, 10 mm apart."""
    size, page, first = (300, 200), (160.0, 110.0), (3.0, 3.0)
    manifest = Manifest(
        (
            Sheet("first", (1000, 2000), size, (0, 0), page, first),
            Sheet("second", (5000, 9000), size, (0, 0), page, first),
        )
    )
    floor = (laid_sheet((1000, 2000), size, page, first),)
    images = [shoot_floor(floor, 40.0 + 10 * k, 50.0, seed=k) for k in range(8)]
    times = 10**18 + np.arange(8) * 10**8
    return manifest, Frames("cam", times, tuple(map(str, range(8))), images)


@pytest.mark.parametrize(
    ("has_truth", "delay_s", "words"),
    [
        (False, 0.0, "no frame shows a seam between two sheets"),
        (True, 0.0, "8 poses with truth cannot be used: at least 10 on one sheet, over 20 mm"),
        (True, 1e4, "no frame on a single sheet has truth at its time"),
    ],
    ids=["no seam", "few poses", "another time"],
)
def test_frames_without_use_are_refused(
    left_alone: tuple[Manifest, Frames], has_truth: bool, delay_s: float, words: str
) -> None:
    manifest, frames = left_alone
    truth = None
    if has_truth:
        x = 0.04 + 0.01 * np.arange(8)
        truth = Trajectory(
            *("body", "room", frames.time_ns + round(delay_s * 1e9)),
            np.column_stack([x, 0.05 + 0 * x, 0 * x]),
            quaternion_from_heading(0 * x),
            np.full((8, 6, 6), np.nan),
        )
    camera = Camera((188, 120), 348.7, (93.5, 59.5))
    with pytest.raises(DegenerateError, match=words) as error:
        calibrate_floor([FloorRecording("run", frames, camera, truth)], manifest)
    assert error.value.hint


@pytest.mark.slow
@pytest.mark.parametrize("has_positions", [True, False], ids=["tiles", "sheets"])
def test_from_frames_to_a_manifest(
    laid_sheet: Callable[..., Any], shoot_floor: Callable[..., Any], has_positions: bool
) -> None:
    """Two small sheets glued with a turn, seen by a camera that shares nothing with the solver."""
    size, page, first = (90, 80), (47.0, 42.0), (0.5, 0.6)
    ids, shared = ("A6-0001", "A6-0002"), 10 if has_positions else -10
    origins = ((1000, 2000), (1000 + size[0] - shared, 2000))
    step = (size[0] - shared) * PITCH_MM if has_positions else 46.0
    positions = ((0.0, 0.0), (step, 0.0)) if has_positions else (None, None)
    manifest = Manifest(
        tuple(
            Sheet(name, origin, size, (0, 0), page, first, position)
            for name, origin, position in zip(ids, origins, positions, strict=True)
        )
    )
    # The second one covers the end of the first one.
    floor = (
        laid_sheet(origins[0], size, page, first),
        laid_sheet(origins[1], size, page, first, step + 0.7, -0.4, 1.0),
    )
    rng = np.random.default_rng(4)
    large = {"size": (320, 240), "centre": (159.5, 119.5)}
    images = [
        shoot_floor(
            floor,
            step + 0.4 + rng.uniform(-1.5, 1.5),
            rng.uniform(6, 36),
            heading=rng.uniform(-3, 3),
            seed=k,
            **large,
        )
        for k in range(6)
    ]
    frames = Frames("cam", np.arange(6) * 10**7, tuple(map(str, range(6))), images)
    camera = Camera((320, 240), 348.7, (159.5, 119.5))
    report = calibrate_floor([FloorRecording("run", frames, camera)], manifest)
    assert report.datum == "A6-0001"
    second = report.manifest.sheets[1]
    np.testing.assert_allclose(second.position_mm, (step + 0.7, -0.4), atol=2e-3)
    assert second.heading_deg == pytest.approx(1.0, abs=2e-3)
    assert second.covariance_mm_deg is not None
    sigma = np.sqrt(np.diag(second.covariance_mm_deg))
    error = np.array([*second.position_mm, second.heading_deg]) - [step + 0.7, -0.4, 1.0]  # type: ignore[misc]
    assert np.abs(error / sigma).max() < 5
    assert report.manifest.frame(1) == "floor"
    first_end = report.manifest.sheets[0].origin[0] + report.manifest.sheets[0].size[0]
    assert second.origin == origins[1]
    assert first_end == (1080 if has_positions else 1090)
