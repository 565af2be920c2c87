"""The sparse least squares over a session: derivatives, closed forms and truth."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.landmarks.detection.fit import POSE, Priors
from locatk.core.landmarks.detection.trace import (
    Trace,
    compose,
    corrections,
    relative,
    sensor_places,
)
from locatk.core.landmarks.field import landmark_field
from locatk.core.landmarks.landmark import Geometry, signs
from locatk.core.landmarks.localization.smoothing import (
    Mark,
    Run,
    Stay,
    _bin_pose,
    _seen_from,
    _System,
    link,
    smooth,
)
from locatk.core.landmarks.map.floor import Cell

Array = NDArray[np.float64]

GEOMETRY = Geometry()

PRIORS = Priors()

LEVER = GEOMETRY.circle_m * np.array([[1.0, 0], [0, 1.0], [-1.0, 0], [0, -1.0]])

CODES: dict[Cell, int] = {(0, 0): 7, (0, 1): 12, (1, 1): 10}

PLACES: dict[Cell, Array] = {
    (0, 0): np.zeros(3),
    (0, 1): np.array([0.2, 0.0, 0.0]),
    (1, 1): np.array([0.2, 0.2, 0.0]),
}


def true_way() -> list[Array]:
    """Poses near each of three landmarks, in the map's frame."""
    line = np.linspace(-0.06, 0.06, 31)
    along = np.column_stack([line, 0.004 + 0.05 * line, np.full(31, 0.05)])
    up = np.column_stack([0.196 - 0.05 * line, 0.2 + line, np.full(31, 1.62)])
    return [along, along + [0.2, 0.006, 0.0], up]


def session(drift: float = 0.0, seed: int | None = None) -> tuple[Run, dict[Cell, Mark]]:
    """A run whose odometry is too long by ``drift``; noise of fields with a seed."""
    parts = true_way()
    told = [part * [1 + drift, 1 + drift, 1] for part in parts]
    stays, links = [], []
    for number, (true, own, cell) in enumerate(zip(parts, told, CODES, strict=True)):
        local = sensor_places(true, LEVER) - PLACES[cell][:2]
        value = landmark_field(GEOMETRY, CODES[cell], local)
        if seed is not None:
            sigma = math.hypot(PRIORS.noise_t, PRIORS.floor_t)
            value = value + np.random.default_rng([seed, number]).normal(0, sigma, value.shape)
        seen = relative(own, own[15])
        trace = Trace(
            seen, corrections(seen, 15, PRIORS.drift), value, LEVER, np.ones(len(seen)), 15
        )
        stays.append(Stay(trace, cell, true[15] + [0.001, -0.001, 0.01]))
    for one, other in pairwise(told):
        between = np.linspace(one[-1], other[0], 20)
        links.append(link(between, PRIORS))
    sigma = np.array([1.5e-3, 1.5e-3, 0.012])
    marks = {
        cell: Mark(PLACES[cell], sigma, signs(code), np.full(4, 0.04))
        for cell, code in CODES.items()
    }
    return Run(stays, links), marks


def test_derivatives_of_frames() -> None:
    random = np.random.default_rng(0)
    pose, mark = random.normal(size=3), random.normal(size=3)
    _, by_pose, by_mark = _seen_from(pose, mark)
    for slope, ahead in (
        (by_pose, lambda d: _seen_from(pose + d, mark)[0]),
        (by_mark, lambda d: _seen_from(pose, mark + d)[0]),
    ):
        own = np.column_stack([(ahead(d) - ahead(-d)) / 2e-6 for d in 1e-6 * np.eye(3)])
        np.testing.assert_allclose(slope, own, atol=1e-8)


def test_derivatives_of_a_bin() -> None:
    trace = session()[0].stays[0].trace
    random = np.random.default_rng(1)
    own = random.normal(size=POSE + trace.correction.shape[2] - 3)
    steady = random.normal(size=3)
    slope = _bin_pose(trace, -1, own, steady)[1]
    both = np.concatenate([own, steady])
    count = len(own)
    for k, step in enumerate(1e-6 * np.eye(len(both))):
        ahead, behind = both + step, both - step
        value = (
            _bin_pose(trace, -1, ahead[:count], ahead[count:])[0]
            - _bin_pose(trace, -1, behind[:count], behind[count:])[0]
        ) / 2e-6
        np.testing.assert_allclose(slope[:, k], value, atol=1e-7)


