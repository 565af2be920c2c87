"""Figures of passes with a given speed that is wrong or right, and of arrays at rest.

The passes are those of :mod:`.designs`, at a constant speed. At rest, the field changes by a motor
that starts, by a drift of the offsets, or by a piece of iron that moves half a metre away.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from locatk.core.magnetics import dipole_field
from locatk.core.polaris.array import Samples, SensorArray, bar
from locatk.core.polaris.codec import layout_of
from locatk.core.polaris.solver import SolveOptions, solve
from locatk.core.polaris.tag import symbol_angles
from locatk.formats.benchmarks.figures import Figure
from locatk.formats.benchmarks.polaris.designs import (
    DESIGNS,
    EARTH_T,
    NOISE_T,
    OFFSET_T,
    QUANTUM_T,
    RATE_HZ,
    SENSOR_SPACING_M,
    SENSORS,
    SPEED_RANGE_MPS,
    random_tag,
    record_pass,
)
from locatk.formats.benchmarks.timing import FIRST_SEED

Array = NDArray[np.float64]
Random = np.random.Generator

RECORDINGS_PER_KIND = 20
"""Recordings of each kind."""

SPEED_ERRORS = (0.03, 0.4)
"""Smallest and largest relative error of a wrong speed."""

MAX_ANGLE_DEG = 6.0
"""Mean error of the magnets' directions up to which a pass is right: three standard deviations of
five magnets that were set by hand."""

REST_S = 12.0
MOTOR_MOMENT_AM2, MOTOR_DISTANCE_M = 0.05, 0.25
IRON_MOMENT_AM2, IRON_DISTANCE_M = 0.2, 0.5
DRIFT_T = 5e-6
"""Standard deviation of the drift of an axis over a recording."""


def given_speed_figures() -> Iterator[Figure]:
    """Return all figures of given speeds, and of arrays at rest."""
    first = FIRST_SEED + 9900
    named = sum(is_corrected(seed) for seed in range(first, first + RECORDINGS_PER_KIND))
    low, high = (100 * error for error in SPEED_ERRORS)
    yield Figure("wrong speed: corrected and named", 100 * named / RECORDINGS_PER_KIND, "%",
                 f"of {RECORDINGS_PER_KIND} passes, {low:.0f} to {high:.0f} % off",
                 better="higher")  # fmt: skip
    first += 100
    doubted = sum(
        bool(_solve_given(seed, 1.0)[1]) for seed in range(first, first + RECORDINGS_PER_KIND)
    )
    yield Figure("right speed: doubted", doubted, "passes", f"of {RECORDINGS_PER_KIND}", 0.0)
    first += 100
    refused = sum(
        bool(solve([record_rest(seed)], DESIGNS[0], SolveOptions()).detections)
        for seed in range(first, first + RECORDINGS_PER_KIND)
    )
    yield Figure("array at rest: refused passes", refused, "recordings",
                 f"of {RECORDINGS_PER_KIND}: {', '.join(DISTURBANCES)}", 0.0)  # fmt: skip


def is_corrected(seed: int) -> bool:
    """Return whether a wrong speed is named, and the tag is right."""
    rng = np.random.default_rng([seed, 1])
    factor = 1 + rng.choice([-1, 1]) * rng.uniform(*SPEED_ERRORS)
    return _solve_given(seed, float(factor)) == (True, True)


def _solve_given(seed: int, factor: float) -> tuple[bool, bool]:
    """Solve a pass with a factor of its speed; return whether the tag is right, and any doubt."""
    rng = np.random.default_rng(seed)
    tags, speed = DESIGNS[0], float(rng.uniform(*SPEED_RANGE_MPS))
    placed = random_tag(tags, rng)
    samples = record_pass([placed], rng, speed_mps=speed)
    solution = solve([samples], tags, SolveOptions(speed_mps=factor * speed))
    doubted = any(warning.code == "path_contradicted" for warning in solution.warnings)
    if [each.tag_id for each in solution.detections] != [placed.tag_id]:
        return False, doubted
    (tag,) = solution.detections
    layout = layout_of(tags, placed.tag_id)
    expected = symbol_angles(tags, layout.symbols) + placed.pose.heading_rad
    by_cell = {magnet.cell: magnet.angle_rad for magnet in tag.magnets}
    error = np.angle(
        np.mean(np.exp(1j * (np.array([by_cell[c] for c in layout.cells]) - expected)))
    )
    return bool(abs(error) < math.radians(MAX_ANGLE_DEG)), doubted


# ---- at rest


def record_rest(seed: int) -> Samples:
    """Simulate an array at rest, with one of :data:`DISTURBANCES`."""
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, REST_S, 1 / RATE_HZ)
    sensors = bar(SENSORS, SENSOR_SPACING_M)
    field = EARTH_T + rng.uniform(-OFFSET_T, OFFSET_T, (SENSORS, 3)) + np.zeros((len(time), 1, 3))
    disturb = list(DISTURBANCES.values())[seed % len(DISTURBANCES)]
    field = field + disturb(time, sensors, rng) + NOISE_T * rng.normal(size=field.shape)
    array = SensorArray(sensors, noise_t=np.full(3, np.nan), quantum_t=QUANTUM_T)
    field = QUANTUM_T * np.rint(field / QUANTUM_T)
    return Samples("bar", array, np.rint(time * 1e9).astype(np.int64), field)


def _motor(time: Array, sensors: Array, rng: Random) -> Array:
    """Return the field of a motor that starts."""
    place = _direction(rng) * MOTOR_DISTANCE_M
    field = dipole_field(sensors - place, _direction(rng) * MOTOR_MOMENT_AM2)
    start_s = rng.uniform(0.3, 0.7) * REST_S
    current = 1 / (1 + np.exp(-(time - start_s) / 0.05))
    return np.asarray(current[:, None, None] * field)


def _drift(time: Array, sensors: Array, rng: Random) -> Array:
    """Return drifts of all axes."""
    steps = rng.normal(size=(len(time), len(sensors), 3)) / math.sqrt(len(time))
    return np.asarray(DRIFT_T * np.cumsum(steps, axis=0))


def _iron(time: Array, sensors: Array, rng: Random) -> Array:
    """Return the field of a piece of iron that moves past the array."""
    direction = _direction(rng)
    offset = np.cross(direction, _direction(rng))
    place = offset / np.linalg.norm(offset) * IRON_DISTANCE_M
    path = place + direction * np.linspace(-1, 1, len(time))[:, None]
    return np.asarray(dipole_field(sensors - path[:, None], _direction(rng) * IRON_MOMENT_AM2))


def _direction(rng: Random) -> Array:
    vector = rng.normal(size=3)
    return np.asarray(vector / np.linalg.norm(vector))


DISTURBANCES: dict[str, Callable[[Array, Array, Random], Array]] = {
    "a motor starts": _motor,
    "offsets drift": _drift,
    "iron moves": _iron,
}
"""Changes of the field at rest, in turn by seed."""
