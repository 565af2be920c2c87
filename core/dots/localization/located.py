"""What is known of frames once they were looked at: a place for each, or why it has none."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Located:
    """Places of n frames; without meaning where :attr:`rejected` says why.

    Attributes
    ----------
    grid : (n, 2) float64 ndarray
        Grid coordinates of the camera's centre.
    section : (n, 2) int64 ndarray
    heading : (n,) float64 ndarray
        From the sheet's x axis to the image's right, counter-clockwise, in rad.
    covariance : (n, 3, 3) float64 ndarray
        Of x, y (pitches, y down) and heading (rad); nan where it is not known.
    dots, corrected : (n,) int64 ndarray
        Dots on the grid, and bits among theirs that were seen wrong.
    confidence : (n,) float64 ndarray
    rejected : (n,) object ndarray of str
        ``""`` where the frame has a place, else the reason.
    """

    grid: NDArray[np.float64]
    section: NDArray[np.int64]
    heading: NDArray[np.float64]
    covariance: NDArray[np.float64]
    dots: NDArray[np.int64]
    corrected: NDArray[np.int64]
    confidence: NDArray[np.float64]
    rejected: NDArray[np.object_]

    def __len__(self) -> int:
        return len(self.rejected)

    @property
    def accepted(self) -> NDArray[np.bool_]:
        """(n,) whether the frame has a place."""
        result: NDArray[np.bool_] = self.rejected == ""
        return result

    def keep(self, at: NDArray[np.int64], part: Located) -> None:
        """Put ``part`` at the frames ``at``, where it has a place or came at least as far."""
        better = part.accepted | (part.confidence >= self.confidence[at])
        for field in fields(Located):
            getattr(self, field.name)[at[better]] = getattr(part, field.name)[better]


def nothing(n: int, reason: str) -> Located:
    """n frames that nobody has looked at, rejected for ``reason``."""
    return Located(
        grid=np.full((n, 2), np.nan),
        section=np.full((n, 2), -1, np.int64),
        heading=np.full(n, np.nan),
        covariance=np.full((n, 3, 3), np.nan),
        dots=np.zeros(n, np.int64),
        corrected=np.zeros(n, np.int64),
        confidence=np.zeros(n),
        rejected=np.full(n, reason, object),
    )
