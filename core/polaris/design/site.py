"""Sites of tags: positions on grids and along routes, ids, and the check of a site.

Tags on a site have different ids. Two passes are separate if the field between two tags falls so
far that :func:`~locatk.core.polaris.preprocessing.find_passes` ends a pass there. Tags that are
closer share a pass: the solver separates two tags of a pass, but not three or more in a row
(docs/polaris.md).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from locatk.core.errors import InputError
from locatk.core.magnetics import dipole_field
from locatk.core.polaris import codec
from locatk.core.polaris.array import Samples
from locatk.core.polaris.codec import families
from locatk.core.polaris.design.planning import ReadingConditions, sensor_array
from locatk.core.polaris.identification.evidence import conflicting_tags
from locatk.core.polaris.preprocessing import CHANGE_LAGS_SAMPLES, find_passes
from locatk.core.polaris.tag import PlanarPose, Tags, cell_positions, symbol_angles
from locatk.core.units import length_text

Array = NDArray[np.float64]

MAX_SITE_TAGS = 10_000
"""Largest number of tags of a designed or imported site; larger numbers are mistakes."""

POSITION_DECIMALS = 9
"""Decimals of a position in metres: a nanometre."""

SEPARATION_RESOLUTION_M = 1e-3
"""Resolution of the distance from which tags are in separate passes."""

SEPARATION_MARGIN = 1.1
"""Ratio of the reported distance to the one without noise and between equal tags. In simulation all
tags in a row were read from a ratio of 1.05 to 1.09 on."""

MAX_SEPARATION_TAGS = 64.0
"""Largest distance, in widths of a tag, at which two passes are tried."""

MAX_TAGS_IN_PASS = 2
"""Number of tags in a row that the solver separates within one pass."""

MAX_NAMED_IDS = 6
"""Number of ids of a family that a message lists."""


@dataclass(frozen=True)
class SitePoint:
    """Position for a tag.

    Attributes
    ----------
    x_m, y_m : float
    heading_rad : float
        From the x axis of the site to that of the tag, counter-clockwise.
    tag_id : int or None
        None if any free id may be used.
    meaning : str
        Empty if the id has none.
    name : str
        Description of the point for messages, as in ``"line 7"``.
    """

    x_m: float
    y_m: float
    heading_rad: float = 0.0
    tag_id: int | None = None
    meaning: str = ""
    name: str = ""


@dataclass(frozen=True)
class SiteFinding:
    """Problem of a site.

    Attributes
    ----------
    code : str
        ``"overlap"`` (a tag makes another one unreadable), ``"row"`` (more tags in a row than a
        pass may have), ``"no_pass"`` (the field of a tag is too weak), ``"out_of_bounds"``, or
        ``"meaning"`` (of an id that is not on the site).
    ids : tuple of int
    message : str
        One line for people.
    """

    code: str
    ids: tuple[int, ...]
    message: str


@dataclass(frozen=True)
class SiteReport:
    """Check of a site.

    Attributes
    ----------
    tags : int
        Number of tags on the site.
    low_m, high_m : (2,) ndarray
        Corners of the rectangle that contains all magnets.
    nearest_m : float
        Smallest distance of the centres of two tags; nan with fewer than two tags.
    nearest_ids : tuple of int
        The two tags; empty with fewer than two.
    separation_m : float
        Distance of two centres from which tags are in separate passes; nan if a tag gives no pass.
    shared_passes : int
        Number of pairs of tags that are closer than that.
    findings : tuple of SiteFinding
    """

    tags: int
    low_m: Array
    high_m: Array
    nearest_m: float
    nearest_ids: tuple[int, ...]
    separation_m: float
    shared_passes: int
    findings: tuple[SiteFinding, ...]


# ---- design


def grid_points(
    rows: int,
    columns: int,
    spacing_m: float,
    origin_m: tuple[float, float] = (0.0, 0.0),
    heading_rad: float = 0.0,
) -> list[SitePoint]:
    """Return the points of a grid, row by row from the origin, with rows along x."""
    check_tag_count(rows * columns)
    return [
        SitePoint(
            origin_m[0] + column * spacing_m,
            origin_m[1] + row * spacing_m,
            heading_rad,
            name=f"row {row}, column {column}",
        )
        for row in range(rows)
        for column in range(columns)
    ]


def route_points(
    waypoints: Sequence[SitePoint], spacing_m: float, min_distance_m: float = 0.0
) -> tuple[list[SitePoint], int]:
    """Return points along a route: at each waypoint, and between so that no gap is larger.

    Points have the heading of the route; a waypoint that of the segment that begins there.

    Parameters
    ----------
    waypoints : sequence of SitePoint
        At least two, none at the position of the previous one. Ids and meanings are kept.
    spacing_m : float
        Largest distance between neighbouring points along the route.
    min_distance_m : float
        Points nearer to an earlier one are left out, because the route comes by again.

    Returns
    -------
    points : list of SitePoint
    left_out : int

    Raises
    ------
    InputError
        There are fewer than two waypoints, two in a row are equal, or there are too many points.
    """
    if len(waypoints) < 2:
        raise InputError("a route of one point", hint="Give two waypoints or more")
    candidates: list[SitePoint] = []
    heading = 0.0
    for start, end in itertools.pairwise(waypoints):
        dx, dy = end.x_m - start.x_m, end.y_m - start.y_m
        length_m = math.hypot(dx, dy)
        if length_m == 0:
            raise InputError(f"{end.name}: the position of the previous waypoint")
        heading = math.atan2(dy, dx)
        steps = max(1, math.ceil(length_m / spacing_m - 1e-9))
        check_tag_count(len(candidates) + steps)
        for step in range(steps):
            fraction = step / steps
            point = SitePoint(
                start.x_m + fraction * dx,
                start.y_m + fraction * dy,
                heading,
                name=f"{fraction * length_m:.3g} m after {start.name}",
            )
            at_start = replace(start, heading_rad=heading)
            candidates.append(point if step else at_start)
    candidates.append(replace(waypoints[-1], heading_rad=heading))
    points: list[SitePoint] = []
    for point in candidates:
        position = np.array([[each.x_m, each.y_m] for each in points]).reshape(-1, 2)
        distance = np.hypot(*(position - [point.x_m, point.y_m]).T)
        if not (distance < min_distance_m).any():
            points.append(point)
    return points, len(candidates) - len(points)


class TooManyTagsError(InputError):
    """A site would have more than :data:`MAX_SITE_TAGS` tags."""


def check_tag_count(count: int) -> None:
    """Raise :class:`TooManyTagsError` for more than :data:`MAX_SITE_TAGS` tags."""
    if count > MAX_SITE_TAGS:
        raise TooManyTagsError(
            f"more than {MAX_SITE_TAGS} tags on a site", hint="Give a larger spacing, in mm"
        )


def place_tags(tags: Tags, points: Sequence[SitePoint], min_distance: int = 1) -> Tags:
    """Return tags with a site: one tag at each point, each with an id of its own.

    Points without an id get the free members of the family in the order of the file. If the tags
    have no family, they become one: the given ids, and those of
    :func:`~locatk.core.polaris.codec.families.generate_family`.

    Parameters
    ----------
    tags : Tags
        Design; its site is replaced. Its meanings are kept for ids of the new site.
    points : sequence of SitePoint
        In the order in which ids are assigned.
    min_distance : int
        Least distance of two members of a generated family.

    Raises
    ------
    InputError
        There are no points, or too many; an id occurs twice, or is not one of the tags; or the
        family has too few members.
    """
    if not points:
        raise InputError("no positions for tags")
    check_tag_count(len(points))
    given: dict[int, str] = {}
    capacity = codec.capacity(tags)
    for point in points:
        if point.tag_id is None:
            continue
        if point.tag_id in given:
            raise InputError(
                f"{point.name}: id {point.tag_id} is also at {given[point.tag_id]}",
                hint="A site has each id once",
            )
        if not 0 <= point.tag_id < capacity:
            raise InputError(
                f"{point.name}: {point.tag_id} is not an id of these tags, whose last one is "
                f"{capacity - 1}"
            )
        if tags.ids is not None and point.tag_id not in tags.ids:
            raise InputError(
                f"{point.name}: id {point.tag_id} is not in the family",
                hint="Leave the ids out to get those of the family, which has "
                + ", ".join(map(str, tags.ids[:MAX_NAMED_IDS]))
                + (" and others" if len(tags.ids) > MAX_NAMED_IDS else ""),
            )
        given[point.tag_id] = point.name
    members, distance = tags.ids, tags.min_distance
    if members is None:
        members, distance = _generate_members(tags, tuple(given), len(points), min_distance)
    free = iter([number for number in members if number not in given])
    missing = len(points) - len(given)
    if missing > len(members) - len(given):
        raise InputError(
            f"{len(points)} positions, but only {len(members)} ids in the family",
            hint=f"Design more tags: locatk tag design --count {len(points)}",
        )
    site, meanings = {}, {}
    for point in points:
        tag_id = next(free) if point.tag_id is None else point.tag_id
        # Sums of floats are not decimal: 0.1 + 0.2 m would be written as 300.00000000000006 mm.
        x_m, y_m = round(point.x_m, POSITION_DECIMALS), round(point.y_m, POSITION_DECIMALS)
        site[tag_id] = PlanarPose(x_m, y_m, point.heading_rad)
        meaning = point.meaning or tags.meanings.get(tag_id, "")
        if meaning:
            meanings[tag_id] = meaning
    return replace(
        tags,
        ids=tuple(members),
        min_distance=distance,
        site=dict(sorted(site.items())),
        site_sigma={},
        meanings=dict(sorted(meanings.items())),
    )


def _generate_members(
    tags: Tags, given: tuple[int, ...], count: int, min_distance: int
) -> tuple[tuple[int, ...], int]:
    """Return a family of ``count`` ids with those that are given, and its minimum distance."""
    if len(given) == count:
        smallest = families.smallest_distance(tags, given) if count > 1 else min_distance
        return given, min(min_distance, smallest)
    if not given:
        return families.generate_family(tags, count, min_distance), min_distance
    # Each given id can exclude several members of the family.
    extra = families.generate_family(
        tags, min(2 * count + 8 * len(given), codec.capacity(tags)), min_distance
    )
    is_far = [
        number
        for number in extra
        if all(families.distance(tags, number, other) >= min_distance for other in given)
    ]
    members = (*given, *is_far[: count - len(given)])
    smallest = families.smallest_distance(tags, members) if len(members) > 1 else min_distance
    return members, min(min_distance, max(smallest, 1))


# ---- check


def check_site(
    tags: Tags,
    use: ReadingConditions | None = None,
    bounds_m: tuple[float, float, float, float] | None = None,
) -> SiteReport:
    """Check the positions of the tags of a site.

    Parameters
    ----------
    tags : Tags
        With a site.
    use : ReadingConditions, optional
        Conditions under which the tags are read.
    bounds_m : (low x, low y, high x, high y), optional
        Rectangle in which all magnets must be.

    Raises
    ------
    InputError
        There is no site, or the design is impossible.
    """
    if not tags.site:
        raise InputError(
            "no tag has a position", hint="Add them with [[site]], or by `locatk site import`"
        )
    use = use or ReadingConditions()
    ids = tuple(tags.site)
    centre_m = np.array([[pose.x_m, pose.y_m] for pose in tags.site.values()])
    nearest_m, nearest_ids = math.nan, tuple[int, ...]()
    tree = cKDTree(centre_m)
    if len(ids) > 1:
        distance_m, neighbour = (np.asarray(each) for each in tree.query(centre_m, 2))
        # Of two tags at one position, either may be the first neighbour.
        first = int(distance_m[:, 1].argmin())
        second = next(k for k in neighbour[first].tolist() if k != first)
        nearest_m = float(distance_m[first, 1])
        nearest_ids = tuple(sorted((ids[first], ids[second])))
    separation_m = pass_separation(tags, use)
    findings: list[SiteFinding] = []
    pairs: set[tuple[int, int]] = set()
    if math.isnan(separation_m):
        findings.append(
            SiteFinding(
                "no_pass",
                (),
                f"the field of a tag is too weak at {length_text(tags.clearance_m)}: no pass is "
                "detected; take larger magnets or less clearance (`locatk tag check`)",
            )
        )
    else:
        pairs = tree.query_pairs(separation_m * (1 - 1e-9))
        findings += _rows_of_tags(ids, centre_m, pairs, separation_m, tags)
    for pair in conflicting_tags(tags):
        findings.append(
            SiteFinding(
                "overlap",
                pair,
                f"tags {pair[0]} and {pair[1]} overlap or continue each other's grid, so that "
                "they are refused (other_design); change their distance by a quarter of the "
                "spacing, or use a family",
            )
        )
    magnets = {tag_id: _magnet_positions(tags, tag_id) for tag_id in ids}
    if bounds_m is not None:
        low, high = np.array(bounds_m[:2]), np.array(bounds_m[2:])
        for tag_id, position_m in magnets.items():
            excess_m = float(np.maximum(low - position_m, position_m - high).max())
            if excess_m > 0:
                message = f"tag {tag_id} is {length_text(excess_m)} out of bounds"
                findings.append(SiteFinding("out_of_bounds", (tag_id,), message))
    for tag_id, meaning in tags.meanings.items():
        if tag_id not in tags.site:
            message = f"id {tag_id} means {meaning!r}, but is not on the site"
            findings.append(SiteFinding("meaning", (tag_id,), message))
    all_m = np.concatenate(list(magnets.values()))
    return SiteReport(
        len(ids),
        all_m.min(axis=0),
        all_m.max(axis=0),
        nearest_m,
        nearest_ids,
        separation_m,
        len(pairs),
        tuple(findings),
    )


def _rows_of_tags(
    ids: tuple[int, ...],
    centre_m: Array,
    pairs: set[tuple[int, int]],
    separation_m: float,
    tags: Tags,
) -> list[SiteFinding]:
    """Return three tags in a row that share a pass, once for each tag in the middle.

    They are in a row if the bar over the middles of the outer ones passes over the middle one.
    """
    neighbours: dict[int, list[int]] = {}
    for one, other in pairs:
        neighbours.setdefault(one, []).append(other)
        neighbours.setdefault(other, []).append(one)
    width_m = (tags.order - 1) * tags.spacing_m
    findings = []
    for middle in sorted(neighbours):
        around = sorted(neighbours[middle])
        for number, first in enumerate(around):
            for last in around[number + 1 :]:
                along = centre_m[last] - centre_m[first]
                length_m = math.hypot(*along)
                offset = centre_m[middle] - centre_m[first]
                if length_m == 0 or not 0 < offset @ along < length_m**2:
                    continue
                lateral_m = abs(float(along[0] * offset[1] - along[1] * offset[0])) / length_m
                if lateral_m < width_m:
                    row = (ids[first], ids[middle], ids[last])
                    break
            else:
                continue
            findings.append(
                SiteFinding(
                    "row",
                    row,
                    f"tags {row[0]}, {row[1]} and {row[2]} are one pass for a robot that drives "
                    f"over them, and at most {MAX_TAGS_IN_PASS} tags in a pass are read; keep "
                    f"their centres {1e3 * separation_m:.6g} mm apart",
                )
            )
            break
    return findings


def pass_separation(tags: Tags, use: ReadingConditions | None = None) -> float:
    """Return the least distance of the centres of two tags that are two passes.

    The bar drives along x over two equal tags. Their magnets are dipoles; the noise of the sensors
    sets the threshold of the detection of passes, but is not part of the field.

    Parameters
    ----------
    tags : Tags
    use : ReadingConditions, optional

    Returns
    -------
    float
        Distance [m] with :data:`SEPARATION_MARGIN`, rounded up to
        :data:`SEPARATION_RESOLUTION_M`; nan if one tag gives no pass.
    """
    use = use or ReadingConditions()
    codec.check_design(tags)
    low_m = max((tags.order - 1) * tags.spacing_m, tags.spacing_m)
    if _count_passes(tags, use, None) == 0:
        return math.nan
    high_m = 2 * low_m
    while _count_passes(tags, use, high_m) < 2:
        low_m, high_m = high_m, 2 * high_m
        if high_m > MAX_SEPARATION_TAGS * tags.order * tags.spacing_m:
            return SEPARATION_MARGIN * high_m
    while high_m - low_m > SEPARATION_RESOLUTION_M / 2:
        middle_m = (low_m + high_m) / 2
        if _count_passes(tags, use, middle_m) < 2:
            low_m = middle_m
        else:
            high_m = middle_m
    steps = SEPARATION_MARGIN * high_m / SEPARATION_RESOLUTION_M
    return math.ceil(steps - 1e-6) * SEPARATION_RESOLUTION_M


def _count_passes(tags: Tags, use: ReadingConditions, distance_m: float | None) -> int:
    """Return the number of passes over two tags at a distance, or over one tag."""
    array, _ = sensor_array(use)
    step_m = use.step_m
    tag_id = next(iter(tags.site), (tags.ids or (0,))[0])
    layout = codec.layout_of(tags, tag_id)
    position_m = cell_positions(tags, layout.cells)
    angle = symbol_angles(tags, layout.symbols)
    centres_m = np.array([0.0] if distance_m is None else [0.0, distance_m])
    position_m = np.concatenate([position_m + [x_m, 0.0] for x_m in centres_m])
    moment = tags.magnet.moment * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    moment = np.tile(moment, (len(centres_m), 1))
    half_m = tags.order * tags.spacing_m + 10 * tags.clearance_m
    margin = 4 * max(CHANGE_LAGS_SAMPLES)
    count = math.ceil((centres_m[-1] + 2 * half_m) / step_m) + 2 * margin
    x_m = (np.arange(count) - margin) * step_m - half_m
    field_t = np.zeros((count, len(array), 3))
    for (magnet_x_m, magnet_y_m), magnet_moment in zip(position_m, moment, strict=True):
        offset = np.empty((count, len(array), 3))
        offset[:, :, 0] = x_m[:, None] + array.position_m[:, 0] - magnet_x_m
        offset[:, :, 1] = array.position_m[:, 1] - magnet_y_m
        offset[:, :, 2] = array.position_m[:, 2] + tags.clearance_m
        field_t += dipole_field(offset, magnet_moment)
    time_ns = np.arange(count, dtype=np.int64)
    noise_t = np.broadcast_to(array.noise_t, (len(array), 3))
    return len(find_passes(Samples("bar", array, time_ns, field_t), noise_t))


def _magnet_positions(tags: Tags, tag_id: int) -> Array:
    """Return the positions (M, 2) of the magnets of a tag on the site."""
    pose = tags.site[tag_id]
    cos, sin = math.cos(pose.heading_rad), math.sin(pose.heading_rad)
    nominal = cell_positions(tags, codec.layout_of(tags, tag_id).cells)
    return nominal @ np.array([[cos, sin], [-sin, cos]]) + [pose.x_m, pose.y_m]
