"""Derivative dynamic time warping: the definition, the kernel, and what it is for."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core import kernels
from locatk.core.errors import InputError
from locatk.core.polaris.published import ddtw
from locatk.core.polaris.published.templates import TemplateGrid, template_set, templates
from locatk.core.polaris.tag import Tags

Array = NDArray[np.float64]

needs_kernels = pytest.mark.skipif(
    kernels.kernels is None, reason="the compiled kernels were not built (no C compiler)"
)

SIZES = [(80, 80, 40), (31, 80, 33), (80, 15, 1), (3, 9, 32), (7, 3, 5), (3, 3, 64)]


def walk(seed: int, *shape: int) -> Array:
    return np.cumsum(np.random.default_rng(seed).normal(size=shape), axis=-2)


def by_definition(a: Array, b: Array) -> float:
    """Written from Keogh and Pazzani's text, number by number."""

    def slopes(series: Array) -> list[list[float]]:
        result = [
            [
                ((series[i][axis] - series[i - 1][axis])
                 + (series[i + 1][axis] - series[i - 1][axis]) / 2) / 2
                for axis in range(3)
            ]
            for i in range(1, len(series) - 1)
        ]  # fmt: skip
        scale = math.sqrt(sum(math.hypot(*slope) ** 2 for slope in result) / len(result))
        return [[value / scale for value in slope] for slope in result]

    q, c = slopes(a), slopes(b)
    total: dict[tuple[int, int], float] = {}
    for i in range(len(q)):
        for j in range(len(c)):
            ways = [total[p] for p in ((i - 1, j - 1), (i - 1, j), (i, j - 1)) if p in total]
            total[i, j] = math.dist(q[i], c[j]) + (min(ways) if ways else 0.0)
    return total[len(q) - 1, len(c) - 1]


@pytest.mark.parametrize(("n", "length", "count"), SIZES)
def test_distances_are_those_of_the_definition(n: int, length: int, count: int) -> None:
    window, generated = walk(1, n, 3), walk(2, count, length, 3)
    result = ddtw.distances(window, ddtw.prepare(generated))
    assert result.shape == (count,)
    some = range(0, count, max(count // 4, 1))
    expected = [by_definition(window, generated[k]) for k in some]
    np.testing.assert_allclose(result[list(some)], expected, rtol=2e-5)


@needs_kernels
@pytest.mark.parametrize(("n", "length", "count"), SIZES)
def test_the_kernel_is_its_twin(
    n: int, length: int, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    window, slopes = walk(3, n, 3), ddtw.prepare(walk(4, count, length, 3))
    mine = ddtw.distances(window, slopes)
    monkeypatch.setattr(ddtw, "kernels", None)
    np.testing.assert_allclose(mine, ddtw.distances(window, slopes), rtol=1e-5)


@needs_kernels
def test_the_kernel_takes_slopes_in_any_memory_order() -> None:
    window, slopes = walk(3, 20, 3), ddtw.prepare(walk(4, 50, 20, 3))
    strided = np.asfortranarray(slopes)
    np.testing.assert_array_equal(ddtw.distances(window, strided), ddtw.distances(window, slopes))


def test_offset_and_scale_of_a_sensor_do_not_matter() -> None:
    window, slopes = walk(5, 40, 3), ddtw.prepare(walk(6, 20, 60, 3))
    moved = 1e-6 * window + np.array([3e-5, -2e-5, 4e-5])
    np.testing.assert_allclose(
        ddtw.distances(moved, slopes), ddtw.distances(window, slopes), rtol=1e-4
    )


def test_slopes_keep_their_size_at_any_sampling_density() -> None:
    # The standard deviation of the samples would not do: the derivative is one per sample.
    coarse, fine = (template_set(Tags(), 0.01, TemplateGrid(points=n)).field_t for n in (40, 160))
    for series in (coarse, fine):
        size = np.square(ddtw.normalised_slopes(series)).sum(axis=-1).mean(axis=-1)
        np.testing.assert_allclose(size, 1, rtol=1e-9)


def test_the_axes_keep_their_proportions() -> None:
    series = walk(10, 30, 3) * [1.0, 2.0, 5.0]
    ratio = ddtw.normalised_slopes(series) / ddtw.derivative(series)
    np.testing.assert_allclose(ratio, ratio[0, 0], rtol=1e-9)


def test_a_template_is_nearest_to_itself_at_other_speeds() -> None:
    generated = template_set(Tags(), 0.01, TemplateGrid(orientations=18))
    slopes = ddtw.prepare(generated.field_t)
    for k in range(0, 90, 7):
        assert ddtw.distances(generated.field_t[k], slopes)[k] == 0
        where = np.linspace(0, 79, 80) + 3 * np.sin(np.linspace(0, math.tau, 80))
        warped = np.column_stack(
            [np.interp(where, np.arange(80), generated.field_t[k, :, axis]) for axis in range(3)]
        )
        near = int(ddtw.distances(warped, slopes).argmin())
        rotated = generated.angle_rad[near] - generated.angle_rad[k]
        assert abs(math.remainder(rotated, math.tau)) < math.radians(21)


def test_each_orientation_is_identified_below_a_sensor() -> None:
    # Where the axes are brought to one size each, those of a quadrant are the same, and those
    # with an axis of zeros (0, 90, 180 and 270 degrees) are not numbers.
    angles = np.linspace(0, math.tau, 36, endpoint=False)
    generated = templates(
        Tags().magnet, 0.01, np.linspace(-0.04, 0.04, 80), np.zeros(1), angles
    ).field_t
    slopes = ddtw.prepare(generated)
    noisy = generated + np.random.default_rng(7).normal(0, 2e-7, generated.shape)
    assert [int(ddtw.distances(window, slopes).argmin()) for window in noisy] == list(range(36))


def test_a_constant_field_is_no_signal() -> None:
    slopes = ddtw.prepare(np.stack([np.full((20, 3), 0.3), walk(8, 20, 3)]))
    assert np.all(slopes[..., 0] == 0)
    still = ddtw.distances(np.full((20, 3), 5e-5), slopes)
    assert still[0] == 0
    assert np.isfinite(still).all()


@pytest.mark.parametrize("n", [0, 1, 2])
def test_too_few_samples_have_no_derivative(n: int) -> None:
    with pytest.raises(InputError, match="three samples"):
        ddtw.distances(np.zeros((n, 3)), ddtw.prepare(walk(9, 4, 20, 3)))
