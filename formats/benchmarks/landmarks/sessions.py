"""Figures of whole sessions on the map of 24 x 24 landmarks, simulated and solved.

The floor consists of single bars (magpylib) with nominal errors; landmarks are displaced by 1 mm
along each axis and rotated by half a degree (one sigma), which the solver does not know. Poses are
compared with the truth in the frame of the map.

In the closed loop, each robot drives by the published method's own estimates
(``simulate landmarks --strategy published``): it searches a landmark from anywhere on the map, and
its driver knows only sensors and odometry.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import LocatkError
from locatk.core.geometry import heading_from_quaternion
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.landmarks.published.driver import published_driver
from locatk.core.landmarks.simulation.closed_loop import Approach
from locatk.core.landmarks.simulation.options import Faults, SimulationOptions
from locatk.core.landmarks.simulation.session import SimulatedSession, simulate
from locatk.core.landmarks.solver import SolveOptions, solve
from locatk.core.solution import Solution
from locatk.core.trajectory import PROVISIONAL_PROBABILITY
from locatk.formats.benchmarks.figures import Figure
from locatk.formats.benchmarks.landmarks.global_localization import (
    MISREAD_FRACTION,
    standard_floor,
)
from locatk.formats.benchmarks.timing import FIRST_SEED

Array = NDArray[np.float64]

SIMULATED_SESSIONS = 30

MISREAD_SESSION_LANDMARKS = 5
"""Landmarks of each session with misread landmarks."""

MAX_MEDIAN_ERROR_M = 0.05
"""Median position error beyond which a trajectory is wrong."""

STAMP_ROUNDING_NS = 1_000_000
"""Tolerance of the times of detections, which are stored in seconds."""

SEARCHING_ROBOTS = 150
"""Robots that search one landmark each."""

CLOSED_LOOP_SESSIONS = 30
"""Sessions with the landmarks of the map's window."""

SEARCH_SAMPLE_RATE_HZ = 100.0
"""Sample rate of the robots that search one landmark; half of the default, to save time."""

INDEPENDENT_PERCENT = {"centre": 71.0, "no_pattern": 21.0, "wrong_pattern": 7.5}
"""Percentages of 916 approaches, measured by another party with the functions of
:mod:`locatk.core.landmarks.published` and its own robot."""

OUTCOME_LABELS = {
    "centre": "approaches that end at the centre",
    "no_pattern": "no pattern after four spins",
    "wrong_pattern": "wrong pattern",
}


@dataclass(frozen=True)
class SessionResult:
    """Errors of a solved session.

    Attributes
    ----------
    has_poses : bool
        True if poses on the map are reported.
    is_certain : bool
        True if the cells are reported without doubt.
    wrong_cells : int
        Landmarks that are reported in another cell.
    error_m : (n,) ndarray
        Position errors; empty without poses.
    heading_rad : (n,) ndarray
        Heading errors.
    nees : (n,) ndarray
        Squared errors of x, y and heading in units of their covariance.
    """

    has_poses: bool
    is_certain: bool
    wrong_cells: int
    error_m: Array
    heading_rad: Array
    nees: Array

    @property
    def is_wrong(self) -> bool:
        """True if the poses, or the cell of a landmark, are those of another position."""
        is_displaced = len(self.error_m) and np.median(self.error_m) > MAX_MEDIAN_ERROR_M
        return bool(self.wrong_cells or is_displaced)


# ---- recorded sessions


