"""Fits of a camera to dots that OpenCV has projected: nothing is rendered or decoded here."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.dots.calibration import camera as calibration
from locatk.core.dots.calibration import camera_fit as models
from locatk.core.dots.calibration.camera_fit import (
    CalibrationViews,
    CameraFit,
    fit_homographies,
    fit_poses,
    fit_without_lens,
)
from locatk.core.errors import DegenerateError
from locatk.core.geometry import rotation_exp

Array = NDArray[np.float64]
SIZE = (188, 120)
HALF = math.hypot(*SIZE) / 2
FOCAL, CENTRE, K = 350.0, np.array([96.0, 57.5]), -3.5e-6
PITCH = 0.508


def bent(offset: Array, k: float) -> Array:
    """Where a lens shows what belongs at ``offset``: u = r / (1 + k r^2), by a table."""
    r = np.linspace(0, 3 * HALF if k <= 0 else min(3 * HALF, 0.98 / math.sqrt(k)), 200_000)
    ideal = r / (1 + k * r * r)
    fits = int(np.argmax(np.diff(ideal) <= 0)) or len(r)
    length = np.linalg.norm(offset, axis=1, keepdims=True)
    return offset * np.interp(length, ideal[:fits], r[:fits], right=np.nan) / length


def views(
    frames: int = 25,
    *,
    tilt_deg: float = 10.0,
    tilts_deg: Sequence[float] = (),
    k: float = K,
    noise: float = 0.03,
    wrong: float = 0.0,
    aspect: float = 0.0,
    bow_mm: float = 0.0,
    seed: int = 0,
) -> CalibrationViews:
    """Frames in all directions, at 0.046 mm a pixel; tilted evenly, or as told."""
    rng = np.random.default_rng(seed)
    intrinsic = np.array([[FOCAL, 0, CENTRE[0]], [0, FOCAL, CENTRE[1]], [0, 0, 1]])
    steps = np.arange(-16, 17) * PITCH
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    actual = []
    for tilt in np.radians(tilts_deg or rng.uniform(0, tilt_deg, frames)):
        towards, rotation = rng.uniform(-4, 4, 2)
        lean, _ = cv2.Rodrigues(tilt * np.array([math.cos(towards), math.sin(towards), 0.0]))
        spin, _ = cv2.Rodrigues(np.array([0.0, 0.0, rotation]))
        vector, _ = cv2.Rodrigues(lean @ spin)
        position = grid + rng.uniform(-0.3, 0.3, 2)
        real = np.c_[position * [1 + aspect / 2, 1 - aspect / 2], np.zeros(len(position))]
        real[:, 2] = bow_mm * rng.normal() * (real[:, 0] / 4) ** 2
        shift = np.array([*rng.uniform(-0.2, 0.2, 2), FOCAL * 0.046])
        flat, _ = cv2.projectPoints(real, vector, shift, intrinsic, None)
        seen = CENTRE + bent(flat[:, 0] - CENTRE, k)
        inside = ((seen > 1) & (seen < np.array(SIZE) - 2)).all(axis=1)
        seen = seen[inside] + rng.normal(0, noise, (int(inside.sum()), 2))
        astray = rng.random(len(seen)) < wrong
        seen[astray] += rng.uniform(-1.3, 1.3, (int(astray.sum()), 2))
        actual.append((seen, position[inside]))
    most = max(len(seen) for seen, _ in actual)
    result = CalibrationViews(
        SIZE,
        np.full((frames, most, 2), np.nan),
        np.full((frames, most, 2), np.nan),
        np.zeros((frames, most), bool),
    )
    for n, (seen, position) in enumerate(actual):
        result.pixels[n, : len(seen)], result.plane[n, : len(seen)] = seen, position
        result.valid[n, : len(seen)] = True
    return result


def errors(fit: CameraFit) -> Array:
    """Of centre, k, focal length and aspect in standard deviations."""
    actual = np.array([*fit.centre, fit.radial, fit.focal, fit.aspect])
    return (actual - [*CENTRE, K, FOCAL, 0.0]) / fit.sigma


@pytest.mark.parametrize("name", ["homographies", "poses"])
def test_derivatives_are_those_of_the_model(name: str) -> None:
    rng = np.random.default_rng(1)
    plane = rng.uniform(-1, 1, (3, 7, 2))
    shared = np.array([0.02, -0.03, -0.1, 0.7, 0.01])
    model: models.FrameModel
    if name == "homographies":
        model, own = models.HomographyModel(), rng.normal(0, 0.1, (3, 8)) + [1, 0, 0, 0, 1, 0, 0, 0]
    else:
        rotations = rotation_exp(rng.normal(0, 0.3, (3, 3))).reshape(3, 9)
        model, own = (
            models.PoseModel(),
            np.c_[rotations, rng.normal(0, 0.1, (3, 2)), [1.1, 0.9, 1.0]],
        )
    _, by_own, by_shared = models.project(model, shared, own, plane)
    small = 1e-6
    for k in range(by_own.shape[3]):
        step = np.zeros((3, by_own.shape[3]))
        step[:, k] = small
        after, before = (
            models.project(model, shared, model.retract(own, s), plane)[0] for s in (step, -step)
        )
        assert by_own[..., k] == pytest.approx((after - before) / (2 * small), abs=1e-8)
    for k in range(5):
        change = np.zeros(5)
        change[k] = small
        after, before = (
            models.project(model, shared + c, own, plane)[0] for c in (change, -change)
        )
        assert by_shared[..., k] == pytest.approx((after - before) / (2 * small), abs=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("k", [-1.5e-5, -3.5e-6, 5e-6])
def test_without_noise_the_camera_comes_back_exactly(k: float) -> None:
    seen = views(8, k=k, noise=0.0)
    bend = fit_homographies(seen)
    poses = fit_poses(seen, bend, 250.0)
    for fit in (bend, poses):
        assert fit.centre == pytest.approx(CENTRE, abs=1e-4)
        assert fit.radial == pytest.approx(k, rel=1e-5)
        assert fit.rms < 1e-4
    assert poses.focal == pytest.approx(FOCAL, rel=1e-5)
    assert fit_without_lens(seen).rms > 0.3


@pytest.mark.slow
def test_sigmas_match_the_scatter_of_repetitions() -> None:
    actual = []
    for seed in range(16):
        seen = views(12, seed=seed)
        bend = fit_homographies(seen)
        assert np.isnan(bend.sigma[3:]).all()
        actual.append([*errors(bend)[:3], *errors(fit_poses(seen, bend, 300.0))])
    # 16 draws of a variance scatter by a third; 2.2 of them allowed for eight numbers.
    assert np.sqrt(np.mean(np.square(actual), axis=0)) == pytest.approx(1.0, abs=0.65)


def test_frames_that_contradict_each_other_are_believed_less() -> None:
    """Paper that is bowed in each frame anew moves all dots of a frame together."""
    flat, bowed = (fit_homographies(views(20, bow_mm=bow, seed=3)) for bow in (0.0, 0.02))
    assert bowed.rms < 1.4 * flat.rms
    assert bowed.sigma[2] > 2.5 * flat.sigma[2]
    assert abs(errors(bowed)[:3]).max() < 4


@pytest.mark.slow
def test_wrong_dots_are_given_up() -> None:
    clean, with_faults = views(seed=5), views(wrong=0.1, seed=5)
    bend = fit_homographies(with_faults)
    poses = fit_poses(with_faults, bend, 300.0)
    assert abs(errors(poses)).max() < 4
    assert poses.sigma[0] < 1.5 * fit_poses(clean, fit_homographies(clean), 300.0).sigma[0]
    given_up = np.mean(~poses.used[with_faults.valid])
    assert 0.05 < given_up < 0.12


def test_bad_frames_count_little() -> None:
    """Motion makes the dots of some frames scatter four times as much."""
    seen = views(30, seed=7)
    bad = np.arange(30) % 5 < 2
    seen.pixels[bad] += np.random.default_rng(0).normal(0, 0.12, seen.pixels[bad].shape)
    good = CalibrationViews(SIZE, *(a[~bad] for a in (seen.pixels, seen.plane, seen.valid)))
    with_bad, without = fit_homographies(seen), fit_homographies(good)
    assert (with_bad.sigma[:3] < 1.15 * without.sigma[:3]).all()
    # Not because their dots were taken for wrong ones.
    assert np.mean(with_bad.used[seen.valid & bad[:, None]]) > 0.98
    assert abs(with_bad.centre - without.centre).max() < without.sigma[:2].max()


@pytest.mark.slow
def test_how_well_the_focal_length_is_known_depends_on_the_tilt() -> None:
    sigmas = []
    for tilt_deg in (10.0, 3.0, 0.0):
        seen = views(25, tilt_deg=tilt_deg, seed=2)
        poses = fit_poses(seen, fit_homographies(seen), 300.0)
        sigmas.append(poses.sigma[3] / poses.focal)
        # The lens is known all the same.
        assert poses.centre == pytest.approx(CENTRE, abs=0.3)
        assert poses.radial == pytest.approx(K, rel=0.01)
    assert sigmas[0] < 0.005 < sigmas[1] < 0.05
    assert sigmas[2] > 0.5


def test_a_sheet_that_is_stretched_does_not_move_the_focal_length() -> None:
    seen = views(25, aspect=0.004, tilt_deg=5.0)
    poses = fit_poses(seen, fit_homographies(seen), 300.0)
    assert abs(poses.focal - FOCAL) < 4 * poses.sigma[3] < 0.05 * FOCAL
    assert poses.aspect == pytest.approx(0.004, abs=1e-4)


def test_tilted_frames_locate_the_centre_of_a_lens_without_distortion() -> None:
    seen = views(25, k=0.0)
    bend = fit_homographies(seen)
    poses = fit_poses(seen, bend, 300.0)
    assert bend.sigma[:2].min() > 5  # px: nothing but the middle of the frame is assumed
    assert poses.centre == pytest.approx(CENTRE, abs=0.3)
    assert poses.sigma[:2].max() < 0.2
    assert poses.focal == pytest.approx(FOCAL, rel=0.01)


def test_a_fixed_centre_is_kept() -> None:
    seen = views(10)
    bend = fit_homographies(seen, fix_centre=True)
    poses = fit_poses(seen, bend, 300.0, fix_centre=True)
    for fit in (bend, poses):
        assert fit.centre.tolist() == [93.5, 59.5]
        assert np.isnan(fit.sigma[:2]).all()


def test_tilts_are_those_of_the_frames() -> None:
    tilts_deg = (9.0, 2.0, 6.0, 0.5, 4.0, 8.0)
    seen = views(6, tilts_deg=tilts_deg)
    bend = fit_homographies(seen)
    assert np.isnan(bend.tilt).all()
    poses = fit_poses(seen, bend, 300.0)
    assert np.degrees(poses.tilt) == pytest.approx(tilts_deg, abs=0.15)


# ---- guards


def test_a_start_beyond_the_fold_of_the_lens_is_refused() -> None:
    """With so large a k the lens would not show the corners at all."""
    seen = views(12, noise=0.0)
    start = fit_homographies(seen)
    folded = replace(start, radial=0.4 / HALF**2)
    with pytest.raises(DegenerateError, match="beyond its fold"):
        fit_poses(seen, folded, 300.0)


def problem_of(seen: CalibrationViews) -> tuple[Any, models.CameraState]:
    """The least-squares problem of homographies, with all dots of the same weight."""
    observed, plane = models.normalize_views(seen)
    free = np.array([True, True, True, False, False])
    problem = models.CameraProblem(
        models.HomographyModel(),
        observed,
        plane,
        seen.valid,
        seen.valid.astype(float),
        free,
        np.zeros(5),
    )
    return problem, models.CameraState(np.zeros(5), models.homographies(seen))


def test_dots_that_the_lens_does_not_show_are_outliers() -> None:
    problem, state = problem_of(views(4))
    folded = models.CameraState(np.array([0, 0, 5.0, 0, 0]), state.frames)
    equations = problem.linearize(folded, np.arange(1))
    assert equations.cost[0] == math.inf
    assert np.isfinite(equations.hessian).all()
    assert np.isfinite(equations.block_gradient).all()
    invisible = (equations.residual == models.INVISIBLE_RESIDUAL).all(axis=2)
    assert 0 < invisible.sum() < problem.valid.sum()
    # Without weight they are rejected outliers and cost nothing.
    without = replace(problem, weights=np.where(invisible, 0.0, problem.weights))
    assert np.isfinite(without.linearize(folded, np.arange(1)).cost[0])


def test_rejected_dots_keep_their_residuals() -> None:
    """Their weights are estimated anew from these; as zeros they would be inliers again."""
    problem, state = problem_of(views(4))
    rejected = np.zeros_like(problem.valid)
    rejected[:, 3] = True
    without = replace(problem, weights=np.where(rejected, 0.0, problem.weights))
    before, after = (p.linearize(state, np.arange(1)) for p in (problem, without))
    np.testing.assert_array_equal(after.residual, before.residual)
    assert np.abs(after.residual[rejected]).max() > 0
    assert after.cost[0] < before.cost[0]


def test_the_gradient_is_that_of_the_cost() -> None:
    problem, state = problem_of(views(3))
    state = models.CameraState(np.array([0.01, -0.02, -0.1, 0, 0]), state.frames)
    equations = problem.linearize(state, np.arange(1))
    for k in range(3):
        step = np.zeros(5)
        step[k] = 1e-6
        after, before = (
            problem.linearize(models.CameraState(state.camera + s, state.frames), np.arange(1))
            for s in (step, -step)
        )
        slope = (after.cost[0] - before.cost[0]) / 2e-6
        assert equations.gradient[k] == pytest.approx(slope, rel=1e-5)


def test_the_prior_constrains_unobservable_parameters() -> None:
    """Untilted frames of a lens without distortion have neither a centre nor a focal length."""
    fit = fit_homographies(views(6, tilt_deg=0.0, k=0.0))
    assert fit.sigma[:2] == pytest.approx([models.CENTRE_PRIOR_SIGMA * HALF] * 2, rel=0.1)
    assert abs(fit.centre - [93.5, 59.5]).max() < fit.sigma[0]


@pytest.mark.slow
def test_frames_that_are_no_poses_have_no_focal_length() -> None:
    """Sheared frames are homographies of the sheet, but no images of a pinhole camera."""
    seen = views(25, tilt_deg=15.0)
    seen.pixels[..., 0] += 0.05 * (seen.pixels[..., 1] - CENTRE[1])
    report = calibration.calibrate_views(seen, calibration.CalibrateOptions(), 25, {})
    assert report.focal_from == "usual"
    assert report.notes[0].startswith("the frames are not what a pinhole sees of a flat sheet")


@pytest.mark.parametrize(
    ("centre", "radial", "plausible"),
    [
        ((93.5, 59.5), -3.5e-6, True),
        ((-1.0, 59.5), -3.5e-6, False),
        ((93.5, 120.0), -3.5e-6, False),
        ((93.5, 59.5), -8e-5, False),
    ],
)
def test_plausible_cameras(centre: Any, radial: float, plausible: bool) -> None:
    fit = replace(fit_homographies(views(5)), centre=np.array(centre), radial=radial)
    if plausible:
        assert calibration.camera_of_fit(SIZE, fit, 350.0).centre_px == centre
    else:
        with pytest.raises(DegenerateError, match="no lens of this kind"):
            calibration.camera_of_fit(SIZE, fit, 350.0)
