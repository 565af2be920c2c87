"""Magnets as built: passes in frames of their own, laid over each other."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.errors import InputError
from locatk.core.polaris.calibration import TagPass, calibrate
from locatk.core.polaris.codec import layout_of
from locatk.core.polaris.tag import AsBuiltTag, Tags, as_built_magnets

TAGS = Tags()
ID = 123_456
LAYOUT = layout_of(TAGS, ID)


def passes(
    count: int, seed: int = 0, *, noise_m: float = 0.0, noise_rad: float = 0.0
) -> tuple[np.ndarray, list[TagPass]]:
    """A tag built by hand (5, 3), and passes over it in frames that mean nothing."""
    rng = np.random.default_rng(seed)
    real = AsBuiltTag(rng.normal(size=(5, 2)) * 5e-4, rng.normal(size=5) * 0.1)
    position, angle = as_built_magnets(replace(TAGS, built={ID: real}), ID, LAYOUT)
    generated = []
    for k in range(count):
        rotation, shift = rng.uniform(-9, 9), rng.normal(size=2)
        c, s = math.cos(rotation), math.sin(rotation)
        observed = np.column_stack([position @ [[c, s], [-s, c]] + shift, angle + rotation])
        observed += rng.normal(size=(5, 3)) * [noise_m, noise_m, noise_rad]
        generated.append(TagPass(f"run {k}", ID, observed, np.full((5, 3), np.nan)))
    return np.column_stack([position, angle]), generated


def shape_of(built: AsBuiltTag) -> np.ndarray:
    """Distances between magnets, and angles against the first one: nothing of a frame."""
    position, angle = as_built_magnets(replace(TAGS, built={ID: built}), ID, LAYOUT)
    apart = np.linalg.norm(position[:, None] - position[None], axis=2)[np.triu_indices(5, 1)]
    along = np.arctan2(*(position[-1] - position[0])[::-1])
    return np.r_[apart, np.cos(angle - along), np.sin(angle - along)]


@pytest.mark.slow
@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10_000), st.integers(2, 8))
def test_exact_passes_give_the_exact_shape(seed: int, count: int) -> None:
    real, generated = passes(count, seed)
    (report,) = calibrate(TAGS, generated).calibrated
    nominal, angle = as_built_magnets(TAGS, ID, LAYOUT)
    expected = AsBuiltTag(real[:, :2] - nominal, real[:, 2] - angle)
    np.testing.assert_allclose(shape_of(report.built), shape_of(expected), atol=1e-8)
    assert report.scatter_m.max() < 1e-8
    # On the grid by least squares: neither moved nor turned as a whole.
    offset, arms = report.built.offset_m, nominal - nominal.mean(axis=0)
    np.testing.assert_allclose(offset.sum(axis=0), 0, atol=1e-12)
    assert abs(np.sum(arms[:, 0] * offset[:, 1] - arms[:, 1] * offset[:, 0])) < 1e-9


@pytest.mark.slow
def test_scatter_is_that_of_the_passes() -> None:
    _, generated = passes(400, noise_m=2e-4, noise_rad=0.02)
    (report,) = calibrate(TAGS, generated).calibrated
    # A pass's own place and turn, 3 of its 10 numbers, take their part of the noise.
    assert np.sqrt(np.mean(report.scatter_m**2)) == pytest.approx(2e-4 * math.sqrt(1.4), rel=0.05)
    assert report.scatter_rad.mean() == pytest.approx(0.02, rel=0.1)
    assert 5e-5 < report.sigma_stretch < 5e-4


def test_a_pass_that_is_known_better_counts_more() -> None:
    real, generated = passes(2)
    worse = generated[1].observed.copy()
    worse[2, 0] += 1e-3
    sure = np.full((5, 3), 1e-5)
    for sigma, fraction in ((1e-5, 0.5), (1e-2, 0.0)):
        both = [replace(generated[0], sigma=sure), TagPass("b", ID, worse, np.full((5, 3), sigma))]
        (report,) = calibrate(TAGS, both).calibrated
        nominal, angle = as_built_magnets(TAGS, ID, LAYOUT)
        exact = shape_of(AsBuiltTag(real[:, :2] - nominal, real[:, 2] - angle))
        off = np.abs(shape_of(report.built) - exact)[:10].max()
        assert off == pytest.approx(1e-3 * fraction, abs=2e-4)


def test_a_magnet_that_some_passes_miss_is_measured_by_the_others() -> None:
    real, generated = passes(4)
    for k, magnet in ((0, 1), (2, 3)):
        generated[k].observed[magnet] = np.nan
    (report,) = calibrate(TAGS, generated).calibrated
    assert report.passes.tolist() == [4, 3, 4, 3, 4]
    nominal, angle = as_built_magnets(TAGS, ID, LAYOUT)
    expected = AsBuiltTag(real[:, :2] - nominal, real[:, 2] - angle)
    np.testing.assert_allclose(shape_of(report.built), shape_of(expected), atol=1e-8)


def test_a_magnet_detected_once_is_named() -> None:
    _, generated = passes(3)
    for k in (0, 1):
        generated[k].observed[2] = np.nan
    cell = LAYOUT.cells[2]
    with pytest.raises(InputError, match="observed 1 times") as caught:
        calibrate(TAGS, generated)
    assert str(cell) in str(caught.value)


@pytest.mark.parametrize("what", [(0, 3e-3), (2, 0.3)])
def test_a_stray_pass_moves_nothing(what: tuple[int, float]) -> None:
    _, generated = passes(5, noise_m=5e-5, noise_rad=5e-3)
    (clean,) = calibrate(TAGS, generated[:4]).calibrated
    column, by = what
    generated[4].observed[1, column] += by
    report = calibrate(TAGS, generated)
    assert report.calibrated[0].disagree == ("run 4",)
    assert report.left_out == {"run 4": f"disagrees on tag {ID} with the others"}
    np.testing.assert_array_equal(report.calibrated[0].built.offset_m, clean.built.offset_m)


def test_large_deviations_from_the_design_are_reported() -> None:
    _, generated = passes(3)
    for each in generated:
        # A speed that is told 3 % too low, on the same way each time.
        rotation = each.observed[:, 2] - as_built_magnets(TAGS, ID, LAYOUT)[1]
        c, s = math.cos(rotation[0]), math.sin(rotation[0])
        each.observed[:, :2] = each.observed[:, :2] @ [[c, -s], [s, c]] * [0.97, 1]
        each.observed[:, 2] -= rotation[0] - 0.6 * (np.arange(5) == 4)
    report = calibrate(TAGS, generated)
    assert report.calibrated[0].stretch == pytest.approx(0.97, abs=0.01)
    stretched, rotated = report.notes
    assert "shorter along the travel" in stretched
    assert f"cell {LAYOUT.cells[4]} is" in rotated


def test_scatter_of_two_passes_is_that_of_their_population() -> None:
    """Two angles that differ by d have a standard deviation of d / sqrt(2)."""
    _, generated = passes(2)
    generated[1].observed[2, 2] += 0.02
    (report,) = calibrate(TAGS, generated).calibrated
    assert report.scatter_rad[2] == pytest.approx(0.02 / math.sqrt(2), rel=1e-6)