def session_figures(folder: Path) -> list[Figure]:
    """Score L sessions, and longer ones on floors with wrong landmarks.

    ``folder`` contains the published maps.
    """
    floor, source = standard_floor(folder)
    plain = SimulationOptions()
    faulty = replace(
        plain, faults=Faults(misread_rate=MISREAD_FRACTION), landmarks=MISREAD_SESSION_LANDMARKS
    )
    clean, clean_failures = solve_sessions(floor, plain, FIRST_SEED + 400)
    hard, hard_failures = solve_sessions(floor, faulty, FIRST_SEED + 600)
    paper, _ = solve_sessions(floor, plain, FIRST_SEED + 400, "paper")
    error, heading, nees = _pose_errors(clean)
    error_paper, heading_paper, _ = _pose_errors(paper)
    peer = "--method paper, the same sessions"
    how = (
        f"{SIMULATED_SESSIONS} simulated sessions of the paper's strategy with an L of three from "
        f"anywhere, {source}, nominal errors; every pose between the first landmark and the last"
    )
    silent = [result for result in hard if result.is_wrong and result.is_certain]
    return [
        Figure("L sessions: right cells, and poses given", right_percent(clean), "%",
               how + clean_failures, 100.0, "higher", peer, right_percent(paper)),
        Figure("L sessions: position, mean", float(error.mean()), "mm",
               "of sessions in the right cells; the paper: 1 mm at a landmark",
               peer=peer, peer_value=float(error_paper.mean())),
        Figure("L sessions: position, p95", float(np.quantile(error, 0.95)), "mm",
               "of the same poses", peer=peer, peer_value=float(np.quantile(error_paper, 0.95))),
        Figure("L sessions: heading, rms", float(np.sqrt(np.mean(heading**2))), "deg",
               "of the same poses; the paper: 1.5 degrees at a landmark",
               peer=peer, peer_value=float(np.sqrt(np.mean(heading_paper**2)))),
        Figure("L sessions: NEES", float(nees.mean()), "",
               "squared errors of x, y and heading in units of their covariance, mean",
               peer="consistent", peer_value=3.0),
        Figure("sessions with 5 % misread landmarks: wrong silently", float(len(silent)),
               "sessions", f"of {SIMULATED_SESSIONS} with {MISREAD_SESSION_LANDMARKS} landmarks "
               "each: a wrong cell, or poses of another position, at a probability of "
               f"{PROVISIONAL_PROBABILITY} or more{hard_failures}", 0.0),
        Figure("sessions with 5 % misread landmarks: right, and poses given", right_percent(hard),
               "%", "of the same sessions", better="higher"),
    ]  # fmt: skip


def solve_sessions(
    floor: FloorMap, options: SimulationOptions, seed: int, method: str = "field"
) -> tuple[list[SessionResult], str]:
    """Simulate and solve sessions; return their results, and the failures as text."""
    results, failures = [], []
    for k in range(seed, seed + SIMULATED_SESSIONS):
        try:
            session = simulate(floor, replace(options, seed=k))
            solution = solve(
                session.samples, floor, SolveOptions(method), odometry=session.odometry
            )
            result = score_session(session, solution)
        except LocatkError as error:
            result = SessionResult(False, False, 0, *(np.empty(0),) * 3)
            failures.append(f"{k}: {error}")
        else:
            if result.is_wrong:
                certainty = "silently" if result.is_certain else "with a remark"
                failures.append(f"{k}: wrong, {certainty}")
            elif not result.has_poses:
                failures.append(f"{k}: no poses")
        results.append(result)
    return results, f"; seeds {', '.join(failures)}" if failures else ""


def score_session(session: SimulatedSession, solution: Solution) -> SessionResult:
    """Compare a solution with the truth, from the first localized landmark to the last."""
    truth = session.truth[0]
    start_ns = truth.time_ns[0]
    columns = (*truth.position[:, :2].T, np.unwrap(heading_from_quaternion(truth.quaternion)))

    def true_poses(time_ns: NDArray[np.int64]) -> Array:
        elapsed, times = time_ns - start_ns, truth.time_ns - start_ns
        return np.column_stack([np.interp(elapsed, times, column) for column in columns])

    wrong_cells, localized_ns = 0, []
    for detection in solution.detections:
        if detection.cell is None:
            continue
        localized_ns.append(round(detection.time_s * 1e9))
        pose = true_poses(np.array(localized_ns[-1:]))[0]
        true_landmark = pose[:2] - [detection.x_m, detection.y_m]
        distance = np.hypot(*(true_landmark - session.floor.position(detection.cell)))
        wrong_cells += bool(distance > session.floor.pitch_m / 2)
    (facts,) = solution.facts.robots.values()
    # The published method reports no probability.
    is_certain = facts.probability is None or facts.probability >= PROVISIONAL_PROBABILITY
    if not solution.trajectories:
        return SessionResult(False, is_certain, wrong_cells, *(np.empty(0),) * 3)
    track = solution.trajectories[0]
    errors = np.column_stack([track.position[:, :2], heading_from_quaternion(track.quaternion)])
    errors -= true_poses(track.time_ns)
    errors[:, 2] = np.angle(np.exp(1j * errors[:, 2]))
    covariance = track.covariance[:, [0, 1, 5]][:, :, [0, 1, 5]]
    nees = np.einsum("ni,ni->n", errors, np.linalg.solve(covariance, errors[..., None])[..., 0])
    if localized_ns:  # a method may also report poses before the first landmark and after the last
        is_between = (track.time_ns >= min(localized_ns) - STAMP_ROUNDING_NS) & (
            track.time_ns <= max(localized_ns) + STAMP_ROUNDING_NS
        )
        errors, nees = errors[is_between], nees[is_between]
    distances = np.hypot(errors[:, 0], errors[:, 1])
    return SessionResult(True, is_certain, wrong_cells, distances, errors[:, 2], nees)


