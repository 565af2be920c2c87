"""Placement templates of tags as SVG: a page a file.

Width and height are in mm and the user unit is 1 mm, so that Inkscape and laser cutters take
it at true size. Text stays text, and each tag is a group named by its id.
"""

from __future__ import annotations

from xml.etree import ElementTree as Xml

from locatk.core.drawing import MM_PER_POINT, Circle, Line, Mark, Page, Point, Text

NAMESPACE = "http://www.w3.org/2000/svg"

_FONT = "Helvetica, Arial, 'Liberation Sans', sans-serif"


def render(page: Page, title: str) -> bytes:
    """An SVG of one drawing; the same drawing gives the same bytes."""
    width, height = page.size_mm
    root = Xml.Element(
        "svg",
        xmlns=NAMESPACE,
        width=f"{_number(width)}mm",
        height=f"{_number(height)}mm",
        viewBox=f"0 0 {_number(width)} {_number(height)}",
    )
    Xml.SubElement(root, "title").text = title
    ink = Xml.SubElement(root, "g", {"fill": "none", "stroke": "black", "font-family": _FONT})
    for group in page.groups:
        within = Xml.SubElement(ink, "g", id=group.name)
        for mark in group.marks:
            _add(within, mark, height)
    Xml.indent(root)
    data: bytes = Xml.tostring(root, encoding="utf-8", xml_declaration=True)
    return data + b"\n"


def _add(group: Xml.Element, mark: Mark, height: float) -> None:
    """One mark; SVG's y points down."""

    def point(at: Point) -> tuple[str, str]:
        return _number(at[0]), _number(height - at[1])

    if isinstance(mark, Text):
        _add_words(group, mark, *point(mark.position))
        return
    stroke = {"stroke-width": _number(mark.width_mm)}
    if isinstance(mark, Line):
        (x1, y1), (x2, y2) = point(mark.start), point(mark.end)
        if mark.dash_mm is not None:
            stroke["stroke-dasharray"] = _number(mark.dash_mm)
        Xml.SubElement(group, "line", {"x1": x1, "y1": y1, "x2": x2, "y2": y2, **stroke})
    elif isinstance(mark, Circle):
        x, y = point(mark.centre)
        Xml.SubElement(group, "circle", {"cx": x, "cy": y, "r": _number(mark.radius_mm), **stroke})
    else:
        points = " ".join(",".join(point(corner)) for corner in mark.corners)
        style = {"fill": "black", "stroke": "none"} if mark.filled else stroke
        Xml.SubElement(group, "polygon", {"points": points, **style})


def _add_words(group: Xml.Element, words: Text, x: str, y: str) -> None:
    style = {"x": x, "y": y, "fill": "black", "stroke": "none"}
    style["font-size"] = _number(words.points * MM_PER_POINT)
    if words.anchor != "start":
        style["text-anchor"] = words.anchor
    if words.bold:
        style["font-weight"] = "bold"
    if words.angle_deg:
        style["transform"] = f"rotate({_number(-words.angle_deg)} {x} {y})"
    Xml.SubElement(group, "text", style).text = words.text


def _number(value: float) -> str:
    """To 0.1 um, without zeros that say nothing."""
    text = f"{value:.4f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text
