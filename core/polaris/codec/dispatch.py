"""Ids and layouts: the one door to the three codecs of a tag.

``mosk`` counts everything that a tag can say, ``redundant`` gives up places and four magnets
for errors it corrects, ``polaris-released`` is the table of the published recordings.
"""

from __future__ import annotations

from itertools import pairwise
from types import ModuleType

from locatk.core.errors import InputError
from locatk.core.polaris.codec import mosk, released
from locatk.core.polaris.codec import redundant as redundancy
from locatk.core.polaris.tag import TagLayout, Tags, vertices

MODULES: dict[str, ModuleType] = {
    "mosk": mosk,
    "redundant": redundancy,
    "polaris-released": released,
}
"""By name; each has ``check``, ``capacity``, ``layout`` and ``tag_id``."""


def check_design(tags: Tags) -> None:
    """Refuse a design that no tag can have.

    Raises
    ------
    InputError
        The order, the number of magnets or of orientations cannot be; there is no such
        codec; or the codec does not take them.
    """
    if tags.order < 2:
        raise InputError(f"order {tags.order} is no grid", hint="Use an order of at least 2")
    most = tags.order**2 - 1
    if not 3 <= tags.magnets <= most:
        raise InputError(
            f"{tags.magnets} magnets on a grid of order {tags.order}",
            hint=f"It takes 3 to {most}: three on corners, the fourth corner stays empty",
        )
    if tags.orientations < 2:
        raise InputError(
            f"{tags.orientations} orientations say nothing", hint="Use at least 2 orientations"
        )
    if tags.codec not in MODULES:
        raise InputError(f"no codec {tags.codec!r}", hint=f"Known codecs: {', '.join(MODULES)}")
    MODULES[tags.codec].check(tags)


def capacity(tags: Tags) -> int:
    """Number of ids of the codec, whatever the family has of them.

    Raises
    ------
    InputError
        See :func:`check_design`.
    """
    check_design(tags)
    result: int = MODULES[tags.codec].capacity(tags)
    return result


def layout_of(tags: Tags, tag_id: int) -> TagLayout:
    """Cells and orientations of an id.

    Raises
    ------
    InputError
        The codec has no such id; see also :func:`check_design`.
    """
    count = capacity(tags)
    if not 0 <= tag_id < count:
        raise InputError(
            f"id {tag_id} is not in 0..{count - 1}",
            hint=f"{count} ids have order {tags.order}, {tags.magnets} magnets, "
            f"{tags.orientations} orientations, codec '{tags.codec}'",
        )
    result: TagLayout = MODULES[tags.codec].layout(tags, tag_id)
    return result


def id_of(tags: Tags, layout: TagLayout) -> int:
    """The id of a layout; the inverse of :func:`layout_of`.

    Raises
    ------
    InputError
        The layout is no tag of this design, or the codec has no id for it; see also
        :func:`check_design`.
    """
    check_design(tags)
    _check_layout(tags, layout)
    result: int = MODULES[tags.codec].tag_id(tags, layout)
    return result


def _check_layout(tags: Tags, layout: TagLayout) -> None:
    cells, symbols = layout.cells, layout.symbols
    if len(cells) != tags.magnets or len(symbols) != tags.magnets:
        raise InputError(
            f"{len(cells)} cells and {len(symbols)} orientations for {tags.magnets} magnets"
        )
    keys = [mosk.row_first(cell) for cell in cells]
    if any(one >= other for one, other in pairwise(keys)):
        raise InputError("the cells of a layout stand row by row from v1, columns ascending")
    if not all(0 <= index < tags.order for cell in cells for index in cell):
        raise InputError(f"a cell lies outside the grid of order {tags.order}")
    *corners, empty = vertices(tags.order)
    if not set(corners) <= set(cells):
        raise InputError("three magnets of each tag lie on the corners v1, v2 and v3")
    if empty in cells:
        raise InputError(f"the corner v4, cell {empty}, stays empty")
    if not all(0 <= symbol < tags.orientations for symbol in symbols):
        raise InputError(f"an orientation is not in 0..{tags.orientations - 1}")
