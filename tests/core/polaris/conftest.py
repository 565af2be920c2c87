"""A small world of tags that shares nothing with the solver.

Its magnets are magpylib's cylinders, put on the floor by the words of the paper (columns to
the right of v1, rows ahead of it, orientations clockwise); its bar drives on the floor and
turns what it measures into its own axes. Nothing of ``core.polaris`` is used but the
records in which the solver takes its samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import magpylib
import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from locatk.core.polaris.array import Samples, SensorArray

Array = NDArray[np.float64]

START_NS = 1_700_000_000_000_000_000

EARTH_T = (21e-6, -3e-6, -43e-6)
"""On the floor, in its axes."""


@dataclass(frozen=True)
class Tag:
    """A tag on the floor.

    ``cells`` (column to the right, row ahead) and ``symbols`` as the paper has them;
    ``x``, ``y`` and ``heading`` (counter-clockwise) place the middle of the grid on the
    floor. ``strength`` (M,) are shares of the magnet's remanence, 0 for one that is
    missing; ``moved`` (M, 2) and ``turned`` (M,) how a hand has misplaced them (metres
    ahead and to the left, radians counter-clockwise); ``tilted`` (M,) by how many radians
    they are magnetised upward.
    """

    cells: tuple[tuple[int, int], ...]
    symbols: tuple[int, ...]
    x: float = 0.0
    y: float = 0.0
    heading: float = 0.0
    order: int = 3
    orientations: int = 8
    spacing: float = 0.04
    diameter: float = 2e-3
    height: float = 0.5e-3
    remanence: float = 1.45
    strength: tuple[float, ...] = ()
    moved: Array | None = None
    turned: Array | None = None
    tilted: Array | None = None

    @property
    def places(self) -> Array:
        """Of the magnets (M, 2) on the floor."""
        ahead = np.array([np.cos(self.heading), np.sin(self.heading)])
        right = np.array([np.sin(self.heading), -np.cos(self.heading)])
        half = (self.order - 1) / 2
        moved = np.zeros((len(self.cells), 2)) if self.moved is None else self.moved
        return np.array(
            [
                np.array([self.x, self.y])
                + ahead * ((row - half) * self.spacing + shift[0])
                + right * ((column - half) * self.spacing - shift[1])
                for (column, row), shift in zip(self.cells, moved, strict=True)
            ]
        )

    @property
    def angles(self) -> Array:
        """Of the moments (M,) on the floor, counter-clockwise from its x."""
        clockwise = 2 * np.pi / self.orientations * np.array(self.symbols)
        turned = 0.0 if self.turned is None else self.turned
        return np.asarray(self.heading - clockwise + turned)

    def sources(self) -> list[magpylib.magnet.Cylinder]:
        strength = self.strength or (1.0,) * len(self.cells)
        tilted = np.zeros(len(self.cells)) if self.tilted is None else self.tilted
        return [
            magpylib.magnet.Cylinder(
                polarization=self.remanence * share * np.array([np.cos(up), 0, np.sin(up)]),
                dimension=(self.diameter, self.height),
                position=(*place, 0),
                orientation=Rotation.from_euler("z", angle),
            )
            for place, angle, share, up in zip(
                self.places, self.angles, strength, tilted, strict=True
            )
            if share
        ]


@dataclass(frozen=True)
class Course:
    """Where the bar is: (k,) seconds, its middle on the floor, and where it looks."""

    t: Array
    x: Array
    y: Array
    heading: Array

    def at(self, t: Array) -> tuple[Array, Array, Array]:
        return (
            np.interp(t, self.t, self.x),
            np.interp(t, self.t, self.y),
            np.interp(t, self.t, self.heading),
        )


def line(
    *,
    direction: float = 0.0,
    lateral: float = 0.0,
    length: float = 0.32,
    speed: float = 0.1,
    past: tuple[float, float] = (0.0, 0.0),
    crab: float = 0.0,
) -> Course:
    """Straight, ``lateral`` metres to the left of the place ``past``, which is halfway.

    The bar looks along ``direction``; its way is turned from there by ``crab``.
    """
    t = np.array([0.0, length / speed])
    s = np.array([-length / 2, length / 2])
    way = direction + crab
    x = past[0] + s * np.cos(way) - lateral * np.sin(way)
    y = past[1] + s * np.sin(way) + lateral * np.cos(way)
    return Course(t, x, y, np.full(2, direction))


def driven(course: Course, t: ArrayLike, share: ArrayLike) -> Course:
    """The same way under another timetable: at ``t`` its share of the way is done."""
    t, share = np.asarray(t, float), np.asarray(share, float)
    old = (course.t - course.t[0]) / (course.t[-1] - course.t[0])
    x, y, heading = (np.interp(share, old, v) for v in (course.x, course.y, course.heading))
    return Course(t, x, y, heading)


def bar(
    count: int = 9,
    spacing: float = 0.02,
    *,
    noise: float = 0.5e-6,
    delay: Sequence[float] = (0.0, 0.0, 0.0),
) -> SensorArray:
    """Sensors from right to left, x ahead."""
    position = np.zeros((count, 3))
    position[:, 1] = spacing * (np.arange(count) - (count - 1) / 2)
    return SensorArray(position, np.full(3, noise), delay_s=np.array(delay, float))


@dataclass(frozen=True)
class Debris:
    """Iron on the floor: a ball that the Earth's field makes a dipole."""

    x: float
    y: float
    radius: float = 2e-3

    def source(self) -> magpylib.misc.Dipole:
        moment = 4 * np.pi * self.radius**3 * np.array(EARTH_T) / (4e-7 * np.pi)
        return magpylib.misc.Dipole(moment=moment, position=(self.x, self.y, 0))


