"""Identification of the visited cells of a map: a Bayes filter over cell and heading.

The paper compares three patterns in an L with the map (section 4.2). This filter uses every visit
with the probabilities of all its hypotheses. A landmark may be misread or missing, and odometry
determines how many cells there are between two visits. The state is a cell and a heading in
quarter turns, for each hypothesis of the visit, or a position outside of the map. A forward and a
backward pass give the probabilities given all visits (Rabiner, Proc. IEEE 77 (1989) 257).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.detection.hypotheses import DetectedVisit, Hypothesis, VisitHypotheses
from locatk.core.landmarks.detection.trace import OdometryDrift
from locatk.core.landmarks.landmark import CODE_COUNT, HALF_PI_RAD, rotated
from locatk.core.landmarks.map.floor import HOLE_CODE, Cell, FloorMap, as_built_code, as_built_codes
from locatk.core.landmarks.preprocessing import VisitSegment

Array = NDArray[np.float64]

MIN_CELL_PROBABILITY = 0.8
"""Posterior probability of a cell of the map from which on it is reported."""

PAD_CELLS = 3
"""Cells around the map on which a robot may be as well, though the map has no landmark there."""

UNMAPPED_LANDMARK_PROBABILITY = 1e-3
"""Probability of a landmark in a cell of the map that has none."""

OUTSIDE_LANDMARK_PROBABILITY = 0.01
"""Probability of a landmark in a cell outside of the map."""

KIDNAP_PROBABILITY = 1e-7
"""Probability that a robot was carried to any other cell between two visits."""

START_OUTSIDE_PROBABILITY = 1e-4
"""Probability that a recording begins outside of the map: it is of another floor, or all fields
have the opposite sign."""

RETURN_PROBABILITY = 1e-2
"""Probability of entering the map between two visits, from outside of it."""

MISSED_LANDMARK_PROBABILITY = 0.02
"""Probability of passing a landmark without a visit."""

LANDMARK_POSITION_SIGMA_M = 3e-3
"""Standard deviation of the position of a landmark, in addition to that of odometry."""

HEADING_SIGMA_RAD = math.radians(2)
"""Standard deviation of the difference of two landmarks' headings, in addition to odometry's."""

MIN_HYPOTHESIS_PROBABILITY = 1e-4
"""Probability below which a hypothesis of a visit is not followed."""

MAX_FOLLOWED_HYPOTHESES = 6

MAX_STEP_LOG_ODDS = 9.0
"""Log likelihood behind a perfect fit at which a step of whole cells is dropped."""


@dataclass(frozen=True)
class CellEstimate:
    """Cell of the map that a visit belongs to.

    Attributes
    ----------
    cell : (row, column)
    quarters : int
        Heading of the hypothesis' frame on the map, in quarter turns.
    hypothesis : int
        Index among the hypotheses of the visit.
    probability : float
        Of this cell and heading, given all visits.
    filtered_probability : float
        Of this cell and heading, given this visit and the previous ones.
    """

    cell: Cell
    quarters: int
    hypothesis: int
    probability: float
    filtered_probability: float


@dataclass(frozen=True)
class IdentifiedVisit:
    """Visit of a robot to a landmark, with its cell on the map.

    Attributes
    ----------
    segment : VisitSegment
    hypotheses : VisitHypotheses
    estimate : CellEstimate or None
        None if the visit is refused, or if there is no map.
    """

    segment: VisitSegment
    hypotheses: VisitHypotheses
    estimate: CellEstimate | None = None

    @property
    def cell(self) -> Cell:
        """Cell of the map; ``ValueError`` if there is none."""
        return self._identified.cell

    @property
    def quarters(self) -> int:
        """Heading of the hypothesis' frame on the map; ``ValueError`` if there is no cell."""
        return self._identified.quarters

    @property
    def hypothesis(self) -> Hypothesis:
        """Hypothesis that agrees with the map; ``ValueError`` if there is no cell."""
        return self.hypotheses.hypotheses[self._identified.hypothesis]

    @property
    def _identified(self) -> CellEstimate:
        if self.estimate is None:
            raise ValueError("the visit has no cell on a map")
        return self.estimate


