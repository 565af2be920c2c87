"""Landmark maps as the transponder list that vehicle controllers import (CSV).

The table is described in :mod:`locatk.formats.importers.map_csv`.
"""

from __future__ import annotations

import math

from locatk.core.landmarks.map.floor import FloorMap, as_built_poses
from locatk.core.units import mm_text
from locatk.formats.importers.map_csv import HEADER

POSITION_DECIMALS = 4
"""Decimals of a position in mm: 0.1 um."""


def dumps_csv(floor: FloorMap) -> str:
    """Return the table of a map; the same map gives the same text."""
    lines = [";".join(HEADER)]
    poses = as_built_poses(floor).tolist()
    for number, (cell, (x, y, heading)) in enumerate(zip(floor.cells(), poses, strict=True)):
        heading_centidegrees = round(100 * math.degrees(heading))
        code = int(floor.codes[cell])
        position = ";".join(mm_text(coordinate, POSITION_DECIMALS) for coordinate in (x, y))
        lines.append(f"{number};{code};{position};{heading_centidegrees};0;0;0")
    return "\n".join(lines) + "\n"
