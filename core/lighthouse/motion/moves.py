"""Stations that are moved during a recording.

The beginning and the end of a recording are estimated independently. If two stations stand
differently to each other in these, by more than the covariances explain, one of them was moved.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from locatk.core.geometry import skew
from locatk.core.lighthouse.motion.parameters import STATION_PARAMETERS
from locatk.core.lighthouse.motion.solver import PathEstimate

Array = NDArray[np.float64]

MOVED_SIGMAS = 7.0
"""Change of a relative pose of two stations, in standard deviations, that is a move."""

MIN_MOVE_M, MIN_TURN_RAD = 0.01, 5e-3
"""Smallest move: smaller ones are errors of the model."""


@dataclass(frozen=True)
class StationMove:
    """Change of the pose of one station relative to another.

    Attributes
    ----------
    stations : (int, int)
        One of the two was moved.
    distance_m, turn_rad : float
    """

    stations: tuple[int, int]
    distance_m: float
    turn_rad: float


def find_moves(first: PathEstimate, last: PathEstimate) -> list[StationMove]:
    """Return the pairs of stations that stand differently in two estimates."""
    moves = []
    for pair in combinations(range(len(first.common.positions)), 2):
        if any(np.any(estimate.is_left_out[list(pair)]) for estimate in (first, last)):
            continue
        before, after = (_relative_pose(estimate, *pair) for estimate in (first, last))
        step = after[0] - before[0]
        turn = Rotation.from_matrix(after[1] @ before[1].T).as_rotvec()
        change = np.concatenate([step, turn])
        # Of two stations without a scale, the covariance along the baseline is zero.
        inverse = np.linalg.pinv(before[2] + after[2], 1e-9, hermitian=True)
        ratio = float(change @ inverse @ change)
        move = StationMove(pair, float(np.linalg.norm(step)), float(np.linalg.norm(turn)))
        is_large = move.distance_m > MIN_MOVE_M or move.turn_rad > MIN_TURN_RAD
        if is_large and ratio > MOVED_SIGMAS**2:
            moves.append(move)
    return moves


def moved_stations(moves: Sequence[StationMove], count: int) -> tuple[int, ...]:
    """Return the stations that moved relative to most of the others; with two, both of them.

    ``count`` is the number of stations that are compared.
    """
    pairs = np.bincount([i for move in moves for i in move.stations])
    return tuple(np.flatnonzero(pairs > (count - 1) / 2).tolist())


def _relative_pose(estimate: PathEstimate, i: int, j: int) -> tuple[Array, Array, Array]:
    """Return position, rotation and covariance (6, 6) of a station in the axes of another."""
    positions, rotations, _ = estimate.common.stations
    to_first, offset = rotations[i].T, positions[j] - positions[i]
    jacobian = np.zeros((6, len(estimate.common_covariance)))
    a, b = i * STATION_PARAMETERS, j * STATION_PARAMETERS
    jacobian[:3, a : a + 3], jacobian[:3, b : b + 3] = -to_first, to_first
    jacobian[:3, a + 3 : a + 6] = to_first @ skew(offset)
    jacobian[3:, a + 3 : a + 6], jacobian[3:, b + 3 : b + 6] = -to_first, to_first
    covariance = jacobian @ estimate.common_covariance @ jacobian.T
    return to_first @ offset, to_first @ rotations[j], covariance
