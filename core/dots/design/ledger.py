"""Allocation of areas of the pattern to new sheets.

Two sheets with the same positions cannot be distinguished, so that each new one is allocated an
area of its own. Areas of different codecs must not overlap either: the codecs share three of their
four sequences, so that a decoder of one accepts windows of another (of anoto by libdots, 6 x 6
dots, nearly all of them, one in 15 at a wrong position).
"""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from locatk.core.dots.codec import SECTION_LENGTH, check_window
from locatk.core.dots.drawing.layout import SheetLayout, manifest
from locatk.core.dots.drawing.tiles import SheetTiling
from locatk.core.dots.sheet import Manifest
from locatk.core.errors import InputError
from locatk.core.paper_sizes import paper_name

GAP_POSITIONS = 64
"""Positions left free around an allocated area, so that a window at the border of a sheet is far
from every other sheet."""

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,39}", re.ASCII)


@dataclass(frozen=True)
class Area:
    """Area of the pattern that is in use.

    Attributes
    ----------
    id : str
        Of its sheet, or of its floor of tiles.
    codec : str
    section : (u, v)
    origin : (x, y)
        Grid coordinates of its upper left position.
    size : (columns, rows)
    """

    id: str
    codec: str
    section: tuple[int, int]
    origin: tuple[int, int]
    size: tuple[int, int]

    def overlaps(self, other: Area) -> bool:
        """Return whether both contain a position."""
        return self.section == other.section and all(
            a < b + n and b < a + m
            for a, m, b, n in zip(self.origin, self.size, other.origin, other.size, strict=True)
        )


def free_origins(
    areas: Iterable[Area], size: tuple[int, int], section: tuple[int, int] = (0, 0), count: int = 1
) -> list[tuple[int, int]]:
    """Return the origins of free areas: as far up as possible, then as far left.

    The number is at most ``count`` and at least one; there are fewer if a row of areas is full, in
    which case the next call continues below.

    Raises
    ------
    InputError
        The section has no free area of this size.
    """
    used = [area for area in areas if area.section == section]
    columns, rows = size
    for y in sorted({0} | {area.origin[1] + area.size[1] + GAP_POSITIONS for area in used}):
        if y + rows > SECTION_LENGTH:
            break
        in_row = [
            (area.origin[0], area.origin[0] + area.size[0])
            for area in used
            if area.origin[1] < y + rows + GAP_POSITIONS
            and y < area.origin[1] + area.size[1] + GAP_POSITIONS
        ]
        x, origins = 0, list[tuple[int, int]]()
        section_end = (SECTION_LENGTH + GAP_POSITIONS, SECTION_LENGTH)
        for start, end in [*sorted(in_row), section_end]:
            while x + columns + GAP_POSITIONS <= start and len(origins) < count:
                origins.append((x, y))
                x += columns + GAP_POSITIONS
            x = max(x, end + GAP_POSITIONS)
        if origins:
            return origins
    raise InputError(
        f"no free area of {columns} x {rows} places in section {section[0]},{section[1]}",
        hint="Choose another --section",
    )


