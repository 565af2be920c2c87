"""How much of the time of the truth an estimate knows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.trajectory import Trajectory


@dataclass(frozen=True)
class Coverage:
    """Time that was solved, of the time that the truth tells of.

    Attributes
    ----------
    solved_s, truth_s : float
        A time is known between two poses that are not further apart than the longest gap.
    """

    solved_s: float
    truth_s: float

    @property
    def share(self) -> float | None:
        """Of the time of the truth, 0 to 1; None where it tells of none (single poses)."""
        return min(1.0, self.solved_s / self.truth_s) if self.truth_s > 0 else None

    def __add__(self, other: Coverage) -> Coverage:
        return Coverage(self.solved_s + other.solved_s, self.truth_s + other.truth_s)


def coverage(
    estimate: Trajectory, truth: Trajectory, *, offset_s: float, max_gap_s: float
) -> Coverage:
    """Coverage of one device; ``offset_s`` is added to the stamps of the estimate."""
    if len(truth) < 2:
        return Coverage(0.0, 0.0)
    limit = round(max_gap_s * 1e9)
    zero = truth.time_ns[0]
    # Known time of the truth until each of its stamps; it is asked at those of the estimate.
    known = _bridged(np.diff(truth.time_ns), limit)
    until = np.concatenate([[0.0], np.cumsum(known)])
    mine = estimate.time_ns + round(offset_s * 1e9)
    asked = np.interp((mine - zero).astype(float), (truth.time_ns - zero).astype(float), until)
    solved = np.diff(asked)[np.diff(mine) <= limit]
    return Coverage(float(solved.sum()) / 1e9, float(until[-1]) / 1e9)


def _bridged(gaps: NDArray[np.int64], limit: int) -> NDArray[np.float64]:
    return np.where(gaps <= limit, gaps, 0).astype(float)