def identify_visits(
    visits: Sequence[DetectedVisit], floor: FloorMap | None, *, misread: float, drift: OdometryDrift
) -> list[IdentifiedVisit]:
    """Identify the cells of all visits of one robot; arguments as of :func:`identify_cells`.

    Refused visits are not used. Without a map no visit has a cell.
    """
    identified = [IdentifiedVisit(visit.segment, visit.hypotheses) for visit in visits]
    if floor is None:
        return identified
    used = [n for n, visit in enumerate(visits) if not visit.hypotheses.refused]
    estimates = identify_cells(
        [visits[n].hypotheses for n in used], floor, misread=misread, drift=drift
    )
    for n, estimate in zip(used, estimates, strict=True):
        identified[n] = replace(identified[n], estimate=estimate)
    return identified


def select_visits_on_map(
    visits: Sequence[IdentifiedVisit], floor: FloorMap
) -> list[IdentifiedVisit]:
    """Return the visits whose cell is probable enough and has a landmark on the map."""
    return [
        visit
        for visit in visits
        if visit.estimate is not None
        and visit.estimate.probability >= MIN_CELL_PROBABILITY
        and as_built_code(floor, visit.cell) != HOLE_CODE
    ]


def identify_cells(
    visits: Sequence[VisitHypotheses], floor: FloorMap, *, misread: float, drift: OdometryDrift
) -> list[CellEstimate]:
    """Identify the cells of the visits of one robot.

    Parameters
    ----------
    visits : sequence of VisitHypotheses
        In order of time, each with at least one hypothesis.
    floor : FloorMap
    misread : float
        Probability that a landmark differs from the map or is misread.
    drift : OdometryDrift
        Of the odometry between visits.

    Returns
    -------
    list of CellEstimate
        The most probable cell and heading of each visit.
    """
    if not visits:
        return []
    followed = [_followed_hypotheses(visit) for visit in visits]
    steps = [
        _steps_between(first, second, hypotheses, next_hypotheses, floor.pitch_m, drift)
        for (first, second), (hypotheses, next_hypotheses) in zip(
            pairwise(visits), pairwise(followed), strict=True
        )
    ]
    codes = as_built_codes(floor)
    map_likelihood = [_map_likelihood(hypotheses, codes, misread) for hypotheses in followed]
    likelihood = list(map_likelihood)
    outside_likelihood = [sum(one.probability for _, one in h) / CODE_COUNT for h in followed]
    for number, code in _repeated_visits(followed, steps).items():
        # A repeated visit adds no evidence of the cell: it is the same landmark, whether it
        # agrees with the map or not.
        of_code = _code_likelihood(followed[number], code, misread)
        shape = likelihood[number].shape
        likelihood[number] = np.broadcast_to(of_code[:, None, None, None], shape)
        outside_likelihood[number] = float(of_code.sum())
    miss = miss_likelihood(floor)

    prior = (1 - START_OUTSIDE_PROBABILITY) / (4 * miss.size)
    start_outside = START_OUTSIDE_PROBABILITY * outside_likelihood[0]
    forward = [_normalized(likelihood[0] * prior, start_outside)]
    for step, now, now_outside in zip(steps, likelihood[1:], outside_likelihood[1:], strict=True):
        belief, outside = predict(*forward[-1], step, len(now), miss)
        forward.append(_normalized(belief * now, outside * now_outside))
    backward = [(np.ones_like(likelihood[-1]), 1.0)]
    for k in range(len(steps) - 1, -1, -1):
        belief, outside = backward[-1]
        earlier = predict_backward(
            belief * likelihood[k + 1],
            outside * outside_likelihood[k + 1],
            steps[k],
            len(followed[k]),
            miss,
        )
        backward.append(_normalized(*earlier))

    estimates = []
    for hypotheses, own, (past, past_outside), (future, future_outside) in zip(
        followed, map_likelihood, forward, reversed(backward), strict=True
    ):
        posterior, _ = _normalized(past * future, past_outside * future_outside)
        by_state = posterior.sum(axis=0)
        quarters, row, column = np.unravel_index(np.argmax(by_state), by_state.shape)
        # The map contributes to the choice of the hypothesis of a repeated visit as well.
        number = int(np.argmax((posterior * own)[:, quarters, row, column]))
        estimates.append(
            CellEstimate(
                cell=(int(row) - PAD_CELLS, int(column) - PAD_CELLS),
                quarters=int(quarters),
                hypothesis=hypotheses[number][0],
                probability=float(by_state[quarters, row, column]),
                filtered_probability=float(past[:, quarters, row, column].sum()),
            )
        )
    return estimates


