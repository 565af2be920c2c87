"""Identification of the visited cells of a map: a hidden Markov model over cell and heading.

The paper compares three patterns in an L with the map (section 4.2). This filter uses every visit
with the probabilities of all its hypotheses. The state of a robot is a cell and a heading in
quarter turns, for each hypothesis of a visit. Between two visits it changes by what odometry says
(:mod:`.cell_steps`). Besides:

- a landmark may be misread, may have been missed, or may differ from the map;
- a wheel may slip, so that odometry is wrong by any distance and angle;
- a visit may be an *outlier*, whose pose and code are both wrong. The state then stays that of an
  earlier visit, and the odometry of the next step begins there;
- the robot may be carried to any other cell, more than once;
- it may drive off the map, and return.

A forward and a backward pass give the probabilities given all visits (Rabiner, Proc. IEEE 77
(1989) 257). Beliefs are sparse: states whose probability is negligible are dropped. The backward
pass runs over blocks of visits, each with the visits that follow it, so that memory does not grow
with the length of a recording.

Whether the robot is on this floor at all is judged by the same evidence
(:attr:`CellIdentification.map_probability`): the readings are compared with those of any other
floor that has the same fraction of each code.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.detection.hypotheses import DetectedVisit, Hypothesis, VisitHypotheses
from locatk.core.landmarks.detection.trace import OdometryDrift
from locatk.core.landmarks.landmark import CODE_COUNT, rotated
from locatk.core.landmarks.localization.cell_steps import (
    CellSteps,
    NumberedHypothesis,
    steps_between,
)
from locatk.core.landmarks.map.floor import HOLE_CODE, Cell, FloorMap, as_built_code, as_built_codes
from locatk.core.landmarks.preprocessing import VisitSegment

Array = NDArray[np.float64]
States = NDArray[np.int64]

MIN_CELL_PROBABILITY = 0.8
"""Posterior probability of a cell of the map from which on it is reported."""

PAD_CELLS = 3
"""Cells around the map on which a robot may be as well, though the map has no landmark there."""

UNMAPPED_LANDMARK_PROBABILITY = 1e-3
"""Probability of a landmark in a cell of the map that has none."""

OUTSIDE_LANDMARK_PROBABILITY = 0.01
"""Probability of a landmark in a cell outside of the map."""

CARRIED_WEIGHT = 1e-6
"""Probability that a robot was carried to another cell between two visits (about 1 %), times the
density of its pose there relative to that of a pose that odometry confirms (about 1e-4)."""

RETURN_PROBABILITY = 1e-2
"""Probability of entering the map between two visits, from outside of it."""

OTHER_FLOOR_PROBABILITY = 0.5
"""Probability, before any reading, that the recording is of another floor: nothing is assumed."""

MISSED_LANDMARK_PROBABILITY = 0.02
"""Probability of passing a landmark without a visit."""

OUTLIER_WEIGHT = 1e-5
"""Probability that neither pose nor code of a visit can be used (about 1 %), times the density of
its pose relative to that of a pose that odometry confirms (about 1e-3)."""

MAX_SUCCESSIVE_OUTLIERS = 3
"""Outliers in a row after which the position is lost."""

MIN_HYPOTHESIS_PROBABILITY = 1e-4
"""Probability below which a hypothesis of a visit is not followed."""

MAX_FOLLOWED_HYPOTHESES = 6

MIN_SLIP_BELIEF = 1e-3
"""Probability of a state from which on slips are followed: there are 64 steps after each."""

MIN_STATE_TO_CARRIED_RATIO = 0.02
"""States are dropped below this fraction of the probability that a carried robot is in one cell."""

MAX_STATES_AT_ONCE = 20_000
"""States for which steps are computed at once, in order to bound the memory."""

BLOCK_VISITS, LOOKAHEAD_VISITS = 64, 24
"""Visits for which the backward pass runs at once, and those after them that it uses: the
readings of a dozen landmarks determine a cell beyond doubt."""


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
    outlier_probability : float
        Probability that neither pose nor code of the visit can be used, given all visits.
    misread_probability : float
        Probability that the code differs from that of the map, if the cell is right.
    """

    cell: Cell
    quarters: int
    hypothesis: int
    probability: float
    filtered_probability: float
    outlier_probability: float = 0.0
    misread_probability: float = 0.0


