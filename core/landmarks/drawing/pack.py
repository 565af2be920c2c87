"""The installation pack of a floor: all that a person needs who lays its magnets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from locatk.core.drawing import Page, Point
from locatk.core.errors import InputError
from locatk.core.landmarks.design.materials import SPARES_PERCENT, bill
from locatk.core.landmarks.drawing.landmark import check
from locatk.core.landmarks.drawing.page import Leaf, bind, check_margin, printable
from locatk.core.landmarks.drawing.plan import plan_leaves
from locatk.core.landmarks.drawing.templates import PlacedTemplate, template_leaves
from locatk.core.landmarks.drawing.texts import bill_leaves, checklist_leaves, list_leaves
from locatk.core.landmarks.map.floor import FloorMap

PARTS = ("plan", "templates", "materials", "checklist", "list")
"""In the order of the pages."""

MOST_PAGES = 500

_LARGEST_WORDS_MM2 = 297.0 * 420.0
_WORDS_MM = (210.0, 297.0)
"""Words are no larger on a large paper: they go on A4 then."""


@dataclass(frozen=True)
class Pack:
    """An installation pack.

    Attributes
    ----------
    pages : tuple of Page
    parts : dict of str to (int, int)
        First page, counted from 0, and the one after the last, of each part.
    templates : tuple of PlacedTemplate
        Their pages are those of the whole pack.
    """

    pages: tuple[Page, ...]
    parts: dict[str, tuple[int, int]]
    templates: tuple[PlacedTemplate, ...]


def pack(
    floor: FloorMap,
    paper_mm: Point,
    *,
    parts: Sequence[str] = PARTS,
    paper_name: str = "",
    margin_mm: float = 10.0,
    spares_percent: float = SPARES_PERCENT,
) -> Pack:
    """An installation pack, as designed, not as built.

    Parameters
    ----------
    floor : FloorMap
    paper_mm : (width, height)
        Of plan and templates, and of the words where it is no larger than A3.
    parts : sequence of str
        Some of :data:`PARTS`.
    paper_name : str
        For what is said of a paper that is too small.
    margin_mm, spares_percent : float

    Raises
    ------
    InputError
        Bars overlap or there are none, a template is larger than the paper, or there are
        more than :data:`MOST_PAGES` pages.
    """
    check(floor)
    check_margin(paper_mm, margin_mm)
    title = printable(floor.name) or "Landmarks"
    large = paper_mm[0] * paper_mm[1] > _LARGEST_WORDS_MM2 * 1.001
    small = _WORDS_MM if large else paper_mm
    leaves: list[Leaf] = []
    found: dict[str, tuple[int, int]] = {}
    templates: tuple[PlacedTemplate, ...] = ()
    for part in PARTS:
        if part not in parts:
            continue
        first = len(leaves)
        if part == "plan":
            leaves += plan_leaves(floor, title, paper_mm, margin_mm)
        elif part == "templates":
            drawn, placed = template_leaves(floor, title, paper_mm, margin_mm, paper_name)
            templates = tuple(replace(item, page=item.page + first) for item in placed)
            leaves += drawn
        elif part == "materials":
            leaves += bill_leaves(floor, bill(floor, spares_percent), title, small, margin_mm)
        elif part == "checklist":
            leaves += checklist_leaves(floor, title, small, margin_mm)
        else:
            leaves += list_leaves(floor, title, small, margin_mm)
        found[part] = (first, len(leaves))
    if len(leaves) > MOST_PAGES:
        raise InputError(
            f"the pack would take {len(leaves)} pages, and {MOST_PAGES} are the most",
            hint="Use a larger paper, or the templates and an exported list of the map",
        )
    return Pack(bind(leaves), found, templates)
