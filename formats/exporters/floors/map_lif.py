"""Landmark maps as a layout in VDMA's Layout Interchange Format (:mod:`.layout_lif`).

- A landmark is a node ``r<row>c<column>`` at its position, as built if that is known; its
  ``nodeName`` (in LIF 2 its ``nodeDescriptor``) is the letters of its bars, as in ``NNSN``,
  counter-clockwise from +x;
- a passage from a landmark to a neighbour is an edge; neighbours without an edge in either
  direction are separated by a wall.

The layout does not contain the alphabet, the window, the bars and the headings as built.
"""

from __future__ import annotations

from datetime import datetime

from locatk.core.landmarks.landmark import name
from locatk.core.landmarks.map.floor import Cell, FloorMap, as_built_poses
from locatk.formats.exporters.floors.layout_lif import LIF_VERSIONS, LayoutPoint, dumps_layout
from locatk.formats.importers.floors.map_lif import iter_passages

SERIES = "landmarks"


def dumps_lif(floor: FloorMap, stamp: datetime, version: str = LIF_VERSIONS[0]) -> str:
    """Return the layout of a map; the same map, stamp and version give the same text.

    Parameters
    ----------
    floor : FloorMap
    stamp : datetime
        Time of the layout, with its time zone.
    version : str
        One of :data:`~locatk.formats.exporters.floors.layout_lif.LIF_VERSIONS`.
    """
    rows, columns = floor.shape
    description = (
        f"{len(floor.cells())} magnetic landmarks in {rows} rows and {columns} columns of "
        f"{1e3 * floor.pitch_m:g} mm"
    )
    points = [
        LayoutPoint(
            _node_id(cell),
            x,
            y,
            name(int(floor.codes[cell])),
            f"landmark of code {floor.codes[cell]} in row {cell[0]}, column {cell[1]}",
        )
        for cell, (x, y, _) in zip(floor.cells(), as_built_poses(floor).tolist(), strict=True)
    ]
    edges = [(_node_id(cell), _node_id(other)) for cell, other in iter_passages(floor)]
    title = floor.name or SERIES
    return dumps_layout(title, floor.name, description, SERIES, points, edges, stamp, version)


def _node_id(cell: Cell) -> str:
    return f"r{cell[0]}c{cell[1]}"
