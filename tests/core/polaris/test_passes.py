"""Where the bar was over magnets, and how noisy it is: recordings of the independent world."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from locatk.core.polaris import passes

CELLS = ((0, 0), (1, 1), (0, 2), (1, 2), (2, 2))
SYMBOLS = (0, 3, 5, 2, 6)


def found(samples: Any) -> list[passes.Pass]:
    return passes.find(samples, passes.noise(samples))


@pytest.mark.parametrize("noise", [0.2e-6, 1e-6])
def test_noise_beside_magnets(noise: float, world: Any) -> None:
    """It is that of the sensors although magnets pass for half of the recording."""
    tag = world.Tag(CELLS, SYMBOLS)
    samples = world.record([tag], world.line(length=0.3), noise=noise)
    np.testing.assert_allclose(np.median(passes.noise(samples)), noise, rtol=0.12)
    assert passes.noise(samples).shape == (9, 3)


def test_noise_by_sensor_and_axis(world: Any) -> None:
    samples = world.record([], world.line(length=2.0, speed=0.1), noise=0.0)
    rng = np.random.default_rng(1)
    truth = rng.uniform(0.2e-6, 3e-6, (9, 3))
    noisy = world.spoiled(samples, samples.field_t + truth * rng.standard_normal((2000, 9, 3)))
    np.testing.assert_allclose(passes.noise(noisy), truth, rtol=0.2)


def test_noise_of_few_samples_is_what_the_array_states(world: Any) -> None:
    samples = world.record([], world.line(length=0.02), array=world.bar(noise=7e-7))
    np.testing.assert_array_equal(passes.noise(samples), np.full((9, 3), 7e-7))


def test_noise_is_never_less_than_the_quantum_allows(world: Any) -> None:
    quantum = np.array([1.5e-7, 1.5e-7, 2.4e-7])
    array = replace(world.bar(), quantum_t=quantum)
    still = world.record([], world.line(), array=array, noise=0.0)
    assert np.all(passes.noise(still) >= quantum / 4)
    bare = world.record([], world.line(), noise=0.0)
    assert np.all(passes.noise(bare) > 0)


@pytest.mark.parametrize("step_mm", [0.1, 0.3, 1.0, 4.0, 8.0])
def test_one_pass_a_tag_and_all_of_it(step_mm: float, world: Any) -> None:
    course = world.line(length=1.2, speed=step_mm / 10)
    samples = world.record([world.Tag(CELLS, SYMBOLS, heading=0.7)], course, seed=3)
    (part,) = found(samples)
    x = np.linspace(-0.6, 0.6, len(samples), endpoint=False)
    tag = world.Tag(CELLS, SYMBOLS, heading=0.7)
    assert x[part.first] < tag.places[:, 0].min() - 0.008
    assert x[part.stop - 1] > tag.places[:, 0].max() + 0.008
    assert x[part.stop - 1] - x[part.first] < 0.26 + 50 * step_mm * 1e-3  # not all of it


def test_tags_far_apart_are_passes_of_their_own(world: Any) -> None:
    tags = [world.Tag(CELLS, SYMBOLS, x=x) for x in (-0.5, 0.0, 0.5)]
    parts = found(world.record(tags, world.line(length=1.4)))
    assert len(parts) == 3
    for part, x in zip(parts, (-0.5, 0.0, 0.5), strict=True):
        assert part.first < (x + 0.7) * 1000 < part.stop
    assert all(a.stop <= b.first for a, b in pairwise(parts))


def test_the_end_of_the_recording_is_the_end_of_the_pass(world: Any) -> None:
    samples = world.record([world.Tag(CELLS, SYMBOLS)], world.line(length=0.3))
    cut = replace(samples, time_ns=samples.time_ns[:150], field_t=samples.field_t[:150])
    (part,) = found(cut)
    assert part.stop == 150


def test_noise_alone_is_no_pass(world: Any) -> None:
    for seed in range(5):
        assert found(world.record([], world.line(length=3.0), seed=seed)) == []


def test_what_all_sensors_share_is_no_pass(world: Any) -> None:
    """The robot turns under the Earth's field; its motors start and stop."""
    samples = world.record([], world.line(length=1.0))
    n = len(samples)
    u = np.linspace(0, 6, n)
    common = 40e-6 * np.column_stack([np.cos(u), np.sin(u), 0 * u])
    common += 8e-6 * (np.arange(n) // 40 % 2)[:, None]
    assert found(world.spoiled(samples, samples.field_t + common[:, None])) == []


@pytest.mark.parametrize("missing", [0.0, 0.1])
def test_sensors_that_give_nothing_do_not_hide_the_tag(missing: float, world: Any) -> None:
    samples = world.record([world.Tag(CELLS, SYMBOLS)], world.line(length=0.4))
    field = samples.field_t.copy()
    field[:, 2] = np.nan
    field[np.random.default_rng(0).random(field.shape[:2]) < missing] = np.nan
    (part,) = found(world.spoiled(samples, field))
    assert part.first < 160
    assert part.stop > 240


def test_even_one_sensor_sees_that_magnets_passed(world: Any) -> None:
    samples = world.record([world.Tag(CELLS, SYMBOLS)], world.line(length=0.4), array=world.bar(1))
    assert found(samples)
