"""Steps of whole cells between two visits: what odometry says about the cells of a robot.

Odometry is right up to its drift, or a wheel slipped. A step therefore has the likelihood of a
mixture: a normal distribution of the difference from the odometry, and a Cauchy distribution of
distance and angle, whose long tails are those of a slip (Lange, Little and Taylor, J. Am. Stat.
Assoc. 84 (1989) 881). Likelihoods are relative to the peak of the normal distribution as long as
odometry determines the cell. If it leaves several open, the peak is lower, so that their sum is
about 1.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.detection.hypotheses import Hypothesis, VisitHypotheses
from locatk.core.landmarks.detection.trace import OdometryDrift
from locatk.core.landmarks.landmark import HALF_PI_RAD

Array = NDArray[np.float64]
NumberedHypothesis = tuple[int, Hypothesis]

LANDMARK_POSITION_SIGMA_M = 3e-3
"""Standard deviation of the position of a landmark, in addition to that of odometry."""

HEADING_SIGMA_RAD = math.radians(2)
"""Standard deviation of the difference of two landmarks' headings, in addition to odometry's."""

SLIP_PROBABILITY = 0.01
"""Probability that a wheel slipped between two visits."""

SLIP_SCALE_M, SLIP_SCALE_RAD = 0.03, math.radians(10)
"""Scales of the Cauchy distributions of a slip: half of all slips are smaller."""

MIN_RANGE_CELLS, MAX_RANGE_CELLS = 1, 4
"""Number of cells that are considered on each side beyond the two nearest ones, in x and in y: at
least those that a slip leads to, and at most those of odometry over several metres."""

RANGE_SIGMAS = 2.0
"""The same in standard deviations of the odometry."""

MIN_STEP_LIKELIHOOD = 1e-9
"""Likelihood below which a step is not followed."""

MIN_ODOMETRY_LIKELIHOOD = 1e-4
"""Likelihood from which a step agrees with the odometry: 4.3 standard deviations of one number."""


@dataclass(frozen=True)
class CellSteps:
    """Steps of whole cells from one hypothesis of a visit to one of a later visit.

    Attributes
    ----------
    cells : (n, 2) int64 ndarray
        Along x and y of the frame of the first hypothesis.
    quarters : (n,) int64 ndarray
        Rotation of the frame of the second hypothesis against that of the first.
    likelihood : (n,) ndarray
        Relative to a step that odometry confirms exactly; in descending order.
    odometry_likelihood : (n,) ndarray
        Normal distribution of the difference from the odometry, relative to its peak.
    """

    cells: NDArray[np.int64]
    quarters: NDArray[np.int64]
    likelihood: Array
    odometry_likelihood: Array

    def __len__(self) -> int:
        return len(self.quarters)

    def that_odometry_confirms(self) -> CellSteps:
        """Return the steps that agree with the odometry."""
        agrees = self.odometry_likelihood >= MIN_ODOMETRY_LIKELIHOOD
        return CellSteps(
            self.cells[agrees],
            self.quarters[agrees],
            self.likelihood[agrees],
            self.odometry_likelihood[agrees],
        )


def steps_between(
    first: VisitHypotheses,
    second: VisitHypotheses,
    start: Hypothesis,
    end: Hypothesis,
    *,
    pitch_m: float,
    drift: OdometryDrift,
) -> CellSteps:
    """Enumerate the steps of whole cells from one hypothesis of a visit to one of a later visit.

    Parameters
    ----------
    first, second : VisitHypotheses
        Of which only times and odometry are used.
    start, end : Hypothesis
        One of each.
    pitch_m : float
    drift : OdometryDrift
    """
    shift = second.odometry[:2] - first.odometry[:2]
    rotation = float(second.odometry[2] - first.odometry[2])
    length = float(np.hypot(*shift))
    # The odometry's shift in the frame of the landmark below the first visit.
    position = start.pose[:2] + _rotated(shift, start.pose[2] - first.odometry[2])
    heading_sigma = math.hypot(
        drift.curvature_rad_per_m * length, drift.rotation_scale * abs(rotation), drift.walk_rad
    )
    frame_sigma = math.hypot(heading_sigma, HEADING_SIGMA_RAD)
    position_sigma_m = math.hypot(
        LANDMARK_POSITION_SIGMA_M,
        drift.scale * length,
        heading_sigma * length,
        _position_sigma(start),
        _position_sigma(end),
    )
    frame_rotation = start.pose[2] + rotation - end.pose[2]
    nearest = round(frame_rotation / HALF_PI_RAD)
    reach = math.ceil(RANGE_SIGMAS * position_sigma_m / pitch_m)
    reach = min(max(reach, MIN_RANGE_CELLS), MAX_RANGE_CELLS)
    nearby = np.array(list(itertools.product(range(-reach, reach + 2), repeat=2)))
    # All rotations (4, 1, 2) times all cells near the position (1, n, 2).
    quarters = np.arange(nearest - 1, nearest + 3)
    angle = np.remainder(frame_rotation - quarters * HALF_PI_RAD + math.pi, math.tau) - math.pi
    robot = np.stack([_rotated(end.pose[:2], each * HALF_PI_RAD) for each in quarters.tolist()])
    expected = ((position - robot) / pitch_m)[:, None]
    cells = np.floor(expected).astype(np.int64) + nearby
    distance_m = pitch_m * np.hypot(*np.moveaxis(expected - cells, 2, 0))
    # Odometry over a long distance leaves many cells and headings open, and none is likely.
    peak = min(1.0, pitch_m**2 / (math.tau * position_sigma_m**2))
    peak *= min(1.0, HALF_PI_RAD / (math.sqrt(math.tau) * frame_sigma))
    by_odometry = np.exp(
        -((distance_m / position_sigma_m) ** 2 + (angle[:, None] / frame_sigma) ** 2) / 2
    )
    slip = _slip_likelihood(distance_m, angle[:, None], position_sigma_m, frame_sigma)
    likelihood = (peak * by_odometry + slip).ravel()
    order = np.argsort(-likelihood, kind="stable")
    order = order[likelihood[order] > MIN_STEP_LIKELIHOOD]
    return CellSteps(
        cells.reshape(-1, 2)[order],
        np.repeat(quarters, len(nearby))[order],
        likelihood[order],
        by_odometry.ravel()[order],
    )


def _slip_likelihood(
    distance_m: Array, angle_rad: Array, position_sigma_m: float, heading_sigma_rad: float
) -> Array:
    """Return the likelihood of a slip, relative to the peak of the normal distribution.

    Both are densities of position and heading; that of a slip is a Cauchy distribution in the
    plane times one of the angle.
    """
    position = (position_sigma_m / SLIP_SCALE_M) ** 2 * (
        1 + (distance_m / SLIP_SCALE_M) ** 2
    ) ** -1.5
    heading = (
        math.sqrt(math.tau)
        * heading_sigma_rad
        / (math.pi * SLIP_SCALE_RAD * (1 + (angle_rad / SLIP_SCALE_RAD) ** 2))
    )
    return SLIP_PROBABILITY * np.minimum(position, 1.0) * np.minimum(heading, 1.0)


def _rotated(vector: Sequence[float] | Array, angle_rad: float) -> Array:
    """Return a vector (2,) rotated counter-clockwise."""
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    x, y = vector
    return np.array([cos * x - sin * y, sin * x + cos * y])


def _position_sigma(hypothesis: Hypothesis) -> float:
    """Return the standard deviation of the position of a hypothesis, in metres."""
    variance = float(np.trace(hypothesis.covariance[:2, :2]))
    return math.sqrt(variance) if math.isfinite(variance) else 2 * LANDMARK_POSITION_SIGMA_M
