"""Points for tags from layouts in VDMA's Layout Interchange Format (LIF) 1.0.0 and 2.0.0.

A node is a tag. Nodes ``tag<id>`` (:mod:`locatk.formats.exporters.floors.site_lif`) state their
ids, and the name (in LIF 2, the descriptor) of a node is the meaning of its tag. In other layouts
the name is the id of the tag if all names are whole numbers; otherwise it is the meaning of the
tag, and the id is free. The heading is the ``theta`` of the first type of vehicle that has one, or
0. Edges are not used.
"""

from __future__ import annotations

import math
import os
from typing import Any

from locatk.core.polaris.design.site import SitePoint
from locatk.core.polaris.tag import MAX_MEANING_CHARACTERS
from locatk.formats.importers.floors.lif import NAME_KEY, LayoutNode, LayoutReader
from locatk.formats.importers.floors.site_csv import MAX_ID_DIGITS

NODE_PREFIX = "tag"
"""Beginning of the identifiers of nodes that state the ids of their tags."""

PROPERTIES_KEY = {"1": "vehicleTypeNodeProperties", "2": "mobileRobotTypeNodeProperties"}
"""Key of the properties of a node by type of vehicle, by the major version of LIF."""


def loads_site_points(text: str, *, file: str | os.PathLike[str]) -> tuple[list[SitePoint], bool]:
    """Parse a layout; errors name ``file``.

    Returns
    -------
    points : list of SitePoint
        In the order of the nodes.
    has_heading : bool
        Whether any node has a heading.

    Raises
    ------
    FormatError
        It is not LIF, or has no nodes; the error names the node or the key.
    """
    reader = LayoutReader(file)
    layout, major = reader.layout(text)
    nodes = list(reader.nodes(layout))
    if not nodes:
        raise reader.error("a layout without nodes", "nodes")
    key = NAME_KEY[major]
    ids, meanings = [node.node_id.removeprefix(NODE_PREFIX) for node in nodes], [""] * len(nodes)
    if all(node.node_id.startswith(NODE_PREFIX) for node in nodes) and _are_ids(ids):
        meanings = [_name(node, key) for node in nodes]
    else:
        ids = [_name(node, key) or node.node_id for node in nodes]
        if not _are_ids(ids):
            ids, meanings = [""] * len(nodes), ids
    headings = [_heading(reader, node, PROPERTIES_KEY[major]) for node in nodes]
    points = [
        SitePoint(
            node.x_m,
            node.y_m,
            heading or 0.0,
            int(tag_id) if tag_id else None,
            _meaning(meaning),
            f"node {node.node_id!r}",
        )
        for node, tag_id, meaning, heading in zip(nodes, ids, meanings, headings, strict=True)
    ]
    return points, any(heading is not None for heading in headings)


def _name(node: LayoutNode, key: str) -> str:
    """Return the name of a node, empty if it has none."""
    name = node.data.get(key)
    return name.strip() if isinstance(name, str) else ""


def _are_ids(texts: list[str]) -> bool:
    return all(text.isascii() and text.isdigit() and len(text) <= MAX_ID_DIGITS for text in texts)


def _meaning(name: str) -> str:
    printable = "".join(character if character.isprintable() else " " for character in name)
    return " ".join(printable.split())[:MAX_MEANING_CHARACTERS].strip()


def _heading(reader: LayoutReader, node: LayoutNode, key: str) -> float | None:
    """Return the first ``theta`` of a node in radians; None if there is none."""
    properties: Any = node.data.get(key)
    if not isinstance(properties, list):
        return None
    for each in properties:
        theta = each.get("theta") if isinstance(each, dict) else None
        if theta is None:
            continue
        is_number = isinstance(theta, int | float) and not isinstance(theta, bool)
        if not is_number or not abs(theta) <= math.tau:
            raise reader.error("expected an angle in radians", f"{node.where}.{key}.theta")
        return float(theta)
    return None
