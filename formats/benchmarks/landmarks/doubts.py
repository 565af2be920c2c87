"""Figures of drives that must be doubted, and of nominal ones that must not.

Robots drive over another floor than that of the map, or their sensors are wired in another way than
stated. Nominal drives have the errors of :mod:`.sessions` and no fault: whatever is accused there
is accused wrongly.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.landmarks.halls import HallSamples
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.landmarks.solver import solve
from locatk.core.solution import Solution
from locatk.core.trajectory import PROVISIONAL_PROBABILITY, Trajectory
from locatk.formats.benchmarks.figures import Figure
from locatk.formats.benchmarks.landmarks.faults import drive_over, random_cells
from locatk.formats.benchmarks.landmarks.global_localization import standard_floor
from locatk.formats.benchmarks.timing import FIRST_SEED

Array = NDArray[np.float64]

DRIVES_PER_KIND = 10
"""Drives of each kind."""

ACCUSATIONS = {
    "sensor_gain",
    "sensor_scale",
    "sensor_left_out",
    "landmark_displaced",
    "wheel_slip",
    "robot_carried",
    "odometry_lag",
    "odometry_scale",
    "odometry_contradicted",
}
"""Warnings that name a fault."""


def doubt_figures(folder: Path) -> Iterator[Figure]:
    """Score drives over wrong floors, with wrong sensors, and without a fault."""
    floor, source = standard_floor(folder)
    yield from floor_figures(floor, source)
    yield from sensor_figures(floor, source)
    yield from nominal_figures(floor, source)


def floor_figures(floor: FloorMap, source: str) -> Iterator[Figure]:
    """Drive over 11 landmarks of another floor."""
    for number, (name, other_floor) in enumerate(OTHER_FLOORS.items()):
        first = FIRST_SEED + 3000 + 100 * number
        probabilities = []
        for seed in range(first, first + DRIVES_PER_KIND):
            other = other_floor(floor, seed)
            session = drive_over(other, seed, random_cells(floor, seed))
            solution = solve(session.samples, floor, odometry=session.odometry)
            probabilities.append(_probability(solution))
        believed = sum(one >= PROVISIONAL_PROBABILITY for one in probabilities)
        yield Figure(f"{name}: believed", float(believed), "drives",
                     f"of {DRIVES_PER_KIND} over 11 landmarks, {source}: poses with a "
                     f"probability of {PROVISIONAL_PROBABILITY} or more; largest "
                     f"{max(probabilities):.2g}", 0.0)  # fmt: skip


def _probability(solution: Solution) -> float:
    """Return the probability of the poses; 0 without poses."""
    if not solution.trajectories:
        return 0.0
    (facts,) = solution.facts.robots.values()
    return float(facts.probability)


def sensor_figures(floor: FloorMap, source: str) -> Iterator[Figure]:
    """Change the wiring of the sensors."""
    for number, (name, (change, words)) in enumerate(WIRINGS.items()):
        first = FIRST_SEED + 3400 + 100 * number
        named = 0
        for seed in range(first, first + DRIVES_PER_KIND):
            session = drive_over(floor, seed, random_cells(floor, seed)[:3])
            samples = session.samples[0]
            samples = replace(samples, field_t=change(samples.field_t, seed))
            named += words in _verdict([samples], floor, session.odometry)
        yield Figure(f"{name}: named", 100 * named / DRIVES_PER_KIND, "%",
                     f"of {DRIVES_PER_KIND} drives over 8 landmarks, {source}",
                     better="higher")  # fmt: skip


def _verdict(
    samples: Sequence[HallSamples], floor: FloorMap, odometry: Sequence[Trajectory]
) -> str:
    """Return all warnings, or the error, of a solution."""
    try:
        solution = solve(samples, floor, odometry=odometry)
    except InputError as error:
        return str(error)
    return " ".join(warning.message for warning in solution.warnings)


def nominal_figures(floor: FloorMap, source: str) -> Iterator[Figure]:
    """Count what is accused wrongly, and the drives whose poses are certain."""
    accused, certain = [], 0
    first = FIRST_SEED + 3900
    for seed in range(first, first + 2 * DRIVES_PER_KIND):
        session = drive_over(floor, seed, random_cells(floor, seed))
        solution = solve(session.samples, floor, odometry=session.odometry)
        accused += [warning.code for warning in solution.warnings if warning.code in ACCUSATIONS]
        accused += [one.refused for one in solution.detections if one.refused == "misread"]
        certain += _probability(solution) >= PROVISIONAL_PROBABILITY
    how = f"of {2 * DRIVES_PER_KIND} drives over 11 landmarks without a fault, {source}"
    yield Figure("drives without a fault: accusations", float(len(accused)), "",
                 f"{how}; {', '.join(accused) or 'none'}")  # fmt: skip
    yield Figure("drives without a fault: certain", 100 * certain / (2 * DRIVES_PER_KIND), "%",
                 how, better="higher")  # fmt: skip


# ---- kinds


def _shuffled(floor: FloorMap, seed: int) -> FloorMap:
    codes = floor.codes.ravel()
    return replace(floor, codes=np.random.default_rng(seed).permutation(codes).reshape(floor.shape))


OTHER_FLOORS: dict[str, Callable[[FloorMap, int], FloorMap]] = {
    "floor with the same landmarks in another order": _shuffled,
    "floor with mirrored rows": lambda floor, _: replace(floor, codes=floor.codes[:, ::-1].copy()),
    "floor with exchanged rows and columns": lambda floor, _: replace(
        floor, codes=floor.codes.T.copy()
    ),
}
"""Floors by name, in the order of their seeds."""


def _inverted(field_t: Array, seed: int) -> Array:
    return field_t * np.where(np.arange(field_t.shape[1]) == seed % field_t.shape[1], -1.0, 1.0)


def _exchanged(field_t: Array, seed: int) -> Array:
    order = np.arange(field_t.shape[1])
    first, second = seed % len(order), (seed + 1) % len(order)
    order[[first, second]] = order[[second, first]]
    return field_t[:, order]


WIRINGS: dict[str, tuple[Callable[[Array, int], Array], str]] = {
    "readings halved": (lambda field_t, _: 0.5 * field_t, "fields are about"),
    "readings times 1.7": (lambda field_t, _: 1.7 * field_t, "fields are about"),
    "a sensor of the opposite sign": (_inverted, "opposite sign"),
    "two exchanged sensors": (_exchanged, "wrong order"),
}
"""Changes of the readings by name, with the words that name them."""
