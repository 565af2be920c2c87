"""Neutral valleys of a landmark on the circle of the sensors, and what is read over its bars."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from locatk.core.landmarks.field import basis
from locatk.core.landmarks.landmark import PATTERNS, Geometry, code_of, signs

Array = NDArray[np.float64]

VALLEYS = (4, 6, 6, 6, 8, 8)
"""How many each of :data:`PATTERNS` has (paper, section 3.3)."""

PHASE = 0.37
"""By which angles are sampled off the symmetric ones, where fields are zero to rounding."""

STRENGTHS = signs([code_of(letters) for letters in PATTERNS]).T
"""(4, 6) of the bars of each pattern."""

_BARS = np.radians([0.0, 90.0, 180.0, 270.0])


def ring(radius_m: ArrayLike, angles_rad: ArrayLike) -> Array:
    """Points (..., 2) at polar coordinates, which broadcast."""
    r, phi = np.broadcast_arrays(np.asarray(radius_m, float), np.asarray(angles_rad, float))
    return np.stack([r * np.cos(phi), r * np.sin(phi)], -1)


def valleys(geometry: Geometry, strengths: ArrayLike) -> tuple[Array, NDArray[np.bool_], Array]:
    """Valleys on the circle of the sensors, whether the field rises there, and mountains.

    Parameters
    ----------
    geometry : Geometry
    strengths : (4,) ndarray
        Signed, of the bars.

    Returns
    -------
    valleys_rad, rising, mountains_t : (n,) ndarray
        As in :class:`Shape`; angles to 1e-9 rad.
    """
    s = np.asarray(strengths, float)
    step = 2 * math.pi / 1440
    phi = step * (np.arange(1440) + PHASE)
    field = basis(geometry, ring(geometry.circle_m, phi)) @ s
    before = np.flatnonzero(field * np.roll(field, -1) < 0)
    low, high = phi[before], phi[before] + step
    rising = field[before] < 0
    for _ in range(24):  # halves of a quarter of a degree, to 3e-10 rad
        middle = (low + high) / 2
        below = (basis(geometry, ring(geometry.circle_m, middle)) @ s < 0) == rising
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    angle = (low + high) / 2
    angle = np.where(angle > 2 * math.pi - 1e-8, 0.0, angle % (2 * math.pi))
    order = np.argsort(angle)
    starts = (before + 1)[order]
    peaks = [stretch[np.argmax(np.abs(stretch))] for stretch in _stretches(field, starts.tolist())]
    return angle[order], rising[order], np.array(peaks)


def _stretches(field: Array, starts: list[int]) -> list[Array]:
    """The circle cut at ``starts``; a start may be the end of the circle."""
    ends = starts[1:] + starts[:1]
    n = len(field)
    return [
        np.take(field, np.arange(a, b if b > a else b + n), mode="wrap")
        for a, b in zip(starts, ends, strict=True)
    ]


def crossing(geometry: Geometry, valleys_rad: Array) -> Array:
    """Centre (2,) by the paper's crossing of two lines through opposite valleys.

    The four valleys are those that lie along the bars, as the labels 1', 2', 4', 6' of
    landmarks 2 and 3, 1', 3', 4', 6' of landmark 4 and four that are no neighbours of
    landmarks 5 and 6 do (section 3.3, Fig. 6).
    """
    off = np.angle(np.exp(1j * (valleys_rad[:, None] - _BARS)))
    a, b, c, d = ring(geometry.circle_m, valleys_rad[np.argmin(np.abs(off), axis=0)])
    sides = np.column_stack([c - a, b - d])
    along: Array = np.linalg.solve(sides, b - a)
    return np.asarray(a + along[0] * (c - a))


def valid_heights(geometry: Geometry) -> tuple[float, float]:
    """Sensor heights between which each pattern has its valleys; ``nan`` where none has.

    The lowest such stretch, from the bars' top faces up; to a micrometre.
    """
    grid = np.linspace(0, 2 * geometry.radius_m, 51)
    holds = _holds(geometry, grid)
    if not holds.any():
        return math.nan, math.nan
    first = int(np.argmax(holds))
    after = int(np.argmin(holds[first:])) + first if not holds[first:].all() else len(grid) - 1

    def edge(good: float, bad: float) -> float:
        while abs(good - bad) > 1e-6:
            middle = (good + bad) / 2
            good, bad = (middle, bad) if _holds(geometry, middle).all() else (good, middle)
        return good

    low = 0.0 if first == 0 else edge(grid[first], grid[first - 1])
    return float(low), float(edge(grid[after - 1], grid[after]))


def _holds(geometry: Geometry, heights_m: ArrayLike) -> NDArray[np.bool_]:
    """Whether all six patterns have their valleys at heights (n,) or at one."""
    phi = np.radians(0.5 * (np.arange(720) + PHASE))
    heights = np.atleast_1d(np.asarray(heights_m, float))
    field = basis(geometry, ring(geometry.circle_m, phi), heights[:, None]) @ STRENGTHS
    counts = (field * np.roll(field, -1, axis=1) < 0).sum(axis=1)
    return np.asarray((counts == VALLEYS).all(axis=-1))


def over_bars(geometry: Geometry) -> tuple[Array, Array, Array]:
    """Lines that fit the field over the bars, as in :class:`.analysis.Shape`.

    Returns
    -------
    slope_t_per_m, zero_m, departure_m : (6, 4) ndarray
        Of each pattern, over each bar.
    """
    half, quarter = geometry.bar_length_m / 2, geometry.bar_length_m / 4
    along = np.linspace(-2 * half, 2 * half, 401)
    outward, forward = ring(1.0, _BARS), ring(1.0, _BARS + math.pi / 2)
    points = geometry.circle_m * outward + along[:, None, None] * forward
    field = basis(geometry, points) @ STRENGTHS
    result = np.full((3, len(PATTERNS), 4), np.nan)
    stretch = np.linspace(-quarter, quarter, 61)
    for bar in range(4):
        for k, own in enumerate(field[:, bar].T):
            signed = own * np.sign(STRENGTHS[bar, k])
            # Counter-clockwise the field rises over an N, and from a distance to its poles falls.
            at = np.flatnonzero((signed[:-1] < 0) & (signed[1:] >= 0) & (np.abs(along[1:]) < half))
            if not len(at):
                continue
            i = at[np.argmin(np.abs(along[at]))]
            share = own[i] / (own[i] - own[i + 1])
            zero = along[i] + share * (along[i + 1] - along[i])
            value = np.interp(zero + stretch, along, own)
            slope = (value @ stretch) / (stretch @ stretch)
            result[:, k, bar] = slope, zero, np.abs(value / slope - stretch).max()
    return result[0], result[1], result[2]
