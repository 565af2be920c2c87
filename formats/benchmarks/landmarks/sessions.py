"""Whole sessions on the map of 24 x 24 landmarks, simulated and solved as a user does it.

The floor is that of every bar (magpylib), with nominal errors; landmarks lie 1 mm off along
each axis and half a degree turned, of which the solver knows nothing. Poses are compared
with the truth in the map's frame.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import LocatkError
from locatk.core.geometry import heading_from_quaternion
from locatk.core.landmarks.localization.consistency import CERTAIN_PROBABILITY
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.landmarks.simulation.options import Faults, SimulationOptions
from locatk.core.landmarks.simulation.session import SimulatedSession, simulate
from locatk.core.landmarks.solver import SolveOptions, solve
from locatk.core.solution import Solution
from locatk.formats.benchmarks import Figure
from locatk.formats.benchmarks.landmarks.global_localization import MISREAD, the_floor
from locatk.formats.benchmarks.timing import SEED

Array = NDArray[np.float64]

SESSIONS = 30

SESSION_LANDMARKS = 5
"""Of the sessions with misread landmarks."""


@dataclass(frozen=True)
class Session:
    """What a solved session was worth.

    Attributes
    ----------
    given : bool
        Whether poses on the map are given.
    silent : bool
        Without a remark that the place is not certain.
    wrong : int
        Landmarks that are told to be of another cell.
    error_m : (n,) ndarray
        Of the poses; empty where none are given.
    heading_rad : (n,) ndarray
    nees : (n,) ndarray
        Of x, y and heading.
    """

    given: bool
    silent: bool
    wrong: int
    error_m: Array
    heading_rad: Array
    nees: Array

    @property
    def lost(self) -> bool:
        """Whether the poses, or a landmark's cell, are those of another place."""
        return bool(self.wrong or (len(self.error_m) and np.median(self.error_m) > 0.05))


def session(floor: FloorMap, options: SimulationOptions, method: str = "field") -> Session:
    """Simulate a session, solve it, and compare."""
    made = simulate(floor, options)
    return judged(made, solve(made.samples, floor, SolveOptions(method), odometry=made.odometry))


def judged(made: SimulatedSession, solution: Solution) -> Session:
    """Compare a solution with the truth."""
    truth = made.truth[0]
    start = truth.time_ns[0]
    columns = (*truth.position[:, :2].T, np.unwrap(heading_from_quaternion(truth.quaternion)))

    def true_at(time_ns: NDArray[np.int64]) -> Array:
        at, time = time_ns - start, truth.time_ns - start
        return np.column_stack([np.interp(at, time, column) for column in columns])

    wrong, known_ns = 0, []
    for found in solution.detections:
        if found.cell is None:
            continue
        known_ns.append(round(found.time_s * 1e9))
        here = true_at(np.array(known_ns[-1:]))[0]
        mark = here[:2] - [found.x_m, found.y_m]
        wrong += bool(np.hypot(*(mark - made.floor.position(found.cell))) > made.floor.pitch_m / 2)
    none = np.empty(0)
    (facts,) = solution.facts.robots.values()
    silent = (
        facts.probability is None or facts.probability >= CERTAIN_PROBABILITY
    )  # the paper has none
    if not solution.trajectories:
        return Session(False, silent, wrong, none, none, none)
    track = solution.trajectories[0]
    off = np.column_stack([track.position[:, :2], heading_from_quaternion(track.quaternion)])
    off -= true_at(track.time_ns)
    off[:, 2] = np.angle(np.exp(1j * off[:, 2]))
    covariance = track.covariance[:, [0, 1, 5]][:, :, [0, 1, 5]]
    nees = np.einsum("ni,ni->n", off, np.linalg.solve(covariance, off[..., None])[..., 0])
    if known_ns:  # a method may also tell where the robot was before and after
        slack_ns = 1_000_000  # times of detections are kept in seconds
        inside = (track.time_ns >= min(known_ns) - slack_ns) & (
            track.time_ns <= max(known_ns) + slack_ns
        )
        off, nees = off[inside], nees[inside]
    return Session(True, silent, wrong, np.hypot(off[:, 0], off[:, 1]), off[:, 2], nees)


