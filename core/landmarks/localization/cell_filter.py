"""Which cells of the map were visited: a Bayes filter over cell and heading, and back again.

The paper compares three patterns in an L with the map (section 4.2). Here every visit
counts, with the probabilities of all that it may have been; a landmark may be misread,
missing or laid a bit off, and odometry says how many cells lie between two visits.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.detection.hypotheses import Hypothesis, VisitHypotheses
from locatk.core.landmarks.detection.trace import Drift
from locatk.core.landmarks.landmark import CODES, rotated
from locatk.core.landmarks.map.floor import HOLE, FloorMap, as_built_codes

Array = NDArray[np.float64]

HALF_PI = math.pi / 2

PAD = 3
"""Cells around the map in which a robot may be too, though no landmark is told there."""

UNTOLD = 1e-3
"""Probability of a landmark in a cell of the map that has none."""

BEYOND = 0.01
"""The same beside the map, of which it says nothing."""

LOST = 1e-7
"""Probability that a robot was carried to anywhere between two visits."""

ELSEWHERE = 1e-4
"""Probability that a recording begins where the map has nothing to say: it is of another
floor, or all fields have the other sign."""

BACK = 1e-2
"""Probability of coming onto the map, from one visit to the next, from elsewhere."""

UNSEEN = 0.02
"""Probability of no sighting of a landmark that lies on the way."""

PLACE_M = 3e-3
"""Standard deviation of a landmark's place, beside that of odometry."""

FAINT = 1e-4
"""Probability under which a hypothesis of a visit is not followed."""

MOST = 6

FAR = 9.0
"""Logarithm of likelihood that a step of whole cells may lack."""


@dataclass(frozen=True)
class Located:
    """Where on the map one sighting was.

    Attributes
    ----------
    cell : (row, column)
    quarters : int
        The heading of the hypothesis' frame in the map, in quarter turns.
    hypothesis : int
        Of the sighting, in its order.
    probability : float
        Of this cell and heading, given all sightings.
    so_far : float
        The same, given this sighting and those before it only.
    """

    cell: tuple[int, int]
    quarters: int
    hypothesis: int
    probability: float
    so_far: float


@dataclass(frozen=True)
class _Step:
    """Whole cells from one visit to the next, in the frame of the first one's hypothesis."""

    before: int
    after: int
    cells: tuple[int, int]
    quarters: int
    odds: float


def locate(
    sightings: Sequence[VisitHypotheses], floor: FloorMap, *, misread: float, drift: Drift
) -> list[Located]:
    """Places of sightings of one robot, in order of time.

    Parameters
    ----------
    sightings : sequence of Sighting
        Each with a hypothesis at least.
    floor : FloorMap
    misread : float
        Probability that a landmark is laid otherwise than the map says, or is misread.
    drift : Drift
        Of the odometry between visits.

    Returns
    -------
    list of Located
    """
    if not sightings:
        return []
    kept = [_followed(sighting) for sighting in sightings]
    steps = [
        _steps(one, other, hypotheses, others, floor.pitch_m, drift)
        for (one, other), (hypotheses, others) in zip(
            pairwise(sightings), pairwise(kept), strict=True
        )
    ]
    laid = as_built_codes(floor)
    read = [_seen(hypotheses, laid, misread) for hypotheses in kept]
    seen = list(read)
    every = [sum(one.probability for _, one in hypotheses) / CODES for hypotheses in kept]
    for number, code in _again(kept, steps).items():
        # How a landmark is laid is drawn once: a second look tells nothing of where it is.
        known = _known(kept[number], code, misread)
        seen[number] = np.broadcast_to(known[:, None, None, None], seen[number].shape)
        every[number] = float(known.sum())
    unseen = _unseen(floor)
    forward = [_normal(seen[0] / (4 * unseen.size) * (1 - ELSEWHERE), ELSEWHERE * every[0])]
    for step, now, share in zip(steps, seen[1:], every[1:], strict=True):
        belief, away = _moved(*forward[-1], step, len(now), unseen)
        forward.append(_normal(belief * now, away * share))
    backward = [(np.ones_like(seen[-1]), 1.0)]
    for k in range(len(steps) - 1, -1, -1):
        belief, away = backward[-1]
        later = _moved_back(
            belief * seen[k + 1], away * every[k + 1], steps[k], len(kept[k]), unseen
        )
        backward.append(_normal(*later))
    found = []
    for hypotheses, own, (past, out), (future, still) in zip(
        kept, read, forward, reversed(backward), strict=True
    ):
        both, away = _normal(past * future, out * still)
        state = both.sum(axis=0)
        quarters, row, column = np.unravel_index(np.argmax(state), state.shape)
        # Of a landmark seen again the map has a word too in which hypothesis is right.
        number = int(np.argmax((both * own)[:, quarters, row, column]))
        found.append(
            Located(
                (int(row) - PAD, int(column) - PAD),
                int(quarters),
                hypotheses[number][0],
                float(state[quarters, row, column]),
                float(past[:, quarters, row, column].sum()),
            )
        )
    return found


