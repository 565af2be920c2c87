"""Which magnets of a sighting are a tag, on which cells, and where that tag lies.

The grid is laid through each pair of magnets in every way that their distance allows;
what puts the most magnets on cells of their own is kept, and fitted by least squares. The
scale along the track is part of that fit where the way of the array was found from the
field alone: the tag's known spacing then is the ruler for it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.polaris.magnets import DetectedMagnets
from locatk.core.polaris.tag import Cell, Tags, places, vertices

Array = NDArray[np.float64]

NEAR = 0.3
"""How far from its cell a magnet may be before the grid is fitted, in spacings."""

GOOD, FAIR = 0.05, 0.1
"""Rms distance of the magnets from their cells, in spacings: what is looked for first, and
what will do."""

FREE_LENGTH, KNOWN_LENGTH = 0.15, 0.05
"""By how much a distance along the track may be wrong, where the way was found from the field
alone and where it was known."""

BUILD_M = 4e-4
"""Standard deviation of a magnet's place that is set by hand."""

MEASURED_M = 1e-4
"""The same of a tag whose magnets were measured as built."""

SCALE = 0.03
"""Standard deviation of a way's scale that was found from the field alone: on the published
recordings it is 2.5 % short, in each of them (docs/polaris.md)."""


@dataclass(frozen=True)
class Match:
    """A tag's grid, laid over magnets of a sighting.

    Attributes
    ----------
    magnets : tuple of int
        Numbers of the magnets in the sighting, in the order of ``cells``.
    cells : tuple of (column, row)
        Row by row from v1.
    x_m, y_m, heading_rad : float
        Pose of the tag in the array's frame.
    covariance : (3, 3) ndarray
        Of these.
    scale, scale_sigma : float
        True over found length along the track, and its standard deviation.
    misfit_m : float
        Rms distance of the magnets from their cells.
    """

    magnets: tuple[int, ...]
    cells: tuple[Cell, ...]
    x_m: float
    y_m: float
    heading_rad: float
    covariance: Array
    scale: float
    scale_sigma: float
    misfit_m: float


def matches(
    sighting: DetectedMagnets, tags: Tags, used: frozenset[int] = frozenset()
) -> list[Match]:
    """Ways to lay the grid over magnets that are not in ``used``, the best first.

    All of them have as many magnets as a tag has, else as many on cells as can be; with the
    three position magnets among them where one has those.
    """
    free = np.array([k for k in range(len(sighting)) if k not in used], int)
    if len(free) < 2:
        return []
    points = sighting.place_m[free]
    found = _layings(points, tags, FREE_LENGTH if sighting.free_path else KNOWN_LENGTH)
    if not found:
        return []
    corners = set(vertices(tags.order)[:3])
    counts = sorted({len(cells) for cells in found.values()}, reverse=True)
    # A whole tag is what is looked for first; more magnets on cells may be two tags' at once.
    whole_tag = [(tags.magnets, misfit) for misfit in (GOOD, FAIR) if tags.magnets in counts]
    others = [(count, misfit) for misfit in (GOOD, FAIR) for count in counts if count > 2]
    for count, misfit in [*whole_tag, *others, (2, FAIR)]:
        laid = [
            _fitted(sighting, tags, tuple(int(free[k]) for k, _ in key), cells)
            for key, cells in found.items()
            if len(cells) == count
        ]
        laid = [match for match in laid if match.misfit_m < misfit * tags.spacing_m]
        if laid:
            whole = [match for match in laid if corners <= set(match.cells)]
            return sorted(whole or laid, key=lambda match: match.misfit_m)
    return []


def _layings(
    points: Array, tags: Tags, length: float
) -> dict[tuple[tuple[int, Cell], ...], tuple[Cell, ...]]:
    """Distinct assignments of points to cells, from every pair of points and of cells."""
    order, spacing = tags.order, tags.spacing_m
    grid = [(c, r) for r in range(order) for c in range(order) if (c, r) != (order - 1, 0)]
    nominal = places(tags, tuple(grid))
    apart = nominal[None, :] - nominal[:, None]
    lengths = np.linalg.norm(apart, axis=2)
    found: dict[tuple[tuple[int, Cell], ...], tuple[Cell, ...]] = {}
    n = len(points)
    for i in range(n):
        for j in range(i):
            span = points[j] - points[i]
            size = np.linalg.norm(span)
            a, b = np.nonzero(
                (np.abs(lengths - size) < length * lengths + NEAR * spacing / 2) & (lengths > 0)
            )
            if len(a) == 0:
                continue
            turn = np.arctan2(span[1], span[0]) - np.arctan2(apart[a, b, 1], apart[a, b, 0])
            # Into the tag's frame, so that the middle of the pair falls on that of the cells.
            cos, sin = np.cos(turn)[:, None], np.sin(turn)[:, None]
            middle = points - (points[i] + points[j]) / 2
            x = cos * middle[:, 0] + sin * middle[:, 1]
            y = cos * middle[:, 1] - sin * middle[:, 0]
            origin = (nominal[a] + nominal[b]) / 2
            x, y = x + origin[:, :1], y + origin[:, 1:]
            half = (order - 1) / 2
            row, column = x / spacing + half, half - y / spacing
            near_row, near_column = np.rint(row), np.rint(column)
            good = np.hypot(row - near_row, column - near_column) < NEAR
            good &= (near_row >= 0) & (near_row < order)
            good &= (near_column >= 0) & (near_column < order)
            good &= ~((near_column == order - 1) & (near_row == 0))
            number = np.minimum(good.sum(axis=1), tags.magnets)
            for k in np.flatnonzero(number >= max(2, number.max() - 1)):
                chosen = np.flatnonzero(good[k])
                cells = [(int(near_column[k, m]), int(near_row[k, m])) for m in chosen]
                if len(set(cells)) < len(cells):
                    continue
                pairs = sorted(
                    zip(chosen.tolist(), cells, strict=True), key=lambda pair: pair[1][::-1]
                )
                found[tuple(pairs)] = tuple(cell for _, cell in pairs)
    return found


