"""Causal identification of cells: the forward pass of :mod:`.cell_filter` in bounded memory."""

from __future__ import annotations

from dataclasses import dataclass

from locatk.core.landmarks.detection.hypotheses import VisitHypotheses
from locatk.core.landmarks.detection.trace import OdometryDrift
from locatk.core.landmarks.localization.cell_filter import (
    MAX_SUCCESSIVE_OUTLIERS,
    CellEstimate,
    CellModel,
    ForwardPass,
    map_probability,
)
from locatk.core.landmarks.map.floor import FloorMap

REMEMBERED_VISITS = 64
"""Visits after which the reading of a landmark counts as new evidence. It is the length of a block
of the offline filter; repeating a wrong reading after so many right ones does no harm."""

MAX_LOG_EVIDENCE = 20.0
"""Log evidence for or against a map to which it is limited: a robot that is carried to another
floor, a probability of 1e-9, is noticed after a few landmarks."""


@dataclass(frozen=True)
class CausalEstimate:
    """Cell of a visit given this visit and the previous ones.

    Attributes
    ----------
    cell : CellEstimate
    map_probability : float
        Probability that the robot is on this floor and not on any other.
    """

    cell: CellEstimate
    map_probability: float


class CausalCells:
    """Bayes filter over cells and headings that takes one visit at a time.

    The last visits can be taken back, because they are revised while the robot remains at one
    landmark.

    Parameters
    ----------
    floor : FloorMap
    misread : float
        Probability that a landmark differs from the map or is misread.
    drift : OdometryDrift
        Of the odometry between visits.
    """

    def __init__(self, floor: FloorMap, *, misread: float, drift: OdometryDrift) -> None:
        self.model = CellModel([], floor, misread=misread, drift=drift)
        self.state = ForwardPass(self.model)

    def add(self, visit: VisitHypotheses) -> CausalEstimate:
        """Return the estimate of the next visit, which has at least one hypothesis."""
        number = self.model.append(visit)
        self.state = self.state.copy()
        belief = self.state.advance(number)
        self.state.limit_evidence(MAX_LOG_EVIDENCE)
        self.model.forget_before(number - max(REMEMBERED_VISITS, MAX_SUCCESSIVE_OUTLIERS + 1))
        estimate = self.model.filtered_estimate(belief)
        return CausalEstimate(estimate, self.map_probability)

    @property
    def map_probability(self) -> float:
        """Probability that the robot is on this floor and not on any other."""
        return map_probability(self.state.log_evidence_ratio)

    def take_back(self, state: ForwardPass) -> None:
        """Return to an earlier :attr:`state`, without the last one or two visits."""
        last = -1 if state.belief is None else state.belief.visit
        while max(self.model.visits, default=-1) > last:
            self.model.remove_last()
        self.state = state