@pytest.mark.parametrize("kind", ["field", "link"])
def test_derivatives_of_all_rows(kind: str) -> None:
    """By every unknown, also by those that no row should know of."""
    run, marks = session(0.01)
    system = _System([run], marks, GEOMETRY, PRIORS)
    random = np.random.default_rng(2)
    state = system.start() + 0.3 * random.normal(size=system.size) * system.prior
    for cell in marks:  # pushed bars have slopes of first order only
        state[system.landmarks[cell][POSE + 4 :]] = 0.0

    def rows(at: Array) -> tuple[NDArray[np.intp], Array, Array]:
        return system._field(at, 0, 1) if kind == "field" else system._link(at, 0, 1, run.links[1])

    place, slope, _ = rows(state)
    told = np.zeros((len(slope), system.size))
    for column, k in enumerate(place):
        told[:, k] += slope[:, column]
    own = np.empty_like(told)
    for k in range(system.size):
        step = np.zeros(system.size)
        step[k] = 1e-6
        own[:, k] = (rows(state + step)[2] - rows(state - step)[2]) / 2e-6
    # Links hang on constant errors of odometry to first order.
    size = np.abs(own).max()
    np.testing.assert_allclose(told / size, own / size, atol=1e-6 if kind == "field" else 5e-3)


def test_faultless_sessions_give_the_truth() -> None:
    run, marks = session()
    found = smooth([run], marks, GEOMETRY, PRIORS)
    for stay, true in zip(found.stays[0], true_way(), strict=True):
        np.testing.assert_allclose(stay.pose, true[15], atol=2e-5)
    for cell, mark in found.marks.items():
        np.testing.assert_allclose(mark.pose, PLACES[cell], atol=2e-5)
    assert found.misfit < 0.05


def test_odometry_that_is_too_long_is_found_out() -> None:
    run, marks = session(0.02)
    found = smooth([run], marks, GEOMETRY, PRIORS)
    scale = found.stays[0][0].wrong[0] * PRIORS.drift.scale
    assert scale == pytest.approx(-0.02, abs=0.006)
    for stay, true in zip(found.stays[0], true_way(), strict=True):
        np.testing.assert_allclose(stay.pose[:2], true[15, :2], atol=3e-4)


def test_a_displaced_landmark_shows() -> None:
    """Where its neighbours and the odometry say that it lies elsewhere."""
    run, marks = session()
    off = np.array([0.004, -0.003, 0.0])
    marks[(0, 1)] = replace(marks[(0, 1)], pose=PLACES[(0, 1)] + off)
    found = smooth([run], marks, GEOMETRY, PRIORS)
    shift = found.marks[(0, 1)].pose - marks[(0, 1)].pose
    assert shift[:2] @ -off[:2] / (off[:2] @ off[:2]) > 0.3


def test_scatter_is_as_told() -> None:
    """Noise alone: what is not there (bars, gains, odometry) makes the answer cautious."""
    squares = []
    for seed in range(15):
        run, marks = session(seed=seed)
        found = smooth([run], marks, GEOMETRY, PRIORS)
        assert 0.8 < found.misfit < 1.2
        for stay, true in zip(found.stays[0], true_way(), strict=True):
            off = stay.pose - true[15]
            squares.append(off @ np.linalg.solve(stay.covariance[:3, :3], off))
    assert 0.001 < np.mean(squares) < 3.5


def test_misfit_widens_the_covariance() -> None:
    run, marks = session(seed=3)
    good = smooth([run], marks, GEOMETRY, PRIORS)
    trusting = replace(PRIORS, noise_t=PRIORS.noise_t / 10, floor_t=PRIORS.floor_t / 10, model=0)
    bad = smooth([run], marks, GEOMETRY, trusting)
    assert bad.misfit > 5
    ratio = bad.stays[0][1].covariance[0, 0] / good.stays[0][1].covariance[0, 0]
    assert ratio > 1


def test_two_runs_share_landmarks() -> None:
    """What one robot says of a landmark helps the other."""
    run, marks = session(seed=4)
    alone = smooth([run], marks, GEOMETRY, PRIORS)
    both = smooth([run, session(seed=5)[0]], marks, GEOMETRY, PRIORS)
    for cell in CODES:
        assert both.marks[cell].covariance[0, 0] < alone.marks[cell].covariance[0, 0]
    assert compose(both.stays[1][0].pose, np.zeros(3)).shape == (3,)
