"""Block-tridiagonal systems against dense matrices."""

from __future__ import annotations

from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from locatk.core import block_tridiagonal
from locatk.core.block_tridiagonal import BlockTridiagonal
from locatk.core.errors import DegenerateError

Array = NDArray[np.float64]


def random_blocks(count: int, size: int, seed: int) -> tuple[Array, Array, Array]:
    """Return blocks on and above the diagonal of a positive definite matrix, and the matrix."""
    rng = np.random.default_rng(seed)
    dense = np.eye(count * size)
    # A sum of squares that each involve two neighbouring states.
    for i in range(count - 1):
        rows = slice(i * size, (i + 2) * size)
        factor = rng.normal(size=(2 * size, 2 * size))
        dense[rows, rows] += factor @ factor.T
    blocks = dense.reshape(count, size, count, size).swapaxes(1, 2)
    index = np.arange(count)
    return blocks[index, index].copy(), blocks[index[:-1], index[1:]].copy(), dense


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 7), st.integers(1, 5), st.integers(0, 1000), st.sampled_from([1, 3, 32, 70]))
def test_solutions_and_inverse_are_those_of_the_dense_matrix(
    count: int, size: int, seed: int, columns: int
) -> None:
    diagonal, above, dense = random_blocks(count, size, seed)
    system = BlockTridiagonal(diagonal, above)
    rng = np.random.default_rng(seed)
    one, several = rng.normal(size=(count, size)), rng.normal(size=(count, size, columns))
    solution = system.solve(one)
    assert solution.shape == one.shape
    np.testing.assert_allclose(dense @ solution.ravel(), one.ravel(), atol=1e-8)
    solution = system.solve(several)
    assert solution.shape == several.shape
    flat = (count * size, columns)
    np.testing.assert_allclose(dense @ solution.reshape(flat), several.reshape(flat), atol=1e-8)
    half = system.half_solve(several)
    assert half.shape == several.shape
    with patch.object(block_tridiagonal, "kernels", None):
        np.testing.assert_allclose(half, system.half_solve(several), atol=1e-9)
        np.testing.assert_allclose(solution, system.solve(several), atol=1e-9)
    half, flat_right = half.reshape(flat), several.reshape(flat)
    np.testing.assert_allclose(half.T @ half, flat_right.T @ solution.reshape(flat), atol=1e-8)
    inverse = np.linalg.inv(dense).reshape(count, size, count, size).swapaxes(1, 2)
    index = np.arange(count)
    own, beside = system.inverse_blocks
    assert own.shape == diagonal.shape
    assert beside.shape == above.shape
    np.testing.assert_allclose(own, inverse[index, index], atol=1e-9)
    np.testing.assert_allclose(beside, inverse[index[:-1], index[1:]], atol=1e-9)


def test_arguments_are_not_changed() -> None:
    diagonal, above, _ = random_blocks(3, 2, 0)
    given = diagonal.copy(), above.copy(), np.ones((3, 2))
    system = BlockTridiagonal(given[0], given[1])
    first = system.solve(given[2])
    assert system.inverse_blocks[0].shape == (3, 2, 2)
    np.testing.assert_array_equal(given[0], diagonal)
    np.testing.assert_array_equal(given[1], above)
    np.testing.assert_array_equal(given[2], 1.0)
    np.testing.assert_array_equal(system.solve(given[2]), first)


@pytest.mark.parametrize("eigenvalue", [-0.1, -1e-6])
def test_an_indefinite_matrix_is_refused(eigenvalue: float) -> None:
    diagonal, above, dense = random_blocks(4, 3, 1)
    smallest = np.linalg.eigvalsh(dense)[0]
    diagonal = diagonal - (smallest - eigenvalue) * np.eye(3)
    # Each block alone is positive definite.
    assert np.linalg.eigvalsh(diagonal).min() > 0.0
    with pytest.raises(DegenerateError, match="not determined"):
        BlockTridiagonal(diagonal, above)
