"""How fast landmarks are: fields, estimates, sessions, and maps from search to file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from time import process_time

import magpylib
import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import LocatkError
from locatk.core.kernels import kernels
from locatk.core.landmarks import field as bars
from locatk.core.landmarks.design.generation import DesignOptions, design_map
from locatk.core.landmarks.design.proof import prove_map
from locatk.core.landmarks.detection import fit
from locatk.core.landmarks.detection.hypotheses import detect_landmark
from locatk.core.landmarks.landmark import Geometry
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.landmarks.preprocessing import preprocess, segment_visits
from locatk.core.landmarks.simulation.options import SimulationOptions
from locatk.core.landmarks.simulation.session import simulate
from locatk.core.landmarks.solver import solve
from locatk.formats.artifacts.map_library import design_or_crop, entries
from locatk.formats.artifacts.maps import dumps_map, loads_map
from locatk.formats.benchmarks import Figure
from locatk.formats.benchmarks.landmarks.global_localization import PUBLISHED, SIDE, read_published
from locatk.formats.benchmarks.landmarks.study import visited
from locatk.formats.benchmarks.timing import SEED, alone, cpu_seconds, measured

Array = NDArray[np.float64]

KERNEL = "numpy, no compiled kernel" if kernels is None else "compiled kernel"

POINTS = 40_000

ESTIMATES = 60
"""Passes whose estimates are timed."""

MAP_SEEDS = 5

PROTOTYPE = "prototype, annealing in C++"

MAPS = (
    (7, "L", "6", "0.13 to 0.4 s", 0.13),
    (SIDE, "L", "16", "4 to 17 s", 4.0),
    (17, "2x2", "6", "0.1 to 0.4 s", 0.1),
    (100, "2x2", "16", "0.6 s", 0.6),
)
"""Sides of the square maps that are searched for, their windows and alphabets, and the
seconds that a prototype in C++ needed."""


def speed_figures() -> list[Figure]:
    """Fields, estimates and sessions."""
    return [*field_figures(), *estimate_figures(), session_figure()]


# ---- fields


def field_figures() -> list[Figure]:
    """Closed form against magpylib: how fast, and how equal."""
    rows = []
    for name, call, target, how in (
        ("field of four bars, times as fast as magpylib", "field_times()", 20.0,
         f"basis() of {POINTS} points x 4 bars against getB() of 4 cuboids, one run, one thread"),
        ("field and its gradient, times as fast as magpylib's field", "field_times(True)", None,
         "basis_gradient() against the same"),
    ):  # fmt: skip
        try:
            ours, theirs = alone(f"landmarks.speed.{call}")
        except OSError as error:
            rows.append(Figure(name, None, "ratio", f"not measured: {error}", target, "higher"))
            continue
        rows.append(
            Figure(name, theirs / ours, "ratio", f"{how}: {1e3 * ours:.2f} and {1e3 * theirs:.0f} "
                   f"ms; {KERNEL}", target, "higher", "prototype, numpy", 33.0)
        )  # fmt: skip
    rows.append(
        Figure("field of a bar, difference to magpylib", field_difference(), "relative",
               f"largest over {POINTS} points x 4 bars, 3 to 20 mm over the bars and within "
               "60 mm of the centre, in units of the bar's field there (its size)", 1e-12)
    )  # fmt: skip
    return rows


def places() -> tuple[Array, Array]:
    """Points (n, 2) of the floor and heights (n,) over the bars."""
    rng = np.random.default_rng(SEED)
    return rng.uniform(-0.06, 0.06, (POINTS, 2)), rng.uniform(0.003, 0.020, POINTS)


def cuboids(geometry: Geometry) -> list[magpylib.magnet.Cuboid]:
    """The four bars of a landmark, each laid N."""
    found = []
    for k in range(4):
        bar = magpylib.magnet.Cuboid(
            polarization=(0, geometry.remanence_t, 0),
            dimension=(geometry.bar_width_m, geometry.bar_length_m, geometry.bar_height_m),
            position=(geometry.radius_m, 0, -geometry.bar_height_m / 2),
        )
        bar.rotate_from_angax(90.0 * k, "z", anchor=(0, 0, 0))
        found.append(bar)
    return found


def field_difference() -> float:
    """Largest difference between the closed form and magpylib, relative to the field."""
    geometry = Geometry()
    floor, height = places()
    ours = bars.basis(geometry, floor, height)
    theirs = np.asarray(magpylib.getB(cuboids(geometry), np.column_stack([floor, height])))
    size = np.linalg.norm(theirs, axis=-1)
    return float(np.max(np.abs(ours.T - theirs[..., 2]) / size))


def field_times(gradient: bool = False) -> tuple[float, float]:
    """Seconds of the closed form, and of magpylib, for the same points."""
    geometry = Geometry()
    floor, height = places()
    points, sources = np.column_stack([floor, height]), cuboids(geometry)
    call = bars.basis_gradient if gradient else bars.basis
    ours = cpu_seconds(lambda: call(geometry, floor, height), 20)
    return ours, cpu_seconds(lambda: magpylib.getB(sources, points), 5)


# ---- estimates and sessions

SEQUELS = {"": "one pass", "spin": "a pass and a spin", "pass": "two passes"}


def estimate_figures() -> list[Figure]:
    """Time from a recording of one visit in memory to its hypotheses."""
    rows = []
    for then, name in SEQUELS.items():
        promised = 0.05 if then == "" else None
        said = ""
        values: Sequence[float | None] = (None, None)
        try:
            values = alone(f"landmarks.speed.estimate_times({then!r}, {ESTIMATES})")
        except OSError as error:
            said = f"not measured: {error}"
        how = (
            f"{ESTIMATES} recordings of {name}, in memory, to hypotheses with probabilities: "
            f"processor time, one thread; {KERNEL}"
        )
        for label, value in zip(("p50", "p95"), values, strict=True):
            rows.append(
                Figure(f"time an estimate, {name}, {label}", value, "s", said or how, promised,
                       peer="prototype", peer_value=0.7)
            )  # fmt: skip
    return rows


def estimate_times(then: str, count: int) -> tuple[float, float]:
    """Median and 95th percentile of the seconds of an estimate."""
    made = [one for _, one in visited(count, then, SEED + 80)]
    geometry = Geometry()
    seconds = []
    for one in [made[0], *made]:  # the first time is not counted
        start = process_time()
        run = preprocess(one.samples, one.odometry)
        priors = fit.ModelPriors(noise_t=run.noise_t)
        for visit in segment_visits(run, geometry, priors.drift):
            detect_landmark(visit, run, geometry, priors)
        seconds.append(process_time() - start)
    return float(np.median(seconds[1:])), float(np.quantile(seconds[1:], 0.95))


def session_figure() -> Figure:
    """Time to solve a whole session."""
    return measured(
        "time an L session", "s", "landmarks.speed.session_time()", 1.0,
        "solve() of a session of {0:.0f} s with an L of three, in memory: processor time, one "
        "thread, best of 3", None,
    )  # fmt: skip


def session_time() -> tuple[float, float]:
    """Seconds that a session lasts, and that solving it takes."""
    entry = next(e for e in entries() if (e.alphabet, e.window, e.detect) == ("16", "L", 0))
    floor = FloorMap(entry.codes()[:SIDE, :SIDE])
    made = simulate(floor, SimulationOptions(seed=SEED + 90))
    (samples,) = made.samples
    lasts = float(samples.time_ns[-1] - samples.time_ns[0]) * 1e-9
    return lasts, cpu_seconds(lambda: solve(made.samples, floor, odometry=made.odometry), 3)


# ---- maps


def map_figures(folder: Path) -> list[Figure]:
    """Search, proof and reading of maps; ``folder`` has the published ones."""
    rows = []
    for side, window, alphabet, theirs, peer_value in MAPS:
        name = f"map {side}x{side}, {alphabet}/{window}: search"
        call = f"landmarks.speed.search_time({side}, {window!r}, {alphabet!r}, {MAP_SEEDS})"
        how = f"design() and its proof, longest of {MAP_SEEDS} seeds ({{0:.0f}} found), one thread"
        rows.append(
            measured(name, "s", call, 1.0, f"{how}; {KERNEL}; theirs {theirs}", 10.0,
                     peer=PROTOTYPE, peer_value=peer_value)
        )  # fmt: skip
    rows += [
        measured("map 100x100, 16/2x2: proof", "s", "landmarks.speed.proof_time()", 1.0,
                 "prove(), all of it, one thread, best of 3; {0:.0f} duplicates", 1.0,
                 peer="prototype, a dictionary in Python", peer_value=0.23),
        measured("map 100x100: map.toml read", "s", "landmarks.speed.reading_time()", 1.0,
                 "loads_map() of {0:.0f} kB, one thread, best of 3", None),
        largest_square(),
        published_maps(folder),
    ]  # fmt: skip
    return rows


def search_time(side: int, window: str, alphabet: str, seeds: int) -> tuple[float, float]:
    """Seeds of which a proved map was found, and the longest search in seconds of processor
    time; ``inf`` where one failed."""
    found, longest = 0, 0.0
    for seed in range(seeds):
        start = process_time()
        try:
            floor = design_map(DesignOptions(side, side, window, alphabet, seed=seed))
        except LocatkError:
            longest = math.inf
            continue
        found += prove_map(floor, steps=False).is_unique
        longest = max(longest, process_time() - start)
    return float(found), longest if found == seeds else math.inf


def a_large_map() -> FloorMap:
    """100 x 100 landmarks of 16/2x2."""
    return design_or_crop(DesignOptions(100, 100, "2x2", "16"))


def proof_time() -> tuple[float, float]:
    """Duplicates of a map of 100 x 100, and seconds to prove it."""
    floor = a_large_map()
    return float(prove_map(floor).duplicate_count), cpu_seconds(lambda: prove_map(floor), 3)


def reading_time() -> tuple[float, float]:
    """Size of the file of such a map in kB, and seconds to read its text."""
    text = dumps_map(a_large_map())
    return len(text.encode()) / 1e3, cpu_seconds(lambda: loads_map(text), 3)


def largest_square() -> Figure:
    """Compare the largest square of the maps that ship with that of the prototype."""
    sides = {(e.alphabet, e.window): min(e.rows, e.columns) for e in entries() if not e.detect}
    said = ", ".join(
        f"{alphabet}/{window} {side}" for (alphabet, window), side in sorted(sides.items())
    )
    return Figure("16/L: largest square that ships", float(sides["16", "L"]), "landmarks",
                  f"without noticing misread ones; all: {said}", float(SIDE), "higher",
                  PROTOTYPE, float(SIDE))  # fmt: skip


def published_maps(folder: Path) -> Figure:
    """The maps of the data folder, proved again."""
    name = "published maps: readings that repeat another one"
    try:
        floors = [read_published(folder, name) for name in PUBLISHED]
    except (OSError, ValueError) as error:
        return Figure(name, None, "readings", f"not measured: {error}", 0.0)
    repeated = sum(prove_map(floor, steps=False).duplicate_count for floor in floors)
    return Figure(name, float(repeated), "readings",
                  f"of {len(floors)} maps: {', '.join(PUBLISHED)}", 0.0)  # fmt: skip
