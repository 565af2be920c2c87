"""Number of landmarks that a robot must visit until its poses are final, from each start.

Poses are final once the robot is on this floor, and in this cell, with a probability of 0.999
(:data:`~locatk.core.trajectory.PROVISIONAL_PROBABILITY`). The probability is that of the cell
filter (:mod:`~locatk.core.landmarks.localization.cell_filter`) for a drive without faults: all
landmarks are read right and beyond doubt, and odometry confirms each step. With the codes c_i of
the landmarks visited so far, the start s is compared with all others and with any other floor:

    P(s) = L(s) / (sum_s' L(s') + sum_h prod_i f_h(c_i) / 4 * prior odds)

L(s') is the prior probability of a start times the likelihoods of the codes on its path, and f_h
the frequency of the codes at heading h. Starts whose codes differ count as well, because landmarks
may be misread.

The drive is that of :mod:`.localization_steps`. A landmark that is visited again adds nothing.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.design.localization_steps import LocalizationDrive, Start
from locatk.core.landmarks.detection.hypotheses import Hypothesis, VisitHypotheses
from locatk.core.landmarks.detection.trace import OdometryDrift
from locatk.core.landmarks.landmark import CODE_COUNT
from locatk.core.landmarks.localization.cell_filter import (
    OTHER_FLOOR_PROBABILITY,
    PAD_CELLS,
    CellModel,
    OtherFloor,
)
from locatk.core.landmarks.map.floor import HOLE_CODE, Cell, FloorMap
from locatk.core.landmarks.solver import SolveOptions
from locatk.core.trajectory import PROVISIONAL_PROBABILITY

Array = NDArray[np.float64]

MAX_COMPARISONS = 10_000_000
"""Pairs of starts that are compared at most; on larger floors, some of the starts are tested. It
bounds the time to about a second."""

MAX_LANDMARKS = 24
"""Landmarks after which a start counts as one that never has final poses on this drive."""

MAX_REPEATED_VISITS = 40
"""Successive visits to known landmarks after which a drive is taken for a circle."""


@dataclass(frozen=True)
class FinalPoses:
    """Number of landmarks to visit until poses are final, including the first one.

    Attributes
    ----------
    starts : int
        Number of starts that were tested, of all cells and headings.
    mean, p99 : float or None
        Over the starts that lead to final poses; None if there are none.
    worst : int or None
    worst_start : (cell, heading) or None
        First of the tested starts that need the most landmarks.
    never : int
        Number of tested starts without final poses, however far the robot drives.
    """

    starts: int
    mean: float | None
    p99: float | None
    worst: int | None
    worst_start: Start | None
    never: int


def count_landmarks_until_final(
    floor: FloorMap, misread: float = SolveOptions.misread
) -> FinalPoses:
    """Count the landmarks until poses are final.

    Parameters
    ----------
    floor : FloorMap
        With the codes as built.
    misread : float
        Probability that a landmark differs from the map or is misread; that of the solver.
    """
    starts = 4 * np.flatnonzero(floor.codes.reshape(-1) != HOLE_CODE)[:, None] + np.arange(4)
    tested = starts.reshape(-1)
    evidence = MapEvidence(floor, misread)
    max_starts = max(MAX_COMPARISONS // evidence.likelihood[0].size, 1)
    if len(tested) > max_starts:
        # The same starts each time, so that the result is that of the map.
        tested = np.sort(np.random.default_rng(0).choice(tested, max_starts, replace=False))
    drive = LocalizationDrive.on(floor)
    counts = [evidence.landmarks_until_final(drive, int(start)) for start in tested]
    final = np.array([count for count in counts if count is not None])
    worst = int(final.max()) if len(final) else None
    worst_start = None
    if worst is not None:
        cell, heading = divmod(int(tested[counts.index(worst)]), 4)
        row, column = divmod(cell, floor.shape[1])
        worst_start = (row, column), heading
    return FinalPoses(
        starts=len(tested),
        mean=float(final.mean()) if len(final) else None,
        p99=float(np.percentile(final, 99)) if len(final) else None,
        worst=worst,
        worst_start=worst_start,
        never=counts.count(None),
    )


class MapEvidence:
    """Likelihoods of the codes of a map, as the cell filter has them.

    Attributes
    ----------
    likelihood : (16, 4, rows, columns) ndarray
        Of reading a code at each heading and cell, on the map with its pad.
    other : (4, 16) ndarray
        Frequency of the codes on any other floor, by heading.
    codes : (4, rows, columns) int64 ndarray
        Code that is read at each heading and cell, with the pad.
    """

    def __init__(self, floor: FloorMap, misread: float) -> None:
        # A visit for each code, which is read beyond doubt.
        certain = [_certain_visit(code) for code in range(CODE_COUNT)]
        model = CellModel(certain, floor, misread=misread, drift=OdometryDrift())
        size = 4, *model.shape
        self.likelihood = np.stack(
            [model.map_likelihood(code, 0).reshape(size) for code in range(CODE_COUNT)]
        )
        self.codes = model.read_code.reshape(size)
        self.other = OtherFloor(model).frequency
        self.columns = floor.shape[1]

    def landmarks_until_final(self, drive: LocalizationDrive, start: int) -> int | None:
        """Return how many landmarks a drive visits until its poses are final; None if it never.

        ``start`` is ``4 cell + heading`` on the map without pad.
        """
        cells = self._cells_of_drive(drive, start)
        for count, probability in enumerate(self.posteriors(cells, start % 4), 1):
            if probability >= PROVISIONAL_PROBABILITY:
                return count
        return None

    def posteriors(self, cells: Iterable[Cell], heading: int = 0) -> Iterator[float]:
        """Yield the probability of this floor and the true start after each of the landmarks.

        Parameters
        ----------
        cells : iterable of cell
            Different landmarks of the map in the order in which they are read.
        heading : int
            Of the robot at the first one, in quarter turns; the result hardly depends on it.
        """
        posterior = np.full(self.likelihood.shape[1:], 1 / self.likelihood[0].size)
        prior_odds = OTHER_FLOOR_PROBABILITY / (1 - OTHER_FLOOR_PROBABILITY)
        other = np.full(4, prior_odds / 4)
        first: Cell | None = None
        for row, column in cells:
            cell = row + PAD_CELLS, column + PAD_CELLS
            first = first or cell
            code = int(self.codes[heading][cell])
            offset = cell[0] - first[0], cell[1] - first[1]
            posterior *= self._likelihood_along(code, offset, heading)
            other *= self.other[:, code]
            yield float(posterior[heading][first] / (posterior.sum() + other.sum()))

    def _cells_of_drive(self, drive: LocalizationDrive, start: int) -> Iterator[Cell]:
        """Yield the different cells of a drive, up to :data:`MAX_LANDMARKS`."""
        state, visited, repeated = start * drive.phases, set[Cell](), 0
        while len(visited) < MAX_LANDMARKS and repeated < MAX_REPEATED_VISITS:
            cell = divmod(state // drive.phases // 4, self.columns)
            state = int(drive.next_state[state])
            repeated += 1
            if cell not in visited:
                visited.add(cell)
                repeated = 0
                yield cell

    def _likelihood_along(self, code: int, offset: Cell, heading: int) -> Array:
        """Return the likelihood (4, rows, columns) of a code by the heading and cell of the start.

        ``offset`` is that of the landmark from the start, at ``heading``. Starts whose paths leave
        the map have the likelihood 0.
        """
        shifted = np.zeros_like(self.likelihood[code])
        height, width = shifted.shape[1:]
        for quarters in range(4):
            rows, columns = offset
            for _ in range((quarters - heading) % 4):
                rows, columns = columns, -rows
            source = self.likelihood[code, quarters]
            shifted[
                quarters,
                max(-rows, 0) : height - max(rows, 0),
                max(-columns, 0) : width - max(columns, 0),
            ] = source[
                max(rows, 0) : height - max(-rows, 0), max(columns, 0) : width - max(-columns, 0)
            ]
        return shifted


def _certain_visit(code: int) -> VisitHypotheses:
    unknown = np.full(4, np.nan)
    hypothesis = Hypothesis(code, 1.0, np.zeros(3), np.zeros((3, 3)), unknown, unknown)
    return VisitHypotheses("", 0, 0, 0, np.zeros(3), (hypothesis,))
