"""The landmark: four bar magnets on the sides of a square, and the sixteen ways to lay them.

Frame of a landmark: the origin is the middle of the square, x right, y up, z up from the
bars' top faces. Bar ``k`` lies at the angle ``90 k`` degrees, counter-clockwise from x
(the paper counts from "the right-hand side magnet in counter clockwise direction", Fig. 1),
flat, along the side of the square: tangential to the circle of the sensors. It is ``N``
where it is magnetised counter-clockwise along that circle, ``S`` where clockwise.

A *code* is how the four bars lie: bit ``k`` is set where bar ``k`` is ``N``. The paper's
six patterns are the codes up to a turn of the whole landmark.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

CODES = 16

PATTERNS = ("NSNS", "SSSN", "NNNS", "NNSS", "NNNN", "SSSS")
"""By the paper's number less one; which of SSSN and NNNS is landmark 2, and which of NNNN
and SSSS is 5, the paper does not say in words."""


@dataclass(frozen=True)
class Geometry:
    """Bars of a landmark, and the plane in which the sensors pass over them.

    The defaults reproduce the paper's two radii (45 and 54 mm).

    Attributes
    ----------
    bar_length_m, bar_width_m, bar_height_m : float
        Of one bar; it is magnetised along its length, and its height is upright.
    remanence_t : float
        Br of the bars' material in tesla.
    radius_m : float
        From the landmark's centre to the middle of each bar.
    sensor_height_m : float
        From the bars' top faces to the sensors.
    circle_m : float
        Radius of the circle on which the robot's hall sensors sit.
    threshold_t : float
        Field at which a sensor is inside the landmark's territory (an MEP is there).
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
    """Letters of the bars, counter-clockwise from the right-hand one, as in ``"NNSN"``."""
    return "".join("N" if code >> k & 1 else "S" for k in range(4))


def code_of(letters: str) -> int:
    """Inverse of :func:`name`; ``ValueError`` for anything but four letters N and S."""
    if len(letters) != 4 or set(letters) - {"N", "S"}:
        raise ValueError(f"{letters!r} is not four letters N and S")
    return sum(1 << k for k, letter in enumerate(letters) if letter == "N")


def rotated(codes: ArrayLike, quarters: ArrayLike) -> NDArray[np.int64]:
    """Codes of landmarks that were turned counter-clockwise by quarter turns.

    Both are integers and broadcast. A robot with the heading of ``q`` quarter turns reads a
    landmark laid as ``code`` as ``rotated(code, -q)``.
    """
    codes, shift = np.asarray(codes, np.int64), np.asarray(quarters, np.int64) % 4
    return (codes << shift | codes >> (4 - shift)) & 15


def signs(codes: ArrayLike) -> Array:
    """Directions (..., 4) of the bars: 1 where N, -1 where S."""
    bits = np.asarray(codes, np.int64)[..., None] >> np.arange(4) & 1
    return np.where(bits == 1, 1.0, -1.0)


PATTERN_OF = np.zeros(CODES, np.int64)
"""(16,) the paper's number, 1 to 6, of each code."""

for _number, _letters in enumerate(PATTERNS, 1):
    PATTERN_OF[rotated(code_of(_letters), np.arange(4))] = _number


def pattern(code: int) -> str:
    """The one of :data:`PATTERNS` of which ``code`` is an orientation."""
    return PATTERNS[PATTERN_OF[code] - 1]
