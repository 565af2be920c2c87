"""Drawings at true size as PDF, and as SVG for vector editors and laser cutters.

Width and height of an SVG are in mm and its user unit is 1 mm, so that Inkscape and laser cutters
import it at true size. Text remains text, and each tag is a group named by its id.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from xml.etree import ElementTree as Xml

from reportlab.lib.units import mm
from reportlab.pdfgen.canvas import Canvas

from locatk.core.drawing import MM_PER_POINT, Circle, Line, Mark, Page, Point, Text
from locatk.core.landmarks.drawing.true_size import FloorPage
from locatk.formats.printing import page

SMALLER_PAPER_HINT = "Use a smaller paper"
"""Remedy for a page that is longer than a PDF may be."""

SVG_NAMESPACE = "http://www.w3.org/2000/svg"

SVG_FONT = "Helvetica, Arial, 'Liberation Sans', sans-serif"


def render_pages(
    pages: Sequence[Page],
    title: str,
    *,
    hint: str = SMALLER_PAPER_HINT,
    done: Callable[[], object] = lambda: None,
) -> bytes:
    """Render drawings as a PDF that viewers print at 100 %.

    The same pages give the same bytes. ``done`` is called after each page.

    Raises
    ------
    InputError
        A page is longer than a PDF may be; ``hint`` is the remedy.
    """
    drawers = [(drawing.size_mm, partial(_draw_page, drawing)) for drawing in pages]
    return _render(drawers, title, hint, done)


def render_floor(
    pages: Sequence[FloorPage], title: str, *, done: Callable[[], object] = lambda: None
) -> bytes:
    """Render a floor at true size as a PDF, one page a tile, with rulers and joining marks.

    See :func:`render_pages`.
    """
    drawers = [(floor_page.size_mm, partial(_draw_tile, floor_page)) for floor_page in pages]
    return _render(drawers, title, SMALLER_PAPER_HINT, done)


def _render(
    drawers: Iterable[tuple[Point, Callable[[Canvas], None]]],
    title: str,
    hint: str,
    done: Callable[[], object],
) -> bytes:
    """Render pages, each given by its size and by the function that draws it."""
    stream = io.BytesIO()
    canvas = page.open_document(stream, title)
    for size_mm, draw in drawers:
        page.start_page(canvas, size_mm, hint=hint)
        draw(canvas)
        canvas.showPage()
        done()
    canvas.save()
    return stream.getvalue()


def _draw_page(drawing: Page, canvas: Canvas) -> None:
    for group in drawing.groups:
        page.draw(canvas, group.marks)


def _draw_tile(floor_page: FloorPage, canvas: Canvas) -> None:
    """Draw the marks of a tile, clipped to its box, and the margin around it."""
    left, bottom, right, top = floor_page.tile.box
    canvas.saveState()
    path = canvas.beginPath()
    path.rect(left * mm, bottom * mm, (right - left) * mm, (top - bottom) * mm)
    canvas.clipPath(path, stroke=0, fill=0)
    page.draw(canvas, floor_page.marks)
    canvas.restoreState()
    box = page.Box(left, bottom, right, top)
    page.draw_margin(canvas, box, floor_page.notes, floor_page.tile.seams, marks=True, crop=False)


# ---- SVG


def render_svg(page: Page, title: str) -> bytes:
    """Render one drawing as SVG; the same drawing gives the same bytes."""
    width, height = page.size_mm
    root = Xml.Element(
        "svg",
        xmlns=SVG_NAMESPACE,
        width=f"{_number(width)}mm",
        height=f"{_number(height)}mm",
        viewBox=f"0 0 {_number(width)} {_number(height)}",
    )
    Xml.SubElement(root, "title").text = title
    root_group = Xml.SubElement(
        root, "g", {"fill": "none", "stroke": "black", "font-family": SVG_FONT}
    )
    for group in page.groups:
        element = Xml.SubElement(root_group, "g", id=group.name)
        for mark in group.marks:
            _add_mark(element, mark, height)
    Xml.indent(root)
    data: bytes = Xml.tostring(root, encoding="utf-8", xml_declaration=True)
    return data + b"\n"


def _add_mark(group: Xml.Element, mark: Mark, height: float) -> None:
    """Add one mark; the y axis of SVG points down."""

    def point(position: Point) -> tuple[str, str]:
        return _number(position[0]), _number(height - position[1])

    if isinstance(mark, Text):
        _add_text(group, mark, *point(mark.position))
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


def _add_text(group: Xml.Element, label: Text, x: str, y: str) -> None:
    style = {"x": x, "y": y, "fill": "black", "stroke": "none"}
    style["font-size"] = _number(label.points * MM_PER_POINT)
    if label.anchor != "start":
        style["text-anchor"] = label.anchor
    if label.bold:
        style["font-weight"] = "bold"
    if label.angle_deg:
        style["transform"] = f"rotate({_number(-label.angle_deg)} {x} {y})"
    Xml.SubElement(group, "text", style).text = label.text


def _number(value: float) -> str:
    """Format a length to 0.1 um, without trailing zeros."""
    text = f"{value:.4f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text
