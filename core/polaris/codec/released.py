"""Codec of the released Polaris program: a table of 18 bits for K = 3, M = 5, P = 8.

With it the published recordings have their published ids. The table is that of the offline decoder
(``Evaluation/sensing_offline.py`` in https://github.com/wjk5117/Polaris, commit 8a232bc). It has
eight of the ten placements. The binary id is three bits for the orientation of each magnet, row by
row from v1, followed by three bits for the placement.
"""

from __future__ import annotations

from locatk.core.errors import InputError
from locatk.core.polaris.tag import Cell, TagLayout, Tags

NUMBERED_CELLS: tuple[Cell, ...] = ((0, 0), (1, 0), (0, 1), (1, 1), (2, 1), (0, 2), (1, 2), (2, 2))
"""Cells in the order of the released program's numbers, from 1; v4 = (2, 0) has no number."""

ORIENTATION_BITS = (0b111, 0b110, 0b010, 0b011, 0b001, 0b000, 0b100, 0b101)
"""Bits of the orientations 0 to 7: a cyclic Gray code."""

PLACEMENT_NUMBERS: tuple[tuple[int, ...], ...] = (
    (1, 2, 3, 6, 8),
    (1, 2, 4, 6, 8),
    (1, 2, 5, 6, 8),
    (1, 2, 6, 7, 8),
    (1, 3, 4, 6, 8),
    (1, 3, 5, 6, 8),
    (1, 3, 6, 7, 8),
    (1, 4, 5, 6, 8),
)
"""Numbers of the occupied cells, for the placement bits 000 to 111."""

PLACEMENT_CELLS = tuple(
    tuple(NUMBERED_CELLS[number - 1] for number in numbers) for numbers in PLACEMENT_NUMBERS
)
"""Occupied cells, for the placement bits 000 to 111."""

ID_BITS = 18
"""Bits of an id: three for each of five magnets, and three for the placement."""


def check(tags: Tags) -> None:
    """Check that the released table has the design.

    Raises
    ------
    InputError
        The design is not K = 3, M = 5, P = 8.
    """
    if (tags.order, tags.magnets, tags.orientations) != (3, 5, 8):
        raise InputError(
            "codec 'polaris-released' has 5 magnets in 8 orientations on a grid of order 3 only, "
            f"not {tags.magnets} in {tags.orientations} on order {tags.order}",
            hint="Use codec 'mosk'",
        )


def capacity(tags: Tags) -> int:
    """Return the number of ids, 2^18."""
    return 1 << ID_BITS


def layout(tags: Tags, tag_id: int) -> TagLayout:
    """Return the cells and orientations of an id in ``0 .. 2^18 - 1``."""
    groups = (tag_id >> shift & 0b111 for shift in (15, 12, 9, 6, 3))
    symbols = tuple(ORIENTATION_BITS.index(bits) for bits in groups)
    return TagLayout(PLACEMENT_CELLS[tag_id & 0b111], symbols)


def tag_id(tags: Tags, layout: TagLayout) -> int:
    """Return the id of a layout; the inverse of :func:`layout`.

    Raises
    ------
    InputError
        The placement is one of the two that the released table does not have.
    """
    if layout.cells not in PLACEMENT_CELLS:
        raise InputError(
            f"codec 'polaris-released' has no id for magnets in the cells {list(layout.cells)}",
            hint="Use codec 'mosk', which has all placements",
        )
    result = 0
    for symbol in layout.symbols:
        result = result << 3 | ORIENTATION_BITS[symbol]
    return result << 3 | PLACEMENT_CELLS.index(layout.cells)
