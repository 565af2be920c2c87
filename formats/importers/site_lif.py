"""Points for tags from layouts in VDMA's Layout Interchange Format (LIF) 1.0.0 and 2.0.0.

A node is a tag. Its name (in LIF 2, its descriptor) is the id of the tag if all names are whole
numbers; otherwise it is the meaning of the tag, and the id is free. The heading is the ``theta`` of
the first type of vehicle that has one (LIF 1), or 0. Edges are not used.
"""

from __future__ import annotations

import math
import os
from typing import Any

from locatk.core.polaris.design.site import SitePoint
from locatk.core.polaris.tag import MAX_MEANING_CHARACTERS
from locatk.formats.importers.lif import NAME_KEY, LayoutNode, LayoutReader
from locatk.formats.importers.site_csv import MAX_ID_DIGITS

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
    names = [_name(node, NAME_KEY[major]) for node in nodes]
    has_ids = all(
        name.isascii() and name.isdigit() and len(name) <= MAX_ID_DIGITS for name in names
    )
    headings = [_heading(reader, node, PROPERTIES_KEY[major]) for node in nodes]
    points = [
        SitePoint(
            node.x_m,
            node.y_m,
            heading or 0.0,
            int(name) if has_ids else None,
            "" if has_ids else _meaning(name),
            f"node {node.node_id!r}",
        )
        for node, name, heading in zip(nodes, names, headings, strict=True)
    ]
    return points, any(heading is not None for heading in headings)


def _name(node: LayoutNode, key: str) -> str:
    """Return the name of a node, or its id if it has none."""
    name = node.data.get(key)
    return name.strip() if isinstance(name, str) and name.strip() else node.node_id


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
