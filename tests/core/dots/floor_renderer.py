"""Several printed sheets on a floor, seen by the camera of :class:`conftest.Shot`.

Like that camera, it shares nothing with solver or simulator but the codec: the dots of each sheet
are put on the floor by complex numbers, later sheets cover earlier ones.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from conftest import ASIDE, PITCH_PX, Shot  # type: ignore[import-not-found]
from numpy.typing import NDArray

from locatk.core.dots.codec import codec

Array = NDArray[np.float64]
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
class FloorShot(Shot):  # type: ignore[misc]
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


__all__ = ["PITCH_MM", "PITCH_PX", "FloorShot", "LaidSheet"]