def allocate(
    areas: Sequence[Area],
    sizes: Sequence[tuple[int, int]],
    *,
    prefixes: Sequence[str],
    codec: str,
    section: tuple[int, int] = (0, 0),
    name: str | None = None,
    origin: tuple[int, int] | None = None,
    force: bool = False,
) -> list[Area]:
    """Allocate an area for each of several new sheets.

    Parameters
    ----------
    areas : sequence of Area
        Areas in use.
    sizes : sequence of (columns, rows)
        One per sheet.
    prefixes : sequence of str
        One per sheet: sheets without a name are numbered, ``A4-0001``.
    codec, section
        Of the new areas.
    name : str, optional
        Of the sheet; of several, ``name-1``, ``name-2`` and so on.
    origin : (x, y), optional
        Of the first; the next follow on its right. Default: the first free areas
        (:func:`free_origins`).
    force : bool
        Allow positions of another sheet, and the name of a sheet that is printed again.

    Raises
    ------
    InputError
        A name or an area is in use or invalid.
    """
    origins = (
        _allocate_free(areas, sizes, codec, section)
        if origin is None
        else [
            (origin[0] + sum(c + GAP_POSITIONS for c, _ in sizes[:n]), origin[1])
            for n in range(len(sizes))
        ]
    )
    numbers = Counter(
        {
            prefix: _highest_number(areas, prefix)
            for prefix in (set(prefixes) if name is None else ())
        }
    )
    new = []
    for n, (at, size, prefix) in enumerate(zip(origins, sizes, prefixes, strict=True), 1):
        check_window(at, size, section)
        if name is None:
            numbers[prefix] += 1
            sheet_id = f"{prefix}-{numbers[prefix]:04d}"
        else:
            sheet_id = name if len(sizes) == 1 else f"{name}-{n}"
        new.append(Area(sheet_id, codec, section, at, size))
        _check_free(new[-1], areas, force)
    return new


def _allocate_free(
    areas: Sequence[Area],
    sizes: Sequence[tuple[int, int]],
    codec: str,
    section: tuple[int, int],
) -> list[tuple[int, int]]:
    """Return a free origin for each size; runs of equal sizes are allocated at once."""
    used, origins = list(areas), []
    for size, group in itertools.groupby(sizes):
        missing = len(list(group))
        while missing:
            free = free_origins(used, size, section, missing)
            used += [Area("", codec, section, at, size) for at in free]
            origins += free
            missing -= len(free)
    return origins


def plan(
    items: Sequence[SheetLayout | SheetTiling],
    areas: Sequence[Area],
    *,
    codec: str,
    section: tuple[int, int] = (0, 0),
    name: str | None = None,
    origin: tuple[int, int] | None = None,
    force: bool = False,
) -> tuple[list[Area], Manifest]:
    """Plan new sheets of layouts on one raster; return their areas and their manifest.

    A :class:`~locatk.core.dots.drawing.tiles.SheetTiling` is one area with one sheet per tile. The
    other parameters and the errors are those of :func:`allocate`.
    """
    papers = [item.layout if isinstance(item, SheetTiling) else item for item in items]
    new = allocate(
        areas,
        [item.size for item in items],
        prefixes=[paper_name(paper.page_mm) for paper in papers],
        codec=codec,
        section=section,
        name=name,
        origin=origin,
        force=force,
    )
    sheets = [
        sheet
        for item, area in zip(items, new, strict=True)
        for sheet in item.sheets(area.id, area.origin, area.section)
    ]
    return new, manifest(papers[0].raster, sheets, codec)


def check_name(name: str) -> None:
    """Raise InputError unless ``name`` can be the id of a sheet, which names frames and files."""
    if not _NAME.fullmatch(name) or name == "floor":
        raise InputError(
            f"{name!r} cannot be the id of a sheet",
            hint="Use up to 40 letters, digits, dots, dashes and underscores, and not 'floor'",
        )


def _highest_number(areas: Iterable[Area], prefix: str) -> int:
    """Return the highest number of a sheet with this prefix, 0 if there is none."""
    matches = (re.fullmatch(re.escape(prefix) + r"-(\d{1,9})", area.id) for area in areas)
    return max((int(match[1]) for match in matches if match), default=0)


def _check_free(area: Area, areas: Iterable[Area], force: bool) -> None:
    """Raise InputError if the name or a position of an area is in use."""
    check_name(area.id)
    for other in areas:
        if other.id == area.id and not (force and other == area):
            raise InputError(
                f"a sheet {area.id!r} is in the ledger already", hint="Choose another --id"
            )
        if not force and area.overlaps(other):
            (x, y), (columns, rows) = other.origin, other.size
            raise InputError(
                f"the area at {area.origin[0]},{area.origin[1]} is in use: sheet {other.id!r} "
                f"holds {columns} x {rows} places at {x},{y}",
                hint="Choose another --origin, or add --force to print the same positions twice",
            )
