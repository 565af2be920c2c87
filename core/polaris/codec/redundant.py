"""Codec ``redundant``: orientations in fixed cells, with check symbols of four magnets.

A word is the orientations of the M magnets in the order of the layout, as symbols of the finite
field of ``q`` elements; q is the largest prime or power of two that is not larger than P. The words
satisfy four checks::

    sum_i w_i x_i^j = 0,   j = 0, 1, 2, 3,     x_i = 0, 1, 2, ... q - 1, infinity

The position at infinity exists only in a tag of q + 1 magnets and counts in the last check alone.
This is the doubly extended Reed-Solomon code. Any four columns ``(1, x, x^2, x^3)`` and
``(0, 0, 0, 1)`` are independent (Vandermonde), so two words differ in at least five positions, the
most that four checks permit (Singleton bound).

Guarantee. Let f magnets be missing (erasures) and e be misread (errors), each by any number of
steps. A word is accepted only if ``2 e + f <= 3``: one misread and up to one missing, or up to
three missing. Without the missing positions, words still differ in ``5 - f`` positions. Two words
within ``r = (3 - f) // 2`` positions of the observation would differ in at most ``2 r <= 3 - f``
positions, so there is at most one; it is the correct one if ``e <= r``. If ``e = r + 1``, any other
word is at least ``5 - f - e = 4 - f - r >= r + 1`` away and nothing is accepted, so one more error
is always detected (and also a third error if nothing is missing). Beyond that the code detects most
errors, not all: it accepts about ``(1 + M (q - 1)) / q^4`` of random words.

Why no library: reedsolo 1.7.0 decodes up to ``2 e + f <= 4`` and detects no error beyond. Of 1000
random words with four checks, M = 7 and P = 8, it decoded wrongly 131 with three errors (this code:
0), 258 with four errors (12), 103 with two errors and one erasure (0), and 439 with one error and
three erasures (0). In return it corrects two errors without erasure, and one error with two
erasures, which are rejected here. It has no fields but GF(2^m) and no words of length q + 1.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

from locatk.core.errors import InputError
from locatk.core.polaris.codec import mosk
from locatk.core.polaris.tag import Cell, TagLayout, Tags

CHECK_SYMBOLS = 4
"""Number of check symbols of a word."""

MIN_WORD_DISTANCE = CHECK_SYMBOLS + 1
"""Smallest number of positions in which two words differ."""

MAX_DECODING_WEIGHT = 3
"""Largest sum of twice the misread and once the missing magnets that is accepted."""


def check(tags: Tags) -> None:
    """Check that a code exists for a design.

    Raises
    ------
    InputError
        There are fewer than five magnets, or more than the size of the field plus one.
    """
    if tags.magnets <= CHECK_SYMBOLS:
        raise InputError(
            f"codec 'redundant' needs {CHECK_SYMBOLS} magnets for checks; "
            f"the tag has {tags.magnets}",
            hint=f"Use at least {MIN_WORD_DISTANCE} magnets",
        )
    max_magnets = field_size(tags.orientations) + 1
    if tags.magnets > max_magnets:
        raise InputError(
            f"codec 'redundant' with {tags.orientations} orientations permits {max_magnets} "
            f"magnets, not {tags.magnets}",
            hint="Use fewer magnets or more orientations",
        )


def capacity(tags: Tags) -> int:
    """Return the number of ids, ``q^(M - 4)``."""
    return field_size(tags.orientations) ** (tags.magnets - CHECK_SYMBOLS)


def cells(tags: Tags) -> tuple[Cell, ...]:
    """Return the cells of the magnets of every tag: the first placement of codec ``mosk``."""
    return mosk.placement(tags.order, tags.magnets, 0)


def layout(tags: Tags, tag_id: int) -> TagLayout:
    """Return the cells and orientations of an id.

    The digits of the id to the base q, most significant first, are the orientations of the first
    M - 4 magnets. The check symbols follow.
    """
    code = code_of_design(tags)
    digits = []
    remaining = tag_id
    for _ in range(tags.magnets - CHECK_SYMBOLS):
        remaining, digit = divmod(remaining, code.field.size)
        digits.append(digit)
    symbols = digits[::-1] + [0] * CHECK_SYMBOLS
    check_positions = range(tags.magnets - CHECK_SYMBOLS, tags.magnets)
    word = code.complete(symbols, check_positions)
    assert word is not None  # Four unknowns have a solution of four independent checks.
    return TagLayout(cells(tags), word)


def tag_id(tags: Tags, layout: TagLayout) -> int:
    """Return the id of a layout; the inverse of :func:`layout`.

    Raises
    ------
    InputError
        The cells are not those of the codec, or the orientations are not a word of the code.
    """
    if layout.cells != cells(tags):
        raise InputError(f"codec 'redundant' has its magnets in the cells {list(cells(tags))}")
    code = code_of_design(tags)
    if max(layout.symbols) >= code.field.size or code.complete(layout.symbols, ()) is None:
        raise InputError("the orientations are no word of codec 'redundant'")
    return id_of_word(tags, layout.symbols)


def id_of_word(tags: Tags, word: Sequence[int]) -> int:
    """Return the id that a word of the code encodes."""
    size = field_size(tags.orientations)
    result = 0
    for symbol in word[: tags.magnets - CHECK_SYMBOLS]:
        result = result * size + symbol
    return result


def decode_word(tags: Tags, observed: Sequence[int | None]) -> tuple[int, ...] | None:
    """Correct missing and misread orientations.

    Parameters
    ----------
    observed : sequence of M int or None
        Orientations in the order of the layout; None for a missing magnet. Orientations from q on,
        which no word has, count as missing.

    Returns
    -------
    tuple of M int or None
        The word within the guarantee of the module, or None.
    """
    code = code_of_design(tags)
    erased = [i for i, s in enumerate(observed) if s is None or s >= code.field.size]
    if len(erased) > MAX_DECODING_WEIGHT:
        return None
    symbols = [0 if s is None or i in erased else s for i, s in enumerate(observed)]
    word = code.complete(symbols, erased)
    if word is not None or len(erased) + 2 > MAX_DECODING_WEIGHT:
        return word
    for position in range(len(symbols)):
        if position not in erased:
            word = code.complete(symbols, [*erased, position])
            if word is not None:
                return word
    return None


@functools.cache
def field_size(orientations: int) -> int:
    """Return q, the largest prime or power of two that is not larger than ``orientations``."""
    for size in range(orientations, 2, -1):
        if size & (size - 1) == 0 or all(size % d for d in range(2, int(size**0.5) + 1)):
            return size
    return 2


@dataclass(frozen=True)
class FiniteField:
    """Arithmetic of a finite field on the numbers ``0 .. size - 1``.

    A field of prime size is arithmetic modulo the prime. In a field of size 2^m the bits of a
    number are the coefficients of a polynomial over GF(2), modulo the smallest primitive
    polynomial.

    Attributes
    ----------
    size : int
    power : tuple of int
        Powers of a generator with exponents ``0 .. 2 (size - 1) - 1``, which are two periods.
    log : tuple of int
        Exponent of each element but 0, for the generator of ``power``.
    """

    size: int
    power: tuple[int, ...]
    log: tuple[int, ...]

    def subtract(self, a: int, b: int) -> int:
        if self.size & (self.size - 1) == 0:
            return a ^ b
        return (a - b) % self.size

    def multiply(self, a: int, b: int) -> int:
        if a == 0 or b == 0:
            return 0
        return self.power[self.log[a] + self.log[b]]

    def divide(self, a: int, b: int) -> int:
        if a == 0:
            return 0
        return self.power[self.log[a] - self.log[b] + self.size - 1]


@functools.cache
def finite_field(size: int) -> FiniteField:
    """Return the field of ``size`` elements, a prime or a power of two of at least 3.

    Raises
    ------
    ValueError
        The size is neither a prime nor a power of two.
    """
    is_binary = size & (size - 1) == 0
    # Candidates are polynomials of the degree of the field, or generators modulo the prime.
    for candidate in range(size, 2 * size) if is_binary else range(2, size):
        powers = [1]
        while len(powers) < size - 1:
            if is_binary:
                shifted = powers[-1] << 1
                next_power = shifted ^ candidate if shifted >= size else shifted
            else:
                next_power = powers[-1] * candidate % size
            if next_power <= 1:
                break
            powers.append(next_power)
        if len(set(powers)) == size - 1:
            log = [0] * size
            for exponent, element in enumerate(powers):
                log[element] = exponent
            return FiniteField(size, tuple(powers * 2), tuple(log))
    raise ValueError(f"{size} is neither a prime nor a power of two")


@dataclass(frozen=True)
class CheckCode:
    """Linear code of the words that satisfy four checks.

    Attributes
    ----------
    field : FiniteField
    columns : tuple of 4-tuples
        Coefficients of each position in the four checks.
    """

    field: FiniteField
    columns: tuple[tuple[int, ...], ...]

    def complete(self, symbols: Sequence[int], unknown: Sequence[int]) -> tuple[int, ...] | None:
        """Solve the checks for the symbols at up to four ``unknown`` positions.

        Returns
        -------
        tuple of int or None
            The unique word that agrees with ``symbols`` at all other positions, or None.
        """
        field = self.field
        rows = [[*(self.columns[p][j] for p in unknown), 0] for j in range(CHECK_SYMBOLS)]
        for position, symbol in enumerate(symbols):
            if position not in unknown:
                for j, row in enumerate(rows):
                    term = field.multiply(symbol, self.columns[position][j])
                    row[-1] = field.subtract(row[-1], term)
        for k in range(len(unknown)):  # Gauss-Jordan elimination
            pivot = next(j for j in range(k, CHECK_SYMBOLS) if rows[j][k])
            rows[k], rows[pivot] = rows[pivot], rows[k]
            rows[k] = [field.divide(value, rows[k][k]) for value in rows[k]]
            for j in range(CHECK_SYMBOLS):
                factor = rows[j][k]
                if j != k and factor:
                    rows[j] = [
                        field.subtract(value, field.multiply(factor, pivot_value))
                        for value, pivot_value in zip(rows[j], rows[k], strict=True)
                    ]
        if any(row[-1] for row in rows[len(unknown) :]):
            return None
        word = list(symbols)
        for position, row in zip(unknown, rows, strict=False):
            word[position] = row[-1]
        return tuple(word)


def code_of_design(tags: Tags) -> CheckCode:
    """Return the code of a design; a word has one symbol for each magnet."""
    return _check_code(field_size(tags.orientations), tags.magnets)


@functools.cache
def _check_code(size: int, length: int) -> CheckCode:
    field = finite_field(size)
    columns = []
    for x in range(min(length, size)):
        column = [1]
        while len(column) < CHECK_SYMBOLS:
            column.append(field.multiply(column[-1], x))
        columns.append(tuple(column))
    if length > size:
        columns.append((0,) * (CHECK_SYMBOLS - 1) + (1,))
    return CheckCode(field, tuple(columns))
