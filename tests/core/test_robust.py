"""Random sampling consensus and robust scale."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.robust import consensus, robust_sigma

Array = NDArray[np.float64]


def fit_line(a: Array, b: Array) -> Array:
    """Lines b = slope a + offset through points (..., n, 1), as (..., 1, 2)."""
    mean_a, mean_b = a.mean(axis=-2, keepdims=True), b.mean(axis=-2, keepdims=True)
    above = np.sum((a - mean_a) * (b - mean_b), axis=(-1, -2))
    across = np.sum((a - mean_a) ** 2, axis=(-1, -2))
    slope = above / np.where(across > 0, across, np.nan)
    offset = mean_b[..., 0, 0] - slope * mean_a[..., 0, 0]
    return np.stack([slope, offset], axis=-1)[..., None, :]


def miss(model: Array, a: Array, b: Array) -> Array:
    return np.asarray(model[..., :1] * a[..., 0] + model[..., 1:] - b[..., 0])[..., 0, :]


@pytest.mark.parametrize("n", [30, 63, 64, 500, 5000])
@pytest.mark.parametrize("share", [0.0, 0.3])
def test_outliers_do_not_bend_the_line(n: int, share: float) -> None:
    rng = np.random.default_rng(n)
    a = rng.uniform(-1, 1, (n, 1))
    b = 2 * a + 1 + rng.normal(0, 0.01, (n, 1))
    wrong = rng.random(n) < share
    b[wrong] += rng.uniform(0.5, 3, (np.count_nonzero(wrong), 1))
    model, inliers = consensus(fit_line, miss, a, b, sample_size=2, gate=0.05)
    np.testing.assert_array_equal(inliers, ~wrong)
    np.testing.assert_allclose(model, fit_line(a[~wrong], b[~wrong]))


def test_same_seed_same_answer() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.random((100, 1)), rng.random((100, 1))
    answers = [consensus(fit_line, miss, a, b, sample_size=2, gate=0.05, seed=s) for s in (4, 4)]
    np.testing.assert_array_equal(answers[0][0], answers[1][0])
    np.testing.assert_array_equal(answers[0][1], answers[1][1])


@pytest.mark.parametrize(("n", "sample"), [(10, 2), (63, 8), (64, 8), (200, 8)])
def test_every_member_of_a_sample_is_another(n: int, sample: int) -> None:
    # A sample that holds one point twice determines nothing: such trials are lost.
    samples: list[Array] = []

    def watched(a: Array, b: Array) -> Array:
        if a.ndim == 3:
            samples.append(a[..., 0])
        return np.ones((*a.shape[:-2], 1, 2))

    a = np.arange(n, dtype=float)[:, None]
    consensus(watched, miss, a, 2 * a, sample_size=sample, gate=0.1, trials=150)
    (picks,) = samples
    assert picks.shape == (150, sample)
    assert np.mean([len(np.unique(row)) == sample for row in picks]) > 0.95


def test_a_model_without_residual_does_not_win() -> None:
    def sometimes(a: Array, b: Array) -> Array:
        model = fit_line(a, b)
        if model.ndim == 3:
            model[::2] = np.nan
        return model

    a = np.linspace(0, 1, 40)[:, None]
    model, inliers = consensus(sometimes, miss, a, 3 * a, sample_size=2, gate=0.01)
    np.testing.assert_allclose(model[0], [3, 0], atol=1e-12)
    assert inliers.all()


def test_sigma_is_that_of_most_values() -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(0, 0.2, 10_000)
    assert robust_sigma(values) == pytest.approx(0.2, rel=0.03)
    values[:1000] = 50
    assert robust_sigma(values) == pytest.approx(0.2, rel=0.2)
    values[1000:2000] = np.nan
    assert robust_sigma(values) == pytest.approx(0.2, rel=0.25)


def test_sigma_of_nothing_is_zero() -> None:
    assert robust_sigma(np.zeros(0)) == 0.0
    assert robust_sigma(np.array([np.nan, np.inf])) == 0.0
