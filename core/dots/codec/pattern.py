"""Codecs: the symbol at each position of the plane, in closed form.

A position is a pair of grid coordinates, x to the right and y down, each in
``0 .. SECTION_LENGTH - 1``. A dot is displaced from its position up, left, right or down, which
encodes two bits: the *column* bit, read down the columns, encodes x, and the *row* bit, read along
the rows, encodes y. The conventions are those of genuine Anoto sheets (the pattern files of
ronyeh/papertoolkit, commit 0aa22f7), of US patent 7,999,798 and of Cellulo's generatePattern.py
(LukasHostettler/cellulo-localization, commit 894f0d0).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from locatk.core.dots.codec import sequences
from locatk.core.errors import InputError

CODEC_NAMES = tuple(sequences.FOURTH_DIGITS)

MAIN_SEQUENCE_LENGTH = len(sequences.MAIN_DIGITS)
"""Length of the main sequence, and number of sections per axis."""

SECTION_LENGTH = 236 * 233 * 31 * 241
"""Positions per axis of one section: 410 815 348, after which all digits repeat."""

UP, LEFT, RIGHT, DOWN = range(4)
"""Symbols: column bit plus twice the row bit."""

SYMBOL_LETTERS = "ulrd"
"""Letter of each symbol, as in Cellulo's and Anoto's text patterns."""

DOT_DIRECTIONS = np.array([[0, -1], [-1, 0], [1, 0], [0, 1]], np.int8)
"""(4, 2) displacement of each symbol's dot from its position, x right and y down."""

MAIN_SEQUENCE = np.array(list(sequences.MAIN_DIGITS), np.uint8)


@dataclass(frozen=True, eq=False)
class Codec:
    """One set of sequences; :func:`codec` returns it by name.

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
        """Coefficients of the four residues in the Chinese remainder theorem."""
        others = [SECTION_LENGTH // len(d) for d in self.digits]
        parts = zip(others, self.digits, strict=True)
        return np.array([m * pow(m, -1, len(d)) for m, d in parts], np.int64)

    def differences(self, position: ArrayLike) -> NDArray[np.int64]:
        """Return the shift of the main sequence, 5..58, from each line ``position`` to the next."""
        p = np.asarray(position, np.int64)
        total = np.full(p.shape, sequences.MIN_SHIFT, np.int64)
        for weight, digits in zip(sequences.DIGIT_WEIGHTS, self.digits, strict=True):
            total += weight * digits[p % len(digits)]
        return total

    def phases(self, position: ArrayLike, section: int = 0) -> NDArray[np.int64]:
        """Return the index 0..62 of the main sequence at the start of columns (or rows).

        It is the sum of all :meth:`differences` before ``position``, plus the section. The closed
        form has the same cost at 0 and at 400 million.
        """
        p = np.asarray(position, np.int64)
        total = sequences.MIN_SHIFT * p + section
        for weight, digits, prefix in zip(
            sequences.DIGIT_WEIGHTS, self.digits, self._prefixes, strict=True
        ):
            rounds, rest = np.divmod(p, len(digits))
            total += weight * (rounds * prefix[-1] + prefix[rest])
        return total % MAIN_SEQUENCE_LENGTH

    def position(self, residues: ArrayLike) -> NDArray[np.int64]:
        """Return the position whose remainders by the four lengths are ``residues`` (..., 4)."""
        result: NDArray[np.int64] = (np.asarray(residues, np.int64) @ self._crt) % SECTION_LENGTH
        return result

    def symbols(
        self, origin: tuple[int, int], size: tuple[int, int], section: tuple[int, int] = (0, 0)
    ) -> NDArray[np.uint8]:
        """Return the symbols of a window.

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
            The window leaves the section, or there is no such section. Beyond the last position
            another section begins, and a window across the border cannot be decoded.
        """
        check_window(origin, size, section)
        (x, y), (columns, rows) = origin, size
        column_phase = self.phases(np.arange(x, x + columns), section[0])
        row_phase = self.phases(np.arange(y, y + rows), section[1])
        # Only 63 different columns and rows exist; generate those, then select.
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
    """Raise InputError unless one section contains the whole window; see :meth:`Codec.symbols`."""
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
    """Return the codec of this name.

    Raises
    ------
    InputError
        There is no such codec.
    """
    if name not in sequences.FOURTH_DIGITS:
        raise InputError(
            f"no codec {name!r}", hint=f"Known codecs: {', '.join(sequences.FOURTH_DIGITS)}"
        )
    texts = (
        sequences.FIRST_DIGITS,
        sequences.SECOND_DIGITS,
        sequences.THIRD_DIGITS,
        sequences.FOURTH_DIGITS[name],
    )
    return Codec(name, tuple(np.array(list(text), np.uint8) for text in texts))
