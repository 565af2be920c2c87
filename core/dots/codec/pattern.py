"""Codecs: which symbol stands at which place of the plane, in closed form.

A place is a pair of grid coordinates, x to the right and y down, each in
``0 .. RANGE - 1``. A dot stands beside its place, up, left, right or down of it, and says
two bits by that: the *column* bit, read down the columns, tells x, and the *row* bit, read
along the rows, tells y. Conventions as on genuine sheets (facts/dots.md 2.4 and 2.5).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from locatk.core.dots.codec import sequences
from locatk.core.errors import InputError

MAIN_SEQUENCE_LENGTH = len(sequences.MAIN)
"""Length of the main sequence, and number of sections an axis."""

SECTION_LENGTH = 236 * 233 * 31 * 241
"""Places an axis of one section: 410 815 348, after which all digits repeat."""

UP, LEFT, RIGHT, DOWN = range(4)
"""Symbols: column bit plus twice the row bit."""

SYMBOL_LETTERS = "ulrd"
"""Letter of each symbol, as in Cellulo's and Anoto's text patterns."""

DOT_DIRECTIONS = np.array([[0, -1], [-1, 0], [1, 0], [0, 1]], np.int8)
"""(4, 2) direction in which a symbol's dot lies from its place, x right and y down."""

MAIN_SEQUENCE = np.array(list(sequences.MAIN), np.uint8)


@dataclass(frozen=True, eq=False)
class Codec:
    """One set of sequences; get it by name with :func:`codec`.

    Attributes
    ----------
    name : str
    digits : tuple of four (length,) uint8 ndarray
        The secondary sequences, whose lengths are coprime.
    """

    name: str
    digits: tuple[NDArray[np.uint8], ...]

    @functools.cached_property
    def _prefixes(self) -> tuple[NDArray[np.int64], ...]:
        return tuple(np.concatenate([[0], np.cumsum(d, dtype=np.int64)]) for d in self.digits)

    @functools.cached_property
    def _crt(self) -> NDArray[np.int64]:
        """What each residue adds to the place of which it is the remainder."""
        others = [SECTION_LENGTH // len(d) for d in self.digits]
        parts = zip(others, self.digits, strict=True)
        return np.array([m * pow(m, -1, len(d)) for m, d in parts], np.int64)

    def differences(self, place: ArrayLike) -> NDArray[np.int64]:
        """Shift of the main sequence from ``place`` to the next, 5..58; same shape."""
        p = np.asarray(place, np.int64)
        total = np.full(p.shape, sequences.SMALLEST_SHIFT, np.int64)
        for weight, digits in zip(sequences.WEIGHTS, self.digits, strict=True):
            total += weight * digits[p % len(digits)]
        return total

    def phases(self, place: ArrayLike, section: int = 0) -> NDArray[np.int64]:
        """Index of the main sequence at the start of columns (or rows) ``place``, 0..62.

        The sum of all :meth:`differences` before ``place``, plus the section; in closed
        form, so that it costs the same at 0 and at 400 million.
        """
        p = np.asarray(place, np.int64)
        total = sequences.SMALLEST_SHIFT * p + section
        for weight, digits, prefix in zip(
            sequences.WEIGHTS, self.digits, self._prefixes, strict=True
        ):
            rounds, rest = np.divmod(p, len(digits))
            total += weight * (rounds * prefix[-1] + prefix[rest])
        return total % MAIN_SEQUENCE_LENGTH

    def place(self, residues: ArrayLike) -> NDArray[np.int64]:
        """The place whose remainders by the four lengths are ``residues`` (..., 4)."""
        result: NDArray[np.int64] = (np.asarray(residues, np.int64) @ self._crt) % SECTION_LENGTH
        return result

    def symbols(
        self, origin: tuple[int, int], size: tuple[int, int], section: tuple[int, int] = (0, 0)
    ) -> NDArray[np.uint8]:
        """Symbols of a window.

        Parameters
        ----------
        origin : (x, y)
            Grid coordinates of its upper left dot.
        size : (columns, rows)
        section : (u, v)
            Each 0..62.

        Returns
        -------
        (rows, columns) uint8 ndarray
            :data:`UP`, :data:`LEFT`, :data:`RIGHT` or :data:`DOWN`.

        Raises
        ------
        InputError
            The window leaves the range, or there is no such section: beyond the last
            place another section begins, and no window across the border can be read.
        """
        check_window(origin, size, section)
        (x, y), (columns, rows) = origin, size
        column_phase = self.phases(np.arange(x, x + columns), section[0])
        row_phase = self.phases(np.arange(y, y + rows), section[1])
        # Only 63 different columns and rows exist: make those, then pick.
        column_bits = MAIN_SEQUENCE[
            np.add.outer(np.arange(y, y + rows), np.arange(MAIN_SEQUENCE_LENGTH))
            % MAIN_SEQUENCE_LENGTH
        ]
        row_bits = (
            MAIN_SEQUENCE[
                np.add.outer(np.arange(MAIN_SEQUENCE_LENGTH), np.arange(x, x + columns))
                % MAIN_SEQUENCE_LENGTH
            ]
            << 1
        )
        result: NDArray[np.uint8] = row_bits[row_phase]
        result |= column_bits[:, column_phase]
        return result


def check_window(
    origin: tuple[int, int], size: tuple[int, int], section: tuple[int, int] = (0, 0)
) -> None:
    """Refuse a window that no section holds whole; see :meth:`Codec.symbols`."""
    if not all(0 <= s < MAIN_SEQUENCE_LENGTH for s in section):
        raise InputError(
            f"section {section[0]},{section[1]} is not in 0..{MAIN_SEQUENCE_LENGTH - 1}"
        )
    for axis, start, count in zip("xy", origin, size, strict=True):
        if count < 1:
            raise InputError(f"a window of {size[0]} x {size[1]} dots")
        if not 0 <= start < SECTION_LENGTH:
            raise InputError(f"origin {axis} {start} is not in 0..{SECTION_LENGTH - 1}")
        if start + count > SECTION_LENGTH:
            raise InputError(
                f"{count} dots from {axis} {start} cross the border of the section "
                f"at {SECTION_LENGTH}",
                hint=f"Use an origin {axis} of at most {SECTION_LENGTH - count}",
            )


@functools.cache
def codec(name: str) -> Codec:
    """The codec of this name.

    Raises
    ------
    InputError
        There is none.
    """
    if name not in sequences.FOURTH:
        raise InputError(f"no codec {name!r}", hint=f"Known codecs: {', '.join(sequences.FOURTH)}")
    texts = (sequences.FIRST, sequences.SECOND, sequences.THIRD, sequences.FOURTH[name])
    return Codec(name, tuple(np.array(list(text), np.uint8) for text in texts))