def record(
    tags: Sequence[Tag | Debris],
    course: Course,
    *,
    array: SensorArray | None = None,
    clearance: float = 0.01,
    rate: float = 100.0,
    noise: float = 0.5e-6,
    offsets: float = 30e-6,
    earth: Sequence[float] = EARTH_T,
    seed: int = 0,
    device: str = "bar",
) -> Samples:
    """What the bar measures on its way over the tags, ``clearance`` above the magnets.

    ``noise`` is added to each sample, a constant of the size of ``offsets`` to each sensor
    and axis.
    """
    array = array or bar(noise=noise)
    rng = np.random.default_rng(seed)
    t = np.arange(course.t[0], course.t[-1], 1 / rate)
    sources: list[object] = []
    for tag in tags:
        sources += tag.sources() if isinstance(tag, Tag) else [tag.source()]
    measured = np.zeros((len(t), len(array), 3))
    for delay in np.unique(array.delay_s):
        x, y, heading = course.at(t + delay)
        cos, sin = np.cos(heading)[:, None], np.sin(heading)[:, None]
        ahead, left = array.position_m[:, 0], array.position_m[:, 1]
        where = np.stack(
            [
                x[:, None] + cos * ahead - sin * left,
                y[:, None] + sin * ahead + cos * left,
                np.broadcast_to(clearance + array.position_m[:, 2], (len(t), len(array))),
            ],
            axis=-1,
        )
        floor = np.broadcast_to(np.array(earth, float), where.shape).copy()
        if sources:
            floor += magpylib.getB(sources, where.reshape(-1, 3), sumup=True).reshape(where.shape)
        own = np.stack(
            [
                cos * floor[..., 0] + sin * floor[..., 1],
                cos * floor[..., 1] - sin * floor[..., 0],
                floor[..., 2],
            ],
            axis=-1,
        )
        axes = np.flatnonzero(array.delay_s == delay)
        measured[:, :, axes] = own[:, :, axes]
    measured += offsets * rng.uniform(-1, 1, measured.shape[1:])
    measured += noise * rng.standard_normal(measured.shape)
    return Samples(device, array, START_NS + np.rint(t * 1e9).astype(np.int64), measured)


def spoiled(samples: Samples, field_t: Array) -> Samples:
    return replace(samples, field_t=field_t)


def true_tag_pose(course: Course, time_ns: int, tag: Tag) -> tuple[float, float, float]:
    """Truth: the tag in the frame of the bar at a time; x, y and heading."""
    x, y, heading = (float(v) for v in course.at(np.array((time_ns - START_NS) * 1e-9)))
    dx, dy = tag.x - x, tag.y - y
    return (
        float(np.cos(heading) * dx + np.sin(heading) * dy),
        float(np.cos(heading) * dy - np.sin(heading) * dx),
        float(np.remainder(tag.heading - heading + np.pi, 2 * np.pi) - np.pi),
    )


def turn(a: ArrayLike, b: ArrayLike = 0.0) -> Array:
    """``a - b``, the short way round."""
    return np.asarray(np.remainder(np.subtract(a, b) + np.pi, 2 * np.pi) - np.pi)


@dataclass
class World:
    """The functions above, for tests that cannot import a conftest."""

    Tag, Course, Debris = Tag, Course, Debris
    start_ns: int = START_NS
    earth_t: tuple[float, float, float] = field(default=EARTH_T)
    line = staticmethod(line)
    driven = staticmethod(driven)
    bar = staticmethod(bar)
    record = staticmethod(record)
    spoiled = staticmethod(spoiled)
    true_tag_pose = staticmethod(true_tag_pose)
    turn = staticmethod(turn)


@pytest.fixture(scope="session")
def world() -> World:
    """The independent world: tags, courses, recordings."""
    return World()


@pytest.fixture(scope="session")
def recordings(data: Path) -> Path:
    """Folder of the published Polaris recordings."""
    folder = data / "polaris"
    if not folder.is_dir():
        pytest.skip(f"no Polaris recordings in {data}")
    return folder
