"""Landmark maps from layouts in VDMA's Layout Interchange Format (LIF) 1.0.0 and 2.0.0.

A node is a landmark, whose name (in LIF 2, its descriptor) is the letters of its bars. Neighbours
without an edge in either direction are separated by a wall. The format and the conventions of its
nodes and edges are described in :mod:`locatk.formats.exporters.floors.map_lif`, which writes such
layouts.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import replace

from locatk.core.errors import error_context
from locatk.core.landmarks.landmark import code_of
from locatk.core.landmarks.map.floor import Cell, FloorMap, neighbour
from locatk.core.landmarks.map.grid_fit import MAX_OFFSET_M, floor_from_poses
from locatk.formats.importers.floors.lif import NAME_KEY, LayoutNode, LayoutReader


def loads_lif(
    text: str,
    *,
    file: str | os.PathLike[str],
    pitch_m: float | None = None,
    tolerance_m: float = MAX_OFFSET_M,
) -> FloorMap:
    """Parse a layout; pitch and cells are estimated from the positions of the nodes.

    An edge in one direction only is not a wall: a map that is unique with this passage is unique
    without it, too.

    Parameters
    ----------
    text : str
    file : path
        Name in errors.
    pitch_m, tolerance_m
        See :func:`locatk.core.landmarks.map.grid_fit.fit_grid`.

    Raises
    ------
    FormatError
        It is not LIF, or the name of a node is not a landmark; the error names the node or the key.
    InputError
        The positions are not on a grid; the error names a deviating node.
    """
    reader = LayoutReader(file)
    layout, major = reader.layout(text)
    codes, poses, names = [], [], []
    index: dict[str, int] = {}
    for number, node in enumerate(reader.nodes(layout)):
        index[node.node_id] = number
        codes.append(_code(reader, node, NAME_KEY[major]))
        poses.append((node.x_m, node.y_m, 0.0))
        names.append(f"node {node.node_id!r}")
    if not codes:
        raise reader.error("a layout without nodes", "nodes")
    with error_context(file):
        floor = floor_from_poses(codes, poses, names, pitch_m=pitch_m, tolerance_m=tolerance_m)
    edges = set()
    for number, edge in enumerate(reader.objects(layout, "edges")):
        ends = [reader.text(edge, key, f"edges[{number}]") for key in ("startNodeId", "endNodeId")]
        if all(end in index for end in ends):  # an end may be in another layout
            edges.add(frozenset(index[end] for end in ends))
    by_cell = dict(zip(_cells(floor, poses), range(len(poses)), strict=True))
    walls = {
        (cell, other)
        for cell, other in iter_passages(floor)
        if cell < other and frozenset((by_cell[cell], by_cell[other])) not in edges
    }
    title = layout.get("layoutName")
    return replace(floor, walls=frozenset(walls), name=title if isinstance(title, str) else "")


def iter_passages(floor: FloorMap) -> Iterator[tuple[Cell, Cell]]:
    """Yield the pairs of cells between which a robot can drive, in both directions."""
    for cell in floor.cells():
        for heading in range(4):
            if floor.is_passable(cell, heading):
                yield cell, neighbour(cell, heading)


def _code(reader: LayoutReader, node: LayoutNode, key: str) -> int:
    """Return the code of the landmark whose letters a node has under ``key``."""
    letters = node.data.get(key)
    try:
        return code_of(letters if isinstance(letters, str) else "")
    except ValueError:
        raise reader.error(
            f"the {key} of node {node.node_id!r} is not a landmark",
            f"{node.where}.{key}",
            f"Give the letters of its bars as {key}, as in NNSN: counter-clockwise from +x",
        ) from None


def _cells(floor: FloorMap, poses: list[tuple[float, float, float]]) -> list[Cell]:
    """Return the cell of each pose."""
    x, y = floor.origin_m
    return [
        (round((pose[1] - y) / floor.pitch_m), round((pose[0] - x) / floor.pitch_m))
        for pose in poses
    ]