def _normalized(belief: Array, outside: float) -> tuple[Array, float]:
    """Scale a belief, and the probability of being outside of the map, to the sum 1."""
    total = float(belief.sum()) + outside
    return belief / total, outside / total


def _followed_hypotheses(visit: VisitHypotheses) -> list[tuple[int, Hypothesis]]:
    """Return the more probable hypotheses with their indices."""
    numbered = list(enumerate(visit.hypotheses))
    kept = [(n, h) for n, h in numbered if n == 0 or h.probability > MIN_HYPOTHESIS_PROBABILITY]
    return kept[:MAX_FOLLOWED_HYPOTHESES]


# ---- likelihoods of one visit


def _map_likelihood(
    hypotheses: list[tuple[int, Hypothesis]], codes: NDArray[np.int64], misread: float
) -> Array:
    """Return the likelihood (H, 4, rows, columns) of each hypothesis in each state, with pad."""
    padded = np.pad(codes, PAD_CELLS, constant_values=HOLE_CODE)
    rotated_codes = np.stack([rotated(np.maximum(padded, 0), -q) for q in range(4)])
    is_inside = np.pad(np.ones(codes.shape, bool), PAD_CELLS)
    without_landmark = (
        np.where(is_inside, UNMAPPED_LANDMARK_PROBABILITY, OUTSIDE_LANDMARK_PROBABILITY)
        / CODE_COUNT
    )
    likelihood = np.empty((len(hypotheses), 4, *padded.shape))
    for number, (_, one) in enumerate(hypotheses):
        of_code = np.where(rotated_codes == one.code, 1 - misread, misread / (CODE_COUNT - 1))
        likelihood[number] = one.probability * np.where(
            padded == HOLE_CODE, without_landmark, of_code
        )
    return likelihood


def _code_likelihood(hypotheses: list[tuple[int, Hypothesis]], code: int, misread: float) -> Array:
    """Return the likelihood (H,) of the hypotheses of a landmark of known code, in any cell."""
    return np.array(
        [
            one.probability * (1 - misread if one.code == code else misread / (CODE_COUNT - 1))
            for _, one in hypotheses
        ]
    )


def miss_likelihood(floor: FloorMap) -> Array:
    """Return the likelihood (rows, columns) of passing a cell without a visit, with pad."""
    padded = np.pad(floor.codes, PAD_CELLS, constant_values=HOLE_CODE)
    return np.where(padded == HOLE_CODE, 1.0, MISSED_LANDMARK_PROBABILITY)


# ---- steps between visits


@dataclass(frozen=True)
class CellStep:
    """Step of whole cells from one visit to the next, in the frame of the first hypothesis.

    Attributes
    ----------
    before, after : int
        Hypotheses of both visits, by their order among the followed ones.
    cells : (int, int)
        Along x and y.
    quarters : int
        Rotation of the frame of the second hypothesis against that of the first.
    log_odds : float
        Log likelihood, relative to the most likely step.
    """

    before: int
    after: int
    cells: tuple[int, int]
    quarters: int
    log_odds: float


