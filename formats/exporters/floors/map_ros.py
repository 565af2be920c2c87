"""Landmark maps as an occupancy grid of ROS: the YAML and PGM of ``map_server``.

The format is that of wiki.ros.org/map_server and of Nav2. Free floor around landmarks is white.
Territories of landmarks (field of at least the threshold of the map's bars) are light grey, which
is still free for ``map_server``. Cells without a landmark are unknown; walls are black and one
pixel wide. The first row of the image has the greatest y; ``origin`` is the lower left corner of
the lower left pixel, half a pitch before cell (0, 0). Landmarks are drawn as built if that is
known.
"""

from __future__ import annotations

import json
import math

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.landmarks.field import basis
from locatk.core.landmarks.map.floor import HOLE_CODE, FloorMap, as_built_landmark

DEFAULT_RESOLUTION_M = 0.010
"""Side of a pixel."""

FREE, TERRITORY, UNKNOWN, OCCUPIED = 254, 230, 205, 0
"""Grey levels; by :data:`FREE_THRESHOLD` all from 206 are free."""

FREE_THRESHOLD, OCCUPIED_THRESHOLD = 0.196, 0.65

MAX_SIDE_PX = 30_000

Pixels = NDArray[np.uint8]


def draw_grid(floor: FloorMap, resolution_m: float = DEFAULT_RESOLUTION_M) -> Pixels:
    """Return the grey levels (height, width) of a map; the first row has the greatest y.

    Raises
    ------
    InputError
        The image would be too large, or a cell smaller than four pixels.
    """
    rows, columns = floor.shape
    size = [math.ceil(count * floor.pitch_m / resolution_m - 1e-9) for count in (rows, columns)]
    if max(size) > MAX_SIDE_PX:
        raise InputError(
            f"an image of {size[1]} x {size[0]} pixels, more than {MAX_SIDE_PX} a side",
            hint="Give a coarser --resolution",
        )
    if resolution_m > floor.pitch_m / 4:
        raise InputError(
            f"pixels of {1e3 * resolution_m:g} mm are too coarse for a pitch of "
            f"{1e3 * floor.pitch_m:g} mm",
            hint="Give a --resolution of at most a quarter of the pitch",
        )
    left, bottom = _corner(floor)
    centre = [(np.arange(n) + 0.5) * resolution_m for n in size]  # from the corner: y, x
    cell = [np.floor(c / floor.pitch_m).astype(int) for c in centre]
    has_landmark = np.full((max(cell[0][-1] + 1, rows), max(cell[1][-1] + 1, columns)), False)
    has_landmark[:rows, :columns] = floor.codes != HOLE_CODE
    upward = np.where(has_landmark[np.ix_(*cell)], FREE, UNKNOWN).astype(np.uint8)
    for position in floor.cells():
        (x, y, heading), strength = as_built_landmark(floor, position)
        spans = []
        for middle, count in ((y - bottom, size[0]), (x - left, size[1])):
            first, last = ((middle + s * floor.pitch_m / 2) / resolution_m for s in (-1, 1))
            spans.append(slice(max(math.floor(first), 0), min(math.ceil(last), count)))
        dy, dx = np.meshgrid(
            centre[0][spans[0]] + bottom - y, centre[1][spans[1]] + left - x, indexing="ij"
        )
        c, s = math.cos(heading), math.sin(heading)
        points = np.stack([c * dx + s * dy, c * dy - s * dx], -1)
        inside = np.abs(basis(floor.geometry, points) @ strength) >= floor.geometry.threshold_t
        window = upward[spans[0], spans[1]]
        window[inside & (window == FREE)] = TERRITORY
    _draw_walls(upward, floor, resolution_m)
    return np.ascontiguousarray(upward[::-1])


def dumps_pgm(pixels: Pixels) -> bytes:
    """Return a binary PGM of grey levels."""
    height, width = pixels.shape
    return b"P5\n%d %d\n255\n" % (width, height) + pixels.tobytes()


def dumps_yaml(floor: FloorMap, image: str, resolution_m: float = DEFAULT_RESOLUTION_M) -> str:
    """Return the YAML of an image whose file is ``image``."""
    left, bottom = _corner(floor)
    return (
        f"image: {json.dumps(image)}\n"
        "mode: trinary\n"
        f"resolution: {resolution_m:.9g}\n"
        f"origin: [{round(left, 9)}, {round(bottom, 9)}, 0.0]\n"
        "negate: 0\n"
        f"occupied_thresh: {OCCUPIED_THRESHOLD}\n"
        f"free_thresh: {FREE_THRESHOLD}\n"
    )


def _corner(floor: FloorMap) -> tuple[float, float]:
    """Return x and y of the lower left corner of the image."""
    x, y = floor.origin_m
    return x - floor.pitch_m / 2, y - floor.pitch_m / 2


def _draw_walls(upward: Pixels, floor: FloorMap, resolution_m: float) -> None:
    """Draw black lines midway between cells; the first row of ``upward`` has the least y."""

    def pixel(cells: float, axis: int) -> int:
        return min(int(cells * floor.pitch_m / resolution_m + 1e-9), upward.shape[axis] - 1)

    for (row, column), (other_row, _) in floor.walls:
        top, right = pixel(row + 1, 0), pixel(column + 1, 1)
        if other_row > row:
            upward[top, pixel(column, 1) : right + 1] = OCCUPIED
        else:
            upward[pixel(row, 0) : top + 1, right] = OCCUPIED
