"""The statistics of one kind of error."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Statistics:
    """Of n errors, in their unit; the names are those of evo.

    Attributes
    ----------
    n : int
    rmse, mean, median, std, min, max : float
        ``std`` is with n, not n - 1, so that rmse^2 = mean^2 + std^2.
    p95 : float
        95 % are below, interpolated linearly between the two nearest.
    sse : float
        Sum of the squares.
    """

    n: int
    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float
    p95: float
    sse: float

    @classmethod
    def of(cls, errors: NDArray[np.float64]) -> Statistics:
        """Statistics of errors (n,), all finite, n > 0."""
        squares = errors * errors
        median, p95 = np.percentile(errors, (50, 95))
        return cls(
            n=len(errors),
            rmse=float(np.sqrt(np.mean(squares))),
            mean=float(np.mean(errors)),
            median=float(median),
            std=float(np.std(errors)),
            min=float(np.min(errors)),
            max=float(np.max(errors)),
            p95=float(p95),
            sse=float(np.sum(squares)),
        )

    @classmethod
    def known(cls, errors: NDArray[np.float64] | None) -> Statistics | None:
        """Statistics of the finite ones of errors (n,); None where there are none."""
        if errors is None:
            return None
        finite = np.isfinite(errors)
        return cls.of(errors[finite]) if finite.any() else None

    def as_dict(self) -> dict[str, float]:
        """For JSON."""
        return asdict(self)
