"""Simulated print: dots with errors, missing dots, and dust.

Random numbers are a hash of the position on the grid instead of a stream: a missing dot is missing
in every frame that shows its position.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from locatk.core.dots.codec import DOT_DIRECTIONS, codec
from locatk.core.dots.sheet import Manifest

Array = NDArray[np.float64]

DUST_RADIUS_PITCHES = (0.05, 0.2)
"""Range of the radius of a speck, from a grain of toner to more than a dot."""


class HashPurpose(IntEnum):
    """Quantities that are drawn from hashes of a position."""

    MISSING = 0
    JITTER = 1
    SPECK = 2
    SPECK_POSITION = 3
    SPECK_SIZE = 4


@dataclass(frozen=True)
class PrintedPaper:
    """Printed sheets of a manifest.

    Attributes
    ----------
    manifest : Manifest
        Its scale is the true one of the paper.
    sheets : tuple of int
        Numbers of the sheets in one frame; each covers those before it.
    dot : float
        Diameter of a dot on the paper in pitches.
    missing : float
        Fraction of the dots that are missing.
    dust : float
        Number of specks as dark as dots, relative to the number of dots.
    jitter_m : float
        Standard deviation of the position of a dot along each axis.
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
        """Return the dark discs around a point.

        Parameters
        ----------
        middle_m : (2,) ndarray
            The point in the frame of the sheets.
        radius_m : float
            All marks within this distance are returned, and possibly more.

        Returns
        -------
        centres : (n, 2) ndarray
            Positions relative to ``middle_m`` in metres.
        radii : (n,) ndarray
            Radii in metres.
        """
        centres, radii = [np.zeros((0, 2))], [np.zeros(0)]
        for number in self.sheets:
            for centre, radius in self._marks_of_sheet(number, middle_m, radius_m):
                is_visible = ~self._is_covered(number, centre + middle_m)
                centres.append(centre[is_visible])
                radii.append(radius[is_visible])
        return np.concatenate(centres), np.concatenate(radii)

    def _marks_of_sheet(
        self, number: int, middle_m: Array, radius_m: float
    ) -> Iterator[tuple[Array, Array]]:
        """Yield centres and radii in metres of the dots, then of the dust, of one sheet."""
        sheet, middle = self.manifest.sheets[number], self.manifest.to_grid(number, middle_m)
        # Within a frame a distortion is linear.
        to_metres = self.manifest.jacobian(number, middle)
        to_grid = np.linalg.inv(to_metres)
        half_width = radius_m * np.linalg.norm(to_grid, axis=1) + 1.0
        low = np.maximum(np.floor(middle - half_width).astype(np.int64), sheet.origin)
        last = np.array(sheet.origin) + sheet.size - 1
        high = np.minimum(np.ceil(middle + half_width).astype(np.int64), last)
        columns, rows = (int(n) for n in high - low + 1)
        if columns < 1 or rows < 1:
            return
        window = codec(self.manifest.codec).symbols(
            (int(low[0]), int(low[1])), (columns, rows), sheet.section
        )
        x, y = np.meshgrid(np.arange(columns), np.arange(rows))
        nodes = np.stack([x.ravel(), y.ravel()], axis=1) + low
        # Integers are subtracted: far from the origin a float would lose the fraction.
        offsets = (nodes - low).astype(float) + (low - middle)
        pitch_m = self.manifest.pitch_mm * 1e-3
        displacement = self.manifest.offset_mm / self.manifest.pitch_mm

        is_printed = self._hash(HashPurpose.MISSING, number, nodes) >= self.missing
        dots = (offsets + DOT_DIRECTIONS[window.ravel()] * displacement)[is_printed] @ to_metres.T
        if self.jitter_m > 0:
            dots += self.jitter_m * self._normal(HashPurpose.JITTER, number, nodes[is_printed])
        yield dots, np.full(len(dots), self.dot / 2 * pitch_m)

        is_dusty = self._hash(HashPurpose.SPECK, number, nodes) < self.dust
        if is_dusty.any():
            dusty = nodes[is_dusty]
            position = np.stack(
                [self._hash(HashPurpose.SPECK_POSITION, number, dusty, k) for k in (0, 1)], axis=1
            )
            size = self._hash(HashPurpose.SPECK_SIZE, number, dusty)
            low_radius, high_radius = DUST_RADIUS_PITCHES
            specks = (offsets[is_dusty] + position - 0.5) @ to_metres.T
            yield specks, (low_radius + (high_radius - low_radius) * size) * pitch_m

    def _is_covered(self, number: int, position_m: Array) -> NDArray[np.bool_]:
        """Return a mask of points (n, 2) that the printed area of a later sheet covers."""
        is_covered = np.zeros(len(position_m), bool)
        for later in self.sheets[self.sheets.index(number) + 1 :]:
            sheet = self.manifest.sheets[later]
            relative = self.manifest.to_grid(later, position_m) - sheet.origin + 0.5
            is_covered |= ((relative >= 0) & (relative < sheet.size)).all(axis=1)
        return is_covered

    def _hash(
        self, purpose: HashPurpose, number: int, nodes: NDArray[np.int64], draw: int = 0
    ) -> Array:
        """Return uniform numbers (n,) from 0 to 1 that depend on the arguments and the seed."""
        state = np.uint64((self.seed * 64 + int(purpose) * 8 + draw) & 0xFFFFFFFFFFFFFFFF)
        words = (nodes[:, 0], nodes[:, 1], np.full(len(nodes), number))
        mixed = np.full(len(nodes), state)
        for word in words:
            mixed = _mix(mixed ^ word.astype(np.uint64))
        return (mixed >> np.uint64(11)).astype(float) * 2.0**-53

    def _normal(self, purpose: HashPurpose, number: int, nodes: NDArray[np.int64]) -> Array:
        """Return standard normal numbers (n, 2), by the method of Box and Muller."""
        radius = np.sqrt(-2 * np.log1p(-self._hash(purpose, number, nodes, 0)))
        angle = 2 * np.pi * self._hash(purpose, number, nodes, 1)
        return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def _mix(words: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Apply the finalizer of SplitMix64 (Steele, Lea, Flood, OOPSLA 2014, section 5)."""
    words = words + np.uint64(0x9E3779B97F4A7C15)
    words = (words ^ (words >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    words = (words ^ (words >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return words ^ (words >> np.uint64(31))
