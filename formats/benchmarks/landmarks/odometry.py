"""Figures of long drives with several errors of odometry: consistency of the covariances.

The odometry is integrated from the increments of the true path with a constant scale and white
noise of each increment; neither the wheels of the simulation nor the model of the solver is used.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from locatk.core.geometry import heading_from_quaternion, quaternion_from_heading
from locatk.core.landmarks.detection.trace import compose, relative
from locatk.core.landmarks.map.floor import Cell, FloorMap
from locatk.core.landmarks.simulation.session import SimulatedSession
from locatk.core.landmarks.solver import solve
from locatk.formats.benchmarks.figures import Figure
from locatk.formats.benchmarks.landmarks.faults import drive_over
from locatk.formats.benchmarks.landmarks.global_localization import standard_floor
from locatk.formats.benchmarks.landmarks.sessions import score_session
from locatk.formats.benchmarks.timing import FIRST_SEED

Array = NDArray[np.float64]

LONG_DRIVES = 4
"""Drives with each kind of odometry."""

LONG_DRIVE_CELLS = 60
"""Length of a drive: 12 m."""

LEG_CELLS_RANGE = (2, 8)
"""Shortest and longest straight line."""

WHEEL_PATH_M_PER_RAD = 0.05
"""Path of the wheels in a rotation that counts like a distance for the noise."""

POSE_FREEDOM = 3
"""Degrees of freedom of a pose."""


@dataclass(frozen=True)
class OdometryErrors:
    """Errors of odometry.

    Attributes
    ----------
    walk_rad, walk_m : float
        Random walk of heading and of the distance, over a square root of a metre.
    scale : float
        Relative error of distances and rotations: standard deviation.
    lag_s : float
        Time by which the odometry is late.
    """

    walk_rad: float
    walk_m: float
    scale: float = 0.01
    lag_s: float = 0.0


KINDS = {
    "a random walk of 0.05 deg": OdometryErrors(math.radians(0.05), 0.1e-3),
    "a random walk of 0.86 deg": OdometryErrors(math.radians(0.86), 0.5e-3),
    "a lag of 60 ms": OdometryErrors(math.radians(0.26), 0.5e-3, lag_s=0.06),
}
"""Kinds of odometry by name, in the order of their seeds."""


def odometry_figures(folder: Path) -> Iterator[Figure]:
    """Score long drives; ``folder`` contains the published maps."""
    floor, source = standard_floor(folder)
    for number, (name, errors) in enumerate(KINDS.items()):
        first = FIRST_SEED + 2400 + 100 * number
        nees, errors_m = [], []
        for seed in range(first, first + LONG_DRIVES):
            session = drive_over(floor, seed, zigzag_cells(floor, seed))
            session = with_odometry(session, errors, seed)
            score = score_session(session, solve(session.samples, floor, odometry=session.odometry))
            nees.append(float(np.mean(score.nees)) / POSE_FREEDOM if score.has_poses else math.nan)
            errors_m.append(score.error_m)
        median = 1e3 * float(np.median(np.concatenate(errors_m)))
        yield Figure(f"drive of 12 m, odometry with {name}: NEES", float(np.mean(nees)), "",
                     f"a degree of freedom, of {LONG_DRIVES} drives ({min(nees):.2f} to "
                     f"{max(nees):.2f}), {source}; median error {median:.2f} mm")  # fmt: skip


def zigzag_cells(floor: FloorMap, seed: int) -> tuple[Cell, ...]:
    """Return the corners of a long drive at right angles."""
    rng = np.random.default_rng([seed, 5])
    position = [int(rng.integers(1, size - 1)) for size in floor.shape]
    corners, length, axis = [(position[0], position[1])], 0, int(rng.integers(2))
    while length < LONG_DRIVE_CELLS:
        step = int(rng.integers(*LEG_CELLS_RANGE)) * int(rng.choice([-1, 1]))
        if not 1 <= position[axis] + step < floor.shape[axis] - 1:
            step = -step
        if not 1 <= position[axis] + step < floor.shape[axis] - 1:
            continue
        position[axis] += step
        length += abs(step)
        corners.append((position[0], position[1]))
        axis = 1 - axis
    return tuple(corners)


def with_odometry(session: SimulatedSession, errors: OdometryErrors, seed: int) -> SimulatedSession:
    """Return the session with odometry of other errors."""
    rng = np.random.default_rng([seed, 6])
    given, truth = session.odometry[0], session.truth[0]
    heading = np.unwrap(heading_from_quaternion(truth.quaternion))
    elapsed_ns = given.time_ns - truth.time_ns[0] - round(1e9 * errors.lag_s)
    pose = np.column_stack(
        [
            np.interp(elapsed_ns, truth.time_ns - truth.time_ns[0], column)
            for column in (*truth.position[:, :2].T, heading)
        ]
    )
    step = np.array([relative(after[None], before)[0] for before, after in pairwise(pose)])
    root = np.sqrt(np.hypot(*step[:, :2].T) + WHEEL_PATH_M_PER_RAD * np.abs(step[:, 2]))
    noise = rng.normal(size=step.shape) * [errors.walk_m, errors.walk_m / 3, errors.walk_rad]
    scale = 1 + errors.scale * rng.normal(size=2)
    step = step * scale[[0, 0, 1]] + root[:, None] * noise
    poses = [np.zeros(POSE_FREEDOM)]
    for each in step:
        poses.append(compose(poses[-1], each))
    path = np.array(poses)
    position = np.column_stack([path[:, :2], np.zeros(len(path))])
    measured = replace(given, position=position, quaternion=quaternion_from_heading(path[:, 2]))
    return replace(session, odometry=(measured,))
