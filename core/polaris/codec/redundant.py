"""Codec ``redundant``: orientations only, all places fixed, four magnets' worth of checks.

A tag is a word of M symbols, its orientations in the order of the layout, over the field of
``q`` elements, q being the largest prime or power of two that is no larger than P. The words
are those that the checks annul::

    sum_i w_i x_i^j = 0,   j = 0, 1, 2, 3,     x_i = 0, 1, 2, ... q - 1, infinity

(the place at infinity, which only a tag of q + 1 magnets has, counts in the last check
alone). It is the doubly extended Reed-Solomon code: any four columns ``(1, x, x^2, x^3)``
and ``(0, 0, 0, 1)`` are independent (Vandermonde), so two words differ in five places at
least, as many as four checks can give (Singleton).

The promise. Let f magnets be missing and e misread, by however many steps. A word is
accepted only where ``2 e + f <= 3``: one missing together with one misread, or up to three
missing. Without the missing places, words still differ in ``5 - f`` places. Words within
``r = (3 - f) // 2`` places of what was seen: two of them would differ in at most ``2 r <=
3 - f`` places, so there is one at most, and it is the right one where ``e <= r``. Where
``e = r + 1``, another word is at least ``5 - f - e = 4 - f - r >= r + 1`` away: nothing is
accepted, so one misread more is always noticed (and a third too where nothing is missing).
Beyond that the code refuses most, not all: of random words it accepts about
``(1 + M (q - 1)) / q^4``.

Why not a library: reedsolo 1.7.0 decodes to the full ``2 e + f <= 4`` and notices nothing
beyond. Of 1000 random words with four checks, M = 7 at P = 8, it answered wrong without a
word to 131 with three misread (this code: 0), 258 with four (12), 103 with two misread and
one missing (0), 439 with one misread and three missing (0). The price: it corrects two
misread where nothing is missing, and one beside two missing, which are refused here. Also,
it has no field but GF(2^m) and no words of length q + 1.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

from locatk.core.errors import InputError
from locatk.core.polaris.codec import mosk
from locatk.core.polaris.tag import Cell, TagLayout, Tags

CHECKS = 4
"""Check symbols of a word."""

DISTANCE = CHECKS + 1
"""Places in which two words differ at least."""

BUDGET = 3
"""Twice the misread and once the missing magnets that are accepted, at most."""


def check(tags: Tags) -> None:
    """Refuse a design for which there is no such code.

    Raises
    ------
    InputError
        Fewer than five magnets, or more than the field's size and one.
    """
    if tags.magnets <= CHECKS:
        raise InputError(
            f"codec 'redundant' spends {CHECKS} magnets on checks, the tag has {tags.magnets}",
            hint=f"Use at least {DISTANCE} magnets",
        )
    longest = field_size(tags.orientations) + 1
    if tags.magnets > longest:
        raise InputError(
            f"codec 'redundant' with {tags.orientations} orientations has room for {longest} "
            f"magnets, not {tags.magnets}",
            hint="Use fewer magnets or more orientations",
        )


def capacity(tags: Tags) -> int:
    """Number of ids: ``q^(M - 4)``."""
    return field_size(tags.orientations) ** (tags.magnets - CHECKS)


def cells(tags: Tags) -> tuple[Cell, ...]:
    """Where the magnets of each tag lie: the first placement of codec ``mosk``."""
    return mosk.placement(tags.order, tags.magnets, 0)


def layout(tags: Tags, tag_id: int) -> TagLayout:
    """Cells and orientations of an id: its digits to the base q, most significant first,
    are the orientations of the first M - 4 magnets; the checks follow."""
    code = code_of(tags)
    digits = []
    rest = tag_id
    for _ in range(tags.magnets - CHECKS):
        rest, digit = divmod(rest, code.field.size)
        digits.append(digit)
    word = digits[::-1] + [0] * CHECKS
    places = range(tags.magnets - CHECKS, tags.magnets)
    filled = code.fill(word, places)
    assert filled is not None  # four unknowns, four independent checks
    return TagLayout(cells(tags), filled)


def tag_id(tags: Tags, layout: TagLayout) -> int:
    """The id of a layout; the inverse of :func:`layout`.

    Raises
    ------
    InputError
        Magnets lie elsewhere, or the orientations are no word of the code.
    """
    if layout.cells != cells(tags):
        raise InputError(f"codec 'redundant' has its magnets in the cells {list(cells(tags))}")
    code = code_of(tags)
    if max(layout.symbols) >= code.field.size or code.fill(layout.symbols, ()) is None:
        raise InputError("the orientations are no word of codec 'redundant'")
    return message(tags, layout.symbols)


def message(tags: Tags, word: Sequence[int]) -> int:
    """The id that a word of the code bears."""
    size = field_size(tags.orientations)
    result = 0
    for symbol in word[: tags.magnets - CHECKS]:
        result = result * size + symbol
    return result


def decode(tags: Tags, seen: Sequence[int | None]) -> tuple[int, ...] | None:
    """The word that was meant, or None beyond the promise above.

    Parameters
    ----------
    seen : sequence of M int or None
        Orientations in the order of the layout; None where a magnet is missing, or has one
        of the orientations from q on, which no word has.
    """
    code = code_of(tags)
    missing = [i for i, s in enumerate(seen) if s is None or s >= code.field.size]
    if len(missing) > BUDGET:
        return None
    word = [0 if s is None or i in missing else s for i, s in enumerate(seen)]
    filled = code.fill(word, missing)
    if filled is not None or len(missing) + 2 > BUDGET:
        return filled
    for place in range(len(word)):
        if place not in missing:
            filled = code.fill(word, [*missing, place])
            if filled is not None:
                return filled
    return None


@functools.cache
def field_size(orientations: int) -> int:
    """q: the largest prime or power of two that is no larger than ``orientations``."""
    for size in range(orientations, 2, -1):
        if size & (size - 1) == 0 or all(size % d for d in range(2, int(size**0.5) + 1)):
            return size
    return 2


@dataclass(frozen=True)
class Field:
    """Arithmetic on ``0 .. size - 1``: modulo a prime, or polynomials over GF(2) whose
    coefficients are the number's bits, modulo the least primitive polynomial.

    ``power[i]`` is the i-th power of a generator, over two rounds; ``log`` its inverse.
    """

    size: int
    power: tuple[int, ...]
    log: tuple[int, ...]

    def subtract(self, one: int, other: int) -> int:
        if self.size & (self.size - 1) == 0:
            return one ^ other
        return (one - other) % self.size

    def multiply(self, one: int, other: int) -> int:
        if one == 0 or other == 0:
            return 0
        return self.power[self.log[one] + self.log[other]]

    def divide(self, one: int, other: int) -> int:
        if one == 0:
            return 0
        return self.power[self.log[one] - self.log[other] + self.size - 1]


@functools.cache
def field(size: int) -> Field:
    """The field of ``size`` elements, a prime or a power of two of at least 3."""
    binary = size & (size - 1) == 0
    # In turn: primitive polynomials of this degree, or generators modulo the prime.
    for choice in range(size, 2 * size) if binary else range(2, size):
        powers = [1]
        while len(powers) < size - 1:
            if binary:
                shifted = powers[-1] << 1
                following = shifted ^ choice if shifted >= size else shifted
            else:
                following = powers[-1] * choice % size
            if following <= 1:
                break
            powers.append(following)
        if len(set(powers)) == size - 1:
            log = [0] * size
            for exponent, element in enumerate(powers):
                log[element] = exponent
            return Field(size, tuple(powers * 2), tuple(log))
    raise ValueError(f"{size} is neither a prime nor a power of two")


@dataclass(frozen=True)
class Code:
    """The words that the checks annul.

    Attributes
    ----------
    field : Field
    columns : tuple of 4-tuples
        What each place counts in the four checks.
    """

    field: Field
    columns: tuple[tuple[int, ...], ...]

    def fill(self, word: Sequence[int], places: Sequence[int]) -> tuple[int, ...] | None:
        """The one word that agrees with ``word`` except on ``places`` (four at most), or
        None where there is none."""
        field = self.field
        rows = [[*(self.columns[p][j] for p in places), 0] for j in range(CHECKS)]
        for place, symbol in enumerate(word):
            if place not in places:
                for j, row in enumerate(rows):
                    term = field.multiply(symbol, self.columns[place][j])
                    row[-1] = field.subtract(row[-1], term)
        for k in range(len(places)):  # Gauss-Jordan
            pivot = next(j for j in range(k, CHECKS) if rows[j][k])
            rows[k], rows[pivot] = rows[pivot], rows[k]
            rows[k] = [field.divide(value, rows[k][k]) for value in rows[k]]
            for j in range(CHECKS):
                factor = rows[j][k]
                if j != k and factor:
                    rows[j] = [
                        field.subtract(value, field.multiply(factor, top))
                        for value, top in zip(rows[j], rows[k], strict=True)
                    ]
        if any(row[-1] for row in rows[len(places) :]):
            return None
        filled = list(word)
        for place, row in zip(places, rows, strict=False):
            filled[place] = row[-1]
        return tuple(filled)


@functools.cache
def _code(size: int, length: int) -> Code:
    arithmetic = field(size)
    columns = []
    for x in range(min(length, size)):
        column = [1]
        while len(column) < CHECKS:
            column.append(arithmetic.multiply(column[-1], x))
        columns.append(tuple(column))
    if length > size:
        columns.append((0,) * (CHECKS - 1) + (1,))
    return Code(arithmetic, tuple(columns))


def code_of(tags: Tags) -> Code:
    """The code of a design, one word symbol a magnet."""
    return _code(field_size(tags.orientations), tags.magnets)