def right_percent(results: Sequence[SessionResult]) -> float:
    """Return the percentage of sessions with poses in the right cells."""
    return 100 * float(np.mean([result.has_poses and not result.is_wrong for result in results]))


def _pose_errors(results: Sequence[SessionResult]) -> tuple[Array, Array, Array]:
    """Return errors [mm, deg] and NEES of all poses in the right cells; one ``nan`` for none."""
    right = [result for result in results if result.has_poses and not result.is_wrong]
    if not right:
        return (np.array([math.nan]),) * 3
    return (
        1e3 * np.concatenate([result.error_m for result in right]),
        np.degrees(np.concatenate([result.heading_rad for result in right])),
        np.concatenate([result.nees for result in right]),
    )


# ---- the closed loop of the published method


def closed_loop_figures(folder: Path) -> list[Figure]:
    """Return the figures of the closed loop; ``folder`` contains the published maps."""
    floor, source = standard_floor(folder)
    return [*approach_figures(floor, source), *closed_loop_solution_figures(floor)]


def approach_figures(floor: FloorMap, source: str) -> Iterator[Figure]:
    """Yield the outcomes of first approaches, as published and with the reading checks."""
    checked = first_approaches(floor, SEARCHING_ROBOTS)
    unchecked = first_approaches(floor, SEARCHING_ROBOTS, check_readings=False)
    how = (
        f"{len(checked)} of {SEARCHING_ROBOTS} robots met a landmark, {source}, nominal errors; "
        "first step, up to four spins, alignment, four voltages, all by sensors and odometry"
    )
    for outcome, label in OUTCOME_LABELS.items():
        without = _percentage(unchecked, outcome)
        yield Figure(f"closed loop: {label}", _percentage(checked, outcome), "%",
                     f"{how}; {without:.1f} % without the check that bars explain the spin's "
                     "field, which is not in the paper",
                     better="higher" if outcome == "centre" else "lower",
                     peer="independent robot, same functions",
                     peer_value=INDEPENDENT_PERCENT[outcome])  # fmt: skip
        how = "of the same approaches"
    reached = 1e3 * np.array(
        [approach.distance_m for approach in checked if approach.outcome == "centre"]
    )
    mean, largest = (reached.mean(), reached.max()) if len(reached) else (math.nan, math.nan)
    yield Figure("closed loop: distance from the centre, mean", float(mean), "mm",
                 f"of those that reach it; largest {largest:.1f}",
                 peer="paper", peer_value=1.0)  # fmt: skip


def first_approaches(floor: FloorMap, robots: int, check_readings: bool = True) -> list[Approach]:
    """Simulate robots that search one landmark; return the first approach of those that met one."""
    approaches: list[Approach] = []
    for seed in range(FIRST_SEED + 800, FIRST_SEED + 800 + robots):
        options = SimulationOptions(
            "published", landmarks=1, rate_hz=SEARCH_SAMPLE_RATE_HZ, seed=seed
        )
        driver = published_driver(floor, options)
        driver.max_approaches = 1
        if not check_readings:
            driver.max_unexplained_fraction = math.inf
        approaches += simulate(floor, options, driver).approaches
    return approaches


def closed_loop_solution_figures(floor: FloorMap) -> Iterator[Figure]:
    """Solve closed-loop sessions by the default method and by the published one."""
    read = 0
    by_field: list[SessionResult] = []
    by_paper: list[SessionResult] = []
    for seed in range(FIRST_SEED + 1000, FIRST_SEED + 1000 + CLOSED_LOOP_SESSIONS):
        options = replace(SimulationOptions("published"), seed=seed)
        session = simulate(floor, options, published_driver(floor, options))
        read += len(session.approaches) > 2 and all(
            approach.outcome == "centre" for approach in session.approaches[-3:]
        )
        for method, results in (("field", by_field), ("paper", by_paper)):
            solution = solve(
                session.samples, floor, SolveOptions(method), odometry=session.odometry
            )
            results.append(score_session(session, solution))
    yield Figure("closed loop: sessions that read an L", 100 * read / CLOSED_LOOP_SESSIONS, "%",
                 f"of {CLOSED_LOOP_SESSIONS} sessions: three landmarks in a row, with at most four "
                 "searches", better="higher")  # fmt: skip
    yield Figure("closed loop sessions: right cells, and poses given", right_percent(by_field), "%",
                 f"default method; {sum(r.is_wrong and r.is_certain for r in by_field)} wrong "
                 "without a remark", better="higher",
                 peer="--method paper, the same sessions",
                 peer_value=right_percent(by_paper))  # fmt: skip


def _percentage(approaches: Sequence[Approach], outcome: str) -> float:
    if not approaches:
        return math.nan
    return 100 * sum(approach.outcome == outcome for approach in approaches) / len(approaches)
