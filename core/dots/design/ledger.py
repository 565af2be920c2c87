"""Which areas of the pattern are in use, and where the next sheet goes.

Two sheets that hold the same positions cannot be told apart, so each new one is given an
area that no other has. Areas of different codecs must not meet either: the codecs share
most of their digits, and read one another's sheets now and then (facts/dots.md 2.2).
"""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from locatk.core.dots.codec import SECTION_LENGTH, check_window
from locatk.core.dots.drawing.layout import Layout, manifest
from locatk.core.dots.drawing.tiles import Tiling
from locatk.core.dots.sheet import Manifest
from locatk.core.errors import InputError
from locatk.core.paper import paper_name

GAP = 64
"""Places left free around an area that is chosen here, so that a window on the rim of a
sheet is nowhere near another sheet."""

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,39}", re.ASCII)


@dataclass(frozen=True)
class Area:
    """An area in use.

    Attributes
    ----------
    id : str
        Of the sheet, or of the floor of tiles, that holds it.
    codec : str
    section : (u, v)
    origin : (x, y)
        Grid coordinates of its upper left place.
    size : (columns, rows)
    """

    id: str
    codec: str
    section: tuple[int, int]
    origin: tuple[int, int]
    size: tuple[int, int]

    def meets(self, other: Area) -> bool:
        """Whether both hold a place."""
        return self.section == other.section and all(
            a < b + n and b < a + m
            for a, m, b, n in zip(self.origin, self.size, other.origin, other.size, strict=True)
        )


def free_origins(
    areas: Iterable[Area], size: tuple[int, int], section: tuple[int, int] = (0, 0), count: int = 1
) -> list[tuple[int, int]]:
    """Upper left places of free areas: as far up as there is room, then as far left.

    At most ``count``, and at least one; fewer where a row of areas is full, below which
    the next call goes on.

    Raises
    ------
    InputError
        The section is full.
    """
    used = [area for area in areas if area.section == section]
    columns, rows = size
    for y in sorted({0} | {area.origin[1] + area.size[1] + GAP for area in used}):
        if y + rows > SECTION_LENGTH:
            break
        beside = [
            (area.origin[0], area.origin[0] + area.size[0])
            for area in used
            if area.origin[1] < y + rows + GAP and y < area.origin[1] + area.size[1] + GAP
        ]
        x, found = 0, list[tuple[int, int]]()
        for start, end in [*sorted(beside), (SECTION_LENGTH + GAP, SECTION_LENGTH)]:
            while x + columns + GAP <= start and len(found) < count:
                found.append((x, y))
                x += columns + GAP
            x = max(x, end + GAP)
        if found:
            return found
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
    """An area for each of several new sheets.

    Parameters
    ----------
    areas : sequence of Area
        Those in use.
    sizes : sequence of (columns, rows)
        One a sheet.
    prefixes : sequence of str
        One a sheet: sheets that have no name are numbered, ``A4-0001``.
    codec, section
        Of the new areas.
    name : str, optional
        Of the sheet; of several, ``name-1``, ``name-2`` and so on.
    origin : (x, y), optional
        Of the first; the next follow to its right. Otherwise each goes to the first free
        place (:func:`free_origins`).
    force : bool
        Hold positions that another sheet has, and take the name of one that is printed
        once more.

    Raises
    ------
    InputError
        A name or an area is in use, or cannot be one.
    """
    origins = (
        _free(areas, sizes, codec, section)
        if origin is None
        else [
            (origin[0] + sum(c + GAP for c, _ in sizes[:n]), origin[1]) for n in range(len(sizes))
        ]
    )
    numbers = Counter(
        {prefix: _highest(areas, prefix) for prefix in (set(prefixes) if name is None else ())}
    )
    new = []
    for n, (at, size, prefix) in enumerate(zip(origins, sizes, prefixes, strict=True), 1):
        check_window(at, size, section)
        if name is None:
            numbers[prefix] += 1
            given = f"{prefix}-{numbers[prefix]:04d}"
        else:
            given = name if len(sizes) == 1 else f"{name}-{n}"
        new.append(Area(given, codec, section, at, size))
        _check(new[-1], areas, force)
    return new


def _free(
    areas: Sequence[Area],
    sizes: Sequence[tuple[int, int]],
    codec: str,
    section: tuple[int, int],
) -> list[tuple[int, int]]:
    """An origin for each size; equal ones that follow each other are found at once."""
    used, origins = list(areas), []
    for size, group in itertools.groupby(sizes):
        missing = len(list(group))
        while missing:
            found = free_origins(used, size, section, missing)
            used += [Area("", codec, section, at, size) for at in found]
            origins += found
            missing -= len(found)
    return origins


def plan(
    items: Sequence[Layout | Tiling],
    areas: Sequence[Area],
    *,
    codec: str,
    section: tuple[int, int] = (0, 0),
    name: str | None = None,
    origin: tuple[int, int] | None = None,
    force: bool = False,
) -> tuple[list[Area], Manifest]:
    """New sheets of these layouts, which are on one raster: their areas and their manifest.

    A :class:`Tiling` is one area, a sheet a tile. The other parameters, and what is
    raised, are :func:`allocate`'s.
    """
    papers = [item.layout if isinstance(item, Tiling) else item for item in items]
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
    """Refuse what cannot be the id of a sheet: it names frames and files."""
    if not _NAME.fullmatch(name) or name == "floor":
        raise InputError(
            f"{name!r} cannot be the id of a sheet",
            hint="Use up to 40 letters, digits, dots, dashes and underscores, and not 'floor'",
        )


def _highest(areas: Iterable[Area], prefix: str) -> int:
    found = (re.fullmatch(re.escape(prefix) + r"-(\d{1,9})", area.id) for area in areas)
    return max((int(match[1]) for match in found if match), default=0)


def _check(area: Area, areas: Iterable[Area], force: bool) -> None:
    check_name(area.id)
    for other in areas:
        if other.id == area.id and not (force and other == area):
            raise InputError(
                f"a sheet {area.id!r} is in the ledger already", hint="Choose another --id"
            )
        if not force and area.meets(other):
            (x, y), (columns, rows) = other.origin, other.size
            raise InputError(
                f"the area at {area.origin[0]},{area.origin[1]} is in use: sheet {other.id!r} "
                f"holds {columns} x {rows} places at {x},{y}",
                hint="Choose another --origin, or add --force to print the same positions twice",
            )