def _steps_between(
    first: VisitHypotheses,
    second: VisitHypotheses,
    hypotheses: list[tuple[int, Hypothesis]],
    next_hypotheses: list[tuple[int, Hypothesis]],
    pitch_m: float,
    drift: OdometryDrift,
) -> list[CellStep]:
    """Enumerate the steps of whole cells that agree with the odometry between two visits."""
    shift = second.odometry[:2] - first.odometry[:2]
    rotation = float(second.odometry[2] - first.odometry[2])
    cos, sin = math.cos(-first.odometry[2]), math.sin(-first.odometry[2])
    own_shift = np.array([cos * shift[0] - sin * shift[1], sin * shift[0] + cos * shift[1]])
    length = float(np.hypot(*own_shift))
    heading_sigma = math.hypot(
        drift.curvature_rad_per_m * length, drift.rotation_scale * abs(rotation), drift.walk_rad
    )
    frame_sigma = np.hypot(heading_sigma, HEADING_SIGMA_RAD)
    steps = []
    for i, (_, start) in enumerate(hypotheses):
        for j, (_, end) in enumerate(next_hypotheses):
            frame_rotation = start.pose[2] + rotation - end.pose[2]
            quarters = round(frame_rotation / HALF_PI_RAD)
            misalignment = frame_rotation - quarters * HALF_PI_RAD
            cos, sin = math.cos(start.pose[2]), math.sin(start.pose[2])
            position = start.pose[:2] + [
                cos * own_shift[0] - sin * own_shift[1],
                sin * own_shift[0] + cos * own_shift[1],
            ]
            c, s = math.cos(quarters * HALF_PI_RAD), math.sin(quarters * HALF_PI_RAD)
            x, y = end.pose[:2]
            cells = (position - [c * x - s * y, s * x + c * y]) / pitch_m
            sigma_cells = (
                math.hypot(
                    LANDMARK_POSITION_SIGMA_M,
                    drift.scale * length,
                    heading_sigma * length,
                    _position_sigma(start),
                    _position_sigma(end),
                )
                / pitch_m
            )
            low_x, low_y = math.floor(cells[0]), math.floor(cells[1])
            for a in (low_x, low_x + 1):
                for b in (low_y, low_y + 1):
                    squared = ((cells[0] - a) ** 2 + (cells[1] - b) ** 2) / sigma_cells**2
                    log_odds = -(squared + (misalignment / frame_sigma) ** 2) / 2
                    if log_odds > -MAX_STEP_LOG_ODDS:
                        steps.append(CellStep(i, j, (a, b), quarters, log_odds))
    # The quality of the odometry is no evidence of the cell: the best step counts in full.
    best = max((step.log_odds for step in steps), default=0.0)
    return [replace(step, log_odds=step.log_odds - best) for step in steps]


def _position_sigma(hypothesis: Hypothesis) -> float:
    """Return the standard deviation of the position of a hypothesis, in metres."""
    variance = float(np.trace(hypothesis.covariance[:2, :2]))
    return math.sqrt(variance) if math.isfinite(variance) else 2 * LANDMARK_POSITION_SIGMA_M


def _repeated_visits(
    followed: list[list[tuple[int, Hypothesis]]], steps: list[list[CellStep]]
) -> dict[int, int]:
    """Find visits to landmarks that another visit determines better.

    The visits to one landmark follow from the most likely steps.

    Returns
    -------
    dict of int to int
        Number of a visit to the code by the better visit, in the frame of the visit's most
        probable hypothesis.
    """
    # Chain of visits that are connected by steps, cell in the frame of its first visit, heading.
    path: list[tuple[int, tuple[int, int], int]] = [(0, (0, 0), 0)]
    for number, candidates in enumerate(steps, 1):
        chain, (x, y), heading = path[-1]
        of_best = [step for step in candidates if step.before == 0 and step.after == 0]
        if of_best:
            step = max(of_best, key=lambda one: one.log_odds)
            rows, columns = _rotate_step(step.cells, heading)
            path.append((chain, (x + columns, y + rows), (heading + step.quarters) % 4))
        else:
            path.append((number, (0, 0), 0))
    visits_of: dict[tuple[int, tuple[int, int]], list[int]] = {}
    for number, (chain, cell, _) in enumerate(path):
        visits_of.setdefault((chain, cell), []).append(number)
    repeated: dict[int, int] = {}
    for numbers in visits_of.values():
        best = max(numbers, key=lambda n: followed[n][0][1].probability)
        code = int(rotated(followed[best][0][1].code, path[best][2]))
        repeated |= {n: int(rotated(code, -path[n][2])) for n in numbers if n != best}
    return repeated


