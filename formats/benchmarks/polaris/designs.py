"""Figures of Polaris on passes over tags of another design than the one given.

The passes are not made by the simulator of ``locatk simulate``: discs are cylinders (magpylib) on
a floor with tags of any designs, each built by hand, and the bar passes them on a straight line
with a varying speed. A sample has white noise, an offset for each axis of each sensor, the Earth's
field and the counts of an MLX90393.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.polaris.array import Samples, SensorArray, bar
from locatk.core.polaris.codec import capacity, layout_of
from locatk.core.polaris.simulation.field import Discs, disc_field
from locatk.core.polaris.simulation.floor import to_site_frame
from locatk.core.polaris.solver import SolveOptions, solve
from locatk.core.polaris.tag import Magnet, PlanarPose, Tags, cell_positions, symbol_angles
from locatk.formats.benchmarks.figures import Figure
from locatk.formats.benchmarks.timing import FIRST_SEED

Array = NDArray[np.float64]
Random = np.random.Generator

DESIGNS = tuple(
    Tags(order=order, magnets=magnets, spacing_m=spacing_m)
    for order, magnets, spacing_m in (
        (3, 5, 0.040), (4, 8, 0.040), (4, 10, 0.040), (5, 10, 0.040), (4, 8, 0.030), (5, 10, 0.030),
        (4, 10, 0.0267), (5, 10, 0.020), (3, 5, 0.036), (3, 5, 0.030), (3, 5, 0.020), (4, 8, 0.020),
    )
)  # fmt: skip
"""Designs that are on the floor, or given, or both."""

PASSES = {
    "part of a larger tag": 100,
    "another spacing": 40,
    "the given design": 40,
    "two tags in a pass": 40,
}
"""Number of passes of each kind."""

SENSORS, SENSOR_SPACING_M, RATE_HZ = 9, 0.020, 100.0
NOISE_T, QUANTUM_T = np.array([0.86e-6, 0.89e-6, 1.24e-6]), np.array([0.150e-6, 0.150e-6, 0.242e-6])
"""Standard deviation of a sample and field of a count by axis, of the published recordings."""

OFFSET_T, EARTH_T = 40e-6, np.array([18e-6, 9e-6, -44e-6])
RUN_UP_M, SPEED_RANGE_MPS, SPEED_VARIATION = 0.10, (0.06, 0.25), 0.1

BUILT_POSITION_M, BUILT_ANGLE_RAD, BUILT_STRENGTH = 0.3e-3, math.radians(4.0), 0.04
"""Standard deviations of magnets set by hand: position by axis, direction, relative moment."""


@dataclass(frozen=True)
class PlacedTag:
    """Tag on the floor, with the pose of its middle in the frame of the track."""

    tags: Tags
    tag_id: int
    pose: PlanarPose


def record_pass(
    placed: Sequence[PlacedTag],
    rng: Random,
    *,
    clearance_m: float = 0.010,
    screws: int = 0,
    speed_mps: float | None = None,
) -> Samples:
    """Simulate a bar that drives along x, with its middle at y = 0.

    ``screws`` are placed at random within the tags and up to 60 mm beside them. The speed varies,
    unless one is given.
    """
    position = np.vstack([_built_positions(each, rng) for each in placed])
    start_m, end_m = position[:, 0].min() - RUN_UP_M, position[:, 0].max() + RUN_UP_M
    speed = speed_mps or rng.uniform(*SPEED_RANGE_MPS)
    time = np.arange(0.0, (end_m - start_m) / speed, 1 / RATE_HZ)
    wave_s, phase = rng.uniform(0.2, 0.6), rng.uniform(0, math.tau)
    ripple = np.sin(math.tau * time / wave_s + phase) - math.sin(phase)
    variation = 0.0 if speed_mps else SPEED_VARIATION
    path = start_m + speed * (time + variation * wave_s / math.tau * ripple)
    sensors = bar(SENSORS, SENSOR_SPACING_M)
    points = sensors + [0.0, 0.0, clearance_m] + np.zeros((len(time), 1, 3))
    points[..., 0] += path[:, None]
    field = EARTH_T + rng.uniform(-OFFSET_T, OFFSET_T, (SENSORS, 3)) + np.zeros(points.shape)
    first = 0
    for each in placed:
        layout = layout_of(each.tags, each.tag_id)
        count = len(layout.cells)
        angle = symbol_angles(each.tags, layout.symbols) + each.pose.heading_rad
        discs = Discs(
            each.tags.magnet,
            (each.tag_id,) * count,
            position[first : first + count],
            angle + BUILT_ANGLE_RAD * rng.normal(size=count),
            1 + BUILT_STRENGTH * rng.normal(size=count),
        )
        field += disc_field(discs, points)
        first += count
    for _ in range(screws):
        field += disc_field(_screw(position, rng), points)
    field += NOISE_T * rng.normal(size=field.shape)
    field = QUANTUM_T * np.rint(field / QUANTUM_T)
    array = SensorArray(sensors, noise_t=np.full(3, np.nan), quantum_t=QUANTUM_T)
    return Samples("bar", array, np.rint(time * 1e9).astype(np.int64), field)


def _built_positions(placed: PlacedTag, rng: Random) -> Array:
    """Return the positions (M, 2) of the magnets of a tag as built, in the frame of the track."""
    position = cell_positions(placed.tags, layout_of(placed.tags, placed.tag_id).cells)
    position = position + BUILT_POSITION_M * rng.normal(size=position.shape)
    return to_site_frame(placed.pose, position)


def _screw(position: Array, rng: Random) -> Discs:
    """Return a magnetised piece of steel with a tenth to a third of the moment of a magnet."""
    low, high = position.min(axis=0) - 0.06, position.max(axis=0) + 0.06
    return Discs(
        Magnet(), (-1,), rng.uniform(low, high)[None], rng.uniform(0, math.tau, 1),
        rng.uniform(0.1, 0.33, 1),
    )  # fmt: skip


def random_tag(
    tags: Tags, rng: Random, *, max_lateral_m: float = 0.02, x_m: float = 0.0
) -> PlacedTag:
    """Return a tag with a random id, heading and lateral position."""
    tag_id = int.from_bytes(rng.bytes(16), "little") % capacity(tags)
    lateral = rng.uniform(-max_lateral_m, max_lateral_m)
    return PlacedTag(tags, tag_id, PlanarPose(x_m, lateral, rng.uniform(0, math.tau)))


# ---- figures


def design_figures() -> list[Figure]:
    """Return all figures of passes over tags of other designs, and of several designs."""
    figures = []
    for number, (kind, count) in enumerate(PASSES.items()):
        first_seed = FIRST_SEED + 9000 + 200 * number
        results = [pass_result(kind, first_seed + k) for k in range(count)]
        wrong = sum(bool(read - present) for read, present, _ in results)
        reasons = Counter(reason for *_, refused in results for reason in set(refused))
        how = f"{count} passes, random ids, headings and heights of 8 to 15 mm; refused: " + (
            ", ".join(f"{times} {reason}" for reason, times in reasons.most_common()) or "none"
        )
        figures.append(Figure(f"{kind}: wrong ids", wrong, "passes", how, 0.0))
        if results[0][1]:
            read = sum(present <= read for read, present, _ in results)
            figures.append(
                Figure(f"{kind}: all read", 100 * read / count, "%", how, better="higher")
            )
    return figures


def pass_result(kind: str, seed: int) -> tuple[set[int], set[int], list[str]]:
    """Simulate and solve a pass; return the ids read, those of the given design, and reasons."""
    rng = np.random.default_rng(seed)
    clearance_m = rng.uniform(0.008, 0.015)
    given = DESIGNS[int(rng.integers(len(DESIGNS)))]
    if kind == "part of a larger tag":
        given = DESIGNS[0]
        placed = [random_tag(DESIGNS[1 + seed % 3], rng, max_lateral_m=0.06)]
        # Most headings at which a grid of five cells fits under the bar are quarter turns.
        if seed % 2:
            heading = math.pi / 2 * rng.integers(4) + 0.05 * rng.normal()
            placed = [replace(placed[0], pose=replace(placed[0].pose, heading_rad=heading))]
    elif kind == "another spacing":
        factor = 1 + rng.choice([-1, 1]) * rng.uniform(0.05, 0.12)
        other = replace(given, spacing_m=given.spacing_m * factor)
        placed = [random_tag(other, rng)]
    elif kind == "two tags in a pass":
        first = random_tag(given, rng, max_lateral_m=0.01)
        width_m = math.sqrt(2) * (given.order - 1) * given.spacing_m
        second = random_tag(given, rng, max_lateral_m=0.01, x_m=width_m + rng.uniform(0.06, 0.12))
        placed = [first, second]
    else:
        placed = [random_tag(given, rng)]
    samples = record_pass(placed, rng, clearance_m=clearance_m, screws=seed % 3)
    detections = solve([samples], given, SolveOptions()).detections
    return (
        {each.tag_id for each in detections if each.tag_id is not None},
        {each.tag_id for each in placed if each.tags is given},
        [each.refused for each in detections if each.refused],
    )