def session_figures(folder: Path) -> list[Figure]:
    """L sessions, and longer ones on floors with wrong landmarks.

    ``folder`` has the published maps.
    """
    floor, which = the_floor(folder)
    plain = SimulationOptions()
    faulty = replace(plain, faults=Faults(misread_rate=MISREAD), landmarks=SESSION_LANDMARKS)
    clean, clean_failed = _sessions(floor, plain, SEED + 400)
    hard, hard_failed = _sessions(floor, faulty, SEED + 600)
    paper, _ = _sessions(floor, plain, SEED + 400, "paper")
    error, heading, nees = _good(clean)
    error_paper, heading_paper, _ = _good(paper)
    peer = "--method paper, the same sessions"
    how = (
        f"{SESSIONS} simulated sessions of the paper's strategy with an L of three from anywhere, "
        f"{which}, nominal errors; every pose on the way from the first landmark to the last"
    )
    lost = [one for one in hard if one.lost and one.silent]
    return [
        Figure("L sessions: right cells, and poses given", _right(clean), "%",
               how + clean_failed, 100.0, "higher", peer, _right(paper)),
        Figure("L sessions: position, mean", float(error.mean()), "mm",
               "of those that are right; the paper says 1 mm at a landmark",
               peer=peer, peer_value=float(error_paper.mean())),
        Figure("L sessions: position, p95", float(np.quantile(error, 0.95)), "mm", "the same",
               peer=peer, peer_value=float(np.quantile(error_paper, 0.95))),
        Figure("L sessions: heading, rms", float(np.sqrt(np.mean(heading**2))), "deg",
               "the same; the paper says 1.5 degrees at a landmark",
               peer=peer, peer_value=float(np.sqrt(np.mean(heading_paper**2)))),
        Figure("L sessions: NEES", float(nees.mean()), "",
               "squared errors of x, y and heading in units of their covariance, mean",
               peer="consistent", peer_value=3.0),
        Figure("sessions with 5 % misread landmarks: wrong silently", float(len(lost)), "sessions",
               f"of {SESSIONS} with {SESSION_LANDMARKS} landmarks each: a wrong cell, or poses "
               f"elsewhere, at a probability of {CERTAIN_PROBABILITY} or more{hard_failed}", 0.0),
        Figure("sessions with 5 % misread landmarks: right, and poses given", _right(hard), "%",
               "the same", better="higher"),
    ]  # fmt: skip


def _right(sessions: Sequence[Session]) -> float:
    """Share in percent of those with poses, and of the right place."""
    return 100 * float(np.mean([one.given and not one.lost for one in sessions]))


def _good(sessions: Sequence[Session]) -> tuple[Array, Array, Array]:
    """Errors in mm and degrees, and NEES, of all poses of those; one ``nan`` for none."""
    good = [one for one in sessions if one.given and not one.lost]
    if not good:
        return (np.array([math.nan]),) * 3
    return (
        1e3 * np.concatenate([one.error_m for one in good]),
        np.degrees(np.concatenate([one.heading_rad for one in good])),
        np.concatenate([one.nees for one in good]),
    )


def _sessions(
    floor: FloorMap, options: SimulationOptions, seed: int, method: str = "field"
) -> tuple[list[Session], str]:
    """Sessions of seeds from ``seed`` on, and in words those that failed."""
    found, words = [], []
    for k in range(seed, seed + SESSIONS):
        try:
            one = session(floor, replace(options, seed=k), method)
        except LocatkError as error:
            one = Session(False, False, 0, *(np.empty(0),) * 3)
            words.append(f"{k}: {error}")
        else:
            if one.lost:
                words.append(f"{k}: elsewhere, {'silently' if one.silent else 'with a remark'}")
            elif not one.given:
                words.append(f"{k}: no poses")
        found.append(one)
    return found, f"; seeds {', '.join(words)}" if words else ""
