"""Sites of tags as a table (CSV), which :mod:`locatk.formats.importers.floors.site_csv` reads.

The columns are ``id``, ``x_mm``, ``y_mm``, ``heading_deg`` and ``meaning``. Positions are exact to
:data:`~locatk.core.polaris.design.site.POSITION_DECIMALS`.
"""

from __future__ import annotations

import csv
import io
import math

from locatk.core.polaris.design.site import POSITION_DECIMALS
from locatk.core.polaris.tag import Tags
from locatk.core.printable import spreadsheet_text
from locatk.core.units import mm_text

HEADER = ("id", "x_mm", "y_mm", "heading_deg", "meaning")


def dumps_csv(tags: Tags) -> str:
    """Return the table of a site in the order of the ids; the same site gives the same text."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(HEADER)
    for tag_id, pose in sorted(tags.site.items()):
        position = (mm_text(value, POSITION_DECIMALS - 3) for value in (pose.x_m, pose.y_m))
        meaning = spreadsheet_text(tags.meanings.get(tag_id, ""))
        writer.writerow((tag_id, *position, f"{math.degrees(pose.heading_rad):.15g}", meaning))
    return stream.getvalue()
