"""Robots that drive by the published method's own estimates, and solutions of their sessions.

Each robot searches a landmark from anywhere on the map of 24 x 24 landmarks
(``simulate landmarks --strategy published``): the simulator has nominal errors, the driver knows
sensors and odometry only.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.landmarks.published.driver import published_driver
from locatk.core.landmarks.simulation.closed_loop import Approach
from locatk.core.landmarks.simulation.options import SimulationOptions
from locatk.core.landmarks.simulation.session import simulate
from locatk.core.landmarks.solver import SolveOptions, solve
from locatk.formats.benchmarks import Figure
from locatk.formats.benchmarks.landmarks.global_localization import the_floor
from locatk.formats.benchmarks.landmarks.sessions import Session, judged
from locatk.formats.benchmarks.timing import SEED

ROBOTS = 150
"""Robots that search one landmark each."""

DRIVEN_SESSIONS = 30
"""Sessions with the landmarks of the map's window."""

SAMPLE_RATE_HZ = 100.0
"""Samples of the robots that search one landmark; half of the default saves time."""

INDEPENDENT = {"centre": 71.0, "no_pattern": 21.0, "wrong_pattern": 7.5}
"""Percentages of 916 approaches, measured by another party with the functions of
:mod:`locatk.core.landmarks.published` and its own robot."""

LABELS = {
    "centre": "approaches that end at the centre",
    "no_pattern": "no pattern after four spins",
    "wrong_pattern": "wrong pattern",
}

PEER = "independent robot, same functions"


def closed_loop_figures(folder: Path) -> list[Figure]:
    """Return the figures of the closed loop; ``folder`` has the published maps."""
    floor, which = the_floor(folder)
    return [*approach_figures(floor, which), *solution_figures(floor)]


def approach_figures(floor: FloorMap, which: str) -> Iterator[Figure]:
    """Yield the outcomes of first approaches, as published and with the reading checks."""
    checked = first_approaches(floor, ROBOTS)
    unchecked = first_approaches(floor, ROBOTS, check_readings=False)
    how = (
        f"{len(checked)} of {ROBOTS} robots met a landmark, {which}, nominal errors; first step, "
        "up to four spins, alignment, four voltages, all by sensors and odometry"
    )
    for outcome, label in LABELS.items():
        without = _percentage(unchecked, outcome)
        yield Figure(f"closed loop: {label}", _percentage(checked, outcome), "%",
                     f"{how}; {without:.1f} % without the check that bars explain the spin's "
                     "field, which is not in the paper",
                     better="higher" if outcome == "centre" else "lower",
                     peer=PEER, peer_value=INDEPENDENT[outcome])  # fmt: skip
        how = "the same"
    reached = 1e3 * np.array([one.distance_m for one in checked if one.outcome == "centre"])
    mean, largest = (reached.mean(), reached.max()) if len(reached) else (math.nan, math.nan)
    yield Figure("closed loop: distance from the centre, mean", float(mean), "mm",
                 f"of those that reach it; largest {largest:.1f}",
                 peer="paper", peer_value=1.0)  # fmt: skip


def first_approaches(floor: FloorMap, robots: int, check_readings: bool = True) -> list[Approach]:
    """Simulate robots that search one landmark; return the first approach of those that met one."""
    approaches: list[Approach] = []
    for seed in range(SEED + 800, SEED + 800 + robots):
        options = SimulationOptions("published", landmarks=1, rate_hz=SAMPLE_RATE_HZ, seed=seed)
        driver = published_driver(floor, options)
        driver.max_approaches = 1
        if not check_readings:
            driver.max_unexplained_fraction = math.inf
        approaches += simulate(floor, options, driver).approaches
    return approaches


def solution_figures(floor: FloorMap) -> Iterator[Figure]:
    """Yield what the default method and the published one make of closed-loop sessions."""
    read = 0
    by_field: list[Session] = []
    by_paper: list[Session] = []
    for seed in range(SEED + 1000, SEED + 1000 + DRIVEN_SESSIONS):
        options = replace(SimulationOptions("published"), seed=seed)
        session = simulate(floor, options, published_driver(floor, options))
        read += len(session.approaches) > 2 and all(
            one.outcome == "centre" for one in session.approaches[-3:]
        )
        for method, results in (("field", by_field), ("paper", by_paper)):
            solution = solve(
                session.samples, floor, SolveOptions(method), odometry=session.odometry
            )
            results.append(judged(session, solution))
    yield Figure("closed loop: sessions that read an L", 100 * read / DRIVEN_SESSIONS, "%",
                 f"of {DRIVEN_SESSIONS} sessions: three landmarks in a row, with at most four "
                 "searches", better="higher")  # fmt: skip
    yield Figure("closed loop sessions: right cells, and poses given", _right(by_field), "%",
                 f"default method; {sum(one.lost and one.silent for one in by_field)} wrong "
                 "without a remark", better="higher",
                 peer="--method paper, the same sessions", peer_value=_right(by_paper))  # fmt: skip


def _percentage(approaches: Sequence[Approach], outcome: str) -> float:
    if not approaches:
        return math.nan
    return 100 * sum(one.outcome == outcome for one in approaches) / len(approaches)


def _right(sessions: Sequence[Session]) -> float:
    """Return the percentage of sessions with poses in the right cells."""
    return 100 * float(np.mean([one.given and not one.lost for one in sessions]))
