"""A camera over printed dots that shares nothing with solver or simulator but the codec.

The paper is a flat raster on which OpenCV draws discs; the frame is that raster as seen
through lens and pinhole, pixel by pixel, many times as fine as it is wanted and averaged.
Nothing here knows of centroids, lattices or their inverse formulas.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.dots.codec import codec

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

PITCH_PX = 0.508 / 0.046
"""Of the paper's camera: 188 x 120 px, each 0.046 mm wide."""

SIXTH = 1 / 6
ASIDE = {0: (0.0, -SIXTH), 1: (-SIXTH, 0.0), 2: (SIXTH, 0.0), 3: (0.0, SIXTH)}
"""Where the dots of symbols up, left, right and down lie from their places, y down."""


@dataclass(frozen=True)
class Shot:
    """How a frame is taken; lengths in px of the frame or pitches of the pattern.

    ``at`` is the grid place under ``centre``, ``heading`` the direction of the image's
    right there, counter-clockwise from the sheet's x. ``radial`` is the division model's k
    in px^-2; ``tilt`` leans the camera towards ``towards`` (both radians), ``focal`` px over
    the paper. ``symbols`` replaces what the codec has at :meth:`corner`.
    """

    at: tuple[float, float] = (150_000_000.0, 90_000_000.0)
    heading: float = 0.0
    codec: str = "anoto"
    section: tuple[int, int] = (0, 0)
    symbols: NDArray[np.uint8] | None = None
    size: tuple[int, int] = (188, 120)
    pitch: float = PITCH_PX
    centre: tuple[float, float] | None = None
    radial: float = 0.0
    tilt: float = 0.0
    towards: float = 0.0
    focal: float = 348.7
    dot: float = 0.30
    missing: float = 0.0
    dust: float = 0.0
    jitter: float = 0.0
    rim: float = math.inf
    blur: float = 0.6
    motion: float = 0.0
    noise: float = 2.0
    paper: float = 210.0
    ink: float = 50.0
    vignette: float = 0.0
    gradient: float = 0.0
    seed: int = 0

    @property
    def middle(self) -> tuple[float, float]:
        return self.centre or ((self.size[0] - 1) / 2, (self.size[1] - 1) / 2)

    @cached_property
    def reach(self) -> int:
        """Pitches that are drawn to each side of :attr:`at`."""
        off = math.dist(self.middle, ((self.size[0] - 1) / 2, (self.size[1] - 1) / 2))
        across = math.hypot(*self.size) / 2 + off
        return math.ceil(across / self.pitch * (1.15 + 2 * self.tilt)) + 2

    @cached_property
    def corner(self) -> tuple[int, int]:
        """The upper left place that is drawn."""
        return round(self.at[0]) - self.reach, round(self.at[1]) - self.reach

    def take(self) -> Image:
        """The frame, (height, width)."""
        rng = np.random.default_rng(self.seed)
        times = 4 if max(self.size) < 400 else 2
        fine = max(math.ceil(self.pitch * times), 40)
        width, height = self.size
        x, y = ((np.arange(n * times, dtype=np.float32) + 0.5) / times - 0.5 for n in self.size)
        on_paper = self._on_paper(x[None], y[:, None])
        # In pitches from the corner.
        column, row = (
            where + float(at - corner)
            for where, at, corner in zip(on_paper, self.at, self.corner, strict=True)
        )
        raster = self._print(
            fine, rng, self._visible(column[::times, ::times], row[::times, ::times])
        )
        to_raster = [(where + 1) * fine - 0.5 for where in (column, row)]
        seen = cv2.remap(
            raster, *to_raster, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0
        )
        small = cv2.resize(seen, self.size, interpolation=cv2.INTER_AREA).astype(float) / 255
        if self.blur:
            small = cv2.GaussianBlur(small, (0, 0), self.blur)
        if self.motion:
            way = rng.uniform(0, math.pi)
            steps = np.linspace(-0.5, 0.5, 9) * self.motion
            shifts = [np.array([[1, 0, math.cos(way) * s], [0, 1, math.sin(way) * s]])
                      for s in steps]  # fmt: skip
            small = np.mean(
                [
                    cv2.warpAffine(small, s, self.size, borderMode=cv2.BORDER_REFLECT)
                    for s in shifts
                ],
                axis=0,
            )
        gx, gy = np.meshgrid(np.linspace(-1, 1, width), np.linspace(-1, 1, height))
        light = 1 - self.vignette * (gx**2 + gy**2) / 2 + self.gradient * gx
        grey = light * (self.paper - (self.paper - self.ink) * small)
        grey += rng.normal(0, self.noise, grey.shape) if self.noise else 0
        return np.clip(np.rint(grey), 0, 255).astype(np.uint8)

    def _visible(self, column: Array, row: Array) -> NDArray[np.bool_]:
        """Places next to those that the pixels see."""
        count = 2 * self.reach + 1
        seen = np.zeros((count, count), np.uint8)
        nearest = (np.rint(row).astype(int), np.rint(column).astype(int))
        inside = np.all([(k >= 0) & (k < count) for k in nearest], axis=0)
        seen[nearest[0][inside], nearest[1][inside]] = 1
        return cv2.dilate(seen, np.ones((3, 3), np.uint8)) > 0

    def _print(self, fine: int, rng: np.random.Generator, visible: NDArray[np.bool_]) -> Image:
        """Ink (255) on paper (0), a margin of one pitch about the places."""
        count = 2 * self.reach + 1
        symbols = self.symbols
        if symbols is None:
            # Drawn as far as the range goes; there is nothing beyond its rim.
            low = [max(start, 0) for start in self.corner]
            size = (count - (low[0] - self.corner[0]), count - (low[1] - self.corner[1]))
            symbols = np.full((count, count), 255, np.uint8)
            symbols[count - size[1] :, count - size[0] :] = codec(self.codec).symbols(
                (low[0], low[1]), size, self.section
            )
        raster = np.zeros(((count + 1) * fine, (count + 1) * fine), np.uint8)
        gone = rng.random(symbols.shape) < self.missing
        strays = rng.normal(0, self.jitter, (*symbols.shape, 2)) if self.jitter else None
        radius = round(self.dot / 2 * fine * 16)

        def disc(x: float, y: float) -> None:
            at = (round((x * fine - 0.5) * 16), round((y * fine - 0.5) * 16))
            cv2.circle(raster, at, radius, 255, -1, cv2.LINE_AA, 4)

        for row, column in np.argwhere((symbols < 4) & ~gone & visible).tolist():
            if column + self.corner[0] - self.at[0] > self.rim:
                continue
            aside = ASIDE[int(symbols[row, column])]
            stray = (0.0, 0.0) if strays is None else strays[row, column]
            disc(column + 1 + aside[0] + stray[0], row + 1 + aside[1] + stray[1])
        for x, y in rng.uniform(1, count, (rng.binomial(symbols.size, self.dust), 2)):
            disc(x, y)
        return raster

    def _on_paper(self, px: Array, py: Array) -> tuple[Array, Array]:
        """Pitches east and south of :attr:`at` that the pixels see."""
        right, down = self._tilted(px, py)
        x, y = self.middle
        rights, downs = self._tilted(np.array([x, x + 1e-3]), np.array([y, y]))
        turn = -self.heading - math.atan2(downs[1] - downs[0], rights[1] - rights[0])
        c, s = math.cos(turn), math.sin(turn)
        return c * right - s * down, s * right + c * down

    def _tilted(self, px: Array, py: Array) -> tuple[Array, Array]:
        """Where rays through the pixels meet the paper, in pitches along two axes on it."""
        x, y = px - self.middle[0], py - self.middle[1]
        bend = 1 / self.focal
        if self.radial:
            bend = bend / (1 + self.radial * (x * x + y * y))
        x, y = x * bend, y * bend  # the rays are (x, y, 1)
        lean = (math.cos(self.towards) * self.tilt, math.sin(self.towards) * self.tilt, 0.0)
        a, b, n = cv2.Rodrigues(np.array(lean))[0].T.tolist()  # two axes on the paper, its normal
        distance = self.focal / self.pitch
        far = (distance * n[2]) / (n[0] * x + n[1] * y + n[2])
        return (
            (a[0] * x + a[1] * y + a[2]) * far - a[2] * distance,
            (b[0] * x + b[1] * y + b[2]) * far - b[2] * distance,
        )


