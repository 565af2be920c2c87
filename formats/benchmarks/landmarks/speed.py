"""Figures of speed of the landmarks: fields, estimates, sessions, and maps."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from time import process_time

import magpylib
import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import LocatkError
from locatk.core.kernels import kernels
from locatk.core.landmarks import field as bar_field
from locatk.core.landmarks.design.generation import DesignOptions, design_map
from locatk.core.landmarks.design.proof import prove_map
from locatk.core.landmarks.detection.fit import ModelPriors
from locatk.core.landmarks.detection.hypotheses import detect_landmark
from locatk.core.landmarks.landmark import Geometry
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.landmarks.preprocessing import preprocess, segment_visits
from locatk.core.landmarks.simulation.options import SimulationOptions
from locatk.core.landmarks.simulation.passes import SinglePass
from locatk.core.landmarks.simulation.session import simulate
from locatk.core.landmarks.solver import solve
from locatk.formats.artifacts.map_library import design_or_crop, library_maps
from locatk.formats.artifacts.maps import dumps_map, loads_map
from locatk.formats.benchmarks.figures import Duration, Figure
from locatk.formats.benchmarks.landmarks.global_localization import (
    MAP_SIDE,
    PUBLISHED_SIDES,
    read_published,
    supplied_floor,
)
from locatk.formats.benchmarks.landmarks.visits import simulate_visits
from locatk.formats.benchmarks.timing import (
    FIRST_SEED,
    machine_factor,
    measure_single_threaded,
    run_single_threaded,
    time_call,
    time_each,
)

Array = NDArray[np.float64]

KERNEL = "numpy, no compiled kernel" if kernels is None else "compiled kernel"

FIELD_POINTS = 40_000

TIMED_ESTIMATES = 60

MAP_SEEDS = 5

PROTOTYPE = "prototype, annealing in C++"

SEARCHED_MAPS = (
    (7, "L", "6", "0.13 to 0.4 s", 0.13),
    (MAP_SIDE, "L", "16", "4 to 17 s", 4.0),
    (17, "2x2", "6", "0.1 to 0.4 s", 0.1),
    (100, "2x2", "16", "0.6 s", 0.6),
)
"""Sides of the square maps that are searched for, their windows and alphabets, and the durations
of a prototype in C++."""


def speed_figures() -> list[Figure]:
    """Return the figures of fields, estimates and sessions."""
    session = Figure(
        "time an L session", None, "s",
        "solve() of a session of {0:.0f} s with an L of three, in memory: processor time, one "
        "thread, best of 3", workload="numpy",
    )  # fmt: skip
    return [
        *field_figures(),
        *estimate_figures(),
        measure_single_threaded(session, "landmarks.speed.time_session()"),
    ]


# ---- fields


def field_figures() -> list[Figure]:
    """Compare duration and values of the closed form with those of magpylib, in the same run."""
    rows = []
    for name, call, target, how in (
        ("field of four bars, times as fast as magpylib", "time_fields()", 20.0,
         f"basis() of {FIELD_POINTS} points x 4 bars against getB() of 4 cuboids, one run, one "
         "thread"),
        ("field and its gradient, times as fast as magpylib's field", "time_fields(True)", None,
         "basis_gradient() against the same"),
    ):  # fmt: skip
        figure = Figure(name, None, "ratio", how, target, "higher", "prototype, numpy", 33.0)
        try:
            ours_s, magpylib_s = run_single_threaded(f"landmarks.speed.{call}")
        except OSError as error:
            rows.append(figure.missing(error))
            continue
        how = f"{how}: {1e3 * ours_s:.2f} and {1e3 * magpylib_s:.0f} ms; {KERNEL}"
        rows.append(replace(figure, value=magpylib_s / ours_s, how=how))
    difference = Figure(
        "field of a bar, difference to magpylib", largest_field_difference(), "relative",
        f"largest over {FIELD_POINTS} points x 4 bars, 3 to 20 mm over the bars and within "
        "60 mm of the centre, relative to the magnitude of the bar's field", 1e-12,
    )  # fmt: skip
    return [*rows, difference]


def random_points() -> tuple[Array, Array]:
    """Return points (n, 2) of the floor and heights (n,) over the bars, in metres."""
    rng = np.random.default_rng(FIRST_SEED)
    return (
        rng.uniform(-0.06, 0.06, (FIELD_POINTS, 2)),
        rng.uniform(0.003, 0.020, FIELD_POINTS),
    )


def cuboids(geometry: Geometry) -> list[magpylib.magnet.Cuboid]:
    """Return the four bars of a landmark, each in the orientation N."""
    bars = []
    for k in range(4):
        bar = magpylib.magnet.Cuboid(
            polarization=(0, geometry.remanence_t, 0),
            dimension=(geometry.bar_width_m, geometry.bar_length_m, geometry.bar_height_m),
            position=(geometry.radius_m, 0, -geometry.bar_height_m / 2),
        )
        bar.rotate_from_angax(90.0 * k, "z", anchor=(0, 0, 0))
        bars.append(bar)
    return bars


def largest_field_difference() -> float:
    """Return the largest difference between the closed form and magpylib, relative to the field."""
    geometry = Geometry()
    points, height = random_points()
    ours = bar_field.basis(geometry, points, height)
    by_magpylib = np.asarray(magpylib.getB(cuboids(geometry), np.column_stack([points, height])))
    magnitude = np.linalg.norm(by_magpylib, axis=-1)
    return float(np.max(np.abs(ours.T - by_magpylib[..., 2]) / magnitude))


def time_fields(gradient: bool = False) -> tuple[float, float]:
    """Return the durations [s] of the closed form and of magpylib for the same points."""
    geometry = Geometry()
    points, height = random_points()
    points_3d, sources = np.column_stack([points, height]), cuboids(geometry)
    closed_form = bar_field.basis_gradient if gradient else bar_field.basis
    ours = time_call(lambda: closed_form(geometry, points, height), 20)
    return ours.seconds, time_call(lambda: magpylib.getB(sources, points_3d), 5).seconds


# ---- estimates and sessions


def estimate_figures() -> Iterator[Figure]:
    """Time the step from a recording of one visit in memory to its hypotheses."""
    for then, name, target in (
        ("", "one pass", 0.05),
        ("spin", "a pass and a spin", None),
        ("pass", "two passes", None),
    ):
        how = (
            f"{TIMED_ESTIMATES} recordings of {name}, in memory, to hypotheses with "
            f"probabilities: processor time, one thread; {KERNEL}"
        )
        declared = [
            Figure(f"time an estimate, {name}, {percentile}", None, "s", how, target,
                   peer="prototype", peer_value=0.7, workload="numpy")
            for percentile in ("p50", "p95")
        ]  # fmt: skip
        try:
            *seconds, factor = run_single_threaded(
                f"landmarks.speed.time_estimates({then!r}, {TIMED_ESTIMATES})"
            )
        except OSError as error:
            yield from (figure.missing(error) for figure in declared)
        else:
            for figure, duration_s in zip(declared, seconds, strict=True):
                yield figure.timed(Duration(duration_s, factor))


def time_estimates(then: str, count: int) -> tuple[float, float, float]:
    """Return the median and the 95th percentile [s] of an estimate, and the machine factor."""
    visits = [visit for _, visit in simulate_visits(count, then, FIRST_SEED + 80)]
    geometry = Geometry()

    def estimate(visit: SinglePass) -> None:
        recording = preprocess(visit.samples, visit.odometry)
        priors = ModelPriors(noise_t=recording.noise_t)
        for segment in segment_visits(recording, geometry, priors.drift):
            detect_landmark(segment, recording, geometry, priors)

    estimate(visits[0])  # the first call is not counted
    seconds, factor = time_each([partial(estimate, visit) for visit in visits])
    return float(np.median(seconds)), float(np.quantile(seconds, 0.95)), factor


def time_session() -> tuple[float, float, float]:
    """Return the length of a session [s], and the duration of its solution."""
    floor, _ = supplied_floor()
    session = simulate(floor, SimulationOptions(seed=FIRST_SEED + 90))
    (samples,) = session.samples
    length_s = float(samples.time_ns[-1] - samples.time_ns[0]) * 1e-9
    duration = time_call(lambda: solve(session.samples, floor, odometry=session.odometry), 3)
    return length_s, *duration


# ---- maps


def map_figures(folder: Path) -> list[Figure]:
    """Time search, proof and reading of maps; ``folder`` contains the published ones."""
    rows = []
    for side, window, alphabet, prototype, peer_value in SEARCHED_MAPS:
        search = Figure(
            f"map {side}x{side}, {alphabet}/{window}: search", None, "s",
            f"design_map() and its proof, longest of {MAP_SEEDS} seeds ({{0:.0f}} successful), "
            f"processor time of one thread; {KERNEL}; the prototype {prototype}", 10.0,
            peer=PROTOTYPE, peer_value=peer_value, workload="numpy",
        )  # fmt: skip
        call = f"landmarks.speed.time_search({side}, {window!r}, {alphabet!r}, {MAP_SEEDS})"
        rows.append(measure_single_threaded(search, call))
    proof = Figure(
        "map 100x100, 16/2x2: proof", None, "s",
        "prove_map(), processor time of one thread, best of 3; {0:.0f} duplicates", 1.0,
        peer="prototype, a dictionary in Python", peer_value=0.23, workload="numpy",
    )  # fmt: skip
    reading = Figure(
        "map 100x100: map.toml read", None, "s",
        "loads_map() of {0:.0f} kB, processor time of one thread, best of 3", workload="Python",
    )  # fmt: skip
    return [
        *rows,
        measure_single_threaded(proof, "landmarks.speed.time_proof()"),
        measure_single_threaded(reading, "landmarks.speed.time_map_reading()"),
        largest_square(),
        published_maps(folder),
    ]


def time_search(side: int, window: str, alphabet: str, seeds: int) -> tuple[float, float, float]:
    """Return the number of proved maps, the longest search [s], and the machine factor.

    The duration is ``inf`` if a search failed.
    """
    proved, longest_s, factors = 0, 0.0, []
    for seed in range(seeds):
        factors.append(machine_factor("numpy"))
        start = process_time()
        try:
            floor = design_map(DesignOptions(side, side, window, alphabet, seed=seed))
        except LocatkError:
            continue
        proved += prove_map(floor, steps=False).is_unique
        longest_s = max(longest_s, process_time() - start)
    return float(proved), longest_s if proved == seeds else math.inf, float(np.median(factors))


def _large_map() -> FloorMap:
    """Return a map of 100 x 100 landmarks of 16/2x2."""
    return design_or_crop(DesignOptions(100, 100, "2x2", "16"))


def time_proof() -> tuple[float, float, float]:
    """Return the number of duplicates of a map of 100 x 100, and the duration of its proof."""
    floor = _large_map()
    duration = time_call(lambda: prove_map(floor), 3)
    return float(prove_map(floor).duplicate_count), *duration


def time_map_reading() -> tuple[float, float, float]:
    """Return the size of the text of a map of 100 x 100 [kB], and the duration of reading it."""
    text = dumps_map(_large_map())
    return len(text.encode()) / 1e3, *time_call(lambda: loads_map(text), 3, "Python")


def largest_square() -> Figure:
    """Compare the largest square of the supplied maps with that of the prototype."""
    sides = {(e.alphabet, e.window): min(e.rows, e.columns) for e in library_maps() if not e.detect}
    listed = ", ".join(
        f"{alphabet}/{window} {side}" for (alphabet, window), side in sorted(sides.items())
    )
    return Figure("16/L: largest square that ships", float(sides["16", "L"]), "landmarks",
                  f"without detection of misread landmarks; all: {listed}", float(MAP_SIDE),
                  "higher", PROTOTYPE, float(MAP_SIDE))  # fmt: skip


def published_maps(folder: Path) -> Figure:
    """Prove the maps of the data folder again."""
    maps = ", ".join(PUBLISHED_SIDES)
    figure = Figure("published maps: readings that repeat another one", None, "readings",
                    f"of {len(PUBLISHED_SIDES)} maps: {maps}", 0.0)  # fmt: skip
    try:
        floors = [read_published(folder, name) for name in PUBLISHED_SIDES]
    except (OSError, ValueError) as error:
        return figure.missing(error)
    repeated = sum(prove_map(floor, steps=False).duplicate_count for floor in floors)
    return replace(figure, value=float(repeated))
