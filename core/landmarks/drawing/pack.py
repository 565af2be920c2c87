"""Installation pack of a floor: all pages that a person needs to place its magnets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from locatk.core.drawing import Page, Point
from locatk.core.drawing.pages import (
    UnnumberedPage,
    check_margin,
    number_pages,
    printable,
    text_paper,
)
from locatk.core.errors import InputError
from locatk.core.landmarks.design.materials import bill_of_materials
from locatk.core.landmarks.drawing.landmark import check_buildable
from locatk.core.landmarks.drawing.plan import draw_plan
from locatk.core.landmarks.drawing.templates import PlacedTemplate, draw_templates
from locatk.core.landmarks.drawing.texts import bill_pages, checklist_pages, marking_list_pages
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.materials import BillItem

PACK_PARTS = ("plan", "templates", "materials", "checklist", "list")
"""Parts of a pack, in the order of their pages."""

MAX_PAGES = 500
"""Largest number of pages of a pack."""


@dataclass(frozen=True)
class InstallationPack:
    """Pages of an installation pack.

    Attributes
    ----------
    pages : tuple of Page
    parts : dict of str to (int, int)
        First page, counted from 0, and the page after the last one of each part.
    templates : tuple of PlacedTemplate
        Their pages are counted from the beginning of the pack.
    """

    pages: tuple[Page, ...]
    parts: dict[str, tuple[int, int]]
    templates: tuple[PlacedTemplate, ...]


def draw_installation_pack(
    floor: FloorMap,
    paper_mm: Point,
    *,
    parts: Sequence[str] = PACK_PARTS,
    paper_name: str = "",
    margin_mm: float = 10.0,
    items: Sequence[BillItem] | None = None,
) -> InstallationPack:
    """Draw the installation pack of a floor as designed, not as built.

    Parameters
    ----------
    floor : FloorMap
    paper_mm : (width, height)
        Paper of plan and templates, and also of the pages of text if it is not larger than A3.
    parts : sequence of str
        Parts to draw, of :data:`PACK_PARTS`.
    paper_name : str
        Name of the paper in error messages.
    margin_mm : float
    items : sequence of BillItem, optional
        Bill of materials, by default that of the floor with the usual spares.

    Raises
    ------
    InputError
        Bars overlap or there are none, a template is larger than the paper, or there are more
        than :data:`MAX_PAGES` pages.
    """
    check_buildable(floor)
    check_margin(paper_mm, margin_mm)
    title = printable(floor.name) or "Landmarks"
    text_paper_mm = text_paper(paper_mm)
    pages: list[UnnumberedPage] = []
    page_ranges: dict[str, tuple[int, int]] = {}
    templates: list[PlacedTemplate] = []
    for part in PACK_PARTS:
        if part not in parts:
            continue
        first = len(pages)
        if part == "plan":
            pages += draw_plan(floor, title, paper_mm, margin_mm)
        elif part == "templates":
            drawn, placed = draw_templates(floor, title, paper_mm, margin_mm, paper_name)
            pages += drawn
            templates = [replace(item, page=item.page + first) for item in placed]
        elif part == "materials":
            items = bill_of_materials(floor) if items is None else items
            pages += bill_pages(floor, items, title, text_paper_mm, margin_mm)
        elif part == "checklist":
            pages += checklist_pages(floor, title, text_paper_mm, margin_mm)
        else:
            pages += marking_list_pages(floor, title, text_paper_mm, margin_mm)
        page_ranges[part] = (first, len(pages))
    if len(pages) > MAX_PAGES:
        raise InputError(
            f"the pack takes {len(pages)} pages; at most {MAX_PAGES} are possible",
            hint="Use a larger paper, or the templates and an exported list of the map",
        )
    return InstallationPack(number_pages(pages), page_ranges, tuple(templates))