PITCH_MM = 0.508


@dataclass(frozen=True)
class LaidSheet:
    """Sheet on the floor: ``x, y`` in mm of its lower left corner, ``turn`` in degrees.

    ``origin``, ``size``, ``page`` and ``first`` are those of its manifest. ``visible`` is the part
    of the paper that is left after cutting: left, bottom, right, top in mm. ``warp`` moves points
    of the paper, as complex numbers in mm.
    """

    origin: tuple[int, int]
    size: tuple[int, int]
    page: tuple[float, float]
    first: tuple[float, float]
    x: float = 0.0
    y: float = 0.0
    turn: float = 0.0
    visible: tuple[float, float, float, float] | None = None
    warp: Callable[[Array], Array] | None = None

    @property
    def rotor(self) -> complex:
        return complex(math.cos(math.radians(self.turn)), math.sin(math.radians(self.turn)))

    def on_paper(self, floor: Any) -> Any:
        return (floor - complex(self.x, self.y)) / self.rotor

    def on_floor(self, paper: Any) -> Any:
        if self.warp is not None:
            paper = paper + self.warp(paper)
        return paper * self.rotor + complex(self.x, self.y)


@dataclass(frozen=True)
class FloorShot(Shot):
    """A frame of a floor; ``spot`` is in mm on it, and replaces ``at``."""

    spot: tuple[float, float] = (0.0, 0.0)
    sheets: Sequence[LaidSheet] = field(default=())

    @classmethod
    def over(cls, sheets: Sequence[LaidSheet], x: float, y: float, **how: Any) -> Any:
        return cls(at=(x / PITCH_MM, -y / PITCH_MM), spot=(x, y), sheets=sheets, **how).take()

    @cached_property
    def reach(self) -> int:
        across = math.hypot(*self.size) / 2
        return math.ceil(across / self.pitch * (1.15 + 2 * self.tilt)) + 2

    def _print(self, fine: int, rng: np.random.Generator, visible: Any) -> Any:
        count = 2 * self.reach + 1
        raster = np.zeros(((count + 1) * fine, (count + 1) * fine), np.uint8)
        radius = round(self.dot / 2 * fine * 16)

        def on_raster(floor: Any) -> Any:
            column = floor.real / PITCH_MM - self.corner[0] + 1
            row = -floor.imag / PITCH_MM - self.corner[1] + 1
            return np.rint((np.stack([column, row], -1) * fine - 0.5) * 16).astype(np.int64)

        middle = complex(*self.spot)
        for sheet in self.sheets:
            left, bottom, right, top = sheet.visible or (0, 0, *sheet.page)
            outline = np.array(
                [
                    complex(x, y)
                    for x, y in ((left, bottom), (right, bottom), (right, top), (left, top))
                ]
            )
            # Clipped so that it stays within the range of OpenCV's fixed point.
            polygon = np.clip(on_raster(sheet.on_floor(outline)), -(2**24), 2**24)
            cv2.fillPoly(raster, [polygon.astype(np.int32)], 0, cv2.LINE_AA, 4)
            here = sheet.on_paper(middle)
            node = np.array(
                [here.real - sheet.first[0], sheet.page[1] - sheet.first[1] - here.imag]
            ) / PITCH_MM  # fmt: skip
            low = np.maximum(np.floor(node - self.reach - 3).astype(int), 0)
            high = np.minimum(np.ceil(node + self.reach + 3).astype(int), np.array(sheet.size) - 1)
            if (high < low).any():
                continue
            columns, rows = (high - low + 1).tolist()
            start = (int(sheet.origin[0] + low[0]), int(sheet.origin[1] + low[1]))
            symbols = codec(self.codec).symbols(start, (columns, rows), self.section)
            aside = np.array([ASIDE[k] for k in range(4)])[symbols]
            x, y = np.meshgrid(np.arange(columns) + low[0], np.arange(rows) + low[1])
            paper = (
                (x + aside[..., 0]) * PITCH_MM
                + sheet.first[0]
                + 1j * (sheet.page[1] - sheet.first[1] - (y + aside[..., 1]) * PITCH_MM)
            )
            inside = (paper.real > left) & (paper.real < right)
            inside &= (paper.imag > bottom) & (paper.imag < top)
            for column, row in on_raster(sheet.on_floor(paper[inside])).tolist():
                if 0 <= column < 16 * raster.shape[1] and 0 <= row < 16 * raster.shape[0]:
                    cv2.circle(raster, (column, row), radius, 255, -1, cv2.LINE_AA, 4)
        return raster


@pytest.fixture(scope="session")
def shoot() -> Callable[..., Image]:
    """``shoot(at=..., heading=..., ...)``: the frame of a :class:`Shot`."""

    def take(**how: Any) -> Image:
        return Shot(**how).take()

    return take


@pytest.fixture(scope="session")
def shot() -> Callable[..., Shot]:
    """The class :class:`Shot`."""
    return Shot


@pytest.fixture(scope="session")
def laid_sheet() -> Callable[..., LaidSheet]:
    """The class :class:`LaidSheet`."""
    return LaidSheet


@pytest.fixture(scope="session")
def shoot_floor() -> Callable[..., Image]:
    """``shoot_floor(sheets, x, y, heading=..., ...)``: a frame over a place of a floor in mm."""
    return FloorShot.over