def _normal(belief: Array, away: float) -> tuple[Array, float]:
    """Both, so that they sum to 1."""
    total = float(belief.sum()) + away
    return belief / total, away / total


def _again(kept: list[list[tuple[int, Hypothesis]]], steps: list[list[_Step]]) -> dict[int, int]:
    """Visits to a landmark that another visit has told better, and its code by that one.

    Which visits are of one landmark is taken from the likeliest steps. Codes are in the
    frame of the visit's likeliest hypothesis.
    """
    place: list[tuple[int, tuple[int, int], int]] = [(0, (0, 0), 0)]
    for number, several in enumerate(steps, 1):
        chain, (x, y), turn = place[-1]
        straight = [step for step in several if step.before == 0 and step.after == 0]
        if straight:
            step = max(straight, key=lambda one: one.odds)
            rows, columns = _on_map(step.cells, turn)
            place.append((chain, (x + columns, y + rows), (turn + step.quarters) % 4))
        else:
            place.append((number, (0, 0), 0))
    groups: dict[tuple[int, tuple[int, int]], list[int]] = {}
    for number, (chain, cell, _) in enumerate(place):
        groups.setdefault((chain, cell), []).append(number)
    again: dict[int, int] = {}
    for numbers in groups.values():
        best = max(numbers, key=lambda n: kept[n][0][1].probability)
        laid = int(rotated(kept[best][0][1].code, place[best][2]))
        again |= {n: int(rotated(laid, -place[n][2])) for n in numbers if n != best}
    return again


def _known(hypotheses: list[tuple[int, Hypothesis]], code: int, misread: float) -> Array:
    """Likelihood (H,) of hypotheses of a landmark whose code is known, wherever it is."""
    return np.array(
        [
            one.probability * (1 - misread if one.code == code else misread / (CODES - 1))
            for _, one in hypotheses
        ]
    )


def _followed(sighting: VisitHypotheses) -> list[tuple[int, Hypothesis]]:
    """The likelier hypotheses with their numbers."""
    every = list(enumerate(sighting.hypotheses))
    return [(n, h) for n, h in every if n == 0 or h.probability > FAINT][:MOST]


def _seen(
    hypotheses: list[tuple[int, Hypothesis]], laid: NDArray[np.int64], misread: float
) -> Array:
    """Likelihood (H, 4, rows, columns) of each hypothesis in each state, the pad included."""
    codes = np.pad(laid, PAD, constant_values=HOLE)
    turned = np.stack([rotated(np.maximum(codes, 0), -q) for q in range(4)])
    inside = np.pad(np.ones(laid.shape, bool), PAD)
    untold = np.where(inside, UNTOLD, BEYOND) / CODES
    out = np.empty((len(hypotheses), 4, *codes.shape))
    for place, (_, one) in enumerate(hypotheses):
        same = np.where(turned == one.code, 1 - misread, misread / (CODES - 1))
        out[place] = one.probability * np.where(codes == HOLE, untold, same)
    return out


def _unseen(floor: FloorMap) -> Array:
    """Likelihood (rows, columns) of passing a cell without a sighting, the pad included."""
    return np.where(np.pad(floor.codes, PAD, constant_values=HOLE) == HOLE, 1.0, UNSEEN)


