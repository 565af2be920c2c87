"""What one visit of a robot to a landmark has shown, before and after the map is asked."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.landmark import CODES
from locatk.core.solution import SolverWarning

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Hypothesis:
    """One explanation of a visit: which landmark, and where the robot was beside it.

    The frame is the landmark's, turned by quarter turns so that the robot's heading at the
    sighting's time is nearest to 0: the code is the one that this robot reads, and a
    landmark laid as ``laid`` on the map and seen under the map heading of ``q`` quarter
    turns (and :attr:`pose`'s rest) has ``code = rotated(laid, -q)``.

    Attributes
    ----------
    code : int
        How the landmark is laid in this frame.
    probability : float
        Among the hypotheses of the visit; they sum to 1.
    pose : (3,) ndarray
        Robot in this frame at the sighting's time: x, y in metres and heading in radians.
    covariance : (3, 3) ndarray
        Of the pose; ``nan`` where the method knows none.
    strength : (4,) ndarray
        Signed strengths of the bars in this frame, in units of the nominal one; ``nan``
        where the method knows none.
    strength_sigma : (4,) ndarray
    """

    code: int
    probability: float
    pose: Array
    covariance: Array
    strength: Array
    strength_sigma: Array


@dataclass(frozen=True)
class VisitHypotheses:
    """One visit to one landmark.

    Attributes
    ----------
    device : str
    time_ns : int
        At which the poses of the hypotheses stand: of a sample of the visit.
    first, stop : int
        The visit: samples ``first`` to ``stop - 1``.
    odometry : (3,) ndarray
        The robot at ``time_ns`` by its own odometry: x, y, heading.
    hypotheses : tuple of Hypothesis
        The most probable first; empty where nothing explains the samples.
    residual_sigma : float
        Rms of what the best hypothesis leaves, in standard deviations of the noise;
        ``nan`` where the method has no model of the samples.
    refused : str
        Why it is not used, ``""`` where it is: ``"too_weak"``, ``"too_short"``, ...
    warnings : tuple of SolverWarning
        Without the name of the device.
    """

    device: str
    time_ns: int
    first: int
    stop: int
    odometry: Array
    hypotheses: tuple[Hypothesis, ...]
    residual_sigma: float = float("nan")
    refused: str = ""
    warnings: tuple[SolverWarning, ...] = ()

    @property
    def best(self) -> Hypothesis:
        """The most probable hypothesis; ``IndexError`` where there is none."""
        return self.hypotheses[0]

    def landmark_place(self) -> Array:
        """(2,) where the best hypothesis has the landmark's centre, by the robot's odometry."""
        x, y, heading = self.best.pose
        turn = float(self.odometry[2] - heading)
        cos, sin = math.cos(turn), math.sin(turn)
        return np.asarray(self.odometry[:2] - [cos * x - sin * y, sin * x + cos * y])

    def code_probabilities(self) -> Array:
        """(16,) probability of each code in the frame of the hypotheses."""
        total = np.zeros(CODES)
        for hypothesis in self.hypotheses:
            total[hypothesis.code] += hypothesis.probability
        return total
