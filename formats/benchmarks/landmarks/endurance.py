"""Memory and duration of an hour of driving on the largest supplied map.

Only the cell filter is tested, with the synthetic observations of :mod:`.global_localization`, a
twentieth of the landmarks misread. The drive runs in a process of its own, because the largest
memory of a process never decreases.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from locatk.core.landmarks.detection.trace import OdometryDrift
from locatk.core.landmarks.localization.cell_filter import CellIdentification, identify_cells
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.landmarks.solver import SolveOptions
from locatk.core.trajectory import PROVISIONAL_PROBABILITY
from locatk.formats.artifacts.map_library import library_maps
from locatk.formats.benchmarks.figures import Duration, Figure
from locatk.formats.benchmarks.landmarks.global_localization import (
    random_misreadings,
    random_walk,
    simulate_observations,
)
from locatk.formats.benchmarks.timing import (
    FIRST_SEED,
    peak_memory_mb,
    run_single_threaded,
    time_call,
)

FLOOR_SIDE = 200

DRIVE_LANDMARKS = 3600
"""Visits in an hour at 0.2 m/s and a pitch of 0.2 m, without stops."""

MAX_MEMORY_MB = 300.0

MAX_VISIT_S = 0.05


def endurance_figures() -> list[Figure]:
    """Return memory, duration and errors of the drive."""
    name = "an hour on 200x200"
    how = (
        f"{DRIVE_LANDMARKS} visits of a random walk on the supplied map of 16/3x3, 5 % of the "
        "landmarks misread, nominal odometry; the filter alone"
    )
    memory = Figure(f"{name}: memory", None, "MB", how, MAX_MEMORY_MB)
    duration = Figure(
        f"{name}: time per visit", None, "s", "processor time of one thread, of the same drive",
        MAX_VISIT_S, workload="numpy",
    )  # fmt: skip
    wrong = Figure(
        f"{name}: wrong silently", None, "visits",
        f"a wrong cell or heading at a probability of {PROVISIONAL_PROBABILITY} or more, of the "
        "same drive", 0.0,
    )  # fmt: skip
    correct = Figure(f"{name}: right", None, "%", "cell and heading, of the same", better="higher")
    try:
        before_mb, after_mb, correct_percent, silently_wrong, seconds, factor = run_single_threaded(
            f"landmarks.endurance.measure_drive({DRIVE_LANDMARKS})"
        )
    except OSError as error:
        return [figure.missing(error) for figure in (memory, duration, wrong, correct)]
    how = f"{how}; largest of a process of its own, {before_mb:.0f} MB of it before the filter"
    return [
        replace(memory, value=after_mb, how=how),
        duration.timed(Duration(seconds / DRIVE_LANDMARKS, factor)),
        replace(wrong, value=silently_wrong),
        replace(correct, value=correct_percent),
    ]


def measure_drive(count: int) -> tuple[float, float, float, float, float, float]:
    """Drive over ``count`` landmarks and identify their cells.

    Returns
    -------
    tuple of float
        Largest memory [MB] before and after, correct visits [%], silently wrong visits, duration
        of all visits [s], and the machine factor.
    """
    requirements = ("16", "3x3", FLOOR_SIDE, FLOOR_SIDE, 0)
    entry = next(
        e
        for e in library_maps()
        if (e.alphabet, e.window, e.rows, e.columns, e.detect) == requirements
    )
    floor = FloorMap(entry.codes(), alphabet=entry.alphabet, window=entry.window)
    rng = np.random.default_rng(FIRST_SEED + 100)
    walk = random_walk(floor, (FLOOR_SIDE // 2, FLOOR_SIDE // 2), 0, rng, count)
    observations = simulate_observations(floor, walk, random_misreadings(floor, rng), rng)
    before_mb = peak_memory_mb()
    results: list[CellIdentification] = []

    def identify() -> None:
        misread = SolveOptions().misread
        results.append(identify_cells(observations, floor, misread=misread, drift=OdometryDrift()))

    seconds, factor = time_call(identify, 1)
    after_mb = peak_memory_mb()
    pairs = list(zip(results[0].estimates, walk.stops, strict=True))
    wrong = [each for each, stop in pairs if (each.cell, each.quarters) != stop]
    silently_wrong = sum(each.probability >= PROVISIONAL_PROBABILITY for each in wrong)
    correct_percent = 100 * (1 - len(wrong) / len(pairs))
    return before_mb, after_mb, correct_percent, float(silently_wrong), seconds, factor
