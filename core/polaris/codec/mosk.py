"""Magnetic orientation-shift keying: ids from placement and orientations of the magnets.

The layout is that of the Polaris paper (ACM MobiCom 2024, section 5,
https://wjk5117.github.io/projects/polaris_project/): three magnets are on v1, v2 and v3, v4 stays
empty, and the other ``M - 3`` magnets are on some of the ``K^2 - 4`` free cells. The paper gives
the number of layouts (eq. 1) but no numbering. Here the ids have no gaps::

    id = placement * P^M + digit_1 * P^(M-1) + ... + digit_M

- ``placement`` is the rank of the set of occupied free cells in lexicographic order
  (combinatorial number system). Cells are numbered as :func:`~locatk.core.polaris.tag.free_cells`
  lists them: the first cells are placement 0 and the last cells the last placement.
- ``digit_i`` is the Gray digit (:func:`gray_digits`) of the orientation of the i-th magnet of the
  layout, row by row from v1, columns ascending.

If P is a power of two, the binary id is the placement followed by one Gray word for each magnet,
and an orientation misread by one step changes one bit of it.
"""

from __future__ import annotations

import functools
import math

from locatk.core.errors import InputError
from locatk.core.polaris.tag import Cell, TagLayout, Tags, free_cells, vertices


def check(tags: Tags) -> None:
    """Accept every order, number of magnets and of orientations that a tag can have."""


def capacity(tags: Tags) -> int:
    """Return the number of ids, ``P^M * binomial(K^2 - 4, M - 3)`` (Polaris paper, eq. 1)."""
    placements = math.comb(tags.order**2 - 4, tags.magnets - 3)
    return tags.orientations**tags.magnets * placements


def layout(tags: Tags, tag_id: int) -> TagLayout:
    """Return the cells and orientations of an id in ``0 .. capacity - 1``."""
    base = tags.orientations
    symbol_of = gray_symbols(base)
    symbols = []
    remaining = tag_id
    for _ in range(tags.magnets):
        remaining, digit = divmod(remaining, base)
        symbols.append(symbol_of[digit])
    return TagLayout(placement(tags.order, tags.magnets, remaining), tuple(reversed(symbols)))


def tag_id(tags: Tags, layout: TagLayout) -> int:
    """Return the id of a layout; the inverse of :func:`layout`."""
    digit_of = gray_digits(tags.orientations)
    result = placement_rank(tags.order, layout.cells)
    for symbol in layout.symbols:
        result = result * tags.orientations + digit_of[symbol]
    return result


@functools.lru_cache(maxsize=1 << 14)
def placement(order: int, magnets: int, rank: int) -> tuple[Cell, ...]:
    """Return all cells of the placement of a rank, row by row from v1, columns ascending."""
    free = free_cells(order)
    occupied = list(vertices(order)[:3])
    for index, cell in enumerate(free):
        remaining = magnets - len(occupied)
        if remaining == 0:
            break
        placements_with_cell = math.comb(len(free) - index - 1, remaining - 1)
        if rank < placements_with_cell:
            occupied.append(cell)
        else:
            rank -= placements_with_cell
    return tuple(sorted(occupied, key=row_major_key))


@functools.lru_cache(maxsize=1 << 14)
def placement_rank(order: int, cells: tuple[Cell, ...]) -> int:
    """Return the rank of a placement; the inverse of :func:`placement`."""
    free = free_cells(order)
    occupied = set(cells)
    remaining = len(cells) - 3
    rank = 0
    for index, cell in enumerate(free):
        if remaining == 0:
            break
        if cell in occupied:
            remaining -= 1
        else:
            rank += math.comb(len(free) - index - 1, remaining - 1)
    return rank


def row_major_key(cell: Cell) -> Cell:
    """Return the key that sorts cells as in a layout: row by row, columns ascending."""
    column, row = cell
    return row, column


@functools.cache
def gray_words(orientations: int) -> tuple[int, ...]:
    """Return the binary word of each orientation; neighbours on the circle differ in one bit.

    If P is a power of two, this is the reflected Gray code ``s ^ (s >> 1)``. For another even P it
    is the reflected code of ``ceil(log2 P)`` bits without its middle: the first P/2 and the last
    P/2 words, which differ in the top bit where they meet. For odd P these are the words of P + 1
    without the last. No circle of odd length has steps of one bit only; the step from orientation P
    - 1 to 0 changes two.

    Raises
    ------
    InputError
        There are fewer than two orientations.
    """
    if orientations < 2:
        raise InputError(f"{orientations} orientations cannot be distinguished")
    even = orientations + orientations % 2
    omitted = (1 << (even - 1).bit_length()) - even
    indices = [s if s < even // 2 else s + omitted for s in range(orientations)]
    return tuple(index ^ (index >> 1) for index in indices)


@functools.cache
def gray_digits(orientations: int) -> tuple[int, ...]:
    """Return the digit ``0 .. P - 1`` of each orientation: the rank of its word.

    The words are those of :func:`gray_words`. If P is a power of two, the digit is the word itself.
    """
    words = gray_words(orientations)
    rank = {word: digit for digit, word in enumerate(sorted(words))}
    return tuple(rank[word] for word in words)


@functools.cache
def gray_symbols(orientations: int) -> tuple[int, ...]:
    """Return the orientation of each digit; the inverse of :func:`gray_digits`."""
    digits = gray_digits(orientations)
    return tuple(sorted(range(orientations), key=digits.__getitem__))
