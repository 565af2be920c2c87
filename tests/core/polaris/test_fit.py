"""The fit from a start nearby: its derivatives, its optimum, its covariance."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.polaris.detection.field_model import disc_correction
from locatk.core.polaris.detection.fit import PassProblem, PassState, fit_pass, sample_weights
from locatk.core.polaris.detection.motion import MOTION_GROUPS, Motion
from locatk.core.polaris.detection.window import PassPriors, PassWindow
from locatk.core.polaris.tag import Magnet

Array = NDArray[np.float64]

CELLS = ((0, 0), (1, 1), (0, 2), (2, 2))
SYMBOLS = (0, 3, 5, 6)
NOISE = 5e-7
STEP = 1e-3


def posed(
    world: Any, *, known: bool, seed: int = 0, order: bool = False, noise: float = NOISE
) -> tuple[PassWindow, PassState, Any]:
    """A pass over four magnets of magpylib, the true state, and the tag.

    The bar goes through 0 in the middle of the pass; with ``order`` x, y and z are
    converted 4 ms apart.
    """
    tag = world.Tag(CELLS, SYMBOLS, heading=0.4, spacing=0.03)
    delay = (0.0, 4e-3, 8e-3) if order else (0.0, 0.0, 0.0)
    array = world.bar(7, noise=NOISE, delay=delay)
    samples = world.record([tag], world.line(length=0.16), array=array, noise=noise, seed=seed)
    n = len(samples)
    path = STEP * np.arange(n) - 0.08
    window = PassWindow(
        field_t=samples.field_t,
        sensors_m=array.position_m,
        noise_t=np.full((7, 3), NOISE),
        time_periods=np.arange(n, dtype=float),
        counts=np.ones(n, np.intp),
        axis_order=np.array([-1.0, 0.0, 1.0]) if order else np.zeros(3),
        path_m=path if known else None,
        disc_correction_m2=disc_correction(Magnet()),
    )
    moment = Magnet().moment * np.column_stack(
        [np.cos(tag.angles), np.sin(tag.angles), 0 * tag.angles]
    )
    return window, PassState(tag.places, moment, path, STEP, 0.01), tag


def perturbed(state: PassState, seed: int = 3) -> PassState:
    rng = np.random.default_rng(seed)
    return replace(
        state,
        position_m=state.position_m + 2e-3 * rng.standard_normal(state.position_m.shape),
        moment_am2=0 * state.moment_am2,
        height_m=0.0115,
    )


def test_side_of_the_normal_equations_is_the_slope_of_the_cost(world: Any) -> None:
    """Places, height, skew and crab: half the slope, downhill, for point dipoles."""
    window, truth, _ = posed(world, known=True, order=True)
    window = replace(window, disc_correction_m2=0.0)
    start = replace(perturbed(truth), skew_periods=0.2, crab_rad=0.01)
    weight = 1 / np.broadcast_to(window.noise_t**2, window.field_t.shape)
    problem = PassProblem(window, PassPriors(), weight, start)
    problem = problem.with_free(frozenset({"crab", "tilt"}))
    trial = problem.project(start)
    side = problem.reduce(trial).descent

    def cost(**moved: Any) -> float:
        return problem.project(replace(trial.state, **moved)).cost

    m = len(truth.position_m)
    step = 1e-8
    for axis in range(2):
        for k in range(m):
            shift = np.zeros((m, 2))
            shift[k, axis] = step
            position = trial.state.position_m
            slope = (cost(position_m=position + shift) - cost(position_m=position - shift)) / (
                2 * step
            )
            assert side[axis * m + k] == pytest.approx(
                -slope / 2, rel=2e-4, abs=1e-4 * np.abs(side).max()
            )
    steps = (("height_m", 1e-8), ("skew_periods", 1e-5), ("crab_rad", 1e-6))
    for position, (name, step) in enumerate(steps):
        value = getattr(trial.state, name)
        slope = (cost(**{name: value + step}) - cost(**{name: value - step})) / (2 * step)
        assert side[2 * m + position] == pytest.approx(-slope / 2, rel=2e-3)


@pytest.mark.slow
def test_descent_of_a_motion_is_the_slope_of_the_cost(world: Any) -> None:
    window, truth, _ = posed(world, known=True)
    window = replace(window, disc_correction_m2=0.0)
    motion = Motion.straight(truth.path_m, 0.0, truth.height_m)
    rng = np.random.default_rng(1)
    motion = motion.with_added(motion.sigmas * rng.normal(size=len(motion.sigmas)))
    free = frozenset(MOTION_GROUPS)
    start = replace(perturbed(truth), motion=motion, free=free)
    problem = PassProblem(window, PassPriors(), sample_weights(window), start)
    trial = problem.project(start)
    descent = problem.reduce(trial).descent[2 * len(truth.position_m) + 3 :]

    def cost(change: Array) -> float:
        return problem.project(replace(trial.state, motion=motion.with_added(change))).cost

    scale = motion.sigmas * 1e-4
    for k, step in enumerate(np.diag(scale)):
        slope = (cost(step) - cost(-step)) / (2 * scale[k])
        assert descent[k] == pytest.approx(-slope / 2, rel=2e-3)


@pytest.mark.parametrize("known", [True, False])
def test_magnets_of_magpylib_are_found_from_a_start_nearby(known: bool, world: Any) -> None:
    window, truth, tag = posed(world, known=known)
    fitted = fit_pass(window, perturbed(truth), PassPriors())
    assert fitted.converged
    assert fitted.rms_sigma == pytest.approx(1.0, abs=0.06)
    position = fitted.state.position_m - (
        0 if known else (fitted.state.position_m - tag.places).mean(axis=0) * [1, 0]
    )
    np.testing.assert_allclose(position[:, 1], tag.places[:, 1], atol=5e-5)
    np.testing.assert_allclose(position[:, 0], tag.places[:, 0], atol=5e-5 if known else 4e-4)
    angle = np.arctan2(fitted.state.moment_am2[:, 1], fitted.state.moment_am2[:, 0])
    assert np.abs(world.turn(angle, tag.angles)).max() < np.radians(0.3)
    assert fitted.state.height_m == pytest.approx(0.01, abs=1e-4)


def test_many_starts_one_optimum(world: Any) -> None:
    window, truth, _ = posed(world, known=True)
    fits = [fit_pass(window, perturbed(truth, seed), PassPriors()) for seed in range(6)]
    assert np.ptp([fitted.state.position_m for fitted in fits], axis=0).max() < 2e-6


def test_free_steps_follow_an_uneven_path(world: Any) -> None:
    """The speed swings by a quarter, and once eight samples are lost of which the clock
    knows nothing; the start is a steady drive."""
    window, truth, _ = posed(world, known=False)
    expected = np.cumsum(1 + 0.25 * np.sin(np.arange(150) / 15))
    expected[75:] += 8
    rows = np.unique(np.rint(expected[expected < 159]).astype(int))
    n = len(rows)
    uneven = replace(
        window,
        field_t=window.field_t[rows],
        time_periods=np.arange(n, dtype=float),
        counts=np.ones(n, np.intp),
    )
    steady = np.linspace(truth.path_m[rows[0]], truth.path_m[rows[-1]], n)
    start = replace(perturbed(truth), path_m=steady, mean_step_m=float(np.diff(steady).mean()))
    fitted = fit_pass(uneven, start, PassPriors())
    inner = slice(15, -15)
    miss = (fitted.state.path_m - truth.path_m[rows])[inner]
    assert fitted.rms_sigma < 1.15
    assert np.ptp((steady - truth.path_m[rows])[inner]) > 6e-3
    assert np.ptp(miss) < 1e-3
    # Against its own middle, and in its own standard deviations (of the whole of it).
    assert np.median(np.abs(miss - np.median(miss))) < 3 * np.median(fitted.path_sigma_m)


def test_skew_of_the_conversion_is_found(world: Any) -> None:
    """4 ms of 10 between two axes: 0.4 of a sample period."""
    window, truth, _ = posed(world, known=True, order=True)
    start, priors = replace(perturbed(truth), skew_periods=0.1), PassPriors(skew_periods=(0.1, 0.5))
    fitted = fit_pass(window, start, priors)
    assert fitted.state.skew_periods == pytest.approx(0.4, abs=0.02)
    unaware = fit_pass(replace(window, axis_order=np.zeros(3)), perturbed(truth), PassPriors())
    assert unaware.rms_sigma > 1.3 * fitted.rms_sigma


@pytest.mark.slow
def test_covariance_is_that_of_many_noises(world: Any) -> None:
    """Errors over 30 draws of the noise against the covariance of one, way known."""
    _, truth, tag = posed(world, known=True)
    clean, _, _ = posed(world, known=True, noise=0.0)
    rng = np.random.default_rng(5)
    errors, spreads = [], []
    for _ in range(30):
        noisy = replace(
            clean, field_t=clean.field_t + NOISE * rng.standard_normal(clean.field_t.shape)
        )
        fitted = fit_pass(noisy, truth, PassPriors(crab_sigma_rad=1e-5, tilt_sigma=1e-4))
        angle = np.arctan2(fitted.state.moment_am2[:, 1], fitted.state.moment_am2[:, 0])
        errors.append(np.column_stack([fitted.state.position_m, angle]))
        spreads.append(np.sqrt(np.diag(fitted.covariance)).reshape(-1, 3))
    scatter = np.std(errors, axis=0)
    ratio = np.sqrt(np.mean((scatter / np.mean(spreads, axis=0)) ** 2, axis=0))
    assert np.all(ratio > 0.8)
    assert np.all(ratio < 1.2)
    assert tag.cells == CELLS


def test_outliers_are_weighted_down(world: Any) -> None:
    window, truth, tag = posed(world, known=True)
    rng = np.random.default_rng(2)
    field = window.field_t.copy()
    field[rng.random(field.shape) < 0.01] += 4e-5
    fitted = fit_pass(replace(window, field_t=field), perturbed(truth), PassPriors())
    assert np.linalg.norm(fitted.state.position_m - tag.places, axis=1).max() < 1e-4


def test_missing_samples_are_no_samples(world: Any) -> None:
    window, truth, tag = posed(world, known=True)
    field = window.field_t.copy()
    field[:, 3] = np.nan
    field[60:70] = np.nan
    fitted = fit_pass(replace(window, field_t=field), perturbed(truth), PassPriors())
    assert np.isnan(fitted.residual[:, 3]).all()
    assert np.isnan(fitted.residual[65]).all()
    assert np.linalg.norm(fitted.state.position_m - tag.places, axis=1).max() < 1e-4


def test_undetermined_parameters_are_an_error(world: Any) -> None:
    window, truth, _ = posed(world, known=True)
    nothing = replace(window, field_t=np.full_like(window.field_t, np.inf))
    with pytest.raises(DegenerateError):
        fit_pass(nothing, truth, PassPriors())


def test_steps_are_limited_to_a_fraction_of_the_height(world: Any) -> None:
    """Far from the minimum the derivatives would move a magnet by several heights."""
    window, truth, _ = posed(world, known=True)
    start = replace(truth, position_m=truth.position_m + 0.012, moment_am2=0 * truth.moment_am2)
    weight = 1 / np.broadcast_to(window.noise_t**2, window.field_t.shape)
    problem = PassProblem(window, PassPriors(), weight, start)
    equations = problem.linearize(start, np.arange(1))
    moved = problem.retract(start, equations.solve(np.array([1e-9]), np.arange(1)))
    change = np.abs(moved.position_m - start.position_m).max()
    assert change == pytest.approx(0.7 * start.height_m)
    assert 0.7 * start.height_m <= moved.height_m <= 1.4 * start.height_m


def test_clusters_of_a_path_that_diverges_need_little_memory(world: Any) -> None:
    window, truth, _ = posed(world, known=False)
    problem = PassProblem(window, PassPriors(), sample_weights(window), truth)
    far = np.where(np.arange(len(truth.path_m)) < 3, truth.path_m, 1e8 + truth.path_m)
    stretches, sensors = problem.clusters(replace(truth, path_m=far))
    assert stretches.shape[0] < 10_000
    for clusters in (stretches, sensors):
        assert np.all(clusters.sum(axis=0) == 1)