@dataclass(frozen=True)
class CellIdentification:
    """Cells of the visits of one robot.

    Attributes
    ----------
    estimates : list of CellEstimate
        The most probable cell and heading of each visit, if the robot is on this floor.
    map_probability : float
        Probability that the robot is on this floor and not on any other.
    """

    estimates: list[CellEstimate]
    map_probability: float


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
) -> tuple[list[IdentifiedVisit], float]:
    """Identify the cells of all visits of one robot; arguments as of :func:`identify_cells`.

    Refused visits are not used. Without a map no visit has a cell.

    Returns
    -------
    visits : list of IdentifiedVisit
    map_probability : float
        See :class:`CellIdentification`.
    """
    identified = [IdentifiedVisit(visit.segment, visit.hypotheses) for visit in visits]
    if floor is None:
        return identified, 0.0
    used = [n for n, visit in enumerate(visits) if not visit.hypotheses.refused]
    result = identify_cells(
        [visits[n].hypotheses for n in used], floor, misread=misread, drift=drift
    )
    for n, estimate in zip(used, result.estimates, strict=True):
        identified[n] = replace(identified[n], estimate=estimate)
    return identified, result.map_probability


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
) -> CellIdentification:
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
    """
    if not visits:
        return CellIdentification([], 0.0)
    model = CellModel(visits, floor, misread=misread, drift=drift)
    estimates: list[CellEstimate] = []
    forward = ForwardPass(model)
    beliefs: list[Belief] = []
    for k in range(len(visits)):
        beliefs.append(forward.advance(k))
        if len(beliefs) == BLOCK_VISITS + LOOKAHEAD_VISITS and k + 1 < len(visits):
            estimates += model.estimates(beliefs)[:BLOCK_VISITS]
            beliefs = beliefs[BLOCK_VISITS:]
    estimates += model.estimates(beliefs)
    return CellIdentification(estimates, map_probability(forward.log_evidence_ratio))


def map_probability(log_evidence_ratio: float) -> float:
    """Return the probability of a map by the evidence for it against that for any other floor."""
    prior_odds = OTHER_FLOOR_PROBABILITY / (1 - OTHER_FLOOR_PROBABILITY)
    return 1 / (1 + prior_odds * math.exp(min(-log_evidence_ratio, 700.0)))


# ---- beliefs


@dataclass(frozen=True)
class Component:
    """States of a robot that have one hypothesis of one visit in common.

    Attributes
    ----------
    visit, hypothesis : int
        The last visit that is no outlier, and its hypothesis by order among the followed ones.
    states : (n,) int64 ndarray
        Ascending, see :meth:`CellModel.cells_of`.
    probability : (n,) ndarray
    """

    visit: int
    hypothesis: int
    states: States
    probability: Array


@dataclass(frozen=True)
class Belief:
    """Belief after one visit.

    Attributes
    ----------
    visit : int
    components : list of Component
        First those of this visit; then those of earlier ones, if this one is an outlier.
    outside : float
        Probability of being outside of the map.
    """

    visit: int
    components: list[Component]
    outside: float


@dataclass(frozen=True)
class RelativeCell:
    """Cell of a visit relative to earlier ones, by the most likely steps.

    Attributes
    ----------
    chain : int
        First of the visits that odometry connects.
    cell : (x, y)
        In the frame of that visit.
    quarters : int
        Rotation of the visit's frame against that of the first one.
    """

    chain: int
    cell: Cell
    quarters: int

    @property
    def landmark(self) -> tuple[int, Cell]:
        """Landmark among those of all chains."""
        return self.chain, self.cell


class CellModel:
    """Likelihoods of visits and of the steps between them, on one map.

    Parameters are those of :func:`identify_cells`. Further visits can be appended.
    """

    def __init__(
        self,
        visits: Sequence[VisitHypotheses],
        floor: FloorMap,
        *,
        misread: float,
        drift: OdometryDrift,
    ) -> None:
        self.pitch_m, self.drift, self.misread = floor.pitch_m, drift, misread
        self.visits: dict[int, VisitHypotheses] = {}
        self.followed: dict[int, list[NumberedHypothesis]] = {}
        self.path: dict[int, RelativeCell] = {}
        for number, visit in enumerate(visits):
            self._append(number, visit)
        codes = np.pad(as_built_codes(floor), PAD_CELLS, constant_values=HOLE_CODE)
        self.shape = codes.shape
        self.cell_count = codes.size
        self.state_count = 4 * codes.size
        # Code that is read in each state; holes have codes of their own, by their likelihood.
        is_inside = np.pad(np.ones(floor.shape, bool), PAD_CELLS)
        read = np.stack([rotated(np.maximum(codes, 0), -q) for q in range(4)])
        empty = np.where(is_inside, CODE_COUNT, CODE_COUNT + 1)
        self.read_code = np.where(codes == HOLE_CODE, empty, read).reshape(-1)
        has_landmark = codes != HOLE_CODE
        self.landmarks_before = (
            np.pad(np.cumsum(has_landmark, axis=1), ((0, 0), (1, 0))),
            np.pad(np.cumsum(has_landmark, axis=0), ((1, 0), (0, 0))),
        )
        self.confirming = self._confirming_visits()
        self._steps: dict[tuple[int, int, int, int], CellSteps] = {}

    # ---- visits

    def append(self, visit: VisitHypotheses) -> int:
        """Append a visit while later ones are unknown, and return its number.

        It is confirming if it repeats the reading of an earlier visit to the same landmark.
        """
        number = max(self.visits, default=-1) + 1
        self._append(number, visit)
        here = self.path[number]
        earlier = [
            n for n, one in self.path.items() if n != number and one.landmark == here.landmark
        ]
        if earlier:
            code = self._code_at(max(earlier, key=self._probability_of), here)
            if self.followed[number][0][1].code == code:
                self.confirming[number] = code
        return number

    def remove_last(self) -> None:
        """Remove the last visit."""
        number = max(self.visits)
        for table in (self.visits, self.followed, self.path):
            del table[number]
        self.confirming.pop(number, None)
        self._steps = {key: value for key, value in self._steps.items() if key[2] != number}

    def forget_before(self, number: int) -> None:
        """Forget all visits before one, to which no belief refers any more."""
        for table in (self.visits, self.followed, self.path, self.confirming):
            for earlier in [n for n in table if n < number]:
                del table[earlier]

    def _append(self, number: int, visit: VisitHypotheses) -> None:
        """Add a visit after the last one, and its cell relative to that by the likeliest step."""
        self.visits[number], self.followed[number] = visit, _followed_hypotheses(visit)
        before = self.path.get(number - 1)
        self.path[number] = RelativeCell(number, (0, 0), 0)
        if before is None:
            return
        steps = steps_between(
            self.visits[number - 1],
            visit,
            self.followed[number - 1][0][1],
            self.followed[number][0][1],
            pitch_m=self.pitch_m,
            drift=self.drift,
        )
        if len(steps):
            dx, dy = steps.cells[0]
            for _ in range(before.quarters):
                dx, dy = -dy, dx
            self.path[number] = RelativeCell(
                before.chain,
                (before.cell[0] + int(dx), before.cell[1] + int(dy)),
                int(before.quarters + steps.quarters[0]) % 4,
            )

    def _probability_of(self, visit: int) -> float:
        """Return the probability of the most probable hypothesis of a visit."""
        return self.followed[visit][0][1].probability

    def _code_at(self, visit: int, there: RelativeCell) -> int:
        """Return the code that a visit read, in the frame of another visit to that landmark."""
        code = self.followed[visit][0][1].code
        return int(rotated(rotated(code, self.path[visit].quarters), -there.quarters))

    def cells_of(self, states: States) -> tuple[States, States, States]:
        """Return quarters, row and column of states, on the map with its pad."""
        quarters, cell = np.divmod(states, self.cell_count)
        row, column = np.divmod(cell, self.shape[1])
        return quarters, row, column

    def initial_belief(self, visit: int = 0) -> tuple[Belief, float]:
        """Return the belief after the first visit, and the probability of its readings."""
        count = len(self.followed[visit])
        updated = [self.likelihood(visit, n) / self.state_count for n in range(count)]
        return self._normalized(visit, updated, 0.0, [])

    def advance(self, belief: Belief, visit: int) -> tuple[Belief, float]:
        """Return the belief after the next visit, and the probability of its readings."""
        followed = self.followed[visit]
        total = sum(float(each.probability.sum()) for each in belief.components)
        anywhere = CARRIED_WEIGHT * total + RETURN_PROBABILITY * belief.outside
        any_code = self.any_code_likelihood(visit)
        outside = (1 - RETURN_PROBABILITY) * belief.outside + CARRIED_WEIGHT * total
        updated = []
        for end, (_, hypothesis) in enumerate(followed):
            predicted = np.zeros(self.state_count)
            for component in belief.components:
                for rows, weight, arrival in self._transitions(component, visit, end):
                    leaving = component.probability[rows][:, None] * weight
                    is_on_map = arrival >= 0
                    predicted += np.bincount(
                        arrival[is_on_map], leaving[is_on_map], minlength=self.state_count
                    )
                    outside += hypothesis.probability * float(leaving[~is_on_map].sum())
            arrived = (anywhere / self.state_count) * self.map_likelihood(visit, end)
            updated.append(
                (1 - OUTLIER_WEIGHT) * (predicted * self.likelihood(visit, end) + arrived)
            )
        outliers = [
            replace(each, probability=each.probability * (OUTLIER_WEIGHT * any_code))
            for each in belief.components
            if visit - each.visit <= MAX_SUCCESSIVE_OUTLIERS
        ]
        outside *= self.outside_likelihood(visit)
        return self._normalized(visit, updated, outside, outliers)

    def _normalized(
        self, visit: int, updated: list[Array], outside: float, outliers: list[Component]
    ) -> tuple[Belief, float]:
        """Return a belief of the sum 1 without negligible states, and the sum before."""
        total = outside + sum(float(each.sum()) for each in updated)
        total += sum(float(each.probability.sum()) for each in outliers)
        least = MIN_STATE_TO_CARRIED_RATIO * CARRIED_WEIGHT / self.state_count * total
        components = []
        for number, each in enumerate(updated):
            states = np.flatnonzero(each > least)
            components.append(Component(visit, number, states, each[states] / total))
        for component in outliers:
            kept = component.probability > least
            if kept.any():
                components.append(
                    replace(
                        component,
                        states=component.states[kept],
                        probability=component.probability[kept] / total,
                    )
                )
        return Belief(visit, components, outside / total), total

    def likelihood(self, visit: int, number: int) -> Array:
        """Return the likelihood (states,) of one hypothesis, for a robot that was not carried.

        A confirming visit adds no evidence of the cell: it is the same landmark, whether it agrees
        with the map or not.
        """
        hypothesis = self.followed[visit][number][1]
        known_code = self.confirming.get(visit)
        if known_code is None:
            return self.map_likelihood(visit, number)
        other = self.misread / (CODE_COUNT - 1)
        of_code = 1 - self.misread if hypothesis.code == known_code else other
        return np.full(self.state_count, hypothesis.probability * of_code)

    def map_likelihood(self, visit: int, number: int) -> Array:
        """Return the likelihood (states,) of one hypothesis by the codes of the map."""
        hypothesis = self.followed[visit][number][1]
        of_code = self._code_likelihood(hypothesis.code)
        return np.asarray(hypothesis.probability * of_code[self.read_code])

    def _code_likelihood(self, code: int) -> Array:
        """Return the likelihood of a code by the one on the map, with those of empty cells."""
        table = np.full(CODE_COUNT + 2, self.misread / (CODE_COUNT - 1))
        table[code] = 1 - self.misread
        table[CODE_COUNT] = UNMAPPED_LANDMARK_PROBABILITY / CODE_COUNT
        table[CODE_COUNT + 1] = OUTSIDE_LANDMARK_PROBABILITY / CODE_COUNT
        return table

    def any_code_likelihood(self, visit: int) -> float:
        """Return the likelihood of a visit if its code says nothing of the cell."""
        if visit in self.confirming:
            count = len(self.followed[visit])
            return float(sum(self.likelihood(visit, n)[0] for n in range(count)))
        return sum(one.probability for _, one in self.followed[visit]) / CODE_COUNT

    def outside_likelihood(self, visit: int) -> float:
        """Return the likelihood of a visit to a landmark outside of the map."""
        return OUTSIDE_LANDMARK_PROBABILITY * self.any_code_likelihood(visit)

    # ---- steps

    def steps(self, first: int, start: int, visit: int, end: int) -> CellSteps:
        """Return the steps from one hypothesis of a visit to one of a later visit."""
        key = first, start, visit, end
        if key not in self._steps:
            self._steps = {k: v for k, v in self._steps.items() if k[2] >= visit - 2}
            self._steps[key] = steps_between(
                self.visits[first],
                self.visits[visit],
                self.followed[first][start][1],
                self.followed[visit][end][1],
                pitch_m=self.pitch_m,
                drift=self.drift,
            )
        return self._steps[key]

    def _transitions(
        self, component: Component, visit: int, end: int
    ) -> Iterator[tuple[States, Array, States]]:
        """Yield where the states of a component lead to.

        Slips are followed only from probable states: there are many of them.

        Yields
        ------
        rows : (n,) int64 ndarray
            Indices of states of the component.
        weight : (n, steps) ndarray
            Likelihood of each step.
        arrival : (n, steps) int64 ndarray
            State after the step; -1 outside of the map.
        """
        steps = self.steps(component.visit, component.hypothesis, visit, end)
        confirmed = steps.that_odometry_confirms()
        is_probable = component.probability > MIN_SLIP_BELIEF
        for followed, rows in (
            (steps, np.flatnonzero(is_probable)),
            (confirmed, np.flatnonzero(~is_probable)),
        ):
            for start in range(0, len(rows) if len(followed) else 0, MAX_STATES_AT_ONCE):
                some = rows[start : start + MAX_STATES_AT_ONCE]
                yield some, *self._arrivals(component.states[some], followed)

    def _arrivals(self, states: States, steps: CellSteps) -> tuple[Array, States]:
        """Return likelihood and state (n, steps) after steps; the state is -1 off the map."""
        quarters, row, column = (each[:, None] for each in self.cells_of(states))
        x, y = steps.cells.T
        # Rotated by quarter turns from the frame of the hypothesis to the map.
        columns = np.stack([x, -y, -x, y])[quarters[:, 0]]
        rows = np.stack([y, x, -y, -x])[quarters[:, 0]]
        new_row, new_column = row + rows, column + columns
        height, width = self.shape
        is_on_map = (new_row >= 0) & (new_row < height) & (new_column >= 0) & (new_column < width)
        arrival = ((quarters + steps.quarters) % 4 * height + new_row) * width + new_column
        weight = steps.likelihood * self._missed_landmarks_likelihood(row, column, rows, columns)
        return weight, np.where(is_on_map, arrival, -1)

    def _missed_landmarks_likelihood(
        self, row: States, column: States, rows: States, columns: States
    ) -> Array:
        """Return the likelihood (n, steps) of no visit between both ends of a straight path."""
        likelihood = np.ones(rows.shape)
        # A straight step is straight from each state.
        is_straight = (rows[0] == 0) | (columns[0] == 0)
        rows, columns = rows[:, is_straight], columns[:, is_straight]
        height, width = self.shape
        along_row = self.landmarks_before[0]
        first, last = _between(column, column + columns, width)
        missed = along_row[row, last] - along_row[row, first]
        along_column = self.landmarks_before[1]
        first, last = _between(row, row + rows, height)
        missed += along_column[last, column] - along_column[first, column]
        likelihood[:, is_straight] = MISSED_LANDMARK_PROBABILITY**missed
        return likelihood

    def _confirming_visits(self) -> dict[int, int]:
        """Find visits that repeat what an earlier or later visit to the same landmark read.

        The visits to one landmark follow from the most likely steps.

        Returns
        -------
        dict of int to int
            Number of a visit to the code of the landmark, in the frame of the visit's most
            probable hypothesis.
        """
        visits_of: dict[tuple[int, Cell], list[int]] = {}
        for number, one in self.path.items():
            visits_of.setdefault(one.landmark, []).append(number)
        confirming: dict[int, int] = {}
        for numbers in visits_of.values():
            best = max(numbers, key=self._probability_of)
            for n in numbers:
                code_here = self._code_at(best, self.path[n])
                # A different reading is evidence: the path may be wrong, after a slip.
                if n != best and self.followed[n][0][1].code == code_here:
                    confirming[n] = code_here
        return confirming

    # ---- backward pass

    def estimates(self, beliefs: Sequence[Belief]) -> list[CellEstimate]:
        """Return the estimates of successive visits from the beliefs after each of them."""
        last = beliefs[-1]
        backward = [np.ones(len(each.states)) for each in last.components]
        outside = 1.0
        estimates = [self._estimate(last, backward, outside)]
        for belief, following in zip(beliefs[-2::-1], beliefs[:0:-1], strict=True):
            backward, outside = self._backward(belief, following, backward, outside)
            estimates.append(self._estimate(belief, backward, outside))
        return estimates[::-1]

    def _backward(
        self, belief: Belief, following: Belief, backward: list[Array], outside: float
    ) -> tuple[list[Array], float]:
        """Return the likelihood of all later readings at the states of a belief."""
        visit = following.visit
        followed = self.followed[visit]
        any_code = self.any_code_likelihood(visit)
        later = [np.zeros(self.state_count) for _ in followed]
        anywhere = 0.0
        stays: dict[tuple[int, int], tuple[States, Array]] = {}
        for component, value in zip(following.components, backward, strict=True):
            if component.visit == visit:
                states, number = component.states, component.hypothesis
                value = value * (1 - OUTLIER_WEIGHT)
                later[number][states] = value * self.likelihood(visit, number)[states]
                anywhere += float(value @ self.map_likelihood(visit, number)[states])
            else:
                stays[component.visit, component.hypothesis] = component.states, value
        anywhere /= self.state_count
        outside *= self.outside_likelihood(visit)
        values = []
        for component in belief.components:
            value = np.full(len(component.states), CARRIED_WEIGHT * (anywhere + outside))
            for end in range(len(followed)):
                for rows, weight, arrival in self._transitions(component, visit, end):
                    off_map = followed[end][1].probability * outside
                    after = np.where(arrival >= 0, later[end][arrival], off_map)
                    value[rows] += (weight * after).sum(axis=1)
            staying = stays.get((component.visit, component.hypothesis))
            if staying is not None:
                states, stay = staying
                rows = np.searchsorted(component.states, states)
                value[rows] += OUTLIER_WEIGHT * any_code * stay
            values.append(value)
        before_outside = (1 - RETURN_PROBABILITY) * outside + RETURN_PROBABILITY * anywhere
        scale = max(
            before_outside, max((float(each.max(initial=0.0)) for each in values), default=0.0)
        )
        return [each / scale for each in values], before_outside / scale

    def filtered_estimate(self, belief: Belief) -> CellEstimate:
        """Return the estimate of the last visit from the belief after it: no later one is known."""
        return self._estimate(
            belief, [np.ones(len(each.states)) for each in belief.components], 1.0
        )

    def _estimate(self, belief: Belief, backward: list[Array], outside: float) -> CellEstimate:
        """Return the most probable cell of a visit."""
        visit = belief.visit
        own = [
            (component, component.probability * value)
            for component, value in zip(belief.components, backward, strict=True)
            if component.visit == visit
        ]
        total = belief.outside * outside + sum(
            float((component.probability * value).sum())
            for component, value in zip(belief.components, backward, strict=True)
        )
        by_state = np.zeros(self.state_count)
        for component, posterior in own:
            by_state[component.states] += posterior
        good = float(by_state.sum())
        state = int(np.argmax(by_state))
        quarters, row, column = (int(each) for each in self.cells_of(np.array(state)))
        # The map contributes to the choice of the hypothesis of a confirming visit as well.
        weights = np.zeros(len(self.followed[visit]))
        filtered = 0.0
        for component, posterior in own:
            index = int(np.searchsorted(component.states, state))
            if index < len(component.states) and component.states[index] == state:
                weights[component.hypothesis] = posterior[index]
                if visit in self.confirming:
                    weights[component.hypothesis] *= self.map_likelihood(
                        visit, component.hypothesis
                    )[state]
                filtered += float(component.probability[index])
        best = int(np.argmax(weights))
        differs = np.array(
            [one.code != self.read_code[state] for _, one in self.followed[visit]], bool
        )
        misread = float(weights[differs].sum() / weights.sum()) if weights.any() else 0.0
        return CellEstimate(
            cell=(row - PAD_CELLS, column - PAD_CELLS),
            quarters=quarters,
            hypothesis=self.followed[visit][best][0],
            probability=float(by_state[state]) / total,
            filtered_probability=filtered,
            outlier_probability=max(0.0, 1 - (good + belief.outside * outside) / total),
            misread_probability=misread,
        )


class OtherFloor:
    """Belief of a robot on any other floor that has the same fraction of each code.

    Odometry, slips and outliers cost there what they cost on the map; any cell is as good as any
    other. Readings depend on the heading only, on a ``compass`` map much and on others little.
    """

    def __init__(self, model: CellModel) -> None:
        self.model = model
        read = model.read_code.reshape(4, -1)
        self.frequency = np.stack(
            [np.bincount(codes[codes < CODE_COUNT], minlength=CODE_COUNT) for codes in read]
        ).astype(float)
        self.frequency += 1.0  # Codes that this floor lacks may occur on another one.
        self.frequency /= self.frequency.sum(axis=1, keepdims=True)
        empty = (model.read_code >= CODE_COUNT)[: model.cell_count]
        outside = (model.read_code > CODE_COUNT)[: model.cell_count]
        hole_fraction = float((empty & ~outside).sum() / max((~outside).sum(), 1))
        self.mean_miss = hole_fraction + (1 - hole_fraction) * MISSED_LANDMARK_PROBABILITY
        self.heading_of: dict[int, Array] = {}  # By the last visit that is no outlier.

    def advance(self, visit: int) -> float:
        """Return the probability of the readings of the next visit."""
        model = self.model
        any_code = model.any_code_likelihood(visit)
        if self.heading_of:
            arriving = CARRIED_WEIGHT * sum(self.heading_of.values()) / 4
            for before, heading in self.heading_of.items():
                steps = model.steps(before, 0, visit, 0)
                for turn, likelihood in enumerate(self._turn_likelihood(steps)):
                    arriving = arriving + likelihood * np.roll(heading, turn)
        else:
            arriving = np.full(4, 0.25)
        if visit in model.confirming:
            likelihood = np.full(4, any_code)
        else:
            followed = model.followed[visit]
            likelihood = np.zeros(4)
            for _, one in followed:
                likelihood += one.probability * self.frequency[:, one.code]
        belief = {
            before: OUTLIER_WEIGHT * any_code * heading
            for before, heading in self.heading_of.items()
            if visit - before <= MAX_SUCCESSIVE_OUTLIERS
        }
        belief[visit] = (1 - OUTLIER_WEIGHT) * likelihood * arriving
        total = float(sum(each.sum() for each in belief.values()))
        self.heading_of = {before: each / total for before, each in belief.items()}
        return total

    def _turn_likelihood(self, steps: CellSteps) -> Array:
        """Return the likelihood (4,) of all steps that turn the robot by so many quarters."""
        columns, rows = np.abs(steps.cells.T)
        missed = np.where((columns == 0) | (rows == 0), np.maximum(columns + rows - 1, 0), 0)
        weight = steps.likelihood * self.mean_miss**missed
        return np.asarray(np.bincount(steps.quarters % 4, weight, minlength=4), float)


class ForwardPass:
    """Belief after successive visits, and the evidence for the map.

    Attributes
    ----------
    model : CellModel
    belief : Belief or None
        After the last visit.
    """

    def __init__(self, model: CellModel) -> None:
        self.model = model
        self.other = OtherFloor(model)
        self.belief: Belief | None = None
        self._log_map, self._log_other = 0.0, 0.0

    @property
    def log_evidence_ratio(self) -> float:
        """Log evidence of all visits for the map, relative to that for any other floor."""
        return self._log_map - self._log_other

    def copy(self) -> ForwardPass:
        """Return a copy that can be advanced by itself."""
        other = copy.copy(self)
        other.other = copy.copy(self.other)
        return other

    def limit_evidence(self, max_log_ratio: float) -> None:
        """Limit the evidence for and against the map: it may change later on."""
        ratio = self.log_evidence_ratio
        self._log_map, self._log_other = min(max(ratio, -max_log_ratio), max_log_ratio), 0.0

    def advance(self, visit: int) -> Belief:
        """Return the belief after the next visit."""
        if self.belief is None:
            self.belief, evidence = self.model.initial_belief(visit)
        else:
            self.belief, evidence = self.model.advance(self.belief, visit)
        self._log_map += math.log(evidence)
        self._log_other += math.log(self.other.advance(visit))
        return self.belief


def _followed_hypotheses(visit: VisitHypotheses) -> list[NumberedHypothesis]:
    """Return the more probable hypotheses with their indices."""
    numbered = list(enumerate(visit.hypotheses))
    kept = [(n, h) for n, h in numbered if n == 0 or h.probability > MIN_HYPOTHESIS_PROBABILITY]
    return kept[:MAX_FOLLOWED_HYPOTHESES]


def _between(start: States, end: States, size: int) -> tuple[States, States]:
    """Return the range of indices strictly between two ones, as far as they are below a size."""
    first = np.clip(np.minimum(start, end) + 1, 0, size)
    last = np.clip(np.maximum(start, end), 0, size)
    return first, np.maximum(first, last)
