"""Routes over tags: accuracy of a pass, accuracy along a route, and the spacing of tags.

The pose of the array at a pass has the errors of the field's measurement (Cramer-Rao bound), of the
magnets within the tag, and of the tag on the floor; the last two dominate. Between two passes,
odometry continues (:mod:`locatk.core.routes`).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from locatk.core.error_quantiles import error_quantile, pose_error_quantiles
from locatk.core.errors import InputError
from locatk.core.geometry import rotation_matrix_2d, wrap_angle
from locatk.core.hand_placement import EDGE_SIGMA_M, LAYING_SIGMA_M
from locatk.core.polaris import codec
from locatk.core.polaris.design.accuracy_bound import magnet_covariance, rotate
from locatk.core.polaris.design.planning import (
    NORMAL_QUANTILE,
    PROBABILITY,
    ReadingConditions,
    errors_text,
    sample_layouts,
    sensor_array,
)
from locatk.core.polaris.design.site import (
    MAX_SITE_TAGS,
    SitePoint,
    TooManyTagsError,
    check_tag_count,
    pass_separation,
)
from locatk.core.polaris.identification.matching import (
    AS_BUILT_SIGMA_M,
    HAND_BUILT_SIGMA_M,
    SCALE_SIGMA,
)
from locatk.core.polaris.tag import PlanarPose, TagLayout, Tags, cell_positions
from locatk.core.routes import Route, RouteAccuracy, RouteFix, predict_accuracy
from locatk.core.streaming.planar_filter import OdometryNoise
from locatk.core.units import length_text

Array = NDArray[np.float64]

SAMPLED_LAYOUTS = 4
"""Number of layouts over which the accuracy of a pass is averaged."""

RUN_UP_CLEARANCES = 2.0
"""Length of a straight path before the first and after the last row of a tag, in clearances. The
field of a magnet is a tenth there."""

HEADING_RESOLUTION_RAD, OFFSET_RESOLUTION_M = math.radians(5), 2e-3
"""Passes whose headings and lateral offsets round to the same multiples are of equal accuracy."""

MAX_TURN_RAD = math.radians(20)
"""Largest turn of a route over a tag at which the pass counts. Paths with a radius from 80 mm on
are read in simulation (docs/polaris.md), but nobody has recorded any."""

MAX_SPACING_M = 200.0
"""Largest spacing of tags that is recommended, even for perfect odometry."""

PLANNED_GAPS = 10
"""Number of spacings of the straight route for which :func:`spacing_for_accuracy` plans."""

SPACING_RATIO, ROUTE_SPACING_RATIO = 1.02, 1.05
"""Relative resolution of a planned spacing, on a straight route and on a given one."""

STEPS_PER_SPACING = 8
"""Points per spacing at which the accuracy is computed while a spacing is searched."""

STRAIGHT_ODOMETRY_ERRORS = (
    "scale", "drift_rad_per_m", "distance_m", "heading_rad", "slip_m", "slip_rad",
)  # fmt: skip
"""Errors of odometry on a straight route, fields of ``OdometryNoise``."""

TOLERANCE_M = 1e-8
"""Tolerance of positions [m]: those of a site are rounded to a nanometre."""


# ---- one pass


def tag_fix_covariance(
    tags: Tags,
    use: ReadingConditions | None = None,
    *,
    tag_id: int | None = None,
    heading_rad: float = 0.0,
    offset_m: float = 0.0,
    has_odometry: bool = True,
    laying: tuple[float, float] | None = None,
    build_m: float | None = None,
    noise: OdometryNoise | None = None,
) -> Array:
    """Return the covariance of the pose of the array as it passes the middle of a tag.

    It is that of a weighted fit of the grid to the magnets, whose errors are the measurement
    (:func:`.accuracy_bound.magnet_covariance`), the path of the array (:func:`path_covariance`)
    and their placement, plus the error of the tag on the floor.

    Parameters
    ----------
    tags : Tags
    use : ReadingConditions, optional
    tag_id : int, optional
        By default, an average tag of the family.
    heading_rad, offset_m : float
        Heading of the tag in the frame of the array, and its distance to the left.
    has_odometry : bool
        True if the path of the array is known from odometry. Otherwise it is estimated from the
        field, and the spacing of the tag gives its scale.
    laying : (float, float), optional
        Standard deviations of the position (each axis) and heading of the tag on the floor, in m
        and rad; by default those of the site, otherwise :func:`laying_sigma`.
    build_m : float, optional
        Standard deviation of the position of a magnet in the tag along each axis; by default that
        of magnets placed by hand, or of tags that were measured as built.
    noise : OdometryNoise, optional
        Errors of odometry, or of a path that is assumed to be straight.

    Returns
    -------
    (3, 3) ndarray
        Of x (forward), y (left) and heading, in the axes of the array, in m and rad.

    Raises
    ------
    InputError
        The samples do not determine the magnets: too few, or too weak a field.
    """
    use = use or ReadingConditions()
    array, _ = sensor_array(use)
    layouts = sample_layouts(tags, SAMPLED_LAYOUTS)
    if tag_id is not None:
        layouts = [codec.layout_of(tags, tag_id)]
    if build_m is None:
        build_m = AS_BUILT_SIGMA_M if tag_id in tags.built else HAND_BUILT_SIGMA_M
    noise = noise or OdometryNoise()
    matches = []
    for layout in layouts:
        measured = magnet_covariance(
            tags,
            layout,
            array,
            step_m=use.step_m,
            heading_rad=heading_rad,
            offset_m=offset_m,
            nuisance="strength" if has_odometry else "steps",
            environment=use.environment,
        )
        along_m = rotate(cell_positions(tags, layout.cells), heading_rad)[:, 0]
        by_path = path_covariance(along_m, noise, has_scale=has_odometry)
        scale_sigma = None if has_odometry else SCALE_SIGMA
        matches.append(
            _match_covariance(tags, layout, measured + by_path, heading_rad, build_m, scale_sigma)
        )
    # The error of the array is the opposite of the tag's in the array's frame, about the tag.
    jacobian = np.diag([-1.0, -1.0, -1.0])
    jacobian[0, 2] = -offset_m
    covariance = jacobian @ np.mean(matches, axis=0) @ jacobian.T
    by_tag = np.eye(3)
    by_tag[0, 2] = offset_m
    laid = by_tag @ _laying_covariance(tags, tag_id, heading_rad, laying) @ by_tag.T
    return np.asarray(covariance + laid)


def path_covariance(along_m: Array, noise: OdometryNoise, *, has_scale: bool) -> Array:
    """Return the covariance (3 M, 3 M) of x, y and angle of magnets by errors of the path.

    The path over a tag is that of odometry, or straight. From the middle of the tag outwards, its
    heading has a drift and a random walk, and the bar is displaced across by its integral. A magnet
    is measured where the bar passes it.

    Parameters
    ----------
    along_m : (M,) ndarray
        Positions of the magnets along the path, from the middle of the tag.
    noise : OdometryNoise
    has_scale : bool
        True if the scale of the path is that of odometry, with its error.
    """
    s = np.abs(along_m)
    side = np.sign(along_m)
    is_same_side = side[:, None] * side[None, :] > 0
    first, last = np.minimum(s[:, None], s[None, :]), np.maximum(s[:, None], s[None, :])
    variance = noise.heading_rad**2 * is_same_side
    walk_angle = variance * first
    walk_across = variance * first**2 * (3 * last - first) / 6
    # Covariance of the heading at row i with the displacement at column j.
    walk_mixed = np.where(
        s[:, None] <= s[None, :], s[:, None] * (s[None, :] - s[:, None] / 2), s[None, :] ** 2 / 2
    )
    walk_mixed = variance * walk_mixed * side[None, :]
    # The heading of a drift is proportional to the distance, its displacement to the square.
    by_drift = np.zeros(3 * len(s))
    by_drift[1::3], by_drift[2::3] = along_m**2 / 2, along_m
    result = noise.drift_rad_per_m**2 * np.outer(by_drift, by_drift)
    result[1::3, 1::3] += walk_across
    result[2::3, 2::3] += walk_angle
    result[2::3, 1::3] += walk_mixed
    result[1::3, 2::3] += walk_mixed.T
    if has_scale:
        result[0::3, 0::3] += noise.scale**2 * np.outer(along_m, along_m)
    return np.asarray(result)


def laying_sigma(tags: Tags) -> tuple[float, float]:
    """Return standard deviations of position [m] and heading [rad] of a tag laid by hand.

    The heading is set by an edge of the sheet, which is a spacing longer than the grid.
    """
    edge_m = tags.order * tags.spacing_m
    return LAYING_SIGMA_M, math.sqrt(2) * EDGE_SIGMA_M / edge_m


def _laying_covariance(
    tags: Tags, tag_id: int | None, heading_rad: float, laying: tuple[float, float] | None
) -> Array:
    """Return the covariance (3, 3) of a tag on the floor, in the axes of the array."""
    if laying is not None or tag_id is None or tag_id not in tags.site_sigma:
        position_m, angle_rad = laying or laying_sigma(tags)
        return np.diag(np.square([position_m, position_m, angle_rad]))
    # Standard deviations of a site are along its axes.
    site_rad = heading_rad - tags.site[tag_id].heading_rad
    rotation = np.eye(3)
    rotation[:2, :2] = rotation_matrix_2d(site_rad)
    return np.asarray(rotation @ np.diag(np.square(tags.site_sigma[tag_id])) @ rotation.T)


def _match_covariance(
    tags: Tags,
    layout: TagLayout,
    covariance: Array,
    heading_rad: float,
    build_m: float,
    scale_sigma: float | None,
) -> Array:
    """Return the covariance (3, 3) of the tag's pose in the frame of the array.

    Unknowns are x, y, heading and, with ``scale_sigma``, the scale of lengths along the track.
    """
    position_m = rotate(cell_positions(tags, layout.cells), heading_rad)
    rows = np.flatnonzero(np.arange(len(covariance)) % 3 < 2)
    jacobian = np.zeros((len(rows), 4))
    jacobian[0::2, 0] = jacobian[1::2, 1] = 1.0
    jacobian[0::2, 2], jacobian[1::2, 2] = -position_m[:, 1], position_m[:, 0]
    jacobian[0::2, 3] = position_m[:, 0]
    total = covariance[np.ix_(rows, rows)] + build_m**2 * np.eye(len(rows))
    information = jacobian.T @ np.linalg.solve(total, jacobian)
    if scale_sigma is None:
        return np.asarray(np.linalg.inv(information[:3, :3]))
    information[3, 3] += 1 / scale_sigma**2
    return np.asarray(np.linalg.inv(information)[:3, :3])


# ---- passes of a route


@dataclass(frozen=True)
class TagPass:
    """A tag that the array passes.

    Attributes
    ----------
    tag_id : int
    distance_m : float
        Along the route, to the middle of the tag.
    offset_m : float
        Distance of the tag's middle to the left of the route.
    heading_rad : float
        Heading of the tag in the frame of the array.
    play_m : float
        Largest further lateral offset at which all magnets are below the array.
    """

    tag_id: int
    distance_m: float
    offset_m: float
    heading_rad: float
    play_m: float


def find_tag_passes(
    tags: Tags, route: Route, use: ReadingConditions | None = None
) -> list[TagPass]:
    """Return the tags whose magnets all pass below the array, in the order of the route.

    A tag counts if the whole of it is passed on one segment, or on two with a turn of at most
    :data:`MAX_TURN_RAD` in between.
    """
    use = use or ReadingConditions()
    half_array_m = use.array_m / 2
    start_m = np.concatenate([[0.0], np.cumsum(route.segment_m)])
    is_sharp = _sharp_turns(route)
    half_m = (tags.order - 1) / 2 * tags.spacing_m
    corners = half_m * np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]])
    ids = list(tags.site)
    middle_m = np.array([[pose.x_m, pose.y_m] for pose in tags.site.values()]).reshape(-1, 2)
    passes: list[TagPass] = []
    for k, heading in enumerate(route.heading_rad.tolist()):
        length_m = float(route.segment_m[k])
        local_m = rotate(middle_m - route.waypoint_m[k], -heading)
        is_near = np.abs(local_m[:, 1]) <= half_array_m
        is_near &= np.abs(local_m[:, 0] - length_m / 2) <= length_m / 2 + 2 * half_m
        for number in np.flatnonzero(is_near).tolist():
            tag_id = ids[number]
            pose = tags.site[tag_id]
            along_m, left_m = local_m[number].tolist()
            relative = math.remainder(pose.heading_rad - heading, math.tau)
            corners_m = rotate(corners, relative)
            half_length_m = float(corners_m[:, 0].max())
            first_m = half_length_m if is_sharp[k] else -half_length_m
            last_m = length_m + (-half_length_m if is_sharp[k + 1] else half_length_m)
            if not first_m - TOLERANCE_M <= along_m <= last_m + TOLERANCE_M:
                continue
            play_m = half_array_m - abs(left_m) - float(corners_m[:, 1].max())
            if play_m >= -TOLERANCE_M:
                distance_m = float(start_m[k] + min(max(along_m, 0.0), length_m))
                passes.append(TagPass(tag_id, distance_m, left_m, relative, max(play_m, 0.0)))
    passes.sort(key=lambda each: each.distance_m)
    # A tag at a waypoint without a sharp turn is on both segments, and passed once.
    last_at: dict[int, float] = {}
    result = []
    for each in passes:
        if each.distance_m - last_at.get(each.tag_id, -math.inf) > 2 * half_m:
            result.append(each)
        last_at[each.tag_id] = each.distance_m
    return result


def _sharp_turns(route: Route) -> NDArray[np.bool_]:
    """Return whether a tag at each waypoint (n,) is not passed: at turns, start and end."""
    turn_rad = wrap_angle(np.diff(route.heading_rad))
    return np.concatenate([[True], np.abs(turn_rad) > MAX_TURN_RAD, [True]])


# ---- forecast


@dataclass(frozen=True, eq=False)
class RouteForecast:
    """Expected accuracy along one route.

    Attributes
    ----------
    route : Route
    passes : tuple of TagPass
    accuracy : RouteAccuracy
    missed : tuple of (TagPass, float)
        Tags beside which the array may pass, and the lateral error before each that is not
        exceeded with 95 % [m]; it is larger than the play.
    """

    route: Route
    passes: tuple[TagPass, ...]
    accuracy: RouteAccuracy
    missed: tuple[tuple[TagPass, float], ...] = ()


@dataclass(frozen=True, eq=False)
class SiteForecast:
    """Expected accuracy of a robot that drives routes over a site.

    Attributes
    ----------
    routes : tuple of RouteForecast
    length_m : float
        Length of all routes.
    tags : int
        Number of tags that are passed on any route.
    position_p95_m, heading_p95_rad : float
        Errors that are not exceeded with a probability of 95 % where the pose is known; ``inf``
        if no tag is passed.
    fix_position_p95_m, fix_heading_p95_rad : float
        The same at the tags, as measured by one pass.
    covered_fraction : float
        Part of the length on which the pose is known: from the first tag on.
    longest_gap_m : float
        Longest stretch without a tag.
    worst_m : (2,) ndarray
        Place on the floor with the largest expected error; ``nan`` if no tag is passed.
    worst_position_p95_m : float
        Error there that is not exceeded with 95 %.
    warnings : tuple of str
    """

    routes: tuple[RouteForecast, ...]
    length_m: float
    tags: int
    position_p95_m: float
    heading_p95_rad: float
    fix_position_p95_m: float
    fix_heading_p95_rad: float
    covered_fraction: float
    longest_gap_m: float
    worst_m: Array
    worst_position_p95_m: float
    warnings: tuple[str, ...] = ()


def forecast_routes(
    tags: Tags,
    routes: Sequence[Route],
    use: ReadingConditions | None = None,
    noise: OdometryNoise | None = None,
    *,
    laying: tuple[float, float] | None = None,
    is_smoothed: bool = False,
) -> SiteForecast:
    """Forecast the accuracy of a robot that drives routes over a site.

    Each route is a drive of its own: its pose is unknown until the first tag.

    Parameters
    ----------
    tags : Tags
        With a site.
    routes : sequence of Route
        At least one.
    use : ReadingConditions, optional
    noise : OdometryNoise, optional
    laying : (float, float), optional
        See :func:`tag_fix_covariance`.
    is_smoothed : bool
        False: accuracy of ``locatk live``, which knows the tags behind it. True: that of an
        estimate from the whole recording.

    Raises
    ------
    InputError
        There is no route, or the design is impossible.
    """
    use, noise = use or ReadingConditions(), noise or OdometryNoise()
    if not routes:
        raise InputError("no route")
    codec.check_design(tags)
    pass_covariance = _PassCovariances(tags, use, laying, noise)
    forecasts, fixes, warnings = [], [], list[str]()
    for route in routes:
        passes = tuple(find_tag_passes(tags, route, use))
        covariances = [pass_covariance(each) for each in passes]
        accuracy = predict_accuracy(
            route,
            [RouteFix(p.distance_m, c) for p, c in zip(passes, covariances, strict=True)],
            noise,
            use.speed_mps,
            is_smoothed=is_smoothed,
        )
        fixes += covariances
        lateral = [(each, lateral_p95_m(accuracy, each.distance_m)) for each in passes]
        missed = tuple(pair for pair in lateral if pair[1] > pair[0].play_m)
        forecasts.append(RouteForecast(route, passes, accuracy, missed))
        warnings += _route_warnings(tags, use, forecasts[-1])
    covariance = np.concatenate([each.accuracy.covariance for each in forecasts])
    weight = np.concatenate([each.accuracy.weight_m for each in forecasts])
    is_known = np.isfinite(covariance).all(axis=(1, 2))
    worst_m, worst = np.full(2, math.nan), np.full((1, 3, 3), math.inf)
    if is_known.any():
        variance = np.where(is_known, np.trace(covariance[:, :2, :2], axis1=1, axis2=2), -1.0)
        k = int(variance.argmax())
        worst_m = np.concatenate([each.accuracy.position_m for each in forecasts])[k]
        worst = covariance[k : k + 1]
    fixed = np.array(fixes).reshape(-1, 3, 3)
    position_p95_m, heading_p95_rad = _quantiles(covariance[is_known], weight[is_known])
    fix_position_p95_m, fix_heading_p95_rad = _quantiles(fixed, np.ones(len(fixed)))
    return SiteForecast(
        routes=tuple(forecasts),
        length_m=sum(route.length_m for route in routes),
        tags=len({each.tag_id for forecast in forecasts for each in forecast.passes}),
        position_p95_m=position_p95_m,
        heading_p95_rad=heading_p95_rad,
        fix_position_p95_m=fix_position_p95_m,
        fix_heading_p95_rad=fix_heading_p95_rad,
        covered_fraction=float(weight[is_known].sum() / weight.sum()),
        longest_gap_m=max(each.accuracy.longest_without_fix_m for each in forecasts),
        worst_m=worst_m,
        worst_position_p95_m=error_quantile(worst[:, :2, :2], PROBABILITY),
        warnings=tuple(warnings),
    )


class _PassCovariances:
    """Covariances of passes over the tags of a site; equal passes are computed once."""

    def __init__(
        self,
        tags: Tags,
        use: ReadingConditions,
        laying: tuple[float, float] | None,
        noise: OdometryNoise,
    ) -> None:
        self._tags, self._use, self._laying, self._noise = tags, use, laying, noise
        self._known: dict[tuple[object, ...], Array] = {}

    def __call__(self, tag_pass: TagPass) -> Array:
        tag_id = tag_pass.tag_id
        is_special = tag_id in self._tags.built or tag_id in self._tags.site_sigma
        heading = round(tag_pass.heading_rad / HEADING_RESOLUTION_RAD)
        offset = round(tag_pass.offset_m / OFFSET_RESOLUTION_M)
        key = (tag_id if is_special else None, heading, offset)
        if key not in self._known:
            self._known[key] = tag_fix_covariance(
                self._tags,
                self._use,
                tag_id=tag_id if is_special else None,
                heading_rad=heading * HEADING_RESOLUTION_RAD,
                offset_m=offset * OFFSET_RESOLUTION_M,
                laying=self._laying,
                noise=self._noise,
            )
        return self._known[key]


def _quantiles(covariance: Array, weight: Array) -> tuple[float, float]:
    """Return the quantiles of the errors of position and heading; ``inf`` without covariances."""
    if not len(covariance):
        return math.inf, math.inf
    return pose_error_quantiles(covariance, PROBABILITY, weight)


def _route_warnings(tags: Tags, use: ReadingConditions, forecast: RouteForecast) -> list[str]:
    """Describe where a robot may miss the tags of a route."""
    name, passes = forecast.route.name, forecast.passes
    if not passes:
        tag_m = (tags.order - 1) * tags.spacing_m
        return [
            f"on route {name}, no tag passes wholly below the array of {length_text(use.array_m)}; "
            f"a tag is {length_text(tag_m)} wide, and a robot that turns over it cannot read it"
        ]
    missed = forecast.missed
    if not missed:
        return []
    first, lateral_m = max(missed, key=lambda pair: pair[1] - pair[0].play_m)
    number = "1 tag" if len(missed) == 1 else f"{len(missed)} of {len(passes)} tags"
    return [
        f"on route {name}, {number} may be missed: before tag {first.tag_id} the robot is off by "
        f"up to {length_text(lateral_m)} across (95 %), and all magnets are below the array up to "
        f"{length_text(first.play_m)}; lay tags closer together, or take a wider array"
    ]


def lateral_p95_m(accuracy: RouteAccuracy, distance_m: float) -> float:
    """Return the error across the route, before a fix, that is not exceeded with 95 % [m].

    0 if the pose is unknown: the robot is then led to the tag.
    """
    row = int(np.searchsorted(accuracy.distance_m, distance_m - TOLERANCE_M))
    covariance = accuracy.covariance[min(row, len(accuracy.covariance) - 1)]
    if not np.isfinite(covariance).all():
        return 0.0
    return NORMAL_QUANTILE * math.sqrt(covariance[1, 1])


# ---- spacing


@dataclass(frozen=True)
class SpacingPlan:
    """Spacing of tags for a wanted accuracy.

    Attributes
    ----------
    is_feasible : bool
        True if ``spacing_m`` gives the wanted accuracy.
    spacing_m : float
        The largest one that gives it; otherwise the smallest at which tags are separate passes.
    position_p95_m, heading_p95_rad : float
        Errors along the route at this spacing, not exceeded with 95 %.
    fix_position_p95_m, fix_heading_p95_rad : float
        The same of a single pass, the limit for dense tags.
    limited_by : {"position", "heading", "play", "maximum", "field", "length", "count"}
        Reason for no larger spacing (if feasible) or no accuracy (if not): error of position or
        heading; lateral error at which the array would miss the next tag; :data:`MAX_SPACING_M`;
        a field that is too weak for any pass; a route without a straight part that is long enough
        for a tag; or one that needs more than :data:`.site.MAX_SITE_TAGS` tags.
    remedies : tuple of str
        Changes that would help if the accuracy is impossible, with their effect.
    """

    is_feasible: bool
    spacing_m: float
    position_p95_m: float
    heading_p95_rad: float
    fix_position_p95_m: float
    fix_heading_p95_rad: float
    limited_by: str
    remedies: tuple[str, ...] = ()


def spacing_for_accuracy(
    tags: Tags,
    use: ReadingConditions | None = None,
    noise: OdometryNoise | None = None,
    position_m: float = math.inf,
    heading_rad: float = math.inf,
    *,
    laying: tuple[float, float] | None = None,
) -> SpacingPlan:
    """Return the largest spacing of tags along a straight route that keeps the wanted accuracy.

    The route has :data:`PLANNED_GAPS` spacings and begins at a tag. The accuracy is that of a
    filter (``locatk live``) with a probability of 95 %, and the lateral error before a tag must be
    less than the play of the array.

    Parameters
    ----------
    tags : Tags
    use : ReadingConditions, optional
    noise : OdometryNoise, optional
    position_m, heading_rad : float
        Errors that must not be exceeded with 95 %.
    laying : (float, float), optional
        See :func:`tag_fix_covariance`.

    Raises
    ------
    InputError
        A wanted error is not positive, or the design is impossible.
    """
    use, noise = use or ReadingConditions(), noise or OdometryNoise()
    if not (position_m > 0 and heading_rad > 0):
        raise InputError("a wanted accuracy must be above 0", hint="Give mm and degrees")
    codec.check_design(tags)
    smallest_m = pass_separation(tags, use)
    try:
        fix = tag_fix_covariance(tags, use, laying=laying, noise=noise)
    except InputError:
        smallest_m = math.nan
    if math.isnan(smallest_m):
        remedy = "take larger magnets, less clearance or a lower speed (`locatk tag design`)"
        unknown = math.inf, math.inf
        return SpacingPlan(False, math.nan, *unknown, *unknown, "field", (remedy,))
    single = _quantiles(fix[None], np.ones(1))
    play_m = (use.array_m - (tags.order - 1) * tags.spacing_m) / 2

    def limits(spacing_m: float) -> tuple[tuple[float, float, float], tuple[str, ...]]:
        """Return the errors of position, heading, and across before a tag, and exceeded limits."""
        route = Route(np.array([[0.0, 0.0], [PLANNED_GAPS * spacing_m, 0.0]]))
        tags_m = np.minimum(spacing_m * np.arange(PLANNED_GAPS + 1), route.length_m).tolist()
        accuracy = predict_accuracy(
            route,
            [RouteFix(distance_m, fix) for distance_m in tags_m],
            noise,
            use.speed_mps,
            step_m=spacing_m / STEPS_PER_SPACING,
        )
        errors = (
            *accuracy.quantiles(),
            max(lateral_p95_m(accuracy, distance_m) for distance_m in tags_m[1:]),
        )
        exceeded = {
            "position": errors[0] > position_m,
            "heading": errors[1] > heading_rad,
            "play": errors[2] > play_m,
        }
        return errors, tuple(name for name, is_exceeded in exceeded.items() if is_exceeded)

    errors, exceeded = limits(smallest_m)
    if exceeded:
        wanted = position_m, heading_rad
        remedies = _remedies(tags, use, noise, wanted, single, errors[2] - play_m, laying)
        return SpacingPlan(False, smallest_m, *errors[:2], *single, exceeded[0], remedies)
    low_m, high_m = smallest_m, MAX_SPACING_M
    largest_errors, exceeded = limits(high_m)
    if not exceeded:
        return SpacingPlan(True, high_m, *largest_errors[:2], *single, "maximum")
    while high_m > SPACING_RATIO * low_m:
        middle_m = math.sqrt(low_m * high_m)
        middle_errors, middle_exceeded = limits(middle_m)
        if middle_exceeded:
            high_m, exceeded = middle_m, middle_exceeded
        else:
            low_m, errors = middle_m, middle_errors
    return SpacingPlan(True, low_m, *errors[:2], *single, exceeded[0])


def _remedies(
    tags: Tags,
    use: ReadingConditions,
    noise: OdometryNoise,
    wanted: tuple[float, float],
    single: tuple[float, float],
    excess_m: float,
    laying: tuple[float, float] | None,
) -> tuple[str, ...]:
    """Describe what would have to change for an accuracy that no spacing gives.

    ``excess_m`` is the lateral error before a tag less the play of the array.
    """
    if single[0] > wanted[0] or single[1] > wanted[1]:

        def after(build_m: float | None) -> str:
            exact = tag_fix_covariance(tags, use, laying=(0.0, 0.0), build_m=build_m, noise=noise)
            return errors_text(*_quantiles(exact[None], np.ones(1)))

        return (
            f"a single pass has errors of {errors_text(*single)} (95 %): the tags are laid to "
            f"{errors_text(*(laying or laying_sigma(tags)))} and their magnets to "
            f"{length_text(HAND_BUILT_SIGMA_M)} rms",
            f"survey the tags (`locatk site survey`): up to {after(None)}",
            "also measure the magnets as built (`locatk calibrate tag`): up to "
            f"{after(AS_BUILT_SIGMA_M)}",
        )
    if excess_m > 0:
        needed = use.sensors + math.ceil(2 * excess_m / use.sensor_spacing_m)
        return (f"the robot misses tags: take a wider array, of {needed} sensors or more",)
    better = replace(noise, **{name: getattr(noise, name) / 2 for name in STRAIGHT_ODOMETRY_ERRORS})
    plan = spacing_for_accuracy(tags, use, better, *wanted, laying=laying)
    if plan.is_feasible:
        return (
            "calibrate the odometry: half of its errors allows tags "
            f"{length_text(plan.spacing_m)} apart",
        )
    return ("take odometry with less than half of these errors",)


def points_along_route(
    tags: Tags, waypoints: Sequence[SitePoint], spacing_m: float, min_spacing_m: float = 0.0
) -> tuple[Route, list[SitePoint]]:
    """Return a route, and points for tags along it that are passed straight.

    Waypoints with an id or a meaning are points for tags themselves. Between sharp turns, tags are
    evenly distributed, at most ``spacing_m`` apart: the first one as soon after the turn as it can
    be passed straight, so that the heading after the turn is known. Points nearer to others than
    the size of a tag are left out: the route comes by again.

    Parameters
    ----------
    tags : Tags
    waypoints : sequence of SitePoint
        At least two.
    spacing_m, min_spacing_m : float
        Largest and smallest distance between neighbours; if no number of tags fits both, the
        smallest counts.

    Raises
    ------
    InputError
        The waypoints are no route, or there are too many points.
    """
    route = Route(np.array([[point.x_m, point.y_m] for point in waypoints]))
    half_m = (tags.order - 1) / 2 * tags.spacing_m
    margin_m = half_m + RUN_UP_CLEARANCES * tags.clearance_m
    start_m = np.concatenate([[0.0], np.cumsum(route.segment_m)])
    ends_m = start_m[_sharp_turns(route)]
    distances_m: list[float] = []

    def gaps(length_m: float) -> int:
        most = math.floor(length_m / min_spacing_m + 1e-9) if min_spacing_m > 0 else MAX_SITE_TAGS
        return min(math.ceil(length_m / spacing_m - 1e-9), most)

    for number, (first_m, last_m) in enumerate(itertools.pairwise(ends_m.tolist())):
        usable_m = last_m - first_m - 2 * margin_m
        if usable_m < 0:
            continue
        if number == len(ends_m) - 2:
            count = gaps(usable_m) + 1
            along = np.linspace(first_m + margin_m, last_m - margin_m, count)
        else:
            # The next tag is as far behind the turn as the first one is behind this one.
            count = max(1, gaps(last_m - first_m))
            along = first_m + margin_m + (last_m - first_m) / count * np.arange(count)
            along = along[along <= last_m - margin_m + TOLERANCE_M]
        check_tag_count(len(distances_m) + count)
        distances_m += along.tolist()
    position_m, heading = route.at(np.array(distances_m))
    headings = np.append(route.heading_rad, route.heading_rad[-1]).tolist()
    points = [
        replace(point, heading_rad=angle)
        for point, angle in zip(waypoints, headings, strict=True)
        if point.tag_id is not None or point.meaning
    ]
    size_m = tags.order * tags.spacing_m
    taken = [complex(point.x_m, point.y_m) for point in points]
    for distance_m, (x_m, y_m), angle in zip(
        distances_m, position_m.tolist(), heading.tolist(), strict=True
    ):
        position = complex(x_m, y_m)
        if taken and np.abs(np.array(taken) - position).min() < size_m - TOLERANCE_M:
            continue
        taken.append(position)
        points.append(SitePoint(x_m, y_m, angle, name=f"{distance_m:.3g} m along the route"))
    return route, points


def plan_route(
    tags: Tags,
    waypoints: Sequence[SitePoint],
    use: ReadingConditions | None = None,
    noise: OdometryNoise | None = None,
    position_m: float = math.inf,
    heading_rad: float = math.inf,
    *,
    laying: tuple[float, float] | None = None,
) -> tuple[list[SitePoint], SpacingPlan]:
    """Return points for tags along a route with a wanted accuracy, and the plan of their spacing.

    It begins with the spacing for a straight route, which is reduced until the forecast for this
    route (turns, tags that are not passed) has the accuracy, too. If that is impossible, the
    points are those of the smallest spacing; none if these are more than a site may have.

    The parameters and errors are those of :func:`spacing_for_accuracy` and
    :func:`points_along_route`.
    """
    plan = spacing_for_accuracy(tags, use, noise, position_m, heading_rad, laying=laying)
    try:
        return _points_for_plan(
            plan, tags, waypoints, use, noise, position_m, heading_rad, laying=laying
        )
    except TooManyTagsError:
        remedy = f"divide the route into sites of at most {MAX_SITE_TAGS} tags"
        return [], replace(plan, is_feasible=False, limited_by="count", remedies=(remedy,))


def _points_for_plan(
    plan: SpacingPlan,
    tags: Tags,
    waypoints: Sequence[SitePoint],
    use: ReadingConditions | None,
    noise: OdometryNoise | None,
    position_m: float,
    heading_rad: float,
    *,
    laying: tuple[float, float] | None,
) -> tuple[list[SitePoint], SpacingPlan]:
    """Adapt the plan for a straight route to a given one; see :func:`plan_route`.

    Raises :class:`.site.TooManyTagsError` if a trial needs too many tags.
    """
    smallest_m = pass_separation(tags, use)
    if math.isnan(smallest_m):
        return [], plan

    def forecast(spacing_m: float) -> tuple[list[SitePoint], SiteForecast]:
        route, points = points_along_route(tags, waypoints, spacing_m, smallest_m)
        site = {k: PlanarPose(p.x_m, p.y_m, p.heading_rad) for k, p in enumerate(points)}
        trial = replace(tags, site=site, built={}, site_sigma={}, ids=None)
        return points, forecast_routes(trial, [route], use, noise, laying=laying)

    def is_enough(result: SiteForecast) -> bool:
        missed = any(forecast.missed for forecast in result.routes)
        return (
            result.position_p95_m <= position_m
            and result.heading_p95_rad <= heading_rad
            and not missed
        )

    low_m, high_m = smallest_m, plan.spacing_m
    route = Route(np.array([[point.x_m, point.y_m] for point in waypoints]))
    check_tag_count(math.floor(route.length_m / plan.spacing_m))
    points, result = forecast(high_m)
    if result.tags == 0 and plan.limited_by != "play":
        straight_m = (tags.order - 1) * tags.spacing_m + 2 * RUN_UP_CLEARANCES * tags.clearance_m
        remedy = f"a tag needs a straight part of {length_text(straight_m)}: take a longer route"
        plan = replace(plan, is_feasible=False, limited_by="length", remedies=(remedy,))
    elif is_enough(result):
        plan = replace(plan, is_feasible=True, remedies=())
    elif plan.is_feasible:
        points, result = forecast(low_m)
        limit = "heading" if result.heading_p95_rad > heading_rad else "position"
        remedy = (
            "turns, and the stretches beside them without a tag, limit the accuracy: take a route "
            "with fewer turns, or calibrate the odometry"
        )
        is_feasible = is_enough(result)
        while is_feasible and high_m > ROUTE_SPACING_RATIO * low_m:
            middle_m = math.sqrt(low_m * high_m)
            middle_points, middle = forecast(middle_m)
            if is_enough(middle):
                low_m, points, result = middle_m, middle_points, middle
            else:
                high_m = middle_m
        plan = replace(plan, is_feasible=is_feasible, spacing_m=low_m)
        if not is_feasible:
            plan = replace(plan, limited_by=limit, remedies=(remedy,))
    plan = replace(
        plan, position_p95_m=result.position_p95_m, heading_p95_rad=result.heading_p95_rad
    )
    return points, plan
