"""Coverage: the part of the time of the truth for which an estimate has poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from locatk.core.trajectory import Trajectory


@dataclass(frozen=True)
class Coverage:
    """Solved time and time of the truth.

    Attributes
    ----------
    solved_s, truth_s : float
        The time between two successive poses counts if they are not further apart than the longest
        gap that is bridged.
    """

    solved_s: float
    truth_s: float

    @property
    def fraction(self) -> float | None:
        """Solved fraction of the time of the truth, 0 to 1; None if the truth is single poses."""
        return min(1.0, self.solved_s / self.truth_s) if self.truth_s > 0 else None

    def __add__(self, other: Coverage) -> Coverage:
        return Coverage(self.solved_s + other.solved_s, self.truth_s + other.truth_s)


def compute_coverage(
    estimate: Trajectory, truth: Trajectory, *, offset_s: float, max_gap_s: float
) -> Coverage:
    """Compute the coverage of one device.

    ``offset_s`` is added to the stamps of the estimate; gaps over ``max_gap_s`` do not count.
    """
    if len(truth) < 2:
        return Coverage(0.0, 0.0)
    max_gap_ns = round(max_gap_s * 1e9)
    start_ns = truth.time_ns[0]
    gaps = np.diff(truth.time_ns)
    # Known time of the truth up to each of its stamps, interpolated to those of the estimate.
    known_ns = np.concatenate(
        [[0.0], np.cumsum(np.where(gaps <= max_gap_ns, gaps, 0).astype(float))]
    )
    time_ns = estimate.time_ns + round(offset_s * 1e9)
    known_at_pose_ns = np.interp(
        (time_ns - start_ns).astype(float), (truth.time_ns - start_ns).astype(float), known_ns
    )
    solved_ns = np.diff(known_at_pose_ns)[np.diff(time_ns) <= max_gap_ns]
    return Coverage(float(solved_ns.sum()) / 1e9, float(known_ns[-1]) / 1e9)
