"""Landmark of four bar magnets on the sides of a square: geometry, and its sixteen codes.

Frame of a landmark: the origin is the centre of the square, x points right, y up, and z upward
from the top faces of the bars. Bar ``k`` is at the angle ``90 k`` degrees, counter-clockwise from
x ("Notation starts from the polarity of the right-hand side magnet in counter clockwise
direction", Fig. 1 of the paper). It rests flat along the side of the square, tangential to the
circle of the sensors. It is ``N`` if it is magnetised counter-clockwise along that circle, ``S``
if clockwise.

A *code* states the directions of the four bars: bit ``k`` is set if bar ``k`` is ``N``. The
paper's six patterns are the codes up to a rotation of the whole landmark.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

CODE_COUNT = 16
"""Number of directions of four bars."""

HALF_PI_RAD = np.pi / 2
"""Rotation of a landmark by one quarter turn, which maps bars onto bars."""

PATTERNS = ("NSNS", "SSSN", "NNNS", "NNSS", "NNNN", "SSSS")
"""By the paper's number minus one. The text of the paper does not state which of SSSN and NNNS is
landmark 2, and which of NNNN and SSSS is landmark 5."""


@dataclass(frozen=True)
class Geometry:
    """Bars of a landmark, and the plane in which the sensors pass over them.

    The defaults reproduce the two radii of the field in the paper (45 and 54 mm, section 3.1).

    Attributes
    ----------
    bar_length_m, bar_width_m, bar_height_m : float
        Size of one bar; it is magnetised along its length, and its height is vertical.
    remanence_t : float
        Br of the material in tesla.
    radius_m : float
        From the landmark's centre to the centre of each bar.
    sensor_height_m : float
        From the top faces of the bars to the sensors.
    circle_m : float
        Radius of the circle on which the robot's hall sensors are mounted.
    threshold_t : float
        Field at which a sensor enters the landmark's territory (the paper's MEP).
    """

    bar_length_m: float = 0.030
    bar_width_m: float = 0.010
    bar_height_m: float = 0.005
    remanence_t: float = 1.2
    radius_m: float = 0.025
    sensor_height_m: float = 0.012
    circle_m: float = 0.025
    threshold_t: float = 3.3e-3


def name(code: int) -> str:
    """Return the letters of the bars, counter-clockwise from the right one, as in ``"NNSN"``."""
    return "".join("N" if code >> k & 1 else "S" for k in range(4))


def code_of(letters: str) -> int:
    """Return the code of four letters; inverse of :func:`name`.

    Raises
    ------
    ValueError
        ``letters`` are not four letters N and S.
    """
    if len(letters) != 4 or set(letters) - {"N", "S"}:
        raise ValueError(f"{letters!r} is not four letters N and S")
    return sum(1 << k for k, letter in enumerate(letters) if letter == "N")


def rotated(codes: ArrayLike, quarters: ArrayLike) -> NDArray[np.int64]:
    """Return the codes of landmarks after a counter-clockwise rotation by quarter turns.

    Both arguments are integers and broadcast. A robot whose heading is ``q`` quarter turns reads
    a landmark of the code ``code`` as ``rotated(code, -q)``.
    """
    codes, shift = np.asarray(codes, np.int64), np.asarray(quarters, np.int64) % 4
    return (codes << shift | codes >> (4 - shift)) & 15


def signs(codes: ArrayLike) -> Array:
    """Return the directions (..., 4) of the bars: 1 for N, -1 for S."""
    bits = np.asarray(codes, np.int64)[..., None] >> np.arange(4) & 1
    return np.where(bits == 1, 1.0, -1.0)


PATTERN_OF = np.zeros(CODE_COUNT, np.int64)
"""(16,) number of the pattern in the paper, 1 to 6, of each code."""

for _number, _letters in enumerate(PATTERNS, 1):
    PATTERN_OF[rotated(code_of(_letters), np.arange(4))] = _number


def pattern(code: int) -> str:
    """Return the one of :data:`PATTERNS` of which ``code`` is an orientation."""
    return PATTERNS[PATTERN_OF[code] - 1]
