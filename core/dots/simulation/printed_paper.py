"""The paper as a printer left it: dots, dots that are missing or astray, and dust.

All of it is drawn from a hash of the place, not from a stream of random numbers: a dot
that is missing is missing in every frame that shows its place.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.codec import DOT_DIRECTIONS, codec
from locatk.core.dots.sheet import Manifest

Array = NDArray[np.float64]

DUST_RADIUS = (0.05, 0.2)
"""Of a speck, in pitches: from a grain of toner to something larger than a dot."""

MISSING, JITTER, SPECK, SPECK_PLACE, SPECK_SIZE = range(5)
"""What a hash is for."""


@dataclass(frozen=True)
class Paper:
    """Sheets of a manifest as they lie there.

    Attributes
    ----------
    manifest : Manifest
        Its scale is the paper's true one.
    sheets : tuple of int
        Numbers of the sheets that lie in one frame; a later one hides those below it.
    dot : float
        Diameter of a dot in pitches, as it is on the paper.
    missing : float
        Share of the dots that are not there.
    dust : float
        Specks as dark as dots, per dot.
    jitter_m : float
        Standard deviation of a dot's place along each axis.
    seed : int
    """

    manifest: Manifest
    sheets: tuple[int, ...]
    dot: float
    missing: float = 0.0
    dust: float = 0.0
    jitter_m: float = 0.0
    seed: int = 0

    def marks(self, middle_m: Array, radius_m: float) -> tuple[Array, Array]:
        """Dark discs about a point of the frame.

        Parameters
        ----------
        middle_m : (2,) ndarray
            In metres, in the frame of the sheets.
        radius_m : float
            At least all marks that come nearer than this are given.

        Returns
        -------
        centres : (n, 2) ndarray
            Relative to ``middle_m``, in metres.
        radii : (n,) ndarray
            In metres.
        """
        centres, radii = [np.zeros((0, 2))], [np.zeros(0)]
        for number in self.sheets:
            for at, radius in self._marks_of(number, middle_m, radius_m):
                shown = ~self._hidden(number, at + middle_m)
                centres.append(at[shown])
                radii.append(radius[shown])
        return np.concatenate(centres), np.concatenate(radii)

    def _marks_of(
        self, number: int, middle_m: Array, radius_m: float
    ) -> Iterator[tuple[Array, Array]]:
        """Centres and radii in metres of the dots, then of the dust, of one sheet."""
        sheet, to_metres = self.manifest.sheets[number], self.manifest.jacobian(number)
        to_grid = np.linalg.inv(to_metres)
        middle = self._grid(number, middle_m)
        reach = radius_m * np.linalg.norm(to_grid, axis=1) + 1.0
        low = np.maximum(np.floor(middle - reach).astype(np.int64), sheet.origin)
        last = np.array(sheet.origin) + sheet.size - 1
        high = np.minimum(np.ceil(middle + reach).astype(np.int64), last)
        columns, rows = (int(n) for n in high - low + 1)
        if columns < 1 or rows < 1:
            return
        window = codec(self.manifest.codec).symbols(
            (int(low[0]), int(low[1])), (columns, rows), sheet.section
        )
        x, y = np.meshgrid(np.arange(columns), np.arange(rows))
        places = np.stack([x.ravel(), y.ravel()], axis=1) + low
        # Subtracted as integers: far out on the plane a float would lose the fraction.
        near = (places - low).astype(float) + (low - middle)
        pitch_m = self.manifest.pitch_mm * 1e-3
        offset = self.manifest.offset_mm / self.manifest.pitch_mm

        there = self._hash(MISSING, number, places) >= self.missing
        dots = (near + DOT_DIRECTIONS[window.ravel()] * offset)[there] @ to_metres.T
        if self.jitter_m > 0:
            dots += self.jitter_m * self._normal(JITTER, number, places[there])
        yield dots, np.full(len(dots), self.dot / 2 * pitch_m)

        dusty = self._hash(SPECK, number, places) < self.dust
        if dusty.any():
            spots = places[dusty]
            place = np.stack([self._hash(SPECK_PLACE, number, spots, k) for k in (0, 1)], axis=1)
            size = self._hash(SPECK_SIZE, number, spots)
            low_radius, high_radius = DUST_RADIUS
            specks = (near[dusty] + place - 0.5) @ to_metres.T
            yield specks, (low_radius + (high_radius - low_radius) * size) * pitch_m

    def _grid(self, number: int, at_m: Array) -> Array:
        """(..., 2) metres in the frame to fractional grid coordinates of a sheet."""
        origin = np.array(self.manifest.sheets[number].origin)
        start = self.manifest.to_metres(number, origin)
        to_grid = np.linalg.inv(self.manifest.jacobian(number))
        result: Array = origin + (at_m - start) @ to_grid.T
        return result

    def _hidden(self, number: int, at_m: Array) -> NDArray[np.bool_]:
        """Which points (n, 2) of sheet ``number`` the printed area of a later one covers."""
        hidden = np.zeros(len(at_m), bool)
        for later in self.sheets[self.sheets.index(number) + 1 :]:
            sheet = self.manifest.sheets[later]
            inside = self._grid(later, at_m) - sheet.origin + 0.5
            hidden |= ((inside >= 0) & (inside < sheet.size)).all(axis=1)
        return hidden

    def _hash(self, use: int, number: int, places: NDArray[np.int64], draw: int = 0) -> Array:
        """Uniform numbers (n,) in 0 to 1 that depend on nothing but the arguments."""
        state = np.uint64((self.seed * 64 + use * 8 + draw) & 0xFFFFFFFFFFFFFFFF)
        words = (places[:, 0], places[:, 1], np.full(len(places), number))
        mixed = np.full(len(places), state)
        for word in words:
            mixed = _mix(mixed ^ word.astype(np.uint64))
        return (mixed >> np.uint64(11)).astype(float) * 2.0**-53

    def _normal(self, use: int, number: int, places: NDArray[np.int64]) -> Array:
        """Standard normal numbers (n, 2), by Box and Muller."""
        radius = np.sqrt(-2 * np.log1p(-self._hash(use, number, places, 0)))
        angle = 2 * np.pi * self._hash(use, number, places, 1)
        return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def _mix(words: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """The finalizer of SplitMix64 (Steele, Lea, Flood, OOPSLA 2014, section 5)."""
    words = words + np.uint64(0x9E3779B97F4A7C15)
    words = (words ^ (words >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    words = (words ^ (words >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return words ^ (words >> np.uint64(31))
