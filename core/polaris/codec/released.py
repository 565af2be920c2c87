"""The codec of the released Polaris code: its own table of 18 bits, K = 3, M = 5, P = 8.

So that the published recordings read as their published ids (facts/polaris.md section 1). It
knows eight of the ten placements. The id in binary: three bits for the orientation of each
magnet, row by row from v1, then three for the placement.
"""

from __future__ import annotations

from locatk.core.errors import InputError
from locatk.core.polaris.tag import Cell, TagLayout, Tags

POSITIONS: tuple[Cell, ...] = ((0, 0), (1, 0), (0, 1), (1, 1), (2, 1), (0, 2), (1, 2), (2, 2))
"""Cells by the released code's number less one; v4 = (2, 0) has none."""

ORIENTATIONS = (0b111, 0b110, 0b010, 0b011, 0b001, 0b000, 0b100, 0b101)
"""Bits of each orientation: a cyclic Gray code."""

PLACEMENTS: tuple[tuple[int, ...], ...] = (
    (1, 2, 3, 6, 8),
    (1, 2, 4, 6, 8),
    (1, 2, 5, 6, 8),
    (1, 2, 6, 7, 8),
    (1, 3, 4, 6, 8),
    (1, 3, 5, 6, 8),
    (1, 3, 6, 7, 8),
    (1, 4, 5, 6, 8),
)
"""Numbers of the occupied positions, by the placement's bits 000 to 111."""

CELLS = tuple(tuple(POSITIONS[number - 1] for number in taken) for taken in PLACEMENTS)


def check(tags: Tags) -> None:
    """Refuse a design that the released table does not know.

    Raises
    ------
    InputError
        It is not K = 3, M = 5, P = 8.
    """
    if (tags.order, tags.magnets, tags.orientations) != (3, 5, 8):
        raise InputError(
            "codec 'polaris-released' knows 5 magnets in 8 orientations on a grid of order 3 only, "
            f"not {tags.magnets} in {tags.orientations} on order {tags.order}",
            hint="Use codec 'mosk'",
        )


def capacity(tags: Tags) -> int:
    """2^18 ids."""
    return 1 << 18


def layout(tags: Tags, tag_id: int) -> TagLayout:
    """Cells and orientations of an id in ``0 .. 2^18 - 1``."""
    groups = (tag_id >> shift & 0b111 for shift in (15, 12, 9, 6, 3))
    return TagLayout(CELLS[tag_id & 0b111], tuple(ORIENTATIONS.index(bits) for bits in groups))


def tag_id(tags: Tags, layout: TagLayout) -> int:
    """The id of a layout; the inverse of :func:`layout`.

    Raises
    ------
    InputError
        It is one of the two placements that the released table does not have.
    """
    if layout.cells not in CELLS:
        raise InputError(
            f"codec 'polaris-released' has no id for magnets in the cells {list(layout.cells)}",
            hint="Use codec 'mosk', which knows all placements",
        )
    result = 0
    for symbol in layout.symbols:
        result = result << 3 | ORIENTATIONS[symbol]
    return result << 3 | CELLS.index(layout.cells)
