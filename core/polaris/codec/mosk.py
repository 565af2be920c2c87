"""Magnetic orientation-shift keying: id <-> placement and orientations (Polaris section 5).

Three magnets always lie on v1, v2 and v3, v4 stays empty, the other ``M - 3`` lie on some of
the ``K^2 - 4`` free cells. The id counts all of that, without a gap::

    id = placement * P^M + digit_1 * P^(M-1) + ... + digit_M

- ``placement`` is the rank of the set of free cells taken, in lexicographic order: cells
  are numbered as :func:`~locatk.core.polaris.tag.free_cells` lists them, so that the first
  cells are placement 0 and the last cells the last placement (combinatorial number system).
- ``digit_i`` belongs to the i-th magnet of the layout (row by row from v1, columns
  ascending): the Gray digit of its orientation, :func:`gray_digits`.

Where P is a power of two, an id in binary is thus the placement followed by one Gray word a
magnet, and an orientation misread by one step changes one bit of it.
"""

from __future__ import annotations

import functools
import math

from locatk.core.errors import InputError
from locatk.core.polaris.tag import Cell, TagLayout, Tags, free_cells, vertices


def check(tags: Tags) -> None:
    """Every order, number of magnets and of orientations that a tag can have will do."""


def capacity(tags: Tags) -> int:
    """Number of ids: ``P^M * binomial(K^2 - 4, M - 3)`` (Polaris eq. 1)."""
    free = tags.order**2 - 4
    return tags.orientations**tags.magnets * math.comb(free, tags.magnets - 3)


def layout(tags: Tags, tag_id: int) -> TagLayout:
    """Cells and orientations of an id in ``0 .. capacity - 1``."""
    base = tags.orientations
    symbol_of = gray_symbols(base)
    symbols = []
    rest = tag_id
    for _ in range(tags.magnets):
        rest, digit = divmod(rest, base)
        symbols.append(symbol_of[digit])
    return TagLayout(placement(tags.order, tags.magnets, rest), tuple(reversed(symbols)))


def tag_id(tags: Tags, layout: TagLayout) -> int:
    """The id of a layout; the inverse of :func:`layout`."""
    digit_of = gray_digits(tags.orientations)
    result = placement_rank(tags.order, layout.cells)
    for symbol in layout.symbols:
        result = result * tags.orientations + digit_of[symbol]
    return result


@functools.lru_cache(maxsize=1 << 14)
def placement(order: int, magnets: int, rank: int) -> tuple[Cell, ...]:
    """All cells of the placement of this rank, row by row from v1, columns ascending."""
    free = free_cells(order)
    taken = list(vertices(order)[:3])
    for index, cell in enumerate(free):
        wanted = magnets - len(taken)
        if wanted == 0:
            break
        with_it = math.comb(len(free) - index - 1, wanted - 1)
        if rank < with_it:
            taken.append(cell)
        else:
            rank -= with_it
    return tuple(sorted(taken, key=row_first))


@functools.lru_cache(maxsize=1 << 14)
def placement_rank(order: int, cells: tuple[Cell, ...]) -> int:
    """The inverse of :func:`placement`."""
    free = free_cells(order)
    taken = set(cells)
    wanted = len(cells) - 3
    rank = 0
    for index, cell in enumerate(free):
        if wanted == 0:
            break
        if cell in taken:
            wanted -= 1
        else:
            rank += math.comb(len(free) - index - 1, wanted - 1)
    return rank


def row_first(cell: Cell) -> Cell:
    """Key that sorts cells as a layout has them: row by row, columns ascending."""
    column, row = cell
    return row, column


@functools.cache
def gray_words(orientations: int) -> tuple[int, ...]:
    """Binary word of each orientation; neighbours on the circle differ in one bit.

    For P a power of two the reflected code, ``s ^ (s >> 1)``. For another even P the
    reflected code of ``ceil(log2 P)`` bits without its middle: the first P/2 and the last
    P/2 words, which meet in the top bit. For odd P the words of P + 1 without the last: no
    circle of odd length has one-bit steps only, so the step from orientation P - 1 to 0
    changes two.
    """
    if orientations < 2:
        raise InputError(f"{orientations} orientations cannot be told apart")
    even = orientations + orientations % 2
    cut = (1 << (even - 1).bit_length()) - even
    indices = [s if s < even // 2 else s + cut for s in range(orientations)]
    return tuple(index ^ (index >> 1) for index in indices)


@functools.cache
def gray_digits(orientations: int) -> tuple[int, ...]:
    """Digit ``0 .. P - 1`` of each orientation: the rank of its word among
    :func:`gray_words`; the word itself where P is a power of two."""
    words = gray_words(orientations)
    rank = {word: digit for digit, word in enumerate(sorted(words))}
    return tuple(rank[word] for word in words)


@functools.cache
def gray_symbols(orientations: int) -> tuple[int, ...]:
    """Orientation of each digit: the inverse of :func:`gray_digits`."""
    digits = gray_digits(orientations)
    return tuple(sorted(range(orientations), key=digits.__getitem__))
