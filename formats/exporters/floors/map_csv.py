"""Landmark maps as the transponder list that vehicle controllers import (CSV).

The table is described in :mod:`locatk.formats.importers.floors.map_csv`.
"""

from __future__ import annotations

import math

from locatk.core.landmarks.landmark import name
from locatk.core.landmarks.map.floor import Cell, FloorMap, as_built_poses
from locatk.core.units import mm_text
from locatk.formats.importers.floors.map_csv import HEADER, LETTERS_COLUMN

POSITION_DECIMALS = 4
"""Decimals of a position in mm: 0.1 um."""


def dumps_csv(floor: FloorMap, unique_codes: bool = False) -> str:
    """Return the table of a map; the same map gives the same text.

    Parameters
    ----------
    floor : FloorMap
    unique_codes : bool
        Write :func:`landmark_number` as the code, and the letters of the bars in a last column.
    """
    lines = [";".join((*HEADER, LETTERS_COLUMN) if unique_codes else HEADER)]
    poses = as_built_poses(floor).tolist()
    for number, (cell, (x, y, heading)) in enumerate(zip(floor.cells(), poses, strict=True)):
        heading_centidegrees = round(100 * math.degrees(heading))
        code = landmark_number(cell) if unique_codes else int(floor.codes[cell])
        letters = f";{name(int(floor.codes[cell]))}" if unique_codes else ""
        position = ";".join(mm_text(coordinate, POSITION_DECIMALS) for coordinate in (x, y))
        lines.append(f"{number};{code};{position};{heading_centidegrees};0;0;0{letters}")
    return "\n".join(lines) + "\n"


def landmark_number(cell: Cell) -> int:
    """Return a number from 1 on that no other cell has.

    It depends on row and column only: other landmarks, holes, or a floor that grows do not change
    it. The cells of a square of n x n have the numbers 1 to n^2, so that they fit 16 bits up to
    255 x 255.
    """
    row, column = cell
    shell = max(cell)
    return shell * shell + shell + column - row + 1
