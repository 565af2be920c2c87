"""Sites of tags as drawings of a floor, for CAD (DXF) and plotters (SVG).

Layers in CAD: TAGS (the square of each tag with an arrow along its x axis), MAGNETS (outlines, with
an arrow to the north pole), CENTRES (a point each), LABELS (id and meaning). A tag is an insert of
the block ``TAG_<id>`` in layer TAGS with the attributes ID and MEANING, rotated by its heading.
Layers in SVG: tags, their centres, labels. Magnets are drawn as designed, not as built.
"""

from __future__ import annotations

from locatk.core.drawing import CAPITAL_HEIGHT_EM, MM_PER_POINT, text_width
from locatk.core.polaris.drawing.outline import tag_magnets, tag_outline, tag_side
from locatk.core.polaris.tag import Tags
from locatk.formats.exporters.floors.floor_drawing import FloorDrawing, Layer, Placement, Shape

TAGS, MAGNETS = Layer("TAGS", 7), Layer("MAGNETS", 1)

GROUP = "tags"

LABEL_FRACTION = 1 / 8
"""Height of the labels as a fraction of the side of a tag."""

MAX_LABEL_HEIGHT_MM = 20.0


def draw_site(tags: Tags) -> FloorDrawing:
    """Return the drawing of a site, with a margin for outlines and labels around the centres."""
    side = tag_side(tags)
    height = min(MAX_LABEL_HEIGHT_MM, LABEL_FRACTION * side)
    outline = tuple(tag_outline(tags))
    placements = []
    for tag_id, pose in sorted(tags.site.items()):
        meaning = tags.meanings.get(tag_id, "")
        shape = Shape(
            f"TAG_{tag_id}",
            GROUP,
            ((TAGS, outline), (MAGNETS, tuple(tag_magnets(tags, tag_id)))),
            letter_height_mm=height,
        )
        placements.append(
            Placement(
                f"tag{tag_id}",
                shape,
                (1e3 * pose.x_m, 1e3 * pose.y_m),
                pose.heading_rad,
                f"{tag_id} {meaning}".strip(),
                (("ID", str(tag_id)), ("MEANING", meaning)),
            )
        )
    x, y = zip(*(placement.position_mm for placement in placements), strict=True)
    longest = max((placement.label for placement in placements), key=len)
    label_width = text_width(longest, height / (CAPITAL_HEIGHT_EM * MM_PER_POINT))
    margin = max(side, label_width / 2)
    return FloorDrawing(
        "Tags",
        (min(x) - margin, min(y) - side, max(x) + margin, max(y) + side),
        (GROUP,),
        tuple(placements),
        (),
        height,
        # Below the arrow, whichever direction it has.
        0.8 * side,
    )