def _fitted(
    sighting: DetectedMagnets,
    tags: Tags,
    magnets: tuple[int, ...],
    cells: tuple[Cell, ...],
    nominal: Array | None = None,
) -> Match:
    """The grid by least squares: heading, place, and the scale along the track."""
    target = places(tags, cells) if nominal is None else nominal
    build = BUILD_M if nominal is None else MEASURED_M
    points = sighting.place_m[list(magnets)]
    m = len(points)
    index = (3 * np.array(magnets)[:, None] + np.arange(2)).ravel()
    covariance = sighting.covariance[np.ix_(index, index)]
    if not np.all(np.isfinite(covariance)):
        covariance = np.eye(2 * m) * 1e-6
    weight = np.linalg.inv(covariance + build**2 * np.eye(2 * m))
    prior = np.zeros(4)
    prior[3] = (1 / SCALE**2) if sighting.free_path else 1e12
    a, b = points - points.mean(axis=0), target - target.mean(axis=0)
    heading = float(np.arctan2((b[:, 0] * a[:, 1] - b[:, 1] * a[:, 0]).sum(), (a * b).sum()))
    scale, shift = 1.0, np.zeros(2)
    for _ in range(6):
        cos, sin = np.cos(heading), np.sin(heading)
        turned = target @ np.array([[cos, sin], [-sin, cos]])
        scaled = points * [scale, 1.0]
        residual = (scaled - turned - shift).ravel()
        jacobian = np.zeros((2 * m, 4))
        jacobian[0::2, 0] = jacobian[1::2, 1] = 1.0
        jacobian[0::2, 2], jacobian[1::2, 2] = -turned[:, 1], turned[:, 0]
        jacobian[0::2, 3] = -points[:, 0]
        gram = jacobian.T @ weight @ jacobian + np.diag(prior)
        side = jacobian.T @ weight @ residual
        side[3] -= prior[3] * (scale - 1.0)
        moved = np.linalg.solve(gram, side)
        shift, heading, scale = shift + moved[:2], heading + moved[2], scale + moved[3]
    misfit = float(np.sqrt((residual**2).sum() / m))
    # A way that was no straight line shows in the grid, not in the samples.
    squares = float(residual @ weight @ residual) + prior[3] * (scale - 1) ** 2
    covariance = np.linalg.inv(gram) * max(1.0, squares / max(2 * m - 3, 1))
    return Match(
        magnets,
        cells,
        float(shift[0]),
        float(shift[1]),
        float(np.remainder(heading + np.pi, 2 * np.pi) - np.pi),
        covariance[:3, :3],
        float(scale),
        float(np.sqrt(covariance[3, 3])),
        misfit,
    )


def refitted(sighting: DetectedMagnets, tags: Tags, match: Match, nominal: Array) -> Match:
    """The same match on ``nominal`` places (M, 2): those of the tag as it was built."""
    return _fitted(sighting, tags, match.magnets, match.cells, nominal)


def ruled(sighting: DetectedMagnets, match: Match) -> DetectedMagnets:
    """The sighting with lengths along the track measured by the tag itself."""
    if not sighting.free_path:
        return sighting
    scale = match.scale
    place = sighting.place_m * [scale, 1.0]
    along = np.zeros(3 * len(place))
    along[0::3] = place[:, 0]
    stretch = np.ones(3 * len(place))
    stretch[0::3] = scale
    covariance = sighting.covariance * stretch[:, None] * stretch
    # What was not known of the scale is known now.
    known = along @ np.linalg.solve(covariance, along)
    if known > 0:
        covariance = covariance + (match.scale_sigma**2 - 1 / known) * np.outer(along, along)
    return replace(
        sighting,
        place_m=place,
        path_m=sighting.path_m * scale,
        covariance=covariance,
        free_path=False,
    )
