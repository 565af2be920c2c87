"""Evidence against a match: magnets of the pass, or properties of the tag, of another design.

A part of a larger tag fits the grid of a smaller one perfectly. It differs in the magnets that are
left over: they have the same moment and continue the lattice. Magnets of a neighbouring tag do so
if the tags are parallel at a distance of whole spacings (laid edge to edge). Then the id decides: a
part of another tag has one of a few ids only by coincidence. Iron has another moment.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from locatk.core.polaris import codec
from locatk.core.polaris.identification.decoding import DecodedTag, coincidence_probability
from locatk.core.polaris.identification.matching import TagMatch, measure_spacing
from locatk.core.polaris.magnets import DetectedMagnets
from locatk.core.polaris.tag import PlanarPose, Tags, cell_positions

Array = NDArray[np.float64]

COMPARABLE_MOMENT_RATIO = 2.0
"""Ratio of two moments up to which magnets may be of one kind. The estimates differ by 1.5 on the
published recordings; a magnet 2 mm nearer than assumed at 10 mm appears 1.7 times as strong."""

LATTICE_TOLERANCE_SPACINGS = 0.1
"""Distance from a point of the lattice up to which a magnet is on it, in spacings. A magnet at an
arbitrary position is with a probability of 3 % (pi 0.1^2), so that one magnet on the lattice
outweighs another one that is not, if 5 % of the magnets of a tag are measured that badly."""

MIN_MAGNETS_IN_GRID = 2
"""Number of strong magnets within the grid, on its lattice or not, that cannot be iron. They are
those of another design, because tags do not overlap."""

MAX_COINCIDENCE_PROBABILITY = 1e-3
"""Probability up to which the id of a tag is no coincidence, so that magnets that continue its
lattice are those of its neighbours. A part of a larger tag fits the smaller grid in one pass in
five (11 of 57, of tags of 4 x 4 and 5 x 5 read as 3 x 3), so that one such pass in 5,000 is read at
most."""

MAX_DESIGN_MOMENT_RATIO, MAX_DESIGN_HEIGHT_RATIO = 3.0, 2.0
"""Ratios of moment and height to those of the design up to which they are of that design. Grades of
magnets differ by 1.3, plating and the height take up to 2 (published recordings: 0.55 to 0.83 of
the design), and discs of the next size have four times the moment."""

MAX_SPACING_ERROR, MAX_SPACING_SIGMAS = 0.02, 4.0
"""Deviation of the spacing from the design that is significant: relative to it, and in its
standard deviations."""


def is_part_of_larger_tag(
    magnets: DetectedMagnets,
    tags: Tags,
    match: TagMatch,
    unexplained: Iterable[int],
    coincidence_probability: float = 1.0,
) -> bool:
    """Return whether magnets that no tag explains belong to the tag of a match.

    Parameters
    ----------
    magnets : DetectedMagnets
    tags : Tags
        Design of the match.
    match : TagMatch
    unexplained : iterable of int
        Indices of magnets.
    coincidence_probability : float
        Probability that a part of another tag has an id as good as that of the match.
    """
    indices = _comparable(magnets, match, unexplained)
    grid = _grid_coordinates(magnets, tags, match)[indices]
    excess_spacings = _excess(tags, grid)
    is_inside = excess_spacings < 0.5
    if np.count_nonzero(is_inside) >= MIN_MAGNETS_IN_GRID:
        return True
    # A finer lattice of another design has the points of this one.
    refined = np.where(is_inside[:, None], 2 * grid, grid)
    error_spacings = np.hypot(*(refined - np.rint(refined)).T) / np.where(is_inside, 2, 1)
    is_on_lattice = error_spacings < LATTICE_TOLERANCE_SPACINGS
    is_evidence = is_inside
    if coincidence_probability > MAX_COINCIDENCE_PROBABILITY:
        is_evidence = excess_spacings < tags.order
    count = np.count_nonzero(is_on_lattice & is_evidence)
    # Each magnet on the lattice outweighs one off it (LATTICE_TOLERANCE_SPACINGS).
    return bool(count > 0 and count >= np.count_nonzero(~is_on_lattice & is_evidence))


def is_in_grid(
    magnets: DetectedMagnets, tags: Tags, match: TagMatch, indices: Iterable[int]
) -> NDArray[np.bool_]:
    """Return which of some magnets are within the grid of a match."""
    grid = _grid_coordinates(magnets, tags, match)[list(indices)]
    return _excess(tags, grid) < 0.5


def lattice_ahead(
    magnets: DetectedMagnets, tags: Tags, match: TagMatch, bar_m: float, half_width_m: float
) -> Array:
    """Return points of the lattice of a match that the array has not passed yet.

    They are the cells of the tag, and their neighbours beyond the grid, up to one spacing after the
    last magnet.

    Parameters
    ----------
    magnets, tags, match
    bar_m : float
        Position of the bar along x.
    half_width_m : float
        Distance from the middle of the array up to which it would detect a magnet.

    Returns
    -------
    (K, 2) ndarray
        In the frame of the magnets.
    """
    cells = tuple((i, k) for k in range(-1, tags.order + 1) for i in range(-1, tags.order + 1))
    cos, sin = np.cos(match.heading_rad), np.sin(match.heading_rad)
    position = cell_positions(tags, cells) @ np.array([[cos, sin], [-sin, cos]])
    position = position + [match.x_m, match.y_m]
    scale = match.scale if magnets.is_path_estimated else 1.0
    direction = 1.0 if magnets.path_m[-1] >= magnets.path_m[0] else -1.0
    along = direction * position[:, 0]
    last = (direction * magnets.position_m[list(match.magnets), 0] * scale).max()
    is_ahead = along > direction * bar_m * scale - magnets.height_m
    is_ahead &= along < last + 1.1 * tags.spacing_m
    is_ahead &= np.abs(position[:, 1]) < half_width_m
    # The cells of the match are explained.
    nearest = np.linalg.norm(
        position[:, None] - magnets.position_m[list(match.magnets)] * [scale, 1.0], axis=2
    ).min(axis=1)
    is_ahead &= nearest > tags.spacing_m / 2
    return np.asarray(position[is_ahead] / [scale, 1.0])


def contradicts_design(magnets: DetectedMagnets, tags: Tags, match: TagMatch) -> bool:
    """Return whether moment, height or spacing of a match are those of another design."""
    moment = np.median(magnets.moment_am2[list(match.magnets)])
    moment_ratio = moment / tags.magnet.moment
    height_ratio = magnets.height_m / tags.clearance_m
    # Methods without a model of the samples do not estimate them: nan compares as False.
    if abs(np.log(moment_ratio)) > np.log(MAX_DESIGN_MOMENT_RATIO):
        return True
    if abs(np.log(height_ratio)) > np.log(MAX_DESIGN_HEIGHT_RATIO):
        return True
    spacing, sigma = measure_spacing(magnets, tags, match)
    return abs(spacing - 1) > max(MAX_SPACING_ERROR, MAX_SPACING_SIGMAS * sigma)


def conflicting_tags(tags: Tags) -> list[tuple[int, int]]:
    """Return the pairs of tags on a site of which one makes the other unreadable.

    Magnets of one are within the grid of the other, or they continue its lattice and its id may be
    a coincidence.
    """
    ids = tuple(tags.site)
    if len(ids) < 2:
        return []
    centre_m = np.array([[tags.site[tag_id].x_m, tags.site[tag_id].y_m] for tag_id in ids])
    # Half a diagonal of both grids, and the distance up to which magnets count.
    range_m = (2 * np.sqrt(2) + 1) * tags.order * tags.spacing_m
    pairs = cKDTree(centre_m).query_pairs(range_m)
    return sorted(
        (ids[i], ids[k])
        for i, k in pairs
        if _makes_unreadable(tags, ids[i], ids[k]) or _makes_unreadable(tags, ids[k], ids[i])
    )


def _makes_unreadable(tags: Tags, neighbour_id: int, tag_id: int) -> bool:
    """Return whether magnets of a neighbour on the site make a tag unreadable."""
    pose, neighbour = tags.site[tag_id], tags.site[neighbour_id]
    cells = codec.layout_of(tags, neighbour_id).cells
    cos, sin = np.cos(neighbour.heading_rad), np.sin(neighbour.heading_rad)
    position_m = cell_positions(tags, cells) @ np.array([[cos, sin], [-sin, cos]])
    grid = _to_grid(tags, pose, position_m + [neighbour.x_m, neighbour.y_m])
    excess_spacings = _excess(tags, grid)
    if np.any(excess_spacings < 0.5):
        return True
    is_on_lattice = np.hypot(*(grid - np.rint(grid)).T) < LATTICE_TOLERANCE_SPACINGS
    if not np.any(is_on_lattice & (excess_spacings < tags.order)):
        return False
    layout = codec.layout_of(tags, tag_id)
    decoded = DecodedTag(tag_id, 0.0, 0, 0, layout.symbols)
    probability = coincidence_probability(tags, layout.cells, decoded)
    return probability > MAX_COINCIDENCE_PROBABILITY


def _comparable(
    magnets: DetectedMagnets, match: TagMatch, indices: Iterable[int]
) -> NDArray[np.intp]:
    """Return the magnets whose moment is that of the magnets of the match."""
    indices = np.array(sorted(indices), np.intp)
    ratio = magnets.moment_am2[indices] / np.median(magnets.moment_am2[list(match.magnets)])
    is_comparable = np.abs(np.log(ratio)) < np.log(COMPARABLE_MOMENT_RATIO)
    return np.asarray(indices[is_comparable])


def _grid_coordinates(magnets: DetectedMagnets, tags: Tags, match: TagMatch) -> Array:
    """Return the positions (M, 2) of all magnets in cells of a match, column and row from v1."""
    scale = match.scale if magnets.is_path_estimated else 1.0
    pose = PlanarPose(match.x_m, match.y_m, match.heading_rad)
    return _to_grid(tags, pose, magnets.position_m * [scale, 1.0])


def _to_grid(tags: Tags, pose: PlanarPose, position_m: Array) -> Array:
    """Return positions (M, 2) in cells of a tag, column and row from v1."""
    offset = position_m - [pose.x_m, pose.y_m]
    cos, sin = np.cos(pose.heading_rad), np.sin(pose.heading_rad)
    x = cos * offset[:, 0] + sin * offset[:, 1]
    y = cos * offset[:, 1] - sin * offset[:, 0]
    middle = (tags.order - 1) / 2
    return np.column_stack([middle - y / tags.spacing_m, x / tags.spacing_m + middle])


def _excess(tags: Tags, grid: Array) -> Array:
    """Return the distance (M,) beyond the outermost cells, in spacings; not positive within."""
    return np.asarray(np.maximum(-grid, grid - (tags.order - 1)).max(axis=1, initial=-np.inf))
