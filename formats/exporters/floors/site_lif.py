"""Sites of tags as a layout in VDMA's Layout Interchange Format (:mod:`.layout_lif`).

A tag is a node ``tag<id>`` at its position, with its heading as ``theta`` and its meaning as
``nodeName`` (in LIF 2 as ``nodeDescriptor``). There are no edges: which tags a vehicle may drive
between is not part of a site. :mod:`locatk.formats.importers.floors.site_lif` reads such layouts.
"""

from __future__ import annotations

import math
from datetime import datetime

from locatk.core.polaris.tag import Tags
from locatk.formats.exporters.floors.layout_lif import LIF_VERSIONS, LayoutPoint, dumps_layout
from locatk.formats.importers.floors.site_lif import NODE_PREFIX

SERIES = "polaris"

TITLE = "site"
"""Identifier of layout, origin and file: sites have no name."""


def dumps_lif(tags: Tags, stamp: datetime, version: str = LIF_VERSIONS[0]) -> str:
    """Return the layout of a site; the same site, stamp and version give the same text.

    Parameters
    ----------
    tags : Tags
        With a site.
    stamp : datetime
        Time of the layout, with its time zone.
    version : str
        One of :data:`~locatk.formats.exporters.floors.layout_lif.LIF_VERSIONS`.
    """
    points = [
        LayoutPoint(
            f"{NODE_PREFIX}{tag_id}",
            pose.x_m,
            pose.y_m,
            tags.meanings.get(tag_id, ""),
            theta_rad=math.remainder(pose.heading_rad, math.tau),
        )
        for tag_id, pose in sorted(tags.site.items())
    ]
    description = f"{len(points)} magnetic tags"
    return dumps_layout(TITLE, "", description, SERIES, points, [], stamp, version)
