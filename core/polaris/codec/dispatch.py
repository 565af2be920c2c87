"""Conversion between ids and layouts by the codec that a design names.

``mosk`` numbers all layouts of a design. ``redundant`` fixes the cells and uses four magnets as
check symbols, so that it corrects errors. ``polaris-released`` is the table of the published
recordings.
"""

from __future__ import annotations

from itertools import pairwise
from types import ModuleType

from locatk.core.errors import InputError
from locatk.core.polaris.codec import mosk, redundant, released
from locatk.core.polaris.tag import TagLayout, Tags, vertices

CODEC_MODULES: dict[str, ModuleType] = {
    "mosk": mosk,
    "redundant": redundant,
    "polaris-released": released,
}
"""Modules of the codecs by name; each has ``check``, ``capacity``, ``layout`` and ``tag_id``."""


def check_design(tags: Tags) -> None:
    """Check that tags of a design exist.

    Raises
    ------
    InputError
        The order, the number of magnets or of orientations is impossible, the codec is unknown, or
        the codec does not support the design.
    """
    if tags.order < 2:
        raise InputError(f"order {tags.order} is no grid", hint="Use an order of at least 2")
    max_magnets = tags.order**2 - 1
    if not 3 <= tags.magnets <= max_magnets:
        raise InputError(
            f"{tags.magnets} magnets on a grid of order {tags.order}",
            hint=f"It takes 3 to {max_magnets}: three on corners, the fourth corner stays empty",
        )
    if tags.orientations < 2:
        raise InputError(
            f"{tags.orientations} orientations encode nothing", hint="Use at least 2 orientations"
        )
    if tags.codec not in CODEC_MODULES:
        raise InputError(
            f"no codec {tags.codec!r}", hint=f"Known codecs: {', '.join(CODEC_MODULES)}"
        )
    CODEC_MODULES[tags.codec].check(tags)


def capacity(tags: Tags) -> int:
    """Return the number of ids of the codec, of which a family has a part.

    Raises
    ------
    InputError
        See :func:`check_design`.
    """
    check_design(tags)
    result: int = CODEC_MODULES[tags.codec].capacity(tags)
    return result


def layout_of(tags: Tags, tag_id: int) -> TagLayout:
    """Return the cells and orientations of an id.

    Raises
    ------
    InputError
        The id is beyond the capacity of the codec; see also :func:`check_design`.
    """
    count = capacity(tags)
    if not 0 <= tag_id < count:
        raise InputError(
            f"id {tag_id} is not in 0..{count - 1}",
            hint=f"{count} ids have order {tags.order}, {tags.magnets} magnets, "
            f"{tags.orientations} orientations, codec '{tags.codec}'",
        )
    result: TagLayout = CODEC_MODULES[tags.codec].layout(tags, tag_id)
    return result


def id_of(tags: Tags, layout: TagLayout) -> int:
    """Return the id of a layout; the inverse of :func:`layout_of`.

    Raises
    ------
    InputError
        The layout is not one of this design, or the codec has no id for it; see also
        :func:`check_design`.
    """
    check_design(tags)
    _check_layout(tags, layout)
    result: int = CODEC_MODULES[tags.codec].tag_id(tags, layout)
    return result


def _check_layout(tags: Tags, layout: TagLayout) -> None:
    """Check number, order and positions of the cells, and the orientations of a layout."""
    cells, symbols = layout.cells, layout.symbols
    if len(cells) != tags.magnets or len(symbols) != tags.magnets:
        raise InputError(
            f"{len(cells)} cells and {len(symbols)} orientations for {tags.magnets} magnets"
        )
    keys = [mosk.row_major_key(cell) for cell in cells]
    if any(key >= next_key for key, next_key in pairwise(keys)):
        raise InputError("the cells of a layout are row by row from v1, columns ascending")
    if not all(0 <= index < tags.order for cell in cells for index in cell):
        raise InputError(f"a cell is outside of the grid of order {tags.order}")
    *corners, empty_corner = vertices(tags.order)
    if not set(corners) <= set(cells):
        raise InputError("three magnets of each tag are on the corners v1, v2 and v3")
    if empty_corner in cells:
        raise InputError(f"the corner v4, cell {empty_corner}, stays empty")
    if not all(0 <= symbol < tags.orientations for symbol in symbols):
        raise InputError(f"an orientation is not in 0..{tags.orientations - 1}")
