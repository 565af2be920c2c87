"""Symmetric positive definite block-tridiagonal systems: the normal equations of a chain of states.

The Cholesky factorization is the banded one of LAPACK. The blocks of the inverse on and beside
the diagonal, which are the covariances of the states, follow from the factor in one backward pass
(Takahashi, Fagan and Chen 1973; for chains the smoother of Rauch, Tung and Striebel 1965).
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_solve_banded, cholesky_banded
from scipy.linalg.lapack import dtbtrs

from locatk.core.errors import DegenerateError
from locatk.core.kernels import kernels

Array = NDArray[np.float64]


class BlockTridiagonal:
    """Cholesky factorization of a symmetric block-tridiagonal matrix.

    Parameters
    ----------
    diagonal : (k, d, d) ndarray
        Blocks on the diagonal.
    above : (k - 1, d, d) ndarray
        Blocks above the diagonal, in rows 0 to k - 2.

    Raises
    ------
    DegenerateError
        The matrix is not positive definite.
    """

    def __init__(self, diagonal: Array, above: Array) -> None:
        k, d, _ = diagonal.shape
        self.count, self.size = k, d
        lower = np.zeros((2 * d, k * d))
        columns = np.arange(k) * d
        for j in range(d):
            for i in range(j, d):
                lower[i - j, columns + j] = diagonal[:, i, j]
            for i in range(d):
                lower[d + i - j, columns[:-1] + j] = above[:, j, i]
        try:
            self._factor = cholesky_banded(lower, overwrite_ab=True, lower=True, check_finite=False)
        except LinAlgError:
            raise DegenerateError("the states of a trajectory are not determined") from None

    def solve(self, right: Array) -> Array:
        """Return the solution for a right-hand side (k, d) or (k, d, m), of the same shape."""
        if kernels is not None:
            return self._solve_compiled(right, is_half=False)
        flat = right.reshape(self.count * self.size, -1)
        solution = cho_solve_banded((self._factor, True), flat, check_finite=False)
        return np.asarray(solution.reshape(right.shape))

    def half_solve(self, right: Array) -> Array:
        """Return L^-1 right for a right-hand side (k, d) or (k, d, m), of the same shape.

        The matrix is L L^T: for two right-hand sides, the scalar product of these is that of one
        with the solution for the other.
        """
        if kernels is not None:
            return self._solve_compiled(right, is_half=True)
        flat = right.reshape(self.count * self.size, -1)
        return np.asarray(dtbtrs(self._factor, flat, uplo="L")[0].reshape(right.shape))

    @cached_property
    def _columns(self) -> Array:
        """The columns of the factor, contiguous: (k d, 2 d)."""
        return np.ascontiguousarray(self._factor.T)

    def _solve_compiled(self, right: Array, *, is_half: bool) -> Array:
        assert kernels is not None
        solution = np.array(right, np.float64, order="C")
        factor = self._columns
        columns = solution.size // len(factor)
        kernels.solve_band(factor, len(factor), factor.shape[1], columns, is_half, solution)
        return solution

    @cached_property
    def inverse_blocks(self) -> tuple[Array, Array]:
        """Blocks the blocks of the inverse: (k, d, d) on and (k - 1, d, d) above the diagonal."""
        k, d = self.count, self.size
        own, below = np.zeros((k, d, d)), np.zeros((k - 1, d, d))
        columns = np.arange(k) * d
        for j in range(d):
            for i in range(j, d):
                own[:, i, j] = self._factor[i - j, columns + j]
            for i in range(d):
                below[:, i, j] = self._factor[d + i - j, columns[:-1] + j]
        inverse = np.linalg.inv(own)
        # Gain of the smoother: state k on state k + 1.
        gain = inverse[:-1].mT @ below.mT
        diagonal, above = inverse.mT @ inverse, np.zeros((k - 1, d, d))
        for i in range(k - 2, -1, -1):
            above[i] = -gain[i] @ diagonal[i + 1]
            diagonal[i] -= above[i] @ gain[i].T
        return diagonal, above