def predict(
    belief: Array, outside: float, steps: list[CellStep], count: int, miss: Array
) -> tuple[Array, float]:
    """Predict the belief at the next visit.

    Parameters
    ----------
    belief : (H, 4, rows, columns) ndarray
    outside : float
        Probability of being outside of the map.
    steps : list of CellStep
    count : int
        Number of hypotheses of the next visit.
    miss : (rows, columns) ndarray

    Returns
    -------
    belief : (count, 4, rows, columns) ndarray
    outside : float
    """
    total = float(belief.sum())
    anywhere = KIDNAP_PROBABILITY * total + RETURN_PROBABILITY * outside
    predicted = np.full((count, *belief.shape[1:]), anywhere / belief[0].size / count)
    outside = (1 - RETURN_PROBABILITY) * outside + KIDNAP_PROBABILITY * total
    for step in steps:
        weight = math.exp(step.log_odds)
        for quarters in range(4):
            rows, columns = _rotate_step(step.cells, quarters)
            leaving = weight * belief[step.before, quarters] * _pass_likelihood(miss, rows, columns)
            arriving = _shifted(leaving, rows, columns)
            predicted[step.after, (quarters + step.quarters) % 4] += arriving
            outside += float(leaving.sum() - arriving.sum())
    return predicted, max(outside, 0.0)


def predict_backward(
    belief: Array, outside: float, steps: list[CellStep], count: int, miss: Array
) -> tuple[Array, float]:
    """Apply the transpose of :func:`predict`."""
    total = float(belief.sum()) / belief[0].size / len(belief)
    predicted = np.full((count, *belief.shape[1:]), KIDNAP_PROBABILITY * (total + outside))
    for step in steps:
        weight = math.exp(step.log_odds)
        for quarters in range(4):
            rows, columns = _rotate_step(step.cells, quarters)
            arriving = belief[step.after, (quarters + step.quarters) % 4]
            leaving = _shifted(arriving, -rows, -columns, fill=outside)
            predicted[step.before, quarters] += (
                weight * _pass_likelihood(miss, rows, columns) * leaving
            )
    return predicted, (1 - RETURN_PROBABILITY) * outside + RETURN_PROBABILITY * total


def _rotate_step(cells: tuple[int, int], quarters: int) -> tuple[int, int]:
    """Return (rows, columns) of a step of (x, y) cells in a frame rotated by quarter turns."""
    x, y = cells
    for _ in range(quarters % 4):
        x, y = -y, x
    return y, x


def _pass_likelihood(miss: Array, rows: int, columns: int) -> Array:
    """Return the likelihood, by cell of departure, of no visit on a straight path."""
    likelihood = np.ones_like(miss)
    if rows and columns:
        return likelihood
    length = max(abs(rows), abs(columns))
    for k in range(1, length):
        likelihood *= _shifted(miss, -rows * k // length, -columns * k // length, fill=1.0)
    return likelihood


def _shifted(values: Array, rows: int, columns: int, fill: float = 0.0) -> Array:
    """Shift values (rows, columns) by whole cells."""
    shifted = np.full_like(values, fill)
    height, width = values.shape
    if abs(rows) < height and abs(columns) < width:
        source = (_overlap(-rows, height), _overlap(-columns, width))
        target = (_overlap(rows, height), _overlap(columns, width))
        shifted[target] = values[source]
    return shifted


def _overlap(shift: int, size: int) -> slice:
    return slice(max(shift, 0), size + min(shift, 0))