def _steps(
    one: VisitHypotheses,
    other: VisitHypotheses,
    before: list[tuple[int, Hypothesis]],
    after: list[tuple[int, Hypothesis]],
    pitch_m: float,
    drift: Drift,
) -> list[_Step]:
    """Steps of whole cells that odometry allows between two sightings."""
    way = other.odometry[:2] - one.odometry[:2]
    turn = float(other.odometry[2] - one.odometry[2])
    back = -one.odometry[2]
    ahead = np.array(
        [
            math.cos(back) * way[0] - math.sin(back) * way[1],
            math.sin(back) * way[0] + math.cos(back) * way[1],
        ]
    )
    length = float(np.hypot(*ahead))
    swing = math.hypot(drift.curvature_radpm * length, drift.turn_scale * abs(turn), drift.walk_rad)
    steps = []
    for i, (_, first) in enumerate(before):
        for j, (_, last) in enumerate(after):
            facing = first.pose[2] + turn - last.pose[2]
            quarters = round(facing / HALF_PI)
            rest = facing - quarters * HALF_PI
            angle = np.hypot(swing, math.radians(2))
            cos, sin = math.cos(first.pose[2]), math.sin(first.pose[2])
            place = first.pose[:2] + [
                cos * ahead[0] - sin * ahead[1],
                sin * ahead[0] + cos * ahead[1],
            ]
            c, s = math.cos(quarters * HALF_PI), math.sin(quarters * HALF_PI)
            x, y = last.pose[:2]
            cells = (place - [c * x - s * y, s * x + c * y]) / pitch_m
            spread = math.hypot(
                PLACE_M,
                drift.scale * length,
                swing * length,
                _sigma(first),
                _sigma(last),
            )
            sigma = spread / pitch_m
            for a in range(math.floor(cells[0]), math.floor(cells[0]) + 2):
                for b in range(math.floor(cells[1]), math.floor(cells[1]) + 2):
                    miss = ((cells[0] - a) ** 2 + (cells[1] - b) ** 2) / sigma**2
                    odds = -(miss + (rest / angle) ** 2) / 2
                    if odds > -FAR:
                        steps.append(_Step(i, j, (a, b), quarters, odds))
    # How well odometry fits says nothing of the map: the best step counts in full.
    best = max((step.odds for step in steps), default=0.0)
    return [replace(step, odds=step.odds - best) for step in steps]


def _sigma(hypothesis: Hypothesis) -> float:
    """Standard deviation of its place, in metres."""
    trace = float(np.trace(hypothesis.covariance[:2, :2]))
    return math.sqrt(trace) if math.isfinite(trace) else 2 * PLACE_M


def _moved(
    belief: Array, away: float, steps: list[_Step], count: int, unseen: Array
) -> tuple[Array, float]:
    """Belief (count, 4, rows, columns) after steps from ``belief`` (H, 4, rows, columns), and
    that of being nowhere on the map."""
    total = float(belief.sum())
    anywhere = (LOST * total + BACK * away) / belief[0].size / count
    out = np.full((count, *belief.shape[1:]), anywhere)
    left = (1 - BACK) * away + LOST * total
    for step in steps:
        weight = math.exp(step.odds)
        for quarters in range(4):
            rows, columns = _on_map(step.cells, quarters)
            going = weight * belief[step.before, quarters] * _passed(unseen, rows, columns)
            moved = _shifted(going, rows, columns)
            out[step.after, (quarters + step.quarters) % 4] += moved
            left += float(going.sum() - moved.sum())
    return out, max(left, 0.0)


def _moved_back(
    belief: Array, away: float, steps: list[_Step], count: int, unseen: Array
) -> tuple[Array, float]:
    """The transpose of :func:`_moved`."""
    total = float(belief.sum()) / belief[0].size / len(belief)
    out = np.full((count, *belief.shape[1:]), LOST * (total + away))
    for step in steps:
        weight = math.exp(step.odds)
        for quarters in range(4):
            rows, columns = _on_map(step.cells, quarters)
            there = belief[step.after, (quarters + step.quarters) % 4]
            back = _shifted(there, -rows, -columns, fill=away)
            out[step.before, quarters] += weight * _passed(unseen, rows, columns) * back
    return out, (1 - BACK) * away + BACK * total


def _on_map(cells: tuple[int, int], quarters: int) -> tuple[int, int]:
    """(rows, columns) of a step of (x, y) cells in a frame turned by quarters."""
    x, y = cells
    for _ in range(quarters % 4):
        x, y = -y, x
    return y, x


def _passed(unseen: Array, rows: int, columns: int) -> Array:
    """Likelihood, by the cell of departure, that nothing was seen on a straight way."""
    out = np.ones_like(unseen)
    if rows and columns:
        return out
    length = max(abs(rows), abs(columns))
    for k in range(1, length):
        out *= _shifted(unseen, -rows * k // length, -columns * k // length, fill=1.0)
    return out


def _shifted(values: Array, rows: int, columns: int, fill: float = 0.0) -> Array:
    """``values`` (rows, columns) moved up by whole cells."""
    out = np.full_like(values, fill)
    height, width = values.shape
    if abs(rows) < height and abs(columns) < width:
        source = (_span(-rows, height), _span(-columns, width))
        target = (_span(rows, height), _span(columns, width))
        out[target] = values[source]
    return out


def _span(shift: int, size: int) -> slice:
    return slice(max(shift, 0), size + min(shift, 0))
