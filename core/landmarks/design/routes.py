"""Routes over a landmark map: landmarks that are read, where the robot is localized, accuracy.

A robot that follows a route passes some landmarks. Each pass is a fix, whose covariance is the
bound of :mod:`.visit_accuracy` plus the errors of the landmark's installation; odometry carries the
pose between fixes (:mod:`locatk.core.routes`). A pose on the map is known once no other cell and
heading of the map would have read the same landmarks along the same route
(:func:`count_matching_poses`), and final once the cell filter of the solver is certain
(:mod:`.final_poses`).

Nothing here is simulated or measured. Landmarks count as they were built, as far as that is known.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from locatk.core.error_quantiles import pose_error_quantiles
from locatk.core.errors import InputError
from locatk.core.geometry import rotation_matrix_2d
from locatk.core.landmarks.design.final_poses import MapEvidence
from locatk.core.landmarks.design.visit_accuracy import (
    STEP_M,
    STEP_RAD,
    VISIT_MARGIN_M,
    VisitAccuracy,
    VisitErrors,
    installation_covariance,
    predict_visit,
    sensor_arms,
    straight_path,
    visit_range,
)
from locatk.core.landmarks.field import basis
from locatk.core.landmarks.halls import circle
from locatk.core.landmarks.landmark import CODE_COUNT, PATTERNS, Geometry, code_of, signs
from locatk.core.landmarks.map.floor import (
    HOLE_CODE,
    Cell,
    FloorMap,
    as_built_codes,
    as_built_landmark,
)
from locatk.core.landmarks.map.windows import letters_as_read
from locatk.core.landmarks.preprocessing import (
    MIN_FIELD_SIGMAS,
    MIN_FIELD_THRESHOLDS,
    MIN_PEAK_THRESHOLDS,
)
from locatk.core.landmarks.solver import SolveOptions
from locatk.core.routes import Route, RouteAccuracy, RouteFix, predict_accuracy
from locatk.core.streaming.planar_filter import OdometryNoise
from locatk.core.trajectory import PROVISIONAL_PROBABILITY

Array = NDArray[np.float64]

MAX_LINK_SIGMAS = 3.0
"""Standard deviations of the dead reckoning that must be below half a pitch, so that the cell of
the next landmark is certain."""

MAX_VISIT_POINTS = 400
"""Points of a visit at most; a longer one is evaluated at every second, third ... point."""

MAX_ROUTE_M = 10_000.0
"""Longest route; 10 km have 2.5 million points."""

PASS_STEP_M = 5e-3
"""Distances of passes that are tried [m]."""

SHIFT_STEPS = 8
"""Shifts of a route that are tried along each axis, over one pitch."""

MIN_SHIFT_GAIN, MIN_SHIFT_GAIN_PITCHES = 0.25, 0.5
"""Part of the longest stretch without a landmark, and length in pitches, by which a shift must
shorten it to be named."""

MIN_FLATNESS = 0.5
"""Ratio of the smallest and the largest standard deviation on a route from which on the errors of
the fixes, not those of the odometry, limit the accuracy."""

LONGER_ROUTE = "make the route longer, or design a map for a shorter window"
"""Remedy of a route with too few landmarks."""

MAX_NAMED_LANDMARKS = 5
"""Landmarks that a warning names."""

FORECAST_ROUTES = 24
FORECAST_PITCHES = 14
"""Straight routes of a forecast, and their length in pitches: 300 landmarks."""


@dataclass(frozen=True, eq=False)
class RouteVisit:
    """Pass of a robot over one landmark.

    Attributes
    ----------
    cell : (row, column)
    distance_m : float
        Along the route, of the point next to the landmark's centre.
    offset_m : float
        Distance of that point from the centre.
    accuracy : VisitAccuracy
        Relative to the landmark, at the point of the fix.
    fix : RouteFix
        On the map, installation of the landmark included (:func:`find_visits`).
    """

    cell: Cell
    distance_m: float
    offset_m: float
    accuracy: VisitAccuracy
    fix: RouteFix

    @property
    def is_read(self) -> bool:
        """True if the visit gives a pose, and the code beyond reasonable doubt."""
        return self.accuracy.is_read


@dataclass(frozen=True, eq=False)
class RouteCheck:
    """Prediction for one route.

    Attributes
    ----------
    route : Route
    visits : tuple of RouteVisit
        In the order of the route; those that give no pose or no certain code included.
    localized_after, final_after : int or None
        Number of different landmarks that were read until the robot is localized, and until its
        poses are final; None if that does not happen on this route.
    localized_m, final_m : float or None
        Distances along the route.
    ambiguous_places : int
        Places and headings of the map, besides the true one, that read the same along the whole
        route; 0 if the robot is localized.
    accuracy : RouteAccuracy
        Of a filter with the fixes since the robot was localized, or of a smoother with all fixes.
    longest_m : (float, float)
        Start and end of the longest stretch without a fix, along the route.
    covered_fraction : float
        Fraction of the route on which the robot knows its pose without a prior: that after
        :attr:`localized_m`; with smoothing, all of the route if the robot is localized.
    position_sigma_m, heading_sigma_rad : float
        Largest standard deviations on the covered part (position: both axes together); ``nan`` if
        nothing is covered.
    position_p95_m, heading_p95_rad : float
        Errors that are not exceeded on 95 % of the covered part.
    warnings : tuple of str
        The route is not localizable, or not as accurate as wanted: with figures and a remedy.
    notes : tuple of str
        Landmarks that may be misread.
    """

    route: Route
    visits: tuple[RouteVisit, ...]
    localized_after: int | None
    localized_m: float | None
    final_after: int | None
    final_m: float | None
    ambiguous_places: int
    accuracy: RouteAccuracy
    longest_m: tuple[float, float]
    covered_fraction: float
    position_sigma_m: float
    heading_sigma_rad: float
    position_p95_m: float
    heading_p95_rad: float
    warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def longest_without_fix_m(self) -> float:
        """Length of the longest stretch without a fix."""
        return self.longest_m[1] - self.longest_m[0]

    @property
    def is_localizable(self) -> bool:
        """True if the robot is localized somewhere on the route without a prior."""
        return self.localized_after is not None


def check_routes(
    floor: FloorMap,
    routes: Sequence[Route],
    noise: OdometryNoise | None = None,
    *,
    errors: VisitErrors | None = None,
    speed_mps: float = 0.1,
    sensors_m: Array | None = None,
    is_smoothed: bool = False,
    wanted_position_m: float | None = None,
    wanted_heading_rad: float | None = None,
) -> tuple[RouteCheck, ...]:
    """Predict what robots read along routes, where they are localized, and how accurately.

    Parameters
    ----------
    floor : FloorMap
    routes : sequence of Route
        In the frame of the map.
    noise : OdometryNoise, optional
        Errors of the odometry.
    errors : VisitErrors, optional
        Errors of sensors, bars and floor.
    speed_mps : float
    sensors_m : (N, 2) ndarray, optional
        In the robot's frame; by default four on the circle of the map's geometry.
    is_smoothed : bool
        False: accuracy of ``locatk live``; True: of ``locatk solve``, which uses the whole drive.
    wanted_position_m, wanted_heading_rad : float, optional
        Errors that are not to be exceeded on 95 % of a route; if they are, a warning states it.

    Raises
    ------
    InputError
        The speed is not positive, or a route is longer than :data:`MAX_ROUTE_M`.
    """
    noise, errors = noise or OdometryNoise(), errors or VisitErrors()
    if not speed_mps > 0:
        raise InputError(f"a speed of {speed_mps!r} m/s", hint="Give a number above 0")
    evidence = None
    if floor.cells():
        built = replace(floor, codes=as_built_codes(floor))
        evidence = MapEvidence(built, SolveOptions.misread)
    checks = []
    for route in routes:
        visits = find_visits(
            floor,
            route,
            noise,
            errors=errors,
            speed_mps=speed_mps,
            sensors_m=sensors_m,
            is_smoothed=is_smoothed,
        )
        check = _check_route(
            floor, route, visits, noise, evidence, speed_mps=speed_mps, is_smoothed=is_smoothed
        )
        advisor = _Advisor(floor, check, noise, errors)
        warnings = tuple(advisor.warnings(wanted_position_m, wanted_heading_rad))
        checks.append(replace(check, warnings=warnings, notes=tuple(advisor.notes())))
    return tuple(checks)


# ---- visits


def find_visits(
    floor: FloorMap,
    route: Route,
    noise: OdometryNoise | None = None,
    *,
    errors: VisitErrors | None = None,
    speed_mps: float = 0.1,
    sensors_m: Array | None = None,
    is_smoothed: bool = False,
) -> tuple[RouteVisit, ...]:
    """Return the passes of a route over landmarks, in order.

    A pass is an interval in which the solver notices the field of a landmark, plus
    :data:`~.visit_accuracy.VISIT_MARGIN_M` on both sides. Its fix is at the point next to the
    centre of the landmark if ``is_smoothed``. Otherwise it is where the last sensor leaves that
    field, because a live robot has no fix before. If a landmark is visited several times, the
    errors of its installation are those of all visits; each of n fixes has n times their
    variance, so that all together count them once.
    """
    noise, errors = noise or OdometryNoise(), errors or VisitErrors()
    sensors = circle(floor.geometry.circle_m) if sensors_m is None else sensors_m
    distance_m, poses = _sampled(route)
    cells = floor.cells()
    if not cells:
        return ()
    landmarks = [as_built_landmark(floor, cell) for cell in cells]
    centres = np.array([pose[:2] for pose, _ in landmarks])
    arm = float(np.hypot(*sensors.T).max())
    near = cKDTree(poses[:, :2]).query_ball_point(
        centres, visit_range(floor.geometry) - floor.geometry.circle_m + arm, return_sorted=True
    )
    margin = math.ceil(VISIT_MARGIN_M / STEP_M)
    peak_t = MIN_PEAK_THRESHOLDS * floor.geometry.threshold_t
    field_t = max(
        MIN_FIELD_THRESHOLDS * floor.geometry.threshold_t, MIN_FIELD_SIGMAS * errors.noise_t
    )
    found = []
    for cell, (landmark, strength), indices in zip(cells, landmarks, near, strict=True):
        if not indices:
            continue
        index = np.asarray(indices, np.int64)
        local = _in_landmark_frame(poses[index], landmark)
        points = local[:, None, :2] + sensor_arms(local, sensors)
        field = np.abs(basis(floor.geometry, points) @ strength)
        strongest = field.max(axis=1)
        inside = np.flatnonzero(strongest >= field_t)
        # Sensors on both sides of the centre may leave the field during a pass.
        for span in np.split(inside, np.flatnonzero(np.diff(index[inside]) > 2 * margin) + 1):
            if not len(span) or strongest[span].max() < peak_t:
                continue
            part = index[span]
            first, stop = max(part[0] - margin, 0), min(part[-1] + margin + 1, len(poses))
            kept = np.arange(first, stop, math.ceil((stop - first) / MAX_VISIT_POINTS))
            path = _in_landmark_frame(poses[kept], landmark)
            gap_m = np.hypot(path[:, 0], path[:, 1])
            nearest = int(np.argmin(gap_m))
            leaving = int(np.searchsorted(kept, part[-1]))
            reference = nearest if is_smoothed else min(leaving, len(kept) - 1)
            accuracy = predict_visit(
                floor.geometry,
                path,
                strength,
                reference=reference,
                sensors_m=sensors,
                speed_mps=speed_mps,
                noise=noise,
                errors=errors,
            )
            fix_m = float(distance_m[kept[reference]])
            visit = RouteVisit(
                cell,
                float(distance_m[kept[nearest]]),
                float(gap_m[nearest]),
                accuracy,
                RouteFix(fix_m, accuracy.covariance),
            )
            found.append((visit, path[reference]))
    counts = Counter(visit.cell for visit, _ in found)
    visits = []
    for visit, pose in sorted(found, key=lambda item: item[0].fix.distance_m):
        installed = installation_covariance(pose, _installation(floor, visit.cell, errors))
        covariance = visit.accuracy.covariance + counts[visit.cell] * installed
        fix = RouteFix(visit.fix.distance_m, _rotated(covariance, -pose[2]))
        visits.append(replace(visit, fix=fix))
    return tuple(visits)


def _installation(floor: FloorMap, cell: Cell, errors: VisitErrors) -> VisitErrors:
    """Return the errors with those of a landmark as built, if they were measured."""
    built = floor.built.get(cell)
    if built is None or not np.isfinite(built.sigma[:3]).all():
        return errors
    return replace(
        errors,
        landmark_position_m=float(max(built.sigma[0], built.sigma[1])),
        landmark_heading_rad=float(built.sigma[2]),
    )


def _sampled(route: Route) -> tuple[Array, Array]:
    """Return points along a route: distances (n,) and poses (n, 3), headings without jumps.

    Points are :data:`STEP_M` apart, or :data:`STEP_RAD` while the robot turns at a waypoint.
    """
    if route.length_m > MAX_ROUTE_M:
        raise InputError(
            f"{route.name} is {route.length_m:g} m long",
            hint=f"Check the unit; routes are up to {MAX_ROUTE_M:g} m long",
        )
    heading = np.unwrap(route.heading_rad)
    start_m, distances, poses = 0.0, [], []
    for number, length_m in enumerate(route.segment_m.tolist()):
        first = route.waypoint_m[number]
        if number:
            before, after = heading[number - 1 : number + 1].tolist()
            count = math.ceil(abs(after - before) / STEP_RAD) + 1
            angles = np.linspace(before, after, count)[1:-1]
            poses.append(np.column_stack([np.tile(first, (len(angles), 1)), angles]))
            distances.append(np.full(len(angles), start_m))
        along = np.linspace(0.0, length_m, max(math.ceil(length_m / STEP_M), 1) + 1)
        direction = np.array([math.cos(heading[number]), math.sin(heading[number])])
        points = first + along[:, None] * direction
        poses.append(np.column_stack([points, np.full(len(along), heading[number])]))
        distances.append(start_m + along)
        start_m += length_m
    return np.concatenate(distances), np.concatenate(poses)


def _in_landmark_frame(poses: Array, landmark: Array) -> Array:
    """Return poses (n, 3) relative to a landmark (3,)."""
    c, s = math.cos(landmark[2]), math.sin(landmark[2])
    x, y = (poses[:, :2] - landmark[:2]).T
    return np.column_stack([c * x + s * y, c * y - s * x, poses[:, 2] - landmark[2]])


def _rotated(covariance: Array, angle_rad: float) -> Array:
    """Return the covariance (3, 3) of a pose in axes rotated by minus an angle."""
    rotation = np.eye(3)
    rotation[:2, :2] = rotation_matrix_2d(angle_rad)
    return np.asarray(rotation @ covariance @ rotation.T)


# ---- localization without a prior


def count_matching_poses(floor: FloorMap, cells: Sequence[Cell]) -> NDArray[np.int64]:
    """Return how many poses on a map read the same landmarks along the same path.

    Parameters
    ----------
    floor : FloorMap
        With the codes as built.
    cells : sequence of cell
        Landmarks in the order in which they are read.

    Returns
    -------
    (len(cells),) int64 ndarray
        After each landmark, cells times headings, the true pose included. Holes are not read:
        a pose is excluded if a landmark is missing there, but not by one that was not expected.
    """
    rows, columns = floor.shape
    codes = np.where(floor.codes == HOLE_CODE, 0, floor.codes)
    exists = floor.codes != HOLE_CODE
    # Letters that are read at each of the four headings, relative to that of the route.
    letters = [letters_as_read(codes, np.array(quarters), floor.alphabet) for quarters in range(4)]
    is_possible = np.broadcast_to(exists, (4, rows, columns)).copy()
    first, counts = cells[0] if cells else (0, 0), []
    row, column = np.indices((rows, columns))
    for cell in cells:
        down, right = cell[0] - first[0], cell[1] - first[1]
        for quarters in range(4):
            there = row + down, column + right
            is_on_map = (there[0] >= 0) & (there[0] < rows)
            is_on_map &= (there[1] >= 0) & (there[1] < columns)
            index = np.where(is_on_map, there[0], 0), np.where(is_on_map, there[1], 0)
            is_equal = letters[quarters][index] == letters[0][cell]
            is_possible[quarters] &= is_on_map & exists[index] & is_equal
            down, right = right, -down  # a quarter turn counter-clockwise: x, y become -y, x
        counts.append(int(is_possible.sum()))
    return np.array(counts, np.int64)


def _connected_visits(
    floor: FloorMap, visits: Sequence[RouteVisit], accuracy: RouteAccuracy
) -> list[list[RouteVisit]]:
    """Return the chains of read visits that odometry connects beyond doubt, without repetitions."""
    chains: list[list[RouteVisit]] = []
    for visit in visits:
        if not visit.accuracy.is_usable:
            continue
        before = np.searchsorted(accuracy.distance_m, visit.fix.distance_m - 1e-9)
        sigma_m = accuracy.position_rms_m[before]
        is_linked = bool(MAX_LINK_SIGMAS * sigma_m <= floor.pitch_m / 2)
        if not chains or not is_linked:
            chains.append([])
        if visit.is_read and all(visit.cell != other.cell for other in chains[-1]):
            chains[-1].append(visit)
    return chains


def _localization(
    floor: FloorMap, chains: Sequence[Sequence[RouteVisit]]
) -> tuple[int | None, float | None, int]:
    """Return landmarks and distance until a robot is localized, and the other possible poses."""
    built = replace(floor, codes=as_built_codes(floor))
    fewest = 4 * len(floor.cells())
    for chain in chains:
        counts = count_matching_poses(built, [visit.cell for visit in chain])
        unique = np.flatnonzero(counts == 1)
        if len(unique):
            return int(unique[0]) + 1, chain[unique[0]].fix.distance_m, 0
        fewest = min([fewest, *counts.tolist()])
    return None, None, max(fewest - 1, 0)


def _final_poses(
    chains: Sequence[Sequence[RouteVisit]], evidence: MapEvidence | None
) -> tuple[int | None, float | None]:
    """Return landmarks and distance until the poses are final; None if they never are."""
    if evidence is None:
        return None, None
    for chain in chains:
        cells = [visit.cell for visit in chain]
        for count, probability in enumerate(evidence.posteriors(cells), 1):
            if probability >= PROVISIONAL_PROBABILITY:
                return count, chain[count - 1].fix.distance_m
    return None, None


# ---- one route


def _check_route(
    floor: FloorMap,
    route: Route,
    visits: tuple[RouteVisit, ...],
    noise: OdometryNoise,
    evidence: MapEvidence | None,
    *,
    speed_mps: float,
    is_smoothed: bool,
) -> RouteCheck:
    fixes = [visit.fix for visit in visits if visit.accuracy.is_usable]
    with_all_fixes = predict_accuracy(route, fixes, noise, speed_mps)
    chains = _connected_visits(floor, visits, with_all_fixes)
    localized_after, localized_m, ambiguous = _localization(floor, chains)
    final_after, final_m = _final_poses(chains, evidence)
    length_m = route.length_m
    stops = np.array([0.0, *(fix.distance_m for fix in fixes), length_m])
    longest = int(np.argmax(np.diff(stops)))
    # Before a live robot is localized, its fixes are not used.
    used = [fix for fix in fixes if is_smoothed or (localized_m or 0.0) <= fix.distance_m]
    accuracy = predict_accuracy(route, used, noise, speed_mps, is_smoothed=is_smoothed)
    is_covered = np.isfinite(accuracy.covariance).all(axis=(1, 2)) & (localized_m is not None)
    weight = np.where(is_covered, accuracy.weight_m, 0.0)
    worst_m = worst_rad = p95_m = p95_rad = math.nan
    if is_covered.any():
        worst_m = float(accuracy.position_rms_m[is_covered].max())
        worst_rad = float(accuracy.heading_sigma_rad[is_covered].max())
        p95_m, p95_rad = pose_error_quantiles(
            accuracy.covariance[is_covered], 0.95, weight[is_covered]
        )
    return RouteCheck(
        route=route,
        visits=visits,
        localized_after=localized_after,
        localized_m=localized_m,
        final_after=final_after,
        final_m=final_m,
        ambiguous_places=ambiguous,
        accuracy=accuracy,
        longest_m=(float(stops[longest]), float(stops[longest + 1])),
        covered_fraction=float(weight.sum() / length_m),
        position_sigma_m=worst_m,
        heading_sigma_rad=worst_rad,
        position_p95_m=p95_m,
        heading_p95_rad=p95_rad,
    )


# ---- warnings


@dataclass(frozen=True)
class _Advisor:
    """Problems of a route in words, with figures and remedies.

    Attributes
    ----------
    floor : FloorMap
    check : RouteCheck
    noise : OdometryNoise
    errors : VisitErrors
    """

    floor: FloorMap
    check: RouteCheck
    noise: OdometryNoise
    errors: VisitErrors

    @cached_property
    def pass_m(self) -> float:
        """Result of :func:`max_pass_offset`, which takes a tenth of a second."""
        return max_pass_offset(self.floor.geometry, self.noise, self.errors)

    def warnings(
        self, wanted_position_m: float | None, wanted_heading_rad: float | None
    ) -> Iterator[str]:
        """Yield what is missing, and a remedy."""
        check, name = self.check, self.check.route.name
        if not check.is_localizable:
            count = len({visit.cell for visit in check.visits if visit.is_read})
            problem = f"no landmark is read on {check.route.length_m:.3g} m"
            if count:
                others = check.ambiguous_places
                problem = (
                    f"{others} other place{'s' * (others != 1)} of the map "
                    f"{'has' if others == 1 else 'have'} the same landmarks ({count}) along it"
                )
            remedy = self.shorten_gap(LONGER_ROUTE)
            yield f"route {name} is not localisable: {problem}; {remedy}"
        for wanted, reached, quantity, unit, scale in (
            (wanted_position_m, check.position_p95_m, "position", "mm", 1e3),
            (wanted_heading_rad, check.heading_p95_rad, "heading", "deg", 180 / math.pi),
        ):
            if wanted is not None and reached > wanted:
                yield (
                    f"route {name} has a {quantity} error of up to {scale * reached:.2g} {unit} on "
                    f"95 % of it, not {scale * wanted:.2g} {unit}; {self.improve_accuracy()}"
                )

    def notes(self) -> Iterator[str]:
        """Yield the landmarks that may be misread."""
        check = self.check
        doubtful = [visit for visit in check.visits if not visit.is_read]
        if not doubtful:
            return
        first = ", ".join(
            f"{visit.cell[0]},{visit.cell[1]} at {1e3 * visit.offset_m:.0f} mm"
            for visit in doubtful[:MAX_NAMED_LANDMARKS]
        )
        more = " ..." if len(doubtful) > MAX_NAMED_LANDMARKS else ""
        yield (
            f"route {check.route.name} only grazes {len(doubtful)} of {len(check.visits)} "
            f"landmarks ({first}{more}), so that they may be misread; pass within "
            f"{1e3 * self.pass_m:.0f} mm of their centres"
        )

    def improve_accuracy(self) -> str:
        """Return what makes the position or the heading more accurate."""
        sigma_m = self.check.accuracy.position_rms_m
        is_flat = float(np.nanmin(sigma_m)) > MIN_FLATNESS * self.check.position_sigma_m
        if is_flat and not self.floor.built:
            return (
                "the installation of the landmarks is the largest error: measure them "
                "(locatk calibrate map)"
            )
        return self.shorten_gap("calibrate the odometry, or make the pitch smaller")

    def shorten_gap(self, otherwise: str) -> str:
        """Return what makes the longest stretch without a fix shorter, if anything does."""
        floor, route = self.floor, self.check.route
        start_m, end_m = self.check.longest_m
        length_m = end_m - start_m
        shift = best_shift(floor, route, self.pass_m)
        if shift is not None:
            return (
                f"shift the route by {1e3 * shift.x_m:.0f} mm in x and {1e3 * shift.y_m:.0f} mm in "
                f"y: it is then {shift.longest_m:.2g} m instead of {shift.unshifted_m:.2g} m "
                "without a landmark"
            )
        middle = route.at(np.array([(start_m + end_m) / 2]))[0][0]
        column, row = np.rint((middle - floor.origin_m) / floor.pitch_m).astype(int).tolist()
        rows, columns = floor.shape
        if not (-1 <= row <= rows and -1 <= column <= columns):
            x, y = floor.position((rows - 1, columns - 1))
            return (
                f"the route leaves the map (x {floor.origin_m[0]:.2g} to {x:.2g} m, "
                f"y {floor.origin_m[1]:.2g} to {y:.2g} m) from {start_m:.2g} m on; extend the map"
            )
        is_on_map = 0 <= row < rows and 0 <= column < columns
        if not is_on_map or floor.codes[row, column] == HOLE_CODE:
            return (
                f"add a landmark at {row},{column}: the route is {length_m:.2g} m without one there"
            )
        return otherwise


def max_pass_offset(
    geometry: Geometry, noise: OdometryNoise | None = None, errors: VisitErrors | None = None
) -> float:
    """Return the largest distance from its centre at which any landmark is read by a pass [m].

    It is a multiple of 5 mm; 0 if no pass reads all landmarks.
    """
    offsets = PASS_STEP_M * np.arange(math.ceil(visit_range(geometry) / PASS_STEP_M))
    for offset in offsets[::-1].tolist():
        path = straight_path(geometry, offset, 0.0)
        visits = (
            predict_visit(geometry, path, signs(code_of(letters)), noise=noise, errors=errors)
            for letters in PATTERNS
        )
        if all(visit.is_read for visit in visits):
            return float(offset)
    return 0.0


@dataclass(frozen=True)
class RouteShift:
    """Parallel shift of a route.

    Attributes
    ----------
    x_m, y_m : float
    longest_m, unshifted_m : float
        Longest stretch without a landmark, shifted and as it is. A landmark counts if the route is
        within the given distance of its centre.
    """

    x_m: float
    y_m: float
    longest_m: float
    unshifted_m: float


def best_shift(floor: FloorMap, route: Route, pass_m: float) -> RouteShift | None:
    """Return the shift of a route with the shortest stretch between landmarks.

    A landmark counts if the route is within ``pass_m`` of its centre. Shifts are multiples of an
    eighth of the pitch, up to half a pitch. Of those with the same stretch (to an eighth as well),
    it is the one that passes landmarks more closely, then the smallest.

    Returns
    -------
    RouteShift or None
        None if no shift makes the longest stretch shorter by :data:`MIN_SHIFT_GAIN` and
        :data:`MIN_SHIFT_GAIN_PITCHES`.
    """
    cells = floor.cells()
    if not cells:
        return None
    tree = cKDTree([as_built_landmark(floor, cell)[0][:2] for cell in cells])
    along = np.linspace(0.0, route.length_m, max(math.ceil(route.length_m / 0.01), 1) + 1)
    position = route.at(along)[0]
    grid = floor.pitch_m * np.arange(-SHIFT_STEPS // 2, SHIFT_STEPS // 2 + 1) / SHIFT_STEPS
    ranked = []
    for x in grid.tolist():
        for y in grid.tolist():
            gap_m = np.asarray(tree.query(position + (x, y))[0])
            stops = np.concatenate([[0.0], along[gap_m <= pass_m], [route.length_m]])
            longest_m = float(np.diff(stops).max())
            steps = math.ceil(longest_m / (floor.pitch_m / SHIFT_STEPS))
            rank = steps, round(gap_m.mean(), 3), math.hypot(x, y)
            ranked.append((rank, x, y, longest_m))
    unshifted_m = next(longest_m for rank, _, _, longest_m in ranked if rank[-1] == 0)
    _, x, y, longest_m = min(ranked)
    gain_m = max(MIN_SHIFT_GAIN_PITCHES * floor.pitch_m, MIN_SHIFT_GAIN * unshifted_m)
    if unshifted_m - longest_m < gain_m:
        return None
    return RouteShift(x, y, longest_m, unshifted_m)


# ---- forecast for a floor without a map


@dataclass(frozen=True)
class FloorForecast:
    """Accuracy on a regular floor of landmarks, for straight drives anywhere on it.

    Attributes
    ----------
    position_at_p95_m, heading_at_p95_rad : float
        Errors that are not exceeded in 95 % of the cases right after a landmark (position: both
        axes together).
    position_p95_m, heading_p95_rad : float
        The same anywhere along the drives, after the first landmark.
    without_fix_p95_m : float
        Distance between two fixes that is not exceeded in 95 % of the cases.
    read_fraction : float
        Fraction of the passes whose code is read beyond reasonable doubt.
    landmarks_per_m : float
        Fixes in a metre.
    """

    position_at_p95_m: float
    heading_at_p95_rad: float
    position_p95_m: float
    heading_p95_rad: float
    without_fix_p95_m: float
    read_fraction: float
    landmarks_per_m: float

    def is_within(self, position_m: float, heading_rad: float | None) -> bool:
        """Return whether the errors anywhere are at most these; None for any heading."""
        return self.position_p95_m <= position_m and (
            heading_rad is None or self.heading_p95_rad <= heading_rad
        )


def forecast_floor(
    geometry: Geometry,
    pitch_m: float,
    noise: OdometryNoise | None = None,
    *,
    errors: VisitErrors | None = None,
    speed_mps: float = 0.1,
    is_smoothed: bool = False,
    routes: int = FORECAST_ROUTES,
) -> FloorForecast:
    """Predict the accuracy on a regular floor of landmarks whose codes are not known yet.

    Straight drives of evenly distributed headings and offsets cross a floor with random codes,
    always the same.

    Parameters
    ----------
    geometry : Geometry
    pitch_m : float
    noise : OdometryNoise, optional
    errors : VisitErrors, optional
    speed_mps : float
    is_smoothed : bool
        See :func:`check_routes`.
    routes : int
        Number of drives.
    """
    if not pitch_m > 0:
        raise InputError(f"a pitch of {pitch_m!r} m", hint="Give a number above 0")
    noise, errors = noise or OdometryNoise(), errors or VisitErrors()
    side = FORECAST_PITCHES + 2
    codes = np.random.default_rng(0).integers(0, CODE_COUNT, (side, side))
    floor = FloorMap(codes, pitch_m=pitch_m, geometry=geometry)
    middle = pitch_m * (side - 1) / 2
    covariances, weights, at_fix, gaps, passes, read, length_m = [], [], [], [], 0, 0, 0.0
    for number in range(routes):
        # Golden-ratio sequences (Kronecker) fill angles and offsets evenly.
        heading = math.pi / 2 * ((number * 0.6180339887) % 1.0) + math.pi / 2 * (number % 4)
        offset = pitch_m * ((number * 0.7548776662) % 1.0 - 0.5)
        c, s = math.cos(heading), math.sin(heading)
        half = pitch_m * FORECAST_PITCHES / 2
        centre = np.array([middle - s * offset, middle + c * offset])
        route = Route(
            np.array([centre - half * np.array([c, s]), centre + half * np.array([c, s])])
        )
        visits = find_visits(
            floor, route, noise, errors=errors, speed_mps=speed_mps, is_smoothed=is_smoothed
        )
        fixes = [visit.fix for visit in visits if visit.accuracy.is_usable]
        accuracy = predict_accuracy(route, fixes, noise, speed_mps, is_smoothed=is_smoothed)
        passes, read = passes + len(visits), read + sum(visit.is_read for visit in visits)
        stops = [fix.distance_m for fix in fixes]
        gaps.extend(np.diff([0.0, *stops, route.length_m]).tolist())
        length_m += route.length_m
        is_known = np.isfinite(accuracy.since_fix_m)
        covariances.append(accuracy.covariance[is_known])
        weights.append(accuracy.weight_m[is_known])
        at_fix.append(accuracy.since_fix_m[is_known] == 0)
    covariance, weight = np.concatenate(covariances), np.concatenate(weights)
    is_fix = np.concatenate(at_fix)
    if not is_fix.any():
        return FloorForecast(
            *(math.inf,) * 4,
            without_fix_p95_m=math.inf,
            read_fraction=0.0,
            landmarks_per_m=0.0,
        )
    return FloorForecast(
        *pose_error_quantiles(covariance[is_fix]),
        *pose_error_quantiles(covariance, weight=weight),
        without_fix_p95_m=float(np.quantile(gaps, 0.95)),
        read_fraction=read / passes,
        landmarks_per_m=float(is_fix.sum() / length_m),
    )
