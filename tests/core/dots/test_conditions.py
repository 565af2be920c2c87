"""Frames under every condition of the issue, from a renderer that the solver has never seen."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.dots.camera import Camera
from locatk.core.dots.codec import codec
from locatk.core.dots.locate import locate
from locatk.core.dots.simulate import decoys

ANOTO = codec("anoto")
Shoot = Callable[..., NDArray[np.uint8]]

CONDITIONS: dict[str, dict[str, Any]] = {
    "plain": {},
    "dots 0.25": {"dot": 0.25},
    "dots 0.35": {"dot": 0.35},
    "dots 1/6": {"dot": 1 / 6},
    "10 % missing": {"missing": 0.1},
    "dust": {"dust": 0.05, "dot": 0.2},
    "blur 2.2": {"blur": 2.2},
    "motion 2 px": {"motion": 2.0},
    "vignette": {"vignette": 0.4},
    "light from a side": {"gradient": 0.3},
    "noise 16": {"noise": 16.0},
    "no noise": {"noise": 0.0, "blur": 0.0},
    "tilt": {"tilt": math.radians(10)},
    "barrel lens": {"radial": -1e-5},
    "pincushion lens": {"radial": 6e-6},
    "at the rim of a sheet": {"rim": 2.5},
    "pitch 8 px": {"pitch": 8.0},
    "pitch 15 px": {"pitch": 15.0},
    "320 x 240": {"size": (320, 240), "pitch": 20.0},
    "640 x 480, fine": {"size": (640, 480)},
    "640 x 480, coarse": {"size": (640, 480), "pitch": 40.0},
}


def poses(shoot: Shoot, how: dict[str, Any], n: int) -> tuple[list[NDArray[np.uint8]], Any]:
    rng = np.random.default_rng(sorted(CONDITIONS).index("plain") + len(str(how)))
    truth = np.column_stack(
        [rng.uniform(1000, 4e8, n), rng.uniform(1000, 4e8, n), rng.uniform(-math.pi, math.pi, n)]
    )
    frames = [
        shoot(
            at=(x, y), heading=heading, seed=k, **({"towards": k} if "tilt" in how else {}), **how
        )
        for k, (x, y, heading) in enumerate(truth.tolist())
    ]
    return frames, truth


@pytest.mark.parametrize("name", CONDITIONS)
def test_each_cold_frame_is_located(name: str, shoot: Shoot) -> None:
    frames, truth = poses(shoot, CONDITIONS[name], 5)
    found = locate(np.stack(frames), ANOTO)
    assert found.rejected.tolist() == [""] * 5
    assert (found.section == 0).all()
    error = found.grid - truth[:, :2]
    assert np.sqrt((error**2).mean()) < 0.003
    turned = (found.heading - truth[:, 2] + math.pi) % (2 * math.pi) - math.pi
    assert np.abs(turned).max() < math.radians(0.1)
    assert (found.confidence > 0.999).all()


def test_a_frame_does_not_know_of_the_others(shoot: Shoot) -> None:
    frames, _ = poses(shoot, {"noise": 6.0}, 6)
    frames[2] = np.full_like(frames[2], 230)
    together = locate(np.stack(frames), ANOTO)
    backwards = locate(np.stack(frames[::-1]), ANOTO)
    for k, frame in enumerate(frames):
        alone = locate(frame[None], ANOTO)
        assert alone.rejected[0] == together.rejected[k] == backwards.rejected[5 - k]
        if not alone.accepted[0]:
            continue
        for other, at in ((together, k), (backwards, 5 - k)):
            np.testing.assert_array_equal(alone.grid[0], other.grid[at])
            np.testing.assert_allclose(alone.covariance[0], other.covariance[at])
    assert not together.accepted[2]


def test_the_covariance_is_that_of_the_errors(shoot: Shoot) -> None:
    frames, truth = poses(shoot, {"noise": 10.0, "jitter": 0.02}, 60)
    found = locate(np.stack(frames), ANOTO)
    error = np.column_stack(
        [
            found.grid - truth[:, :2],
            (found.heading - truth[:, 2] + math.pi) % (2 * math.pi) - math.pi,
        ]
    )
    squares = np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance), error)
    assert 0.5 < squares.mean() / 3 < 2


def test_a_camera_is_where_its_centre_is(shoot: Shoot) -> None:
    centre, k = (98.0, 55.0), -8e-6
    at = (150_000_000.25, 90_000_000.5)
    frame = shoot(at=at, heading=0.7, centre=centre, radial=k)
    camera = Camera((188, 120), 348.7, centre, k * 348.7**2)
    found = locate(frame[None], ANOTO, camera)
    np.testing.assert_allclose(found.grid[0], at, atol=0.003)
    assert found.heading[0] == pytest.approx(0.7, abs=1e-3)
    blind = locate(frame[None], ANOTO)
    assert math.dist(blind.grid[0], at) == pytest.approx(math.hypot(4.5, 4.5) / 11.04, abs=0.03)


@pytest.mark.parametrize("kind", ["noise", "text", "blank", "checkerboard", "halftone", "texture"])
def test_what_is_no_pattern_has_no_place(kind: str) -> None:
    found = locate(np.asarray(decoys(kind, 40, 3)), ANOTO)
    assert not found.accepted.any()
    assert all(found.rejected)


def test_symbols_drawn_by_lot_have_no_place(shoot: Shoot) -> None:
    rng = np.random.default_rng(5)
    frames = [
        shoot(symbols=rng.integers(0, 4, (61, 61)).astype(np.uint8), heading=h)
        for h in rng.uniform(0, 6, 6)
    ]
    assert not locate(np.stack(frames), ANOTO).accepted.any()


@pytest.mark.parametrize("shape", [(1, 20, 30), (2, 47, 200), (1, 1, 1)])
def test_frames_too_small_for_a_window(shape: tuple[int, int, int]) -> None:
    found = locate(np.zeros(shape, np.uint8), ANOTO)
    assert found.rejected.tolist() == ["too_few_dots"] * shape[0]
